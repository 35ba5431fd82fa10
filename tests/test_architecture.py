"""The architecture, checked on the syntax trees: who imports whom, where files and codecs live, what is documented."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "polsep"

#: Rank of every subpackage: a folder or a module of the package. Modules import from lower ranks, or from their own.
RANKS = {
    "compute": 0,
    "physics": 1,
    "metrics": 1,
    "sensor": 2,
    "demosaic": 3,
    "light": 3,
    "separation": 4,
    "render": 4,
    "networks": 5,
    "io": 6,
    "datasets": 7,
    "shipped": 7,
    "photographs": 7,
    "in_torch": 8,
    "methods": 9,
    "pipeline": 10,
    "batch": 11,
    "calibrate": 11,
    "video": 11,
    "capture": 11,
    "material": 11,
    "geometry": 11,
    "edit": 12,
    "kernels": 12,
    "doctor": 12,
    "train": 13,
    "bench": 13,
    "view": 13,
    "cli": 14,
    "__main__": 15,
}
#: Rooms inside of io, which has the same rule.
IO_RANKS = {"store": 0, "raw": 1, "results": 2, "assets": 3}
#: Libraries that only one subpackage may use.
HOMES = {
    "imagecodecs": "io",
    "tifffile": "io",
    "OpenEXR": "io",
    "PIL": "io",
    "cv2": "compute",
    "rawpy": "io",
    "imageio": "io",
    "zipfile": "io",
    "argparse": "cli",
    "click": "cli",
    "torch.optim": "train",
    "embreex": "render",
    "safetensors": "io",
    "lightning_fabric": "train",
    "tensorboard": "io",
    "torch.utils.tensorboard": "io",
    "mitsuba": "render",
    "drjit": "render",
    "trimesh": "io",
    "scipy.io": "io",
    "ray": "compute",
    "onnxscript": "io",
    "onnx": "io",
    "flip_evaluator": "metrics",
    "openvino": "networks",
    "av": "io",
    "gi": "capture",
    "pypylon": "capture",
    "gradio": "view",
    "magicgui": "view",
    "napari": "view",
}
#: Calls that touch files, by name of the function or method.
FILE_CALLS = {"open", "read_bytes", "write_bytes", "read_text", "write_text", "imread", "imwrite", "fromfile", "tofile"}
FILE_CALLS |= {"save", "savez", "savez_compressed", "mkdir", "unlink", "rmdir", "rename", "touch"}
#: How the names of calls begin that raise when a claim fails.
CLAIMS = ("assert_", "raises", "warns", "gradcheck", "fail")
MAX_LINES = 450
#: Parameters of public functions at most; kernels and the public contract may have eight.
MAX_PARAMETERS = 5
#: Rooms and files whose parameters others fix: the public contract, and the options of commands.
CONTRACTS = ("pipeline", "cli")


def modules() -> list[Path]:
    return sorted(path for path in PACKAGE.rglob("*.py"))


def suites() -> list[Path]:
    return sorted((ROOT / "tests").glob("*.py"))


def subpackage(path: Path) -> str:
    """``polsep/io/raw/png.py`` is in the subpackage ``io``, ``polsep/physics/stokes.py`` in ``stokes``."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return parts[0]


def label(path: Path) -> str:
    return str(path.relative_to(ROOT))


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def imports(path: Path) -> Iterator[tuple[int, str]]:
    """Line and dotted name of everything that a module imports, anywhere in it."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{label(path)}:{node.lineno}: expected absolute imports, found a relative one"
            yield from ((node.lineno, f"{node.module}.{alias.name}") for alias in node.names)


def called_name(node: ast.AST) -> str | None:
    """``f`` of the calls ``f(...)`` and ``x.f(...)``."""
    if not isinstance(node, ast.Call):
        return None
    if isinstance(node.func, ast.Attribute):
        return node.func.attr
    return node.func.id if isinstance(node.func, ast.Name) else None


def test_imports_go_down() -> None:
    """A module imports from subpackages of lower rank only, or from its own."""
    wrong = []
    for path in modules():
        here = subpackage(path)
        if here == "__init__":
            continue
        assert here in RANKS, f"{label(path)}: give this subpackage a rank in {label(Path(__file__))}"
        for line, name in imports(path):
            there = name.split(".")[1] if name.startswith("polsep.") else ""
            if there in RANKS and there != here and RANKS[there] >= RANKS[here]:
                wrong.append(f"{label(path)}:{line}: {here} (rank {RANKS[here]}) imports {name} (rank {RANKS[there]})")
    assert wrong == []
    assert {subpackage(path) for path in modules()} - {"__init__"} == set(RANKS)


def test_imports_inside_io_go_down() -> None:
    """Files are read and written on top of what keeps them whole, never the other way round."""
    wrong = []
    for path in (PACKAGE / "io").glob("*/*.py"):
        for line, name in imports(path):
            there = name.split(".")[2] if name.startswith("polsep.io.") else path.parent.name
            if there != path.parent.name and IO_RANKS[there] >= IO_RANKS[path.parent.name]:
                wrong.append(f"{label(path)}:{line}: {name}")
    assert wrong == []


def test_libraries_stay_in_their_room() -> None:
    """Codecs are imported in io, argument parsing in cli, optimizers in train."""
    wrong = []
    for path in modules():
        for line, name in imports(path):
            homes = [home for library, home in HOMES.items() if (name + ".").startswith(library + ".")]
            wrong += [f"{label(path)}:{line}: {name}" for home in homes if subpackage(path) != home]
        if subpackage(path) != "train":
            optimizers = (n for n in ast.walk(tree(path)) if isinstance(n, ast.Attribute) and n.attr == "optim")
            wrong += [f"{label(path)}:{node.lineno}: optim" for node in optimizers]
    assert wrong == []


def test_files_are_touched_in_io_only() -> None:
    """Nothing outside io opens, reads, writes, makes or removes files; Linux's facts under /proc are none."""
    wrong = [
        f"{label(path)}:{node.lineno}: {called_name(node)}(...)"
        for path in modules()
        if subpackage(path) != "io"
        for node in ast.walk(tree(path))
        if called_name(node) in FILE_CALLS and not is_io_function(node, path) and not reads_facts(node)
    ]
    assert wrong == []


