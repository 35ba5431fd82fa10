// The network's runtime: ONNX Runtime Web on the graphics processor by WebGPU where there is one that agrees with the
// processor, else WebAssembly with as many threads as the page may have.

const KINDS = {
  cpu: { module: "ort.wasm.bundle.min.mjs", binary: "ort-cpu.bin", provider: "wasm" },
  gpu: { module: "ort.webgpu.bundle.min.mjs", binary: "ort-gpu.bin", provider: "webgpu" },
};
/** Largest difference of the two on a test frame, white = 1, for the graphics processor to be used. */
const AGREEMENT = 1e-3, TEST_SIDE = 96;
const sessions = new Map();

/** Threads that the page may have: several only where it is cross-origin isolated. */
export const threadsOf = ({ threads }) =>
  self.crossOriginIsolated ? threads || Math.min(navigator.hardwareConcurrency || 1, 8) : 1;

/** {run(samples, rows, width), name} of the network for so many colours. `settings`: {threads, device}. */
export async function networkOf(colors, settings) {
  const threads = threadsOf(settings), cpu = () => open("cpu", colors, threads);
  if (settings.device !== "cpu" && (await hasGpu())) {
    try {
      const gpu = await open("gpu", colors, threads);
      gpu.agrees ??= await agree(gpu, await cpu());
      if (gpu.agrees) return { run: gpu.run, name: "graphics processor" };
      console.warn("the graphics processor's images differ: the processor is taken");
    } catch (error) {
      console.warn("the graphics processor failed: the processor is taken", error);
    }
  }
  return { run: (await cpu()).run, name: `processor, ${threads} thread${threads > 1 ? "s" : ""}` };
}

async function hasGpu() {
  try {
    return Boolean(self.navigator.gpu && (await self.navigator.gpu.requestAdapter()));
  } catch {
    return false;
  }
}

/** A session, opened once. */
function open(kind, colors, threads) {
  const key = `${kind}${colors}`;
  if (!sessions.has(key)) sessions.set(key, start(kind, colors, threads).catch((error) => { sessions.delete(key); throw error; }));
  return sessions.get(key);
}

const modules = new Map();

async function load(kind, threads) {
  const { module, binary } = KINDS[kind];
  const ort = await import(new URL(module, self.location.href).href);
  ort.env.wasm.numThreads = threads;
  ort.env.wasm.wasmBinary = await unpacked(binary);
  ort.env.logLevel = "error";
  return ort;
}

async function start(kind, colors, threads) {
  if (!modules.has(kind)) modules.set(kind, load(kind, threads));
  const ort = await modules.get(kind);
  const model = await fetched(colors === 3 ? "joint-fast.onnx" : "joint-fast-mono.onnx");
  const session = await ort.InferenceSession.create(new Uint8Array(await model.arrayBuffer()),
    { executionProviders: [KINDS[kind].provider], graphOptimizationLevel: "all" });
  async function run(samples, rows, width) {
    const input = new ort.Tensor("float32", samples, [1, 2, rows, width]);
    const found = await session.run({ frame: input });
    const images = {};
    for (const [name, tensor] of Object.entries(found)) {
      images[name] = await tensor.getData();
      tensor.dispose();
    }
    return images;
  }
  return { run };
}

/** True if two runtimes make the same images of a test frame with clipped samples. */
async function agree(one, other) {
  const n = TEST_SIDE ** 2, light = (k) => 0.35 + 0.3 * Math.sin(0.37 * (k % TEST_SIDE)) *
    Math.cos(0.23 * Math.floor(k / TEST_SIDE)) + (k % 89 === 0 ? 0.7 : 0);
  const frame = () => Float32Array.from({ length: 2 * n }, (_, k) => (k < n ? Math.min(light(k), 1) : +(light(k - n) >= 1)));
  const [a, b] = [await one.run(frame(), TEST_SIDE, TEST_SIDE), await other.run(frame(), TEST_SIDE, TEST_SIDE)];
  return ["diffuse", "specular", "s1", "s2"].every((name) => a[name].every((value, k) => Math.abs(value - b[name][k]) < AGREEMENT));
}

async function fetched(name) {
  const answer = await fetch(new URL(name, self.location.href));
  if (!answer.ok) throw new Error(`expected ${name} beside the page, found status ${answer.status}`);
  return answer;
}

/** The bytes of a file that is gzip-compressed, unless the host has unpacked it on the way. */
async function unpacked(name) {
  const bytes = new Uint8Array(await (await fetched(name)).arrayBuffer());
  if (bytes[0] !== 0x1f || bytes[1] !== 0x8b) return bytes.buffer;
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}
