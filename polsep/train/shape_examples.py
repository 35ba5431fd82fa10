"""Training examples of shape from one frame: a raw frame of a random object, separated, and the truth of its surface.

A third of the objects are unions of solids (`render.shapes`), a third smooth bodies (`render.blobs`), a third vessels
(`render.vessels`). Solids are seen from all sides; bodies and vessels stand, and cameras look at them as users do
(`random_upright_camera`). Examples of the split `MESHES` show meshes of files (`render.models`), which stand, too.
Lights, looks and disturbances are those of the separation's training (`variety`, `reality`). The lamp is mostly beside
the camera. Frames are exposed, recorded with noise and separated by `METHODS`, as users' frames are; networks never see
true images, but for the input "perfect", which measures what better separation could gain.

Conventions: images at half resolution, the lamp's colour divided out, 1 = white level of one measurement; normals x
right, y up, z to the camera.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from polsep.demosaic.measured_stokes import measured_stokes
from polsep.io.store.examples import read_example, write_example
from polsep.pipeline import separate_capture
from polsep.render.blobs import random_blob
from polsep.render.materials import Materials, random_materials
from polsep.render.models import random_model
from polsep.render.raycast import MeshScene, View, build_gbuffer, find_lit, find_view, shade_view
from polsep.render.shapes import Floats, Mesh, random_mesh
from polsep.render.simulate import blur, capture, expose_to_clip, expose_to_level
from polsep.render.sphere_tracing import PinholeCamera, PointLight, camera_axes
from polsep.render.vessels import random_vessel
from polsep.render.views import (
    MIN_LEVEL,
    MIN_LIT,
    Shot,
    lit_share,
    random_camera,
    random_camera_from,
    random_clip,
    scene_seed,
)
from polsep.sensor.camera import Layout
from polsep.train.reality import RealScene, as_ideal, disturb
from polsep.train.stream import relit_of
from polsep.train.variety import (
    LitView,
    log_between,
    random_sensor,
    vary_colors,
    vary_gloss,
    vary_normals,
    vary_polarization,
    vary_shot,
)

#: Planes of an example, in order: the measured s0, s1, s2 of three colours; what the separation found, with the s1 and
#: s2 of all colours and its expected errors; the same without errors; the mask; what the surface is; the lamp.
PLANES = {
    "stokes": slice(0, 9),
    "found": slice(9, 13),
    "found_polarized": slice(13, 15),
    "found_error": slice(15, 17),
    "true": slice(17, 21),
    "true_polarized": slice(21, 23),
    "mask": slice(23, 24),
    "normal": slice(24, 27),
    "albedo": slice(27, 30),
    "roughness": slice(30, 31),
    "specular": slice(31, 32),
    "light": slice(32, 35),
}
COUNT = 35
#: Raw pixels per side, and rays along a pixel's side.
SIDE, SAMPLES = 384, 2
#: Methods that separate frames, and their shares.
METHODS, METHOD_SHARES = ("joint", "joint-fast", "color-affine"), (0.7, 0.2, 0.1)
#: Share of lamps near the camera, largest angle of these and of the others, and distances in radii of the object.
NEAR_SHARE, NEAR_DEG, LARGEST_DEG, DISTANCES = 0.3, 20.0, 60.0, (3.0, 12.0)
#: Shares of views that may be close-ups, of scenes with disturbances, and with another diffuse polarization.
CLOSE_SHARE, REAL_SHARE, DEPOLARIZED_SHARE = 0.4, 0.6, 0.5
#: Standard deviation of the lens's point spread in raw pixels.
BLURS = (0.3, 1.0)
#: Elevations of cameras about objects that stand [degrees]; share of those that look down, and their elevations.
ELEVATIONS_DEG, DOWN_SHARE, DOWN_DEG = (-5.0, 70.0), 0.1, (70.0, 88.0)
#: Kinds of objects in turn; all but the first stand.
KINDS = (random_mesh, random_blob, random_vessel)
#: The split of training examples that show meshes of files, beside those of `render.views.SPLITS`.
MESHES = "meshes"
#: Most draws of a view that shows much of the object lit.
MAX_DRAWS = 20


class Examples(NamedTuple):
    """Examples of a ``split`` and a ``seed``; ``meshes``, with creases, are those that the split `MESHES` shows.

    ``shown``: the sha256 of the files of these; its beginning is in the names of their examples.
    """

    split: str
    seed: int
    meshes: Sequence[Mesh] = ()
    shown: str = ""

    def generator(self, number: int, view: int | None = None) -> torch.Generator:
        """Return the generator of the object of example ``number``, or of a view of it."""
        split = "train" if self.split == MESHES else self.split
        return torch.Generator().manual_seed(scene_seed(split, self.seed, number, view))

    def shape(self, number: int) -> MeshScene:
        """Return random object ``number``; but for meshes, the number says of which of `KINDS`."""
        generator = self.generator(number)
        if self.split == MESHES:
            return MeshScene(random_model(self.meshes, generator))
        return MeshScene(KINDS[number % len(KINDS)](generator))

    def stands(self, number: int) -> bool:
        """Return True where the object of example ``number`` stands, +y up, before an upright camera."""
        return self.split == MESHES or number % len(KINDS) != 0

    def path(self, folder: Path, number: int) -> Path:
        """The file of example ``number``."""
        of = f".{self.shown[:12]}" if self.split == MESHES and self.shown else ""
        return folder / f"shape-{self.split}{of}-{self.seed}-{number:06d}.npy"


def random_upright_camera(vertices: Floats, generator: torch.Generator) -> PinholeCamera:
    """Return a camera that looks at an object that stands: mostly from `ELEVATIONS_DEG`, sometimes straight down."""
    turn, down, height = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
    low, high = DOWN_DEG if down < DOWN_SHARE else ELEVATIONS_DEG
    elevation = math.radians(low + (high - low) * height)
    return random_camera_from(vertices, 2 * math.pi * turn, math.sin(elevation), generator)


def random_lamp(camera: PinholeCamera, radius: float, generator: torch.Generator) -> PointLight:
    """Return a lamp near the camera's direction, at a random distance and behind a random polarizer."""
    near, place, turn, far, angle = torch.rand(5, generator=generator, dtype=torch.float64).tolist()
    most = math.radians(NEAR_DEG if near < NEAR_SHARE else LARGEST_DEG)
    cosine, turn = math.cos(most) + (1 - math.cos(most)) * place, 2 * math.pi * turn
    right, up, forward = camera_axes(camera).double()
    sideways = math.cos(turn) * right + math.sin(turn) * up
    distance = radius * log_between(DISTANCES, far)
    x, y, z = (distance * (math.sqrt(1 - cosine**2) * sideways - cosine * forward)).tolist()
    return PointLight((x, y, z), distance**2, math.pi * angle)


