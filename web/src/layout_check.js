// Does a frame agree with its layout? By m0 + m90 = m45 + m135, whatever the light: twin of
// polsep/sensor/layout_check.py, where every constant is explained.

import { mirroredAcross, mirroredDown, rolled, sameLayout, SONY, SONY_MONO, specOf, transposed } from "./layout.js";
import { CLIP_MARGIN } from "./levels.js";
import { mean, median, quantile } from "./numbers.js";
import { checkSlopes } from "./slope_check.js";

const MIN_CONTRADICTION = 0.006, GAIN_TOLERANCE = 0.03, MIN_RATIO = 2;
const MIN_COLOR = 0.03, MAX_MONO = 0.02, EVEN = 0.007;
const MIN_AGREEMENT = 0.4, MIN_COMMON = 0.25, MAX_DISAGREEMENT = 0.25, MAX_COMMON = 0.1;
const MIN_BLOCKS = 60, MIN_EXCESS = 1.15, CLEAR = 6, VAGUE = 5.2, CHANCE = 1.6, FAR = 2.2, DARK = 0.01, MAX_DARK = 0.8;
const STRIPS = 4, STRIP = 64, LARGE = 16;
const SENSORS = ["2448x2048", "2464x2056", "4096x3000", "4112x3008"];  // heights x widths of turned frames
const PAIRINGS = { diagonals: [1, -1, -1, 1], rows: [1, 1, -1, -1], columns: [1, -1, 1, -1] };
const ORDERS = { diagonals: [90, 45, 135, 0], rows: [0, 90, 45, 135], columns: [0, 45, 90, 135] };

/** Position of a layout's crossed analysers in the cell, or null. */
export function crossedPairs({ polarizer: [a, b, c, d] }) {
  const crossed = (x) => Math.abs((((x % 180) + 180) % 180) - 90) < 1e-6;
  const pairs = { diagonals: [a - d, b - c], rows: [a - b, c - d], columns: [a - c, b - d] };
  return Object.keys(pairs).find((name) => pairs[name].every(crossed)) || null;
}

/** Means [16][blocks] of every pixel of the 4x4 period over blocks of 16x16 samples, gradients removed. */
export function seePhases(mosaic) {
  const { height, width } = mosaic, phases = Array.from({ length: 16 }, () => []);
  if (Math.min(height, width) < 16) return phases;
  const large = height >= LARGE * STRIP, step = Math.floor(height / STRIPS / STRIP) * STRIP;
  for (let s = 0; s < (large ? STRIPS : 1); s++)
    addPhases(mosaic, large ? s * step : 0, large ? STRIP : height, phases);
  return phases;
}

function addPhases({ data, width, black, white }, top, height, phases) {
  const side = Math.min(height, width) >= 64 ? 16 : 4, rows = Math.floor(height / side), cols = Math.floor(width / side);
  const span = white - black, share = 1 / ((side / 4) ** 2 * span), count = rows * cols;
  const means = Array.from({ length: 16 }, () => new Float64Array(count)), peak = new Float64Array(count).fill(-Infinity);
  for (let y = 0; y < rows * side; y++)
    for (let x = 0, at = (top + y) * width; x < cols * side; x++, at++) {
      const block = Math.floor(y / side) * cols + Math.floor(x / side);
      means[(y & 3) * 4 + (x & 3)][block] += data[at];
      if (data[at] > peak[block]) peak[block] = data[at];
    }
  for (const own of means) for (let b = 0; b < count; b++) own[b] = own[b] * share - black / span;
  const brightness = new Float64Array(count);
  for (const own of means) own.forEach((value, b) => (brightness[b] += value / 16));
  const average = mean(brightness), full = black + (1 - CLIP_MARGIN) * span;
  const parts = means.map((own) => mean(own) / (average > 1e-9 ? average : 1));
  // Central differences of the brightness per block, one-sided at the ends.
  const slope = (b, at, n, stride) => n < 2 ? 0 : at === 0 ? brightness[b + stride] - brightness[b]
    : at === n - 1 ? brightness[b] - brightness[b - stride] : (brightness[b + stride] - brightness[b - stride]) / 2;
  for (let b = 0; b < count; b++) {
    if (!(peak[b] < full)) continue;
    const down = slope(b, Math.floor(b / cols), rows, cols) / side, across = slope(b, b % cols, cols, 1) / side;
    for (let k = 0; k < 16; k++)
      phases[k].push(means[k][b] - parts[k] * (((k >> 2) - 1.5) * down + ((k & 3) - 1.5) * across));
  }
}

/** The four cells of a Bayer block and their four pixels, [cell][pixel][blocks], for an alignment. */
function cellsOf(phases, [row, col]) {
  const at = (r, c) => phases[((r + row) & 3) * 4 + ((c + col) & 3)];
  return [[0, 0], [0, 2], [2, 0], [2, 2]].map(([r, c]) => [at(r, c), at(r, c + 1), at(r + 1, c), at(r + 1, c + 1)]);
}

