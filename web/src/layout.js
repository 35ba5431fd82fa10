// Filters of a sensor and the orientation of its frames: twin of polsep/sensor/camera.py (Layout) and sensor/orient.py.
//
// A layout is {polarizer: [4 angles in degrees, reading order], bayer: "RGGB" or null, origin: [row, col]}. Rows grow
// downward; angles count from image-right toward image-up. A filter is [angle in degrees, channel].

const BAYER = ["RGGB", "BGGR", "GRBG", "GBRG"];
/** Sides of frames are continued to multiples of it before they go through a network. */
export const PERIOD = 4;

/** Analysers that are closer than this are one. */
const MIN_APART_DEG = 0.1;

export const SONY = { polarizer: [90, 45, 135, 0], bayer: "RGGB", origin: [0, 0] };
export const SONY_MONO = { ...SONY, bayer: null };

const mod = (a, n) => ((a % n) + n) % n;

/** A layout of "color", "mono" or "90,45,135,0/RGGB@row,col". Throws on other text, in the words of `Layout`. */
export function parseLayout(spec) {
  if (spec === "color" || spec === "colour") return SONY;
  if (spec === "mono") return SONY_MONO;
  const [, angles, colors, row, col] = /^([^/]*)\/([^@]+)(?:@([^,]*),([^,]*))?$/.exec(spec) ?? [];
  const number = (text) => (text?.trim() ? Number(text) : NaN), given = (angles ?? "").split(",").map(number);
  const origin = row === undefined ? [0, 0] : [number(row), number(col)];
  if (given.length !== 4 || !given.every(Number.isFinite) || !origin.every(Number.isInteger))
    throw new Error(`expected "color", "mono" or angles and colours like "90,45,135,0/RGGB", found '${spec}'`);
  const polarizer = given.map((angle) => mod(angle, 180)), around = [...polarizer].sort((a, b) => a - b);
  if (!around.every((angle, k) => (k < 3 ? around[k + 1] : around[0] + 180) - angle >= MIN_APART_DEG)) {
    const [a, b, c, d] = given.map((angle) => (Number.isInteger(angle) ? angle.toFixed(1) : angle));
    throw new Error(`expected four different analyser angles (modulo 180 degrees), found ((${a}, ${b}), (${c}, ${d}))`);
  }
  const bayer = colors === "mono" ? null : colors;
  if (bayer && !BAYER.includes(bayer)) throw new Error(`expected bayer ${BAYER.join(", ")} or None, found '${bayer}'`);
  if (!origin.every((start) => start === 0 || start === 1))
    throw new Error(`expected an origin of two numbers, each 0 or 1, found (${origin.join(", ")})`);
  if (!bayer && (origin[0] || origin[1]))
    throw new Error(`expected (0, 0) as the origin of a mono layout: permute its cell, found (${origin.join(", ")})`);
  return { polarizer, bayer, origin };
}

/** The text that parseLayout reads back. */
export function specOf({ polarizer, bayer, origin }) {
  return `${polarizer.join(",")}/${bayer || "mono"}${origin[0] || origin[1] ? `@${origin}` : ""}`;
}

export const channelsOf = (layout) => (layout.bayer ? 3 : 1);
export const periodOf = (layout) => (layout.bayer ? 4 : 2);
export const sameLayout = (a, b) => specOf(a) === specOf(b);
/** The four analyser angles in degrees, sorted. */
export const anglesOf = (layout) => [...layout.polarizer].sort((a, b) => a - b);

/** The filter on pixel (row, col) of the mosaic. */
export function filterAt({ polarizer, bayer, origin }, row, col) {
  const r = mod(row - origin[0], 4), c = mod(col - origin[1], 4);
  const angle = polarizer[(r % 2) * 2 + (c % 2)];
  return [angle, bayer ? "RGB".indexOf(bayer[(r >> 1) * 2 + (c >> 1)]) : 0];
}

/** One 4x4 period of filters, in reading order. */
export function tableOf(layout) {
  return Array.from({ length: 16 }, (_, k) => filterAt(layout, k >> 2, k & 3));
}

