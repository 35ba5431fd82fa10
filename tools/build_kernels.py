"""Compile the kernels of polsep ahead of time, into the library that comes with it: ``make kernels``.

Numba compiles what `tools.kernel_calls` calls, for processors of the level x86-64-v3. The code of every entry, and a
function with a plain C interface that calls it (`polsep.compute.library`), are linked to a library that needs neither
Python nor numba.
"""

from __future__ import annotations

import os
import tempfile

# Numba reads these when it is imported; in a cache in use it would find code for this machine. One thread: one order.
os.environ.update(NUMBA_CPU_NAME="x86-64-v3", NUMBA_CPU_FEATURES="", POLSEP_KERNELS="jit", OMP_NUM_THREADS="1")
os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp(prefix="polsep-kernels-")

import atexit
import gc
import hashlib
import json
import re
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
from llvmlite import ir
from numba.core import cgutils, types

from polsep.compute import library
from polsep.compute.compiling import Entry, reach
from tools.kernel_calls import call_kernels

WORD = ir.IntType(64)
#: Types of numba whose members its annotations do not know.
_TUPLE: Any = types.BaseTuple
_NAMED_TUPLE: Any = types.BaseNamedTuple
#: Offsets of the addresses of shape and strides in NumPy's objects of arrays (``PyArrayObject_fields``).
SHAPE_AT, STRIDES_AT = library.DATA_AT + 16, library.DATA_AT + 24
#: The oldest glibc that shall have what the library takes from the system: that of torch's wheels.
NEWEST_GLIBC = (2, 28)


#: Pickled exceptions in LLVM's code, which name files of this machine; polsep reads the status only.
EXCEPTION = re.compile(r'^(@\.const\.pickledata\.[\w.]+ = .*constant \[\d+ x i8\]) c".*"', re.MULTILINE)


class Table:
    """The table of the library, as it grows, and the code of its functions."""

    def __init__(self) -> None:
        self.entries: dict[str, Any] = {}
        self.sources: dict[str, str] = {}
        self.constants: dict[str, str] = {}
        self.tuples: list[dict[str, Any]] = []
        self.modules: list[str] = []
        self.symbols: list[str] = []

    def add(self, entry: Entry) -> None:
        """Add the code of an entry, for all types that it was compiled for."""
        sources, constants = {"polsep.compute.compiling"}, set()
        for function, named in reach(entry.py_func):
            sources.add(function.__module__)
            for module, name, value in named:
                text = library.describe(value)
                if text is not None:
                    constants.add(f"{module}:{name}")
                    self.constants[f"{module}:{name}"] = text
        self.sources |= {module: library.source_stamp(module) for module in sources}
        overloads = []
        for overload in entry.dispatcher.overloads.values():
            symbol = f"k{len(self.symbols)}_{entry.__name__.strip('_')}"
            self.symbols.append(symbol)
            self.modules += [overload.library.get_llvm_str(), write_bridge(overload, symbol)]
            arguments = [self.kind(each) for each in overload.signature.args]
            overloads.append({"arguments": arguments, "returns": self.kind(overload.signature.return_type)})
            overloads[-1]["symbol"] = symbol
        name = library.name_of(entry.py_func)
        self.entries[name] = {"overloads": overloads, "sources": sorted(sources), "constants": sorted(constants)}

    def kind(self, kind: Any) -> library.Kind:
        """A type of numba as the table writes it; named tuples are added to it."""
        if isinstance(kind, types.NoneType):
            return None
        if isinstance(kind, types.Array) and kind.layout in "CA" and kind.aligned:
            layout = f"{'C' if kind.layout == 'C' else 'A'}{kind.ndim}"
            return f"{kind.dtype} {'' if kind.mutable else 'readonly '}{layout}"
        if isinstance(kind, _NAMED_TUPLE):
            fields = {"name": library.name_of(kind.instance_class), "fields": list(kind.fields)}
            fields["kinds"] = [self.kind(each) for each in kind]
            if fields not in self.tuples:
                self.tuples.append(fields)
            return self.tuples.index(fields)
        if isinstance(kind, _TUPLE):
            return [self.kind(each) for each in kind]
        if isinstance(kind, types.Boolean | types.Number) and not isinstance(kind, types.Complex):
            return str(kind)
        raise TypeError(f"expected numbers, arrays of rows and tuples of them, found {kind}")

    def write(self, stamp: str) -> str:
        """The table as JSON, one entry a line."""
        parts = {"format": library.FORMAT, "library": stamp, "numba": numba.__version__}
        groups = {"sources": self.sources, "constants": self.constants, "entries": self.entries}
        text = ",\n".join(f"{json.dumps(key)}: {json.dumps(value)}" for key, value in parts.items())
        for key, group in groups.items():
            lines = ",\n".join(f"  {json.dumps(name)}: {json.dumps(value)}" for name, value in sorted(group.items()))
            text += f",\n{json.dumps(key)}: {{\n{lines}\n}}"
        lines = ",\n".join(f"  {json.dumps(each)}" for each in self.tuples)
        return f'{{\n{text},\n"tuples": [\n{lines}\n]\n}}\n'


