"""Kernels compiled by numba on first use, for development and for machines that the library is not made for.

Compiled code is kept on disk where numba keeps it: in ``__pycache__`` beside the kernels or, where that cannot be
written, in the user's cache folder (``NUMBA_CACHE_DIR`` overrides both). Numba alone would renew it only when the file
of the `compiling.entry` changes. Here it is renewed exactly when the code of the entry, of anything that it calls, a
constant or the fields of a tuple change: not by comments, nor by the path or the time of a file.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable, Iterator
from types import CodeType
from typing import Any

import numpy as np
from numba import njit
from numba.core import event, types
from numba.core.caching import FunctionCache, IndexDataCacheFile

from polsep.compute import compiling, warm_up


def make_dispatcher(function: Callable[..., Any], options: dict[str, Any], cached: bool) -> Any:
    """Numba's dispatcher of a function, whose code is kept on disk if ``cached``."""
    fastmath = options["fastmath"]
    given: dict[str, Any] = options | {"fastmath": set(fastmath) if isinstance(fastmath, tuple) else fastmath}
    decorated: Any = njit(**given)(function)
    if cached:
        decorated._cache = _Cache(function)  # type: ignore[no-untyped-call]
    return decorated


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


class _Announcer(event.Listener):
    """Tells whoever waits for kernels that numba compiles."""

    def on_start(self, event: Any) -> None:
        del event
        warm_up.announce_compilation()

    def on_end(self, event: Any) -> None:
        del event


event.register("numba:compile", _Announcer())


def fingerprint(function: Callable[..., Any]) -> str:
    """Hash of the code of a function, of all compiled functions that it calls, and of the constants that they use."""
    text = [_describe(tuple(compiling.OPTIONS.items()))]
    for current, named in compiling.reach(function):
        text.append(f"{current.__module__}.{current.__qualname__}")
        for code in compiling.codes(current.__code__):
            constants = [c for c in code.co_consts if not isinstance(c, CodeType) and c != current.__doc__]
            text += [code.co_code.hex(), _describe(tuple(constants)), _describe(code.co_names), str(code.co_argcount)]
        text += [f"{name}={_describe(value)}" for _, name, value in named]
    return hashlib.sha256("\n".join(text).encode()).hexdigest()


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
    options = getattr(value, "options", None) or getattr(value, "targetoptions", {})  # of kernels
    name, fields = getattr(value, "__qualname__", type(value).__name__), getattr(value, "_fields", "")
    return f"{name}{fields}{_describe(tuple(options.items()))}" if isinstance(options, dict) else f"{name}{fields}"


def _fields(signature: Any) -> Iterator[tuple[str, ...]]:
    """Fields of all named tuples in a signature, in which numba names only their types."""
    for kind in signature:
        if isinstance(kind, types.BaseNamedTuple):
            yield kind.fields  # type: ignore[attr-defined]
        if isinstance(kind, types.BaseTuple):
            yield from _fields(kind)
