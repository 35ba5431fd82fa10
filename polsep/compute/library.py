"""Kernels compiled ahead of time: a shared library with a plain C interface, and a table of what is in it.

``tools/build_kernels.py`` makes both (``make kernels``). The table names for every `compiling.entry` the sources and
constants that it was made of, and for every combination of argument types a function ``int f(words, results)``:

* ``words``: the arguments in order, tuples flattened, 8 bytes each: numbers by value, arrays by the address of their
  NumPy object, of which the library reads data, shape and strides;
* ``results``: what the kernel returns, flattened too; an array is the address of its memory block, which counts
  references (0: memory of an argument), of its data, its shape, and its strides;
* the return value is 0 unless the kernel failed.

Kinds of values are written like this: ``float32``; ``float32 C2`` for arrays of two dimensions without gaps, ``A2``
with any strides, ``readonly C2`` for those that the kernel does not write to; a list for a tuple; a number for one of
the table's named tuples.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib
import json
import pkgutil
import platform
import struct
import sys
from collections.abc import Callable, Iterator
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from polsep.compute.processor import X86_64_V3, cpu_flags

#: Version of the interface; a table of another one is of another polsep.
FORMAT = 1
#: Characters of the stamp that the library and its table share.
STAMP_SIZE = 16
#: The library, and beside it the table with the suffix ``.json``.
PATH = Path(__file__).with_name("kernels-linux-x86_64.so")

#: A kind of value, see above.
Kind = Any
#: Appends the words of a value. Raises TypeError on a value of another kind.
Packer = Callable[[Any, list[Any]], None]
#: Makes a value of the next words of a result and the arguments of its call.
Unpacker = Callable[[Iterator[Any], tuple[Any, ...]], Any]

# Bits of the flags of NumPy's arrays.
_CONTIGUOUS, _ALIGNED, _WRITABLE = 0x1, 0x100, 0x400
#: Offset of the address of the data within NumPy's objects of arrays, as the library was built for.
DATA_AT = 16
#: How words hold numbers, for `struct`; other numbers are whole.
_FORMATS = {"float32": "f4x", "float64": "d", "uint64": "Q"}
#: Python's own types of numbers, beside NumPy's.
_PLAIN: dict[str, type] = {"int64": int, "float64": float, "bool": bool}


class Unusable(Exception):
    """The library has no code of a kernel for this machine and these sources; the text says why."""


@cache
def find(function: Callable[..., Any]) -> Callable[..., Any]:
    """The library's code of a kernel, to call with the function's arguments.

    Raises Unusable unless there is any, made of these very sources. What it returns raises TypeError on arguments of
    types that it was not compiled for.
    """
    name, library = name_of(function), open_library()
    found = library.table["entries"].get(name)
    if found is None:
        raise Unusable("not in the library")
    for module in found["sources"]:
        if source_stamp(module) != library.table["sources"][module]:
            raise Unusable(f"{module} has changed: make kernels")
    for constant in found["constants"]:
        module, _, member = constant.partition(":")
        if describe(getattr(sys.modules.get(module), member, None)) != library.table["constants"][constant]:
            raise Unusable(f"{constant} has changed: make kernels")
    return _Code(library, name, found["overloads"])


def name_of(function: Any) -> str:
    """The name of a function or type in the table."""
    return f"{function.__module__}:{function.__qualname__}"


@cache
def source_stamp(module: str) -> str:
    """Hash of the text of a module, by which the table knows it; empty without a text."""
    package, _, name = module.rpartition(".")
    try:
        text = pkgutil.get_data(package, f"{name}.py") if package else None
    except OSError:
        text = None
    return "" if text is None else hashlib.sha256(text).hexdigest()[:16]


def describe(value: Any) -> str | None:
    """Text of a constant that differs for another value; None for what is no data, such as a function.

    Types of named tuples differ by their fields.
    """
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{value.shape} {hashlib.sha256(value.tobytes()).hexdigest()[:16]}"
    if isinstance(value, tuple):
        parts = [describe(part) for part in value]
        return None if None in parts else f"({', '.join(map(str, parts))})"
    if isinstance(value, np.generic):
        return f"{value.dtype} {value.item()!r}"
    if isinstance(value, type) and hasattr(value, "_fields"):
        return f"{value.__qualname__}({', '.join(value._fields)})"
    return f"{type(value).__name__} {value!r}" if isinstance(value, float | int | str) else None


class _Library:
    """The library, loaded, and its table."""

    def __init__(self, code: ctypes.CDLL, table: dict[str, Any]) -> None:
        self.code, self.table = code, table
        self.release = code.polsep_release
        self.release.argtypes, self.release.restype = (ctypes.c_void_p,), None

    def function(self, symbol: str) -> Any:
        """A function of the library, see above."""
        found = self.code[symbol]
        found.argtypes, found.restype = (ctypes.c_char_p, ctypes.c_void_p), ctypes.c_int
        return found


@lru_cache(maxsize=1)
def open_library() -> _Library:
    """Load the library. Raises Unusable on a machine that it is not made for."""
    system = f"{sys.platform}-{platform.machine()}-{sys.implementation.name}"
    if system != "linux-x86_64-cpython":
        raise Unusable(f"the library is for linux-x86_64-cpython, this is {system}")
    missing = X86_64_V3 - cpu_flags()
    if missing:
        raise Unusable(f"the processor has no {', '.join(sorted(missing))}")
    probe = np.empty(1)
    if ctypes.c_size_t.from_address(id(probe) + DATA_AT).value != probe.ctypes.data:
        raise Unusable("NumPy's arrays are laid out in another way")
    try:
        text = pkgutil.get_data(__package__, PATH.with_suffix(".json").name)
        code = ctypes.CDLL(str(PATH))
        table: dict[str, Any] = json.loads(text or b"{}")
        stamp = (ctypes.c_char * STAMP_SIZE).in_dll(code, "polsep_stamp").value.decode()
    except (OSError, ValueError) as error:
        raise Unusable(f"{PATH.name} cannot be loaded: {error}") from error
    if table.get("format") != FORMAT or table.get("library") != stamp:
        raise Unusable(f"{PATH.name} and its table do not belong together: make kernels")
    return _Library(code, table)


class _Code:
    """The code of a kernel, for every combination of argument types that it was compiled for."""

    def __init__(self, library: _Library, name: str, overloads: list[dict[str, Any]]) -> None:
        self._name = name
        self._overloads = [_Overload(library, overload) for overload in overloads]

    def __call__(self, *args: Any) -> Any:
        problems = []
        for overload in self._overloads:
            words: list[Any] = []
            try:
                overload.pack(args, words)
            except TypeError as problem:
                problems.append(str(problem))
                continue
            return overload.run(words, args, self._name)
        raise TypeError(f"{self._name}: {'; or '.join(problems)}")


class _Overload:
    """The code of a kernel for one combination of argument types."""

    def __init__(self, library: _Library, overload: dict[str, Any]) -> None:
        tuples, returned = library.table["tuples"], overload["returns"]
        self.pack = _packer(overload["arguments"], tuples)
        self._words = struct.Struct("<" + "".join(_word_formats(overload["arguments"], tuples)))
        self._results = struct.Struct("<" + "".join(_result_formats(returned, tuples)))
        self._unpack = None if returned is None else _unpacker(returned, tuples, library.release)
        self._function = library.function(overload["symbol"])

    def run(self, words: list[Any], args: tuple[Any, ...], name: str) -> Any:
        """Call the code; ``args`` are what the words were packed of, and are alive until it returns."""
        results = ctypes.create_string_buffer(self._results.size)
        status = self._function(self._words.pack(*words), results)
        if status:
            raise RuntimeError(f"{name}: expected status 0, found {status}; kernels stop when memory runs out")
        return None if self._unpack is None else self._unpack(iter(self._results.unpack(results)), args)


def _packer(kind: Kind, tuples: list[Any]) -> Packer:
    """Packer of values of a kind; named tuples are known by their fields."""
    if isinstance(kind, str):
        return _array_packer(kind) if " " in kind else _number_packer(kind)
    fields = tuple(tuples[kind]["fields"]) if isinstance(kind, int) else None
    parts = [_packer(part, tuples) for part in _parts(kind, tuples)]

    def pack(value: Any, words: list[Any]) -> None:
        if not isinstance(value, tuple) or len(value) != len(parts) or getattr(value, "_fields", None) != fields:
            raise TypeError(f"expected a tuple of {fields or len(parts)}, found {_kind_of(value)}")
        for part, member in zip(parts, value, strict=True):
            part(member, words)

    return pack


def _array_packer(kind: str) -> Packer:
    """Packer of the address of an array."""
    dtype, layout = np.dtype(kind.split()[0]), kind.split()[-1]
    ndim, needed = int(layout[1:]), _ALIGNED
    needed |= (_CONTIGUOUS if layout[0] == "C" else 0) | (0 if "readonly" in kind else _WRITABLE)

    def pack(value: Any, words: list[Any]) -> None:
        if (
            not isinstance(value, np.ndarray)
            or value.ndim != ndim
            or value.dtype != dtype
            or value.flags.num & needed != needed
        ):
            raise TypeError(f"expected {kind}, found {_kind_of(value)}")
        words.append(id(value))

    return pack


def _number_packer(kind: str) -> Packer:
    """Packer of a number; as in compiled code, no type of numbers stands in for another."""
    types = {np.dtype(kind).type, _PLAIN.get(kind)}
    least, most = (-(2**63), 2**63) if kind != "uint64" else (0, 2**64)

    def pack(value: Any, words: list[Any]) -> None:
        if type(value) not in types or (type(value) is int and not least <= value < most):
            raise TypeError(f"expected {kind}, found {_kind_of(value)}")
        words.append(int(value) if kind == "bool" else value)

    return pack


def _unpacker(kind: Kind, tuples: list[Any], release: Callable[[int], None]) -> Unpacker:
    """Maker of results of a kind. Raises Unusable if a named tuple has other fields by now."""
    if isinstance(kind, str):
        return _array_unpacker(kind, release) if " " in kind else _number_unpacker(kind)
    parts = [_unpacker(part, tuples, release) for part in _parts(kind, tuples)]
    make: Callable[[Iterator[Any]], Any] = tuple
    if isinstance(kind, int):
        module, _, name = tuples[kind]["name"].partition(":")
        named = getattr(importlib.import_module(module), name, None)
        if getattr(named, "_fields", None) != tuple(tuples[kind]["fields"]):
            raise Unusable(f"{tuples[kind]['name']} has changed: make kernels")
        make = named._make  # type: ignore[union-attr]  # its fields are those of the table
    return lambda words, args: make(part(words, args) for part in parts)


def _array_unpacker(kind: str, release: Callable[[int], None]) -> Unpacker:
    """Maker of arrays on a kernel's memory, which is released with the last of them."""
    typestr, ndim = np.dtype(kind.split()[0]).str, int(kind.split()[-1][1:])

    def unpack(words: Iterator[Any], args: tuple[Any, ...]) -> Any:
        block, data, *sizes = (next(words) for _ in range(2 + 2 * ndim))
        array = {"version": 3, "typestr": typestr, "data": (data, "readonly" in kind)}
        array |= {"shape": tuple(sizes[:ndim]), "strides": tuple(sizes[ndim:])}
        return np.asarray(_Memory(array, block, release if block else None, args))

    return unpack


