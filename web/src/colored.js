// Specular light that is coloured (metals), kept by bodies, or of a lamp that is not fully polarized: twin of
// polsep/separation/colored_specular.py, lamp_polarization.py and retained_polarization.py, which explain all of it.
// Images are in white light; `Periods` have a pixel per 4x4 period of the mosaic, three colours in one array each.

import { linearSamples, stokesInverse } from "./analytic.js";
import { anglesOf, channelsOf, filterAt } from "./layout.js";
import { mean, sum, weightedMedian } from "./numbers.js";

const SLOPES = [0.4, 0.7], MIN_SIZE = 80, MANY = 1500, MIN_CONTRAST = 1e-4, MIN_RELATIVE = 1e-2, MIN_SHARE = 0.002, MAX_GAIN = 1.5;
const LAMP = { side: 8, places: 12, variance: 5e-4, white: 0.15, sample: 0.9, part: [0.04, 0.5], errors: 3, beside: 0.5 };
const MIN_HUES = 0.03, MEDIAN_ERROR = 1.4826 * 1.25;
const KEPT = { places: 16, side: 4, least: 20, contrast: 3e-4, relative: 3e-3, brightness: 0.03, width: 0.02, slope: 0.4,
  range: [0.04, 0.15], across: 0.03, alike: 0.75, caution: 0.005, steps: 10 };

/**
 * Change images where such light is proven; {report, remark}. `sums`: of `tallyOf`, whose specular light grows too.
 */
export function colorSpecular(images, mosaic, light, sums) {
  const report = { colored_specular: 0, retained_polarization: 0, lamp_dolp: 1 };
  const [top, left] = mosaic.layout.origin, sides = [mosaic.height - top, mosaic.width - left];
  if (channelsOf(mosaic.layout) !== 3 || Math.min(...sides) < MIN_SIZE) return { report };
  const { diffuse, specular, valid } = images;
  const unpolarized = findUnpolarized(images, Math.max(...light, 1)), before = sum(specular);
  if (unpolarized)
    for (let k = 0; k < diffuse.length; k++) {
      const moved = Math.min(unpolarized * specular[k], diffuse[k]);
      diffuse[k] -= moved;
      specular[k] += moved;
    }
  const see = (thin) => seePeriods(images, mosaic, light, sums, thin), some = see(true);
  const retained = findRetained(Math.min(...sides) <= MANY ? see(false) : some);
  let share = null, seen = null;
  if (mean(partOf(some).map((v) => +(v > 0.5))) >= MIN_SHARE) {
    seen = see(false);
    const found = findColored(seen);
    report.colored_specular = mean(found);
    share = mean(found.map((v) => +(v > 0.5))) >= MIN_SHARE ? found : null;
    if (!share) report.colored_specular = 0;
  }
  const all = share ? sum(diffuse) + sum(specular) : 0;
  if (share) metallic(images, seen, share, retained);
  else if (retained)
    for (let k = 0; k < diffuse.length; k++) {
      specular[k] += retained * diffuse[k];
      diffuse[k] *= 1 - retained;
    }
  Object.assign(report, { retained_polarization: retained, lamp_dolp: 1 / (1 + unpolarized) });
  sums.specular += (sum(specular) - before) / 3;
  if (share) sums.s0 += (sum(diffuse) + sum(specular) - all) / 3; // all light of metals is what their polarization says
  sums.valid = sum(valid);
  const remark = unpolarized && `a fully polarized lamp was expected, found one of ${Math.round(100 / (1 + unpolarized))}%: what ` +
    "its highlights leave in the diffuse image moves to the specular one, but not in films; a better polarizer before the lamp separates more";
  return { report, remark };
}

/** Where the diffuse image is specular by `share`, all polarized light becomes specular, in its own colour. */
function metallic({ diffuse, specular, height, width, valid }, seen, share, retained) {
  const n = seen.height * seen.width, ratio = new Float32Array(3 * n);
  for (let k = 0; k < 3 * n; k++)
    ratio[k] = Math.min(Math.max(Math.min(Math.max(seen.polarized[k], 0), seen.s0[k]) / Math.max(seen.total[k], 1e-4), 0), MAX_GAIN);
  const at = (count, size) => Array.from({ length: count }, (_, k) => {
    const place = Math.max(((k + 0.5) * size) / count - 0.5, 0), first = Math.floor(place);
    return [first, Math.min(first + 1, size - 1), place - first];
  });
  const rows = at(height, seen.height), cols = at(width, seen.width);
  for (let i = 0, k = 0; i < height; i++)
    for (let j = 0; j < width; j++, k++) {
      const [r, r2, down] = rows[i], [c, c2, across] = cols[j];
      const read = (image, step, channel) => {
        const one = (row, col) => image[(row * seen.width + col) * step + channel];
        return (1 - down) * ((1 - across) * one(r, c) + across * one(r, c2)) + down * ((1 - across) * one(r2, c) + across * one(r2, c2));
      };
      const part = read(share, 1, 0);
      if (part >= 0.5) valid[k] = 0;
      for (let channel = 0; channel < 3; channel++) {
        const own = 3 * k + channel, d = diffuse[own], s = specular[own], reflected = s + retained * d;
        diffuse[own] = (1 - part) * (1 - retained) * d;
        specular[own] = reflected + part * (read(ratio, 3, channel) * (d + s) - reflected);
      }
    }
}

