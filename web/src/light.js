// The lamp's colour, found in one frame: twin of polsep/light/color.py, find.py and metals.py, where the method, its
// sources and every constant are explained. Matrices [3][3] are arrays of 9, in reading order.

import { channelsOf } from "./layout.js";
import { mean, median, quantile, sum } from "./numbers.js";
import { tilesOf } from "./tiles.js";

const MOST_TILES = 640, MIN_TILES = 6, LEAST_K = 0.006, OWN_K = 0.8, MEAN_K = 0.03;
const LEAST_JITTER = 0.005, OWN_JITTER = 0.3, MEAN_JITTER = 0.08, INDEPENDENT = 5, LEAK = 0.43, ACROSS = 1;
const VOTE_ERROR = 0.0045, FREEDOM = 3.6, SPREAD = 0.5, STEPS = 15, LARGEST_STEP = 0.4, LAST_STEP = 3e-4, MAX_K = 0.4;
const SURE_DEG = 2.5, UNKNOWN_DEG = 20, ASTRAY = [[0.938, 0.02], [0.323, 0.1]], ASTRAY_LEAN = -0.674, ASTRAY_BIAS = 0.017;
const RAW_LAMPS = [[-1.05, 0.13], [-1.35, 0.03]], RAW_EDGE = 0.06, WARM = [0.524, -0.852], WARM_SPREAD = [0.5, 0.08];
const GOOD = [1.25 * Math.exp(0.28), 0.126, 0.563], UNCERTAIN_DEG = 5.5, LEAST_METAL = 0.02;
const WHITE_SHARE = 0.6, RAW_SHARE = 0.27, WARM_SHARE = 0.08, ANY_SHARE = 0.03, ANY_SPREAD = 0.5, LED_SHARE = 0.02, LED_SPREAD = 1.5, LED_LIMIT = 3.4;
const BODIES_SPREAD = 1, ASTRAY_SPREAD = 0.5, GOOD_SPREAD = 2.03, LIKELY_WHITE = 0.5, LIKELY_RIGHT = 0.5, GRID = [-1.5, 0.8, 47];
const LARGEST_RATIO = 5;
const GREENISH = -1.2, PURE_SPECULAR = 1, MIN_SPECULAR_TILES = 3, METAL_DISTANCE = 0.28;
const COPPER = [0.403, -0.17], GOLD = [0.246, -0.821];
/** Two directions beside grey. */
const BESIDE = [[1, -1, 0].map((v) => v / Math.SQRT2), [1, 1, -2].map((v) => v / Math.sqrt(6))];

const trace = (m) => m[0] + m[4] + m[8];
const transpose = (m) => [m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]];
const mix = (...terms) => Array.from({ length: 9 }, (_, k) => terms.reduce((total, [factor, m]) => total + factor * m[k], 0));
const invert2 = ([a, b, c, d]) => { const det = a * d - b * c; return [d / det, -b / det, -c / det, a / det]; };
const times2 = (p, q) => [p[0] * q[0] + p[1] * q[2], p[0] * q[1] + p[1] * q[3], p[2] * q[0] + p[3] * q[2], p[2] * q[1] + p[3] * q[3]];

/** Eigenvalues and unit eigenvectors of a symmetric matrix (a, b; b, d). */
function eigen2(a, b, d) {
  const angle = 0.5 * Math.atan2(2 * b, a - d), c = Math.cos(angle), s = Math.sin(angle);
  const value = (x, y) => a * x * x + 2 * b * x * y + d * y * y;
  return [[value(c, s), [c, s]], [value(-s, c), [-s, c]]];
}

const IGNORED = "the colour stated of the light changes nothing: mono frames show no colours";
const TOO_LITTLE = "a frame that shows the lamp's colour was expected, found one too small, dark or overexposed; white is " +
  "assumed: if the lamp is not white, say the lamp's colour";

/** The light's colour, {color: [gain per channel], source, remarks}, green = 1: found in the frame unless it was said. */
export function lightOf(said, mosaic) {
  const mono = channelsOf(mosaic.layout) === 1, stated = (color, remarks = []) => ({ color, source: "stated", remarks });
  if (said === "white") return stated(mono ? [1] : [1, 1, 1]);
  if (!Array.isArray(said)) return findLight(mosaic);
  if (said.length !== 3 || !said.every((gain) => gain > 1e-6 && gain < 1e6))
    throw new Error(`expected a light colour of three positive numbers, found ${said}`);
  if (!mono) return stated(said.map((gain) => gain / said[1]));
  return stated([1], new Set(said).size > 1 ? [IGNORED] : []);
}

