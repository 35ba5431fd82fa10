// The network joint-fast in strips of rows: what polsep/networks/run.py does, by ONNX Runtime Web.
//
// The network (tools/web_models.py) takes frames [1, 2, H, W] in Sony's order: linear samples in white light, and which
// of them clip. Strips overlap by all that an output depends on, so they agree with the whole frame.

import { linearSamples } from "./analytic.js";
import { channelsOf, orient, spansOf, turnedPlaces } from "./layout.js";
import { clipLevel } from "./levels.js";
import { thumbnailOf } from "./thumbnail.js";

/** Raw rows around a strip that its images depend on. Raw samples of all strips that run at once, and of one. */
const MARGIN = 112, AT_ONCE = 5.2e6, SAMPLES = 1.9e6;

/** First and last row that is kept of every strip; strips begin at multiples of the network's grid, 16. */
function cutRows(height, width, workers) {
  const most = Math.max(Math.floor((Math.min(SAMPLES, AT_ONCE / workers) / width - 2 * MARGIN) / 16), 4) * 16;
  const count = Math.ceil(Math.ceil(height / most) / workers) * workers;  // as many for each worker
  const each = Math.max(Math.ceil(height / count / 16), 4) * 16;
  return Array.from({ length: Math.ceil(height / each) }, (_, k) => [k * each, Math.min((k + 1) * each, height)]);
}

/** Planes of a turned frame at half resolution, filled strip by strip. */
class Planes {
  constructor(names, height, width) {
    this.height = height;
    this.width = width;
    for (const [name, count] of Object.entries(names))
      this[name] = Array.from({ length: count }, () => new Float32Array(height * width));
  }
}

/**
 * Images as `separateAnalytic` gives them, with `error` and `sums`, of a mosaic in a light.
 * `network`: {run(samples, rows, width, thumbnail), seesFrame, count of strips at once}; only one that sees the frame is
 * given a thumbnail. `progress(share)` is called after every strip.
 */
export async function separateJoint(mosaic, light, network, progress) {
  const way = orient(mosaic.height, mosaic.width, mosaic.layout), { rows, cols } = turnedPlaces(way);
  const H = rows.length, W = cols.length, colors = channelsOf(mosaic.layout), full = clipLevel(mosaic);
  const samples = linearSamples(mosaic, light);
  const planes = new Planes({ diffuse: colors, specular: 1, error: 2, s1: colors, s2: colors }, H / 2, W / 2);
  const residual = new Float32Array((H * W) / 16);
  const strips = cutRows(H, W, network.count), clips = (place) => (mosaic.data[place] >= full ? 1 : 0);
  const thumbnail = network.seesFrame ? thumbnailOf(mosaic.layout, { rows, cols }, samples, clips) : null;
  let next = 0, done = 0;

  async function takeStrip([first, last]) {
    const top = Math.max(first - MARGIN, 0), bottom = Math.min(last + MARGIN, H), size = (bottom - top) * W;
    const frame = new Float32Array(2 * size);
    for (let r = top, at = 0; r < bottom; r++)
      for (let c = 0; c < W; c++, at++) {
        const place = rows[r] + cols[c];
        frame[at] = samples[place];
        frame[size + at] = clips(place);
      }
    const images = await network.run(frame, bottom - top, W, thumbnail);
    for (const name of ["diffuse", "specular", "error", "s1", "s2"])
      planes[name].forEach((plane, c) => {
        const begin = (c * size) / 4 + ((first - top) / 2) * (W / 2);
        plane.set(images[name].subarray(begin, begin + ((last - first) * W) / 4), (first / 2) * (W / 2));
      });
    const begin = ((first - top) * W) / 16;
    residual.set(images.residual.subarray(begin, begin + ((last - first) * W) / 16), (first * W) / 16);
    progress(++done / strips.length);
  }

  await Promise.all(Array.from({ length: network.count }, async () => {
    while (next < strips.length) await takeStrip(strips[next++]);
  }));
  return turnBack(planes, residual, colors, way, clippedCells(mosaic, full));
}

