// Pictures of separated images for people: twin of polsep/io/results/previews.py. Results are RGBA bytes.

import { quantile } from "./numbers.js";

const STEPS = 4096;
/** Light in units of its noise below which polarization is not shown, and from which on it is in full; the grey then. */
const AT_NOISE = 4, CLEAR = 20, FADED = [70, 70, 76];
const INFERNO = "000004 210c4a 56106e 89226a bb3754 e35932 f98c0a f9c932 fcffa4".split(" ")
  .map((hex) => [0, 2, 4].map((k) => parseInt(hex.slice(k, k + 2), 16)));

/** The sRGB transfer function (IEC 61966-2-1:1999). */
export const srgb = (x) => (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055);
const TONES = Uint8ClampedArray.from({ length: STEPS + 1 }, (_, k) => 255 * srgb(k / STEPS));

/** The gain that shows 99.5 % of the samples of a linear image at 0.9. */
export function fittingGain({ diffuse, specular }) {
  const step = Math.max(1, Math.floor(diffuse.length / 60000)), seen = [];
  for (let k = 0; k < diffuse.length; k += step) seen.push(diffuse[k] + specular[k]);
  const level = quantile(seen, 0.995);
  return level > 0 ? 0.9 / level : 1;
}

/** From 0 where the light is at its noise to 1 where polarization can be seen; noise is s1's in the darkest quarter. */
export function clearnessOf({ diffuse, specular, colors, dolp, aolp, width }) {
  const n = dolp.length, light = new Float32Array(n), s1 = new Float32Array(n);
  for (let k = 0; k < n; k++) {
    for (let c = 0; c < colors; c++) light[k] += (diffuse[k * colors + c] + specular[k * colors + c]) / colors;
    s1[k] = light[k] * dolp[k] * Math.cos(2 * aolp[k]);
  }
  const dark = quantile(light.filter((_, k) => k % 13 === 0), 0.25);
  let total = 0, count = 0;
  for (let k = width + 1; k < n; k++)
    if (light[k] <= dark && k % width) {
      total += Math.abs(s1[k] - s1[k - width - 1]);
      count++;
    }
  const noise = count ? ((total / count) * Math.sqrt(Math.PI)) / 2 : 0;
  return light.map((own) => (noise ? Math.min(Math.max((own / noise - AT_NOISE) / (CLEAR - AT_NOISE), 0), 1) : 1));
}

/** A view's picture, RGBA [height, width]. `gain`: exposure of light; maps do not depend on it. */
export function drawView(view, images, gain) {
  const { diffuse, specular, colors, dolp, aolp, clearness } = images, n = dolp.length, out = new Uint8ClampedArray(4 * n).fill(255);
  if (view === "dolp" || view === "aolp") {
    for (let k = 0; k < n; k++) {
      const strength = Math.min(dolp[k], 1);
      if (view === "dolp") {
        const at = strength * 8, low = Math.min(Math.floor(at), 7);
        for (let c = 0; c < 3; c++) out[4 * k + c] = INFERNO[low][c] + (at - low) * (INFERNO[low + 1][c] - INFERNO[low][c]);
      } else {
        const light = TONES[Math.round(strength * STEPS)];
        for (let c = 0; c < 3; c++) out[4 * k + c] = light * Math.cos(aolp[k] - (c * Math.PI) / 3) ** 2;
      }
      if (clearness && clearness[k] < 1)
        for (let c = 0; c < 3; c++) out[4 * k + c] = clearness[k] * out[4 * k + c] + (1 - clearness[k]) * FADED[c];
    }
    return out;
  }
  const scale = gain * STEPS;
  for (let k = 0; k < n; k++)
    for (let c = 0; c < 3; c++) {
      const at = colors === 3 ? 3 * k + c : k;
      const light = view === "diffuse" ? diffuse[at] : view === "specular" ? specular[at] : diffuse[at] + specular[at];
      out[4 * k + c] = TONES[light <= 0 ? 0 : Math.min(STEPS, light * scale) | 0];
    }
  return out;
}
