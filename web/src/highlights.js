// Diffuse light under clipped highlights, from the diffuse light around them: twin of
// polsep/separation/under_highlights.py, which explains the method and its constants. Images are in white light.

import { linearSamples } from "./analytic.js";
import { filterAt } from "./layout.js";
import { clipLevel } from "./levels.js";
import { solve } from "./numbers.js";

const RING = 3, CONTRASTS = [0.3, 0.5], SURPRISE = 1.4, TEXTURE = 2, MAX_TEXTURE = 0.3, MAX_NOISE = 0.01;
const MAX_HOLE = 4000, MIN_RING = 6, MAX_CLIPPED = 0.05, TOLERANCE = 1e-4, STEPS = 200;
/** Neighbours that are not pixels of holes: other pixels, and none. */
const OUTSIDE = -1, BEYOND = -2;

/** Fill the holes of the diffuse image, and lower the expected error there; the share of its pixels that was filled. */
export function fillUnderHighlights(images, mosaic, light) {
  const { diffuse, error, colors, height, width } = images, clipped = clippedCells(mosaic, height, width);
  if (!clipped.length || clipped.length > MAX_CLIPPED * height * width) return 0;
  const holes = findHoles(clipped, height, width), number = numbersOf(holes.flat(), height * width);
  const contrast = contrastOf(mosaic, light, width), chosen = [];
  for (const flat of holes) {
    const fit = fitPlane(flat, number, images);
    const sure = fit && Math.min(Math.max((contrast(flat, fit.plane, colors) - CONTRASTS[0]) / (CONTRASTS[1] - CONTRASTS[0]), 0), 1);
    if (sure > 0) chosen.push({ flat, sure, ...fit });
  }
  if (!chosen.length) return 0;
  const fill = solveLaplace(chosen, images);
  let filled = 0, at = 0;
  for (const { flat, sure, texture } of chosen) {
    let guessed = 0, apart = 0;
    flat.forEach((k, i) => {
      guessed += (SURPRISE * error[2 * k]) ** 2 / flat.length;
      for (let c = 0; c < colors; c++) apart += (fill[(at + i) * colors + c] - diffuse[k * colors + c]) ** 2 / (colors * flat.length);
    });
    const weights = texture.map((own) => (sure * guessed) / Math.max(guessed + Math.max((TEXTURE * own) ** 2, apart - guessed), 1e-12));
    const weight = weights.reduce((a, b) => a + b) / colors;
    flat.forEach((k, i) => {
      for (let c = 0; c < colors; c++) diffuse[k * colors + c] += weights[c] * (fill[(at + i) * colors + c] - diffuse[k * colors + c]);
      error[2 * k] *= Math.sqrt(1 - weight);
    });
    filled += weight * flat.length;
    at += flat.length;
  }
  return filled / (height * width);
}

/** The cells with a clipped sample, as places of a half-resolution image. */
function clippedCells(mosaic, height, width) {
  const { data, layout } = mosaic, [top, left] = layout.origin, full = clipLevel(mosaic), found = [];
  for (let i = 0; i < height; i++)
    for (let j = 0; j < width; j++) {
      const at = (top + 2 * i) * mosaic.width + left + 2 * j, below = at + mosaic.width;
      if (data[at] >= full || data[at + 1] >= full || data[below] >= full || data[below + 1] >= full) found.push(i * width + j);
    }
  return found;
}

/** Call with the places from `r - reach` to `r + reach` and as many columns inside of an image. */
function around(place, reach, height, width, use) {
  const r = Math.floor(place / width), c = place % width;
  for (let i = Math.max(r - reach, 0); i <= Math.min(r + reach, height - 1); i++)
    for (let j = Math.max(c - reach, 0); j <= Math.min(c + reach, width - 1); j++) use(i * width + j);
}

/** Connected pixels, also over corners, of what clipped cells spoil: the cells next to them. */
function findHoles(clipped, height, width) {
  const open = new Set(), holes = [];
  for (const cell of clipped) around(cell, 1, height, width, (k) => open.add(k));
  for (const first of open) {
    open.delete(first);
    const hole = [first];
    for (let i = 0; i < hole.length; i++) around(hole[i], 1, height, width, (k) => open.delete(k) && hole.push(k));
    holes.push(hole.sort((a, b) => a - b));
  }
  return holes;
}

function numbersOf(flat, count) {
  const number = new Int32Array(count).fill(OUTSIDE);
  flat.forEach((k, i) => (number[k] = i));
  return number;
}

/** The numbers of a pixel's neighbours at the right, left, below and above. */
function neighbors(number, k, height, width) {
  const c = k % width;
  return [c < width - 1 ? number[k + 1] : BEYOND, c > 0 ? number[k - 1] : BEYOND,
    k + width < height * width ? number[k + width] : BEYOND, k >= width ? number[k - width] : BEYOND];
}

