// Dead, hot and stuck pixels, found in one frame and repaired: twin of polsep/sensor/defects.py and defects_kernel.py,
// where the laws and every constant are explained.
//
// The residual of a pixel is its sample minus its prediction from the other samples of 9x9 pixels (kriging).

import { filterAt, periodOf } from "./layout.js";
import { clipLevel } from "./levels.js";
import { measureNoise } from "./noise.js";
import { solve } from "./numbers.js";

const SIDE = 9, REACH = 4, RING = 2, MAX_UNEVEN = 12, MOST = 4, MIN_CLIPPED = 3, SWEEPS = 200, CYCLES = 12, ROUNDS = 3;
const CANDIDATE = 4, CONFIRMED = 6, RATIO = 3, CLUSTER_RATIO = 8, SPREAD = 0.06, MIN_SIZE = 16;
const LENGTH = 3, CORRELATION = 0.95, POLARIZATION = 0.5, ALLOWANCE = 0.02;
const SIGNIFICANT = 9, SIGNIFICANT_CLUSTER = 2;

/** The number of defects of a mosaic, whose samples are repaired in place. */
export function removeDefects(mosaic) {
  if (Math.min(mosaic.height, mosaic.width) < MIN_SIZE) return 0;
  const frame = new Frame(mosaic), known = new Map();
  let candidates = findCandidates(mosaic, frame);
  for (let round = 0; round < ROUNDS; round++) {
    const fresh = candidates.flatMap((place) => frame.confirm(place));
    if (!fresh.length) break;
    for (const place of fresh) if (!known.has(place)) known.set(place, mosaic.data[place]);
    for (const [place, value] of known) mosaic.data[place] = value;
    frame.fill([...known.keys()].sort((a, b) => a - b));
    candidates = candidates.filter((place) => !known.has(place) && fresh.some((other) => frame.isNear(place, other)));
  }
  return known.size;
}

/** Samples beyond the second largest or smallest of their 8 neighbours of one kind, by more than noise. */
function findCandidates({ data, height, width, layout, black }, { noise }) {
  const p = periodOf(layout), found = [];
  for (let i = 0; i < height; i++) {
    const up = (i >= p ? -p : p) * width, down = (i + p < height ? p : -p) * width;
    for (let j = 0, at = i * width; j < width; j++, at++) {
      const left = j >= p ? -p : p, right = j + p < width ? p : -p, x = data[at];
      const a = data[at + left], b = data[at + right], c = data[at + up], d = data[at + down];
      // Two of four neighbours as large, and two as small: so are most samples.
      if ((a >= x) + (b >= x) + (c >= x) + (d >= x) > 1 && (a <= x) + (b <= x) + (c <= x) + (d <= x) > 1) continue;
      let high = -Infinity, second = -Infinity, low = Infinity, other = Infinity;
      for (let k = 0; k < 8; k++) {
        const row = k < 3 ? up : k < 5 ? 0 : down, col = k < 3 ? k : k < 5 ? 2 * (k - 3) : k - 5;
        const value = data[at + row + (col === 0 ? left : col === 2 ? right : 0)];
        if (value > high) { second = high; high = value; } else if (value > second) second = value;
        if (value < low) { other = low; low = value; } else if (value < other) other = value;
      }
      const excess = Math.max(x - second, other - x);
      const variance = noise.gain * Math.max(second - black, 0) + noise.floor;
      if (excess > 0 && excess * excess > CANDIDATE ** 2 * variance) found.push(at);
    }
  }
  return found;
}

/** A mosaic with its predictions. Coefficients of residuals are solved for when a case first occurs. */
class Frame {
  constructor(mosaic) {
    Object.assign(this, { mosaic, noise: measureNoise(mosaic), clip: clipLevel(mosaic), tables: new Map() });
  }

