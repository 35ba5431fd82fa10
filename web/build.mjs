// `node build.mjs MODELS EXAMPLE OUT`: the page as one folder of static files. MODELS: a folder with the networks
// (python -m tools.web_models); EXAMPLE: a raw frame as PNG. `make web` calls it.

import { build } from "esbuild";
import { createHash } from "node:crypto";
import { copyFileSync, mkdirSync, readdirSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { gzipSync } from "node:zlib";

const [models, example, out] = process.argv.slice(2), here = import.meta.dirname;
const runtime = join(here, "node_modules/onnxruntime-web"), source = (name) => join(here, "src", name);
rmSync(out, { recursive: true, force: true });
mkdirSync(out, { recursive: true });

await build({
  entryPoints: ["page.js", "worker.js", "network.js"].map(source), outdir: out, bundle: true, minify: true, format: "esm",
  target: "es2022", charset: "utf8", legalComments: "eof", logLevel: "warning",
});
for (const name of ["index.html", "style.css", "icon.svg"]) copyFileSync(source(name), join(out, name));
for (const name of readdirSync(models).filter((own) => own.endsWith(".onnx"))) copyFileSync(join(models, name), join(out, name));
copyFileSync(example, join(out, "example.png"));

// The runtime: modules as they are, binaries compressed (a quarter of the size on hosts that do not compress). They are
// not called .gz, because some hosts would then say that they are to be unpacked on the way.
for (const name of ["ort.wasm.bundle.min.mjs", "ort.webgpu.bundle.min.mjs"]) {
  const text = readFileSync(join(runtime, "dist", name), "utf8");
  writeFileSync(join(out, name), text.replace(/\n\/\/# sourceMappingURL=.*\s*$/, "\n"));
}
for (const [name, binary] of [["ort-cpu.bin", "ort-wasm-simd-threaded.wasm"], ["ort-gpu.bin", "ort-wasm-simd-threaded.asyncify.wasm"]])
  writeFileSync(join(out, name), gzipSync(readFileSync(join(runtime, "dist", binary)), { level: 9 }));
const licences = ["onnxruntime-web", "fast-png", "fflate", "iobuffer"].map((name) => {
  const folder = join(here, "node_modules", name), text = readdirSync(folder).find((own) => /^licen[cs]e/i.test(own));
  const { version, license } = JSON.parse(readFileSync(join(folder, "package.json"), "utf8"));
  return `${name} ${version}, ${license}\n\n${text ? readFileSync(join(folder, text), "utf8") : ""}`;
});
writeFileSync(join(out, "licences.txt"), licences.join("\n\n"));

const files = readdirSync(out).filter((name) => name !== "sw.js").sort(), hash = createHash("sha256");
for (const name of files) hash.update(name).update(readFileSync(join(out, name)));
// What not everybody needs is kept once it was asked for (sw.js).
const isKept = (name) => !/gpu/.test(name), asJson = (names) => JSON.stringify(names);
writeFileSync(join(out, "sw.js"), readFileSync(source("sw.js"), "utf8")
  .replace("VERSION", hash.digest("hex").slice(0, 12)).replace("FILES_OF_THE_PAGE", asJson(files.filter(isKept)))
  .replace("FILES_FOR_SOME", asJson(files.filter((name) => !isKept(name)))));
const bytes = readdirSync(out).reduce((total, name) => total + readFileSync(join(out, name)).length, 0);
console.log(`${out}: ${files.length + 1} files, ${(bytes / 1e6).toFixed(1)} MB`);
