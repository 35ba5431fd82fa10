// Bilinear demosaicking at half resolution and the analytic split: twins of polsep/demosaic/bilinear.py and
// polsep/separation/analytic.py. A mosaic is {data: Float32Array, height, width, layout, black, white}; images are
// Float32Arrays in reading order, at one pixel per polarizer cell, in white light.

import { anglesOf, channelsOf, filterAt } from "./layout.js";
import { clipLevel } from "./levels.js";

/** Stokes vectors of four analysers: rows of the pseudo-inverse [3][4] of Dave et al. 2022, Eqs. 11 and 12. */
export function stokesInverse(degrees) {
  const rows = degrees.map((t) => [0.5, 0.5 * Math.cos((t * Math.PI) / 90), 0.5 * Math.sin((t * Math.PI) / 90)]);
  const normal = [0, 1, 2].map((i) => [0, 1, 2].map((j) => rows.reduce((sum, row) => sum + row[i] * row[j], 0)));
  const [[a, b, c], [, d, e], [, , f]] = normal;
  const adjoint = [[d * f - e * e, c * e - b * f, b * e - c * d], [c * e - b * f, a * f - c * c, b * c - a * e],
    [b * e - c * d, b * c - a * e, a * d - b * b]];
  const det = a * adjoint[0][0] + b * adjoint[0][1] + c * adjoint[0][2];
  const exact = (x) => Math.round(x * 1e12) / 1e12;  // rounding would polarize
  return adjoint.map((own) => rows.map((row) => exact((own[0] * row[0] + own[1] * row[1] + own[2] * row[2]) / det)));
}

/** Correlate an image with (side, middle, side) along rows, or `down` columns; borders mirror. */
function correlate(x, out, [h, w], side, middle, down) {
  if (down)
    for (let r = 0; r < h; r++) {
      const up = (r > 0 ? r - 1 : Math.min(1, h - 1)) * w, here = r * w, below = (r < h - 1 ? r + 1 : Math.max(h - 2, 0)) * w;
      for (let c = 0; c < w; c++) out[here + c] = side * (x[up + c] + x[below + c]) + middle * x[here + c];
    }
  else
    for (let r = 0; r < h; r++) {
      const first = r * w, last = first + w - 1;
      for (let k = first + 1; k < last; k++) out[k] = side * (x[k - 1] + x[k + 1]) + middle * x[k];
      out[first] = 2 * side * x[Math.min(first + 1, last)] + middle * x[first];
      out[last] = 2 * side * x[Math.max(last - 1, first)] + middle * x[last];
    }
  return out;
}

/** Shift a plane by a quarter sample to the cell's centre, in place: weights 3/4 and 1/4, along rows and columns. */
function toCenter(x, [h, w], [row, col]) {
  for (let k = 0, n = h; k < n; k++) {
    const r = row ? n - 1 - k : k, next = row ? -w : w, last = k === n - 1;
    for (let at = r * w; at < (r + 1) * w; at++) x[at] = last ? x[at] : 0.75 * x[at] + 0.25 * x[at + next];
  }
  for (let r = 0; r < h; r++) {
    const first = r * w;
    if (col) for (let at = first + w - 1; at > first; at--) x[at] = 0.75 * x[at] + 0.25 * x[at - 1];
    else for (let at = first; at < first + w - 1; at++) x[at] = 0.75 * x[at] + 0.25 * x[at + 1];
  }
}

/** Call `use(analyser, channel, image)` with every analyser of `samples [H, W]` in every colour at the cells' centres. */
function interpolate(samples, { height, width, layout }, use) {
  const [top, left] = layout.origin, h = (height - top) >> 1, w = (width - left) >> 1, size = [h, w];
  const one = new Float32Array(h * w), two = new Float32Array(h * w), masked = new Float32Array(h * w);
  anglesOf(layout).forEach((angle, k) => {
    const spot = layout.polarizer.indexOf(angle), place = [spot >> 1, spot & 1];
    for (let c = 0; c < channelsOf(layout); c++) {
      masked.fill(0);
      for (let cell = 0; cell < 4; cell++) {  // of a 2x2 block of cells, those of this colour
        if (layout.bayer && layout.bayer[cell] !== "RGB"[c]) continue;
        for (let i = cell >> 1; i < h; i += 2) {
          const row = (top + 2 * i + place[0]) * width + left + place[1];
          for (let j = cell & 1; j < w; j += 2) masked[i * w + j] = samples[row + 2 * j];
        }
      }
      let image = masked;
      if (layout.bayer && c !== 1) image = correlate(correlate(masked, one, size, 0.5, 1, false), two, size, 0.5, 1, true);
      else if (layout.bayer) {
        correlate(masked, one, size, 0.25, 0.5, false);
        correlate(masked, two, size, 0.25, 0.5, true);
        for (let at = 0; at < one.length; at++) two[at] += one[at];
        image = two;
      }
      toCenter(image, size, place);
      use(k, c, image);
    }
  });
}

/** The samples [H, W] of a mosaic with black at 0 and white at 1, under white light. */
export function linearSamples({ data, height, width, layout, black, white }, light) {
  const out = new Float32Array(data.length);
  for (let k = 0; k < 16; k++) {
    const gain = 1 / ((white - black) * light[filterAt(layout, k >> 2, k & 3)[1]]);
    for (let r = k >> 2; r < height; r += 4)
      for (let at = r * width + (k & 3), end = (r + 1) * width; at < end; at += 4) out[at] = (data[at] - black) * gain;
  }
  return out;
}

/**
 * The paper's first estimate: specular = sqrt(s1^2 + s2^2), at most s0; diffuse = s0 - specular; clipped samples at
 * face value (Dave et al. 2022, Eqs. 15-18). {height, width, colors, diffuse, specular (per colour), s1, s2 (means
 * over colours), valid}.
 */
export function separateAnalytic(mosaic, light) {
  const { layout, data } = mosaic, colors = channelsOf(layout), inverse = stokesInverse(anglesOf(layout));
  const h = (mosaic.height - layout.origin[0]) >> 1, w = (mosaic.width - layout.origin[1]) >> 1, n = h * w;
  const stokes = Array.from({ length: 3 * colors }, () => new Float32Array(n));
  interpolate(linearSamples(mosaic, light), mosaic, (k, c, image) => {
    for (let i = 0; i < 3; i++) {
      const target = stokes[3 * c + i], weight = inverse[i][k];
      for (let at = 0; at < n; at++) target[at] += weight * image[at];
    }
  });
  const valid = new Uint8Array(n).fill(1), full = clipLevel(mosaic);
  if (data.some((value) => value >= full))
    interpolate(data.map((value) => +(value >= full)), mosaic, (k, c, image) => {
      for (let at = 0; at < n; at++) if (image[at] > 0) valid[at] = 0;
    });
  const diffuse = new Float32Array(n * colors), specular = new Float32Array(n * colors);
  const s1 = new Float32Array(n), s2 = new Float32Array(n), s0 = new Float32Array(n);
  for (let c = 0; c < colors; c++)
    for (let at = 0; at < n; at++) {
      const x = stokes[3 * c][at], y = stokes[3 * c + 1][at], z = stokes[3 * c + 2][at], total = Math.max(x, 0);
      specular[at * colors + c] = Math.min(Math.sqrt(y * y + z * z), total);
      diffuse[at * colors + c] = total - specular[at * colors + c];
      s0[at] += x / colors;
      s1[at] += y / colors;
      s2[at] += z / colors;
    }
  const clipped = valid.map((own) => 1 - own);
  return { height: h, width: w, colors, diffuse, specular, s0, s1, s2, valid, clipped };
}