/** Stokes images of the samples along and across the lamp's polarization, and a method's images, period by period. */
function seePeriods(images, mosaic, light, sums, thin) {
  const { layout } = mosaic, [top, left] = layout.origin, step = thin ? 3 : 1, samples = linearSamples(mosaic, light);
  const rows = (mosaic.height - top) >> 2, cols = (mosaic.width - left) >> 2;
  const h = Math.ceil(rows / step), w = Math.ceil(cols / step), angles = anglesOf(layout), inverse = stokesInverse(angles);
  const filters = Array.from({ length: 16 }, (_, k) => {
    const [angle, channel] = filterAt(layout, top + (k >> 2), left + (k & 3));
    return { row: top + (k >> 2), col: left + (k & 3), channel, part: inverse.map((own) => own[angles.indexOf(angle)]) };
  });
  const cells = [0, 1, 2].map((c) => filters.filter(({ channel }) => channel === c).length / 4);
  const names = ["s0", "polarized", "across", "diffuse", "total"];
  const seen = { height: h, width: w, ...Object.fromEntries(names.map((name) => [name, new Float32Array(3 * h * w)])) };
  const length = Math.max(Math.hypot(sums.along, sums.across), 1e-30), [a, b] = [sums.along / length, sums.across / length];
  const range = (k) => [2 * step * k, 2 * step * k + 2]; // a last row or column that is no whole period is left out
  const stokes = new Float64Array(9), light6 = new Float64Array(6);
  for (let i = 0, at = 0; i < h; i++)
    for (let j = 0; j < w; j++, at += 3) {
      stokes.fill(0);
      for (const { row, col, channel, part } of filters) {
        const value = samples[(4 * step * i + row) * mosaic.width + 4 * step * j + col] / cells[channel];
        for (let s = 0; s < 3; s++) stokes[3 * s + channel] += part[s] * value;
      }
      light6.fill(0);
      const [r0, r1] = range(i), [c0, c1] = range(j), share = 1 / ((r1 - r0) * (c1 - c0));
      for (let r = r0; r < r1; r++)
        for (let c = c0, k = 3 * (r * images.width + c0); c < c1; c++, k += 3)
          for (let channel = 0; channel < 3; channel++) {
            light6[channel] += share * images.diffuse[k + channel];
            light6[3 + channel] += share * images.specular[k + channel];
          }
      for (let c = 0; c < 3; c++) {
        seen.s0[at + c] = stokes[c];
        seen.polarized[at + c] = stokes[3 + c] * a + stokes[6 + c] * b;
        seen.across[at + c] = stokes[6 + c] * a - stokes[3 + c] * b;
        seen.diffuse[at + c] = light6[c];
        seen.total[at + c] = light6[c] + light6[3 + c];
      }
    }
  return seen;
}

/** 0 to 1, as the slope of the colours' polarized on their diffuse light lies in SLOPES, period by period. */
function partOf({ polarized, diffuse, total }) {
  return Float32Array.from({ length: total.length / 3 }, (_, k) => {
    const three = (image) => [image[3 * k], image[3 * k + 1], image[3 * k + 2]], body = deviations(three(diffuse));
    const brightness = mean(three(total)), other = deviations(three(polarized));
    const slope = dot(other, body) / (dot(body, body) + MIN_CONTRAST + MIN_RELATIVE * brightness ** 2);
    return Math.min(Math.max((slope - SLOPES[0]) / (SLOPES[1] - SLOPES[0]), 0), 1);
  });
}

const dot = (p, q) => p[0] * q[0] + p[1] * q[1] + p[2] * q[2];
const deviations = (v) => { const m = (v[0] + v[1] + v[2]) / 3; return [v[0] - m, v[1] - m, v[2] - m]; };

/** The part of the diffuse image that is specular, where it fills 3x3 periods. */
function findColored(seen) {
  const { height, width } = seen, part = partOf(seen);
  const around = (image, pick) => image.map((_, k) => {
    const r = Math.floor(k / width), c = k % width;
    let found = image[k];
    for (let i = Math.max(r - 1, 0); i <= Math.min(r + 1, height - 1); i++)
      for (let j = Math.max(c - 1, 0); j <= Math.min(c + 1, width - 1); j++) found = pick(found, image[i * width + j]);
    return found;
  });
  const solid = around(around(part, Math.min), Math.max);
  return part.map((v, k) => Math.min(v, solid[k]));
}