/** {color: [r, g, b], source, sure, error_deg, metal_fraction, remarks}, green = 1; of a mono mosaic the colour is [1]. */
export function findLight(mosaic) {
  if (channelsOf(mosaic.layout) === 1) return { color: [1], source: "found", sure: true, error_deg: 0, metal_fraction: 0, remarks: [] };
  const tiles = tilesOf(mosaic);
  if (tiles.length < MIN_TILES) {
    const unknown = { x: [0, 0], error: UNKNOWN_DEG, sure: false, metal: 0 };
    return { ...asReport(unknown), remarks: [TOO_LITTLE] };
  }
  const axis = axisOf(strongest(tiles)), light = lightOfTiles(tiles, axis);
  return { ...asReport(light), remarks: remarksOn(light, tiles) };
}

const colorOf = ({ x }) => [Math.exp(x[0]), 1, Math.exp(x[1])];
const asReport = (light) =>
  ({ color: colorOf(light), source: "found", sure: light.sure, error_deg: light.error, metal_fraction: light.metal });

/** The light of the bodies alone where they show that the frame holds coloured metal. */
function lightOfTiles(tiles, axis) {
  const fit = fitColor(strongest(tiles), axis), specular = onlySpecular(tiles, axis);
  const marked = new Set(tiles.filter((_, k) => specular[k]).map(({ row, col }) => `${row},${col}`));
  const touches = ({ row, col }) => [-1, 0, 1].some((i) => [-1, 0, 1].some((j) => marked.has(`${row + i},${col + j}`)));
  const bodies = tiles.filter((tile) => !touches(tile));
  if (marked.size < MIN_SPECULAR_TILES || bodies.length < MIN_TILES) return asLight(fit, tiles);
  const reflected = iterate(planesAlong(strongest(tiles.filter((_, k) => specular[k])), axis)).x;
  const ownAxis = axisOf(strongest(bodies)), own = fitColor(strongest(bodies), ownAxis);
  if (!isMetal([reflected[0] - own.x[0], reflected[1] - own.x[1]])) return asLight(fit, tiles);
  return { ...asLight(own, bodies), metal: metalShare(tiles, ownAxis, own.x) };
}

function remarksOn(light, tiles) {
  const remarks = [], color = colorOf(light);
  if (light.metal >= LEAST_METAL)
    remarks.push("highlights of the lamp's colour were expected, found those of gold or copper on " +
      `${Math.round(100 * light.metal)}% of the lit frame: diffuse and specular may be wrong there; compare with method analytic`);
  if (light.sure) return remarks;
  const [r, g, b] = [1, 2, 3].map((k) => mean(tiles.map(({ moments }) => moments[k] / moments[0])));
  const white = light.x[0] === 0 && light.x[1] === 0;
  if (light.error > UNCERTAIN_DEG && (!white || r * b < Math.exp(GREENISH) * g ** 2))
    remarks.push(`highlights that show the lamp's colour were expected, found too few; ${color.map((v) => v.toFixed(2))} is ` +
      "assumed: show a shiny object, or measure a grey card and say the lamp's colour");
  return remarks;
}

/** Unit vector of (s1, s2) along which light is polarized most. */
function axisOf(tiles) {
  const sums = [0, 0, 0, 0, 0, 0];  // 11, 22, 12, 01, 02, noise
  for (const { moments, noise } of tiles) {
    const at = (i, j) => [0, 1, 2].reduce((total, c) => total + moments[(1 + 3 * i + c) * 10 + 1 + 3 * j + c], 0);
    [at(1, 1), at(2, 2), at(1, 2), at(0, 1), at(0, 2), sum(noise)].forEach((value, k) => (sums[k] += value));
  }
  const [along, across, mixed, first, second, noise] = sums;
  const angle = 0.5 * Math.atan2(2 * mixed, along - 2 * noise - (across - 2 * noise));
  const axis = [Math.cos(angle), Math.sin(angle)];
  return first * axis[0] + second * axis[1] < 0 ? axis.map((v) => -v) : axis;
}

