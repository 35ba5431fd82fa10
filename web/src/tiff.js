// TIFF files of one raw frame: 8 to 16 bits (also packed, 10 or 12 bits), strips or tiles, uncompressed, LZW, deflate
// or PackBits. Twin of what polsep/io/raw/tiff.py reads. Source: TIFF 6.0 (Adobe 1992).

import { unzlibSync } from "fflate";
import { requireSize } from "./header_checks.js";

const SIZES = { 1: 1, 2: 1, 3: 2, 4: 4, 6: 1, 7: 1, 13: 4 };
const COMPRESSIONS = { 1: (x) => x, 5: unpackLzw, 8: unpackDeflate, 32946: unpackDeflate, 32773: unpackBits };

/** Meanings of samples with black at zero: MinIsBlack, and of Digital Negatives colour filters and linear raw. */
const PHOTOMETRIC = [1, 32803, 34892];

/** The one page: {data, height, width, white}; `white` where the file says its bits. Throws on others. */
export function readTiff(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength), little = bytes[0] === 0x49;
  if (view.getUint16(2, little) !== 42) throw new Error("expected a classic TIFF file, found another kind (BigTIFF?)");
  const { tags, next } = readTags(view, view.getUint32(4, little), little), one = (tag, usual) => (tags[tag] ?? [usual])[0];
  const width = one(256), height = one(257), bits = one(258, 1), channels = one(277, 1);
  const unpack = COMPRESSIONS[one(259, 1)], predictor = one(317, 1);
  if (!width || !height) throw new Error("expected a TIFF file with a size, found none");
  requireSize(width, height);
  if (channels !== 1) throw new Error(`expected one channel, found ${channels}: a demosaicked picture is not a raw mosaic`);
  if (next) throw new Error("expected a TIFF file of one picture, found several");
  if (!PHOTOMETRIC.includes(one(262, 0))) throw new Error(`expected gray samples with black at zero, found TIFF photometric ${one(262, 0)}`);
  if (bits < 8 || bits > 16 || one(339, 1) !== 1) throw new Error(`expected samples of 8 to 16 bits, found ${bits} of another kind`);
  if (!unpack) throw new Error(`expected a TIFF file without compression, LZW, deflate or PackBits, found number ${one(259)}`);
  if (one(266, 1) !== 1 || (predictor !== 1 && (predictor !== 2 || bits % 8)))
    throw new Error("expected a TIFF file in usual order, found reversed bits or another predictor");
  const tiled = 322 in tags, boxWidth = tiled ? one(322) : width, boxHeight = tiled ? one(323) : one(278, height);
  const offsets = tags[tiled ? 324 : 273], counts = tags[tiled ? 325 : 279];
  if (!offsets || !counts) throw new Error("expected a TIFF file with pixels, found none");
  const across = Math.ceil(width / boxWidth), chunks = across * Math.ceil(height / boxHeight);
  const held = offsets.filter((offset, k) => offset && counts[k]).length;
  if (held < chunks) throw new Error(`expected ${chunks} TIFF strips or tiles, found ${held}`);
  const end = offsets.reduce((last, offset, k) => Math.max(last, offset + (counts[k] ?? 0)), 0);
  if (end > bytes.length)
    throw new Error(`expected TIFF samples up to byte ${end}, found a file of ${bytes.length} bytes: it is truncated`);
  const data = new (bits === 8 ? Uint8Array : Uint16Array)(width * height);
  offsets.forEach((offset, k) => {
    const top = Math.floor(k / across) * boxHeight, left = (k % across) * boxWidth;
    const rows = tiled ? boxHeight : Math.min(boxHeight, height - top), rowBytes = Math.ceil((boxWidth * bits) / 8);
    if (top >= height) return;
    const packed = unpack(bytes.subarray(offset, offset + counts[k]), rows * rowBytes);
    if (packed.length < rows * rowBytes) throw new Error("expected full TIFF strips or tiles, found one that ends early");
    const row = new data.constructor(boxWidth);
    for (let r = 0; r < Math.min(rows, height - top); r++) {
      readRow(packed.subarray(r * rowBytes, (r + 1) * rowBytes), bits, little, row);
      if (predictor === 2) for (let c = 1; c < boxWidth; c++) row[c] += row[c - 1];
      data.set(row.subarray(0, Math.min(boxWidth, width - left)), (top + r) * width + left);
    }
  });
  const turned = one(274, 1), notes = turned === 1 ? [] : [`TIFF orientation ${turned} is not applied: pixels stay as stored`];
  return { data, height, width, white: bits > 8 && bits < 16 ? 2 ** bits - 1 : null, notes };
}