def random_shape_shot(shape: MeshScene, upright: bool, generator: torch.Generator) -> Shot:
    """Return a view of a shape under a lamp that reaches much of it. Raises ValueError where none of the draws does."""
    draw_camera = random_upright_camera if upright else random_camera
    for _ in range(MAX_DRAWS):
        camera = draw_camera(shape.mesh.vertices, generator)
        lamp = random_lamp(camera, shape.size / 2, generator)
        softness, close = torch.rand(2, generator=generator, dtype=torch.float64).tolist()
        shot = Shot(camera, lamp, random_clip(generator), log_between(BLURS, softness))
        if lit_share(shape, shot) >= MIN_LIT:
            return vary_shot(shape, shot, generator) if close < CLOSE_SHARE else shot
    raise ValueError(f"expected a view that shows {MIN_LIT:.0%} of the object lit, found none in {MAX_DRAWS} draws")


def random_shape_example(examples: Examples, number: int, side: int = SIDE) -> Tensor:
    """Return planes ``[COUNT, side/2, side/2]`` (`PLANES`) of example ``number``; it depends on the arguments alone."""
    shape, generator = examples.shape(number), examples.generator(number, 0)
    shot = random_shape_shot(shape, examples.stands(number), generator)
    view = vary_normals(find_view(shape, shot.camera, (side, side), SAMPLES), generator)
    materials = random_materials(shape.mesh.slot_count, generator, shape.size)
    materials = vary_gloss(vary_colors(materials, generator), generator)
    lit_view = LitView(view, materials, shot.light, find_lit(shape, view, shot.light))
    scene = blur(shade_view(*lit_view), shot.blur)
    real, depolarized = torch.rand(2, generator=generator, dtype=torch.float64).tolist()
    if depolarized < DEPOLARIZED_SHARE:
        scene = vary_polarization(scene, generator)

    second = LitView(view, materials, random_lamp(shot.camera, shape.size / 2, generator), lit_view.lit)
    relit = relit_of(shape, second, shot.blur)
    found = disturb(scene, relit, generator) if real < REAL_SHARE else as_ideal(scene)
    return torch.cat([_photograph(found, shot.clip, generator), surface_planes(view, materials, shot)])