  /** Coefficients [81] of the residual of a pixel, first sample of its window, and the spread of its noise. */
  window(place) {
    const { height, width, data } = this.mosaic, i = Math.floor(place / width), j = place % width;
    const top = Math.min(Math.max(i - REACH, 0), height - SIDE), left = Math.min(Math.max(j - REACH, 0), width - SIDE);
    let clipped = 0;
    for (let a = 0; a < SIDE; a++)
      for (let b = 0, at = (top + a) * width + left; b < SIDE; b++, at++) clipped += data[at] >= this.clip;
    const own = clipped >= MIN_CLIPPED;
    const key = `${own},${i - top},${j - left},${top % 4},${left % 4}`;
    if (!this.tables.has(key)) this.tables.set(key, kriging(this.mosaic.layout, top, left, [i - top, j - left], own));
    return { ...this.tables.get(key), first: top * width + left, top, left };
  }

  residual(place, { coefficients, first } = this.window(place)) {
    const { width, data } = this.mosaic;
    let total = 0;
    for (let a = 0; a < SIDE; a++)
      for (let b = 0; b < SIDE; b++) total += data[first + a * width + b] * coefficients[a * SIDE + b];
    return total;
  }

  /** Factor of the sample at `other` in a residual. */
  factor({ coefficients, top, left }, other) {
    const a = Math.floor(other / this.mosaic.width) - top, b = (other % this.mosaic.width) - left;
    return a < 0 || a >= SIDE || b < 0 || b >= SIDE ? 0 : coefficients[a * SIDE + b];
  }

  /** Places of the defects that a candidate is or belongs to; nothing if it is none. */
  confirm(place) {
    const places = [];
    for (let size = 1; size <= MOST; size++) {
      places.push(place);
      const windows = places.map((own) => this.window(own)), excess = this.excessOf(places, windows);
      const least = this.leastExcess(places, windows, excess);
      if (least === 0) return [];
      const ring = this.searchRing(places, excess, least / (size === 1 ? RATIO : CLUSTER_RATIO));
      if (ring.count === 0)
        return ring.spread < (size === 1 ? SPREAD : SPREAD / 2) && !this.isSquare(places) ? places : [];
      if (ring.count > MAX_UNEVEN) return [];
      place = ring.worst;
    }
    return [];
  }

  /** Differences of all places to their predictions from the samples of all others. */
  excessOf(places, windows) {
    const residuals = places.map((place, k) => this.residual(place, windows[k])), excess = [...residuals];
    for (let cycle = 0; cycle < (places.length > 1 ? CYCLES : 0); cycle++)
      for (let k = 0; k < places.length; k++)
        excess[k] = places.reduce((sum, other, m) => (m === k ? sum : sum - this.factor(windows[k], other) * excess[m]), residuals[k]);
    return excess;
  }

  /** The smallest difference without sign; 0 if noise may be one of them. */
  leastExcess(places, windows, excess) {
    const { data, black } = this.mosaic, { gain, floor } = this.noise;
    for (const [k, place] of places.entries()) {
      const variance = gain * Math.max(data[place] - excess[k] - black, 0) + floor;
      if (excess[k] ** 2 <= (CONFIRMED * windows[k].spread) ** 2 * variance) return 0;
    }
    return Math.min(...excess.map(Math.abs));
  }

  /** How many pixels around are out of line once the places are repaired, the worst, and the light they share. */
  searchRing(places, excess, limit) {
    const { height, width } = this.mosaic;
    const rows = places.map((place) => Math.floor(place / width)), cols = places.map((place) => place % width);
    let count = 0, most = 0, worst = places[0], light = 0, power = 0, near = 0, far = 0;
    for (let a = Math.max(Math.min(...rows) - RING, 0); a <= Math.min(Math.max(...rows) + RING, height - 1); a++)
      for (let b = Math.max(Math.min(...cols) - RING, 0); b <= Math.min(Math.max(...cols) + RING, width - 1); b++) {
        const steps = rows.map((row, k) => Math.abs(row - a) + Math.abs(cols[k] - b)), distance = Math.min(...steps);
        if (distance === 0) continue;
        const place = a * width + b, window = this.window(place);
        const rest = places.reduce((sum, other, k) => sum - this.factor(window, other) * excess[k], this.residual(place, window));
        if (distance === 1) {
          light += excess[steps.indexOf(distance)] > 0 ? rest : -rest;
          near++;
        } else if (distance > 2) {
          power += rest * rest;
          far++;
        }
        count += Math.abs(rest) > limit;
        if (Math.abs(rest) > most) [most, worst] = [Math.abs(rest), place];
      }
    const significant = places.length === 1 ? SIGNIFICANT : SIGNIFICANT_CLUSTER;
    const shared = far > 0 && light ** 2 > (significant * power * near) / far;
    return { count, worst, spread: shared ? light / excess.reduce((sum, own) => sum + Math.abs(own), 0) : 0 };
  }

