// Noise of samples and the black level that one frame shows: twins of polsep/sensor/noise.py and black_level.py.

import { clipLevel } from "./levels.js";
import { mean, median, quantile, quantileOfSorted, sorted, sum } from "./numbers.js";

/** Samples along the side of a block. */
export const BLOCK = 4;
const BLOCKS = 6144, MAX_BINS = 64, FEWEST_BINS = 6, BLOCKS_PER_BIN = 48, MIN_BLOCKS = 24;
const QUARTER = 8.438 / 12, MEDIAN = 11.34 / 12, OUTLIER = 2, MIN_WELL = 200, LARGEST_FLOOR = 0.05;
const ROUNDING = 2 ** -20, ROUNDS = 16, DEVIATION = 0.44, LARGEST_WELL = 20000;
const CODE_ROWS = 8, MIN_CODES = 32, MIN_SPAN = 100, LEAST = 0.0015;

/**
 * Rows of blocks, every `step`-th, with what all estimates need of them: `kept` tells blocks that do not clip, nor
 * their neighbours left and right; `level` is the mean, `spread` the mean square of the difference to them.
 */
function* blockRows({ data, height, width }, step, full, least) {
  const cols = Math.floor(width / BLOCK), rows = Math.floor(height / BLOCK);
  for (let row = 0; row < rows; row += step) {
    const x = new Float32Array(cols * 16), usable = new Uint8Array(cols).fill(1), level = new Float64Array(cols);
    for (let k = 0; k < 16; k++)
      for (let b = 0, at = (row * BLOCK + (k >> 2)) * width + (k & 3); b < cols; b++, at += BLOCK) {
        const value = data[at];
        x[b * 16 + k] = value;
        level[b] += value / 16;
        if (!(value < full && value > least)) usable[b] = 0;
      }
    const square = new Float64Array(cols), variance = new Float64Array(cols);
    for (let b = 1; b < cols - 1; b++) {
      let total = 0;
      for (let k = 0; k < 16; k++) {
        const across = x[b * 16 + k] - 0.5 * (x[b * 16 - 16 + k] + x[b * 16 + 16 + k]);
        square[b] += across * across;
        total += across;
      }
      variance[b] = (square[b] / 16 - (total / 16) ** 2) / 1.5;
      square[b] /= 16 * 1.5;
    }
    yield { cols, x, usable, level, square, variance };
  }
}

const leastNoise = (span, step) => ({ gain: 0, floor: step ** 2 / 4 + (ROUNDING * span) ** 2 });

/** Step between the codes that samples of some rows are, scaled ones too; 0 for others, as of renderings. */
function codeStep({ data, width }, rows, span) {
  const kept = rows.filter((_, k) => k % Math.max(1, Math.floor(rows.length / CODE_ROWS)) === 0);
  const ordered = Float32Array.from(kept.flatMap((row) => Array.from(data.subarray(row * width, (row + 1) * width)))).sort();
  const codes = ordered.filter((value, k) => value === ordered[k + 1] && value !== ordered[k - 1]);  // that occur twice
  const gaps = codes.subarray(1).map((code, k) => code - codes[k]), least = gaps.reduce((a, b) => Math.min(a, b), Infinity);
  if (codes.length >= MIN_CODES && 2 ** -15 * span <= least && least <= 2 ** -7 * span) {
    const near = mean(gaps.filter((gap) => gap < 1.5 * least));
    const step = sum(gaps) / sum(gaps.map((gap) => Math.round(gap / near)));
    if (codes.every((code) => Math.abs((code - codes[0]) / step - Math.round((code - codes[0]) / step)) < 0.05)) return step;
  }
  const lit = ordered.filter((value) => value !== 0), others = lit.filter((value) => value !== Math.floor(value));
  return span >= MIN_SPAN && others.length <= 0.01 * lit.length ? 1 : 0;
}

