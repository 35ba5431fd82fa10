"""Style and scripts of the page: plain text for Gradio.

Fonts are the system's, and nothing is fetched from elsewhere. The picture is on neutral grey, because colours around
it change its appearance.
"""

from __future__ import annotations

FONTS = ["system-ui", "Segoe UI", "Roboto", "Helvetica Neue", "sans-serif"]
MONOSPACE = ["ui-monospace", "Menlo", "Consolas", "monospace"]

#: Always the dark theme, for pictures; Gradio would follow the system.
ON_LOAD = """() => {
  const keep = () => document.body.classList.contains('dark') || document.body.classList.add('dark');
  new MutationObserver(keep).observe(document.body, {attributes: true, attributeFilter: ['class']});
  keep();
}"""

#: Download the target of the hidden link, after the file was written.
FETCH = "() => { const link = document.querySelector('#ps-fetch'); (link.querySelector('a') ?? link).click(); }"

#: A drag moves the line between the two pictures, a click names the pixel under it.
STAGE = """
let press = null;
const box = () => element.querySelector('.ps-stage');
const cut = (share) => {
  const percent = Math.round(1000 * Math.min(Math.max(share, 0), 1)) / 10;
  element.style.setProperty('--cut', percent + '%');
  element.querySelector('.ps-handle')?.setAttribute('aria-valuenow', percent);
};
const place = (event) => {
  const frame = box().getBoundingClientRect();
  return [(event.clientX - frame.left) / frame.width, (event.clientY - frame.top) / frame.height];
};
element.addEventListener('pointerdown', (event) => {
  if (event.button !== 0 || !event.target.closest('.ps-stage')) return;
  event.preventDefault();
  press = {x: event.clientX, y: event.clientY, moved: event.target.closest('.ps-handle') !== null};
  if (press.moved) event.target.focus();
});
window.addEventListener('pointermove', (event) => {
  if (!press || !box()) return;
  press.moved ||= Math.hypot(event.clientX - press.x, event.clientY - press.y) > 4;
  if (press.moved) cut(place(event)[0]);
});
window.addEventListener('pointerup', (event) => {
  if (press && !press.moved && box()) {
    const [x, y] = place(event);
    trigger('click', {x, y});
  }
  press = null;
});
element.addEventListener('keydown', (event) => {
  const step = {ArrowLeft: -0.02, ArrowRight: 0.02}[event.key];
  if (!step || !event.target.closest('.ps-handle')) return;
  event.preventDefault();
  cut((parseFloat(element.style.getPropertyValue('--cut') || '50') / 100) + step);
});
"""

EMPTY = (
    '<div class="ps-nothing"><div><b>No frame yet</b><p>Drop a raw frame of a polarization camera at the left,<br>'
    "or open the demo capture to see what polsep does.</p></div></div>"
)

