"""`polsep shape`: the file of one frame in, maps, a mesh and a preview of its surface out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from polsep.geometry.frames import open_frame
from polsep.geometry.one_frame import SIDE, UNKNOWN, Shape, find_shape, gather, on_object, square_around
from polsep.geometry.shape_maps import Surface, relight
from polsep.io.assets.maps import read_object
from polsep.io.assets.relight_page import RelightMaps, encode_relight_page
from polsep.io.assets.shapes import ShapeFiles
from polsep.io.raw.frames import ReadOptions
from polsep.io.results.previews import Panel, exposure_of, titled_sheet, toned
from polsep.io.store.errors import input_error
from polsep.light.light_color import LightColor
from polsep.physics.fresnel import ETA
from polsep.separation.report import SeparatedFrame

if TYPE_CHECKING:
    from polsep.geometry.surface import Surface as Mesh

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]
Pixels = NDArray[np.uint8]

#: Side of the square in which depth is integrated and the mesh is spanned, and of a panel of the preview.
MESH_SIDE, CELL = SIDE // 2, 320
#: Largest side of the textures of the page.
PAGE_SIDE = 512
#: Lamps of the preview's relit pictures: their directions, and words for them.
LAMPS = {
    "lamp left": (-0.7, 0.1, 0.7),
    "lamp right": (0.7, 0.1, 0.7),
    "lamp above": (0.0, 0.75, 0.65),
    "lamp below": (0.0, -0.75, 0.65),
}
#: Errors of normals [degrees] that are white in the preview.
LARGEST_DEG = 30.0
#: Colour around the object in the preview.
GREY = 40


@dataclass(frozen=True)
class ShapeSettings:
    """Options of `polsep shape`: ``read`` and ``method`` of a raw frame; ``light_color``, of a separated one too, where
    it goes before that of its report; ``lamp``, the direction toward it; a file of the ``mask``; format of the
    ``mesh`` ("none": no depth and mesh), its ``integration``, a ``turntable``; ``weights`` instead of the shipped ones;
    and the refractive ``index`` of the object."""

    read: ReadOptions = field(default_factory=ReadOptions)
    method: str = "joint"
    light_color: LightColor | str = "auto"
    lamp: tuple[float, ...] | None = None
    mask: Path | None = None
    mesh: str = "glb"
    integration: str = "bilateral"
    turntable: bool = False
    weights: Path | None = None
    index: float = ETA


def find_shape_of(path: Path, settings: ShapeSettings) -> tuple[ShapeFiles, list[str]]:
    """The files of the shape in a frame, and notes for the user. Raises ValueError."""
    frame, notes = open_frame(path, settings.read, settings.method, settings.light_color)
    mask = None if settings.mask is None else read_object(settings.mask, frame.dolp.shape)
    try:
        found = find_shape(frame, mask, settings.lamp, settings.weights, settings.index)
        files = shape_files(frame, found, settings, path.stem)
    except ValueError as error:
        raise input_error(path, error) from error
    notes = [*notes, *found.warnings()]
    return replace(files, facts={**files.facts, "warnings": notes}), notes


def shape_files(frame: SeparatedFrame, found: Shape, settings: ShapeSettings, title: str) -> ShapeFiles:
    """The files of a shape; depth and mesh, unless none is wanted, in a square of `MESH_SIDE` around the object.

    ``title``: of the page that relights it.
    """
    facts: dict[str, Any] = {
        "light": [round(x, 4) for x in found.light],
        "light_is": "found from the shading" if settings.lamp is None else "given",
        "mask_is": "given" if found.mask_given else "found where light falls",
        "index": settings.index,
        "method": frame.report.get("method", "separated before"),
        "median_normal_error_deg": round(float(np.degrees(np.median(found.normal_error[found.mask]))), 2),
        "unknown_roughness": round(float((found.roughness_error[found.mask] >= UNKNOWN).mean()), 4),
    }
    more = {
        "normal_error": np.degrees(found.normal_error),
        "roughness": found.roughness,
        "roughness_error": found.roughness_error,
        "specular": found.specular,
        "specular_error": found.specular_error,
    }
    panels, depth, mesh, film = draw_panels(frame, found), None, None, None
    if settings.mesh != "none":
        from polsep.geometry.files import draw_mesh, encode_mesh, film_turntable

        surface, depth = _solid(found, settings.integration)
        mesh = encode_mesh(surface, settings.mesh, float(np.median(found.roughness[found.mask])))
        panels.append(draw_mesh(surface, CELL))
        facts |= {"integration": settings.integration, "triangles": len(surface.faces)}
        if settings.turntable:
            film = film_turntable(surface)
    normals, albedo = (x.astype(np.float64) for x in (found.normals, found.albedo))
    page = page_of(found, title)
    return ShapeFiles(normals, albedo, depth, found.mask, mesh, titled_sheet(panels), film, facts, more, page)


def page_of(found: Shape, title: str) -> bytes:
    """The page that relights a shape; its lamp begins where the frame's was."""
    return encode_relight_page(_page_maps(found), title, found.light)


def _page_maps(found: Shape) -> RelightMaps:
    """Maps of a page, at most `PAGE_SIDE` pixels wide, the albedo brightest at 0.9."""
    surface, share = in_square(found, PAGE_SIDE)
    gain = 0.9 / max(float(np.percentile(found.albedo[found.mask], 99)), 1e-9)
    normals, colors = (np.moveaxis(x, 0, -1) for x in (surface.normal, surface.albedo * gain))
    return RelightMaps(normals, colors, surface.roughness[0], surface.specular[0], on_object(share))