/** Variance of a sample, {gain, floor}: gain times its light above black, plus floor; for the search of defects. */
export function measureNoise(mosaic) {
  const { width, height, black, white } = mosaic, span = white - black;
  const step = codeStep(mosaic, Array.from({ length: height }, (_, row) => row), span);
  const blocks = Math.floor(height / BLOCK) * Math.floor(width / BLOCK), least = leastNoise(span, step);
  const signal = [], spread = [], dark = [];
  for (const row of blockRows(mosaic, Math.max(1, Math.floor(blocks / BLOCKS)), clipLevel(mosaic), 0))
    for (let b = 0; b < row.cols; b++) {
      const own = row.x.subarray(b * 16, b * 16 + 16);
      let below = 0, squares = 0;
      for (const value of own) {
        below += value <= black;
        squares += Math.max(value - black, 0) ** 2;
      }
      if (below >= 4) dark.push(squares / 16);
      if (!row.usable[b]) continue;
      const inner = b > 0 && b < row.cols - 1 && row.usable[b - 1] && row.usable[b + 1];
      signal.push(row.level[b] - black);
      spread.push(inner ? row.square[b] : Infinity);
    }
  const found = signal.length < MIN_BLOCKS ? least : fitNoise(byBrightness(signal, spread, span), span, least);
  const floor = dark.length < MIN_BLOCKS ? found.floor : Math.max(2 * median(dark), leastNoise(span, step).floor);
  return { gain: Math.max(found.gain, span / LARGEST_WELL), floor };
}

/** [signal, variance, number] of the blocks of each bin of brightness, bins of equal width in the signal's root. */
function byBrightness(signal, spread, span) {
  const root = signal.map((value) => Math.sqrt(Math.max(value, 0)));
  const bins = Math.min(Math.max(Math.floor(root.length / BLOCKS_PER_BIN), FEWEST_BINS), MAX_BINS);
  const scale = bins / Math.max(root.reduce((a, b) => Math.max(a, b)), 1e-3 * span ** 0.5);
  const parts = Array.from({ length: bins }, () => [[], []]);
  root.forEach((value, k) => {
    const part = parts[Math.min(Math.floor(value * scale), bins - 1)];
    part[0].push(signal[k]);
    part[1].push(spread[k]);
  });
  return parts.map(([own, squares]) => [own, central(sorted(squares))]).filter(([, variance]) => Number.isFinite(variance))
    .map(([own, variance]) => [median(own), variance, own.length]);
}

/** The variance that explains most of the blocks' ascending mean squares; Infinity if too few are finite. */
function central(ordered) {
  const finite = ordered.filter(Number.isFinite);
  if (finite.length < MIN_BLOCKS) return Infinity;
  const quiet = quantileOfSorted(finite, 0.25) / QUARTER;
  return quantileOfSorted(finite.filter((value) => value <= OUTLIER * quiet), 0.5) / MEDIAN;
}

function fitNoise(points, span, least) {
  if (!points.length) return least;
  const x = points.map(([signal]) => signal), y = points.map(([, own]) => Math.max(own, least.floor));
  const count = points.map(([, , own]) => own), trust = y.map((own, k) => count[k] / own ** 2);
  let line = least, weight = trust;
  for (let round = 0; round < ROUNDS; round++) {
    line = fitLine(x, y, weight, least.floor);
    line = { gain: Math.min(line.gain, span / MIN_WELL), floor: Math.min(line.floor, (LARGEST_FLOOR * span) ** 2) };
    weight = trust.map((own, k) => {
      const above = (y[k] - line.gain * x[k] - line.floor) / y[k] / (DEVIATION / Math.sqrt(count[k]));
      return own / (above > 0 ? Math.max(above, 1) ** 2 : Math.max(-above, 1));
    });
  }
  return line;
}

function fitLine(x, y, weight, least) {
  const dot = (f) => x.reduce((total, _, k) => total + weight[k] * f(k), 0), total = dot(() => 1);
  const middle = dot((k) => x[k]) / total, height = dot((k) => y[k]) / total;
  const spread = dot((k) => (x[k] - middle) ** 2);
  const gain = spread > 0 ? dot((k) => (x[k] - middle) * (y[k] - height)) / spread : 0, floor = height - gain * middle;
  if (gain < 0) return { gain: 0, floor: Math.max(height, least) };
  if (floor >= least) return { gain, floor };
  const power = dot((k) => x[k] ** 2);
  return { gain: Math.max(power > 0 ? dot((k) => x[k] * (y[k] - least)) / power : 0, 0), floor: least };
}

