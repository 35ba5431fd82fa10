"""The gallery of docs/gallery.md, after the paper's Figs. 6 to 8: captures, separations and edits.

Captures are renders of known truth: spot and fish by Keenan Crane (public domain, from the data folder) and a shape of
this project, in 12 bits with the noise of the IMX250. Every picture is made from the separation of one
such frame. `draw_gallery_real` does the same with frames of real cameras; their pictures are not part of the project.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evaluation.figures import Panel, Pixels, draw_grid
from evaluation.gallery import REAL, crop
from polsep.bench.rows import Row
from polsep.edit import (
    Edit,
    IsolateHighlights,
    Metallic,
    Recipe,
    Recolor,
    RemoveHighlights,
    Rougher,
    Sharper,
    SpecularGain,
    Texture,
    Tint,
    apply,
)
from polsep.edit.images import Maps
from polsep.io.raw.frames import ReadOptions, read_frames
from polsep.io.results.previews import exposure_of, toned
from polsep.io.store.image_codecs import write_jpeg
from polsep.metrics import psnr
from polsep.pipeline import separate_capture
from polsep.render.materials import Materials
from polsep.render.simulate import blur, expose_to_clip, half_resolution
from polsep.render.sphere_tracing import PinholeCamera, PointLight, Scene, Vector, camera_axes
from polsep.render.textures import CLOUDS, STRIPES, Textures
from polsep.sensor.camera import IMX250, Capture, Layout, expose
from polsep.separation.report import SeparatedFrame

if TYPE_CHECKING:
    from polsep.render.raycast import MeshScene
    from polsep.render.shapes import Mesh

Floats = NDArray[np.float32]

#: Raw pixels per side, width of a panel, share of the samples that clips, seed of the noise.
SIDE, CELL, CLIPPED, SEED = 768, 240, 0.002, 8
#: Where patterns change from one colour to the other, and over which width: within `materials.THRESHOLDS` and `EDGES`.
THRESHOLD_AND_EDGE = {CLOUDS: (0.0, 0.3), STRIPES: (0.5, 0.2)}


@dataclass(frozen=True)
class GalleryCapture:
    """One capture: its ``title``, the raw ``mosaic``; of renders, true ``scene`` and ``normals [h, w, 3]`` of the half
    resolution (x right, y up, z to the camera, 0 without a surface)."""

    title: str
    mosaic: Capture
    scene: Scene | None = None
    normals: Floats | None = None

    def truth(self) -> tuple[Tensor, Tensor, Tensor]:
        """Diffuse, specular and mask at half resolution."""
        assert self.scene is not None
        return half_resolution(self.scene)

    def separate(self) -> SeparatedFrame:
        """The separation by the default method."""
        return separate_capture(self.mosaic, "auto", "white")


def expose_scene(title: str, scene: Scene, normals: Floats | None = None) -> GalleryCapture:
    """A scene as 12 bits of an IMX250, its brightest samples clipped."""
    exposed = expose_to_clip(scene, CLIPPED, Layout(), IMX250)
    generator = torch.Generator().manual_seed(SEED)
    return GalleryCapture(
        title, expose(exposed.diffuse + exposed.specular, Layout(), IMX250, generator), exposed, normals
    )


def render_spot(data: Path) -> GalleryCapture:
    """Spot, clouded in two warm colours."""
    skin = Skin(((0.66, 0.2, 0.07),), ((0.8, 0.55, 0.22),), CLOUDS, 0.35, 0.3)
    return _render_model("spot", data / "meshes/spot.obj", (140.0, 14.0), skin)


def render_fish(data: Path) -> GalleryCapture:
    """The fish, striped."""
    skin = Skin(((0.05, 0.3, 0.42),), ((0.62, 0.48, 0.14),), STRIPES, 0.25, 0.26)
    return _render_model("fish", data / "meshes/fish.obj", (65.0, 12.0), skin)


def render_gourd(_data: Path) -> GalleryCapture:
    """A glazed gourd of this page's own, clouded."""
    from polsep.render.raycast import MeshScene

    skin = Skin(((0.1, 0.36, 0.32),), ((0.72, 0.6, 0.34),), CLOUDS, 0.45, 0.34)
    return _render("gourd", MeshScene(make_gourd()), (20.0, 18.0), skin)