/** Mean contradiction of every pairing relative to s0, beyond a gain error common to the frame. */
function contradictions(cells) {
  const s0 = cells.flatMap((cell) => cell[0].map((_, b) => 0.5 * (cell[0][b] + cell[1][b] + cell[2][b] + cell[3][b])));
  const found = {}, average = Math.max(mean(s0), 1e-9);
  for (const [name, signs] of Object.entries(PAIRINGS)) {
    const missed = cells.flatMap((cell) => cell[0].map((_, b) => signs.reduce((sum, sign, k) => sum + sign * cell[k][b], 0)));
    const gain = median(missed.map((value, b) => value / Math.max(s0[b], 1e-6)));
    const common = Math.max(-GAIN_TOLERANCE, Math.min(GAIN_TOLERANCE, gain));
    found[name] = mean(missed.map((value, b) => Math.abs(value - common * s0[b]))) / average;
  }
  return found;
}

/** Difference of the cells of one alignment: contrast, agreement of neighbours, what is common, and the greens' diagonal. */
function colorPattern(cells, dark) {
  const blocks = cells[0][0].length;
  const bright = cells.map((cell) => cell[0].map((_, b) => (cell[0][b] + cell[1][b] + cell[2][b] + cell[3][b]) / 4));
  const differences = Object.values(PAIRINGS).map((signs) =>
    bright[0].map((_, b) => signs.reduce((sum, sign, k) => sum + sign * bright[k][b], 0) / 4));
  const scale = bright[0].map((_, b) => Math.max((bright[0][b] + bright[1][b] + bright[2][b] + bright[3][b]) / 4 - dark, 1e-9));
  const parts = differences.map((own) => own.map((value, b) => value / scale[b]));
  const size = scale.map((_, b) => parts.reduce((sum, own) => sum + Math.abs(own[b]), 0));
  const contrast = blocks ? median(size) : 0;
  const limited = parts.map((own) => own.map((value, b) => value / Math.max(size[b], contrast, 1e-9)));
  let product = 0, square = 0;
  for (const own of limited)
    own.forEach((value, b) => {
      square += value * value;
      if (b) product += value * own[b - 1];
    });
  const common = blocks ? limited.reduce((sum, own) => sum + Math.abs(median(own)), 0) : 0;
  const [, r, c] = differences, dot = (x, y) => x.reduce((sum, value, b) => sum + value * y[b], 0);
  const power = Math.sqrt(dot(r, r) * dot(c, c));
  return { contrast, agreement: product / Math.max(square, 1e-9), common, greens: dot(r, c) / Math.max(power, 1e-12), blocks };
}

/** [cells differ in colour (true, false, null), alignment where they differ most, the greens' diagonal]. */
function findColor(phases, layout) {
  const brightness = phases[0].map((_, b) => mean(phases.map((own) => own[b]))), average = mean(brightness);
  let dark = Math.min(...brightness) > 0 ? Math.max(quantile(brightness, DARK), 0) : 0;
  dark = dark < MAX_DARK * average ? dark : 0;
  const lit = brightness.map((value) => value - dark > 0.1 * (average - dark));
  const kept = phases.map((own) => own.filter((_, b) => lit[b]));
  const origins = [[0, 0], [0, 1], [1, 0], [1, 1]], patterns = origins.map((at) => colorPattern(cellsOf(kept, at), dark));
  const best = patterns.reduce((found, own, k) => (own.contrast > patterns[found].contrast ? k : found), 0);
  const own = patterns[best], others = patterns.filter((_, k) => k !== best).map(({ contrast }) => contrast);
  const sharp = own.contrast > MIN_EXCESS * Math.max(...others);
  const agreed = own.agreement > MIN_AGREEMENT || own.common > MIN_COMMON + CHANCE / Math.max(own.blocks, 1) ** 0.5;
  const clear = own.contrast > Math.max(CLEAR * Math.min(...others), FAR * Math.max(...others));
  if (sharp && own.contrast > MIN_COLOR && (agreed || clear)) return [true, origins[best], own.greens];
  const plain = own.agreement < MAX_DISAGREEMENT && own.common < MAX_COMMON && own.contrast < VAGUE * Math.min(...others);
  const mono = plain && (own.contrast < MAX_MONO || (sharp && own.blocks > MIN_BLOCKS));
  return [mono || own.contrast < EVEN ? false : null, layout.origin, 0];
}

/** The pairing that the identity singles out, the layout's own where that does not contradict, null if undecided. */
function findPairs(found, layout) {
  const claimed = crossedPairs(layout), names = Object.keys(found);
  const best = names.reduce((a, b) => (found[b] < found[a] ? b : a)), next = Object.values(found).sort((a, b) => a - b)[1];
  if (!claimed || next < MIN_CONTRADICTION) return null;
  if (found[claimed] > MIN_CONTRADICTION && found[claimed] > MIN_RATIO * found[best]) return best;
  return claimed === best && next > MIN_RATIO * found[best] ? claimed : null;
}

