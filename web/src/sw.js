// The service worker: the page works offline once it was loaded, and may use threads on hosts that send no headers.

const CACHE = "polsep-VERSION", FILES = ["./", ...FILES_OF_THE_PAGE], LATER = FILES_FOR_SOME;
const OWN = new Set([...FILES, ...LATER].map((name) => new URL(name, self.location.href).href));

self.addEventListener("install", (event) => {
  // Not from the browser's own cache: soon after a new build it has files of the old one.
  const requests = FILES.map((name) => new Request(name, { cache: "reload" }));
  event.waitUntil(caches.open(CACHE).then((cache) => cache.addAll(requests)));
});

self.addEventListener("activate", (event) => {
  const old = caches.keys().then((names) => Promise.all(names.filter((name) => name !== CACHE && name.startsWith("polsep-")).map((name) => caches.delete(name))));
  event.waitUntil(old.then(() => self.clients.claim()));
});

self.addEventListener("fetch", (event) => {
  const url = new URL(event.request.url);
  url.search = url.hash = "";
  if (event.request.method !== "GET" || !OWN.has(url.href)) return;  // other pages of the host are not ours
  event.respondWith(answer(event.request));
});

/** From the cache, else from the host; with the headers that isolate the page, which threads need. */
async function answer(request) {
  let found = await caches.match(request, { ignoreSearch: true, cacheName: CACHE });
  if (!found) {
    found = await fetch(request);
    if (found.status === 200) await (await caches.open(CACHE)).put(request, found.clone()).catch(() => {});  // no room: it works without
  }
  const headers = new Headers(found.headers);
  headers.set("Cross-Origin-Opener-Policy", "same-origin");
  headers.set("Cross-Origin-Embedder-Policy", "require-corp");
  headers.set("Cross-Origin-Resource-Policy", "same-origin");
  return new Response(found.body, { status: found.status, statusText: found.statusText, headers });
}
