"""A material as one GLB file, a square with textures, and as a MaterialX document: bytes and text, no files.

glTF's dielectrics are GGX with alpha = roughness^2 and a reflectance of 0.04 at normal incidence, times the specular
colour of KHR_materials_specular: the shading of `polsep.material.svbrdf`. Colours are in sRGB, the rest is linear.
Sources: Khronos, glTF 2.0 Specification, 3.9 and Appendix B; KHR_materials_specular; MaterialX 1.38, gltf_pbr.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from polsep.io.results.outputs import encode_png
from polsep.io.results.previews import srgb

Floats = NDArray[np.float32]
Pixels = NDArray[np.uint8]

#: Reflectance of glTF's dielectrics at normal incidence.
DIELECTRIC = 0.04
#: Textures of a material, by the names of their files.
TEXTURES = ("normal", "diffuse", "roughness", "specular")
_GLB, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_FLOAT, _SHORT, _ARRAY, _ELEMENTS = 5126, 5123, 34962, 34963


def specular_scale(specular: Floats) -> float:
    """What white in the specular texture stands for, a reflectance at normal incidence: the largest one."""
    return max(float(specular.max()), DIELECTRIC)


def texture_pixels(maps: Mapping[str, Floats]) -> dict[str, Pixels]:
    """Textures ``uint8 [h, w, 3]`` of maps ``[h, w, C]``: normal (y up), diffuse, roughness, specular.

    Albedos are in sRGB, specular over `specular_scale`; roughness is in green, as glTF wants it, and in the others.
    """
    linear = {"normal": maps["normal"] * 0.5 + 0.5, "roughness": np.repeat(maps["roughness"], 3, axis=2)}
    linear["diffuse"] = srgb(maps["diffuse"])
    linear["specular"] = srgb(maps["specular"] / specular_scale(maps["specular"]))
    return {name: np.rint(np.clip(linear[name], 0, 1) * 255).astype(np.uint8) for name in TEXTURES}


def encode_glb(textures: Mapping[str, Pixels], scale: float, name: str) -> bytes:
    """A square of side 2 in the plane z = 0 that faces +z, with a material of these textures.

    ``scale``: what white in the specular texture stands for.
    """
    positions = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    normals = np.tile(np.array([0, 0, 1], np.float32), (4, 1))
    tangents = np.tile(np.array([1, 0, 0, 1], np.float32), (4, 1))
    places = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)  # v counts down
    faces = np.array([0, 1, 2, 0, 2, 3], np.uint16)
    # Metalness is in blue, which is 0: these are dielectrics.
    packed = textures["roughness"] * np.array([0, 1, 0], np.uint8)
    images = [encode_png(x) for x in (textures["diffuse"], packed, textures["normal"], textures["specular"])]
    chunks = [positions.tobytes(), normals.tobytes(), tangents.tobytes(), places.tobytes(), faces.tobytes(), *images]
    views, body = _pack(chunks)
    for k in range(5):
        views[k]["target"] = _ELEMENTS if k == 4 else _ARRAY
    kinds = (("VEC3", 4), ("VEC3", 4), ("VEC4", 4), ("VEC2", 4), ("SCALAR", 6))
    accessors: list[dict[str, Any]] = [
        {"bufferView": k, "componentType": _SHORT if k == 4 else _FLOAT, "count": count, "type": kind}
        for k, (kind, count) in enumerate(kinds)
    ]
    accessors[0] |= {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    specular = {"specularColorFactor": [scale / DIELECTRIC] * 3, "specularColorTexture": {"index": 3}}
    material = {
        "name": name,
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0},
            "metallicFactor": 0.0,
            "roughnessFactor": 1.0,
            "metallicRoughnessTexture": {"index": 1},
        },
        "normalTexture": {"index": 2},
        "extensions": {"KHR_materials_specular": specular},
    }
    attributes = {"POSITION": 0, "NORMAL": 1, "TANGENT": 2, "TEXCOORD_0": 3}
    document = {
        "asset": {"version": "2.0", "generator": "polsep"},
        "extensionsUsed": ["KHR_materials_specular"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": name}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 4, "material": 0}]}],
        "materials": [material],
        "textures": [{"source": k, "sampler": 0} for k in range(4)],
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
        "images": [{"bufferView": 5 + k, "mimeType": "image/png"} for k in range(4)],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(body)}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<3I", _GLB, 2, 12 + 8 + len(text) + 8 + len(body))
    return head + struct.pack("<2I", len(text), _JSON) + text + struct.pack("<2I", len(body), _BIN) + body


def _pack(chunks: list[bytes]) -> tuple[list[dict[str, Any]], bytes]:
    """Views of one buffer, each at a multiple of 4 bytes, and the buffer."""
    views: list[dict[str, Any]] = []
    body = b""
    for chunk in chunks:
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": len(chunk)})
        body += chunk + b"\0" * (-len(chunk) % 4)
    return views, body


def encode_materialx(files: Mapping[str, str], scale: float, name: str) -> str:
    """A MaterialX document with the node gltf_pbr and an image node for each of `TEXTURES`' ``files``."""

    def image(texture: str, kind: str, space: str) -> str:
        file = f'<input name="file" type="filename" value={quoteattr(files[texture])}{space} />'
        return f'  <image name="{texture}_image" type="{kind}">\n    {file}\n  </image>\n'

    encoded = ' colorspace="srgb_texture"'
    factor = scale / DIELECTRIC
    return (
        '<?xml version="1.0"?>\n<materialx version="1.38" colorspace="lin_rec709">\n'
        + image("diffuse", "color3", encoded)
        + image("roughness", "float", "")
        + image("specular", "color3", encoded)
        + image("normal", "vector3", "")
        + '  <normalmap name="normal_map" type="vector3">\n'
        '    <input name="in" type="vector3" nodename="normal_image" />\n  </normalmap>\n'
        '  <multiply name="specular_color" type="color3">\n'
        '    <input name="in1" type="color3" nodename="specular_image" />\n'
        f'    <input name="in2" type="float" value="{factor:.6g}" />\n  </multiply>\n'
        '  <gltf_pbr name="shader" type="surfaceshader">\n'
        '    <input name="base_color" type="color3" nodename="diffuse_image" />\n'
        '    <input name="metallic" type="float" value="0" />\n'
        '    <input name="roughness" type="float" nodename="roughness_image" />\n'
        '    <input name="normal" type="vector3" nodename="normal_map" />\n'
        '    <input name="specular_color" type="color3" nodename="specular_color" />\n  </gltf_pbr>\n'
        f'  <surfacematerial name={quoteattr(name)} type="material">\n'
        '    <input name="surfaceshader" type="surfaceshader" nodename="shader" />\n  </surfacematerial>\n'
        "</materialx>\n"
    )
