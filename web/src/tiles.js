// Second moments of Stokes samples over small tiles of a frame: twin of polsep/light/tiles.py.

import { stokesInverse } from "./analytic.js";
import { anglesOf, channelsOf, tableOf } from "./layout.js";

const MIN_POINTS = 12, BLUR = 4, EVERY_POINT = 256, LARGEST = 0.96, DARKEST = 0.004;
const PHOTONS = 2e-5, FLOOR = 5e-8, GAIN_ERROR = 0.005;

/** Weights of the samples one period before, at and one after a period, of the filter at an offset in it. */
function taps(offset) {
  const shift = 1.5 - offset, spread = (BLUR + shift * shift) / 16, lean = shift / 4;
  return [(spread - lean) / 2, 1 - spread, (spread + lean) / 2];
}

/** The combination of four analysers that is 0 for all light; of 0, 45, 90, 135: (1, -1, 1, -1) / 2. */
function contradiction(degrees) {
  const rows = degrees.map((t) => [1, Math.cos((t * Math.PI) / 90), Math.sin((t * Math.PI) / 90)]);
  const det = ([a, b, c]) => a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0]);
  const found = rows.map((_, k) => (k % 2 ? -1 : 1) * det(rows.filter((_, other) => other !== k)));
  const length = Math.hypot(...found) * Math.sign(found[0] || 1);
  return found.map((value) => value / length);
}

/**
 * Tiles of 8x8 points: {moments: Float64Array [n x n] of the vector (1, s0, s1, s2 of all colours), noise [C], count,
 * row, col}. Points near clipped samples and in the dark are left out.
 */
export function tilesOf({ data, height, width, layout, black, white }) {
  const rows = height >> 2, cols = width >> 2, colors = channelsOf(layout), size = 1 + 3 * colors;
  const step = Math.max(rows, cols) <= EVERY_POINT ? 1 : 2, matrix = [...stokesInverse(anglesOf(layout)), contradiction(anglesOf(layout))];
  const table = tableOf(layout), filters = table.map(([angle, channel], k) => {
    const same = table.filter(([a, c]) => a === angle && c === channel).length;
    return { row: k >> 2, col: k & 3, channel, down: taps(k >> 2), across: taps(k & 3),
      part: matrix.map((own) => own[anglesOf(layout).indexOf(angle)] / same) };
  });
  const peaks = new Float32Array(rows * cols).fill(-Infinity), scale = 1 / (white - black);
  for (let y = 0; y < 4 * rows; y++)
    for (let x = 0, at = y * width; x < 4 * cols; x++, at++) {
      const k = (y >> 2) * cols + (x >> 2), value = (data[at] - black) * scale;
      if (value > peaks[k]) peaks[k] = value;
    }
  const tiles = new Map(), stokes = new Float64Array(4 * colors), v = new Float64Array(size);
  for (let i = 0, r = 0; r < rows - 2; i++, r += step)
    for (let j = 0, c = 0; c < cols - 2; j++, c += step) {
      let near = -Infinity;
      for (let a = r; a < r + 3; a++) for (let b = c; b < c + 3; b++) near = Math.max(near, peaks[a * cols + b]);
      if (!(near < LARGEST)) continue;
      stokes.fill(0);
      for (const { row, col, channel, down, across, part } of filters) {
        let value = 0;
        for (let a = 0; a < 3; a++) {
          const at = (4 * (r + a) + row) * width + 4 * c + col;
          value += down[a] * (across[0] * data[at] + across[1] * data[at + 4] + across[2] * data[at + 8]);
        }
        value = (value - black) * scale;
        for (let kind = 0; kind < 4; kind++) stokes[kind * colors + channel] += part[kind] * value;
      }
      let brightness = 0;
      for (let k = 0; k < colors; k++) brightness += stokes[k] / colors;
      if (!(brightness > DARKEST)) continue;
      const key = (i >> 3) * 4096 + (j >> 3);
      if (!tiles.has(key))
        tiles.set(key, { moments: new Float64Array(size * size), noise: new Float64Array(colors), count: 0, row: i >> 3, col: j >> 3 });
      const tile = tiles.get(key), weight = 1 / (PHOTONS * brightness + FLOOR + (GAIN_ERROR * brightness) ** 2);
      v[0] = 1;
      for (let k = 0; k < 3 * colors; k++) v[k + 1] = stokes[k];
      for (let a = 0; a < size; a++) for (let b = 0; b < size; b++) tile.moments[a * size + b] += weight * v[a] * v[b];
      for (let k = 0; k < colors; k++) tile.noise[k] += weight * stokes[3 * colors + k] ** 2;
      tile.count++;
    }
  const kept = [...tiles.entries()].sort((a, b) => a[0] - b[0]).map(([, tile]) => tile).filter(({ count }) => count >= MIN_POINTS);
  for (const { moments, noise, count } of kept) {
    const excess = Math.max(1, noise.reduce((a, b) => a + b) / colors / count);
    moments.forEach((value, k) => (moments[k] = value / excess));
    noise.forEach((value, k) => (noise[k] = value / excess));
  }
  return kept;
}