def _photograph(real: RealScene, clip: float, generator: torch.Generator) -> Tensor:
    """The planes up to the true images: a scene exposed, recorded and separated."""
    sensor, layout = random_sensor(generator), Layout()
    exposed = expose_to_level(expose_to_clip(real.scene, clip, layout, sensor), MIN_LEVEL, layout, sensor)
    mosaic = capture(exposed, layout, sensor, generator).mosaic
    mosaic = replace(mosaic, data=mosaic.data.numpy().astype(np.float32))
    color = real.told / real.told[1]
    light = tuple(float(c) for c in color)
    method = METHODS[int(torch.multinomial(torch.tensor(METHOD_SHARES), 1, generator=generator))]
    frame = separate_capture(mosaic, method, light)
    gain = np.array(light, np.float32)
    stokes = measured_stokes(mosaic, light) / gain
    diffuse, specular = frame.diffuse / gain, (frame.specular / gain).mean(axis=-1, keepdims=True)
    strength = frame.dolp * (diffuse.mean(axis=-1) + specular[..., 0])
    error = np.zeros((*strength.shape, 2), np.float32) if frame.error is None else frame.error / gain.mean()
    images = [stokes[0], stokes[1], stokes[2], diffuse, specular]
    images += [(strength * f(2 * frame.aolp))[..., None] for f in (np.cos, np.sin)] + [error]
    true = [light.s0 / color[:, None, None] for light in (exposed.diffuse, exposed.specular)]
    total = exposed.diffuse + exposed.specular
    polarized = [(s / color[:, None, None]).mean(dim=0, keepdim=True) for s in (total.s1, total.s2)]
    truth = torch.cat([true[0], true[1].mean(dim=0, keepdim=True), *polarized])
    seen = torch.from_numpy(np.concatenate(images, axis=-1)).movedim(-1, 0)
    return torch.cat([seen, avg_pool2d(truth, 2)])


def surface_planes(view: View, materials: Materials, shot: Shot) -> Tensor:
    """Return mask, normal, albedo, roughness, specular strength and the lamp's direction: means over 2x2 pixels."""
    height, width = view.size
    planes = torch.zeros(9, height * width)
    axes = camera_axes(shot.camera)
    toward = torch.stack([axes[0], axes[1], -axes[2]])
    for band in view.bands:
        if not band.pixel.numel():
            continue
        buffer = build_gbuffer(band.hits, materials)
        parts = (torch.ones_like(buffer.roughness), toward @ buffer.normal[..., 0], buffer.albedo)
        values = torch.cat([*(part.reshape(-1, band.pixel.numel()) for part in parts), buffer.roughness[..., 0]])
        values = torch.cat([values, buffer.specular[..., 0]])
        planes.index_add_(1, band.pixels[0] + band.pixel, values)
    means = avg_pool2d((planes / view.samples**2).view(1, 9, height, width), 2)[0]
    mask = (means[:1] > 0.999).float()
    share = means[:1].clamp(min=1e-6)
    normal = torch.nn.functional.normalize(means[1:4], dim=0)
    lamp = torch.tensor(shot.light.position) - torch.tensor(shot.camera.target)
    way = toward.double() @ (lamp / lamp.norm()).double()
    direction = way.float()[:, None, None].expand(-1, *mask.shape[1:])
    return torch.cat([mask, normal * mask, *(means[k : k + 1] / share * mask for k in range(4, 9)), direction])


def find_example(path: Path) -> tuple[Examples, int]:
    """The examples to which a file of `Examples.path` belongs, without their meshes, and its number."""
    _, split, rest = path.stem.split("-", 2)
    seed, number = rest.rsplit("-", 1)  # a seed may have a sign
    return Examples(split.partition(".")[0], int(seed)), int(number)


def make_examples(examples: Examples, folder: Path, numbers: range) -> Iterator[int]:
    """Render the missing ones of some examples; yield their numbers. Views that no lamp reaches are left out."""
    for number in numbers:
        path = examples.path(folder, number)
        if not path.is_file():
            try:
                write_example(path, random_shape_example(examples, number))
            except ValueError:
                continue
        yield number


def load_example(path: Path) -> Tensor:
    """Planes of an example in half precision. Raises ValueError on other files."""
    planes = read_example(path)
    if len(planes) != COUNT:
        raise ValueError(f"expected an example of {COUNT} planes in {path}, found {len(planes)}")
    return planes
