// Files of raw frames: PNG, TIFF, and headerless GenICam frames of a format and size that the visitor states. Twin of
// polsep/io/raw. A frame is {data: Uint8Array or Uint16Array, height, width, white, layout, notes}.

import { decode } from "fast-png";
import { requireSize } from "./header_checks.js";
import { readTiff } from "./tiff.js";

const PACKINGS = {
  8: [8, "byte"], 10: [10, "word"], 12: [12, "word"], 14: [14, "word"], 16: [16, "word"],
  "10p": [10, "lsb"], "12p": [12, "lsb"], "10Packed": [10, "gige"], "12Packed": [12, "gige"],
};
const FAMILIES = [
  ["Mono", "8 10 12 14 16 10p 12p 10Packed 12Packed", null],
  ["BayerRG", "8 10 12 16 10p 12p 10Packed 12Packed", "RGGB"],
  ["Polarized", "8 10p 12p 12Packed 16", null],
  ["BayerRGPolarized", "8 10p 12p 16", "RGGB"],
];

/** GenICam pixel formats by name: {bits, packing, bayer}. */
export const PIXEL_FORMATS = Object.fromEntries(FAMILIES.flatMap(([family, kinds, bayer]) =>
  kinds.split(" ").map((kind) => [family + kind, { bits: PACKINGS[kind][0], packing: PACKINGS[kind][1], bayer }])));

/** Ends of the names of files that have headers, but are not read here. */
const OTHER_KINDS = /\.(npy|npz|pgm|exr|json|bmp|zip|mkv|avi|mov|nut|mp4)$/i;

/** Sizes of whole frames of polarization sensors. */
const SENSORS = [[2448, 2048], [2464, 2056], [4096, 3000], [4112, 3008], [1224, 1024]];

/** A frame of a file's bytes. `stated`: {format, width, height} of files without a header. Throws in one line. */
export function readFrame(name, bytes, stated) {
  if (bytes.length > 8 && bytes[0] === 0x89 && bytes[1] === 0x50) return readPng(bytes);
  if (looksLikeTiff(bytes)) return readIntactTiff(bytes);
  if (/\.(jpe?g|gif|webp|heic)$/i.test(name)) throw new Error("expected a raw frame as PNG or TIFF, found a compressed photograph");
  if (!bytes.length) throw new Error("expected a raw frame, found an empty file");
  if (/\.(png|tiff?)$/i.test(name)) throw new Error("expected a PNG or TIFF file as the name says, found another one");
  if (OTHER_KINDS.test(name)) throw new Error(`expected a raw frame as PNG, TIFF or without a header, found ${name.match(OTHER_KINDS)[0]}`);
  if (!stated) return { needsFormat: true, size: bytes.length, guesses: guessFormats(bytes.length) };
  return readHeaderless(bytes, stated);
}

/** True for the first bytes of TIFF and BigTIFF: the order of bytes twice, then 42 or 43. */
function looksLikeTiff([first, second, third, fourth]) {
  const little = first === 0x49 && second === 0x49 && fourth === 0, big = first === 0x4d && second === 0x4d && third === 0;
  return (little && [42, 43].includes(third)) || (big && [42, 43].includes(fourth));
}

function readIntactTiff(bytes) {
  try {
    return { layout: null, ...readTiff(bytes) };
  } catch (error) {
    if (error.message.startsWith("expected")) throw error;
    throw new Error(`expected an intact TIFF file, found damage (${error.message})`);
  }
}

function readPng(bytes) {
  let png;
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (bytes.length > 24 && view.getUint32(12) === 0x49484452) requireSize(view.getUint32(16), view.getUint32(20));  // IHDR
  try {
    png = decode(bytes, { checkCrc: true });
  } catch (error) {
    throw new Error(`expected a complete PNG file, found a damaged one (${error.message})`);
  }
  const { data, width, height, channels, depth } = png, notes = [];
  if (png.palette || depth < 8) throw new Error("expected a PNG of 8 or 16 bits, found one of a palette or fewer bits");
  if (channels === 1) return { data, width, height, white: null, layout: null, notes };
  if (channels !== 3) throw new Error(`expected one channel, found ${channels}: transparency has no place in a raw mosaic`);
  const one = new data.constructor(width * height);
  for (let k = 0; k < one.length; k++) {
    one[k] = data[3 * k];
    if (data[3 * k + 1] !== one[k] || data[3 * k + 2] !== one[k])
      throw new Error("expected one channel, found 3: a demosaicked picture is not a raw mosaic");
  }
  return { data: one, width, height, white: null, layout: null, notes: ["gray stored as three equal channels: one is used"] };
}

const frameBytes = ({ packing, bits }, width, height) =>
  Math.ceil((width * height * ({ byte: 8, word: 16, gige: 12 }[packing] || bits)) / 8);

/** Formats and sizes of known sensors that fit a number of bytes, the best guesses first. */
function guessFormats(size) {
  return ["BayerRG12p", "BayerRG8", "BayerRG16", "BayerRG10p"].flatMap((format) =>
    SENSORS.filter(([width, height]) => frameBytes(PIXEL_FORMATS[format], width, height) === size)
      .map(([width, height]) => ({ format, width, height })));
}

function readHeaderless(bytes, { format, width, height }) {
  const kind = PIXEL_FORMATS[format];
  if (!kind) throw new Error(`expected a GenICam pixel format, found ${format}`);
  if (!(width > 0 && height > 0)) throw new Error(`expected a width and height, found ${width}x${height}`);
  requireSize(width, height);
  const expected = frameBytes(kind, width, height);
  if (bytes.length !== expected) throw new Error(`expected ${expected} bytes for ${width}x${height} ${format}, found ${bytes.length}`);
  const data = kind.packing === "byte" ? bytes.slice() : new Uint16Array(width * height);
  if (kind.packing === "word") for (let k = 0; k < data.length; k++) data[k] = bytes[2 * k] | (bytes[2 * k + 1] << 8);
  if (kind.packing === "lsb")  // a little-endian bit stream
    for (let k = 0, at = 0; k < data.length; k++, at += kind.bits)
      data[k] = ((bytes[at >> 3] | (bytes[(at >> 3) + 1] << 8)) >> (at & 7)) & (2 ** kind.bits - 1);
  if (kind.packing === "gige") {  // b0 and b2 the high 8 bits of two pixels, b1 the low bits of both
    const low = kind.bits - 8, mask = 2 ** low - 1;
    for (let k = 0, b = 0; k < data.length; k += 2, b += 3) {
      data[k] = (bytes[b] << low) | (bytes[b + 1] & mask);
      if (k + 1 < data.length) data[k + 1] = (bytes[b + 2] << low) | ((bytes[b + 1] >> 4) & mask);
    }
  }
  const white = kind.bits > 8 && kind.bits < 16 ? 2 ** kind.bits - 1 : null;
  return { data, width, height, white, layout: kind.bayer ? "color" : "mono", notes: [] };
}
