"""Blender: File > Import > polsep (.exr). What polsep wrote becomes images, and a material on a plane of their aspect.

Files of `polsep separate` (also of `polsep video` and `polsep edit`): the material shows the photograph, diffuse and
specular light each with a gain of its own, and turns into a surface under the scene's lights as "Relit" goes from 0 to
1. Files of `polsep material`: a surface of its maps. Files of `polsep geometry`: the mesh beside the file, or without
one a surface of albedo and normals. Values stay linear camera RGB in 32-bit floats, packed into the .blend.
"""

from pathlib import Path

import bpy
import numpy as np
from bpy_extras.io_utils import ImportHelper

#: Layers that are light or colour; others are numbers.
LIGHT = ("diffuse", "specular", "albedo", "base color", "tint")
#: Inputs of the Principled node by the maps that go there.
SOCKETS = {
    "albedo": "Base Color",
    "base color": "Base Color",
    "metallic": "Metallic",
    "roughness": "Roughness",
    "level": "Specular IOR Level",
    "tint": "Specular Tint",
}
#: Channels of a layer in their order, one set of them.
CHANNELS = ("RGB", "XYZ", "Y", "Z")
#: Reflectance at normal incidence where the specular level of the Principled node is 1.
FULL_LEVEL = 0.08
#: The same of glass, and the largest mean of dielectrics and the least of metals: those of polsep's GLB files.
GLASS, DIELECTRICS, METALS = 0.04, 0.2, 0.32


def read_layers(path):
    """The layers of an EXR file by name: float32 [h, w, C], the first row on top. Raises ValueError."""
    import OpenImageIO

    buffer = OpenImageIO.ImageBuf(str(path))
    pixels = buffer.get_pixels(OpenImageIO.FLOAT)
    if buffer.has_error or pixels is None:
        raise ValueError(f"{Path(path).name}: expected an EXR file, found: {buffer.geterror()}")
    place = {name: k for k, name in enumerate(buffer.spec().channelnames)}
    found = {}
    for layer in sorted({name.rpartition(".")[0] for name in place} - {""}):
        for channels in CHANNELS:
            if all(f"{layer}.{c}" in place for c in channels):
                found[layer] = pixels[..., [place[f"{layer}.{c}"] for c in channels]]
                break
    if not ({"diffuse", "specular"} <= set(found) or {"albedo", "normal"} <= set(found)):
        raise ValueError(f"{Path(path).name}: expected layers of polsep, found {', '.join(sorted(place))[:200]}")
    return found


def make_image(name, layer, pixels):
    """An image of Blender with a layer's values, packed; one channel becomes grey."""
    height, width, channels = pixels.shape
    image = bpy.data.images.new(name, width, height, alpha=False, float_buffer=True)
    image.use_half_precision = False
    image.colorspace_settings.name = "Linear Rec.709" if layer in LIGHT else "Non-Color"
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., :3] = pixels if channels == 3 else pixels[..., :1]
    image.pixels.foreach_set(rgba[::-1].ravel())
    image.update()
    image.pack()
    return image


def principled_maps(layers):
    """Maps for inputs of the Principled node, besides the layers of a surface that go there as they are.

    `polsep material` writes the reflectance at normal incidence: that of a metal becomes metallic and base color, as in
    its GLB files, that of others a level times a tint. `polsep shape` writes its strength, 1 for glass.
    """
    if "albedo" in layers:
        return {"level": layers["specular"] * np.float32(GLASS / FULL_LEVEL)} if "specular" in layers else {}
    diffuse, specular = layers["diffuse"], layers["specular"]
    metallic = np.clip((specular.mean(axis=2, keepdims=True) - DIELECTRICS) / (METALS - DIELECTRICS), 0, 1)
    dielectric = specular + metallic * (GLASS - specular)
    mean = dielectric.mean(axis=2, keepdims=True)
    tint = np.where(mean > 0, dielectric / np.where(mean > 0, mean, 1), 1)
    base = diffuse + metallic * (specular - diffuse)
    return {"base color": base, "metallic": metallic, "level": mean / FULL_LEVEL, "tint": tint}


class Nodes:
    """The nodes of a new material, in columns from left to right."""

    def __init__(self, name):
        self.material = bpy.data.materials.new(name)
        self.material.use_nodes = True
        self.tree = self.material.node_tree
        self.tree.nodes.clear()
        self._rows = {}

    def add(self, kind, label, column, **values):
        """A node in a column; ``values`` are of its properties."""
        node = self.tree.nodes.new(kind)
        node.name = node.label = label
        row = self._rows.get(column, 0)
        node.location, self._rows[column] = (300 * column, -320 * row), row + 1
        for key, value in values.items():
            setattr(node, key, value)
        return node

    def textures(self, images):
        """A node for each image, by layer."""
        kind = "ShaderNodeTexImage"
        return {layer: self.add(kind, layer, -1, image=image, extension="EXTEND") for layer, image in images.items()}

    def join(self, output, socket):
        """A link from a node's first output, or from an output, to an input."""
        self.tree.links.new(output.outputs[0] if hasattr(output, "outputs") else output, socket)

    def value(self, label, number):
        """A number to turn, as the output of a node."""
        node = self.add("ShaderNodeValue", label, 0)
        node.outputs[0].default_value = number
        return node

    def scaled(self, label, image, gain):
        """An image times a number."""
        node = self.add("ShaderNodeVectorMath", label, 1, operation="SCALE")
        self.join(image, node.inputs[0])
        self.join(gain, node.inputs["Scale"])
        return node


