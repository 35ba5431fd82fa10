// The page: files in, settings, pictures, files out. Everything is computed by the worker.

import { PIXEL_FORMATS } from "./read.js";
import { clearnessOf, drawView, fittingGain } from "./tone.js";
import { Viewer } from "./viewer.js";

const VIEWS = { input: "Input", diffuse: "Diffuse", specular: "Specular", dolp: "DoLP", aolp: "AoLP" };
const part = (id) => document.getElementById(id);
const options = new URLSearchParams(location.search);
const worker = new Worker(new URL("worker.js", location.href), { type: "module" });
const viewer = new Viewer(part("stage"), part("canvas"), part("handle"), showScale);
/** Settings that describe a file. */
const OF_FILES = ["black", "white", "sensor", "layout", "light"];
// name: of the images shown; frame: name of the frame that the worker holds, once there is one; pending: the file that is
// being read, or whose format is asked for; subject: name of the file at work; kept: settings of the frame meanwhile;
// shown: what the status says of the images.
const state = {
  images: null, report: null, gain: 1, name: "", shown: "", frame: "", pending: null, kept: null,
  subject: "", busy: false, again: false, next: null,
};

for (const [id, start] of [["left", "diffuse"], ["right", "specular"]])
  part(id).append(...Object.entries(VIEWS).map(([value, text]) => new Option(text, value, value === start, value === start)));
part("format").append(...Object.keys(PIXEL_FORMATS).map((name) => new Option(name, name)));
part("format").value = "BayerRG12p";

const asked = [];
worker.onmessage = ({ data }) => {
  if (data.progress) return showProgress(data.progress);
  const { resolve, reject } = asked.shift();
  part("progress").hidden = true;
  if (data.failed) reject(new Error(data.failed));
  else resolve(data);
};
let broken = null;
worker.onerror = (event) => {  // it did not start, and never will
  broken = new Error(event.message || "expected worker.js beside the page, found none that runs: reload the page");
  for (const { reject } of asked.splice(0)) reject(broken);
};

/** What the worker answers to a job; it takes one after the other. Throws what went wrong, in one line. */
function ask(job, message = {}) {
  return new Promise((resolve, reject) => {
    if (broken) throw broken;
    asked.push({ resolve, reject });
    worker.postMessage({ job, ...message });
  });
}

function showProgress({ share, text }) {
  part("progress").hidden = false;
  part("progress").value = share;
  part("status").textContent = `${state.subject} · ${text} …`;
}

/** The number in a field, null where there is none. Throws on what is no number, like 4e. */
function numberIn(id, name) {
  if (part(id).validity.badInput) throw new Error(`expected a number as ${name}, found text that is none`);
  return part(id).value === "" ? null : part(id).valueAsNumber;
}

const settings = () => ({
  method: part("method").value,
  white: numberIn("white", "white level"),  // 0 is said, and refused
  black: numberIn("black", "black level") ?? 0,
  layout: part("sensor").value === "other" ? part("layout").value.trim() || part("layout").placeholder : part("sensor").value || null,
  light: part("light").value === "stated" ? part("color").value.split(",").map(Number) : part("light").value,
  threads: Number(options.get("threads")) || 0,
  device: options.get("device") || part("device").value,
});

/** Read a file and separate it; after what is at work, of several files the last. `stated`: format and size; `white`:
 * its white level where that is known. */
function open(file, stated = null, white = null) {
  if (!state.busy) return work(() => read(file, stated, white), file.name);
  state.next = [file, stated, white];
  part("status").textContent = `${file.name} · next …`;
}

/** Do one thing for a file at a time, then what was asked for meanwhile: another file, or other settings. */
async function work(act, subject) {
  Object.assign(state, { busy: true, subject });
  try {
    await act();
  } catch (error) {
    fail(error);
  } finally {
    state.busy = false;
  }
  const next = state.next;
  state.next = null;
  if (next) await open(...next);
  else if (state.again) separate();
}

