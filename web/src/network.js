// A worker that runs the network on one strip after the other: ONNX Runtime Web, by WebAssembly (SIMD) or WebGPU.
//
// Messages in: {id, kind: "cpu" or "gpu", colors, samples, rows, width, thumbnail}; out: {id, images,
// seesFrame} or {id, failed}. Without a thumbnail a dark frame's is taken; networks that do not see the frame need none.

import { SIDE } from "./thumbnail.js";

const KINDS = {
  cpu: { module: "ort.wasm.bundle.min.mjs", binary: "ort-cpu.bin", provider: "wasm" },
  gpu: { module: "ort.webgpu.bundle.min.mjs", binary: "ort-gpu.bin", provider: "webgpu" },
};
const sessions = new Map();
let runtime = null;

/** The runtime of this worker, which is of one kind. One thread: strips are what runs side by side. */
async function load(kind) {
  const { module, binary } = KINDS[kind], ort = await import(new URL(module, self.location.href).href);
  ort.env.wasm.numThreads = 1;
  ort.env.wasm.wasmBinary = await unpacked(binary);
  ort.env.logLevel = "error";
  return ort;
}

async function start(kind, colors) {
  runtime ??= load(kind).catch((error) => {
    runtime = null;  // the network may be back for the next frame
    throw error;
  });
  const ort = await runtime, model = await fetched(colors === 3 ? "joint-fast.onnx" : "joint-fast-mono.onnx");
  return ort.InferenceSession.create(new Uint8Array(await model.arrayBuffer()),
    { executionProviders: [KINDS[kind].provider], graphOptimizationLevel: "all", enableMemPattern: false });
}

async function run({ kind, colors, samples, rows, width, thumbnail }) {
  if (!sessions.has(colors))
    sessions.set(colors, start(kind, colors).catch((error) => {
      sessions.delete(colors);
      throw error;
    }));
  const session = await sessions.get(colors), { Tensor } = await runtime, images = {};
  const seesFrame = session.inputNames.includes("thumbnail");
  const inputs = { frame: new Tensor("float32", samples, [1, 2, rows, width]) }, shape = [1, 5 * colors + 2, SIDE, SIDE];
  if (seesFrame)
    inputs.thumbnail = new Tensor("float32", thumbnail ?? new Float32Array(shape.reduce((a, b) => a * b)), shape);
  const found = await session.run(inputs);
  for (const [name, tensor] of Object.entries(found)) {
    images[name] = (await tensor.getData()).slice();
    tensor.dispose();
  }
  return { images, seesFrame };
}

onmessage = async ({ data }) => {
  try {
    const { images, seesFrame } = await run(data);
    postMessage({ id: data.id, images, seesFrame }, Object.values(images).map(({ buffer }) => buffer));
  } catch (error) {
    postMessage({ id: data.id, failed: error.message });
  }
};

async function fetched(name) {
  const answer = await fetch(new URL(name, self.location.href)).catch(() => null);
  if (!answer?.ok) throw new Error(`expected ${name} beside the page, found ${answer ? `status ${answer.status}` : "no answer"}`);
  return answer;
}

/** The bytes of a file that is gzip-compressed, unless the host has unpacked it on the way. */
async function unpacked(name) {
  const bytes = new Uint8Array(await (await fetched(name)).arrayBuffer());
  if (bytes[0] !== 0x1f || bytes[1] !== 0x8b) return bytes.buffer;
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}
