// Levels of a raw frame, and what the user should know of them: twin of polsep/sensor/levels.py.

/** A sample within this share of white counts as clipped. */
export const CLIP_MARGIN = 2 ** -10;
const MAX_CLIPPED = 0.03, LIT = 0.02, NARROW_BITS = [8, 10, 12, 14];
const SPANS = [1e-12, 1e12], MAX_RATIO = 1e6;
const PILE = { count: 64, ratio: 5, range: 1 / 64 };

/** The white level that a type of samples implies. */
export const whiteOf = (samples) =>
  samples instanceof Uint8Array ? 255 : samples instanceof Uint16Array ? 65535 : 1;

/** The library's name of a type of samples. */
const typeOf = (samples) => `uint${8 * samples.BYTES_PER_ELEMENT}`;

/** Throws on levels that the library refuses, in its words: between them samples must keep their digits as float32. */
export function requireLevels(samples, black, white) {
  const [shownBlack, shownWhite] = [black, white].map(shortOf), span = white - black, most = whiteOf(samples);
  if (!Number.isFinite(black) || !Number.isFinite(white))
    throw new Error(`expected finite black and white levels, found ${shownBlack} and ${shownWhite}`);
  if (black < 0)
    throw new Error(`expected a black level from 0 on in samples of ${typeOf(samples)}, found ${shownBlack}`);
  const found = `found white ${shownWhite}, black ${shownBlack}`;
  if (!(white > black)) throw new Error(`expected a white level above the black level, ${found}`);
  if (!(span >= SPANS[0] && span <= SPANS[1] && white <= MAX_RATIO * span))
    throw new Error(`expected a white level well above the black level, ${found}`);
  const farthest = Math.max(black, most - black);
  if (farthest > MAX_RATIO * span)
    throw new Error(`expected samples within 1e+06 times the white level, found them ${shortOf(farthest)} from black, ` +
      `white ${shownWhite}: say white level N`);
}

/** A number in six digits, as the library's messages show it. */
const shortOf = (value) => String(Number(value.toPrecision(6)));

/** The least clipped sample. */
export const clipLevel = ({ black, white }) => black + (1 - CLIP_MARGIN) * (white - black);

/**
 * Notes on exposure and bit depth: [{text, white}], `white` being the level to offer. `white` null: nobody said one.
 */
export function levelNotes(samples, width, black, said) {
  const white = said ?? whiteOf(samples), notes = [];
  let low = Infinity, high = -Infinity, used = 0, above = 0;
  for (const value of samples) {
    if (value < low) low = value;
    if (value > high) high = value;
    used |= value;
    above += value > white;
  }
  if (high <= black) return [{ text: `black frame: no sample exceeds the black level ${black} (largest ${high})` }];
  const shown = Number(white.toPrecision(6));
  if (low - black >= (1 - CLIP_MARGIN) * (white - black))
    notes.push({ text: `every sample is clipped: the smallest is ${low} of white level ${shown}` });
  else if (high >= black + (1 - CLIP_MARGIN) * (white - black)) notes.push(...overexposureNotes(samples, width, black, white));
  else if ((said != null || !(samples instanceof Uint16Array)) && saturatesEarly(samples, black, white))
    notes.push({ text: `many samples share the largest value ${Number(high.toPrecision(6))}, below the white level ${shown}: if the ` +
      `sensor clips there, say white level ${Number(high.toPrecision(6))}`, white: Number(high.toPrecision(6)) });
  if (high > white)
    notes.push({ text: `${above} samples exceed the white level ${shown} (largest ${high}): they count as clipped` });
  if (white > whiteOf(samples))
    notes.push({ text: `white level ${shown} is beyond ${typeOf(samples)}: no sample can count as clipped` });
  if (said == null && samples instanceof Uint16Array) notes.push(...depthNotes(used, high));
  return notes;
}

/** Whether samples pile up at their largest value, and that is one between black and what counts as clipped. */
export function saturatesEarly(samples, black, white) {
  const high = samples.reduce((most, value) => Math.max(most, value), -Infinity);
  if (!(black < high && high < clipLevel({ black, white }))) return false;
  const codes = new Set(), least = high - PILE.range * (white - black);
  let count = 0, below = 0;
  for (const value of samples) {
    if (value === high) count++;
    else if (value > least) below++, codes.add(value);
  }
  return count >= PILE.count && below > 0 && count * codes.size > PILE.ratio * below;
}

/** A note on a frame of which too many lit samples clip, or none. */
export function overexposureNotes(samples, width, black, white) {
  const share = clippedShare(samples, width, black, white);
  if (share <= MAX_CLIPPED) return [];
  return [{
    text: `overexposed: ${Math.round(100 * share)}% of the lit samples are clipped, what they hide is estimated: ` +
      "expose less, or merge several exposures (polsep merge)",
  }];
}

/** Share of clipped samples among those that light reaches, of a large frame among some of its rows. */
function clippedShare(samples, width, black, white) {
  const height = samples.length / width, span = white - black, rows = Math.min(4, height), every = height >= 1024 ? 16 : rows;
  const lit = black + LIT * span, full = black + (1 - CLIP_MARGIN) * span;
  let bright = 0, clipped = 0;
  for (let first = 0; first + rows <= height; first += every)
    for (let k = first * width; k < (first + rows) * width; k++) {
      bright += samples[k] > lit;
      clipped += samples[k] >= full;
    }
  return clipped / Math.max(bright, 1);
}

/** The likely bit depth of 16-bit words of unknown white level; codes at the left have idle low bits. */
function depthNotes(used, high) {
  const idle = used ? 31 - Math.clz32(used & -used) : 0;
  const left = NARROW_BITS.find((bits) => idle >= 16 - bits);
  if (left) {
    const largest = (2 ** left - 1) * 2 ** (16 - left), seen = `the lowest ${16 - left} bits are always zero`;
    const kind = `${left}-bit left-justified data`;
    if (largest >= (1 - CLIP_MARGIN) * 65535) return [{ text: `${seen}: ${kind}; white level 65535 fits` }];
    return [{ text: `${seen}: ${kind}; say white level ${largest} if so`, white: largest }];
  }
  const right = NARROW_BITS.find((bits) => high < 2 ** bits);
  if (!right) return [];
  const top = 2 ** right - 1;
  const seen = `values never exceed ${top} of 65535: looks like ${right}-bit right-justified data`;
  return [{ text: `${seen}; say white level ${top} if so`, white: top }];
}