  /** True for three or four pixels of one square of 2x2. */
  isSquare(places) {
    const { width } = this.mosaic, rows = places.map((place) => Math.floor(place / width)), cols = places.map((place) => place % width);
    return places.length > 2 && Math.max(...rows) - Math.min(...rows) <= 1 && Math.max(...cols) - Math.min(...cols) <= 1;
  }

  /** Replace samples by their predictions from each other and from all others. */
  fill(places) {
    let largest = 0;
    for (let sweep = 0; sweep < SWEEPS; sweep++) {
      let change = 0;
      for (const place of places) {
        const residual = this.residual(place);
        this.mosaic.data[place] -= residual;
        change = Math.max(change, Math.abs(residual));
      }
      largest = Math.max(largest, change);
      if (change <= 1e-6 * largest) break;
    }
  }

  /** True where the residual of one place may depend on the sample of another. */
  isNear(one, other) {
    const { width } = this.mosaic, block = (place) => [Math.floor(place / width / 4), Math.floor((place % width) / 4)];
    const [a, b] = block(one), [c, d] = block(other);
    return Math.abs(a - c) <= 2 && Math.abs(b - d) <= 2;
  }
}

/** Coefficients of the residual of the sample in the `middle` of a window at (top, left); `own`: by its kind alone. */
function kriging(layout, top, left, middle, own) {
  const all = Array.from({ length: SIDE * SIDE }, (_, k) => {
    const place = [Math.floor(k / SIDE), k % SIDE], [angle, color] = filterAt(layout, top + place[0], left + place[1]);
    return { k, place, angle: (angle * Math.PI) / 180, color };
  });
  const target = all[middle[0] * SIDE + middle[1]];
  const kept = all.filter((one) => !own || (one.angle === target.angle && one.color === target.color));
  const others = kept.filter((one) => one !== target);
  const covariance = (p, q) => {
    const alike = p.color === q.color ? 1 : CORRELATION, mix = 0.25 * (1 + POLARIZATION ** 2 * Math.cos(2 * (p.angle - q.angle)));
    const distance = Math.hypot(p.place[0] - q.place[0], p.place[1] - q.place[1]);
    return Math.exp(-distance / LENGTH) * alike * mix + (p === q ? ALLOWANCE ** 2 : 0);
  };
  // Unknown constants: s0, s1, s2 of each colour; of samples of one kind just one.
  const colors = own ? [target.color] : [...new Set(all.map(({ color }) => color))];
  const drift = (one) => own ? [1]
    : colors.flatMap((c) => (one.color === c ? [1, Math.cos(2 * one.angle), Math.sin(2 * one.angle)] : [0, 0, 0]));
  const drifts = others.map(drift), count = drifts[0].length, n = others.length;
  const system = others.map((p, i) => [...others.map((q) => covariance(p, q)), ...drifts[i]]);
  for (let c = 0; c < count; c++) system.push([...drifts.map((own) => own[c]), ...new Array(count).fill(0)]);
  const weights = solve(system, [...others.map((p) => covariance(p, target)), ...drift(target)]);
  const coefficients = new Float64Array(SIDE * SIDE);
  coefficients[target.k] = 1;
  for (let i = 0; i < n; i++) coefficients[others[i].k] = -weights[i];
  return { coefficients, spread: Math.hypot(...coefficients) };
}
