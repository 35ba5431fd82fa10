"""How kernels are compiled: two decorators, and the numbers that keep their arithmetic in float32.

Both decorators allow fused multiply-adds and ignore the sign of zero, but no reassociation and no assumption of finite
values: bits do not depend on how loops are cut. Division by zero gives infinity or NaN, as in NumPy.

Compiled code is kept on disk by numba: in ``__pycache__`` beside the kernels or, where that cannot be written, in the
user's cache folder (``NUMBA_CACHE_DIR`` overrides both). Note: numba renews an `entry` when the file that defines it
changes, not when the modules that it imports do; after editing those, remove the ``__pycache__`` beside it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numba import njit

Compilable = TypeVar("Compilable", bound=Callable[..., Any])

# A bare 1.0 in a kernel is a double, and so would be everything computed from it.
ZERO, ONE, TWO = np.float32(0), np.float32(1), np.float32(2)
HALF, THIRD, QUARTER = np.float32(0.5), np.float32(1 / 3), np.float32(0.25)

_FASTMATH = {"contract", "nsz"}


def compiled(function: Compilable) -> Compilable:
    """Decorator of everything that an `entry` calls: compiled into it, not callable from Python, not cached on its own.

    Wrappers for Python would take longer to compile than the functions themselves. Inside, copy arrays by loops: an
    assignment of slices brings numba's broadcasting with it, seconds of compilation.
    """
    decorated: Compilable = njit(  # type: ignore[call-overload]  # numba's stubs lack its two options for wrappers
        nogil=True, fastmath=_FASTMATH, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True
    )(function)
    return decorated


def entry(function: Compilable) -> Compilable:
    """Decorator of what Python calls: cached on disk, and without the interpreter's lock, so that threads overlap."""
    decorated: Compilable = njit(  # type: ignore[assignment]  # its own type, called alike
        cache=True, nogil=True, fastmath=_FASTMATH, error_model="numpy"
    )(function)
    return decorated