async function read(file, stated, white) {
  if (!stated && state.kept) restoreSettings(); // the file whose format was asked for is dropped
  state.pending = file;
  document.body.dataset.state = "busy";
  part("raw").hidden = !stated;
  clearNotes();
  const found = await ask("open", { file, name: file.name, stated }).catch((error) => {
    if (!stated) state.pending = null;  // else the format can be put right
    throw error;
  });
  if (found.needsFormat && state.frame) state.kept = Object.fromEntries(OF_FILES.map((id) => [id, part(id).value]));
  if (!stated && (state.frame || white)) beginSettings(white);
  if (found.needsFormat) return askFormat(found);
  Object.assign(state, { pending: null, frame: file.name, kept: null });
  part("raw").hidden = true;
  await separateOpen();
}

/** The settings of the frame that is shown, as they were before another file asked for its format. */
function restoreSettings() {
  for (const [id, value] of Object.entries(state.kept)) part(id).value = value;
  state.kept = null;
  showFields();
}

/** The settings that describe a file, as the page begins with them: another file has others. */
function beginSettings(white) {
  for (const id of ["black", "sensor", "layout"]) part(id).value = "";
  part("white").value = white ?? "";
  part("light").value = "auto";
  showFields();
}

function showFields() {
  part("order").hidden = part("sensor").value !== "other";
  part("rgb").hidden = part("light").value !== "stated";
}

function askFormat({ size, guesses }) {
  part("raw").hidden = false;
  document.body.dataset.state = "asking";
  part("status").textContent = `${state.subject}: ${size} bytes without a header. Which format and size?`;
  if (!guesses.length) return;
  part("format").value = guesses[0].format;
  part("width").value = guesses[0].width;
  part("height").value = guesses[0].height;
}

/** Separate the frame that is open, by the settings as they are; once more where these change meanwhile. */
function separate() {
  if (state.busy) state.again = true;
  else if (state.frame && !state.pending) work(separateOpen, state.frame);  // else the settings are of a file to come
}

async function separateOpen() {
  do {
    state.again = false;
    document.body.dataset.state = "busy";
    showResult(await ask("separate", { settings: settings() }));  // always: the worker writes files of its last result
  } while (state.again && !state.next);
}

function showResult({ images, report, notes, name }) {
  const first = !state.images;
  Object.assign(state, { images: { ...images, clearness: clearnessOf(images) }, report, gain: fittingGain(images), name });
  part("empty").hidden = true;
  document.body.classList.remove("empty");
  clearNotes(name);
  part("notes").append(...notes.map(noteItem));
  draw();
  if (first) viewer.fit();
  const seconds = Object.entries(report.seconds).reduce((total, [name, own]) => (name === "load" ? total : total + own), 0);
  const where = report.device ? ` on the ${report.device}` : "";
  state.shown = `${name} · ${images.width}×${images.height} · ${report.method}${where} · ${seconds.toFixed(1)} s`;
  part("status").textContent = state.shown;
  showFacts(report);
  showReadout();
  document.body.dataset.state = "done";
  window.polsep = { images, report, notes };  // for tests and the curious
}

function showFacts({ light, light_color: color, statistics: s, defects, colored_specular: metal }) {
  const percent = (share) => `${(100 * share).toFixed(share < 0.01 ? 2 : 1)} %`, facts = [];
  if (color.length === 3) {
    const swatch = document.createElement("span"), top = Math.max(...color);
    swatch.className = "swatch";
    swatch.style.background = `rgb(${color.map((gain) => Math.round(255 * (gain / top) ** (1 / 2.2)))})`;
    const source = light.source === "found" ? (light.sure ? "found" : "unsure") : "stated";
    facts.push([`Lamp, ${source}`, [swatch, color.map((gain) => gain.toFixed(2)).join(", ")]]);
  }
  facts.push(["Specular share", [percent(s.specular_fraction)]], ["Clipped", [percent(s.clipped_fraction)]],
    ["Highlights' AoLP", [`${s.specular_aolp_deg.toFixed(0) % 180}°`]], ["Concentration", [s.specular_aolp_concentration.toFixed(2)]]);
  if (defects) facts.push(["Pixels repaired", [String(defects)]]);
  if (metal) facts.push(["Coloured metal", [percent(metal)]]);
  part("facts").replaceChildren(...facts.flatMap(([name, values]) => {
    const [term, value] = [document.createElement("dt"), document.createElement("dd")];
    term.textContent = name;
    value.append(...values);
    return [term, value];
  }));
}

