"""Kernels of the library are those of the sources, give the bytes that numba gives, and refuse other arguments."""

from __future__ import annotations

import gc
import importlib
import json
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from polsep.compute import compiling, library, processor
from polsep.compute.compiling import ONE, ZERO, Entry, read_only
from polsep.demosaic.bilinear_kernel import read_pattern
from polsep.demosaic.cells_kernel import Source, read_grid
from polsep.edit.blur_kernel import filter_image
from polsep.kernels import separate_analytic_half, separate_color_affine_half
from polsep.physics.stokes import stokes_inverse
from polsep.sensor import defects_kernel
from polsep.sensor.calibration import neighbours
from polsep.sensor.calibration_kernel import mix_neighbours
from polsep.sensor.camera import Layout
from polsep.sensor.unpack_kernel import as_samples
from polsep.separation import analytic_kernel, fill_kernel, strips_kernel
from polsep.video.panels_kernel import STEPS, make_panels
from polsep.video.temporal_kernel import blend_images

ROOT = Path(__file__).resolve().parents[1]
TABLE: dict[str, Any] = json.loads(library.PATH.with_suffix(".json").read_text())
LEVEL = np.ones((6, 4, 4), np.float32)
PLACES = np.arange(3)

needs_library = pytest.mark.skipif(
    sys.platform != "linux" or not processor.cpu_flags() >= processor.X86_64_V3,
    reason="the library is for Linux on processors of the level x86-64-v3",
)


def kernels() -> dict[str, Entry]:
    """All kernels of the package that Python calls, but those for rendering."""
    for path in sorted((ROOT / "polsep").rglob("*_kernel.py")):
        importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
    found = (each for each in gc.get_objects() if type(each) is Entry)
    return {library.name_of(each): each for each in found if each.__module__.startswith("polsep.")}


def source() -> Source:
    """A frame of zeros, as kernels read it."""
    samples, layout = as_samples(np.zeros((64, 64), np.uint8)), Layout()
    pattern = read_pattern((64, 64), layout, 0, 1, (1.0, 1.0, 1.0))
    return Source(samples, pattern, read_grid(pattern, layout.angles, stokes_inverse(layout.angles).astype(np.float32)))


@needs_library
def test_the_library_is_fresh() -> None:
    """Every kernel was compiled from its present sources and constants; where not: ``make kernels``."""
    found = kernels()
    assert set(TABLE["entries"]) == {name for name in found if not name.startswith("polsep.render.")}
    for name in TABLE["entries"]:
        library.find(found[name].py_func)


def test_kernels_are_compiled_once() -> None:
    """One function serves all dtypes, packings, layouts and sizes of frames."""
    assert {
        name: len(entry["overloads"]) for name, entry in TABLE["entries"].items() if len(entry["overloads"]) > 1
    } == {}


SEPARATE = """
import hashlib, os, sys
import numpy as np
from polsep.kernels import *
from polsep.sensor.camera import Layout
set_threads(int(sys.argv[1]))
raw = np.random.default_rng(7).integers(0, 4096, (96, 128), np.uint16)
raw[40:60, 40:60] = 4095

def digest():
    images = separate_analytic_half(raw, Layout(), 0, 4095, AnalyticOptions(report=True))
    options = ColorAffineOptions(guided=True, report=True)
    found = [images, separate_color_affine_half(raw, Layout(), 0, 4095, options)]
    arrays = [getattr(one, name) for one in found for name in ("diffuse", "specular", "valid", "dolp", "aolp")]
    return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()

print(digest(), "numba" in sys.modules, flush=True)
if sys.argv[2] == "fork" and os.fork() == 0:
    print(digest(), "numba" in sys.modules, flush=True)
    os._exit(0)
"""


def run_separate(threads: int, *, fork: bool = False, **environment: str) -> list[str]:
    """Hash of the images of a frame, and whether numba was imported, in another process and its child."""
    command = [sys.executable, "-c", SEPARATE, str(threads), "fork" if fork else ""]
    done = subprocess.run(
        command, env=os.environ | environment, check=True, capture_output=True, text=True, timeout=600, cwd=ROOT
    )
    return done.stdout.split("\n")[:-1]


