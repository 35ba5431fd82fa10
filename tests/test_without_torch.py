"""The bare install: everything that separates frames runs where torch is not installed, and never loads it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from polsep.geometry.lights import NAMED
from polsep.io.results.separation_writer import write_separation
from polsep.io.store.image_codecs import encode_png
from polsep.methods import METHODS
from polsep.physics.srgb import srgb
from polsep.separation.report import SeparatedFrame

#: Refuses to find torch, as where it is not installed, if it is told to.
BLOCK = """
import importlib.abc, sys, warnings
class Refuse(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "torch":
            raise ModuleNotFoundError("No module named 'torch'", name="torch")
warnings.simplefilter("ignore")
if sys.argv[1] == "blocked":
    sys.meta_path.insert(0, Refuse())
"""
SEPARATE = """
import numpy as np, polsep
raw = np.random.default_rng(0).integers(100, 4096, (64, 96)).astype(np.uint16)
for method in sys.argv[2].split(","):
    for full in (False, True):
        for layout in ("color", "mono", polsep.Layout().rolled(1, 1).spec):
            out = polsep.separate(raw, method, layout, white_level=4095, full=full)
            assert np.isfinite(out.diffuse).all() and out.dolp.shape == out.valid.shape
angles = np.random.default_rng(0).integers(100, 4096, (4, 32, 48, 3)).astype(np.uint16)
from polsep.pipeline import separate_capture
from polsep.sensor.levels import as_measurements
from polsep.separation.analytic import separate_analytic_unclipped
from polsep.separation.multi_capture import separate_ding2021, separate_extremes
seen = as_measurements(angles, 0, 4095)[0]
assert seen.clipped.any()
for method in ("analytic", "color-affine", "paper"):
    assert separate_capture(seen, method).diffuse.shape == (32, 48, 3)
for found in (separate_ding2021(seen, seen), separate_extremes(seen), separate_analytic_unclipped(seen)):
    assert np.isfinite(found.diffuse + found.specular).all()
slow = {"array_api_compat.numpy", "numpy.f2py"}  # a tenth of a second together, for nothing
print(sorted(name for name in sys.modules if name.partition(".")[0] == "torch" or name in slow))
"""
COMMANDS = """
from polsep.cli import main
sys.argv[:3] = ["polsep"]
main()
"""


def run(program: str, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", BLOCK + program, *words], capture_output=True, text=True, timeout=300, check=False
    )


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("torch", ["blocked", "installed"])
def test_every_method_separates(torch: str) -> None:
    """Colour, mono and cropped mosaics at both resolutions, and co-sited samples, some of them clipped; torch stays."""
    done = run(SEPARATE, torch, ",".join(METHODS))
    assert done.stdout == "[]\n", done.stderr


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    """A folder of two raw frames."""
    for k in range(2):
        raw = np.random.default_rng(k).integers(100, 60000, (64, 96)).astype(np.uint16)
        np.save(tmp_path / f"raw{k}.npy", raw)
    return tmp_path


def ball() -> NDArray[np.float32]:
    """Grey pictures ``[6, 64, 64, 3]`` of a ball under the six lamps of `polsep geometry`."""
    x, y = np.meshgrid(*2 * [(np.arange(64) - 31.5) / 28])
    normals = np.stack([x, -y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1)
    lamps = np.array(list(NAMED.values()))
    shading = np.maximum(normals @ lamps.T, 0) * (x**2 + y**2 < 1)[..., None]
    return np.repeat(0.6 * np.moveaxis(shading, -1, 0)[..., None], 3, axis=-1).astype(np.float32)


@pytest.mark.usefixtures("compiled")
def test_shapes_need_no_torch(tmp_path: Path) -> None:
    """`polsep geometry` and `polsep shape` with their meshes and pictures."""
    pytest.importorskip("embreex", reason="needs the extra mesh")
    pictures = ball()
    paths = [tmp_path / f"{k}.png" for k in range(6)]
    for path, picture in zip(paths, pictures, strict=True):
        path.write_bytes(encode_png(np.rint(255 * srgb(picture)).astype(np.uint8)))
    flat = np.full((64, 64), 0.05, np.float32)
    frame = SeparatedFrame(pictures[2], 0 * pictures[2], np.ones((64, 64), np.bool_), flat, flat, {"warnings": []})
    one = write_separation(frame, tmp_path, "ball")[0]
    for words in (("geometry", "--srgb", *map(str, paths)), ("shape", str(one))):
        done = run(COMMANDS, "blocked", "", *words, "-o", str(tmp_path / words[0]))
        assert done.returncode == 0, done.stderr
        assert len(list((tmp_path / words[0]).glob("*.glb"))) == 1


@pytest.mark.usefixtures("compiled")
def test_commands_of_the_bare_install(frames: Path) -> None:
    """Stills, recordings and editing; what needs torch says so in one line."""
    still, film, edited = (str(frames / name) for name in ("still", "film", "edited"))
    stem = frames / "raw0.npy"
    commands = (
        ("separate", str(stem), "-o", still, "--method", "joint-fast"),
        ("video", str(frames), "-o", film, "--method", "analytic"),
        ("edit", f"{still}/raw0.exr", "-o", edited, "--rougher", "3"),
    )
    for words in commands:
        done = run(COMMANDS, "blocked", "", *words)
        assert done.returncode == 0, done.stderr
    done = run(COMMANDS, "blocked", "", "separate", str(stem), "-o", still, "--overwrite", "--device", "cuda")
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].endswith("device 'cuda' needs torch: install polsep[torch]")
    done = run(COMMANDS, "blocked", "", "train", "joint", "-o", str(frames / "run"))
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1] == (
        "polsep: error: expected the extra 'train' (pip install 'polsep[train]'), found no torch"
    )