/** A note with a button for what it recommends. */
function noteItem({ text, white, black, layout }) {
  const item = document.createElement("li");
  item.textContent = text;
  const offer = (label, act) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = label;
    button.onclick = () => {
      act();
      separate();
    };
    item.append(button);
  };
  if (white) offer(`Use white level ${white}`, () => (part("white").value = white));
  if (black != null) offer(`Use black level ${black}`, () => (part("black").value = black));
  if (layout) offer(`Use ${layout}`, () => useLayout(layout));
  return item;
}

function useLayout(layout) {
  const known = ["color", "mono"].includes(layout);
  part("sensor").value = known ? layout : "other";
  part("layout").value = known ? "" : layout;
  showFields();
}

/** Remove the notes, but for what is wrong with another file than the one given. */
function clearNotes(name = null) {
  const kept = name === null ? [] : [...part("notes").querySelectorAll(".failed")].filter((item) => item.dataset.file !== name);
  part("notes").replaceChildren(...kept);
}

function fail(error, file = state.subject) {
  const item = document.createElement("li");
  item.className = "failed";
  item.dataset.file = file;
  item.textContent = `${file}: ${error.message}`;
  part("notes").replaceChildren(item);
  part("status").textContent = state.shown;
  part("progress").hidden = true;
  document.body.dataset.state = "failed";
}

let waiting = 0;
/** Draw both pictures, at most once per frame of the screen. */
function draw() {
  part("stops-shown").value = Number(part("stops").value).toFixed(1);
  if (!state.images) return;
  waiting ||= requestAnimationFrame(() => {
    waiting = 0;
    const { images } = state, gain = state.gain * 2 ** Number(part("stops").value);
    const picture = (view) => new ImageData(drawView(view, images, gain), images.width, images.height);
    const [left, right] = [part("left").value, part("right").value], one = picture(left);
    viewer.show(one, left === right ? one : picture(right));
    drawLegend(part("legend-left"), left);
    drawLegend(part("legend-right"), right);
  });
}

/** What the colours of a map mean: a bar from 0 to 1 for DoLP, a disc of angles for AoLP. */
function drawLegend(canvas, view) {
  const side = canvas.width, context = canvas.getContext("2d");
  canvas.hidden = view !== "dolp" && view !== "aolp";
  if (canvas.hidden) return;
  const n = side * side, dolp = new Float32Array(n), aolp = new Float32Array(n), alpha = new Uint8Array(n);
  for (let r = 0, k = 0; r < side; r++)
    for (let c = 0; c < side; c++, k++) {
      const [x, y] = [c - side / 2 + 0.5, side / 2 - 0.5 - r], radius = Math.hypot(x, y) / (side / 2);
      aolp[k] = (Math.atan2(y, x) + Math.PI) % Math.PI;
      dolp[k] = view === "aolp" ? radius : c / side;
      alpha[k] = view === "aolp" ? 235 * (radius < 1) : 235 * (r > side - 34 && r < side - 18);
    }
  const picture = new ImageData(drawView(view, { dolp, aolp, diffuse: dolp, specular: dolp, colors: 1 }, 1), side, side);
  alpha.forEach((value, k) => (picture.data[4 * k + 3] = value));
  context.putImageData(picture, 0, 0);
  context.fillStyle = "#e8e8ea";
  context.font = "12px system-ui, sans-serif";
  context.shadowColor = "#000";
  context.shadowBlur = 3;
  if (view === "dolp") {
    context.fillText("DoLP 0", 0, side - 3);
    context.fillText("1", side - 8, side - 3);
  } else {
    context.fillText("0°", side - 18, side / 2 + 4);
    context.fillText("90°", side / 2 - 9, 13);
  }
  context.shadowBlur = 0;
}

function showScale() {
  part("scale").value = viewer.pictures.length ? `${Math.round(100 * viewer.scale * viewer.ratio)} %` : "";
}

/** Offer a file to the visitor. */
function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}

function closeMenu() {
  part("download").open = false;
  part("download").querySelector("summary").focus();
}