CSS = """
.gradio-container { max-width: none !important; padding: 0 !important; }
.gradio-container .fillable { max-width: none !important; padding: 14px 20px !important; }
footer { display: none !important; }
#ps-title { padding: 2px 2px 0; }
#ps-title b { font-size: 1.35rem; letter-spacing: -.01em; }
#ps-title p { margin: 2px 0 0; color: #9a9aa2; font-size: .85rem; line-height: 1.35; }
#ps-side { gap: 10px; }
#ps-main { gap: 10px; }
#ps-file { min-height: 150px; }
#ps-file .icon-wrap { display: none; }
#ps-file .or { margin: 0; }
#ps-edits { max-height: calc(100vh - 330px); min-height: 320px; overflow-y: auto; flex-wrap: nowrap; gap: 8px; }
#ps-edits > * { flex: none; }
#ps-edits .html-container { padding: 0 !important; }
.ps-edit { display: block; padding: 7px 12px; font-size: .88rem; }
#ps-edits .block { padding: 6px 12px 8px; border: 0 !important; }
#ps-fetch { position: absolute; width: 1px; height: 1px; overflow: hidden; opacity: 0; pointer-events: none; }
#ps-status { min-height: 26px; }
.ps-line { font-size: .88rem; color: #c9c9ce; line-height: 1.5; }
.ps-line b { color: #fff; font-weight: 600; margin-right: .5em; }
.ps-line span + span::before { content: "·"; margin: 0 .55em; color: #6b6b73; }
.ps-error { border-left: 3px solid #ff6b5e; background: #35201f; color: #ffd9d5; padding: 8px 12px; font-size: .9rem; }
.ps-remark { border-left: 3px solid #e0b13c; background: #2f2a1c; color: #f3e3b5; padding: 6px 12px; margin-top: 6px;
  font-size: .84rem; }
.ps-nothing { display: grid; place-items: center; height: min(60vh, 620px); border: 1px dashed #45454d;
  border-radius: 8px; text-align: center; color: #9a9aa2; background: #1b1b1e; }
.ps-nothing b { color: #e4e4e8; font-size: 1.05rem; }
.ps-nothing p { margin: 6px 0 0; line-height: 1.5; color: #9a9aa2 !important; }
.ps-stage { position: relative; aspect-ratio: var(--ratio); width: min(100%, calc((100vh - 255px) * var(--ratio)));
  min-width: min(100%, 420px); margin: 0 auto; cursor: crosshair; user-select: none; touch-action: none;
  background: #111; overflow: hidden; border-radius: 4px; }
.ps-stage img { position: absolute; inset: 0; width: 100%; height: 100%; margin: 0; border-radius: 0; }
.ps-stage .ps-right { clip-path: inset(0 0 0 var(--cut, 50%)); }
.ps-handle { position: absolute; top: 0; bottom: 0; left: calc(var(--cut, 50%) - 14px); width: 28px; cursor: ew-resize;
  background: linear-gradient(#fff, #fff) center / 2px 100% no-repeat; outline: none; }
.ps-handle::after { content: "‹ ›"; position: absolute; top: 50%; left: 50%; transform: translate(-50%, -50%);
  width: 34px; height: 34px; line-height: 31px; border-radius: 50%; background: #fffffff0; color: #222;
  text-align: center; font-weight: 600; box-shadow: 0 1px 6px #0008; }
.ps-handle:focus-visible::after { box-shadow: 0 0 0 3px #6ea8fe; }
.ps-name { position: absolute; top: 10px; padding: 2px 9px; border-radius: 4px; background: #000a; color: #fff;
  font-size: .8rem; pointer-events: none; }
.ps-name-left { left: 10px; }
.ps-name-right { right: 10px; }
.ps-mark { position: absolute; width: 15px; height: 15px; margin: -8px 0 0 -8px; border: 2px solid #fff;
  border-radius: 50%; box-shadow: 0 0 0 1.5px #000, inset 0 0 0 1px #000; pointer-events: none; }
.ps-hint, .ps-empty { color: #9a9aa2; font-size: .88rem; line-height: 1.5; }
.ps-readout, .ps-readout * { border: 0 !important; }
.ps-readout { width: 100%; border-collapse: collapse; font-size: .84rem; font-variant-numeric: tabular-nums; }
.ps-readout tr + tr > * { border-top: 1px solid #2e2e33 !important; }
.ps-readout th { text-align: left; vertical-align: top; font-weight: 500; color: #9a9aa2; padding: 4px 14px 4px 0;
  white-space: nowrap; width: 1%; }
.ps-readout td { padding: 4px 0; color: #e4e4e8; }
.ps-cells { display: flex; flex-wrap: wrap; gap: 4px 16px; }
.ps-cells i { font-style: normal; color: #85858d; margin-right: .4em; }
.ps-clipped { color: #ff8f85; text-decoration: underline; }
.ps-pair { display: grid; grid-template-columns: 1fr 1fr; gap: 18px; }
.ps-pair figure { margin: 0; }
.ps-pair figcaption { font-size: .85rem; color: #c9c9ce; margin-bottom: 6px; }
.ps-pair figure > img { width: 100%; height: auto; border-radius: 4px; display: block; }
.ps-legend { margin-top: 14px; color: #9a9aa2; font-size: .8rem; line-height: 1.5; display: flex; align-items: center;
  gap: 52px; }
.ps-legend p { margin: 0; }
.ps-scale { width: 100%; }
.ps-scale img { width: 100%; height: 14px; display: block; border-radius: 2px; }
.ps-scale div { display: flex; justify-content: space-between; margin-top: 4px; }
.ps-wheel { position: relative; width: 96px; height: 96px; margin: 18px 0 6px 44px; flex: none; }
.ps-wheel img { width: 96px; height: 96px; border-radius: 50%; display: block; }
.ps-wheel i { position: absolute; font-style: normal; transform: translate(-50%, -50%); }
.ps-wheel i:first-of-type { transform: translate(4px, -50%); }
.ps-wheel i:nth-of-type(2) { transform: translate(2px, -80%); }
.ps-wheel i:nth-of-type(4) { transform: translate(-100%, -80%); }
.ps-histogram svg { width: 100%; height: 240px; background: #1b1b1e; border-radius: 4px; display: block; }
.ps-axis { display: flex; justify-content: space-between; color: #85858d; font-size: .78rem; margin-top: 5px; }
.ps-shares { display: flex; gap: 18px; font-size: .86rem; margin-top: 10px; font-variant-numeric: tabular-nums; }
@media (max-width: 900px) { .ps-pair { grid-template-columns: 1fr; } }
"""
