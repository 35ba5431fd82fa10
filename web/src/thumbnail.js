// A thumbnail of a whole frame, by which the network knows what is common to it: twin of whole_frame_kernel.py and
// thumbnails.py in polsep/networks.

import { channelsOf, SONY, SONY_MONO, tableOf } from "./layout.js";

/** Cells of a thumbnail along each side; brightness that is added before it is divided by. */
export const SIDE = 64;
const MIN_BRIGHTNESS = 0.01;
/** Stokes component that an analyser counts to, and its sign, by its angle in degrees. */
const PARTS = { 0: [1, 1], 90: [1, -1], 45: [2, 1], 135: [2, -1] };

/**
 * [5 C + 2, SIDE, SIDE] of a frame of `samples` whose rows and columns in Sony's order start at `places`: means of s0,
 * s1, s2 of every colour, maxima of s0 and of the polarized light, all over the mean brightness by asinh; the share of
 * clipped samples and the logarithm of the brightness. `clips(place)`: whether a sample clips.
 */
export function thumbnailOf(layout, places, samples, clips) {
  const colors = channelsOf(layout), packed = packedStokes(colors, places, samples, clips);
  const area = SIDE * SIDE, out = new Float32Array((5 * colors + 2) * area);
  packed.planes.forEach((plane, k) => pool(plane, packed, out.subarray((k < 3 * colors ? k : 5 * colors) * area), meanOf));
  for (let c = 0; c < colors; c++) {
    const [s0, s1, s2] = [0, 1, 2].map((part) => packed.planes[part * colors + c]);
    pool(s0, packed, out.subarray((3 * colors + c) * area), largestOf);
    pool(s1.map((value, k) => Math.sqrt(value * value + s2[k] * s2[k])), packed, out.subarray((4 * colors + c) * area), largestOf);
  }
  const mean = out.subarray(0, colors * area).reduce((sum, value) => sum + value, 0) / (colors * area);
  const brightness = Math.max(mean, 0) + MIN_BRIGHTNESS;
  for (let k = 0; k < 5 * colors * area; k++) out[k] = Math.asinh(out[k] / brightness);
  return out.fill(Math.log(brightness), (5 * colors + 1) * area);
}

/** s0, s1, s2 of every colour of 4x4 samples, as means over the cells of a colour, and the share of clipped samples. */
function packedStokes(colors, { rows, cols }, samples, clips) {
  const height = rows.length / 4, width = cols.length / 4, table = tableOf(colors === 3 ? SONY : SONY_MONO);
  const planes = Array.from({ length: 3 * colors + 1 }, () => new Float32Array(height * width));
  table.forEach(([angle, color], k) => {
    const share = 4 / table.filter((other) => other[1] === color).length, [part, sign] = PARTS[angle];
    const s0 = planes[color], signed = planes[part * colors + color], clipped = planes[3 * colors];
    for (let u = 0, at = 0; u < height; u++)
      for (let v = 0; v < width; v++, at++) {
        const place = rows[4 * u + (k >> 2)] + cols[4 * v + (k & 3)], value = samples[place] * share;
        s0[at] += value / 2;
        signed[at] += sign * value;
        clipped[at] += clips(place) / 16;
      }
  });
  return { planes, height, width };
}

/** Fill an image [SIDE, SIDE] with what `take` makes of parts of a plane, which meet or overlap by one. */
function pool(plane, { height, width }, out, take) {
  const first = (k, length) => Math.floor((k * length) / SIDE), end = (k, length) => Math.ceil(((k + 1) * length) / SIDE);
  for (let i = 0; i < SIDE; i++)
    for (let j = 0; j < SIDE; j++)
      out[i * SIDE + j] = take(plane, width, [first(i, height), end(i, height)], [first(j, width), end(j, width)]);
}

function meanOf(plane, width, [top, bottom], [left, right]) {
  let sum = 0;
  for (let r = top; r < bottom; r++) for (let c = left; c < right; c++) sum += plane[r * width + c];
  return sum / ((bottom - top) * (right - left));
}

function largestOf(plane, width, [top, bottom], [left, right]) {
  let largest = -Infinity;
  for (let r = top; r < bottom; r++) for (let c = left; c < right; c++) largest = Math.max(largest, plane[r * width + c]);
  return largest;
}