/** The tiles of the most polarized light, MOST_TILES at most, in their order. */
function strongest(tiles) {
  if (tiles.length <= MOST_TILES) return tiles;
  const power = tiles.map(({ moments, noise }) =>
    [4, 5, 6, 7, 8, 9].reduce((total, k) => total + moments[11 * k], 0) - 4 * sum(noise));
  const order = power.map((_, k) => k).sort((a, b) => power[b] - power[a] || a - b).slice(0, MOST_TILES);
  return order.sort((a, b) => a - b).map((k) => tiles[k]);
}

/** Sums of q and d along an axis of every tile, and the spread of k from the component across it. */
function planesAlong(tiles, [a, b]) {
  const planes = tiles.map(({ moments, noise }) => {
    const s = (i, j) => Array.from({ length: 9 }, (_, k) => moments[(1 + 3 * i + Math.floor(k / 3)) * 10 + 1 + 3 * j + (k % 3)]);
    const s00 = s(0, 0), s01 = s(0, 1), s02 = s(0, 2), s11 = s(1, 1), s12 = s(1, 2), s22 = s(2, 2), s21 = transpose(s12);
    const N = [noise[0], 0, 0, 0, noise[1], 0, 0, 0, noise[2]], total = sum(noise);
    const all = mix([a * a, s11], [b * b, s22], [a * b, s12], [a * b, s21]);
    const other = mix([b * b, s11], [a * a, s22], [-a * b, s12], [-a * b, s21]);
    const sq = mix([a, s01], [b, s02]), so = mix([a, s02], [-b, s01]), qs = transpose(sq);
    const oq = mix([a * a, s21], [-b * b, s12], [a * b, s22], [-a * b, s11]);
    const dd = mix([1, s00], [-1, sq], [-1, qs], [1, all], [-3, N]), qd = mix([1, qs], [-1, all], [2, N]), qq = mix([1, all], [-2, N]);
    const diffuse = Math.max(trace(dd), 1e-9), along = Math.max(trace(qq), 1e-9), leak = LEAK ** 2 * along;
    const shared = trace(so) - trace(oq), power = Math.max(trace(other) - 2 * total, 0);
    const middle = Math.max(shared ** 2 / diffuse - leak, 0) / diffuse;
    const inside = Math.min(Math.max(Math.max(power - leak, 0) / diffuse - middle, 0), 0.05);
    return { qq, qd, dd, across: power / along, diffuse, middle: Math.min(middle, 0.1), inside };
  });
  const limit = median(planes.map(({ diffuse }) => diffuse)), weights = planes.map(({ diffuse }) => Math.min(diffuse, limit));
  const total = sum(weights), average = (name) => planes.reduce((found, own, k) => found + (weights[k] / total) * own[name], 0);
  const middle = average("middle"), inside = average("inside");
  for (const own of planes) {
    own.spread = LEAST_K ** 2 + OWN_K * own.middle + MEAN_K * middle;
    own.jitter = LEAST_JITTER ** 2 + OWN_JITTER * own.inside + MEAN_JITTER * inside;
  }
  return planes;
}

/** Linearised least squares of a tile at a colour and its k, with that k eliminated. */
function castVote({ qq, qd, dd, spread, jitter }, x, k) {
  const s = [Math.exp(-x[0]), 1, Math.exp(-x[1])], scaled = (m) => m.map((v, i) => v * s[Math.floor(i / 3)] * s[i % 3]);
  const Q = scaled(qq), M = scaled(qd), D = scaled(dd), T = transpose(M);
  const beside = [];
  for (const p of BESIDE) for (const q of BESIDE) beside.push(p.reduce((t, v, i) => t + v * (D[3 * i] * q[0] + D[3 * i + 1] * q[1] + D[3 * i + 2] * q[2]), 0));
  const share = jitter / INDEPENDENT, W = invert2([1 + share * beside[0], share * beside[1], share * beside[2], 1 + share * beside[3]]);
  const metric = Array.from({ length: 9 }, (_, at) => {
    const i = Math.floor(at / 3), j = at % 3;
    return BESIDE[0][i] * (W[0] * BESIDE[0][j] + W[1] * BESIDE[1][j]) + BESIDE[1][i] * (W[2] * BESIDE[0][j] + W[3] * BESIDE[1][j]);
  });
  const dot = (m) => metric.reduce((total, v, i) => total + v * m[i], 0);
  const certainty = Math.max(dot(D), 0) + 1 / spread, unknown = 1 / certainty + jitter;
  let power = sum(mix([1, Q], [-k, M], [-k, T], [k * k - unknown, D])) / 9;
  const lit = power > 0 ? 1 : 0;
  power *= lit;
  const columns = (m) => [0, 1, 2].map((j) => ((m[j] + m[3 + j] + m[6 + j]) / 3) * lit);
  const toDiffuse = columns(mix([1, M], [-k, D])), toPolarized = columns(mix([1, Q], [-k, T], [-unknown, D]));
  const rows = (v) => [0, 6].map((i) => metric[i] * v[0] + metric[i + 1] * v[1] + metric[i + 2] * v[2]);
  const coupling = rows(toDiffuse), pull = rows(toPolarized), known = dot(M);
  return {
    coupling, known, certainty,
    information: [power * metric[0] - coupling[0] ** 2 / certainty, power * metric[2] - (coupling[0] * coupling[1]) / certainty,
      power * metric[8] - coupling[1] ** 2 / certainty],
    pull: pull.map((v, i) => v - (coupling[i] * known) / certainty),
  };
}

