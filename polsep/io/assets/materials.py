"""One material as files, written atomically by `polsep material`, and published materials as files.

NAME.exr holds normal.X/Y/Z, diffuse.R/G/B, roughness.Y and specular.R/G/B (float32, ZIP); NAME_normal.png (y up),
NAME_diffuse.png and NAME_specular.png (sRGB) and NAME_roughness.png (linear, gray) are textures of 8 bits; NAME.glb (a
square with these textures) and NAME.mtlx are the material for renderers, the latter beside its textures; NAME.png is a
preview and NAME.json a sidecar.

glTF's dielectrics are GGX with alpha = roughness^2 and a reflectance of 0.04 at normal incidence, times the specular
colour of KHR_materials_specular: the shading of `polsep.material.svbrdf`. Where the reflectance is that of a metal
(`gltf.metalness`), NAME.glb says metallic, with the reflectance as base colour; NAME.mtlx, whose specular colour has no
limit, says the same by the specular colour alone. Colours are in sRGB, the rest is linear.
Sources: Khronos, glTF 2.0 Specification, 3.9 and Appendix B; KHR_materials_specular; MaterialX 1.38, gltf_pbr.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from polsep.io.raw.png import read_png
from polsep.io.results.exr import encode_exr
from polsep.io.results.sidecars import EncodedFile, exr_notes, require_finite, require_stem, write_with_sidecar
from polsep.io.store.atomic import refuse_existing
from polsep.io.store.errors import naming
from polsep.io.store.image_codecs import encode_png
from polsep.physics.gltf import GLASS, metalness
from polsep.physics.srgb import srgb

Floats = NDArray[np.float32]
Pixels = NDArray[np.uint8]

#: Channels of the maps in the EXR file.
CHANNELS = {"normal": "XYZ", "diffuse": "RGB", "roughness": "Y", "specular": "RGB"}
#: Textures of a material, by the names of their files.
TEXTURES = tuple(CHANNELS)
UNITS = {
    "normal": "unit vectors, x right, y up, z toward the camera; PNG: 0 to 255 for -1 to 1",
    "diffuse": "linear reflectance, 0 to 1; PNG: sRGB",
    "roughness": "GGX alpha = roughness^2; PNG: linear",
    "specular": "linear reflectance at normal incidence, 0.04 for glass; PNG: sRGB, over specular_scale",
}
#: Panels of a picture of Deschaintre et al. 2018: the photograph, normals, diffuse, roughness, specular.
PANELS = 5


class MaterialFiles(NamedTuple):
    """Maps float32 ``[h, w, C]`` by name, a ``preview`` in sRGB ``uint8 [h, w, 3]``, and ``facts`` for the sidecar."""

    maps: Mapping[str, Floats]
    preview: Pixels
    facts: Mapping[str, Any]


def material_targets(directory: Path, name: str) -> list[Path]:
    """The files of a material. Raises OutputError where ``name`` is no plain file name."""
    require_stem(name)
    ends = (".exr", *(f"_{texture}.png" for texture in TEXTURES), ".glb", ".mtlx", ".png", ".json")
    return [directory / f"{name}{end}" for end in ends]


def write_material(material: MaterialFiles, directory: Path, name: str, overwrite: bool) -> list[Path]:
    """Write a material's files atomically; return their paths. Raises OutputError."""
    targets = material_targets(directory, name)
    refuse_existing(directory, targets, overwrite)
    require_finite(material.maps)
    scale = specular_scale(material.maps["specular"])
    facts = {"shape": list(material.maps["normal"].shape[:2]), "specular_scale": scale, "units": UNITS}
    write_with_sidecar(targets, _encoded_files(material, name, scale), {**material.facts, **facts})
    return targets