@needs_library
def test_bytes_are_those_of_numba() -> None:
    """Numba for the same processor, one thread, two threads and a forked child: all images are the same.

    The run in which numba compiles may round in another way: it calls functions before they are optimized together.
    """
    for _ in ("compile", "load"):
        found = run_separate(1, POLSEP_KERNELS="jit", NUMBA_CPU_NAME="x86-64-v3", NUMBA_CPU_FEATURES="")
    expected = found[0].split()[0]
    assert run_separate(1, fork=True) == [f"{expected} False"] * 2
    assert run_separate(2) == [f"{expected} False"]


@needs_library
def test_frames_are_separated_without_numba() -> None:
    """Every method, also at full resolution, needs neither numba nor llvmlite."""
    code = """
import sys, warnings
import numpy, polsep
warnings.simplefilter("ignore")
raw = numpy.random.default_rng(1).integers(0, 4000, (64, 64), numpy.uint16)
for method in ("analytic", "color-affine", "paper", "joint-fast"):
    for full in (False, True):
        polsep.separate(raw, method, white_level=4095, full=full)
print(sorted({name.split(".")[0] for name in sys.modules} & {"numba", "llvmlite"}))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=300, cwd=ROOT
    )
    assert done.stdout.strip() == "[]"


@needs_library
@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ((LEVEL, (8, 8), PLACES.astype(np.int32)), "expected int64 C1, found int32 C1"),
        ((LEVEL.astype(np.float64), (8, 8), PLACES), "expected float32 C3, found float64 C3"),
        ((LEVEL[0], (8, 8), PLACES), "expected float32 C3, found float32 C2"),
        ((LEVEL[:, :, ::2], (8, 8), PLACES), "expected float32 C3, found float32 A3"),
        ((LEVEL.tolist(), (8, 8), PLACES), "expected float32 C3, found list"),
        ((LEVEL, (8.0, 8), PLACES), "expected int64, found float"),
        ((LEVEL, (True, 8), PLACES), "expected int64, found bool"),
        ((LEVEL, (8, 2**63), PLACES), "expected int64, found int"),
        ((LEVEL, (8, 8, 8), PLACES), "expected a tuple of 2, found a tuple of 3"),
        ((LEVEL, [8, 8], PLACES), "expected a tuple of 2, found list"),
        ((LEVEL, (8, 8)), "expected a tuple of 3, found a tuple of 2"),
    ],
)
def test_other_arguments_are_refused(arguments: tuple[Any, ...], problem: str) -> None:
    with pytest.raises(TypeError, match=f"fill_kernel:_push_at: {problem}"):
        library.find(fill_kernel._push_at.py_func)(*arguments)


@needs_library
def test_frames_that_cannot_be_written_are_refused_where_kernels_write() -> None:
    code, level = library.find(fill_kernel._halve_planes.py_func), np.zeros((6, 2, 2), np.float32)
    with pytest.raises(TypeError, match="expected float32 C3, found float32 readonly C3"):
        code(LEVEL, read_only(level))


@needs_library
def test_images_that_cannot_be_written_are_read() -> None:
    """As those of files are: separating, repairing, filtering and showing them."""
    image, raw = read_only(np.full((16, 16, 3), 0.5, np.float32)), read_only(np.full((16, 16), 0.5, np.float32))
    assert separate_analytic_half(raw, Layout(), 0, 1).diffuse.max() > 0
    assert separate_color_affine_half(raw, Layout(), 0, 1).diffuse.max() > 0
    assert len(defects_kernel.find_candidates(raw, defects_kernel.Rules._make([ONE] * 9 + [4]))) == 0
    near = neighbours(16, 0, 4)
    assert mix_neighbours(raw, ZERO, near, near, np.zeros((4, 4, 4), np.float32)).shape == (16, 16)
    np.testing.assert_allclose(filter_image(image, read_only(np.ones(1, np.float32))), image)
    np.testing.assert_array_equal(blend_images((image, image), read_only(np.ones((4, 4), np.float32)), 4), image)
    assert make_panels((image, image), 1.0, read_only(np.zeros(STEPS + 1, np.uint8)), 16).shape == (16, 48, 3)


@needs_library
def test_named_tuples_have_their_fields() -> None:
    """Another tuple of the same values is refused, and what comes back has its own type."""
    code = library.find(strips_kernel.open_strip.py_func)
    strip = code(source(), (0, 32), 0)
    assert type(strip) is strips_kernel.Strip and type(strip.rows) is strips_kernel.Rows
    assert (strip.start, strip.stop) == (0, 32)
    with pytest.raises(TypeError, match=r"expected a tuple of \('samples', 'pattern', 'grid'\), found a tuple of 3"):
        code(tuple(source()), (0, 32), 0)


@needs_library
def test_memory_lives_as_long_as_its_arrays() -> None:
    """Arrays that a kernel made stay as they are while others come and go, and go when nobody has them."""
    code, frame = library.find(strips_kernel.open_strip.py_func), source()
    kept = code(frame, (0, 32), 8).rings.stokes
    kept[...] = 7
    for _ in range(20):
        code(frame, (0, 32), 8)
    before = psutil.Process().memory_info().rss
    for _ in range(2000):
        code(frame, (0, 32), 8)
    assert psutil.Process().memory_info().rss - before < 200 * kept.nbytes
    np.testing.assert_array_equal(kept, 7)


def bind(entry: Any) -> Any:
    """The code that a fresh process would call for a kernel."""
    return compiling._bind(Entry(entry.py_func, entry.options))


@pytest.fixture
def _afresh() -> Any:
    """Nothing is known of the library, before a test and after it."""
    for known in (library.find, library.open_library):
        known.cache_clear()
    yield
    for known in (library.find, library.open_library):
        known.cache_clear()


@pytest.mark.usefixtures("_afresh")
@pytest.mark.parametrize(
    ("place", "name", "value", "reason"),
    [
        (library, "source_stamp", lambda module: "another", "compiling has changed: make kernels"),
        (library, "PATH", Path("/nowhere/kernels.so"), "kernels.so cannot be loaded"),
        (library, "FORMAT", 0, "do not belong together: make kernels"),
        (library, "cpu_flags", lambda: processor.cpu_flags() - {"avx2", "fma"}, "the processor has no avx2, fma"),
        (library, "cpu_flags", frozenset, "the processor has no abm"),
        (fill_kernel, "_MIN_WEIGHT", np.float32(1), "fill_kernel:_MIN_WEIGHT has changed: make kernels"),
    ],
)
def test_numba_compiles_what_the_library_does_not_have(
    monkeypatch: pytest.MonkeyPatch, place: Any, name: str, value: object, reason: str
) -> None:
    """Other sources, constants, tables and processors, and no library at all."""
    if sys.platform == "linux" and processor.cpu_flags() >= processor.X86_64_V3:
        assert isinstance(bind(fill_kernel._push_at), library._Code)
    for known in (library.find, library.open_library):
        known.cache_clear()
    monkeypatch.setattr(place, name, value)
    if sys.platform == "linux":
        with pytest.raises(library.Unusable, match=reason):
            library.find(fill_kernel._push_at.py_func)
    assert hasattr(bind(fill_kernel._push_at), "signatures")


def test_without_library_and_numba_one_line_says_so() -> None:
    code = """
import sys
sys.modules["numba"] = None
from polsep.kernels import warm_up
try:
    warm_up()
except ImportError as error:
    print(error)
"""
    environment = os.environ | {compiling.CHOICE: "jit"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True, timeout=300, cwd=ROOT)
    assert done.stdout == (
        "expected compiled code of _separate_rows, found none (POLSEP_KERNELS=jit) and no numba to compile it: "
        "pip install numba\n"
    )


def test_numba_compiles_if_it_shall(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(compiling.CHOICE, "jit")
    assert hasattr(bind(analytic_kernel._separate_rows), "signatures")
    monkeypatch.setenv(compiling.CHOICE, "numpy")
    with pytest.raises(ValueError, match="expected POLSEP_KERNELS=jit or nothing, found 'numpy'"):
        bind(analytic_kernel._separate_rows)


def test_kernels_are_pickled_by_name() -> None:
    """Other processes get the kernel of that name."""
    assert pickle.loads(pickle.dumps(fill_kernel._push)) is fill_kernel._push