/** Votes of all tiles to their robust mean: log-ratios x (ln R/G, ln B/G), votes (rr, rb, bb) and what pulls remain. */
function iterate(planes) {
  const prior = 1 / SPREAD ** 2, trust = planes.map(({ across }) => 1 / (1 + (across / ACROSS) ** 2));
  let x = [0, 0], k = planes.map(() => 0), votes = [], rest = [];
  for (let step = 0; step < STEPS; step++) {
    const casts = planes.map((own, t) => castVote(own, x, k[t])), total = [prior, 0, prior], target = [-prior * x[0], -prior * x[1]];
    const pulls = [];
    votes = casts.map(({ information: [a, b, d], pull }, t) => {
      const parts = eigen2(a, b, d).map(([value, vector]) => {
        const own = Math.max(value, 0), share = 1 / (1 + VOTE_ERROR ** 2 * own);
        return { own, share, vector, turned: own > 0 ? vector[0] * pull[0] + vector[1] * pull[1] : 0 };
      });
      const disagreement = parts.reduce((found, { own, share, turned }) => found + (turned ** 2 * share) / Math.max(own, 1e-9), 0);
      const weight = step ? (trust[t] * (FREEDOM + 2)) / (FREEDOM + disagreement) : trust[t];
      const vote = [0, 0, 0], own = [0, 0];
      for (const { own: value, share, vector: [p, q], turned } of parts) {
        const v = weight * value * share, u = weight * turned * share;
        vote[0] += v * p * p; vote[1] += v * p * q; vote[2] += v * q * q;
        own[0] += u * p; own[1] += u * q;
      }
      pulls.push(own);
      vote.forEach((v, i) => (total[i] += v));
      own.forEach((v, i) => (target[i] += v));
      return vote;
    });
    const inverse = invert2([total[0], total[1], total[1], total[2]]);
    let change = [inverse[0] * target[0] + inverse[1] * target[1], inverse[2] * target[0] + inverse[3] * target[1]];
    const largest = Math.max(...change.map(Math.abs)), limit = Math.min(1, LARGEST_STEP / Math.max(largest, 1e-12));
    change = change.map((v) => v * limit);
    x = x.map((v, i) => v + change[i]);
    k = casts.map(({ known, coupling, certainty }) =>
      Math.min(Math.max((known - coupling[0] * change[0] - coupling[1] * change[1]) / certainty, -MAX_K), MAX_K));
    rest = pulls.map((own, t) => [own[0] - votes[t][0] * change[0] - votes[t][1] * change[1],
      own[1] - votes[t][1] * change[0] - votes[t][2] * change[1]]);
    if (step > 3 && Math.max(...change.map(Math.abs)) < LAST_STEP) break;
  }
  return { x, votes, rest };
}

