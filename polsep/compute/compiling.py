"""Two decorators that compile kernels with numba, and the numbers that keep their arithmetic in float32.

Both decorators allow fused multiply-adds and ignore the sign of zero, but allow no reassociation and do not assume
finite values: bits do not depend on how loops are cut. Division by zero gives infinity or NaN, as in NumPy.

Compiled code is kept on disk where numba keeps it: in ``__pycache__`` beside the kernels or, where that cannot be
written, in the user's cache folder (``NUMBA_CACHE_DIR`` overrides both). Numba alone would renew it only when the file
of the `entry` changes. Here it is renewed exactly when the code of the `entry`, of anything that it calls, a constant
or the fields of a tuple change: not by comments, nor by the path or the time of a file.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable, Iterator
from types import CodeType, ModuleType
from typing import Any, TypeVar

import numpy as np
from numba import njit
from numba.core import types
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

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
    decorated: Any = njit(nogil=True, fastmath=_FASTMATH, error_model="numpy")(function)
    decorated._cache = _Cache(function)  # type: ignore[no-untyped-call]
    result: Compilable = decorated
    return result


class _CacheFile(IndexDataCacheFile):
    """Numba's file of one function; one that names types which are gone is of other code, like one of another stamp."""

    def _load_index(self) -> Any:
        try:
            return super()._load_index()  # type: ignore[no-untyped-call]
        except (AttributeError, ImportError):
            return {}


class _Cache(FunctionCache):
    """Numba's cache of one function, in numba's folder, that is valid for one `fingerprint`."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load as numba does; called before a function is compiled or saved, when all that it calls is defined."""
        name = f"{self._py_func.__module__.rpartition('.')[2]}.{self._py_func.__qualname__}"
        name = f"{name.replace('<', '').replace('>', '')}.py{sys.version_info[0]}{sys.version_info[1]}"
        stamp = fingerprint(self._py_func)
        self._cache_file = _CacheFile(self._cache_path, name, stamp)  # type: ignore[no-untyped-call]
        return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        return *super()._index_key(sig, codegen), tuple(_fields(sig))  # type: ignore[no-untyped-call]


def fingerprint(function: Callable[..., Any]) -> str:
    """Hash of the code of a function, of all compiled functions that it calls, and of the constants that they use."""
    text, hashed, pending = [_describe(_FASTMATH)], set(), [function]
    while pending:
        current = pending.pop()
        if current in hashed:
            continue
        hashed.add(current)
        text.append(f"{current.__module__}.{current.__qualname__}")
        names: list[str] = []
        for code in _codes(current.__code__):
            constants = [c for c in code.co_consts if not isinstance(c, CodeType) and c != current.__doc__]
            text += [code.co_code.hex(), _describe(tuple(constants)), _describe(code.co_names), str(code.co_argcount)]
            names += code.co_names
        for name, value in _globals(current, names):
            if isinstance(value, Dispatcher):
                pending.append(value.py_func)
                value = tuple(value.targetoptions.items())
            text.append(f"{name}={_describe(value)}")
    return hashlib.sha256("\n".join(text).encode()).hexdigest()


def _codes(code: CodeType) -> Iterator[CodeType]:
    """The code of a function and of all functions inside it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _globals(function: Callable[..., Any], names: list[str]) -> Iterator[tuple[str, Any]]:
    """The globals that a function names, and what it may name inside of modules among them."""
    for name in names:
        value = function.__globals__.get(name)
        if isinstance(value, ModuleType):
            yield from ((f"{name}.{each}", getattr(value, each)) for each in names if hasattr(value, each))
        elif value is not None:
            yield name, value


def _describe(value: Any) -> str:
    """Text of a constant that differs for another value; of types and functions their name and fields."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{value.shape}{value.tobytes().hex()}"
    if isinstance(value, tuple):
        return f"{getattr(value, '_fields', '')}({','.join(map(_describe, value))})"
    if isinstance(value, set | frozenset):  # in an order that differs between processes
        return f"{{{','.join(sorted(map(_describe, value)))}}}"
    if isinstance(value, np.generic | float | int | str):
        return f"{type(value).__name__} {value!r}"
    return f"{getattr(value, '__qualname__', type(value).__name__)}{getattr(value, '_fields', '')}"


def _fields(signature: Any) -> Iterator[tuple[str, ...]]:
    """Fields of all named tuples in a signature, in which numba names only their types."""
    for kind in signature:
        if isinstance(kind, types.BaseNamedTuple):
            yield kind.fields  # type: ignore[attr-defined]
        if isinstance(kind, types.BaseTuple):
            yield from _fields(kind)
