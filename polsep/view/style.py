"""Style and scripts of the page: plain text for Gradio.

Fonts are the system's, and nothing is fetched from elsewhere. The picture is on neutral grey, because colours around
it change its appearance.
"""

from __future__ import annotations

FONTS = ["system-ui", "Segoe UI", "Roboto", "Helvetica Neue", "sans-serif"]
MONOSPACE = ["ui-monospace", "Menlo", "Consolas", "monospace"]

#: Always the dark theme, for pictures; Gradio would follow the system. Files may be dropped anywhere. A list that loses
#: the keyboard is closed: Gradio opens it again on the Tab key.
ON_LOAD = """() => {
  const keep = () => document.body.classList.contains('dark') || document.body.classList.add('dark');
  new MutationObserver(keep).observe(document.body, {attributes: true, attributeFilter: ['class']});
  keep();
  window.addEventListener('dragover', (event) => event.preventDefault());
  const inside = async (folder) => {  // results, else raw frames; else a file of its name, refused in words
    const reader = folder.createReader(), all = [];
    const more = () => new Promise((done, fail) => reader.readEntries(done, fail));  // a hundred at a time
    for (let some = await more(); some.length; some = await more()) all.push(...some);
    const files = all.filter((entry) => entry.isFile && !entry.name.startsWith('.'));
    const [results, frames] = [/[.]exr$/i, /[.](png|tiff?|npy|npz|pgm|raw|bin)$/i]
      .map((kinds) => files.filter((entry) => kinds.test(entry.name)));
    const kept = await Promise.all((results.length ? results : frames)
      .map((entry) => new Promise((done, fail) => entry.file(done, fail))));
    return kept.length ? kept : [new File([], folder.name)];
  };
  window.addEventListener('drop', async (event) => {
    event.preventDefault();
    const items = [...event.dataTransfer?.items ?? []].map((item) => [item.webkitGetAsEntry(), item.getAsFile()]);
    const field = document.querySelector('#ps-top input[type=file]'), dropped = new DataTransfer();
    for (const [entry, file] of items)
      for (const own of entry?.isDirectory ? await inside(entry) : file ? [file] : []) dropped.items.add(own);
    if (!field || !dropped.files.length) return;
    field.files = dropped.files;
    field.dispatchEvent(new Event('change', {bubbles: true}));
  });
  document.addEventListener('focusout', (event) => {
    if (event.target.matches('input[role=combobox]')) {
      event.target.dispatchEvent(new KeyboardEvent('keydown', {key: 'Escape', bubbles: true}));
    }
  });
}"""

#: Download the target of the hidden link, after the file was written.
FETCH = "() => { const link = document.querySelector('#ps-fetch'); (link.querySelector('a') ?? link).click(); }"