/** Log-ratios of the lamp and what the fit shows about their error: scatter, across, change, lean. */
function fitColor(tiles, axis) {
  const planes = planesAlong(tiles, axis), { x, votes, rest } = iterate(planes), prior = 1 / SPREAD ** 2;
  const total = [prior, 0, 0, prior], remains = [prior, 0, 0, prior];
  votes.forEach(([a, b, d], t) => {
    const [p, q] = rest[t];
    [a, b, b, d].forEach((v, i) => (total[i] += v));
    [p * p, p * q, p * q, q * q].forEach((v, i) => (remains[i] += v));
  });
  const spread = invert2(total), scatter = times2(times2(spread, remains), spread);
  const s = [Math.exp(-x[0]), 1, Math.exp(-x[1])], scaled = (m) => m.reduce((found, v, i) => found + v * s[Math.floor(i / 3)] * s[i % 3], 0);
  const glossy = planes.map(({ qq, dd }) => Math.sqrt(Math.max(scaled(qq), 0) / Math.max(scaled(dd), 1e-9)));
  const clear = planes.map((own, t) => glossy[t] / Math.sqrt(own.spread)), bound = quantile(clear, 0.75);
  const [best, others] = [true, false].map((wanted) => iterate(planes.filter((_, t) => clear[t] > bound === wanted)).x);
  const casts = planes.map((own) => castVote(own, x, 0));
  const power = casts.map(({ information: [a, b, d] }) =>
    sum(eigen2(a, b, d).map(([value]) => Math.max(value, 0) / (1 + VOTE_ERROR ** 2 * Math.max(value, 0)))));
  const all = Math.max(sum(power), 1e-12), weigh = (values) => power.reduce((found, own, t) => found + (own / all) * values[t], 0);
  const k = casts.map(({ known, certainty }) => known / certainty), lit = planes.map(({ dd }) => dd[0] * s[0] ** 2 + dd[4] + dd[8] * s[2] ** 2);
  const limit = median(lit), light = lit.map((v) => Math.max(Math.min(v, limit), 0)), weighed = (f) => light.reduce((found, v, t) => found + v * f(k[t]), 0);
  const lean = weighed((v) => v) / Math.max(Math.sqrt(sum(light) * weighed((v) => v * v)), 1e-12);
  return { x, scatter, lean, change: [best[0] - others[0], best[1] - others[1]],
    across: weigh(planes.map(({ across }) => Math.min(across, 3))) };
}

/** The light of a fit to a frame of these tiles. */
function asLight(fit, tiles) {
  const { good, chance } = expectedErrors(fit);
  const [red, green, blue] = [1, 2, 3].map((k) => Math.max(sum(tiles.map(({ moments }) => moments[k])), 1e-9));
  const { x, off, right } = likelyLamp(fit.x, good, chance, [Math.log(red / green), Math.log(blue / green)]);
  const error = Math.min(off, UNKNOWN_DEG);
  return { x, error, sure: error <= SURE_DEG && right >= LIKELY_RIGHT, metal: 0 };
}

/** The likely lamp of a frame of this mean colour: white, or the mean of what else is likely; its mean error, and
 *  the chance that the fit did not go astray. */
function likelyLamp(fitted, good, astray, mean) {
  [fitted, mean] = [fitted, mean].map((x) => x.map(limited));
  const chances = (lamp) => {
    const seen = normal(lamp, mean, BODIES_SPREAD);
    return [(1 - astray) * seen, astray * seen * normal(lamp, fitted, ASTRAY_SPREAD)];
  };
  const [right, wrong] = chances([0, 0]), spread = (GOOD_SPREAD * good * Math.PI) / 180;
  const ofWhite = WHITE_SHARE * (right * normal([0, 0], fitted, spread) + wrong);
  const [from, to, count] = GRID, step = (to - from) / (count - 1), ofFit = priorDensity(fitted) * chances(fitted)[0];
  const others = Array.from({ length: count * count }, (_, k) => {
    const lamp = [from + (k % count) * step, from + Math.floor(k / count) * step];
    return { lamp, own: priorDensity(lamp) * step ** 2 * chances(lamp)[1] };
  });
  const colored = ofFit + sum(others.map(({ own }) => own));
  const x = ofWhite > LIKELY_WHITE * (ofWhite + colored) ? [0, 0]
    : fitted.map((v, i) => (ofFit * v + sum(others.map(({ lamp, own }) => own * lamp[i]))) / colored);
  const off = ofWhite * angleDeg([0, 0], x) + ofFit * Math.hypot(good, angleDeg(fitted, x)) +
    sum(others.map(({ lamp, own }) => own * angleDeg(lamp, x)));
  const all = ofWhite + colored;
  return { x, off: off / all, right: (ofWhite - WHITE_SHARE * wrong + ofFit) / all };
}

/** Density of log-ratios around a center, each of this standard deviation. */
const normal = ([r, b], center, spread) =>
  Math.exp(-((r - center[0]) ** 2 + (b - center[1]) ** 2) / (2 * spread ** 2)) / (2 * Math.PI * spread ** 2);