def make_gourd(rows: int = 160, cols: int = 240) -> Mesh:
    """A closed surface of revolution about y: radius 2 sqrt(t (1 - t)) (0.45 + 0.2 cos 2 pi (t - 0.3)) at height t."""
    from polsep.render.shapes import Mesh

    t, turn = np.meshgrid(np.linspace(1e-4, 1 - 1e-4, rows), np.linspace(0, 2 * np.pi, cols), indexing="ij")

    def radius(t: NDArray[np.float64]) -> NDArray[np.float64]:
        return 2 * np.sqrt(t * (1 - t)) * (0.45 + 0.2 * np.cos(2 * np.pi * (t - 0.3)))

    slope = (radius(t + 5e-5) - radius(t - 5e-5)) / 1e-4 / 2.2
    points = np.stack([radius(t) * np.sin(turn), 2.2 * t - 1.1, radius(t) * np.cos(turn)], axis=-1)
    normals = np.stack([np.sin(turn), -slope, np.cos(turn)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    corner = (np.arange(rows - 1)[:, None] * cols + np.arange(cols - 1)).ravel()
    faces = np.concatenate(
        [np.stack(c, -1) for c in ((corner, corner + 1, corner + cols), (corner + 1, corner + cols + 1, corner + cols))]
    )
    flat = [x.reshape(-1, x.shape[-1]) for x in (points, normals, np.stack([t, turn / (2 * np.pi)], axis=-1))]
    return Mesh(flat[0], flat[1], flat[2], faces, np.zeros(len(faces), np.int64))


class Skin(NamedTuple):
    """Two albedos per slot, the pattern of `render.textures` that mixes them, the size of its cells, the roughness."""

    first: tuple[Vector, ...]
    second: tuple[Vector, ...]
    pattern: int
    size: float
    roughness: float


def _materials(skin: Skin, slots: int) -> Materials:
    """A skin as materials of so many slots."""
    first, second = (
        torch.tensor([colors[k % len(colors)] for k in range(slots)]) for colors in (skin.first, skin.second)
    )
    one = torch.ones(slots)
    transform = torch.cat([torch.eye(3) / skin.size, torch.full((3, 1), 0.3)], dim=1).expand(slots, 3, 4).contiguous()
    whole = {"pattern": skin.pattern, "seed": SEED, "octaves": 2}
    numbers = {name: torch.full((slots,), value, dtype=torch.int64) for name, value in whole.items()}
    threshold, edge = THRESHOLD_AND_EDGE[skin.pattern]
    even = {name: value * one for name, value in (("warp", 0.4), ("threshold", threshold), ("edge", edge))}
    textures = Textures(second, skin.roughness * one, transform=transform, **even, **numbers)
    return Materials(first, skin.roughness * one, one, textures)


def _render_model(title: str, path: Path, pose: tuple[float, float], skin: Skin) -> GalleryCapture:
    from polsep.io.assets.objects import read_mesh
    from polsep.render.raycast import MeshScene

    return _render(title, MeshScene(read_mesh(path)), pose, skin)


def _render(title: str, model: MeshScene, pose: tuple[float, float], skin: Skin) -> GalleryCapture:
    """A mesh from azimuth and elevation [degrees], lit from above the camera, through its lens."""
    from evaluation.testsets.casting import LENS_BLUR, SAMPLES, look_at
    from polsep.render.raycast import render_scene

    camera = look_at(model.mesh, *pose)
    right, up, _ = camera_axes(camera)
    eye = torch.tensor(camera.position)
    far = float(eye.norm())
    x, y, z = (eye - 0.35 * far * right + 0.45 * far * up).tolist()
    light = PointLight((x, y, z), 1.0, math.radians(30))
    materials = _materials(skin, model.mesh.slot_count)
    scene = render_scene((model, materials), camera, light, (SIDE, SIDE), SAMPLES)
    return expose_scene(title, blur(scene, LENS_BLUR), find_normals(model, camera))


def find_normals(model: MeshScene, camera: PinholeCamera) -> Floats:
    """Normals in the camera's frame at the centres of the separated pixels."""
    from polsep.render.raycast import find_hits

    side = SIDE // 2
    rows, cols = (g.flatten() for g in torch.meshgrid(*[torch.arange(side) + 0.5] * 2, indexing="ij"))
    hits = find_hits(model, camera, (rows, cols), (side, side))
    axes = camera_axes(camera)
    axes[2] *= -1  # forward is away from the camera
    found = torch.zeros(3, hits.rays)
    found[:, hits.ray] = axes @ hits.normal[..., 0]
    return found.T.reshape(side, side, 3).contiguous().numpy()


def make_cloth(side: int = 512) -> Floats:
    """A printed cloth of this page's own: rings and lines on a light ground, reflectance ``[side, side, 3]``."""
    y, x = np.meshgrid(*[(np.arange(side) + 0.5) * 8 / side] * 2, indexing="ij")
    ring = np.hypot(x % 2 - 1, y % 2 - 1)
    other = np.hypot((x + 1) % 2 - 1, (y + 1) % 2 - 1)
    image = np.full((side, side, 3), (0.95, 0.9, 0.8))
    image[np.abs(ring - 0.62) < 0.1] = (0.12, 0.22, 0.5)
    image[ring < 0.3] = (0.75, 0.15, 0.12)
    image[other < 0.18] = (0.15, 0.4, 0.3)
    return image.astype(np.float32)


SUBJECTS: tuple[Callable[[Path], GalleryCapture], ...] = (render_spot, render_fish, render_gourd)
#: The edits of the gallery by title.
EDITS: tuple[tuple[str, tuple[Edit, ...]], ...] = (
    ("metallic, gain 45 as the paper's", (Metallic(),)),
    ("rougher, sigma 10 as the paper's", (Rougher(sigma=10.0),)),
    ("rough metal", (Rougher(sigma=5.0), Metallic(gain=25.0))),
    ("glossier", (Sharper(sigma=3.0), SpecularGain(gain=1.5))),
    (
        "texture under the highlights",
        (Recolor(color=(1.0, 1.0, 1.0)), Texture(image="cloth", repeats=3.0, normals="normals")),
    ),
    ("recoloured", (Recolor(color=(0.05, 0.22, 0.6)),)),
    ("without highlights", (RemoveHighlights(),)),
    ("highlights alone", (IsolateHighlights(),)),
    ("evening light", (Tint(color=(1.0, 0.62, 0.3)),)),
)


def bench_gallery(data: Path) -> Iterator[Row]:
    """PSNR of the separations of the gallery's captures, and the pictures of docs/gallery.md.

    Raises ValueError without the extras render and bench.
    """
    for capture, found in separate_all(data):
        diffuse, specular, mask = capture.truth()
        for name, image, truth in (("diffuse", found.diffuse, diffuse), ("specular", found.specular, specular)):
            value = psnr(torch.from_numpy(image).permute(2, 0, 1), truth, mask)
            yield Row("gallery", capture.title, found.report["method"], f"{name} PSNR", value, "dB")


@cache
def separate_all(data: Path) -> tuple[tuple[GalleryCapture, SeparatedFrame], ...]:
    """The captures, separated. Raises ValueError without Embree."""
    try:
        import polsep.render.raycast  # noqa: F401
    except ImportError as error:
        raise ValueError(f"expected the extra render, found no {error.name}") from None
    captures = [make(data) for make in SUBJECTS]
    return tuple((capture, capture.separate()) for capture in captures)


def draw_gallery(_rows: Sequence[Row], data: Path, folder: Path) -> Iterator[Path]:
    """Write the pictures of docs/gallery.md into ``folder`` and give their paths."""
    all_of_them = separate_all(data)
    separations = [_separation_row(capture, found) for capture, found in all_of_them]
    yield _written(folder / "separated.jpg", draw_grid(separations, "One 12-bit frame each", CELL))
    for capture, found in all_of_them:
        yield _written(folder / f"edits-{capture.title}.jpg", draw_edits(capture, found))


def _written(path: Path, pixels: Pixels) -> Path:
    write_jpeg(path, pixels)
    return path


def _frame_of(capture: GalleryCapture, image: Floats) -> Floats:
    """An image around its object, or all of it where that is unknown."""
    if capture.scene is None:
        return image
    around = crop(torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1), capture.truth()[2])
    return around.permute(1, 2, 0).numpy()


def _separation_row(capture: GalleryCapture, found: SeparatedFrame) -> list[Panel]:
    """Input, diffuse and specular, and the truth of both where it is known."""
    light = found.diffuse + found.specular
    gain = exposure_of(light)
    images = [(f"{capture.title}: input", light), ("diffuse", found.diffuse), ("specular x 2", 2 * found.specular)]
    if capture.scene is not None:
        diffuse, specular = (image.float().permute(1, 2, 0).numpy() for image in capture.truth()[:2])
        images += [("true diffuse", diffuse), ("true specular x 2", 2 * specular)]
    return [Panel(title, toned(_frame_of(capture, image), gain)) for title, image in images]


def draw_edits(capture: GalleryCapture, found: SeparatedFrame) -> Pixels:
    """The input and every edit of `EDITS` that the frame has colours for, at the input's exposure, five in a row."""
    maps = {"cloth": make_cloth()}
    if capture.scene is not None and capture.normals is not None:
        maps |= {"normals": capture.normals, "object": capture.truth()[2].float().numpy()}
    light = found.diffuse + found.specular
    gain = exposure_of(light)
    panels = [Panel(f"{capture.title}: input", toned(_frame_of(capture, light), gain))]
    for name, edits in EDITS:
        if found.diffuse.shape[2] == 1 and any(edit.needs_color for edit in edits):
            continue
        recipe = Recipe(tuple(_fitting(edit, maps) for edit in edits))
        panels.append(Panel(name, toned(_frame_of(capture, apply(found, recipe, maps).combined), gain)))
    rows = [panels[first : first + 5] for first in range(0, len(panels), 5)]
    return draw_grid(rows, "Edits of one separated frame, at its exposure", CELL)


def _fitting(edit: Edit, maps: Maps) -> Edit:
    """The edit along the object's normals, and inside its outline if it spreads light, where these are known."""
    if isinstance(edit, Texture) and "normals" not in maps:
        return replace(edit, normals=None)
    return replace(edit, mask="object") if isinstance(edit, (Rougher, Metallic)) and "object" in maps else edit


def bench_gallery_real(data: Path) -> Iterator[Row]:
    """Share of specular light in real frames, and pictures of them and their edits, which are not published."""
    for capture in read_real(data):
        found = capture.separate()
        share = float(found.specular.mean() / max(float((found.diffuse + found.specular).mean()), 1e-9))
        yield Row("gallery_real", capture.title, found.report["method"], "specular light", 100 * share, "%")


def read_real(data: Path) -> Iterator[GalleryCapture]:
    """Frames of real cameras from the data folder."""
    for name, title, white in REAL:
        frame = next(read_frames(data / name, ReadOptions(Layout(bayer=None), white_level=white)))
        yield GalleryCapture(title, frame.data)


def draw_gallery_real(_rows: Sequence[Row], data: Path, folder: Path) -> Iterator[Path]:
    """Write pictures of real frames, which are not part of the project, into ``folder``."""
    for capture in read_real(data):
        found = capture.separate()
        stem = capture.title.replace(", ", "-").replace(" ", "-")
        yield _written(folder / f"{stem}.jpg", draw_grid([_separation_row(capture, found)], capture.title, CELL))
        yield _written(folder / f"{stem}-edits.jpg", draw_edits(capture, found))