#: The picture: wheel, pinch and keys zoom at the pointer, a drag pans or moves the line, a click keeps a pixel. Sizes
#: follow from four properties: --cut of the line, --z of the zoom (1 fits), --x and --y of the centre in pixels.
STAGE = """
const MOST = 32;  // pixels of the screen for one of the frame
let view = {z: 1, x: 0, y: 0}, fingers = new Map(), press = null, timer = 0, hovered = 0, waiting = null;
const stage = () => element.querySelector('.ps-stage');
const frame = () => stage().getBoundingClientRect();
const ratio = () => parseFloat(stage().style.getPropertyValue('--ratio'));
const fit = () => { const f = frame(); return Math.min(f.width, f.height * ratio()); };
const one = () => stage().dataset.width / devicePixelRatio / fit();
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
const world = () => {
  const f = frame(), width = fit() * view.z, height = width / ratio();
  const left = f.left + f.width / 2 + view.x - width / 2, top = f.top + f.height / 2 + view.y - height / 2;
  return {left, top, width, height};
};
const place = (event) => {
  const w = world();
  return {x: (event.clientX - w.left) / w.width, y: (event.clientY - w.top) / w.height};
};
const inside = (at) => at.x >= 0 && at.x < 1 && at.y >= 0 && at.y < 1;
const cut = (share) => {
  const percent = Math.round(1000 * clamp(share, 0, 1)) / 10;
  element.style.setProperty('--cut', percent + '%');
  element.querySelector('.ps-handle')?.setAttribute('aria-valuenow', percent);
};
const apply = () => {
  if (!stage()) return;
  const f = frame(), width = fit() * view.z, height = width / ratio();
  const x = Math.max((width - f.width) / 2, 0), y = Math.max((height - f.height) / 2, 0);
  view.x = clamp(view.x, -x, x);
  view.y = clamp(view.y, -y, y);
  for (const name of ['x', 'y', 'z']) element.style.setProperty('--' + name, view[name]);
  stage().classList.toggle('ps-zoomed', view.z > 1);
  stage().classList.toggle('ps-large', view.z > 2 * one());
  const shown = element.querySelector('.ps-tools output');
  if (shown) shown.textContent = Math.round(100 * view.z / one()) + ' %';
  clearTimeout(timer);
  timer = setTimeout(sharpen, 150);
};
const sharpen = () => {
  if (!stage() || fingers.size) return;
  const f = frame(), w = world();
  if (!f.width) return;
  const side = (from, length, low, size, round) => clamp(round(10000 * (from + length - low) / size), 0, 10000);
  const window = [side(f.left, 0, w.left, w.width, Math.floor), side(f.top, 0, w.top, w.height, Math.floor),
    side(f.left, f.width, w.left, w.width, Math.ceil), side(f.top, f.height, w.top, w.height, Math.ceil)];
  const pixels = Math.ceil((window[2] - window[0]) / 10000 * w.width * devicePixelRatio);
  const wanted = [...window, clamp(pixels, 1, 99999)].join(',');
  if (wanted !== stage().dataset.window) trigger('input', {window: wanted});
};
const zoom = (z, at) => {
  const f = frame(), low = Math.min(1, one()), next = clamp(z, low, Math.max(MOST * one(), 1)), k = next / view.z;
  const x = at ? at.clientX - f.left - f.width / 2 : 0, y = at ? at.clientY - f.top - f.height / 2 : 0;
  view = {z: next, x: x - (x - view.x) * k, y: y - (y - view.y) * k};
  apply();
};
const tools = {in: () => zoom(view.z * 1.5), out: () => zoom(view.z / 1.5), one: () => zoom(one()), fit: () => zoom(1)};
const middle = () => {
  const [a, b] = [...fingers.values()];
  return {clientX: (a.clientX + b.clientX) / 2, clientY: (a.clientY + b.clientY) / 2,
    apart: Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY)};
};
element.addEventListener('wheel', (event) => {
  if (!event.target.closest('.ps-stage')) return;
  event.preventDefault();
  zoom(view.z * Math.exp(-clamp(event.deltaY, -120, 120) * (event.ctrlKey ? 0.01 : 0.002)), event);
}, {passive: false});
element.addEventListener('pointerdown', (event) => {
  if (event.button !== 0 || !event.target.closest('.ps-stage') || event.target.closest('.ps-tools')) return;
  event.preventDefault();
  const handle = event.target.closest('.ps-handle');
  (handle ?? stage()).focus({preventScroll: true});
  fingers.set(event.pointerId, event);
  press = fingers.size === 1 ? {x: event.clientX, y: event.clientY, from: {...view}, moved: !!handle, line: !!handle}
    : {pinch: middle(), from: {...view}, moved: true};
});
window.addEventListener('pointermove', (event) => {
  if (!stage()) return;
  if (!press) { hover(event); return; }
  if (!fingers.has(event.pointerId)) return;
  fingers.set(event.pointerId, event);
  if (press.pinch && fingers.size === 2) {
    const now = middle();
    view = {...press.from};
    view.x += now.clientX - press.pinch.clientX;
    view.y += now.clientY - press.pinch.clientY;
    zoom(press.from.z * now.apart / Math.max(press.pinch.apart, 1), now);
  } else if (!press.pinch) {
    press.moved ||= Math.hypot(event.clientX - press.x, event.clientY - press.y) > 4;
    if (!press.moved) return;
    if (press.line || view.z <= 1) {
      const f = frame();
      cut((event.clientX - f.left) / f.width);
    } else {
      view = {...view, x: press.from.x + event.clientX - press.x, y: press.from.y + event.clientY - press.y};
      apply();
    }
  }
});
const end = (event) => {
  fingers.delete(event.pointerId);
  const clicked = press && !press.moved && stage() && event.type === 'pointerup';
  if (clicked && inside(place(event))) trigger('click', place(event));
  if (!fingers.size) { press = null; apply(); }
};
window.addEventListener('pointerup', end);
window.addEventListener('pointercancel', end);
const hover = (event) => {
  const seen = document.querySelector('#ps-pixel')?.offsetParent;
  const at = event.target.closest?.('.ps-stage') && element.contains(event.target) ? place(event) : null;
  const next = seen && at && inside(at) && event.pointerType !== 'touch' ? at : null;
  if (!next && !waiting) return;
  waiting = next ?? {x: null, y: null};
  if (!next) { clearTimeout(hovered); hovered = 0; trigger('select', waiting); waiting = null; return; }
  hovered ||= setTimeout(() => { hovered = 0; if (waiting) trigger('select', waiting); }, 70);
};
element.addEventListener('click', (event) => tools[event.target.closest('[data-tool]')?.dataset.tool]?.());
element.addEventListener('dblclick', (event) => {
  if (event.target.closest('.ps-layer')) zoom(view.z > 1 ? 1 : one(), event);
});
element.addEventListener('keydown', (event) => {
  const arrow = {ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1]}[event.key];
  if (event.target.closest('.ps-handle') && arrow && arrow[0]) {
    cut(parseFloat(element.style.getPropertyValue('--cut') || '50') / 100 - arrow[0] * 0.02);
  } else if (event.target.closest('.ps-handle, .ps-stage') && !event.target.closest('.ps-tools')) {
    const tool = {'+': 'in', '=': 'in', '-': 'out', '0': 'fit', '1': 'one'}[event.key];
    if (tool && !event.ctrlKey && !event.metaKey) tools[tool]();
    else if (arrow && view.z > 1) { view.x += 60 * arrow[0]; view.y += 60 * arrow[1]; apply(); }
    else return;
  } else return;
  event.preventDefault();
});
const room = () => {  // the height that remains above the controls of the picture
  const parts = ['#ps-view', '#ps-strip'].map((part) => document.querySelector(part)?.offsetHeight ?? 0);
  const body = document.querySelector('#ps-body');  // where the picture is while nothing is scrolled
  const rest = innerHeight - body.getBoundingClientRect().top - scrollY - parts[0] - parts[1] - 52;
  if (innerWidth > 900) element.style.setProperty('--room', Math.max(rest, 300) + 'px');
  else element.style.removeProperty('--room');
};
const around = new ResizeObserver(() => { room(); apply(); });
for (const part of ['body', '#ps-status', '#ps-mends']) around.observe(document.querySelector(part) ?? document.body);
new ResizeObserver(() => apply()).observe(element);
watch('value', () => {
  const now = stage()?.dataset.width + stage()?.style.getPropertyValue('--ratio');
  if (stage() && now !== element.dataset.frame) { element.dataset.frame = now; view = {z: 1, x: 0, y: 0}; }
  cut(parseFloat(element.style.getPropertyValue('--cut') || '50') / 100);
  room();
  apply();
});
"""