/** The layout and what common mistakes make of it, [layout, reason], the likeliest first. */
function candidates(layout) {
  const crops = [];
  for (let r = 0; r < 4; r++) for (let c = 0; c < 4; c++) if (r || c) crops.push([r, c]);
  crops.sort((a, b) => a[0] + a[1] - b[0] - b[1]);
  const cropped = (own) => crops.map(([r, c]) => [rolled(own, -r, -c), cropReason(own, r, c)]);
  const bayer = layout.bayer ? "RGGB" : null, found = [[layout, "as given"], [{ ...SONY, bayer }, "Sony's order"]];
  found.push(...cropped(layout).slice(0, 3), [mirroredAcross(layout, 4), "mirrored left-right"],
    [mirroredDown(layout, 4), "mirrored top-bottom"], [transposed(layout), "transposed"], ...cropped(layout).slice(3));
  for (const order of Object.values(ORDERS)) {
    const other = { polarizer: order, bayer: layout.bayer, origin: [0, 0] };
    found.push([other, "another order of analysers"]);
    found.push(...cropped(other).map(([crop, why]) => [crop, `another order of analysers, ${why}`]));
  }
  const swapped = layout.bayer ? "mono read as colour" : "colour read as mono";
  for (const order of [layout.polarizer, ...Object.values(ORDERS)]) {
    const other = { polarizer: order, bayer: layout.bayer ? null : "RGGB", origin: [0, 0] };
    found.push([other, swapped], ...cropped(other).map(([crop, why]) => [crop, `${swapped}, ${why}`]));
  }
  return [...found, ...turns(layout)];
}

/** In colour the reason names the crop two rows and columns farther too, which differs in red and blue. */
function cropReason(layout, r, c) {
  const reason = `cropped from row ${r}, column ${c} on`, row = (r + 2) % 4, col = (c + 2) % 4;
  return layout.bayer ? `${reason}; if from row ${row}, column ${col}, ${specOf(rolled(layout, -row, -col))}` : reason;
}

/** The layout of frames turned by a right angle, which swap red and blue: the reason names the other one too. */
function turns(layout) {
  const left = mirroredDown(transposed(layout), 4), right = mirroredAcross(transposed(layout), 4);
  return [[left, `turned to the left; if to the right, ${specOf(right)}`]];
}

/** The layout of mirrored whole frames, which differ in red and blue: the reason names the other one too. */
function reversals(layout) {
  return [[mirroredAcross(layout, 4), `mirrored left-right; if top-bottom, ${specOf(mirroredDown(layout, 4))}`]];
}

const optionOf = (layout) => (sameLayout(layout, SONY_MONO) ? "mono" : specOf(layout));

/** What contradicts the mosaic's layout: {text, layout}, the layout being the one to offer; null where nothing does. */
export function checkLayout(mosaic, phases) {
  const { layout } = mosaic;
  if (phases[0].length < 16 || mean(phases.map(mean)) <= 1e-4) return null;
  const [color, origin, greens] = findColor(phases, layout), pairs = findPairs(contradictions(cellsOf(phases, origin)), layout);
  const agrees = (own) => (color === null || (own.bayer !== null) === color) &&
    !(color && (own.origin[0] !== origin[0] || own.origin[1] !== origin[1])) &&
    !(color && Math.abs(greens) > 0.5 && ["RGGB", "BGGR"].includes(own.bayer) !== greens > 0) &&
    (pairs === null || [pairs, null].includes(crossedPairs(own)));
  const fits = candidates(layout).filter(([own]) => agrees(own));
  const sensor = SENSORS.includes(`${mosaic.height}x${mosaic.width}`), turned = sensor && [SONY, SONY_MONO].some((own) => sameLayout(own, layout));
  if (!fits.length || fits.some(([own]) => sameLayout(own, layout))) {
    if (!turned) return color && !sensor ? checkSlopes(mosaic) : null;
    const stood = transposed(layout);
    return {
      text: `the frame is ${mosaic.width}x${mosaic.height}, a sensor's ${mosaic.height}x${mosaic.width} turned or ` +
        `transposed: say layout ${specOf(stood)} (transposed), the likeliest, or save it as it was read`,
      layout: specOf(stood),
    };
  }
  const whole = color && SENSORS.includes(`${mosaic.width}x${mosaic.height}`) && sameLayout(SONY, layout);  // no crop
  const turn = turned ? turns(layout) : whole ? reversals(layout) : [];
  const [likely, reason] = turn.find(([own]) => agrees(own)) || fits[0];
  const option = `layout ${optionOf(likely)} (${reason})`;
  if (color === false && layout.bayer)
    return { text: `the frame shows no colour pattern: unless all it shows is grey, say ${option}`, layout: optionOf(likely) };
  return { text: `the frame contradicts layout ${specOf(layout)}: it fits ${option}, the likeliest`, layout: optionOf(likely) };
}
