// The worker: reads a frame, checks it, separates it and writes files. The page only draws.
//
// Messages in: {job, ...}; out: {progress} while it works, then {done: job, ...} or {failed: text}.

import { separateAnalytic } from "./analytic.js";
import { colorSpecular } from "./colored.js";
import { removeDefects } from "./defects.js";
import { encodingWarning } from "./encoding.js";
import { fillUnderHighlights } from "./highlights.js";
import { separateJoint } from "./joint.js";
import { checkLayout, seePhases } from "./layout_check.js";
import { channelsOf, parseLayout, periodOf, specOf } from "./layout.js";
import { levelNotes, overexposureNotes, requireLevels, whiteOf } from "./levels.js";
import { lightOf } from "./light.js";
import { checkBlackLevel } from "./noise.js";
import { readFrame } from "./read.js";
import { addPolarization, describe, intoLight, tallyOf } from "./report.js";
import { networkOf } from "./runtime.js";
import { encodeExr, encodeLinearPng, layersOf } from "./write.js";

let frame = null, separated = null;

const tell = (share, text) => postMessage({ progress: { share, text } });

const JOBS = {
  /** Begin to load the network, before it is needed; other jobs need not wait for it. */
  async warm({ settings }) {
    networkOf(3, settings).catch((error) => console.warn(error));
    return {};
  },

  /** Read a file; {needsFormat} where it has no header and nothing was stated of it. */
  async open({ name, file, stated }) {
    tell(0.02, "Reading");
    const bytes = await file.arrayBuffer().catch((error) => {
      throw new Error(`expected a file, found a folder or one that cannot be read (${error.message})`);
    });
    const found = readFrame(name, new Uint8Array(bytes), stated);
    if (found.needsFormat) return found;
    frame = { ...found, name };
    return { name, width: found.width, height: found.height, white: found.white, layout: found.layout };
  },

  /** Separate the frame that was read. `settings`: {method, layout, black, white, light, threads, device}. */
  async separate({ settings }) {
    const steps = {}, clock = stopwatch(steps), { mosaic, notes, defects } = prepare(settings);
    clock("check");
    tell(0.12, "Finding the light");
    const light = lightOf(settings.light, mosaic);
    clock("light");
    const network = settings.method === "joint-fast";
    let images, device = "";
    if (network) {
      tell(0.15, "Loading the network");
      const found = await networkOf(channelsOf(mosaic.layout), settings);
      clock("load");
      device = found.name;
      tell(0.2, "Separating");
      images = await separateJoint(mosaic, light.color, found, (share) => tell(0.2 + 0.75 * share, "Separating"));
    } else {
      tell(0.3, "Separating");
      images = separateAnalytic(mosaic, light.color);
    }
    clock("separate");
    addPolarization(images);
    const sums = tallyOf(images), colored = network ? colorSpecular(images, mosaic, light.color, sums) : {};
    if (network) colored.report.filled_under_highlights = fillUnderHighlights(images, mosaic, light.color);
    const { statistics, warnings } = describe(sums, network, images.colors);
    intoLight(images, light.color);
    clock("report");
    const report = {
      method: settings.method, layout: specOf(mosaic.layout), white_level: mosaic.white, black_level: mosaic.black,
      light_color: light.color, light, defects, statistics, ...colored.report,
      seconds: steps, device,
    };
    const said = [...notes, ...[...light.remarks, ...(colored.remark ? [colored.remark] : []), ...warnings].map((text) => ({ text }))];
    separated = { images, report: { ...report, warnings: said.map(({ text }) => text) } };
    const { height, width, colors, diffuse, specular, dolp, aolp, valid } = images;
    return { images: { height, width, colors, diffuse, specular, dolp, aolp, valid }, report, notes: said, name: frame.name };
  },

  /** A file of the images: "exr", or a linear PNG of "diffuse" or "specular". */
  async write({ format }) {
    const { images, report } = separated, { width, height, colors } = images;
    tell(0.5, "Writing");
    if (format !== "exr") return { blob: encodeLinearPng(images[format], colors, width, height, 2) };
    const notes = { software: "polsep in the browser", method: report.method, report: JSON.stringify(report) };
    return { blob: encodeExr(layersOf(images), width, height, notes) };
  },
};

/** Call the result with a name after each step of the work: the seconds that it took go to `steps`. */
function stopwatch(steps) {
  let before = performance.now();
  return (name) => {
    const now = performance.now();
    steps[name] = (now - before) / 1000;
    before = now;
  };
}

/** The frame as a mosaic, put right where that is sure, with notes for the user: {text, white, black, layout}. */
function prepare(settings) {
  const layout = parseLayout(settings.layout || frame.layout || "color"), notes = frame.notes.map((text) => ({ text }));
  const said = settings.white ?? frame.white, white = said ?? whiteOf(frame.data), black = settings.black || 0;
  requireLevels(frame.data, black, white);
  const [top, left] = layout.origin, [rows, cols] = [top, left].map((start) => start + periodOf(layout));
  if (frame.height < rows || frame.width < cols)
    throw new Error(`expected a mosaic of at least ${cols}x${rows} pixels, found ${frame.width}x${frame.height}`);
  const height = frame.height - ((frame.height - top) % 2), width = frame.width - ((frame.width - left) % 2);
  if (height !== frame.height || width !== frame.width)
    notes.push({ text: `size ${frame.width}x${frame.height} cuts polarizer cells of the layout: cropped to ${width - left}x${height - top}, whole cells` });
  const data = new Float32Array(height * width);
  for (let r = 0; r < height; r++) data.set(frame.data.subarray(r * frame.width, r * frame.width + width), r * width);
  notes.push(...levelNotes(frame.data, frame.width, black, said));
  const mosaic = { data, height, width, layout, black, white };
  tell(0.05, "Checking the frame");
  let phases = seePhases(mosaic);
  const level = checkBlackLevel(mosaic);
  const encoded = encodingWarning(mosaic, phases);
  if (encoded) notes.push({ text: encoded });
  const taken = level?.level != null && black === 0;
  if (level) notes.push({ text: level.text, black: taken ? null : level.shown });
  if (taken) {
    if (!overexposureNotes(frame.data, frame.width, 0, white).length)  // else it was said where the levels were
      notes.push(...overexposureNotes(frame.data, frame.width, level.level, white));
    mosaic.black = level.level;
    phases = seePhases(mosaic);
  }
  const wrong = !encoded && (!level || level.level != null) ? checkLayout(mosaic, phases) : null;
  if (wrong) notes.push(wrong);
  const defects = removeDefects(mosaic), share = defects / data.length;
  if (share >= 5e-4)
    notes.push({ text: `${defects} dead or hot pixels were repaired (${(100 * share).toFixed(2)}%): a calibration of the dark ` +
      "finds them more surely, see 'polsep calibrate dark'" });
  return { mosaic, notes, defects };
}

let before = Promise.resolve();
onmessage = ({ data }) => {
  before = before.then(async () => {
    try {
      postMessage({ done: data.job, ...(await JOBS[data.job](data)) });
    } catch (error) {
      postMessage({ failed: String(error.message).split("\n")[0] });
    }
  });
};
