"""Decorators of kernels, and the numbers that keep their arithmetic in float32.

A kernel is compiled ahead of time, into a library that comes with polsep (`polsep.compute.library`), or else on first
use by numba (`polsep.compute.jit`). This module imports neither, so that a kernel costs nothing until it is called.

All decorators allow no reassociation and do not assume finite values: bits do not depend on how loops are cut. Division
by zero gives infinity or NaN, as in NumPy. Unless said otherwise they allow fused multiply-adds and ignore the sign of
zero.
"""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable, Iterator
from types import CodeType, ModuleType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from polsep.compute import library

Compilable = TypeVar("Compilable", bound=Callable[..., Any])
Scalar = TypeVar("Scalar", bound=np.generic)

# A bare 1.0 in a kernel is a double, and so would be everything computed from it.
ZERO, ONE, TWO = np.float32(0), np.float32(1), np.float32(2)
HALF, THIRD, QUARTER = np.float32(0.5), np.float32(1 / 3), np.float32(0.25)

#: The environment variable that chooses compiled code: "jit" for numba; unset for the library where it is valid.
CHOICE = "POLSEP_KERNELS"

_FASTMATH = ("contract", "nsz")
#: Numba's options of all kernels.
OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": _FASTMATH}
# Wrappers for Python would take longer to compile than the functions themselves.
_CALLED: dict[str, Any] = OPTIONS | {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


class Kernel:
    """A function to compile and numba's ``options`` for it; numba's own dispatcher is made when it is asked for."""

    _lock = threading.RLock()

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self.__module__, self.__doc__ = function.__module__, function.__doc__
        self.__name__, self.__qualname__ = function.__name__, function.__qualname__
        self.py_func, self.options = function, options
        self._dispatcher: Any = None

    @property
    def dispatcher(self) -> Any:
        """Numba's dispatcher. Raises ImportError without numba."""
        from polsep.compute import jit

        with self._lock:
            if self._dispatcher is None:
                self._dispatcher = jit.make_dispatcher(self.py_func, self.options, isinstance(self, Entry))
            return self._dispatcher

    @property
    def _numba_type_(self) -> Any:
        """The type by which numba knows a global that kernels name."""
        return self.dispatcher._numba_type_

    def __reduce__(self) -> str:
        """Pickle by name, as functions are."""
        return self.py_func.__qualname__


class Entry(Kernel):
    """A kernel that Python calls. State: the compiled code it was bound to by the first call."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        super().__init__(function, options)
        self._code: Callable[..., Any] | None = None

    def __call__(self, *args: Any) -> Any:
        """Run the compiled code, without the interpreter's lock, so that threads overlap."""
        if self._code is None:
            self._code = _bind(self)
        return self._code(*args)


def compiled(function: Compilable) -> Compilable:
    """Decorator of everything that an `entry` calls: compiled into it, not callable from Python.

    Inside, copy arrays by loops: an assignment of slices brings numba's broadcasting with it, seconds of compilation.
    """
    result: Any = Kernel(function, _CALLED)
    return result  # type: ignore[no-any-return]


def inlined(function: Compilable) -> Compilable:
    """Decorator like `compiled`, inlined into the calling loop, which LLVM can vectorise only then."""
    result: Any = Kernel(function, _CALLED | {"forceinline": True})
    return result  # type: ignore[no-any-return]


def inlined_exactly(function: Compilable) -> Compilable:
    """Decorator like `inlined`, with every operation rounded on its own.

    ``fastmath=False`` must be given: without it numba compiles a function with its caller's setting.
    """
    result: Any = Kernel(function, _CALLED | {"forceinline": True, "fastmath": False})
    return result  # type: ignore[no-any-return]


def entry(function: Compilable) -> Compilable:
    """Decorator of what Python calls, by position: NumPy arrays, numbers and tuples of them."""
    result: Any = Entry(function, OPTIONS)
    return result  # type: ignore[no-any-return]


def read_only(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """A view that cannot be written, for what a kernel only reads.

    Kernels know such arrays as a type of their own. Whoever passes only them can pass frames that may not be written.
    """
    view = array.view()
    view.flags.writeable = False
    return view


def _bind(kernel: Entry) -> Callable[..., Any]:
    """The kernel's code in the library, or numba's. Raises ImportError if there is neither."""
    choice = os.environ.get(CHOICE, "")
    if choice not in ("", "jit"):
        raise ValueError(f"expected {CHOICE}=jit or nothing, found {choice!r}")
    try:
        if choice == "jit":
            raise library.Unusable(f"{CHOICE}=jit")
        return library.find(kernel.py_func)
    except library.Unusable as reason:
        logging.getLogger("polsep").debug("numba compiles %s: %s", kernel.__qualname__, reason)
        try:
            return kernel.dispatcher  # type: ignore[no-any-return]
        except ImportError as error:
            raise ImportError(
                f"expected compiled code of {kernel.__qualname__}, found none ({reason}) and no numba to compile it: "
                "pip install numba"
            ) from error


def reach(function: Callable[..., Any]) -> Iterator[tuple[Callable[..., Any], list[tuple[str, str, Any]]]]:
    """A function and all compiled ones that it calls, each with the globals that it names.

    Globals are told by their module, name and value; those inside of a named module, ``math.pi`` say, by that module.
    """
    seen, pending = set(), [function]
    while pending:
        current = pending.pop()
        if current in seen:
            continue
        seen.add(current)
        named = list(_globals(current))
        pending += [value.py_func for _, _, value in named if hasattr(value, "py_func")]
        yield current, named


def codes(code: CodeType) -> Iterator[CodeType]:
    """The code of a function and of all functions inside it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from codes(constant)


def _globals(function: Callable[..., Any]) -> Iterator[tuple[str, str, Any]]:
    """The globals that a function names, and what it may name inside of modules among them."""
    names = [name for code in codes(function.__code__) for name in code.co_names]
    for name in names:
        value = function.__globals__.get(name)
        if isinstance(value, ModuleType):
            yield from ((value.__name__, each, getattr(value, each)) for each in names if hasattr(value, each))
        elif value is not None:
            yield function.__module__, name, value