/** The plane through a hole's ring: its values in the hole and the rms of the ring from it; null where none may be. */
function fitPlane(flat, number, { diffuse, colors, height, width }) {
  const ring = new Set();
  for (const k of flat)
    if (neighbors(number, k, height, width).some((other) => other < 0))
      around(k, RING, height, width, (near) => number[near] < 0 && ring.add(near));
  if (ring.size < MIN_RING || flat.length > MAX_HOLE) return null;
  const places = [...ring], mean = (f) => places.reduce((total, k) => total + f(k), 0) / places.length;
  const row = mean((k) => Math.floor(k / width)), col = mean((k) => k % width);
  const shape = (k) => [1, (Math.floor(k / width) - row) / RING, ((k % width) - col) / RING];
  const products = [0, 1, 2].map((i) => [0, 1, 2].map((j) => places.reduce((total, k) => total + shape(k)[i] * shape(k)[j], 0)));
  const det = products[1][1] * products[2][2] - products[1][2] ** 2, flatRing = det < 1e-9 * places.length ** 2;
  const factors = Array.from({ length: colors }, (_, c) => {
    const right = [0, 1, 2].map((i) => places.reduce((total, k) => total + shape(k)[i] * diffuse[k * colors + c], 0));
    return flatRing ? [right[0] / places.length, 0, 0] : solve(products.map((own) => [...own]), right);
  });
  const value = (k, c) => shape(k).reduce((total, own, i) => total + own * factors[c][i], 0);
  const texture = factors.map((_, c) => Math.sqrt(mean((k) => (diffuse[k * colors + c] - value(k, c)) ** 2)));
  const light = mean((k) => factors.reduce((total, _, c) => total + diffuse[k * colors + c] / colors, 0));
  const rest = Math.sqrt(texture.reduce((total, own) => total + own * own, 0) / colors);
  if (rest > MAX_TEXTURE * light + MAX_NOISE) return null;
  return { texture, plane: flat.flatMap((k) => factors.map((_, c) => value(k, c))) };
}

/** Polarized share of what a hole has beyond a fill: (most - least) / (most + least - fill) of its cells' samples. */
function contrastOf(mosaic, light, width) {
  const { layout } = mosaic, [top, left] = layout.origin, samples = linearSamples(mosaic, light);
  return (flat, plane, colors) => {
    let apart = 0, beyond = 0;
    flat.forEach((k, i) => {
      const y = top + 2 * Math.floor(k / width), x = left + 2 * (k % width), at = y * mosaic.width + x, below = at + mosaic.width;
      const own = [samples[at], samples[at + 1], samples[below], samples[below + 1]], most = Math.max(...own), least = Math.min(...own);
      apart += most - least;
      beyond += Math.max(most + least - plane[i * colors + filterAt(layout, y, x)[1]], 0);
    });
    return apart / Math.max(beyond, 1e-9);
  };
}

/** Values of the holes' pixels, each the mean of its four neighbours: by conjugate gradients, from the planes on. */
function solveLaplace(chosen, { diffuse, colors, height, width }) {
  const flat = chosen.flatMap((hole) => hole.flat), x = Float64Array.from(chosen.flatMap(({ plane }) => plane)), n = x.length;
  const number = numbersOf(flat, height * width), right = new Float64Array(n), steps = [1, -1, width, -width];
  const links = flat.map((k) => neighbors(number, k, height, width));
  links.forEach((own, i) => own.forEach((other, side) => {
    if (other === OUTSIDE) for (let c = 0; c < colors; c++) right[i * colors + c] += diffuse[(flat[i] + steps[side]) * colors + c];
  }));
  const counts = links.map((own) => own.filter((other) => other !== BEYOND).length), inner = links.map((own) => own.filter((other) => other >= 0));
  const apply = (v) => {
    const out = new Float64Array(n);
    for (let i = 0; i < flat.length; i++)
      for (let c = 0; c < colors; c++) {
        let total = counts[i] * v[i * colors + c];
        for (const other of inner[i]) total -= v[other * colors + c];
        out[i * colors + c] = total;
      }
    return out;
  };
  const dot = (a, b) => a.reduce((total, own, k) => total + own * b[k], 0);
  const first = apply(x), rest = right.map((own, k) => own - first[k]), step = rest.slice();
  let power = dot(rest, rest);
  for (let round = 0; round < STEPS && rest.some((own) => Math.abs(own) > TOLERANCE); round++) {
    const moved = apply(step), length = power / Math.max(dot(step, moved), 1e-30), before = power;
    for (let k = 0; k < n; k++) {
      x[k] += length * step[k];
      rest[k] -= length * moved[k];
    }
    power = dot(rest, rest);
    for (let k = 0; k < n; k++) step[k] = rest[k] + (power / before) * step[k];
  }
  return x.map((own) => Math.max(own, 0));
}
