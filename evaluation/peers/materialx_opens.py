"""Check that MaterialX reads the files of `polsep material`, finds their textures and generates a shader.

    python3 -m venv materialx && materialx/bin/pip install materialx==1.39.5
    polsep material polsep/data/still_life.png --white-level 4095 -o out
    python evaluation/peers/materialx_opens.py materialx/bin/python out/still_life.mtlx   # results/materialx.jsonl

MaterialX reads the file with its own libraries of nodes, checks it against them, and writes GLSL for it.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from recorded import record

from polsep.bench.rows import Row

#: Runs beside MaterialX: what it says of a file, as one line of JSON.
INSIDE = """
import json, sys
import MaterialX as mx
import MaterialX.PyMaterialXGenGlsl as glsl
import MaterialX.PyMaterialXGenShader as shaders
folders, library, document = mx.getDefaultDataSearchPath(), mx.createDocument(), mx.createDocument()
mx.loadLibraries(mx.getDefaultDataLibraryFolders(), folders, library)
mx.readFromXmlFile(document, sys.argv[1])
document.importLibrary(library)
valid, message = document.validate()
(material,) = document.getMaterialNodes()
generator = glsl.GlslShaderGenerator.create()
context = shaders.GenContext(generator)
context.registerSourceCodeSearchPath(folders)
code = generator.generate(material.getName(), material, context).getSourceCode("pixel")
print(json.dumps({
    "version": mx.getVersionString(),
    "valid": valid,
    "message": message,
    "textures": [node.getInput("file").getValueString() for node in document.getNodes("image")],
    "samplers": sum("uniform sampler2D" in line and "_file" in line for line in code.splitlines()),
    "lines": len(code.splitlines()),
}))
"""


def ask(python: Path, path: Path) -> dict[str, Any]:
    """MaterialX's report on a file."""
    done = subprocess.run([python, "-c", INSIDE, path], capture_output=True, text=True, check=True)
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def check(python: Path, path: Path) -> Iterator[Row]:
    """Rows of one file."""
    found = ask(python, path)
    case = f"{path.name} in MaterialX {found['version']}"
    missing = [name for name in found["textures"] if not (path.parent / name).is_file()]
    for metric, value in (
        ("nodes against their definitions, errors", float(not found["valid"])),
        ("textures", len(found["textures"])),
        ("textures that are not there", len(missing)),
        ("textures that the GLSL shader samples", found["samplers"]),
        ("lines of the GLSL shader", found["lines"]),
    ):
        yield Row("materialx", case, "read", metric, float(value), "1")
    print(case, found["message"], missing)


def main() -> None:
    """Measure and record the rows."""
    python, *paths = (Path(word) for word in sys.argv[1:])
    rows = [row for path in paths for row in check(python, path)]
    record(
        "materialx",
        rows,
        f"python evaluation/peers/materialx_opens.py materialx/bin/python {' '.join(map(str, paths))}",
    )


if __name__ == "__main__":
    main()
