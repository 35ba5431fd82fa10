"""The floor plan, held over the syntax trees: who imports whom, where files and codecs live, what is documented."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "polsep"

#: Rank of every module; those of `io` share one. A module imports from lower ranks.
RANKS = {
    "stokes": 0,
    "optics": 1,
    "svbrdf": 2,
    "material_network": 3,
    "camera": 2,
    "networks": 2,
    "metrics": 2,
    "separation": 2,
    "color_affine": 2,
    "multi_capture": 2,
    "demosaic": 3,
    "guided": 3,
    "refine": 3,
    "orient": 3,
    "details": 3,
    "joint": 4,
    "graph": 5,
    "layout_check": 3,
    "render": 3,
    "shapes": 3,
    "textures": 2,
    "materials": 3,
    "raycast": 4,
    "report": 3,
    "scenes": 3,
    "levels": 3,
    "kernels": 4,
    "engine": 4,
    "noise": 3,
    "temporal": 4,
    "learned": 5,
    "mosaic_network": 5,
    "openvino_engine": 5,
    "joint_engine": 5,
    "methods": 5,
    "pipeline": 5,
    "simulate": 4,
    "views": 4,
    "pathtrace": 4,
    "io": 4,
    "batch": 6,
    "cluster": 1,
    "workers": 1,
    "video": 6,
    "dataset": 6,
    "edit": 6,
    "material": 6,
    "geometry": 6,
    "bench": 6,
    "testsets": 6,
    "train": 6,
    "capture": 6,
    "view": 6,
    "cli": 7,
}
#: Imports between modules of one rank that belong together.
WITHIN = {
    ("color_affine", "separation"),
    ("multi_capture", "separation"),
    ("scenes", "render"),
    ("kernels", "joint"),
    ("raycast", "kernels"),
    ("simulate", "kernels"),
    ("views", "simulate"),
    ("pathtrace", "pathtrace"),
    ("pathtrace", "raycast"),
    ("views", "raycast"),
    ("engine", "kernels"),
    ("temporal", "kernels"),
    ("methods", "learned"),
    ("methods", "mosaic_network"),
    ("methods", "joint_engine"),
    ("joint_engine", "mosaic_network"),
    ("joint_engine", "openvino_engine"),
    ("methods", "openvino_engine"),
    ("pipeline", "openvino_engine"),
    ("pipeline", "methods"),
    ("guided", "demosaic"),
    ("io", "io"),
    ("kernels", "kernels"),
    ("bench", "bench"),
    ("bench", "edit"),
    ("bench", "view"),
    ("bench", "testsets"),
    ("bench", "dataset"),
    ("bench", "train"),
    ("bench", "video"),
    ("bench", "material"),
    ("bench", "geometry"),
    ("testsets", "testsets"),
    ("train", "train"),
    ("train", "material"),
    ("material", "material"),
    ("capture", "capture"),
    ("edit", "edit"),
    ("geometry", "geometry"),
    ("edit", "video"),
    ("view", "view"),
    ("view", "edit"),
    ("cli", "cli"),
}
#: Libraries that only one room may use.
HOMES = {
    "imagecodecs": "io",
    "tifffile": "io",
    "OpenEXR": "io",
    "PIL": "io",
    "cv2": "io",
    "imageio": "io",
    "zipfile": "io",
    "argparse": "cli",
    "click": "cli",
    "torch.optim": "train",
    "embreex": "raycast",
    "safetensors": "io",
    "lightning_fabric": "train",
    "tensorboard": "io",
    "torch.utils.tensorboard": "io",
    "mitsuba": "pathtrace",
    "drjit": "pathtrace",
    "trimesh": "io",
    "scipy.io": "io",
    "ray": "cluster",
    "onnxscript": "io",
    "onnx": "io",
    "flip_evaluator": "metrics",
    "matplotlib": "bench",
    "openvino": "openvino_engine",
    "av": "io",
    "gi": "capture",
    "pypylon": "capture",
    "gradio": "view",
}
#: Calls that touch files, by name of the function or method.
FILE_CALLS = {"open", "read_bytes", "write_bytes", "read_text", "write_text", "imread", "imwrite", "fromfile", "tofile"}
FILE_CALLS |= {"save", "savez", "savez_compressed", "mkdir", "unlink", "rmdir", "rename", "touch"}
#: How the names of calls begin that raise when a claim fails.
CLAIMS = ("assert_", "raises", "warns", "gradcheck")
MAX_LINES = 450


def modules() -> list[Path]:
    return sorted(path for path in PACKAGE.rglob("*.py"))


def suites() -> list[Path]:
    return sorted((ROOT / "tests").glob("*.py"))


def room(path: Path) -> str:
    """``polsep/io/raw/png.py`` is in the room ``io``, ``polsep/physics/stokes.py`` in ``stokes``."""
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


@pytest.mark.parametrize("path", [p for p in modules() if p.parent != PACKAGE or p.name != "__init__.py"], ids=label)
def test_imports_go_down(path: Path) -> None:
    """A module imports from lower ranks only, or from its own room."""
    here = room(path)
    assert here in RANKS, f"{label(path)}: give this room a rank in {label(Path(__file__))}"
    wrong = []
    for line, name in imports(path):
        if not name.startswith("polsep."):
            continue
        there = name.split(".")[1]
        if there not in RANKS:
            assert there.startswith("__"), f"{label(path)}:{line}: expected a room, found {name}"
        elif RANKS[there] >= RANKS[here] and (here, there) not in WITHIN:
            wrong.append(f"{label(path)}:{line}: {here} (rank {RANKS[here]}) imports {name} (rank {RANKS[there]})")
    assert wrong == []


@pytest.mark.parametrize("path", modules(), ids=label)
def test_libraries_stay_in_their_room(path: Path) -> None:
    """Codecs are imported in io, argument parsing in cli, optimizers in train."""
    wrong = [
        f"{label(path)}:{line}: {name}"
        for line, name in imports(path)
        for library, home in HOMES.items()
        if (name + ".").startswith(library + ".") and room(path) != home
    ]
    assert wrong == []
    optimizers = [n for n in ast.walk(tree(path)) if isinstance(n, ast.Attribute) and n.attr == "optim"]
    assert optimizers == [] or room(path) == "train"


@pytest.mark.parametrize(
    "path",
    [p for p in modules() if room(p) != "io"],
    ids=lambda p: label(p),
)
def test_files_are_touched_in_io_only(path: Path) -> None:
    """Nothing outside io opens, reads, writes, makes or removes files; README and git access of bench go through io."""
    wrong = [
        f"{label(path)}:{node.lineno}: {called_name(node)}(...)"
        for node in ast.walk(tree(path))
        if called_name(node) in FILE_CALLS and not is_io_function(node, path)
    ]
    assert wrong == []


def is_io_function(node: ast.AST, path: Path) -> bool:
    """True for a plain name that the module imports from polsep.io, such as ``write_text(path, text)``."""
    assert isinstance(node, ast.Call)
    names = {name.split(".")[-1] for _, name in imports(path) if name.startswith("polsep.io.")}
    return isinstance(node.func, ast.Name) and node.func.id in names


def public_definitions(path: Path) -> Iterator[tuple[str, ast.FunctionDef | ast.ClassDef]]:
    """Public functions and classes of a module, and the public methods of those classes."""
    for node in tree(path).body:
        if not isinstance(node, (ast.FunctionDef, ast.ClassDef)) or node.name.startswith("_"):
            continue
        yield node.name, node
        if isinstance(node, ast.ClassDef):
            methods = (n for n in node.body if isinstance(n, ast.FunctionDef))
            yield from ((f"{node.name}.{m.name}", m) for m in methods if not m.name.startswith("_"))


@pytest.mark.parametrize("path", modules(), ids=label)
def test_public_names_are_documented_and_typed(path: Path) -> None:
    """Every public function, class and method has a docstring, and every function a return type."""
    missing = []
    for name, node in public_definitions(path):
        text = ast.get_docstring(node)
        if not text:
            missing.append(f"{label(path)}:{node.lineno}: {name} has no docstring")
        if isinstance(node, ast.FunctionDef) and node.returns is None:
            missing.append(f"{label(path)}:{node.lineno}: {name} has no return annotation")
    assert missing == []


@pytest.mark.parametrize("path", modules(), ids=label)
def test_modules_are_short_and_say_what_they_are(path: Path) -> None:
    """No file exceeds 450 lines, and each starts with a docstring."""
    assert len(path.read_text(encoding="utf-8").splitlines()) <= MAX_LINES
    assert ast.get_docstring(tree(path))


@pytest.mark.parametrize("path", [*modules(), *suites()], ids=label)
def test_no_error_is_swallowed(path: Path) -> None:
    """No handler of Exception, BaseException or everything does nothing."""
    wrong = []
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


@pytest.mark.parametrize("path", suites(), ids=label)
def test_comparisons_are_asserted(path: Path) -> None:
    """No test computes allclose, isclose, equal or a comparison as a statement and throws the answer away."""
    wrong = []
    for node in ast.walk(tree(path)):
        if not isinstance(node, ast.Expr):
            continue
        if isinstance(node.value, ast.Compare) or called_name(node.value) in (
            "allclose",
            "isclose",
            "array_equal",
            "equal",
        ):
            wrong.append(f"{label(path)}:{node.lineno}")
    assert wrong == []


@pytest.mark.parametrize("path", [p for p in suites() if p.name.startswith("test_")], ids=label)
def test_every_test_claims_something(path: Path) -> None:
    """Every test function holds an assertion, calls something that asserts, or expects an exception or a warning."""
    silent = []
    for node in ast.walk(tree(path)):
        if not isinstance(node, ast.FunctionDef) or not node.name.startswith("test_"):
            continue
        claims = any(isinstance(n, ast.Assert) or (called_name(n) or "").startswith(CLAIMS) for n in ast.walk(node))
        if not claims:
            silent.append(f"{label(path)}:{node.lineno}: {node.name}")
    assert silent == []


def test_rooms_exist_and_have_one_rank() -> None:
    """Every module has a rank; rooms that are planned but not built are named here and nowhere else."""
    built = {room(path) for path in modules()} - {"__init__"}
    assert built <= set(RANKS)
    assert set(RANKS) - built <= {"train", "bench"}