/** The layout whose table is given; throws where none has it. */
function fromTable(table) {
  const mono = table.every(([, channel]) => channel === 0);
  for (const origin of mono ? [[0, 0]] : [[0, 0], [0, 1], [1, 0], [1, 1]]) {
    const at = (r, c) => table[mod(r + origin[0], 4) * 4 + mod(c + origin[1], 4)];
    const polarizer = [at(0, 0)[0], at(0, 1)[0], at(1, 0)[0], at(1, 1)[0]];
    const order = [at(0, 0), at(0, 2), at(2, 0), at(2, 2)].map(([, channel]) => "RGB"[channel]).join("");
    const layout = { polarizer, bayer: mono ? null : order, origin };
    if (!mono && !BAYER.includes(order)) continue;
    if (tableOf(layout).every((own, k) => own[0] === table[k][0] && own[1] === table[k][1])) return layout;
  }
  throw new Error("no layout has this table of filters");
}

const mapTable = (layout, place, angle) =>
  fromTable(Array.from({ length: 16 }, (_, k) => {
    const [own, channel] = filterAt(layout, ...place(k >> 2, k & 3));
    return [angle(own), channel];
  }));

/** The layout of a mosaic rolled by rows and columns, or cropped by the negative numbers. */
export const rolled = (layout, rows, cols) => mapTable(layout, (r, c) => [r - rows, c - cols], (t) => t);
/** The layout of a mirrored frame: columns (rows) reverse and angles change sign. */
export const mirroredAcross = (layout, width) => mapTable(layout, (r, c) => [r, width - 1 - c], (t) => mod(-t, 180));
export const mirroredDown = (layout, height) => mapTable(layout, (r, c) => [height - 1 - r, c], (t) => mod(-t, 180));
/** The layout of the transposed frame: an angle t becomes 90 degrees - t. */
export const transposed = (layout) => mapTable(layout, (r, c) => [c, r], (t) => mod(90 - t, 180));

/**
 * Steps from a frame to Sony's order, which networks know: transposed, mirrored, then continued by `top` and `left`
 * samples. The simplest that keeps polarizer cells, as sensor/orient.py finds it. Throws where there is none.
 */
export function orient(height, width, layout) {
  const wanted = tableOf(layout.bayer ? SONY : SONY_MONO).join(";");
  for (const turn of [false, true]) {
    const [rows, cols] = turn ? [width, height] : [height, width];
    for (const [down, across] of [[false, false], [false, true], [true, false], [true, true]]) {
      let turned = turn ? transposed(layout) : layout;
      turned = down ? mirroredDown(turned, rows) : turned;
      turned = across ? mirroredAcross(turned, cols) : turned;
      for (let top = 0; top < PERIOD; top++)
        for (let left = 0; left < PERIOD; left++) {
          if (tableOf(rolled(turned, top, left)).join(";") !== wanted) continue;
          const found = { height, width, turn, down, across, top, left, origin: layout.origin };
          if (spansOf(found).every(([first]) => first % 2 === 0)) return found;
        }
    }
  }
  const known = specOf(layout.bayer ? SONY : SONY_MONO);
  throw new Error(`expected filters ${known}, mirrored, turned or cropped, found ${specOf(layout)}`);
}

/** First row and column of the turned frame that the frame's whole cells take, and how many samples. */
export function spansOf({ height, width, turn, down, across, top, left, origin }) {
  const sides = [[height, origin[0]], [width, origin[1]]];
  const [rows, cols] = turn ? [sides[1], sides[0]] : sides;
  const span = ([count, start], before, mirrored) => {
    const whole = (count - start) >> 1 << 1;
    return [before + (mirrored ? count - start - whole : start), whole];
  };
  return [span(rows, top, down), span(cols, left, across)];
}

/** The place in the frame of every row (or column) of the turned frame, which is continued by whole periods. */
function placesOf(count, before) {
  const after = mod(-count - before, PERIOD), period = Math.min(PERIOD, count >> 1 << 1);
  return Int32Array.from({ length: before + count + after }, (_, k) => {
    const place = k - before;
    if (place < 0) return mod(place, period);
    return place >= count ? count - period + mod(place - count, period) : place;
  });
}

/** Where the rows and columns of a turned frame come from: {rows, cols, at(r, c)}, at giving the index in the frame. */
export function turnedPlaces(way) {
  const [height, width] = way.turn ? [way.width, way.height] : [way.height, way.width];
  const rows = placesOf(height, way.top), cols = placesOf(width, way.left);
  if (way.down) rows.forEach((place, k) => (rows[k] = height - 1 - place));
  if (way.across) cols.forEach((place, k) => (cols[k] = width - 1 - place));
  const [rowStep, colStep] = way.turn ? [1, way.width] : [way.width, 1];
  rows.forEach((place, k) => (rows[k] = place * rowStep));
  cols.forEach((place, k) => (cols[k] = place * colStep));
  return { rows, cols };
}