/**
 * The black level that the darkest parts of a frame show by their noise, {level, shown, text}; null where they show none, or
 * what was said. `level` null: only a warning.
 */
export function checkBlackLevel(mosaic) {
  const { data, height, width, black, white } = mosaic, span = white - black;
  if (Math.min(height, width) < 4 * BLOCK) return null;
  const samples = someRows(mosaic).flatMap((row) => Array.from(data.subarray(row * width, row * width + width - (width % BLOCK))));
  const below = samples.filter((value) => value < black - 0.002 * span).length / samples.length;
  if (below > 0.002 && !((blackOf({ ...mosaic, black: 0 }) ?? 0) > black - LEAST * span))  // else these are tails of its noise
    return {
      level: null,
      text: `${(100 * below).toFixed(1)}% of the samples lie below the black level ${black}, which only noise should: ` +
        `the darkest are at ${Number(quantile(samples, 0.001).toPrecision(6))}, say a lower black level`,
    };
  const found = blackOf(mosaic);
  if (found === null || found - black < LEAST * span) return null;
  const shown = Number(found.toPrecision(4)), text = `black lies at ${shown}, not at ${black}, as the noise of dark parts shows`;
  return { level: found, shown, text: `${text}: ${black === 0 ? "taken so, say" : "say"} black level ${shown}` };
}

const stepOf = ({ height, width }) => Math.max(1, Math.floor(Math.floor(height / BLOCK) * Math.floor(width / BLOCK) / 24576));

/** Rows of samples in some rows of blocks. */
function someRows(mosaic) {
  const count = Math.floor(Math.floor(mosaic.height / BLOCK - 1) / stepOf(mosaic)) + 1;
  return Array.from({ length: BLOCK * count }, (_, k) => (k >> 2) * stepOf(mosaic) * BLOCK + (k & 3));
}

/** The level of the darkest parts if they are black, by their noise; null where that is not shown. */
function blackOf(mosaic) {
  const { black, white } = mosaic, span = white - black, least = 32, step = codeStep(mosaic, someRows(mosaic), span);
  const blocks = smoothBlocks(mosaic).sort(([a], [b]) => a - b), [level, variance] = [0, 1].map((k) => blocks.map((own) => own[k]));
  if (level.length < 4 * least || !(0 < step && step <= span / MIN_SPAN)) return null;
  const count = Math.max(least, Math.floor(0.004 * level.length));
  const dark = median(level.slice(0, count)), quiet = median(variance.slice(0, count)), last = level[level.length - 1];
  if (dark - black < LEAST * span || !(last > dark)) return null;
  const edge = (k) => dark + (last - dark) * (k / 24) ** 2, gains = [];
  for (let k = 1, at = level.findIndex((own) => own >= edge(1)); k <= 24 && at >= 0; k++) {
    let end = at;
    while (end < level.length && (k === 24 || level[end] < edge(k + 1))) end++;
    if (end - at >= least && median(level.slice(at, end)) > dark)
      gains.push((quantile(variance.slice(at, end), 0.25) - quiet) / (median(level.slice(at, end)) - dark));
    at = end;
  }
  if (gains.length < 3) return null;
  const gain = quantile(gains, 0.25);
  if (gain < (0.5 * span) / LARGEST_WELL) return null;
  if (quiet > (dark - black) * Math.min(0.35 * gain, (0.6 * span) / LARGEST_WELL)) return null;
  return median(level.filter((own) => own <= dark + 4 * Math.sqrt(quiet / BLOCK ** 2)));
}

/** Mean level and variance [level, variance] of unclipped blocks, without what is common to a block: texture. */
export function smoothBlocks(mosaic) {
  const found = [];
  for (const row of blockRows(mosaic, stepOf(mosaic), clipLevel(mosaic), -Infinity))
    for (let b = 1; b < row.cols - 1; b++)
      if (row.usable[b] && row.usable[b - 1] && row.usable[b + 1]) found.push([row.level[b], row.variance[b]]);
  return found;
}
