"""Check that Blender opens the files of `polsep geometry` and `polsep material` and reads the same numbers.

    python3.11 -m venv blender && blender/bin/pip install bpy==5.0.1
    polsep geometry --srgb 196CANON/[0-5].JPG --mask 196CANON/mask.png --integration smooth -o out
    polsep material polsep/data/still_life.png --white-level 4095 -o out
    python evaluation/peers/blender_opens.py blender/bin/python out/shape.glb out/still_life.glb

Blender imports each file in an empty scene, checks its meshes, and says what it has; trimesh reads the same file.
"""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from recorded import record

from polsep.bench.rows import Row

#: Runs inside Blender: what it finds in a file, as one line of JSON.
INSIDE = """
import bpy, json, sys
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=sys.argv[1], merge_vertices=False)
(thing,) = [o for o in bpy.data.objects if o.type == "MESH"]
mesh, (material,) = thing.data, thing.data.materials
repaired = mesh.validate(verbose=False)
shader = next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED")
colors = mesh.color_attributes
print("FOUND " + json.dumps({
    "version": bpy.app.version_string,
    "repaired": repaired,
    "vertices": [list(thing.matrix_world @ v.co) for v in mesh.vertices],
    "faces": len(mesh.polygons),
    "colors": [list(c.color)[:3] for c in colors[0].data] if len(colors) else [],
    "corners": bool(len(colors)) and colors[0].domain == "CORNER",
    "loops": [l.vertex_index for l in mesh.loops],
    "textures": sorted(n.image.size[0] for n in material.node_tree.nodes if n.type == "TEX_IMAGE"),
    "linked": sorted(i.name for i in shader.inputs if i.is_linked),
}))
"""


def ask_blender(blender: Path, path: Path) -> dict[str, Any]:
    """Blender's report on a file."""
    done = subprocess.run([blender, "-c", INSIDE, path], capture_output=True, text=True, check=True)
    line = next(line for line in done.stdout.splitlines() if line.startswith("FOUND "))
    found: dict[str, Any] = json.loads(line.removeprefix("FOUND "))
    return found


def compare(blender: Path, path: Path) -> Iterator[Row]:
    """Rows of one file. Blender has z up: its (x, y, z) is the file's (x, -z, y)."""
    found, mesh = ask_blender(blender, path), trimesh.load(path, force="mesh", process=False)
    seen = np.array(found["vertices"])[:, [0, 2, 1]] * [1, 1, -1]
    case = f"{path.name} in Blender {found['version']}"
    yield Row("blender", case, "import", "meshes that had to be repaired", float(found["repaired"]), "1")
    yield Row("blender", case, "import", "faces more or less", abs(found["faces"] - len(mesh.faces)), "1")
    yield Row("blender", case, "import", "vertices, largest distance", float(np.abs(seen - mesh.vertices).max()), "1")
    yield Row("blender", case, "import", "textures", len(found["textures"]), "1")
    yield Row("blender", case, "import", "inputs of the shader that are fed", len(found["linked"]), "1")
    if found["colors"]:
        colors = np.array(found["colors"])
        stored = read_colors(path)
        wanted = stored[found["loops"]] if found["corners"] else stored
        yield Row("blender", case, "import", "colours, largest difference", float(np.abs(colors - wanted).max()), "1")
    print(case, found["linked"], found["textures"])


def read_colors(path: Path) -> np.ndarray:
    """The colours ``[V, 3]`` of a GLB of one mesh, linear float32; trimesh leaves them out beside a material."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    said, start = json.loads(data[20 : 20 + length]), 20 + length + 8
    accessor = said["accessors"][said["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    view = said["bufferViews"][accessor["bufferView"]]
    count = 3 if accessor["type"] == "VEC3" else 4
    flat = np.frombuffer(data, "<f4", accessor["count"] * count, start + view["byteOffset"])
    return flat.reshape(-1, count)[:, :3]


def main() -> None:
    """Measure and record the rows."""
    blender, *paths = (Path(word) for word in sys.argv[1:])
    rows = [row for path in paths for row in compare(blender, path)]
    record("blender", rows, f"python evaluation/peers/blender_opens.py blender/bin/python {' '.join(map(str, paths))}")


if __name__ == "__main__":
    main()