async function download(format) {
  closeMenu();
  while (state.busy) await new Promise((resolve) => setTimeout(resolve, 50)); // a setting that has just been left
  if (!state.images) return;
  const stem = state.name.replace(/\.[^.]*$/, "");
  if (format === "left" || format === "right") {
    const canvas = viewer.pictures[format === "left" ? 0 : 1];
    return save(await canvas.convertToBlob({ type: "image/png" }), `${stem}_${part(format).value}_preview.png`);
  }
  const status = part("status").textContent;
  await work(async () => {
    const { blob } = await ask("write", { format });
    save(blob, format === "exr" ? `${stem}.exr` : `${stem}_${format}.png`);
    part("status").textContent = status;
  }, state.name);
}

let pointed = null;  // row and column of the pixel under the pointer, or the last one that was
/** The numbers of that pixel. */
function showReadout() {
  const { height, width, colors, diffuse, specular, dolp, aolp, valid } = state.images ?? { height: 0 };
  if (!pointed || pointed[0] >= height || pointed[1] >= width) return void (part("readout").textContent = "");
  const [row, column] = pointed, k = row * width + column;
  const values = (image) => Array.from({ length: colors }, (_, c) => image[k * colors + c].toFixed(3)).join("  ");
  part("readout").textContent = `row ${row}, column ${column}${valid[k] ? "" : ", clipped: estimated"}\n` +
    `diffuse ${values(diffuse)}\nspecular ${values(specular)}\nDoLP ${dolp[k].toFixed(3)}, AoLP ${(((aolp[k] * 180) / Math.PI).toFixed(1) % 180).toFixed(1)}°`;
}

for (const id of ["open", "choose"]) part(id).onclick = () => part("file").click();
part("file").onchange = () => {
  if (part("file").files[0]) open(part("file").files[0]);
  part("file").value = "";
};
part("example").onclick = async () => {
  const answer = await fetch("example.png").catch(() => null);
  if (!answer?.ok) return fail(new Error("expected the example beside the page, found none"), "example.png");
  open(new File([await answer.blob()], "example.png"), null, 4095);
};
part("raw").onsubmit = (event) => {
  event.preventDefault();
  open(state.pending, { format: part("format").value, width: part("width").valueAsNumber, height: part("height").valueAsNumber });
};
part("leave").onclick = () => {
  if (state.busy) return;  // it is being read
  if (state.kept) restoreSettings();
  state.pending = null;
  part("raw").hidden = true;
  clearNotes();
  part("status").textContent = state.shown;
  document.body.dataset.state = "ready";
  separate();  // the frame before, and what was said of it
};
part("settings").onsubmit = (event) => event.preventDefault();
part("settings").onchange = () => {
  showFields();
  separate();
};
for (const id of ["left", "right"]) part(id).onchange = draw;
part("stops").oninput = draw;
part("stops").ondblclick = () => {
  part("stops").value = 0;
  draw();
};
part("fit").onclick = () => viewer.fit();
part("actual").onclick = () => viewer.actual();
for (const left of ["pointerdown", "focusin"])
  addEventListener(left, ({ target }) => part("download").contains(target) || (part("download").open = false));
part("download").onkeydown = ({ key }) => {
  if (key === "Escape") closeMenu();
};
part("download").onclick = ({ target }) => target.dataset.format && download(target.dataset.format);
part("stage").addEventListener("pointermove", (event) => {
  const box = part("stage").getBoundingClientRect();
  pointed = viewer.pixelAt(event.clientX - box.left, event.clientY - box.top);
  showReadout();
});
addEventListener("dragover", (event) => {
  event.preventDefault();
  part("over").hidden = false;
});
addEventListener("dragleave", (event) => event.relatedTarget || (part("over").hidden = true));
addEventListener("drop", (event) => {
  event.preventDefault();
  part("over").hidden = true;
  const { files } = event.dataTransfer;
  if (files.length > 1) fail(new Error(`expected one raw frame, found ${files.length} files: drop them one by one`), files[0].name);
  else if (files.length) open(files[0]);
});

// The page works offline once it was loaded; the service worker also asks for what threads need (sw.js).
if (!options.has("plain")) navigator.serviceWorker?.register("sw.js").catch(() => {});
document.body.dataset.state = "ready";
ask("warm", { settings: settings() }).catch((error) => console.warn(error));  // while the visitor looks for a file