def separation_material(name, images):
    """A material of a separation: emitted light of the photograph, mixed by "Relit" with a lit surface."""
    nodes = Nodes(name)
    textures = nodes.textures(images)
    gains = {layer: nodes.value(f"{layer.capitalize()} gain", 1.0) for layer in ("diffuse", "specular")}
    parts = [nodes.scaled(f"{layer} x gain", textures[layer], gains[layer]) for layer in gains]
    total = nodes.add("ShaderNodeVectorMath", "diffuse + specular", 2, operation="ADD")
    for part, socket in zip(parts, total.inputs, strict=False):
        nodes.join(part, socket)
    photograph = nodes.add("ShaderNodeEmission", "Photograph", 3)
    nodes.join(total, photograph.inputs["Color"])
    surface = nodes.add("ShaderNodeBsdfPrincipled", "Surface under the scene's lights", 3)
    nodes.join(parts[0], surface.inputs["Base Color"])
    mix = nodes.add("ShaderNodeMixShader", "Photograph or surface", 4)
    nodes.join(nodes.value("Relit", 0.0), mix.inputs[0])
    nodes.join(photograph, mix.inputs[1])
    nodes.join(surface, mix.inputs[2])
    nodes.join(mix, nodes.add("ShaderNodeOutputMaterial", "Output", 5).inputs["Surface"])
    return nodes.material


def surface_material(name, images):
    """A material of maps: normals, `principled_maps`, and where there is, roughness."""
    nodes = Nodes(name)
    textures = nodes.textures(images)
    surface = nodes.add("ShaderNodeBsdfPrincipled", "Surface", 3)
    for layer, socket in SOCKETS.items():
        if layer in textures:
            nodes.join(textures[layer], surface.inputs[socket])
    up = nodes.add("ShaderNodeVectorMath", "to 0 ... 1", 1, operation="MULTIPLY_ADD")
    up.inputs[1].default_value = up.inputs[2].default_value = (0.5, 0.5, 0.5)
    nodes.join(textures["normal"], up.inputs[0])
    bump = nodes.add("ShaderNodeNormalMap", "Normals", 2)
    nodes.join(up, bump.inputs["Color"])
    nodes.join(bump, surface.inputs["Normal"])
    nodes.join(surface, nodes.add("ShaderNodeOutputMaterial", "Output", 4).inputs["Surface"])
    return nodes.material


def make_plane(name, material, aspect):
    """An upright plane, 1 high and ``aspect`` wide, that faces the front view."""
    mesh = bpy.data.meshes.new(name)
    corners = [(0, 0), (1, 0), (1, 1), (0, 1)]
    mesh.from_pydata([(aspect * (u - 0.5), 0, v - 0.5) for u, v in corners], [], [(0, 1, 2, 3)])
    mesh.uv_layers.new(name="UVMap").data.foreach_set("uv", [x for corner in corners for x in corner])
    mesh.materials.append(material)
    plane = bpy.data.objects.new(name, mesh)
    bpy.context.collection.objects.link(plane)
    return plane


def import_file(path):
    """Import one file of polsep; return the new object. Raises ValueError in one line."""
    path = Path(path)
    layers = read_layers(path)
    mesh = path.with_suffix(".glb")
    if "albedo" in layers and mesh.is_file():
        before = set(bpy.data.objects)
        bpy.ops.import_scene.gltf(filepath=str(mesh), merge_vertices=False)
        return next(thing for thing in bpy.data.objects if thing not in before and thing.type == "MESH")
    surface = "normal" in layers
    maps = {**layers, **principled_maps(layers)} if surface else layers
    images = {layer: make_image(f"{path.stem} {layer}", layer, pixels) for layer, pixels in maps.items()}
    material = (surface_material if surface else separation_material)(path.stem, images)
    height, width = next(iter(layers.values())).shape[:2]
    return make_plane(path.stem, material, width / height)


class IMPORT_OT_polsep(bpy.types.Operator, ImportHelper):
    """Import images that polsep separated, or its materials and shapes, with a material."""

    bl_idname = "import_scene.polsep"
    bl_label = "Import polsep"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012
    filename_ext = ".exr"
    filter_glob: bpy.props.StringProperty(default="*.exr", options={"HIDDEN"})
    files: bpy.props.CollectionProperty(type=bpy.types.OperatorFileListElement, options={"HIDDEN", "SKIP_SAVE"})
    directory: bpy.props.StringProperty(subtype="DIR_PATH", options={"HIDDEN", "SKIP_SAVE"})

    def execute(self, context):
        """Import every chosen file; an error names its file and ends the import."""
        paths = [Path(self.directory) / file.name for file in self.files if file.name] or [Path(self.filepath)]
        try:
            things = [import_file(path) for path in paths]
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        for thing in context.selected_objects:
            thing.select_set(False)
        for thing in things:
            thing.select_set(True)
        context.view_layer.objects.active = things[-1]
        return {"FINISHED"}


def _menu(self, context):
    self.layout.operator(IMPORT_OT_polsep.bl_idname, text="polsep (.exr)")


def register():
    """Add the operator and its line in the menu."""
    bpy.utils.register_class(IMPORT_OT_polsep)
    bpy.types.TOPBAR_MT_file_import.append(_menu)


def unregister():
    """Remove them."""
    bpy.types.TOPBAR_MT_file_import.remove(_menu)
    bpy.utils.unregister_class(IMPORT_OT_polsep)