/** True if colours, as unit vectors, are of several hues or saturations. */
function hasHues(bodies) {
  const square = [0, 1, 2].map((c) => {
    const values = bodies.map((body) => body[c]), middle = mean(values);
    return sum(values.map((v) => (v - middle) ** 2)) / (values.length - 1);
  });
  return Math.sqrt(sum(square)) >= MIN_HUES;
}

const lower = (values) => [...values].sort((a, b) => a - b)[(values.length - 1) >> 1];

/** The part of the specular image that is left in the diffuse one, (1 - p) / p; 0 where none is proven. */
function findUnpolarized({ diffuse, specular, height, width }, gain) {
  const shown = [], n = LAMP.side ** 2;
  for (let top = 0; top + LAMP.side <= height; top += LAMP.side)
    for (let left = 0; left + LAMP.side <= width; left += LAMP.side) {
      const color = [0, 0, 0], product = [0, 0, 0];
      let light = 0, square = 0, largest = -Infinity;
      for (let r = top; r < top + LAMP.side; r++)
        for (let c = left, k = 3 * (r * width + left); c < left + LAMP.side; c++, k += 3) {
          const s = (specular[k] + specular[k + 1] + specular[k + 2]) / 3;
          light += s / n;
          square += (s * s) / n;
          for (let i = 0; i < 3; i++) {
            color[i] += diffuse[k + i] / n;
            product[i] += (s * diffuse[k + i]) / n;
          }
          largest = Math.max(largest, s + Math.max(diffuse[k], diffuse[k + 1], diffuse[k + 2]) / 2);
        }
      const size = Math.max(Math.hypot(...color), 1e-9), body = color.map((v) => v / size), variance = square - light ** 2;
      const white = body.map((v) => 1 - v * sum(body)), power = dot(white, white);
      if (variance > LAMP.variance && power > LAMP.white && largest * gain < LAMP.sample) {
        const slope = color.map((v, i) => (product[i] - light * v) / variance);
        const cross = [body[1] * white[2] - body[2] * white[1], body[2] * white[0] - body[0] * white[2], body[0] * white[1] - body[1] * white[0]];
        shown.push({ body, along: dot(slope, white) / power, beside: dot(slope, cross) / power });
      }
    }
  if (shown.length < LAMP.places || !hasHues(shown.map(({ body }) => body))) return 0;
  const along = shown.map((own) => own.along), part = lower(along);
  const error = (MEDIAN_ERROR * lower(along.map((v) => Math.abs(v - part)))) / Math.sqrt(shown.length);
  const beside = Math.abs(lower(shown.map((own) => own.beside)));
  return Math.max(LAMP.part[0], LAMP.errors * error) < part && part < LAMP.part[1] && beside < LAMP.beside * part ? part : 0;
}

/** The share of the diffuse light that keeps the lamp's polarization all over a frame; 0 where none is proven. */
function findRetained({ polarized, across, diffuse, height, width }) {
  const side = Math.max(KEPT.side, Math.floor(Math.min(height, width) / KEPT.places)), slopes = [], weights = [], bodies = [];
  for (let top = 0; top + side <= height; top += side)
    for (let left = 0; left + side <= width; left += side) {
      const sums = [0, 0, 0, 0], body = [0, 0, 0], n = side * side;
      for (let r = top; r < top + side; r++)
        for (let c = left, k = 3 * (r * width + left); c < left + side; c++, k += 3) {
          const three = (image) => [image[k], image[k + 1], image[k + 2]], own = three(diffuse), colors = deviations(own);
          [dot(deviations(three(polarized)), colors), dot(deviations(three(across)), colors), dot(colors, colors), mean(own)]
            .forEach((v, i) => (sums[i] += v / n));
          own.forEach((v, i) => (body[i] += v / n));
        }
      const [first, second, contrast, brightness] = sums;
      if (!(contrast > KEPT.contrast + KEPT.relative * brightness ** 2 && brightness > KEPT.brightness)) continue;
      bodies.push(body.map((v) => v / Math.hypot(...body)));
      if (Math.abs(first / contrast) >= KEPT.slope) continue;
      slopes.push([first / contrast, second / contrast]);
      weights.push(Math.sqrt(contrast));
    }
  if (weights.length < KEPT.least || !hasHues(bodies)) return 0;
  const near = ([p, q]) => slopes.map(([x, y], k) => weights[k] * Math.exp((-0.5 * ((x - p) ** 2 + (y - q) ** 2)) / KEPT.width ** 2));
  const density = slopes.map((place) => sum(near(place)));
  let center = slopes[density.indexOf(Math.max(...density))], own = weights;
  for (let step = 0; step < KEPT.steps; step++) {
    own = near(center);
    center = [0, 1].map((i) => slopes.reduce((total, place, k) => total + place[i] * own[k], 0) / sum(own));
  }
  const share = Math.min(center[0], weightedMedian(slopes.map(([along]) => along), weights)), alike = sum(own) / sum(weights);
  const proven = KEPT.range[0] < share && share < KEPT.range[1] && Math.abs(center[1]) <= KEPT.across && alike <= KEPT.alike;
  return proven ? share - KEPT.caution : 0;
}