/** Density of lamps before a frame is seen, but for exactly white ones. */
function priorDensity(x) {
  const [length, width] = WARM_SPREAD, soft = (v) => Math.tanh(v / (2 * RAW_EDGE));
  const raw = RAW_LAMPS.reduce((all, [least, most], k) => (all * (soft(x[k] - least) - soft(x[k] - most))) / 2 / (most - least), 1);
  const along = x[0] * WARM[0] + x[1] * WARM[1], across = x[0] * WARM[1] - x[1] * WARM[0];
  const warm = Math.exp(-((along / length) ** 2 + (across / width) ** 2) / 2) / (2 * Math.PI * length * width);
  const led = x.every((v) => Math.abs(v) < LED_LIMIT) ? normal(x, [0, 0], LED_SPREAD) : 0;
  return RAW_SHARE * raw + WARM_SHARE * warm + ANY_SHARE * normal(x, [0, 0], ANY_SPREAD) + LED_SHARE * led;
}

/** Mean angle [degrees] by which fits like this one are off that were not led astray; the chance that it was. */
function expectedErrors({ x, scatter, across, change, lean }) {
  const moved = angleDeg(change, [0, 0]), spread = spreadDeg(x, scatter), shown = [across, moved];
  const logit = ASTRAY.reduce((found, [a, b], k) => found + a * Math.log(shown[k] + b), ASTRAY_BIAS + ASTRAY_LEAN * lean);
  return { good: GOOD[0] * (moved + 0.1) ** GOOD[1] * (spread + 0.03) ** GOOD[2], chance: 1 / (1 + Math.exp(-logit)) };
}

const limited = (ratio) => Math.min(Math.max(ratio, -LARGEST_RATIO), LARGEST_RATIO);

/** Angle [degrees] between two colours of log-ratios. */
function angleDeg(one, other) {
  const [p, q] = [one, other].map(([r, b]) => [Math.exp(limited(r)), 1, Math.exp(limited(b))]), dot = (u, v) => sum(u.map((value, i) => value * v[i]));
  return (Math.acos(Math.min(1, dot(p, q) / Math.sqrt(dot(p, p) * dot(q, q)))) * 180) / Math.PI;
}

/** Root mean square angle of colours whose log-ratios have a covariance around x. */
function spreadDeg(x, covariance) {
  const color = [Math.exp(x[0]), 1, Math.exp(x[1])], square = sum(color.map((v) => v * v));
  const column = (c) => color.map((v, i) => ((i === c ? 1 : 0) - (v * color[c]) / square) * color[c]);
  const [p, q] = [column(0), column(2)], dot = (u, v) => sum(u.map((value, i) => value * v[i]));
  const power = covariance[0] * dot(p, p) + (covariance[1] + covariance[2]) * dot(p, q) + covariance[3] * dot(q, q);
  return (Math.sqrt(Math.max(power, 0) / square) * 180) / Math.PI;
}

/** Which tiles hold hardly any diffuse light. */
const onlySpecular = (tiles, axis) =>
  planesAlong(tiles, axis).map(({ qq, dd }) => trace(qq) > PURE_SPECULAR ** 2 * Math.max(trace(dd), 1e-9));

/** True for colours, relative to the lamp's, of gold, copper and what lies between. */
function isMetal([r, b]) {
  const line = [GOLD[0] - COPPER[0], GOLD[1] - COPPER[1]], own = [r - COPPER[0], b - COPPER[1]];
  const place = Math.min(Math.max((own[0] * line[0] + own[1] * line[1]) / (line[0] ** 2 + line[1] ** 2), 0), 1);
  return Math.hypot(own[0] - place * line[0], own[1] - place * line[1]) < METAL_DISTANCE;
}

/** Share of the lit points that are in tiles of coloured metal. */
function metalShare(tiles, axis, lamp) {
  const specular = onlySpecular(tiles, axis), planes = planesAlong(tiles, axis);
  const metal = planes.map(({ qq }, t) => {
    const [r, g, b] = [qq[0], qq[4], qq[8]].map((v) => Math.max(v, 1e-12));
    return specular[t] && isMetal([0.5 * Math.log(r / g) - lamp[0], 0.5 * Math.log(b / g) - lamp[1]]);
  });
  return sum(tiles.map(({ count }, t) => (metal[t] ? count : 0))) / Math.max(sum(tiles.map(({ count }) => count)), 1);
}