def _number_unpacker(kind: str) -> Unpacker:
    """Maker of numbers, Python's own where it has them."""
    make = _PLAIN.get(kind, np.dtype(kind).type)
    return lambda words, _: make(next(words))


class _Memory:
    """Memory of an array that a kernel returned: a block of its own, or else that of an argument."""

    def __init__(self, array: dict[str, Any], block: int, release: Callable[[int], None] | None, args: object) -> None:
        self.__array_interface__, self._block, self._release = array, block, release
        self._args = None if release else args

    def __del__(self) -> None:
        if self._release is not None:
            self._release(self._block)


def _parts(kind: Kind, tuples: list[Any]) -> list[Kind]:
    """Kinds of the members of a tuple."""
    return list(tuples[kind]["kinds"]) if isinstance(kind, int) else list(kind)


def _word_formats(kind: Kind, tuples: list[Any]) -> Iterator[str]:
    """Formats of the words of an argument, for `struct`."""
    if isinstance(kind, str):
        yield "Q" if " " in kind else _FORMATS.get(kind, "q")
    else:
        for part in _parts(kind, tuples):
            yield from _word_formats(part, tuples)


def _result_formats(kind: Kind, tuples: list[Any]) -> Iterator[str]:
    """Formats of the words of a result."""
    if isinstance(kind, str):
        yield "QQ" + 2 * int(kind.split()[-1][1:]) * "q" if " " in kind else _FORMATS.get(kind, "q")
    elif kind is not None:
        for part in _parts(kind, tuples):
            yield from _result_formats(part, tuples)


def _kind_of(value: Any) -> str:
    """The kind of an argument, for messages."""
    if isinstance(value, np.ndarray):
        layout = "C" if value.flags.c_contiguous else "A"
        return f"{value.dtype} {'' if value.flags.writeable else 'readonly '}{layout}{value.ndim}"
    if isinstance(value, tuple):
        return f"a tuple of {getattr(value, '_fields', len(value))}"
    return type(value).__name__
