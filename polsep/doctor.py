"""The state of an installation: what it consists of, what will run a frame, and whether all that was promised works.

The self-test separates a crop of the embedded capture by every method. Its means are compared with those of the
release, so that damaged weights and code that computes something else are noticed, and not only what crashes. Libraries
are imported where they are examined: one that is missing or broken is a problem to report.
"""

from __future__ import annotations

import os
import platform
import re
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import polsep
from polsep.compute.installed import is_installed

#: Instruction sets that change what runs: the library of kernels needs AVX2 and FMA, layers use VNNI and AMX.
INSTRUCTIONS = ("avx2", "fma", "avx512f", "avx_vnni", "avx512_vnni", "amx_int8", "amx_bf16")
#: The crop of the capture that the self-test separates: rows and columns.
CROP = (slice(400, 912), slice(300, 812))
#: Means of the crop's diffuse and specular image by method, and the share of these by which they may differ: layers in
#: 8 bits, bfloat16 and float32 do by less.
MEANS = {
    "joint-large": (0.2237, 0.0095),
    "joint": (0.2244, 0.00913),
    "joint-fast": (0.2229, 0.01006),
    "color-affine": (0.2240, 0.00977),
    "analytic": (0.2170, 0.01614),
    "paper": (0.2219, 0.00932),
}
TOLERANCE = 0.02


def examine(extras: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    """Facts of this installation and machine, as JSON takes them; takes some seconds.

    ``extras``: modules by which each extra is known. "tests" are the self-tests with their seconds and errors.
    "problems" are what a bare install promises and does not work, one line each; empty where all is well.
    """
    tests: dict[str, dict[str, Any]] = {}
    facts: dict[str, Any] = {
        "polsep": polsep.__version__,
        "folder": str(Path(polsep.__file__).parent),
        "python": platform.python_version(),
        "system": platform.platform(),
        "packages": find_packages(),
        "cores": os.cpu_count(),
    }
    for name, find in _FACTS.items():
        facts[name] = _attempt(tests, name, find)
    facts["extras"] = {
        name: [module for module in modules if not is_installed(module)] for name, modules in extras.items()
    }
    facts["extra_packages"] = find_extra_packages(extras)
    names = _attempt(tests, "methods", _methods) or ()
    tests = {name: found for name, found in tests.items() if found["error"]}  # facts that could not be found
    for name in names:
        _attempt(tests, name, partial(check_method, name))
    _attempt(tests, "files", check_files)
    problems = [f"expected the package {name}, found none" for name, found in facts["packages"].items() if not found]
    problems += [f"{name}: {found['error']}" for name, found in tests.items() if found["error"]]
    return facts | {"tests": tests, "problems": problems}


def find_packages() -> dict[str, str | None]:
    """Versions of the packages that a bare install has, by name; None where one is missing.

    Numba counts where it is installed, or where the library of kernels is not for this machine.
    """
    with suppress(metadata.PackageNotFoundError):
        required = [line for line in metadata.requires("polsep") or () if "extra ==" not in line]
        names = [re.split(r"[^\w.-]", line)[0] for line in required]
        versions = {name: _version(name) for name in names}
        return {name: found for name, found in versions.items() if found or name != "numba" or _kernels() != "library"}
    return {}


def find_extra_packages(extras: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Versions of the installed packages that extras are known by, by name."""
    owners = metadata.packages_distributions()
    modules = {module for modules in extras.values() for module in modules if is_installed(module)}
    names = sorted({owners[module][0] for module in modules if module in owners})
    return {name: metadata.version(name) for name in names}


def check_method(name: str) -> None:
    """Raise ValueError unless a method makes of the crop what the release made."""
    import numpy as np

    found = separate_crop(name)
    means = [float(np.mean(image)) for image in (found.diffuse, found.specular)]
    if name in MEANS and any(abs(a - b) > TOLERANCE * b for a, b in zip(means, MEANS[name], strict=True)):
        diffuse, specular = MEANS[name]
        raise ValueError(
            f"expected means of {diffuse:.4f} diffuse and {specular:.4f} specular light, "
            f"found {means[0]:.4f} and {means[1]:.4f}"
        )


def check_files() -> None:
    """Raise unless a separation is written, with its preview, and read again."""
    from polsep.io.results.separation_reader import read_separated
    from polsep.io.results.separation_writer import write_separation

    found = separate_crop("analytic")
    with TemporaryDirectory() as folder:
        write_separation(found, Path(folder), "crop")
        again = read_separated(Path(folder) / "crop.exr")
        if not ((again.diffuse == found.diffuse).all() and (again.specular == found.specular).all()):
            raise ValueError("expected to read the images that were written, found others")


def separate_crop(method: str) -> Any:
    """The self-test's crop of the embedded capture, separated by a method."""
    from polsep.io.raw.frames import ReadOptions, read_frames
    from polsep.io.store.samples import DEMO, DEMO_WHITE

    frame = next(read_frames(DEMO, ReadOptions(white_level=DEMO_WHITE)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", polsep.PolsepWarning)
        return polsep.separate(frame.data.data[CROP], method, white_level=DEMO_WHITE, device="cpu")


def _attempt(tests: dict[str, dict[str, Any]], name: str, act: Callable[[], Any]) -> Any:
    """The value of ``act``, or None after an error; its seconds and the error, in one line, go to ``tests``."""
    from polsep.io.store.errors import one_line

    start, value, error = time.perf_counter(), None, None
    try:
        value = act()
    except Exception as raised:
        error = one_line(f"{type(raised).__name__}: {raised}")
    tests[name] = {"seconds": round(time.perf_counter() - start, 2), "error": error}
    return value


def _methods() -> list[str]:
    from polsep.methods import METHODS

    return list(METHODS)


def _threads() -> int:
    from polsep.compute.threads import get_threads

    return get_threads()


def _instructions() -> list[str]:
    from polsep.compute.processor import cpu_flags

    return [name for name in INSTRUCTIONS if name in cpu_flags()]


def _kernels() -> str:
    """ "library", or why numba compiles the kernels."""
    from polsep.compute import library
    from polsep.compute.compiling import CHOICE

    try:
        library.open_library()
    except library.Unusable as reason:
        return f"numba: {reason}"
    return f"numba: {CHOICE}=jit" if os.environ.get(CHOICE) == "jit" else "library"


def _cache() -> dict[str, Any]:
    """The folder of kernels that numba has compiled, where it is needed, and whether it can be written."""
    folder = Path(polsep.__file__).parent / "compute"
    if not is_installed("numba"):
        return {"needed": _kernels() != "library", "folder": None, "writable": False}
    from numba.core.caching import FunctionCache

    from polsep.separation.analytic_kernel import separate_analytic_half

    try:
        found: str | None = FunctionCache(separate_analytic_half).cache_path
    except RuntimeError:  # numba found no folder that it can write
        found = None
    return {"needed": _kernels() != "library", "folder": found or str(folder), "writable": found is not None}


def _precision() -> str:
    from polsep.networks.openvino_engine import usual_precision

    return usual_precision()


def _device() -> str:
    from polsep.compute.devices import find_device

    return find_device("auto")


def _cameras() -> dict[str, Any]:
    from polsep.capture.find import list_cameras

    found = list_cameras()
    return {"found": found.cameras, "missing": found.missing}


#: Facts by name, and what finds them.
_FACTS: dict[str, Callable[[], Any]] = {
    "threads": _threads,
    "instructions": _instructions,
    "kernels": _kernels,
    "cache": _cache,
    "precision": _precision,
    "device": _device,
    "cameras": _cameras,
}


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None
