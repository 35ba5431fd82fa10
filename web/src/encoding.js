// Samples that are no longer linear light: gamma curves and JPEG. Twin of polsep/sensor/encoding.py, which explains it.

import { saturatesEarly } from "./levels.js";
import { crossedPairs, seePhases } from "./layout_check.js";
import { median, quantile } from "./numbers.js";
import { smoothBlocks } from "./noise.js";

const MIN_SPAN = 100, USUAL_CODES = 4095;
const MIN_SLOPE = -2, MAX_SLOPE = -0.55, MIN_ERRORS = 2.5, MAX_EXPONENT = 0.3, BINS = 12, MIN_BLOCKS = 32, MIN_LEVEL = 0.02;
const MIN_RANGE = 0.25, MAX_DOLP = 0.9, MIN_DOLP = 0.05, MIN_CELLS = 64, MIN_SIDE = 64, SIDE = 8, BLOCKS = 8192, MAX_RATIO = 0.87;

/** A line on samples that are gamma-encoded or were JPEG files, or null. */
export function encodingWarning(mosaic, phases = seePhases(mosaic)) {
  const slope = gammaSlope(mosaic, phases), bent = slope !== null && MIN_SLOPE < slope && slope < MAX_SLOPE;
  const early = bent && saturatesEarly(mosaic.data, mosaic.black, mosaic.white);  // contradicts the analysers, too
  const rise = bent && !early ? noiseExponent(mosaic) : null;
  if (rise !== null && rise < MAX_EXPONENT)
    return "the samples are gamma-encoded, as analysers and noise show: linear ones were expected; record with gamma off (1), " +
      "or decode the frame first";
  const ratio = mosaic.white === 255 ? blockRatio(mosaic) : null;
  if (ratio !== null && ratio < MAX_RATIO)
    return "the samples were JPEG-compressed (blocks of 8x8 pixels): raw ones were expected; record PNG, TIFF or raw, " +
      "compression costs up to 3 dB";
  return null;
}

/** Slope of the analysers' contradiction, (g - 1) / g for samples encoded by m^g; null where light shows none. */
function gammaSlope({ layout, height, width }, phases) {
  const order = { diagonals: [0, 3, 1, 2], rows: [0, 1, 2, 3], columns: [0, 2, 1, 3] }[crossedPairs(layout)];
  if (!order || Math.min(height, width) < MIN_SIDE) return null;
  const [top, left] = layout.origin, pairs = [];
  for (let cell = 0; cell < 4; cell++)
    for (let k = 0; k < phases[0].length; k++) {
      const at = (r, col) => phases[((r + top + 2 * (cell >> 1)) & 3) * 4 + ((col + left + 2 * (cell & 1)) & 3)][k];
      const cells = [at(0, 0), at(0, 1), at(1, 0), at(1, 1)], [p, r, s, t] = order.map((n) => cells[n]);
      const middle = (p + r + s + t) / 4, q = p - r, u = s - t;
      const polarized = Math.hypot(q, u) / (2 * middle);
      if (middle > 0.02 && polarized < MAX_DOLP && polarized > MIN_DOLP) pairs.push([(q ** 2 - u ** 2) / (4 * middle), p + r - s - t]);
    }
  if (pairs.length < MIN_CELLS) return null;
  let power = 0, product = 0, square = 0;
  for (const [expected, missed] of pairs) {
    power += expected ** 2;
    product += expected * missed;
  }
  const slope = product / Math.max(power, 1e-12);
  for (const [expected, missed] of pairs) square += (expected * (missed - slope * expected)) ** 2;
  return Math.abs(slope) > (MIN_ERRORS * Math.sqrt(square)) / Math.max(power, 1e-12) ? slope : 0;
}

/** Exponent of the power of the level that the variance of smooth parts follows; null where levels are too alike. */
function noiseExponent(mosaic) {
  if (Math.min(mosaic.height, mosaic.width) < 8 * SIDE) return null;
  const least = MIN_LEVEL * (mosaic.white - mosaic.black);
  const blocks = smoothBlocks(mosaic).map(([level, variance]) => [level - mosaic.black, variance]).filter(([level]) => level > least);
  if (blocks.length < BINS * MIN_BLOCKS) return null;
  blocks.sort((a, b) => a[0] - b[0]);
  const span = mosaic.white - mosaic.black, step = span >= MIN_SPAN ? 1 : span / USUAL_CODES;
  const points = [], extra = blocks.length % BINS, each = Math.floor(blocks.length / BINS);
  for (let bin = 0, at = 0; bin < BINS; bin++) {
    const part = blocks.slice(at, (at += each + (bin < extra)));
    points.push([Math.log(median(part.map(([level]) => level))), Math.log(quantile(part.map(([, own]) => own), 0.1) + step ** 2 / 12)]);
  }
  if (points[BINS - 1][0] - points[0][0] < MIN_RANGE) return null;
  const [x, y] = [0, 1].map((k) => points.reduce((total, own) => total + own[k] / BINS, 0));
  return points.reduce((total, own) => total + (own[0] - x) * (own[1] - y), 0) / points.reduce((total, own) => total + (own[0] - x) ** 2, 0);
}

/** Strength of the finest waves in blocks of 8x8 over that in blocks moved by 4; null for small frames. */
function blockRatio({ data, height, width }) {
  if (Math.min(height, width) < 8 * SIDE) return null;
  const waves = Array.from({ length: SIDE }, (_, k) => Array.from({ length: SIDE }, (_, n) =>
    Math.cos((Math.PI / SIDE) * k * (n + 0.5)) * (k ? 0.5 : Math.sqrt(0.125))));
  const strengths = [0, SIDE / 2].map((start) => {
    const rows = Math.floor((height - SIDE) / SIDE), cols = Math.floor((width - SIDE) / SIDE);
    const step = Math.max(1, Math.floor((rows * cols) / BLOCKS)), found = [];
    let count = 0;
    for (let r = 0; r < rows; r += step)
      for (let c = 0; c < cols; c++) {
        const at = (i, j) => data[(start + r * SIDE + i) * width + start + c * SIDE + j];
        let low = Infinity, high = -Infinity;
        for (let i = 0; i < SIDE; i++) for (let j = 0; j < SIDE; j++) [low, high] = [Math.min(low, at(i, j)), Math.max(high, at(i, j))];
        if (!(high > low)) continue;
        count++;
        const half = waves.map((wave) => Array.from({ length: SIDE }, (_, j) => wave.reduce((total, v, i) => total + v * at(i, j), 0)));
        for (let p = 2; p < SIDE; p++)
          for (let q = SIDE + 1 - p; q < SIDE; q++) found.push(Math.abs(half[p].reduce((total, v, j) => total + v * waves[q][j], 0)));
      }
    return count < 64 ? null : median(found);
  });
  return strengths[0] !== null && strengths[1] > 0 ? strengths[0] / strengths[1] : null;
}