def _solid(found: Shape, integration: str) -> tuple[Mesh, NDArray[np.float64]]:
    """Mesh and depth ``[h, w]`` of a shape. Needs the extra ``mesh``. Raises ValueError on too thin objects."""
    from polsep.geometry.files import INTEGRATIONS
    from polsep.geometry.photometric import Appearance
    from polsep.geometry.surface import span_surface

    window = square_around(found.mask)
    surface, share = in_square(found, MESH_SIDE)
    mask, side = share > 0.99, len(share)
    corners = np.lib.stride_tricks.sliding_window_view(mask, (2, 2))
    if corners.sum(axis=(2, 3)).max() < 3:  # of four neighbours a triangle needs three
        least = math.ceil(3 * window[2] / side)
        raise ValueError(f"expected an object of {least} pixels across or more for a mesh, found less; say --mesh none")
    normals, albedo = (np.moveaxis(x, 0, -1).astype(np.float64) * mask[..., None] for x in surface[:2])
    depth = INTEGRATIONS[integration](normals, mask)
    gain = 1 / max(float(np.percentile(albedo[mask], 99.5)), 1e-9)
    shown = np.minimum(albedo * gain, 1) * mask[..., None]
    mesh = span_surface(Appearance(normals, np.broadcast_to(shown, (side, side, 3)), mask), depth)
    return mesh, _enlarged(np.where(mask, depth, np.nan) * (window[2] / side), window, found.mask)


def _enlarged(depth: NDArray[np.float64], window: tuple[int, int, int], mask: Mask) -> NDArray[np.float64]:
    """Depth of the small square at every pixel of the mask, bilinear; unknown pixels have that of the nearest known."""
    from scipy.ndimage import distance_transform_edt, map_coordinates

    top, left, width = window
    side = len(depth)
    nearest = distance_transform_edt(np.isnan(depth), return_distances=False, return_indices=True)
    whole = depth[tuple(nearest)]
    rows, cols = np.nonzero(mask)
    at = [(x - first + 0.5) * side / width - 0.5 for x, first in ((rows, top), (cols, left))]
    found = np.full(mask.shape, np.nan)
    found[mask] = map_coordinates(whole, at, order=1, mode="nearest")
    return found


def in_square(found: Shape, side: int) -> tuple[Surface, Floats]:
    """The surface ``[C, n, n]`` in the square around an object, n at most ``side``, and its share of pixels ``[n, n]``.

    Maps are means over the object alone, where pixels are merged.
    """
    window = square_around(found.mask)
    albedo = np.broadcast_to(found.albedo, (*found.mask.shape, 3))
    planes = [*np.moveaxis(found.normals, -1, 0), *np.moveaxis(albedo, -1, 0), found.roughness, found.specular]
    planes += [found.normal_error, found.roughness_error, found.specular_error, found.mask]
    small = gather(np.stack(planes).astype(np.float32), window, min(window[2], side))
    share = small[-1]
    maps = small[:-1] / np.maximum(share, 1e-6)
    normal = maps[:3] / np.maximum(np.linalg.norm(maps[:3], axis=0), 1e-6)
    return Surface(normal, maps[3:6], *(maps[k : k + 1] for k in range(6, 11))), share


def draw_panels(frame: SeparatedFrame, found: Shape) -> list[Sequence[Panel]]:
    """Rows of pictures: the frame and its surface; the object under other lamps."""
    surface, share = in_square(found, CELL)
    there, mask = on_object(share), found.mask
    images = np.concatenate([frame.diffuse + frame.specular, frame.specular], axis=-1)
    small = gather(np.moveaxis(images, -1, 0), square_around(mask), len(share))
    seen, mirrored = (np.broadcast_to(x, (3, *share.shape)) for x in np.split(small, 2))

    def cell(planes: NDArray[Any], gain: float | None = None) -> Pixels:
        picture = np.moveaxis(np.broadcast_to(planes, (3, *share.shape)), 0, -1)
        shown = np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8) if gain is None else toned(picture, gain)
        return _fit(_on_grey(shown, there))

    albedo_gain = 0.9 / max(float(np.percentile(surface.albedo[:, there], 99)), 1e-9)
    lamps = [np.array(lamp, np.float32) / np.float32(np.linalg.norm(lamp)) for lamp in LAMPS.values()]
    relit = np.stack([relight(surface, lamp) for lamp in lamps])
    gain = exposure_of(relit[..., there])
    roughness = np.where(surface.roughness_error < UNKNOWN, surface.roughness, 0)
    error = np.degrees(surface.normal_error) / LARGEST_DEG
    return [
        [
            Panel("Frame", "", cell(seen, exposure_of(seen[:, there]))),
            Panel("Normals", "red right, green up", cell((surface.normal + 1) / 2)),
            Panel("Albedo", "relative", cell(surface.albedo, albedo_gain)),
            Panel("Roughness", "white 1, black unknown", cell(roughness)),
            Panel("Expected error", f"white {LARGEST_DEG:g} deg", cell(error)),
        ],
        [
            *(Panel("Relit", name, cell(picture, gain)) for name, picture in zip(LAMPS, relit, strict=True)),
            Panel("Specular", "as separated", cell(mirrored, exposure_of(mirrored[:, there]))),
        ],
    ]


def _on_grey(picture: Pixels, there: Mask) -> Pixels:
    return np.where(there[..., None], picture, GREY).astype(np.uint8)


def _fit(picture: Pixels) -> Pixels:
    """The picture at `CELL` pixels, enlarged by nearest pixels where it is smaller."""
    side = len(picture)
    if side == CELL:
        return picture
    at = np.minimum((np.arange(CELL) * side) // CELL, side - 1)
    return picture[at][:, at]
