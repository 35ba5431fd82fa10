// Files to download: EXR with the layers that `polsep separate` writes, and PNG.

import { encode } from "fast-png";
import { zlibSync } from "fflate";

const ROWS = 16;  // of a chunk

/** The layers of separated images by channel name, as polsep's EXR files have them. */
export function layersOf(images) {
  const { diffuse, specular, colors, dolp, aolp, valid, error } = images, n = dolp.length, layers = {};
  const total = diffuse.map((light, k) => light + specular[k]);  // for programs that know no layers
  for (const [name, image, count] of [["", total, colors], ["diffuse", diffuse, colors], ["specular", specular, colors], ["error", error, 2]])
    for (let c = 0; image && c < count; c++) {
      const plane = new Float32Array(n), channel = name === "error" ? ["diffuse", "specular"][c] : count === 1 ? "Y" : "RGB"[c];
      for (let k = 0; k < n; k++) plane[k] = image[k * count + c];
      layers[name ? `${name}.${channel}` : channel] = plane;
    }
  return { ...layers, "dolp.Y": dolp, "aolp.Y": aolp, "valid.Y": Float32Array.from(valid) };
}

/**
 * An OpenEXR file of one part of float scanlines, ZIP-compressed. `layers`: Float32Arrays by channel name; `notes`:
 * attributes of text. Source: OpenEXR, "OpenEXR File Layout".
 */
export function encodeExr(layers, width, height, notes) {
  const names = Object.keys(layers).sort(), text = (value) => [...new TextEncoder().encode(value), 0];
  const int = (...values) => [...new Uint8Array(Int32Array.from(values).buffer)];
  const float = (...values) => [...new Uint8Array(Float32Array.from(values).buffer)];
  const attribute = (name, kind, value) => [...text(name), ...text(kind), ...int(value.length), ...value];
  const box = int(0, 0, width - 1, height - 1);
  const head = [
    ...int(20000630, 2),
    ...attribute("channels", "chlist", [...names.flatMap((name) => [...text(name), ...int(2, 0, 1, 1)]), 0]),
    ...attribute("compression", "compression", [3]),
    ...attribute("dataWindow", "box2i", box), ...attribute("displayWindow", "box2i", box),
    ...attribute("lineOrder", "lineOrder", [0]), ...attribute("pixelAspectRatio", "float", float(1)),
    ...attribute("screenWindowCenter", "v2f", float(0, 0)), ...attribute("screenWindowWidth", "float", float(1)),
    ...Object.entries(notes).flatMap(([name, value]) => attribute(name, "string", text(value).slice(0, -1))),
    0,
  ];
  const chunks = [];
  for (let top = 0; top < height; top += ROWS) {
    const rows = Math.min(ROWS, height - top), pixels = new Float32Array(rows * names.length * width);
    for (let r = 0, at = 0; r < rows; r++)
      for (const name of names) {
        pixels.set(layers[name].subarray((top + r) * width, (top + r + 1) * width), at);
        at += width;
      }
    const raw = new Uint8Array(pixels.buffer), packed = zlibSync(predicted(raw), { level: 4 });
    chunks.push([top, packed.length < raw.length ? packed : raw]);
  }
  let place = head.length + 8 * chunks.length;
  const offsets = new BigUint64Array(chunks.map(([, data]) => {
    const own = BigInt(place);
    place += 8 + data.length;
    return own;
  }));
  return new Blob([Uint8Array.from(head), offsets, ...chunks.flatMap(([top, data]) => [Int32Array.from([top, data.length]), data])],
    { type: "image/x-exr" });
}

/** Bytes as OpenEXR's ZIP wants them: even ones first, then odd ones, each as the difference to the one before. */
function predicted(bytes) {
  const n = bytes.length, half = (n + 1) >> 1, out = new Uint8Array(n);
  for (let k = 0; k < n; k++) out[(k & 1 ? half : 0) + (k >> 1)] = bytes[k];
  for (let k = n - 1; k > 0; k--) out[k] = out[k] - out[k - 1] + 128;
  return out;
}

/** A linear image of 16 bits, as PNG: code 65535 is light of `white`. */
export function encodeLinearPng(image, colors, width, height, white) {
  const data = new Uint16Array(image.length);
  for (let k = 0; k < data.length; k++) data[k] = Math.min(Math.max(Math.round((image[k] * 65535) / white), 0), 65535);
  return new Blob([encode({ width, height, data, channels: colors, depth: 16 })], { type: "image/png" });
}
