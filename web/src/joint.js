// The network joint-fast in strips of rows: what polsep/networks/run.py does, by ONNX Runtime Web.
//
// The network (tools/web_models.py) takes frames [1, 2, H, W] in Sony's order: linear samples in white light, and which
// of them clip. Strips overlap by all that an output depends on, so they agree with the whole frame.

import { channelsOf, filterAt, orient, spansOf, turnedPlaces } from "./layout.js";
import { clipLevel } from "./levels.js";

/** Raw rows around a strip that its images depend on (tests/test_web.py compares), and raw samples of a strip. */
const MARGIN = 112, SAMPLES = 1.8e6;

/** First and last row that is kept of every strip; strips begin at multiples of the network's grid, 16. */
function cutRows(height, width) {
  const rows = Math.max(Math.floor((SAMPLES / width - 2 * MARGIN) / 16), 4) * 16;
  const count = Math.max(1, Math.ceil(height / rows)), each = Math.ceil(height / count / 16) * 16;
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
 * Images as `separateAnalytic` gives them, with `residual` and `error`, of a mosaic in a light.
 * `run(samples, rows, width)` calls the network; `progress(share)` is told after every strip.
 */
export async function separateJoint(mosaic, light, run, progress) {
  const way = orient(mosaic.height, mosaic.width, mosaic.layout), { rows, cols } = turnedPlaces(way);
  const H = rows.length, W = cols.length, colors = channelsOf(mosaic.layout), full = clipLevel(mosaic);
  const gains = Float32Array.from({ length: 16 }, (_, k) => 1 / ((mosaic.white - mosaic.black) *
    light[filterAt(mosaic.layout, k >> 2, k & 3)[1]]));
  const planes = new Planes({ diffuse: colors, specular: 1, error: 2, s1: colors, s2: colors }, H / 2, W / 2);
  const residual = new Float32Array((H * W) / 16);
  const strips = cutRows(H, W);
  for (const [k, [first, last]] of strips.entries()) {
    const top = Math.max(first - MARGIN, 0), bottom = Math.min(last + MARGIN, H), count = (bottom - top) * W;
    const frame = new Float32Array(2 * count);
    for (let r = top, at = 0; r < bottom; r++)
      for (let c = 0; c < W; c++, at++) {
        const place = rows[r] + cols[c], value = mosaic.data[place];
        const y = Math.floor(place / mosaic.width), x = place - y * mosaic.width;
        frame[at] = (value - mosaic.black) * gains[(y & 3) * 4 + (x & 3)];
        frame[count + at] = value >= full ? 1 : 0;
      }
    const images = await run(frame, bottom - top, W);
    for (const name of ["diffuse", "specular", "error", "s1", "s2"])
      planes[name].forEach((plane, c) => {
        const size = ((bottom - top) * W) / 4, begin = c * size + ((first - top) / 2) * (W / 2);
        plane.set(images[name].subarray(begin, begin + ((last - first) * W) / 4), (first / 2) * (W / 2));
      });
    const begin = ((first - top) * W) / 16;
    residual.set(images.residual.subarray(begin, begin + ((last - first) * W) / 16), (first * W) / 16);
    progress((k + 1) / strips.length);
  }
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
    s0: new Float32Array(n), s1: new Float32Array(n), s2: new Float32Array(n), residual: new Float32Array(n),
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
      out.residual[at] = Math.SQRT2 * residual[(r >> 1) * (planes.width / 2) + (c >> 1)];
    }
  return out;
}
