// Workers that run the network, and which kind: WebGPU where there is one that agrees with the processor, else
// WebAssembly on several cores, a strip of the frame on each. No host needs to send headers for that.

/** Largest difference of both kinds on a test frame, white = 1, for the graphics processor to be used; its side. */
const AGREEMENT = 1e-3, TEST_SIDE = 96;
/** Most workers of WebAssembly: each takes some 200 MB. */
const MOST = 4;

/** Workers of one kind, each with one strip at a time. State: idle ones, what waits for one, and which networks (by
 * their colours) see the whole frame. */
class Pool {
  constructor(kind, count) {
    Object.assign(this, { kind, waiting: [], jobs: new Map(), seesFrame: new Map(), next: 0 });
    this.idle = Array.from({ length: count }, () => {
      const worker = new Worker(new URL("network.js", self.location.href), { type: "module" });
      worker.onmessage = ({ data: { id, images, seesFrame, failed } }) => this.finish(worker, id, (job) => {
        if (failed) return job.reject(new Error(failed));
        this.seesFrame.set(job.message.colors, seesFrame);
        job.resolve(images);
      });
      worker.onerror = (event) => this.drop(new Error(event.message || "expected network.js beside the page, found none that runs"));
      return worker;
    });
    this.count = count;
  }

  /** The network's images of a strip. */
  run(colors, samples, rows, width, thumbnail) {
    return new Promise((resolve, reject) => {
      this.waiting.push({ resolve, reject, message: { id: this.next++, kind: this.kind, colors, samples, rows, width, thumbnail } });
      this.give();
    });
  }

  give() {
    while (this.idle.length && this.waiting.length) {
      const worker = this.idle.pop(), job = this.waiting.shift();
      worker.job = job.message.id;
      this.jobs.set(worker.job, job);
      worker.postMessage(job.message, [job.message.samples.buffer]);
    }
  }

  finish(worker, id, settle) {
    this.idle.push(worker);
    if (this.jobs.has(id)) settle(this.jobs.get(id));
    this.jobs.delete(id);
    this.give();
  }

  /** All that was asked for fails, since a worker did not start; the next frame begins with other workers. */
  drop(error) {
    for (const [key, pool] of pools) if (pool === this) pools.delete(key);
    for (const job of [...this.jobs.values(), ...this.waiting]) job.reject(error);
  }
}

const pools = new Map();

function poolOf(kind, count) {
  const key = `${kind}${count}`;
  if (!pools.has(key)) pools.set(key, new Pool(kind, count));
  return pools.get(key);
}

/** Workers that are asked for, else one for each core. */
export const countOf = ({ threads }) => Math.min(threads || navigator.hardwareConcurrency || 1, MOST);

/**
 * {run(samples, rows, width, thumbnail), seesFrame, count, name} of the network for so many colours. `settings`:
 * {threads, device}. `seesFrame`: false where it is known that the network needs no thumbnail.
 */
export async function networkOf(colors, settings) {
  const count = countOf(settings), cpu = poolOf("cpu", count);
  const made = (pool, name) =>
    ({ run: (...strip) => pool.run(colors, ...strip), seesFrame: pool.seesFrame.get(colors) ?? true, count: pool.count, name });
  if (settings.device !== "cpu" && (await hasGpu(settings))) {
    const gpu = poolOf("gpu", 1);
    gpu.agrees ??= await agree(made(gpu), made(cpu)).catch((error) => {
      console.warn("the graphics processor failed:", error.message);
      return false;
    });
    if (gpu.agrees) return made(gpu, "graphics processor");
  }
  await Promise.all(Array.from({ length: count }, () => cpu.run(colors, new Float32Array(2 * 32 * 32), 32, 32)));  // opens all
  return made(cpu, count > 1 ? `processor, ${count} cores` : "processor, 1 core");
}

/** True where there is a graphics processor, not one that the processor plays. */
async function hasGpu({ device }) {
  try {
    const adapter = await self.navigator.gpu?.requestAdapter(), info = adapter?.info;
    const played = adapter?.isFallbackAdapter || info?.isFallbackAdapter || info?.architecture === "swiftshader";
    return Boolean(adapter) && (!played || device === "gpu");
  } catch {
    return false;
  }
}

/** True if two runtimes make the same images of a test frame with clipped samples. */
async function agree(one, other) {
  const n = TEST_SIDE ** 2, light = (k) => 0.35 + 0.3 * Math.sin(0.37 * (k % TEST_SIDE)) *
    Math.cos(0.23 * Math.floor(k / TEST_SIDE)) + (k % 89 === 0 ? 0.7 : 0);
  const frame = () => Float32Array.from({ length: 2 * n }, (_, k) => (k < n ? Math.min(light(k), 1) : +(light(k - n) >= 1)));
  const [a, b] = [await one.run(frame(), TEST_SIDE, TEST_SIDE), await other.run(frame(), TEST_SIDE, TEST_SIDE)];
  return ["diffuse", "specular", "s1", "s2"].every((name) => a[name].every((value, k) => Math.abs(value - b[name][k]) < AGREEMENT));
}
