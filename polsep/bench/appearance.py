"""The gallery of docs/gallery.md, after the paper's Figs. 6 to 8: captures, what they become, what edits make of them.

Captures are the demo's and renders of known truth: spot and fish by Keenan Crane (public domain, from the data folder)
and shapes of this project, in 12 bits with the noise of the IMX250. Every picture is of what `separate` found in one
such frame. `draw_real` does the same with frames of real cameras; their pictures are not part of the project.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from polsep.bench.figures import Panel, Pixels, draw_grid
from polsep.bench.gallery import REAL
from polsep.bench.rows import Row
from polsep.camera import IMX250, Layout, Mosaic, expose
from polsep.edit import (
    Edit,
    IsolateHighlights,
    Metallic,
    Recipe,
    Recolor,
    RemoveHighlights,
    Rougher,
    Texture,
    Tint,
    apply,
)
from polsep.edit.images import Maps
from polsep.io.frames import ReadOptions, read_frames
from polsep.io.pictures import write_picture
from polsep.io.previews import exposure_of, toned
from polsep.metrics import psnr
from polsep.pipeline import separate_capture
from polsep.render import GBuffer, PinholeCamera, PointLight, Scene, camera_axes, render
from polsep.report import SeparatedFrame
from polsep.scenes import Field, cells, marble, still_life, stripes
from polsep.simulate import expose_to_clip, half_resolution

if TYPE_CHECKING:
    from polsep.raycast import MeshScene

Floats = NDArray[np.float32]

#: Raw pixels per side, width of a panel, share of the samples that clips, seed of the noise.
SIDE, CELL, CLIPPED, SEED = 1024, 300, 0.003, 8
#: How much brighter specular images are shown.
SPECULAR_GAIN = 2.0


@dataclass(frozen=True)
class Taken:
    """One capture: its ``title``, the raw ``mosaic``; of renders, true ``scene`` and ``normals [h, w, 3]`` of the half
    resolution (x right, y up, z to the camera, 0 without a surface)."""

    title: str
    mosaic: Mosaic
    scene: Scene | None = None
    normals: Floats | None = None

    def truth(self) -> tuple[Tensor, Tensor, Tensor]:
        """Diffuse, specular and mask at half resolution."""
        assert self.scene is not None
        return half_resolution(self.scene)

    def separate(self) -> SeparatedFrame:
        """What the default method finds."""
        return separate_capture(self.mosaic, "auto")


def expose_scene(title: str, scene: Scene, normals: Floats | None = None) -> Taken:
    """A scene as 12 bits of an IMX250, its brightest samples clipped."""
    exposed = expose_to_clip(scene, CLIPPED, Layout(), IMX250)
    generator = torch.Generator().manual_seed(SEED)
    return Taken(title, expose(exposed.diffuse + exposed.specular, Layout(), IMX250, generator), exposed, normals)


def take_still_life(_data: Path) -> Taken:
    """The demo's scene, made anew at half its size."""
    parts, camera, light = still_life()
    size = (SIDE, SIDE * 6 // 5)
    diffuse, specular = render(parts, camera, light, size)
    lit = (diffuse + specular).s0.amax(dim=0) > 0
    return expose_scene("the demo's scene", Scene(diffuse, specular, lit))


def take_spot(data: Path) -> Taken | None:
    """Spot with veins of two colours."""
    return _take_mesh(
        "spot", data / "meshes/spot.obj", (140.0, 14.0), (marble((0.62, 0.16, 0.06), (0.78, 0.5, 0.2), 0.9), 0.32)
    )


def take_fish(data: Path) -> Taken | None:
    """The fish with stripes."""
    skin = stripes((0.05, 0.3, 0.42), (0.62, 0.5, 0.16), 0.16)
    return _take_mesh("fish", data / "meshes/fish.obj", (65.0, 12.0), (skin, 0.3))


def take_shape(_data: Path) -> Taken:
    """A random shape of the test split, in patches of a few colours."""
    from polsep.views import seeded_shape

    colors = ((0.55, 0.06, 0.08), (0.75, 0.66, 0.5), (0.08, 0.2, 0.35), (0.16, 0.4, 0.2))
    skin = cells(colors, 0.35, torch.Generator().manual_seed(SEED))
    return _render_mesh("a random shape", seeded_shape("test", 0, 4), (30.0, 25.0), (skin, 0.3))


def _take_mesh(title: str, path: Path, pose: tuple[float, float], look: tuple[Field, float]) -> Taken | None:
    from polsep.io.objects import read_mesh
    from polsep.raycast import MeshScene

    if not path.is_file():
        print(f"polsep: {title} is left out: expected {path}, found none", file=sys.stderr)
        return None
    return _render_mesh(title, MeshScene(read_mesh(path)), pose, look)


def _render_mesh(title: str, model: MeshScene, pose: tuple[float, float], look: tuple[Field, float]) -> Taken:
    """A mesh from azimuth and elevation [degrees], of an albedo and a roughness, lit from above the camera."""
    from polsep.raycast import Hits
    from polsep.testsets.casting import look_at, render_covered

    albedo, roughness = look
    camera = look_at(model.mesh, *pose)
    right, up, _ = camera_axes(camera)
    eye = torch.tensor(camera.position)
    far = float(eye.norm())
    lamp = eye - 0.35 * far * right + 0.45 * far * up
    light = PointLight(tuple(lamp.tolist()), 1.0, math.radians(30))

    def cover(hits: Hits) -> GBuffer:
        one = torch.ones_like(hits.position[:1])
        return GBuffer(hits.position, hits.normal, albedo(hits.position), roughness * one, one, one > 0)

    return expose_scene(title, render_covered(model, cover, camera, light, SIDE), find_normals(model, camera))


def find_normals(model: MeshScene, camera: PinholeCamera) -> Floats:
    """Normals in the camera's frame at the centres of the separated pixels."""
    from polsep.raycast import find_hits

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


SUBJECTS: tuple[Callable[[Path], Taken | None], ...] = (take_spot, take_fish, take_shape, take_still_life)
#: The edits of the gallery: title, edits, whether normals guide them.
EDITS: tuple[tuple[str, tuple[Edit, ...]], ...] = (
    ("metallic (45 x specular, as the paper)", (Metallic(),)),
    ("rougher (sigma 10 px, as the paper)", (Rougher(sigma=10.0),)),
    (
        "texture under the highlights",
        (Recolor(color=(1.0, 1.0, 1.0)), Texture(image="cloth", repeats=3.0, normals="normals")),
    ),
    ("recoloured", (Recolor(color=(0.05, 0.22, 0.6)),)),
    ("without highlights", (RemoveHighlights(),)),
    ("highlights alone", (IsolateHighlights(),)),
    ("rough metal", (Rougher(sigma=5.0), Metallic(gain=25.0))),
    ("evening light", (Tint(color=(1.0, 0.62, 0.3)),)),
)


def bench_gallery(data: Path) -> Iterator[Row]:
    """How near the separations of the gallery's captures come to the truth; draws docs/gallery.md's pictures.

    Raises ValueError without the extras render and bench.
    """
    for taken in take_all(data):
        found = taken.separate()
        diffuse, specular, mask = taken.truth()
        for name, image, truth in (("diffuse", found.diffuse, diffuse), ("specular", found.specular, specular)):
            value = psnr(torch.from_numpy(image).permute(2, 0, 1), truth, mask)
            yield Row("gallery", taken.title, found.report["method"], f"{name} PSNR", value, "dB")


def take_all(data: Path) -> Iterator[Taken]:
    """The captures that can be made here. Raises ValueError without Embree."""
    try:
        import polsep.raycast  # noqa: F401
    except ImportError as error:
        raise ValueError(f"expected the extra render, found no {error.name}") from None
    yield from (taken for make in SUBJECTS if (taken := make(data)) is not None)


def draw_gallery(_rows: Sequence[Row], data: Path, folder: Path) -> Iterator[Path]:
    """Write the pictures of docs/gallery.md into ``folder`` and give their paths."""
    separations, edited = [], {}
    for taken in take_all(data):
        found = taken.separate()
        separations.append(_separation_row(taken, found))
        if taken.normals is not None:
            edited[taken.title] = partial(draw_edits, taken.title, found, taken.normals)
    yield _written(
        folder / "separated.jpg",
        draw_grid(separations, "One 12-bit frame each: input, what polsep finds, and the truth", CELL),
    )
    for title, draw in edited.items():
        yield _written(folder / f"edits-{title.replace(' ', '-')}.jpg", draw())


def _written(path: Path, pixels: Pixels) -> Path:
    write_picture(path, pixels)
    return path


def _separation_row(taken: Taken, found: SeparatedFrame) -> list[Panel]:
    """Input, diffuse and specular, and the truth of both where it is known."""
    light = found.diffuse + found.specular
    gain = exposure_of(light)
    images = [
        (f"{taken.title}: input", light, 1.0),
        ("diffuse", found.diffuse, 1.0),
        ("specular x 2", found.specular, SPECULAR_GAIN),
    ]
    if taken.scene is not None:
        diffuse, specular, _ = (image.float().numpy() for image in taken.truth())
        images += [
            ("true diffuse", diffuse.transpose(1, 2, 0), 1.0),
            ("true specular x 2", specular.transpose(1, 2, 0), SPECULAR_GAIN),
        ]
    return [Panel(title, toned(image, factor * gain)) for title, image, factor in images]


def draw_edits(title: str, found: SeparatedFrame, normals: Floats | None) -> Pixels:
    """The input and every edit of `EDITS` that there is an image for, four in a row, at the input's exposure."""
    maps: Maps = {"cloth": make_cloth()} | ({} if normals is None else {"normals": normals})
    light = found.diffuse + found.specular
    gain = exposure_of(light)
    panels = [Panel("input", toned(light, gain))]
    for name, edits in EDITS:
        fitting = tuple(_without_normals(edit) if normals is None else edit for edit in edits)
        if found.diffuse.shape[2] == 1 and any(edit.needs_color for edit in fitting):
            continue
        panels.append(Panel(name, toned(apply(found, Recipe(fitting), maps).combined, gain)))
    rows = [panels[first : first + 3] for first in range(0, len(panels), 3)]
    return draw_grid(rows, f"{title}: edits of one separated frame, same exposure", CELL)


def _without_normals(edit: Edit) -> Edit:
    return Texture(image=edit.image, repeats=edit.repeats) if isinstance(edit, Texture) else edit


def bench_gallery_real(data: Path) -> Iterator[Row]:
    """How much of the light of real frames is specular; draws them and their edits, for looking at only."""
    for taken in take_real(data):
        found = taken.separate()
        share = float(found.specular.mean() / max(float((found.diffuse + found.specular).mean()), 1e-9))
        yield Row("gallery-real", taken.title, found.report["method"], "specular light", 100 * share, "%")


def take_real(data: Path) -> Iterator[Taken]:
    """Frames of real cameras that there are in the data folder."""
    for name, title, white in REAL:
        if (data / name.format(angle=0)).is_file():
            frame = next(read_frames(data / name, ReadOptions(Layout(bayer=None), white_level=white)))
            yield Taken(title, frame.data)  # type: ignore[arg-type]  # measurements are separated alike


def draw_gallery_real(_rows: Sequence[Row], data: Path, folder: Path) -> Iterator[Path]:
    """Write pictures of real frames, which are not part of the project, into ``folder``."""
    for taken in take_real(data):
        found = taken.separate()
        stem = taken.title.replace(", ", "-").replace(" ", "-")
        yield _written(folder / f"{stem}.jpg", draw_grid([_separation_row(taken, found)], taken.title, CELL))
        yield _written(folder / f"{stem}-edits.jpg", draw_edits(taken.title, found, None))