/** Bits of every cell: 1 where a sample near it clips, 2 where all of a cell near it do; a cell has one colour. */
function clippedCells({ data, height, width, layout }, full) {
  const [top, left] = layout.origin, h = (height - top) >> 1, w = (width - left) >> 1;
  const own = new Uint8Array(h * w), near = new Uint8Array(h * w);
  let some = false;
  for (let i = 0, at = 0; i < h; i++)
    for (let j = 0; j < w; j++, at++) {
      const k = (top + 2 * i) * width + left + 2 * j;
      const count = (data[k] >= full) + (data[k + 1] >= full) + (data[k + width] >= full) + (data[k + width + 1] >= full);
      own[at] = count === 4 ? 3 : count ? 1 : 0;
      some ||= count > 0;
    }
  if (!some) return near;
  for (let i = 0; i < h; i++)
    for (let j = 0; j < w; j++) {
      if (!own[i * w + j]) continue;
      for (let y = Math.max(i - 1, 0); y <= Math.min(i + 1, h - 1); y++)
        for (let x = Math.max(j - 1, 0); x <= Math.min(j + 1, w - 1); x++) near[y * w + x] |= own[i * w + j];
    }
  return near;
}

/** Planes of a turned frame as images of the frame's own whole cells; s1 and s2 change sign as in Stokes' frame. */
function turnBack(planes, residual, colors, way, near) {
  const [[top, tall], [left, wide]] = spansOf(way);
  const [height, width] = way.turn ? [wide / 2, tall / 2] : [tall / 2, wide / 2], n = height * width;
  const out = {
    height, width, colors,
    diffuse: new Float32Array(n * colors), specular: new Float32Array(n * colors), error: new Float32Array(2 * n),
    s0: new Float32Array(n), s1: new Float32Array(n), s2: new Float32Array(n),
    valid: near.map((bits) => (bits & 2 ? 0 : 1)), clipped: near.map((bits) => bits & 1),
  };
  const sign1 = way.turn ? -1 : 1, sign2 = way.down !== way.across ? -1 : 1;
  for (let i = 0, at = 0; i < height; i++)
    for (let j = 0; j < width; j++, at++) {
      let [r, c] = way.turn ? [j, i] : [i, j];
      r = top / 2 + (way.down ? tall / 2 - 1 - r : r);
      c = left / 2 + (way.across ? wide / 2 - 1 - c : c);
      const from = r * planes.width + c, tau = planes.specular[0][from];
      out.s0[at] = tau;
      for (let k = 0; k < colors; k++) {
        const value = planes.diffuse[k][from];
        out.diffuse[at * colors + k] = value;
        out.specular[at * colors + k] = tau;
        out.s0[at] += value / colors;
        out.s1[at] += (sign1 * planes.s1[k][from]) / colors;
        out.s2[at] += (sign2 * planes.s2[k][from]) / colors;
      }
      out.error[2 * at] = planes.error[0][from];
      out.error[2 * at + 1] = planes.error[1][from];
    }
  return { ...out, sums: sumsOf(planes, residual, colors, way) };
}

/** Sums over all that the network saw, in the frame's own orientation, as `tallyOf` (report.js) names them. */
function sumsOf({ height, width, ...planes }, residual, colors, { turn, down, across }) {
  const sums = { pixels: height * width, s0: 0, specular: 0, power: 0, along: 0, across: 0, residual: 0 };
  for (let k = 0; k < sums.pixels; k++) {
    const tau = planes.specular[0][k];
    let body = 0, x = 0, y = 0;
    for (let c = 0; c < colors; c++) {
      body += planes.diffuse[c][k] / colors;
      x += planes.s1[c][k] / colors;
      y += planes.s2[c][k] / colors;
    }
    sums.s0 += tau + body;
    sums.specular += tau;
    sums.power += tau * Math.sqrt(x * x + y * y);
    sums.along += tau * x;
    sums.across += tau * y;
  }
  for (const value of residual) sums.residual += 4 * Math.SQRT2 * value;  // rms of two components, of four cells each
  if (turn) sums.along = -sums.along;
  if (down !== across) sums.across = -sums.across;
  return sums;
}
