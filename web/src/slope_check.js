// Is light from inside a body polarized along the slope of its shading? Frames that were transposed or turned by 180
// degrees show it across: twin of polsep/sensor/slope_check.py, where the law and every constant are explained.

import { filterAt, mirroredAcross, mirroredDown, specOf } from "./layout.js";
import { CLIP_MARGIN } from "./levels.js";
import { mean } from "./numbers.js";

const BLOCK = 4, SIDE = 1024, SIZES = 3, BACKGROUND = 0.05, SPECULAR = 0.3, MIN_SPECULAR = 0.012, MIN_AGREEMENT = 0.1, CERTAIN = 3.5;

/** {text, layout} of a colour frame whose AoLP is 90 degrees off, beyond doubt; else null. */
export function checkSlopes(mosaic) {
  const { layout, height, width } = mosaic, [top, left] = layout.origin, sides = [height - top, width - left];
  const side = BLOCK * Math.ceil(Math.max(...sides) / SIDE), most = 1 << (SIZES - 1);
  if (!layout.bayer || Math.min(...sides) < 4 * most * side) return null;
  const own = { ...layout, origin: [0, 0] }, levels = [blockMeans(mosaic, side, most)];
  for (let k = 1; k < SIZES; k++) levels.push(halve(levels[k - 1]));
  for (let k = SIZES - 1; k >= 0; k--) {
    const [agreement, certainty] = agreementOf(levels[k], own, side << k);
    if (agreement > -MIN_AGREEMENT || certainty > -CERTAIN) return null;
  }
  const { total, polarized } = fitColors(levels[0].means, own), average = mean(total);
  const lit = total.map((v, b) => [v, polarized[b]]).filter(([v]) => v > BACKGROUND * average);
  if (!(lit.filter(([v, p]) => p > SPECULAR * v).length > MIN_SPECULAR * lit.length)) return null;
  const turned = { ...layout, polarizer: layout.polarizer.map((angle) => (angle + 90) % 180) };
  const around = mirroredDown(mirroredAcross(layout, 4), 4);
  return {
    text: `surfaces are polarized across their slopes under layout ${specOf(layout)}: say layout ${specOf(turned)} ` +
      `(transposed, the likeliest; if turned by 180 degrees, ${specOf(around)})`,
    layout: specOf(turned),
  };
}

/** Means [16][blocks] of each pixel of the period over blocks, of whose rows the first four count; `usable`: unclipped. */
function blockMeans({ data, height, width, layout, black, white }, side, most) {
  const [top, left] = layout.origin, rows = Math.floor((height - top) / (side * most)) * most;
  const cols = Math.floor((width - left) / (side * most)) * most, full = black + (1 - CLIP_MARGIN) * (white - black);
  const means = Array.from({ length: 16 }, () => new Array(rows * cols).fill(0)), usable = new Array(rows * cols).fill(true);
  for (let r = 0, b = 0; r < rows; r++)
    for (let c = 0; c < cols; c++, b++)
      for (let y = 0; y < 4; y++)
        for (let x = 0, at = (top + r * side + y) * width + left + c * side; x < side; x++, at++) {
          means[4 * y + (x & 3)][b] += ((data[at] - black) * 4) / (side * (white - black));
          if (data[at] >= full) usable[b] = false;
        }
  return { means, usable, rows, cols };
}

/** The same for blocks of twice the side. */
function halve({ means, usable, rows, cols }) {
  const h = rows >> 1, w = cols >> 1, four = (b) => { const at = 2 * Math.floor(b / w) * cols + 2 * (b % w); return [at, at + 1, at + cols, at + cols + 1]; };
  const blocks = Array.from({ length: h * w }, (_, b) => four(b));
  return { rows: h, cols: w, means: means.map((own) => blocks.map((at) => mean(at.map((k) => own[k])))),
    usable: blocks.map((at) => at.every((k) => usable[k])) };
}

/** s0 and p = s1 + i s2 of the three colours, and their means over the colours. */
function fitColors(means, layout) {
  const count = means[0].length, empty = () => [0, 1, 2].map(() => new Float64Array(count)), [s0, x, y] = [empty(), empty(), empty()];
  means.forEach((own, k) => {
    const [angle, c] = filterAt(layout, k >> 2, k & 3), share = c === 1 ? 8 : 4, turn = (angle * Math.PI) / 90;
    own.forEach((value, b) => {
      s0[c][b] += (2 * value) / share;
      x[c][b] += (4 * value * Math.cos(turn)) / share;
      y[c][b] += (4 * value * Math.sin(turn)) / share;
    });
  });
  const middle = (image) => Array.from({ length: count }, (_, b) => (image[0][b] + image[1][b] + image[2][b]) / 3);
  const [total, px, py] = [s0, x, y].map(middle);
  return { s0, x, y, total, px, py, polarized: px.map((v, b) => Math.hypot(v, py[b])) };
}

/** Agreement of AoLP and slope over all blocks, in [-1, 1], and over its spread. */
function agreementOf({ means, usable, rows, cols }, layout, side) {
  const count = rows * cols, brightness = Array.from({ length: count }, (_, b) => mean(means.map((own) => own[b])));
  const average = Math.max(mean(brightness), 1e-9), ratio = means.map((own) => mean(own) / average);
  const slope = (b, at, n, step) => at === 0 ? brightness[b + step] - brightness[b] : at === n - 1 ? brightness[b] - brightness[b - step]
    : (brightness[b + step] - brightness[b - step]) / 2;
  const down = brightness.map((_, b) => slope(b, Math.floor(b / cols), rows, cols)), right = brightness.map((_, b) => slope(b, b % cols, cols, 1));
  const moved = means.map((own, k) => own.map((value, b) => value - (ratio[k] * (((k >> 2) - 1.5) * down[b] + ((k & 3) - 1.5) * right[b])) / side));
  const { s0, x, y, total, px, py, polarized } = fitColors(moved, layout);
  let whole = 0, size = 0, square = 0;
  for (let b = 0; b < count; b++) {
    if (!usable[b] || !(brightness[b] > BACKGROUND * average) || !(polarized[b] < SPECULAR * total[b])) continue;
    let contrast = 0, re = 0, im = 0;
    for (let c = 0; c < 3; c++) {
      const d = s0[c][b] - total[b];
      contrast += d * d;
      re += d * (x[c][b] - px[b]);
      im += d * (y[c][b] - py[b]);
    }
    if (!(contrast > 0)) continue;
    const steep = Math.hypot(down[b], right[b]), scale = Math.max(steep, 1e-12) ** 2;  // conjugate: rows grow down, angles up
    const cosine = (right[b] ** 2 - down[b] ** 2) / scale, sine = (2 * right[b] * down[b]) / scale;
    const along = ((re * cosine - im * sine) / Math.max(Math.sqrt(contrast), 1e-9)) * Math.min(steep / Math.max(brightness[b], 0.1 * average), 1);
    whole += along;
    size += Math.abs(along);
    square += along * along;
  }
  return [whole / Math.max(size, 1e-12), whole / Math.max(Math.sqrt(square), 1e-12)];
}
