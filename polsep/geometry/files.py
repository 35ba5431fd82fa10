"""Files of frames under several lights in, normals, albedo, depth and a mesh out.

Inputs are separated EXR files of `polsep separate`, raw frames, which are separated first, or photographs of an
ordinary camera, which have no polarization.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.geometry.frames import open_frame
from polsep.geometry.integration import integrate_bilateral, integrate_smooth
from polsep.geometry.object_mask import find_object_mask
from polsep.geometry.photometric import Appearance, fit_robust, unexplained_share
from polsep.geometry.polarization import Polarized, find_diffuse_polarization, normals_from_polarization
from polsep.geometry.surface import Surface, draw_views, relight, span_surface
from polsep.io.assets.maps import read_map
from polsep.io.assets.shapes import ShapeFiles, encode_glb, encode_ply
from polsep.io.raw.frames import ReadOptions
from polsep.io.raw.videos import load_library
from polsep.io.results.films import WATCHABLE, encode_film
from polsep.io.results.previews import Panel, exposure_of, titled_sheet, toned
from polsep.io.results.separation_reader import is_separated
from polsep.io.store.errors import InputError, input_error, naming, refuse_repeated
from polsep.separation.report import SeparatedFrame, reported_light, require_known_angles

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Pixels = NDArray[np.uint8]

#: Side of the pictures of the preview, and the views of its meshes: azimuth and elevation [degrees].
CELL = 360
VIEWS = ((-50.0, 5.0), (-20.0, 10.0), (20.0, 10.0), (50.0, 5.0))
#: A turntable: its swing to both sides and up [degrees], number of pictures, and pictures per second.
SWING, TURN_PICTURES, TURN_RATE = (60.0, 12.0), 96, 24.0
#: Integration of normals to depth: with jumps, or as one smooth surface.
INTEGRATIONS = {"bilateral": integrate_bilateral, "smooth": integrate_smooth}
#: Largest `unexplained_share` of photographs without a remark: of statues rendered with weak highlights it is at most
#: 0.17, with strong ones 0.23 to 0.32, of two objects under a flash 0.31 and 0.51 (docs/experiments.md).
MOST_UNEXPLAINED = 0.2
#: Largest distance of an object's far side over that of its near side without a remark: what is nearer fills the view.
MOST_FARTHER = 10.0
#: Colour around the object in previews.
GREY = 40


@dataclass(frozen=True)
class Views:
    """Linear ``images [L, H, W, C]`` under different lights, their polarization if known, ``notes`` for the user."""

    images: Floats
    polarized: Polarized | None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Source:
    """Options of reading: ``kind`` is "photographs" or "frames"; ``options`` and ``method`` are for raw frames."""

    kind: str
    options: ReadOptions
    method: str


@dataclass(frozen=True)
class ShapeOptions:
    """Format of the ``mesh``, vertical field of view [degrees] (None: orthographic), one of `INTEGRATIONS`, and whether
    to draw a ``turntable``. Raises ValueError."""

    mesh: str = "glb"
    fov_deg: float | None = None
    integration: str = "bilateral"
    turntable: bool = False

    def __post_init__(self) -> None:
        if self.integration not in INTEGRATIONS:
            raise ValueError(f"expected an integration of {' or '.join(INTEGRATIONS)}, found {self.integration!r}")
        if self.turntable:
            load_library()  # reports at once that it is missing


def read_views(paths: Sequence[Path], source: Source) -> Views:
    """Read files, and separate raw frames. Raises InputError, also on images of different shapes."""
    refuse_repeated(paths, "pictures under different lights")
    if source.kind == "photographs":
        images = [read_map(path, "texture") for path in paths]
        _require_one_shape(paths, images)
        return Views(np.stack(images).astype(np.float64), None)
    frames, notes = [], list[str]()
    for path in paths:
        frame, said = _read_frame(path, source)
        frames.append(frame)
        notes += [f"{path}: {note}" for note in said]
    _require_one_shape(paths, [frame.diffuse for frame in frames])
    return replace(views_of(frames), notes=tuple(notes))


def views_of(frames: Sequence[SeparatedFrame]) -> Views:
    """Separated frames of one size with their polarization.

    In white light, as their DoLP is: the lamp's colour by each report, over its mean, is divided out.
    """
    lobes = [[lobe / _gains_of(frame) for lobe in (frame.diffuse, frame.specular)] for frame in frames]
    diffuse, specular = (np.stack(images) for images in zip(*lobes, strict=True))
    names = ("dolp", "aolp", "valid")
    dolp, aolp, valid = (np.stack([getattr(frame, name) for frame in frames]).astype(np.float64) for name in names)
    grey, highlight = diffuse.mean(axis=-1), specular.mean(axis=-1)
    strength = dolp * (grey + highlight)
    return Views(diffuse, Polarized(grey, highlight, strength * np.cos(2 * aolp), strength * np.sin(2 * aolp), valid))


def _gains_of(frame: SeparatedFrame) -> Floats:
    """The lamp's colour by the report over its mean; 1 where it says none."""
    light = np.array(reported_light(frame), np.float64)
    gains: Floats = light / light.mean()
    return gains


