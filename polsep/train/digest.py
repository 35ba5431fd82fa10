"""The digest of training data: the options that made the examples, and the source of every module that made them."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import json
from collections.abc import Iterator
from importlib.abc import InspectLoader


def digest_examples(options: object, maker: str) -> str:
    """Return the sha256 of ``options``, as JSON, and of the sources of the module ``maker`` with all that it imports.

    Only contents count, not the names of modules. Weights that a method loads, and other packages, are not covered.
    """
    digest = hashlib.sha256(json.dumps(options).encode())
    for source in sorted(find_sources(maker).values()):
        digest.update(source.encode())
    return digest.hexdigest()


def find_sources(maker: str) -> dict[str, str]:
    """Return the source of a module of polsep and of every module of polsep that it imports, directly or not, by name.

    Imports count wherever they stand in a module; the package of an imported module counts only if it is named itself.
    """
    sources: dict[str, str] = {}
    names = [maker]
    while names:
        name = names.pop()
        source = None if name in sources else _read_source(name)
        if source is not None:
            sources[name] = source
            names += _imported_names(source)
    return sources


def _read_source(name: str) -> str | None:
    """The source of a module; None for the name of anything else in one, such as a function."""
    try:
        spec = importlib.util.find_spec(name)
    except ModuleNotFoundError:
        return None
    return spec.loader.get_source(name) if spec and isinstance(spec.loader, InspectLoader) else None


def _imported_names(source: str) -> Iterator[str]:
    """Dotted names in polsep that import statements mention: modules, and things in them."""
    for node in ast.walk(ast.parse(source)):
        names = [alias.name for alias in node.names] if isinstance(node, (ast.Import, ast.ImportFrom)) else []
        if isinstance(node, ast.ImportFrom):
            names = [f"{node.module}", *(f"{node.module}.{name}" for name in names)]
        yield from (name for name in names if name.split(".")[0] == "polsep")