def is_io_function(node: ast.AST, path: Path) -> bool:
    """True for a plain name that the module imports from polsep.io, such as ``write_text(path, text)``."""
    assert isinstance(node, ast.Call)
    names = {name.split(".")[-1] for _, name in imports(path) if name.startswith("polsep.io.")}
    return isinstance(node.func, ast.Name) and node.func.id in names


def reads_facts(node: ast.AST) -> bool:
    """True for ``Path("/proc/...").open()``."""
    return any(isinstance(n, ast.Constant) and str(n.value).startswith("/proc/") for n in ast.walk(node))


def public_definitions(path: Path) -> Iterator[tuple[str, ast.FunctionDef | ast.ClassDef]]:
    """Public functions and classes of a module, and the public methods of those classes."""
    for node in tree(path).body:
        if not isinstance(node, (ast.FunctionDef, ast.ClassDef)) or node.name.startswith("_"):
            continue
        yield node.name, node
        if isinstance(node, ast.ClassDef):
            methods = (n for n in node.body if isinstance(n, ast.FunctionDef))
            yield from ((f"{node.name}.{m.name}", m) for m in methods if not m.name.startswith("_"))


def test_public_names_are_documented_and_typed() -> None:
    """Every public function, class and method has a docstring, and every function a return type."""
    missing = []
    for path in modules():
        for name, node in public_definitions(path):
            if not ast.get_docstring(node):
                missing.append(f"{label(path)}:{node.lineno}: {name} has no docstring")
            if isinstance(node, ast.FunctionDef) and node.returns is None:
                missing.append(f"{label(path)}:{node.lineno}: {name} has no return annotation")
    assert missing == []


def test_docstrings_begin_with_a_noun_or_a_verb() -> None:
    """They say what a thing is or does, and do not ask."""
    wrong_start = ("What", "How", "Where", "Which", "Whether", "When", "Who", "Of", "As", "By")
    wrong = []
    for path in [*modules(), *sorted((ROOT / "evaluation").rglob("*.py"))]:
        for node in ast.walk(tree(path)):
            if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
                words = (ast.get_docstring(node) or "").split()
                wrong += [f"{label(path)}: {' '.join(words[:6])}"] if words and words[0] in wrong_start else []
    assert wrong == []


def test_public_functions_have_few_parameters() -> None:
    """More than five are a frozen dataclass; kernels may have eight, which the linter checks."""
    wrong = []
    for path in modules():
        if path.name.endswith("_kernel.py") or subpackage(path) in CONTRACTS:
            continue
        for name, node in public_definitions(path):
            if isinstance(node, ast.FunctionDef):
                own = [a.arg for a in (*node.args.args, *node.args.kwonlyargs) if a.arg not in ("self", "cls")]
                if len(own) > MAX_PARAMETERS:
                    wrong.append(f"{label(path)}:{node.lineno}: {name} has {len(own)} parameters")
    assert wrong == []


def test_modules_are_short_and_say_what_they_are() -> None:
    """No file exceeds 450 lines, and each starts with a docstring."""
    lines = {label(path): len(path.read_text(encoding="utf-8").splitlines()) for path in modules()}
    assert {name: count for name, count in lines.items() if count > MAX_LINES} == {}
    assert [label(path) for path in modules() if not ast.get_docstring(tree(path))] == []


def test_no_error_is_swallowed() -> None:
    """No handler of Exception, BaseException or everything does nothing."""
    wrong = []
    for path in (*modules(), *suites()):
        for node in ast.walk(tree(path)):
            if not isinstance(node, ast.ExceptHandler):
                continue
            broad = node.type is None or (
                isinstance(node.type, ast.Name) and node.type.id in ("Exception", "BaseException")
            )
            silent = all(isinstance(s, (ast.Pass, ast.Continue)) or is_constant(s) for s in node.body)
            if broad and silent:
                wrong.append(f"{label(path)}:{node.lineno}")
    assert wrong == []


def is_constant(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def test_comparisons_are_asserted() -> None:
    """No test computes allclose, isclose, equal or a comparison as a statement and throws the answer away."""
    names = ("allclose", "isclose", "array_equal", "equal")
    wrong = [
        f"{label(path)}:{node.lineno}"
        for path in suites()
        for node in ast.walk(tree(path))
        if isinstance(node, ast.Expr) and (isinstance(node.value, ast.Compare) or called_name(node.value) in names)
    ]
    assert wrong == []


def test_every_test_claims_something() -> None:
    """Every test function holds an assertion, calls something that asserts, or expects an exception or a warning."""
    silent = []
    for path in suites():
        for node in ast.walk(tree(path)):
            if not isinstance(node, ast.FunctionDef) or not node.name.startswith("test_"):
                continue
            if not any(isinstance(n, ast.Assert) or (called_name(n) or "").startswith(CLAIMS) for n in ast.walk(node)):
                silent.append(f"{label(path)}:{node.lineno}: {node.name}")
    assert silent == []