def _read_frame(path: Path, source: Source) -> tuple[SeparatedFrame, list[str]]:
    """One frame, separated, and notes; its report's warnings were given when it was separated."""
    frame, notes = open_frame(path, source.options, source.method)
    if not is_separated(path):
        return frame, notes
    if not frame.dolp.any():
        raise input_error(path, "expected a file of polsep separate with its polarization, found none in it")
    with naming(path):
        require_known_angles(frame)
    return frame, [note for note in notes if note not in frame.report.get("warnings", ())]


def _require_one_shape(paths: Sequence[Path], images: Sequence[NDArray[Any]]) -> None:
    for path, image in zip(paths, images, strict=True):
        if image.shape != images[0].shape:
            raise input_error(path, f"expected {list(images[0].shape)} as {paths[0]} has, found {list(image.shape)}")
        if not np.isfinite(image).all():
            raise input_error(path, "expected finite light, found NaN or infinite samples")
    for k, path in enumerate(paths):
        same = [other for other, image in zip(paths, images[:k], strict=False) if np.array_equal(image, images[k])]
        if same:
            raise input_error(path, f"expected pictures under different lights, found that of {same[0]} again")


def shrink(views: Views, mask: Mask, longest: int) -> tuple[Views, Mask]:
    """Means over square blocks, so that no side exceeds ``longest``; the mask keeps blocks entirely on the object."""
    factor = -(-max(mask.shape) // longest)
    if factor == 1:
        return views, mask

    def mean(images: Floats) -> Floats:
        rows, cols = (side // factor for side in images.shape[1:3])
        cut = images[:, : rows * factor, : cols * factor]
        blocks: Floats = cut.reshape(len(images), rows, factor, cols, factor, *images.shape[3:]).mean(axis=(2, 4))
        return blocks

    small = mean(mask[None].astype(np.float64))[0] == 1
    if not small.any():
        raise InputError(f"expected an object that is wider than {factor} pixels, found none")
    states = None if views.polarized is None else Polarized(*(mean(image) for image in vars(views.polarized).values()))
    return replace(views, images=mean(views.images), polarized=states), small


def find_object(views: Views) -> Mask:
    """Estimate the mask of an object before a dark background, from where light falls. Raises InputError."""
    brightest = views.images.mean(axis=-1).max(axis=0).astype(np.float32)
    try:
        return find_object_mask(brightest, brightest)
    except ValueError:
        raise InputError("expected light on an object, found black images") from None


def find_shape(views: Views, directions: Floats, mask: Mask, options: ShapeOptions) -> ShapeFiles:
    """Normals, albedo, depth, mesh and preview. Raises ValueError."""
    cue, level = None, 1.0
    if views.polarized is not None:
        cue = normals_from_polarization(find_diffuse_polarization(views.polarized, mask))
    else:  # photographs of a unit of their own: the brightest light on the object stands for white
        level = max(float(np.percentile(views.images[:, mask], 99.5)), 1e-30)
    found = fit_robust(views.images / level, directions, mask, cue)
    notes = views.notes
    if cue is None and options.integration == "bilateral":
        notes += _notes_on_photographs(unexplained_share(views.images / level, directions, found))
    found = replace(found, albedo=found.albedo * level)
    intrinsics = None if options.fov_deg is None else intrinsics_of(options.fov_deg, mask.shape)
    depth = INTEGRATIONS[options.integration](found.normals, mask, intrinsics)
    if intrinsics is not None:
        notes += _notes_on_distances(depth[mask])
    gain = 1 / max(float(np.percentile(found.albedo[mask], 99.5)), 1e-30)
    shown = Appearance(found.normals, np.minimum(found.albedo * gain, 1), mask)
    surface = span_surface(shown, depth, intrinsics)
    mesh = encode_mesh(surface, options.mesh)
    sidecar = {
        "lights": directions.round(6).tolist(),
        "polarization": cue is not None,
        "field_of_view_deg": options.fov_deg,
        "integration": options.integration,
        "triangles": len(surface.faces),
        "albedo_of_mesh": f"albedo x {gain:.6g}, limited to 1",
        "warnings": list(notes),
    }
    sheet, film = draw_sheet(views, shown, surface), None
    if options.turntable:
        film = film_turntable(surface)
        sidecar |= {
            "turntable": f"seen from {SWING[0]:g} degrees left to {SWING[0]:g} right, the light beside the camera"
        }
    return ShapeFiles(found.normals, found.albedo, depth, mask, mesh, sheet, film, sidecar)


def _notes_on_photographs(unexplained: float) -> tuple[str, ...]:
    """A note on photographs whose normals are too poor for a depth with jumps, or none."""
    if unexplained <= MOST_UNEXPLAINED:
        return ()
    seen = f"light of matte surfaces was expected, found {unexplained:.0%} of it that no normal explains"
    return (f"{seen} (highlights, clipped or uneven light): the mesh may be torn; --integration smooth keeps it whole",)


def _notes_on_distances(depth: Floats) -> tuple[str, ...]:
    """A note on distances from a pinhole that no object in its view has, or none."""
    near, far = np.percentile(depth, (1, 99))
    if far <= MOST_FARTHER * near:
        return ()
    times = f"{far / max(near, 1e-300):.3g}"
    return (
        f"an object was expected, found its far side {times} times as far as its near one: are lights and fov right?",
    )


def encode_mesh(surface: Surface, name: str, roughness: float = 1.0) -> bytes:
    """The mesh as a file, "glb" or "ply", which has no ``roughness``."""
    arrays = (surface.vertices, surface.normals, surface.colors, surface.faces)
    return encode_ply(*arrays) if name == "ply" else encode_glb(*arrays, roughness)


def intrinsics_of(fov_deg: float, size: tuple[int, ...]) -> Floats:
    """The centred camera matrix of a vertical field of view. Raises ValueError unless it is in (0, 120] degrees."""
    if not 0 < fov_deg <= 120:
        raise ValueError(f"expected a field of view in (0, 120] degrees, found {fov_deg:g}")
    focal = size[0] / 2 / math.tan(math.radians(fov_deg) / 2)
    return np.array([[focal, 0, (size[1] - 1) / 2], [0, focal, (size[0] - 1) / 2], [0, 0, 1]])


def draw_sheet(views: Views, shown: Appearance, surface: Surface) -> Pixels:
    """Two rows of pictures: brightest frame, normals, albedo, another light; then the mesh from four sides."""
    mask = shown.mask
    front = views.images[int(views.images.sum(axis=(1, 2, 3)).argmax())]
    relit = relight(shown)
    flat = [
        Panel("Brightest frame", "", toned(front, exposure_of(front[mask]))),
        Panel("Normals", "red right, green up", np.rint(255 * (shown.normals + 1) / 2).astype(np.uint8)),
        Panel("Albedo", "brightest = white", toned(shown.albedo, 0.9)),
        Panel("Another light", "from above left", toned(relit, exposure_of(relit[mask]))),
    ]
    return titled_sheet(
        [[panel._replace(pixels=_cell(panel.pixels, mask)) for panel in flat], draw_mesh(surface, CELL)]
    )


def draw_mesh(surface: Surface, size: int) -> list[Panel]:
    """Pictures of a mesh from `VIEWS`, each ``size`` x ``size`` on grey, of one exposure."""
    meshes = np.stack(list(draw_views(surface, size, VIEWS)))
    gain = _exposure_of_mesh(meshes)
    sides = [f"{abs(azimuth):g} deg {'left' if azimuth < 0 else 'right'}" for azimuth, _ in VIEWS]
    return [Panel("Mesh", side, _on_grey(picture, gain)) for side, picture in zip(sides, meshes, strict=True)]


def film_turntable(surface: Surface) -> bytes:
    """The film of `draw_turntable`, to watch. Raises ValueError without the extra ``video``."""
    return encode_film(draw_turntable(surface), WATCHABLE, TURN_RATE)


def draw_turntable(surface: Surface) -> Iterator[Pixels]:
    """`TURN_PICTURES` pictures of a mesh that swings to both sides and back, so that a player can loop.

    Its back is not known, so it does not turn around.
    """
    turns = 2 * np.pi * np.arange(TURN_PICTURES) / TURN_PICTURES
    places = [(SWING[0] * math.sin(turn), SWING[1] * math.cos(turn)) for turn in turns]
    gain = None
    for picture in draw_views(surface, CELL, places):
        gain = gain or _exposure_of_mesh(picture)
        yield _on_grey(picture, gain)


def _exposure_of_mesh(pictures: Floats) -> float:
    """The gain of pictures of a mesh by their pixels that show it; 1 where none does, as of a sliver."""
    shown = pictures[pictures.sum(axis=-1) > 0]
    return exposure_of(shown) if shown.size else 1.0


def _on_grey(picture: Floats, gain: float) -> Pixels:
    """A picture of `draw_views` with a ``gain``, on grey."""
    there = picture.sum(axis=-1, keepdims=True) > 0
    return np.where(there, toned(picture, gain), GREY).astype(np.uint8)


def _cell(picture: Pixels, mask: Mask) -> Pixels:
    """A picture cropped to its object, resized to `CELL` x `CELL` nearest pixels, on grey."""
    rows, cols = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    cut = np.where(mask[..., None], picture, GREY)[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
    scale = (CELL - 20) / max(cut.shape[:2])
    height, width = (max(1, round(side * scale)) for side in cut.shape[:2])
    at = [
        np.minimum(((np.arange(n) + 0.5) / scale).astype(int), side - 1)
        for n, side in zip((height, width), cut.shape[:2], strict=True)
    ]
    cell = np.full((CELL, CELL, 3), GREY, np.uint8)
    top, left = (CELL - height) // 2, (CELL - width) // 2
    cell[top : top + height, left : left + width] = cut[at[0]][:, at[1]]
    return cell