def _encoded_files(material: MaterialFiles, name: str, scale: float) -> Iterator[EncodedFile]:
    """Every file but the sidecar."""
    maps = material.maps
    planes = {f"{kind}.{c}": maps[kind][..., k] for kind, names in CHANNELS.items() for k, c in enumerate(names)}
    yield f"{name}.exr", encode_exr(planes, exr_notes(UNITS))
    textures = texture_pixels(maps)
    files = {texture: f"{name}_{texture}.png" for texture in TEXTURES}
    for texture, pixels in textures.items():
        yield files[texture], encode_png(pixels[..., 0] if texture == "roughness" else pixels)
    yield f"{name}.glb", encode_glb(maps, re.sub(r"\W", "_", name))
    yield f"{name}.mtlx", encode_materialx(files, scale, name).encode()
    yield f"{name}.png", encode_png(material.preview)


def specular_scale(specular: Floats) -> float:
    """The reflectance at normal incidence of white in the specular texture: the largest one, at least `GLASS`."""
    return max(float(specular.max()), GLASS)


def texture_pixels(maps: Mapping[str, Floats]) -> dict[str, Pixels]:
    """Textures ``uint8 [h, w, 3]`` of maps ``[h, w, C]``: normal (y up), diffuse, roughness, specular.

    Albedos are in sRGB, specular over `specular_scale`; roughness is in green, as glTF wants it, and in the others.
    """
    linear = {"normal": maps["normal"] * 0.5 + 0.5, "roughness": np.repeat(maps["roughness"], 3, axis=2)}
    linear["diffuse"] = srgb(maps["diffuse"])
    linear["specular"] = srgb(maps["specular"] / specular_scale(maps["specular"]))
    return {name: np.rint(np.clip(linear[name], 0, 1) * 255).astype(np.uint8) for name in TEXTURES}


def metallic_maps(maps: Mapping[str, Floats]) -> dict[str, Floats]:
    """Maps ``[h, w, C]`` in glTF's terms: base colour as diffuse, ``metallic`` [h, w, 1], specular of dielectrics."""
    specular = np.ascontiguousarray(np.moveaxis(maps["specular"], -1, 0))
    metallic = np.moveaxis(metalness(specular), 0, -1).astype(np.float32)
    base = maps["diffuse"] + metallic * (maps["specular"] - maps["diffuse"])
    dielectric = maps["specular"] + metallic * (GLASS - maps["specular"])
    return {**maps, "diffuse": base, "specular": dielectric, "metallic": metallic}


def encode_glb(maps: Mapping[str, Floats], name: str) -> bytes:
    """A GLB file of a square of side 2 in the plane z = 0 that faces +z, with a material of maps ``[h, w, C]``.

    Note: trimesh knows neither specular textures nor tangents. The specular texture is given to it as the one of
    occlusion, tangents as an attribute of their own, and both are renamed in the document.
    """
    maps = metallic_maps(maps)
    textures, scale = texture_pixels(maps), specular_scale(maps["specular"])
    rough = textures["roughness"] * np.array([0, 1, 0], np.uint8)  # roughness is in green, metalness in blue
    rough[..., 2] = np.rint(255 * maps["metallic"][..., 0])
    material = PBRMaterial(
        name=name,
        baseColorTexture=Image.fromarray(textures["diffuse"]),
        metallicRoughnessTexture=Image.fromarray(rough),
        normalTexture=Image.fromarray(textures["normal"]),
        occlusionTexture=Image.fromarray(textures["specular"]),
        metallicFactor=1.0,
        roughnessFactor=1.0,
    )
    square = trimesh.Trimesh(
        vertices=[[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]],
        faces=[[0, 1, 2], [0, 2, 3]],
        vertex_normals=np.tile([0.0, 0, 1], (4, 1)),
        visual=TextureVisuals(np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]), material),  # trimesh counts v up
        vertex_attributes={"TANGENT": np.tile(np.array([1, 0, 0, 1], np.float32), (4, 1))},
        process=False,
    )

    def finish(tree: dict[str, Any]) -> None:
        (primitive,), (shading,) = tree["meshes"][0]["primitives"], tree["materials"]
        primitive["attributes"]["TANGENT"] = primitive["attributes"].pop("_TANGENT")
        specular = {
            "specularColorFactor": [scale / GLASS] * 3,
            "specularColorTexture": shading.pop("occlusionTexture"),
        }
        shading["extensions"] = {"KHR_materials_specular": specular}
        tree["extensionsUsed"] = ["KHR_materials_specular"]
        tree["samplers"] = [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}]  # linear, clamped
        for texture in tree["textures"]:
            texture["sampler"] = 0

    scene = trimesh.Scene()
    scene.add_geometry(square, node_name=name, geom_name=name)
    data: bytes = export_glb(scene, include_normals=True, tree_postprocessor=finish)
    return data


