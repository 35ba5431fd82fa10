"""Golden outputs: what polsep makes of small frames, to the last bit, before and after a change of its code.

    python evaluation/golden.py record FILE.json     # and the arrays in FILE.npz, which tell how far things differ
    python evaluation/golden.py compare FILE.json    # exit status 1, and a line for every entry that differs
    python evaluation/golden.py compare FILE.json --parts streams edits    # the others: separate, commands

The tree that is measured is the one that Python imports, so PYTHONPATH decides. Only the public contract is used:
`polsep.__all__`, the streams of `polsep.kernels`, `polsep.edit` and the command line. Bits depend on the processor and
on the versions of libraries: compare where was recorded. Recording measures twice and refuses what is not the same.

Note: the very run that compiles kernels gives other bytes for ``joint`` than later ones, and numba renews a kernel only
when its own file changes. So every state of the sources has a cache of kernels of its own in the temporary folder, and
a first run, of which nothing is kept, fills it.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import importlib.util
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import OpenEXR
import tifffile
from numpy.typing import NDArray

Array = NDArray[Any]
Light = tuple[Array, Array, Array]
WHITE, SMALL, ODD = 4095, (64, 96), (69, 91)
#: Sony's order, ones that `joint` turns or that are cropped at an odd offset, and ones that only formulas take.
SPECS = {
    "sony": "90,45,135,0/RGGB",
    "mirrored": "135,90,0,45/GRBG",
    "cropped": "0,135,45,90/RGGB@1,1",
    "other": "0,45,90,135/RGGB",
    "mono": "90,45,135,0/mono",
    "mono-mirrored": "135,90,0,45/mono",
    "mono-cropped": "45,90,0,135/mono",
    "mono-other": "0,45,90,135/mono",
}
LIGHT = (1.1, 1.0, 0.8)
FORMATS = ("exr", "npz", "tiff", "png")
IMAGES = ("diffuse", "specular", "valid", "dolp", "aolp", "error")
PROGRAM = (sys.executable, "-P", "-c", "from polsep.cli import main; main()")
#: What JSON files say of the program, the machine and its libraries.
VOLATILE = ("polsep", "versions", "commit", "machine")
LIGHTS = ((0, 0, 1), (0.5, 0, 0.9), (-0.5, 0, 0.9), (0, 0.6, 0.8), (0.4, -0.4, 0.8), (-0.4, -0.4, 0.8))


class Golden:
    """Measured outputs by name: texts, and hashes of arrays and files; arrays too, unless told not to keep them."""

    def __init__(self) -> None:
        self.entries, self.arrays = dict[str, dict[str, Any]](), dict[str, Array]()

    def array(self, name: str, array: Array, keep: bool = True) -> None:
        array = np.ascontiguousarray(array)
        self._add(name, array.tobytes(), kind=f"{array.dtype} {list(array.shape)}")
        if keep:
            self.arrays[name] = array

    def text(self, name: str, value: object) -> None:
        """Anything that JSON can hold."""
        text = json.dumps(value, indent=1, sort_keys=True)
        self._add(name, text.encode(), kind="text", text=text)

    def file(self, name: str, path: Path) -> None:
        """A file's bytes but for polsep's version, and the arrays in it; of JSON the values."""
        data = path.read_bytes()
        if path.suffix in (".json", ".jsonl"):
            parts = data.decode().splitlines() if path.suffix == ".jsonl" else [data.decode()]
            self.text(name, [_steady(json.loads(part), path.parent) for part in parts])
            return
        self._add(name, data.replace(version("polsep").encode(), b"VERSION"), kind=f"{len(data)} bytes")
        for part, array in _arrays_in(path):
            self.array(f"{name}:{part}", array)

    def _add(self, name: str, data: bytes, **said: str) -> None:
        assert name not in self.entries, name
        self.entries[name] = {"sha256": hashlib.sha256(data).hexdigest(), **said}


def _steady(value: Any, folder: Path) -> Any:
    """JSON without `VOLATILE`; of the hash of a file that lies there only whether it is right."""
    if isinstance(value, list):
        return [_steady(item, folder) for item in value]
    if not isinstance(value, dict):
        return value
    kept = {key: _steady(item, folder) for key, item in value.items() if key not in VOLATILE}
    if {"name", "sha256"} <= kept.keys():
        kept["sha256"] = kept["sha256"] == hashlib.sha256((folder / kept["name"]).read_bytes()).hexdigest()
    return kept


def _arrays_in(path: Path) -> Iterator[tuple[str, Array]]:
    if path.suffix == ".exr":
        channels = OpenEXR.File(str(path), False, False).channels()
        yield from ((name, channel.pixels) for name, channel in channels.items())
    elif path.suffix == ".npz":
        yield from np.load(path).items()
    elif path.suffix == ".png":
        yield "pixels", imagecodecs.png_decode(path.read_bytes())
    elif path.suffix == ".tiff":
        yield "pixels", tifffile.imread(path)


def make_light(size: tuple[int, int], strength: float) -> Light:
    """s0, s1, s2 ``[H, W, 3]``: a coloured texture, polarized a little, under two highlights of one angle."""
    y, x = np.meshgrid(*(np.arange(n) / n for n in size), indexing="ij")
    squares = (np.floor(6 * x) + np.floor(5 * y)) % 2
    waves = np.stack([np.sin(2 * np.pi * (3 * x + c / 3)) * np.cos(2 * np.pi * (2 * y + c / 5)) for c in range(3)], -1)
    albedo = np.where(squares[..., None] > 0, (1.0, 0.75, 0.5), (0.4, 0.7, 1.0))
    diffuse = (0.3 + 0.12 * waves) * albedo
    spots = np.exp(-((x - 0.6) ** 2 + (y - 0.4) ** 2) / 0.02) + 0.3 * np.exp(-((x - 0.2) ** 2 + (y - 0.7) ** 2) / 0.005)
    specular, own, lamp = strength * spots[..., None], 2 * np.pi * y[..., None], np.radians(50)
    degree = 0.15 * x[..., None] * diffuse
    s1, s2 = (degree * turn(own) + 0.7 * specular * turn(lamp) for turn in (np.cos, np.sin))
    return diffuse + specular, s1, s2


def make_frame(spec: str, light: Light, seed: int = 0) -> NDArray[np.uint16]:
    """The mosaic of that light behind the filters of ``spec``, with noise, in 12 bits."""
    (filters, _, origin), (height, width) = spec.partition("@"), light[0].shape[:2]
    angles, colors = filters.split("/")
    cell = np.radians(np.array(angles.split(","), float).reshape(2, 2))
    bayer = [1] * 4 if colors == "mono" else ["RGB".index(color) for color in colors]
    channel = np.repeat(np.repeat(np.array(bayer).reshape(2, 2), 2, axis=0), 2, axis=1)
    first = tuple(map(int, origin.split(","))) if origin else (0, 0)
    rows, cols = np.ix_(*(np.arange(n) - start for n, start in zip((height, width), first, strict=True)))
    doubled, shown = 2 * cell[rows % 2, cols % 2], channel[rows % 4, cols % 4][..., None]
    s0, s1, s2 = (np.take_along_axis(image, shown, axis=-1)[..., 0] for image in light)
    signal = (s0 + s1 * np.cos(doubled) + s2 * np.sin(doubled)) / 2
    noise = np.random.default_rng(seed).normal(size=signal.shape) * np.sqrt(1e-5 + 1e-4 * signal)
    codes: NDArray[np.uint16] = np.rint(WHITE * np.clip(signal + noise, 0, 1)).astype(np.uint16)
    return codes


def measure_separations(golden: Golden) -> None:
    """`polsep.separate` with every method."""
    import polsep

    demo = imagecodecs.png_decode((Path(polsep.__file__).parent / "data" / "still_life.png").read_bytes())
    crop, levels = np.ascontiguousarray(demo[1056:1248, 1120:1376]), {"white_level": WHITE}
    huge = np.pad(demo, ((0, 512), (0, 0)), mode="wrap")  # so large that networks see it in strips
    cases: list[tuple[str, Array, str, dict[str, Any]]] = [("demo", crop, SPECS["sony"], levels)]
    for (name, spec), size, strength in product(SPECS.items(), (SMALL, ODD), (8.0, 0.5)):
        kind = f"{name}/{'clipped' if strength > 1 else 'plain'}/{size[0]}x{size[1]}"
        cases.append((kind, make_frame(spec, make_light(size, strength)), spec, levels))
    for name in ("sony", "mono"):
        frame = make_frame(SPECS[name], make_light(SMALL, 8.0))
        cases.append((f"{name}/tiny", frame[:12, :20], SPECS[name], levels))
        cases.append((f"{name}/light", frame, SPECS[name], {**levels, "light_color": LIGHT}))
        cases.append((f"{name}/estimate", frame, SPECS[name], {**levels, "light_color": "estimate"}))
        cases.append((f"{name}/uint8", (frame >> 4).astype(np.uint8), SPECS[name], {}))
        cases.append((f"{name}/float32", frame.astype(np.float32), SPECS[name], {**levels, "black_level": 64}))
    for (name, raw, spec, options), method, full in product(cases, polsep.METHODS, (False, True)):
        options = {**options, "method": method, "full": full, "layout": polsep.Layout.parse(spec)}
        _separate(golden, f"separate/{name}/{method}/{'full' if full else 'half'}", raw, options)
    for method in ("joint-fast", "color-affine", "analytic"):
        _separate(golden, f"separate/huge/{method}/half", huge, {**levels, "method": method}, keep=False)
    _separate(golden, "separate/demo/default", crop, {**levels, "light_color": "estimate"})


def _separate(golden: Golden, name: str, raw: Array, options: dict[str, Any], keep: bool = True) -> None:
    """Images and report of one frame, or why there are none."""
    import polsep

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", polsep.PolsepWarning)
        try:
            found = polsep.separate(raw, **{"light_color": "white", **options})
        except ValueError as error:
            golden.text(f"{name}/refused", str(error))
            return
    for image in IMAGES:
        if getattr(found, image) is not None:
            golden.array(f"{name}/{image}", getattr(found, image), keep)
    golden.text(f"{name}/report", found.report)


def pack(codes: NDArray[np.uint16], packing: str) -> NDArray[np.uint8]:
    """12-bit codes in reading order as bytes, two in three: BayerRG12p ("lsb") or BayerRG12Packed ("gige")."""
    even, odd = np.pad(codes.reshape(-1), (0, codes.size % 2)).reshape(-1, 2).T
    middle = odd % 16 * 16 + (even >> 8 if packing == "lsb" else even % 16)
    ends = (even % 256, odd >> 4) if packing == "lsb" else (even >> 4, odd >> 4)
    return np.stack([ends[0], middle, ends[1]], -1).astype(np.uint8).reshape(-1)[: (3 * codes.size + 1) // 2]


def measure_streams(golden: Golden) -> None:
    """Both streams of `polsep.kernels` on frames of every type, into the same images again and again."""
    import polsep
    from polsep import kernels

    streams: dict[str, tuple[Any, Any, Any, dict[str, Any]]] = {
        "analytic": (kernels.separate_analytic_half, kernels.AnalyticImages, kernels.AnalyticOptions, {}),
        "linear": (kernels.separate_color_affine_half, kernels.ColorAffineImages, kernels.ColorAffineOptions, {}),
    }
    streams["guided"] = (*streams["linear"][:3], {"guided": True})
    for (name, spec), (kind, (separate, images, options, more)) in product(SPECS.items(), streams.items()):
        if "mono" in name and kind != "analytic":
            continue
        layout, frame = polsep.Layout.parse(spec), make_frame(spec, make_light(ODD, 8.0))
        plain = make_frame(spec, make_light(ODD, 0.5))
        frames: dict[str, Any] = {"uint8": (frame >> 4).astype(np.uint8), "float32": np.float32(frame)}
        frames |= {packing: kernels.PackedFrame(pack(frame, packing), *ODD, packing) for packing in ("lsb", "gige")}
        padded = np.stack([np.pad(pack(row, "lsb"), (0, 5)) for row in frame])
        frames |= {"padded": kernels.PackedFrame(padded, *ODD, "lsb"), "uint16": frame, "plain": plain}
        out = images.empty(ODD, layout, report=True)
        for kind_of_frame, raw in frames.items():
            white = 255 if kind_of_frame == "uint8" else WHITE
            asked = options(LIGHT, in_light=True, report=True, out=out, **more)
            for light, given in (("in-light", asked), ("white-light", options(**more) if more else None)):
                found = separate(raw, layout, 3, white, given)
                at = f"streams/{kind}/{name}/{kind_of_frame}/{light}"
                for image in IMAGES[: 5 if light == "in-light" else 3]:
                    golden.array(f"{at}/{image}", getattr(found, image))
                if found.tally is not None:
                    golden.text(f"{at}/tally", dataclasses.asdict(found.tally))


def measure_edits(golden: Golden) -> None:
    """Every edit of `polsep.edit`, with and without a mask, and all of them as a recipe."""
    from polsep import edit

    light = [image.astype(np.float32) for image in make_light((48, 64), 1.0)]
    images, (y, x) = edit.SeparatedImages(light[0], np.abs(light[1])), np.mgrid[-1:1:48j, -1:1:64j]
    normals = np.stack([0.6 * x, -0.6 * y, np.sqrt(1 - 0.36 * (x**2 + y**2))], axis=-1).astype(np.float32)
    maps = {"texture": light[0][::2, ::2], "mask": ((x + 1) / 2).astype(np.float32), "normals": normals}
    needed: dict[str, dict[str, Any]] = {"texture": {"image": "texture", "repeats": 3.0, "normals": "normals"}}
    needed |= {"specular-gain": {"gain": 2.5}, "diffuse-gain": {"gain": 0.4}, "tint": {"color": (1.2, 1.0, 0.7)}}
    edits = {}
    for name, mask in product(edit.EDITS, ({}, {"mask": "mask"})):
        made = edit.make_edit(edit.EDITS[name], {**needed.get(name, {}), **mask})
        edits[f"{name}{'/masked' if mask else ''}"] = edit.Recipe((made,))
    edits["all"] = edit.Recipe(tuple(made for recipe in edits.values() for made in recipe.edits))
    for name, recipe in edits.items():
        found = edit.apply(images, recipe, maps)
        for image in ("diffuse", "specular", "combined"):
            golden.array(f"edits/{name}/{image}", getattr(found, image))
        golden.text(f"edits/{name}/recipe", edit.recipe_as_text(recipe))


def make_ball(toward: tuple[float, float, float]) -> Light:
    """s0, s1, s2 ``[80, 80, 3]`` of a coloured sphere under a light from there, with a small highlight."""
    y, x = np.mgrid[0.9:-0.9:80j, -0.9:0.9:80j]
    inside = x**2 + y**2 < 0.64
    z, unit = np.sqrt(np.maximum(1 - x**2 - y**2, 0)), np.array(toward) / np.linalg.norm(toward)
    shading = np.maximum(x * unit[0] + y * unit[1] + z * unit[2], 0) * inside
    diffuse, slant = shading[..., None] * (0.8, 0.5, 0.3), (0.3 * (1 - z))[..., None]
    specular, angle = (0.4 * shading**40)[..., None], 2 * np.arctan2(y, x)[..., None]
    return diffuse + specular, diffuse * slant * np.cos(angle) + specular, diffuse * slant * np.sin(angle)


def write_inputs(folder: Path) -> None:
    """The files that commands read."""
    frame, mono = (make_frame(SPECS[name], make_light(SMALL, 8.0)) for name in ("sony", "mono"))
    pictures: dict[str, Array] = {"shot": frame, "mono": mono, "mask": (frame[::2, ::2] >> 4).astype(np.uint8)}
    pictures |= {"flash": make_frame(SPECS["sony"], make_light((96, 96), 0.3))}
    pictures["wood"] = np.clip(200 * make_light((24, 40), 0.1)[0], 0, 255).astype(np.uint8)
    for angle in (0, 45, 90, 135):
        pictures[f"angles_{angle}"] = (40000 * make_light(SMALL, 0.2)[0] * (1 - angle / 200)).astype(np.uint16)
    wide = make_light((64, 88), 1.5)
    for k in range(6):  # the lower half of the film moves
        s0, s1, s2 = (np.concatenate([image[:32, :64], image[32:, 4 * k : 4 * k + 64]]) for image in wide)
        pictures[f"frames/frame{k}"] = make_frame(SPECS["sony"], (s0, s1, s2), k)
        pictures[f"ball{k}"] = make_frame(SPECS["sony"], make_ball(LIGHTS[k]), k)
        pictures[f"photo{k}"] = (255 * np.clip(make_ball(LIGHTS[k])[0], 0, 1) ** (1 / 2.2)).astype(np.uint8)
    (folder / "frames").mkdir()
    for name, pixels in pictures.items():
        (folder / f"{name}.png").write_bytes(imagecodecs.png_encode(np.ascontiguousarray(pixels)))
    np.save(folder / "array.npy", frame)
    tifffile.imwrite(folder / "pages.tiff", np.stack([frame, frame[::-1]]), photometric="minisblack")
    (folder / "dump.raw").write_bytes(pack(frame, "lsb").tobytes())


def list_commands() -> dict[str, str]:
    """Command lines by the folder that each writes."""
    white, lights = f"--white-level {WHITE}", " ".join(",".join(map(str, light)) for light in LIGHTS)
    balls, photos = (" ".join(f"{stem}{k}.png" for k in range(6)) for stem in ("ball", "photo"))
    return {f"separate-{kind}": f"separate shot.png {white} --format {kind}" for kind in FORMATS} | {
        "separate-full": f"separate shot.png --full --method color-affine --light-color 1,0.9,0.7 {white}",
        "separate-mono": f"separate mono.png --layout mono --method joint-fast {white}",
        "separate-many": f"separate array.npy pages.tiff missing.png --method analytic {white}",
        "separate-raw": "separate dump.raw --size 96x64 --pixel-format BayerRG12p --method color-affine",
        "separate-angles": "separate angles_{angle}.png --light-color estimate",
        "render-exr": "render --shapes 2 --views 2 --size 64 --workers 1",
        "render-npz": "render --shapes 1 --views 1 --size 64 --split test --format npz --samples 1 --workers 1",
        "video-exr": f"video frames {white}",
        "video-ffv1": f"video frames {white} --format ffv1 --method color-affine",
        "video-zip": f"video frames {white} --compression zip --no-preview --filter none --method joint --frames 3",
        "edit-one": "edit separate-exr/shot.exr separate-mono/mono.exr --metallic 1 --rougher 3 --tint 1.2,1,0.8",
        "edit-masked": "edit separate-exr/shot.exr --recolor 0.1,0.6,0.2 --diffuse-gain 0.8 --mask mask.png",
        "edit-texture": "edit separate-npz/shot.npz --texture wood.png --texture-repeats 3 --save-recipe recipe.json",
        "edit-recipe": "edit separate-exr/shot.exr --recipe recipe.json",
        "edit-film": "edit video-exr --recipe recipe.json",
        "geometry-raw": f"geometry {balls} {white} --lights '{lights}'",
        "geometry-photos": f"geometry --srgb {photos} --lights '{lights}' --fov 25 --mesh ply --integration smooth",
        "geometry-film": f"geometry {balls} {white} --lights '{lights}' --method analytic --size 24 --turntable",
        "material-raw": f"material flash.png {white} --white 0.8 --size 64",
        "material-exr": "material separate-full/shot.exr --input unseparated --size 48",
        "bench": "bench exactness",
        "methods": "methods",
        "edits": "edit --list",
    }


def measure_commands(golden: Golden) -> None:
    """The command line: what it says, its exit status and its files."""
    with tempfile.TemporaryDirectory(prefix="polsep-golden-") as name:
        folder = Path(name)
        write_inputs(folder)
        for target, line in list_commands().items():
            words = shlex.split(line) + ([] if target in ("methods", "edits") else ["-o", target])
            done = subprocess.run([*PROGRAM, *words], cwd=folder, capture_output=True, text=True)
            out = re.sub(r"\b[0-9a-f]{64}\b", "SHA256", done.stdout).splitlines()  # some cover polsep's version
            said = [text for text in done.stderr.splitlines() if text.startswith("polsep: ")]  # no notes on compiling
            golden.text(f"commands/{target}", {"status": done.returncode, "out": out, "err": said})
            for path in sorted(path for path in (folder / target).rglob("*") if path.is_file()):
                golden.file(f"commands/{target}/{path.relative_to(folder / target)}", path)
        golden.file("commands/edit-texture/recipe", folder / "recipe.json")


#: What is measured, by the first word of its entries' names.
PARTS = {
    "separate": measure_separations,
    "streams": measure_streams,
    "edits": measure_edits,
    "commands": measure_commands,
}


def measure(target: Path, parts: list[str]) -> None:
    """Measure in this process and in those of the commands, into TARGET.json and TARGET.npz."""
    golden = Golden()
    for part in parts:
        PARTS[part](golden)
    target.with_suffix(".json").write_text(json.dumps(golden.entries, indent=1) + "\n")
    np.savez_compressed(target.with_suffix(".npz"), **golden.arrays)  # type: ignore[arg-type]  # names are not parameters


def measure_fresh(folder: Path, times: int, parts: list[str]) -> list[Path]:
    """`measure` in fresh processes, with all kernels compiled before; the files that they wrote."""
    found = importlib.util.find_spec("polsep")
    assert found is not None and found.origin is not None
    package = Path(found.origin).resolve().parent
    sources = b"".join(str(path).encode() + path.read_bytes() for path in sorted(package.rglob("*.py")))
    kernels = Path(tempfile.gettempdir()) / "polsep-golden-kernels" / hashlib.sha256(sources).hexdigest()[:16]
    kernels.mkdir(parents=True, exist_ok=True)
    # Two threads, whatever the machine has: sums in torch may depend on it.
    pinned = {"NUMBA_CACHE_DIR": str(kernels), "PYTHONPATH": str(package.parent), "OMP_NUM_THREADS": "2"}
    targets = [folder / f"run{k}.json" for k in range(times)]
    cold = [part for part in parts if not (kernels / f"filled-{part}").exists()]
    for target, chosen in [(folder / "discarded.json", cold), *((target, parts) for target in targets)]:
        if chosen:
            print(f"measuring {', '.join(chosen)} of {package}", file=sys.stderr, flush=True)
            command = [sys.executable, "-P", __file__, "measure", str(target), "--parts", *chosen]
            subprocess.run(command, env={**os.environ, **pinned}, check=True)
        for part in chosen:
            (kernels / f"filled-{part}").touch()
    return targets


def differences(before: Path, after: Path, parts: list[str]) -> Iterator[str]:
    """A line for each entry of the parts that is not the same in two recordings."""
    old, new = (json.loads(path.read_text()) for path in (before, after))
    old = {name: entry for name, entry in old.items() if name.partition("/")[0] in parts}
    kept = (path.with_suffix(".npz") for path in (before, after))
    arrays = [np.load(path) if path.exists() else {} for path in kept]
    for name in [*old, *(name for name in new if name not in old)]:
        if name not in old or name not in new:
            yield f"{name}: {'only before' if name in old else 'only now'}"
        elif old[name]["kind"] != new[name]["kind"]:
            yield f"{name}: {old[name]['kind']}, now {new[name]['kind']}"
        elif old[name]["sha256"] != new[name]["sha256"]:
            yield f"{name}: {_explain(name, (old[name], new[name]), arrays)}"


def _explain(name: str, entries: tuple[dict[str, Any], dict[str, Any]], arrays: list[Any]) -> str:
    if "text" in entries[0]:
        a, b = (entry["text"].splitlines() for entry in entries)
        line = next((k for k, pair in enumerate(zip(a, b, strict=False)) if pair[0] != pair[1]), min(len(a), len(b)))
        return "{}, now {}".format(*("".join(text[line : line + 1]).strip() or "nothing" for text in (a, b)))
    if name not in arrays[0] or name not in arrays[1]:
        return "other bytes"
    a, b = (np.asarray(array[name], np.float64) for array in arrays)
    return f"largest difference {np.abs(a - b).max():.3g}, in {np.count_nonzero(a != b)} of {a.size} values"


def main() -> int:
    """The exit status."""
    parser = argparse.ArgumentParser(description="Record or compare golden outputs.")
    parser.add_argument("command", choices=("record", "compare", "measure"), help="measure: what the others start")
    parser.add_argument("file", type=Path, metavar="FILE.json")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="these alone")
    asked = parser.parse_args()
    command, path, chosen = asked.command, asked.file, asked.parts
    if command == "measure":
        measure(path, chosen)
        return 0
    with tempfile.TemporaryDirectory(prefix="polsep-golden-") as name:
        runs = measure_fresh(Path(name), 2 if command == "record" else 1, chosen)
        lines = list(differences(path if command == "compare" else runs[0], runs[-1], chosen))
        count = len(json.loads(runs[-1].read_text()))
        for line in lines:
            print(line)
        if command == "record" and not lines:
            for suffix in (".json", ".npz"):
                path.with_suffix(suffix).write_bytes(runs[-1].with_suffix(suffix).read_bytes())
    print(f"{len(lines)} of {count} entries differ" if lines else f"all {count} entries are equal")
    return int(bool(lines))


if __name__ == "__main__":
    sys.exit(main())