function readTags(view, at, little) {
  const tags = {}, count = view.getUint16(at, little);
  for (let k = 0; k < count; k++) {
    const entry = at + 2 + 12 * k, kind = view.getUint16(entry + 2, little), size = SIZES[kind], n = view.getUint32(entry + 4, little);
    if (!size || n > 1e6) continue;
    const place = size * n <= 4 ? entry + 8 : view.getUint32(entry + 8, little);
    tags[view.getUint16(entry, little)] = Array.from({ length: n }, (_, i) =>
      size === 1 ? view.getUint8(place + i) : size === 2 ? view.getUint16(place + 2 * i, little) : view.getUint32(place + 4 * i, little));
  }
  const end = at + 2 + 12 * count;
  return { tags, next: end + 4 <= view.byteLength ? view.getUint32(end, little) : 0 };
}

function readRow(bytes, bits, little, row) {
  if (bits === 8) row.set(bytes.subarray(0, row.length));
  else if (bits === 16)
    for (let c = 0; c < row.length; c++) row[c] = little ? bytes[2 * c] | (bytes[2 * c + 1] << 8) : (bytes[2 * c] << 8) | bytes[2 * c + 1];
  else  // packed from the highest bit on, every row from a whole byte on
    for (let c = 0, at = 0; c < row.length; c++, at += bits) {
      const k = at >> 3, word = (bytes[k] << 16) | (bytes[k + 1] << 8) | (bytes[k + 2] || 0);
      row[c] = (word >> (24 - bits - (at & 7))) & (2 ** bits - 1);
    }
}

/** zlib's format, of which the last four bytes are the checksum Adler-32 (RFC 1950). */
function unpackDeflate(bytes) {
  const out = unzlibSync(bytes), found = new DataView(bytes.buffer, bytes.byteOffset + bytes.length - 4, 4).getUint32(0);
  let a = 1, b = 0;
  for (let k = 0; k < out.length; b %= 65521, a %= 65521)
    for (const end = Math.min(k + 3800, out.length); k < end; k++) b += a += out[k];
  if (b * 65536 + a !== found) throw new Error("wrong checksum");
  return out;
}

function unpackBits(bytes, size) {
  const out = new Uint8Array(size);
  let at = 0;
  for (let k = 0; k < bytes.length && at < size; ) {
    const n = bytes[k++];
    if (n < 128) {
      out.set(bytes.subarray(k, k + Math.min(n + 1, size - at)), at);
      k += n + 1;
      at += n + 1;
    } else if (n > 128) {
      out.fill(bytes[k++], at, at + 257 - n);
      at += 257 - n;
    }
  }
  if (at > size) throw new Error("too many bytes");
  return out.subarray(0, at);
}

/** LZW with codes from the highest bit on; 256 clears the table, 257 ends (TIFF 6.0, section 13). */
function unpackLzw(bytes, size) {
  const out = new Uint8Array(size), starts = new Int32Array(4097), lengths = new Int32Array(4097);
  let at = 0, next = 258, bits = 9, word = 0, held = 0, before = -1;
  for (const byte of bytes) {
    word = ((word << 8) | byte) & 0xffffff;
    held += 8;
    if (held < bits) continue;
    held -= bits;
    const code = (word >> held) & (2 ** bits - 1);
    if (code === 257 || at >= size) break;
    if (code === 256) {
      [next, bits, before] = [258, 9, -1];
      continue;
    }
    if (code > next || (code > 257 && before < 0)) throw new Error("unknown code");
    const begin = at;  // a table entry is the string before and one byte more: both are in the output already
    if (code < 256) out[at++] = code;
    else {
      const from = code < next ? starts[code] : before, length = code < next ? lengths[code] : begin - before + 1;
      for (let k = 0; k < length && at < size; k++) out[at++] = out[from + k];
    }
    if (before >= 0 && next < 4096) {
      starts[next] = before;
      lengths[next++] = begin - before + 1;
    }
    before = begin;
    bits = next >= 2047 ? 12 : next >= 1023 ? 11 : next >= 511 ? 10 : 9;
  }
  return out.subarray(0, at);
}