def encode_materialx(files: Mapping[str, str], scale: float, name: str) -> str:
    """A MaterialX document with the node gltf_pbr and an image node for each of `TEXTURES`' ``files``.

    Names of MaterialX are ASCII letters, digits and underscores, not a digit first, and unique: the material's is
    material_NAME, with underscores for other characters.
    """
    root = ElementTree.Element("materialx", version="1.38", colorspace="lin_rec709")

    def node(kind: str, node_name: str, type: str, *inputs: dict[str, str]) -> None:
        element = ElementTree.SubElement(root, kind, name=node_name, type=type)
        for given in inputs:
            ElementTree.SubElement(element, "input", given)

    def link(input_name: str, type: str, target: str) -> dict[str, str]:
        return {"name": input_name, "type": type, "nodename": target}

    for texture, type in (("diffuse", "color3"), ("roughness", "float"), ("specular", "color3"), ("normal", "vector3")):
        encoding = {"colorspace": "srgb_texture"} if type == "color3" else {}
        file = {"name": "file", "type": "filename", "value": files[texture], **encoding}
        node("image", f"{texture}_image", type, file)
    node("normalmap", "normal_map", "vector3", link("in", "vector3", "normal_image"))
    factor = {"name": "in2", "type": "float", "value": f"{scale / GLASS:.6g}"}
    node("multiply", "specular_color", "color3", link("in1", "color3", "specular_image"), factor)
    node(
        "gltf_pbr",
        "shader",
        "surfaceshader",
        link("base_color", "color3", "diffuse_image"),
        {"name": "metallic", "type": "float", "value": "0"},
        link("roughness", "float", "roughness_image"),
        link("normal", "vector3", "normal_map"),
        link("specular_color", "color3", "specular_color"),
    )
    material = "material_" + re.sub(r"[^0-9A-Za-z_]", "_", name)
    node("surfacematerial", material, "material", link("surfaceshader", "surfaceshader", "shader"))
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def read_panels(path: Path) -> tuple[Tensor, ...]:
    """Normal, diffuse, roughness and specular ``[C, H, W]`` of a picture of five square panels, for `Svbrdf`.

    Normals are encoded from -1 to 1; albedos and roughness are linear, whose rendering resembles the first panel.
    Raises InputError on other pictures.
    """
    with naming(path):
        page = next(read_png(path)).array
        height, width = page.shape[:2]
        if page.ndim != 3 or width != PANELS * height:
            raise ValueError(f"expected {PANELS} square panels in colour, found {width}x{height}")
    panels = torch.from_numpy(page.astype(np.float32) / np.iinfo(page.dtype).max).permute(2, 0, 1)
    _, normal, diffuse, roughness, specular = panels.split(height, dim=2)  # type: ignore[no-untyped-call]
    normal = torch.nn.functional.normalize(2 * normal - 1, dim=0)
    return normal, diffuse, roughness.mean(dim=0, keepdim=True), specular


def find_panels(folder: Path) -> list[Path]:
    """The pictures in a folder, by name; none where there is no folder."""
    return sorted(folder.glob("*.png")) if folder.is_dir() else []