EMPTY = """<div class="ps-nothing"><div><b>No frame yet</b>
<p>Open or drop raw frames of a polarization camera, or four images at 0, 45, 90 and 135 degrees.<br>
The demo capture shows what polsep does.</p></div></div>"""

CSS = """
.gradio-container { max-width: none !important; padding: 0 !important; overflow: clip !important; }
.gradio-container .fillable { max-width: none !important; padding: 10px 16px !important; }
footer { display: none !important; }
.gradio-container .column, .gradio-container .gap { gap: 8px; }
#ps-top { align-items: center; gap: 8px; flex-wrap: nowrap; }
#ps-title { flex: none; width: auto; min-width: 0; padding: 0 8px 0 2px; }
#ps-title b { font-size: 1.3rem; letter-spacing: -.01em; }
#ps-progress { min-width: 0; text-align: right; color: #c9c9ce; font-size: .88rem; font-variant-numeric: tabular-nums; }
#ps-status { min-height: 22px; }
#ps-mends { gap: 8px; }
#ps-mends:not(:has(button:not(.hidden):not(.hide))) { display: none; }
#ps-body { gap: 14px; }
#ps-side { flex: 0 0 360px; }
#ps-beside .tab-container button { padding: 6px 6px; font-size: .8rem; }
#ps-downloads { gap: 6px; }
#ps-fetch { position: absolute; width: 1px; height: 1px; overflow: hidden; visibility: hidden; }
.ps-line { font-size: .88rem; color: #c9c9ce; line-height: 1.5; }
.ps-line b { color: #fff; font-weight: 600; margin-right: .5em; }
.ps-line span + span::before { content: "·"; margin: 0 .55em; color: #6b6b73; }
.ps-error { border-left: 3px solid #ff6b5e; background: #35201f; color: #ffd9d5; padding: 8px 12px; font-size: .9rem; }
.ps-remark { border-left: 3px solid #e0b13c; background: #2f2a1c; color: #f3e3b5; padding: 5px 12px; margin-top: 5px;
  font-size: .84rem; }
.ps-nothing { display: grid; place-items: center; height: var(--room, max(300px, calc(100vh - 250px))); padding: 0 12px;
  border: 1px dashed #45454d; border-radius: 8px; text-align: center; color: #9a9aa2; background: #1b1b1e; }
.ps-nothing b { color: #e4e4e8; font-size: 1.05rem; }
.ps-nothing p { margin: 6px 0 0; line-height: 1.5; color: #9a9aa2 !important; }
.ps-stage { position: relative; height: var(--room, max(300px, calc(100vh - 250px))); cursor: crosshair;
  user-select: none;
  touch-action: pan-y; background: #111; overflow: hidden; border-radius: 4px; container-type: size; outline: none; }
.ps-stage:focus-visible { box-shadow: inset 0 0 0 2px #6ea8fe; }
.ps-zoomed { cursor: grab; touch-action: none; }
.ps-layer { position: absolute; inset: 0; overflow: hidden; }
.ps-layer-right { clip-path: inset(0 0 0 var(--cut, 50%)); }
.ps-over { pointer-events: none; }
.ps-world { position: absolute; aspect-ratio: var(--ratio);
  width: calc(min(100cqw, 100cqh * var(--ratio)) * var(--z, 1));
  left: calc(50% + var(--x, 0) * 1px); top: calc(50% + var(--y, 0) * 1px); transform: translate(-50%, -50%); }
.ps-stage .ps-world img { position: absolute; inset: 0; width: 100%; height: 100%; max-width: none; margin: 0;
  border-radius: 0; }
.ps-large .ps-world img { image-rendering: pixelated; }
.ps-handle { position: absolute; top: 0; bottom: 0; left: calc(var(--cut, 50%) - 14px); width: 28px; cursor: ew-resize;
  background: linear-gradient(#fff, #fff) center / 2px 100% no-repeat; outline: none; touch-action: none; }
.ps-handle::after { content: "‹ ›"; position: absolute; top: 50%; left: 50%; transform: translate(-50%, -50%);
  width: 34px; height: 34px; line-height: 31px; border-radius: 50%; background: #fffffff0; color: #222;
  text-align: center; font-weight: 600; box-shadow: 0 1px 6px #0008; }
.ps-handle:focus-visible::after { box-shadow: 0 0 0 3px #6ea8fe; }
.ps-name { position: absolute; top: 10px; padding: 2px 9px; border-radius: 4px; background: #000a; color: #fff;
  font-size: .8rem; pointer-events: none; max-width: 46%; }
.ps-name-left { left: 10px; }
.ps-name-right { right: 10px; }
.ps-tools { position: absolute; bottom: 10px; left: 50%; transform: translateX(-50%); display: flex; gap: 2px;
  align-items: center; padding: 2px; border-radius: 6px; background: #111; color: #ddd; font-size: .8rem;
  cursor: default; z-index: 1; }
.ps-tools button { min-width: 30px; height: 28px; border: 0; border-radius: 4px; background: none; color: #fff;
  font-size: .85rem; cursor: pointer; }
.ps-tools button:hover, .ps-tools button:focus-visible { background: #3b82f6; outline: none; }
.ps-tools output { min-width: 52px; text-align: right; padding-right: 8px; font-variant-numeric: tabular-nums; }
.ps-key { position: absolute; bottom: 10px; padding: 3px 8px; border-radius: 4px; background: #000b; color: #eee;
  font-size: .76rem; display: flex; gap: 6px; align-items: center; pointer-events: none; }
.ps-key:empty { display: none; }
.ps-key-left { left: 10px; }
.ps-key-right { right: 10px; }
.ps-stage img.ps-bar { width: 96px; height: 10px; margin: 0; }
.ps-wheel { position: relative; width: 72px; height: 72px; margin: 16px 30px 4px 26px; }
.ps-stage .ps-wheel img { width: 72px; height: 72px; border-radius: 50%; margin: 0; }
.ps-wheel i { position: absolute; font-style: normal; transform: translate(-50%, -50%); left: 50%; top: -9px; }
.ps-wheel i:nth-of-type(1) { left: 86px; top: 50%; }
.ps-wheel i:nth-of-type(2) { left: 76px; top: 3px; }
.ps-wheel i:nth-of-type(4) { left: -9px; top: 3px; }
.ps-mark { position: absolute; width: 15px; height: 15px; margin: -8px 0 0 -8px; border: 2px solid #fff;
  border-radius: 50%; box-shadow: 0 0 0 1.5px #000, inset 0 0 0 1px #000; pointer-events: none; }
.ps-relit { width: 100%; height: 520px; border: 0; border-radius: 6px; }
.ps-hint { color: #9a9aa2; font-size: .88rem; line-height: 1.5; }
.ps-readout, .ps-readout * { border: 0 !important; }
.ps-readout { width: 100%; border-collapse: collapse; font-size: .84rem; font-variant-numeric: tabular-nums; }
.ps-readout + .ps-readout { margin-top: 10px; border-top: 2px solid #45454d !important; }
.ps-readout tr + tr > * { border-top: 1px solid #2e2e33 !important; }
.ps-readout th { text-align: left; vertical-align: top; font-weight: 500; color: #9a9aa2; padding: 4px 12px 4px 0;
  white-space: nowrap; width: 1%; }
.ps-readout td { padding: 4px 0; color: #e4e4e8; }
.ps-cells { display: flex; flex-wrap: wrap; gap: 4px 12px; }
.ps-cells i { font-style: normal; color: #85858d; margin-right: .4em; }
.ps-clipped { color: #ff8f85; text-decoration: underline; }
.ps-histogram svg { width: 100%; height: 170px; background: #1b1b1e; border-radius: 4px; display: block; }
.ps-axis { display: flex; justify-content: space-between; color: #85858d; font-size: .78rem; margin-top: 4px; }
.ps-shares { display: flex; flex-wrap: wrap; gap: 4px 12px; font-size: .84rem; margin-top: 8px;
  font-variant-numeric: tabular-nums; }
.ps-note p { margin: 8px 0 0; font-size: .84rem; line-height: 1.45; color: #c9c9ce; }
.ps-rose svg { width: 100%; max-width: 300px; display: block; margin: 0 auto; }
.ps-rose path { fill: #7aa7ff66; stroke: #7aa7ff; stroke-width: .6; }
.ps-rose .rim { fill: none; stroke: #3a3a41; }
.ps-rose text { fill: #9a9aa2; font-size: 11px; text-anchor: middle; }
.ps-rose line { stroke-width: 2; stroke: #ffb454; }
.ps-rose line.ps-lamp { stroke: #63d471; stroke-dasharray: 5 4; }
.ps-note b { font-weight: 600; }
.ps-note b.ps-found { color: #ffb454; }
.ps-note b.ps-lamp { color: #63d471; }
.ps-swatch { display: inline-block; width: 14px; height: 14px; margin: 0 6px -2px 0; border-radius: 3px; }
#ps-edits { gap: 4px; }
#ps-view { gap: 8px; }
.gradio-container input[role=combobox] { padding-right: 22px; text-overflow: ellipsis; }
#ps-marks { padding: 8px 12px; }
@media (min-width: 901px) {  /* the picture stays where it is while a long panel is scrolled */
  #ps-main { position: sticky; top: 8px; align-self: flex-start; }
}
@media (max-width: 900px) {
  #ps-top { flex-wrap: wrap; }
  #ps-demo { min-width: 116px !important; }
  #ps-progress { flex: 1 1 200px; }
  #ps-top #ps-progress:not(:has([role=status])) { display: none; }
  .gradio-container .fillable { padding: 8px 10px !important; }
  #ps-side { flex: 1 1 100%; }
  #ps-against { min-width: 100% !important; }
  .ps-stage { height: min(calc(92vw / var(--ratio, 1.2)), 56vh); min-height: 220px; }
  .ps-nothing { height: 38vh; }
  .ps-tools { bottom: 6px; }
  .ps-tools button { min-width: 40px; height: 34px; }
  .ps-tools [data-tool=in], .ps-tools [data-tool=out] { display: none; }
}
"""