def write_bridge(overload: Any, symbol: str) -> str:
    """LLVM code of the function ``int symbol(words, results)`` that calls a compiled function."""
    context, signature = overload.target_context, overload.signature
    module = context.codegen().create_library(symbol).create_ir_module(symbol)
    callee = context.declare_function(module, overload.fndesc)
    function = ir.Function(module, ir.FunctionType(ir.IntType(32), [WORD.as_pointer()] * 2), symbol)
    builder = ir.IRBuilder(function.append_basic_block())
    bridge = Bridge(context, builder, *function.args)
    arguments = [bridge.load(kind) for kind in signature.args]
    status, result = context.call_conv.call_function(builder, callee, signature.return_type, signature.args, arguments)
    with builder.if_then(status.is_error):
        builder.ret(status.code)
    bridge.store(signature.return_type, result)
    builder.ret(ir.Constant(ir.IntType(32), 0))
    return str(cgutils.normalize_ir_text(str(module)))


class Bridge:
    """Code from words to values of numba and back; state: the places of the next words."""

    def __init__(self, context: Any, builder: ir.IRBuilder, words: ir.Value, results: ir.Value) -> None:
        self.context, self.builder = context, builder
        self.words, self.results, self.taken, self.given = words, results, 0, 0

    def load(self, kind: Any) -> ir.Value:
        """The next argument."""
        if isinstance(kind, _TUPLE):
            return self.context.make_tuple(self.builder, kind, [self.load(each) for each in kind])
        word = self.builder.load(self.builder.gep(self.words, [WORD(self.taken)]))
        self.taken += 1
        return self.load_array(kind, word) if isinstance(kind, types.Array) else self.from_word(kind, word)

    def load_array(self, kind: Any, address: ir.Value) -> ir.Value:
        """The array of a NumPy object; its memory is not numba's."""
        builder, array = self.builder, self.context.make_array(kind)(self.context, self.builder)
        shape = self.read_words(address, SHAPE_AT, kind.ndim)
        count, size = WORD(1), WORD(self.context.get_abi_sizeof(self.context.get_data_type(kind.dtype)))
        steps = [size]
        for length in shape[::-1]:
            count = builder.mul(count, length)
            steps.append(builder.mul(steps[-1], length))
        strides = steps[-2::-1] if kind.layout == "C" else self.read_words(address, STRIDES_AT, kind.ndim)
        array.meminfo, array.parent = (cgutils.get_null_value(each.type) for each in (array.meminfo, array.parent))
        array.nitems, array.itemsize = count, size
        array.data = builder.inttoptr(self.read_word(address, library.DATA_AT), array.data.type)
        array.shape, array.strides = (cgutils.pack_array(builder, each, WORD) for each in (shape, strides))
        return array._getvalue()

    def read_word(self, address: ir.Value, offset: int) -> ir.Value:
        """The word at an address."""
        at = self.builder.add(address, WORD(offset))
        return self.builder.load(self.builder.inttoptr(at, WORD.as_pointer()))

    def read_words(self, address: ir.Value, offset: int, count: int) -> list[ir.Value]:
        """The first words of an array to which an address points."""
        start = self.read_word(address, offset) if count else address
        return [self.read_word(start, 8 * k) for k in range(count)]

    def from_word(self, kind: Any, word: ir.Value) -> ir.Value:
        """A number in the first bytes of a word."""
        place, target = cgutils.alloca_once_value(self.builder, word), self.context.get_data_type(kind)
        found = self.builder.load(self.builder.bitcast(place, target.as_pointer()))
        return self.context.data_model_manager[kind].from_data(self.builder, found)

    def store(self, kind: Any, value: ir.Value) -> None:
        """Write a result to the next words."""
        if isinstance(kind, _TUPLE):
            for k, each in enumerate(kind):
                self.store(each, self.builder.extract_value(value, k))
        elif isinstance(kind, types.Array):
            array = self.context.make_array(kind)(self.context, self.builder, value)
            sizes = [each for part in (array.shape, array.strides) for each in cgutils.unpack_tuple(self.builder, part)]
            for word in (array.meminfo, array.data, *sizes):
                self.write_word(self.builder.ptrtoint(word, WORD) if word.type.is_pointer else word)
        elif not isinstance(kind, types.NoneType):
            place = cgutils.alloca_once_value(self.builder, WORD(0))
            number = self.context.data_model_manager[kind].as_data(self.builder, value)
            self.builder.store(number, self.builder.bitcast(place, number.type.as_pointer()))
            self.write_word(self.builder.load(place))

    def write_word(self, word: ir.Value) -> None:
        """Write the next word of the results."""
        self.builder.store(word, self.builder.gep(self.results, [WORD(self.given)]))
        self.given += 1


