"""Choice of one of Mitsuba's compiled variants, and work inside it.

In the fast one a number is an array over all paths, and Python only records what is compiled; in the slow one it is a
float, and each path runs in Python. The same code serves both, but for a path that ends: see `is_over`.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi

#: Compiled just in time for all cores; and one number at a time, which works everywhere.
FAST_VARIANT, SLOW_VARIANT = "llvm_ad_mono_polarized", "scalar_spectral_polarized"
#: Where Debian keeps an LLVM that Mitsuba works with. Its default may be 14, which fails, or 15, which aborts.
LLVM_PATH = "/usr/lib/x86_64-linux-gnu/libLLVM-19.so"
#: What an LLVM must compile: additions alone would pass with one that aborts at the first maximum.
PROBE = f"""
import drjit, mitsuba
mitsuba.set_variant({FAST_VARIANT!r})
scene = mitsuba.load_dict({{"type": "scene", "cube": {{"type": "cube", "bsdf": {{"type": "pplastic"}}}}}})
origin = mitsuba.Point3f(drjit.linspace(mitsuba.Float, -0.5, 0.5, 16), 0, 5)
hit = scene.ray_intersect(mitsuba.Ray3f(origin, mitsuba.Vector3f(0, 0, -1)))
light = hit.bsdf().eval(mitsuba.BSDFContext(), hit, hit.wi)[0, 0][0]
assert drjit.all(drjit.maximum(light, 0) > 0)
"""


@lru_cache(maxsize=1)
def find_variant() -> str:
    """`FAST_VARIANT` where LLVM works, else `SLOW_VARIANT`; asked of another process, which a bad LLVM would abort.

    Takes ``DRJIT_LIBLLVM_PATH`` from the environment, or sets it to `LLVM_PATH` if that works.
    """
    given = os.environ.get("DRJIT_LIBLLVM_PATH")
    for path in (LLVM_PATH,) if given is None else (given,):
        environment = {**os.environ, "DRJIT_LIBLLVM_PATH": path}
        done = subprocess.run([sys.executable, "-c", PROBE], env=environment, capture_output=True, check=False)
        if done.returncode == 0:
            os.environ["DRJIT_LIBLLVM_PATH"] = path
            return FAST_VARIANT
    return SLOW_VARIANT


@contextmanager
def in_variant(variant: str) -> Iterator[None]:
    """Mitsuba's classes are those of the variant inside, and those of before after it."""
    before = mi.variant()
    mi.set_variant(variant)
    try:
        yield
    finally:
        if before is not None:
            mi.set_variant(before)


@contextmanager
def only_errors() -> Iterator[None]:
    """Mitsuba logs no warnings inside."""
    before = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        mi.set_log_level(before)


def is_fast() -> bool:
    """True if the numbers of the current variant are arrays."""
    return bool(dr.is_jit_v(mi.Float))


def is_over(active: Any) -> bool:
    """True if nothing is left to do: of a single path only, as one of many never ends for all."""
    return active is False


def fixed(value: float) -> Any:
    """A number that is the same for all paths and no constant of the compiled code, which then serves other values."""
    return dr.opaque(mi.Float, float(value))


def fixed_vector(vector: Any) -> Any:
    """`fixed` for three numbers."""
    return mi.Vector3f(*(fixed(x) for x in vector))