def find_entries() -> list[Entry]:
    """All entries of the package that were compiled."""
    found = {library.name_of(each): each for each in gc.get_objects() if type(each) is Entry}
    return [found[name] for name in sorted(found) if found[name].dispatcher.overloads]


def compile_object(table: Table, path: Path) -> None:
    """Machine code of all functions of a table, of which only its symbols can be seen from outside."""
    module = llvm.parse_assembly("")
    for text in table.modules:
        module.link_in(llvm.parse_assembly(EXCEPTION.sub(r"\1 zeroinitializer", text)))
    for each in (*module.functions, *module.global_variables):
        if not each.is_declaration and each.name not in table.symbols:
            each.linkage = "internal"
    machine = llvm.Target.from_triple(llvm.get_process_triple()).create_target_machine(
        cpu=os.environ["NUMBA_CPU_NAME"], opt=3, reloc="pic", codemodel="default"
    )
    passes = llvm.create_new_module_pass_manager()
    passes.add_global_dead_code_eliminate_pass()
    passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(3)))
    path.write_bytes(machine.emit_object(module))


def link(code: Path, stamp: str, target: Path) -> None:
    """Link the code, and what it needs of a runtime, to a library."""
    runtime = Path(__file__).with_name("kernel_runtime.c")
    options = ["-shared", "-O2", "-fPIC", "-s", f'-DSTAMP="{stamp}"']
    options += ["-Wl,--build-id=none", "-Wl,-z,defs", "-Wl,--wrap=exp,--wrap=hypot"]
    subprocess.run(["gcc", *options, runtime, code, "-lm", "-o", target], check=True)


def check_needs(target: Path) -> None:
    """Raise RuntimeError if a library needs functions newer than `NEWEST_GLIBC`, or of anything but glibc."""
    listed = subprocess.run(["nm", "-D", "--undefined-only", target], check=True, capture_output=True, text=True).stdout
    needs = re.findall(r"[Uw] (\S+?)(?:@+(\S+))?$", listed, re.MULTILINE)
    for name, version in needs:
        known = re.fullmatch(r"GLIBC_(\d+)\.(\d+)(?:\.\d+)?", version)
        weak = not version and name.startswith(("_ITM_", "__gmon_start__"))
        if not weak and (known is None or tuple(map(int, known.groups())) > NEWEST_GLIBC):
            raise RuntimeError(f"expected functions of glibc {NEWEST_GLIBC} at most, found {name} {version}")
    print("from the system:", ", ".join(name for name, version in needs if version))


def main() -> None:
    """Compile, link, and write the library and its table."""
    started = time.monotonic()
    atexit.register(shutil.rmtree, os.environ["NUMBA_CACHE_DIR"])
    call_kernels()
    print(f"compiled in {time.monotonic() - started:.0f} s")
    table = Table()
    for entry in find_entries():
        table.add(entry)
    with tempfile.TemporaryDirectory() as folder:
        code, target = Path(folder) / "kernels.o", Path(folder) / library.PATH.name
        compile_object(table, code)
        stamp = hashlib.sha256(code.read_bytes()).hexdigest()[: library.STAMP_SIZE]
        link(code, stamp, target)
        check_needs(target)
        beside = library.PATH.with_suffix(".new")
        shutil.copyfile(target, beside)
        beside.replace(library.PATH)  # processes that have loaded the old one keep it
    library.PATH.with_suffix(".json").write_text(table.write(stamp))
    size = library.PATH.stat().st_size / 1024
    print(f"{library.PATH.name}: {len(table.entries)} kernels in {len(table.symbols)} functions, {size:.0f} KiB")


if __name__ == "__main__":
    main()
