"""`polsep material`: files of photographs of one flat material in, files of its maps out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, interpolate

from polsep.io.assets.materials import MaterialFiles, material_targets, write_material
from polsep.io.raw.frames import ReadOptions, output_stem, read_frames, refuse_forgotten
from polsep.io.results.previews import Panel, Pixels, titled_sheet, toned
from polsep.io.results.separation_reader import is_separated, open_separated
from polsep.io.store.atomic import refuse_existing, refuse_inputs
from polsep.io.store.errors import InputError, input_error, refuse_repeated
from polsep.light.light_color import LightColor
from polsep.material.estimate import load_estimator
from polsep.material.svbrdf import CAMERA_HEIGHT, MAP_SIZE, Svbrdf, plane_points, relight
from polsep.pipeline import separate_capture
from polsep.separation.report import SeparatedFrame, reported_light

Floats = NDArray[np.float32]

#: Median of the separated diffuse images of training's dielectrics, 1 = white paper: assumed of unknown exposures.
USUAL_DIFFUSE = 0.25
#: The same of all light of training's metals, and least median of all light over that of diffuse light of a metal;
#: training's dielectrics: 99 % below 3.2, metals: 99 % above 6.
USUAL_METAL, MIRRORS = 0.14, 4.0
#: Smallest and largest side of maps.
MIN_SIZE, LARGEST_SIZE = 32, 1024
#: Largest level of white, the most that s0 reaches before it clips: codes of the camera lie far beyond.
LARGEST_WHITE = 2.0
#: Parts along a side of the square, and the least light of one relative to the brightest that a flat sample shows.
#: Random dielectrics: 95 % above 0.06; objects on black: 0.000, spheres that fill the square 0.02 to 0.04. Polished
#: metal has dark corners, too.
FLAT_PARTS, MIN_PART = 8, 0.05
#: Positions of the lights of the preview, and the side of its pictures in pixels.
PREVIEW_LIGHTS = ((0.0, 0.0, 2.75), (-1.2, 0.8, 1.8), (1.3, 0.9, 1.5), (1.0, -1.3, 1.2), (-1.6, -0.6, 0.9))
PREVIEW_SIDE = 256


@dataclass(frozen=True)
class MaterialOptions:
    """Options of `polsep material`.

    ``white``: s0 of white paper in the middle of each photograph, or one number for all; empty: unknown. ``size``: side
    of the maps. ``weights``: a file instead of the shipped ones. ``kept``: files that results may not replace, besides
    photographs. Raises ValueError on numbers out of range.
    """

    read: ReadOptions = field(default_factory=ReadOptions)
    method: str = "auto"
    light_color: LightColor | str = "auto"
    white: tuple[float, ...] = ()
    size: int = MAP_SIZE
    input: str = "separated"
    weights: Path | None = None
    kept: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        if not MIN_SIZE <= self.size <= LARGEST_SIZE:
            raise ValueError(f"expected a size of {MIN_SIZE} to {LARGEST_SIZE} pixels, found {self.size}")
        if not all(0 < level <= LARGEST_WHITE for level in self.white):
            found = ", ".join(f"{level:g}" for level in self.white)
            raise ValueError(f"expected levels of white above 0, at most {LARGEST_WHITE:g}, found {found}")


@dataclass(frozen=True)
class Photographs:
    """Separated views ``[V, 6, size, size]`` of one material and their source files; ``notes`` for the user.

    Views are in white light of the same mean: ``lights``, the lamp's colour of each, is divided out (`white_lobes`).
    """

    views: Tensor
    sources: tuple[str, ...]
    notes: tuple[str, ...]
    lights: tuple[tuple[float, ...], ...] = ()


def estimate_files(
    paths: Sequence[str], options: MaterialOptions, directory: Path, name: str | None = None, overwrite: bool = False
) -> tuple[list[Path], list[str]]:
    """Estimate a material from all photographs in the files and write it; return the paths and notes for the user.

    ``name``: of the results, None for that of the first file. Raises ValueError, in one line, on what cannot be read or
    written.
    """
    name = output_stem(paths[0]) if name is None else name
    refuse_existing(directory, targets := material_targets(directory, name), overwrite)
    inputs = [Path(path) for path in paths]
    refuse_repeated(inputs, "photographs under different lights")
    reports = [path.with_suffix(".json") for path in inputs if is_separated(path)]
    refuse_inputs(targets, [*inputs, *reports, *options.kept, *filter(None, [options.weights])])
    estimator = load_estimator(options.input, options.weights)
    photographs = read_photographs(paths, options)
    white = find_white(photographs.views, options.white)
    views = photographs.views / torch.tensor(white)[:, None, None, None]
    maps = estimator.estimate(views[:, :3] + views[:, 3:] if estimator.input == "unseparated" else views)
    notes = [*photographs.notes, *flatness_notes(photographs)]
    notes += _whiter_notes(photographs, white)
    if not options.white:
        notes.append("the level of white paper is not known (--white): the diffuse map's brightness is a guess")
    sidecar = {
        "sources": list(photographs.sources),
        "input": estimator.input,
        "method": options.method,
        "white": list(white),
        "light_color": [list(light) for light in photographs.lights],
        "warnings": notes,
    }
    arrays = {kind: np.ascontiguousarray(x.movedim(0, -1).numpy()) for kind, x in vars(maps).items()}
    files = MaterialFiles(arrays, draw_material(maps, views), sidecar)
    return write_material(files, directory, name, overwrite), notes


def read_photographs(paths: Sequence[str], options: MaterialOptions) -> Photographs:
    """Separate every frame of the files and resize its middle square to the maps. Raises InputError."""
    views, sources, lights, notes = [], [], [], list[str]()
    for path in paths:
        for frame, said in _separated(path, options):
            planes = [torch.from_numpy(x).movedim(-1, 0).expand(3, -1, -1) for x in white_lobes(frame)]
            view = torch.cat([_middle_square(x, options.size) for x in planes])
            if not float(view.sum()) > 0:
                raise input_error(path, "expected light in the middle of a photograph, found a black one")
            views.append(view)
            sources.append(Path(path).name)
            lights.append(reported_light(frame))
            notes += [f"{path}: {note}" for note in [*said, *_small_notes(frame, options.size)]]
    if not views:
        raise InputError("expected photographs of a material, found none")
    return Photographs(torch.stack(views), tuple(sources), tuple(notes), tuple(lights))


def _separated(path: str, options: MaterialOptions) -> Iterator[tuple[SeparatedFrame, Sequence[str]]]:
    """Every frame of a file, separated here or before, and what was said about it."""
    if is_separated(Path(path)):
        yield open_separated(Path(path), options.light_color)
        return
    for raw in read_frames(path, options.read):
        refuse_forgotten(path, raw)
        try:
            frame = separate_capture(raw.data, options.method, options.light_color)
        except (ValueError, RuntimeError) as error:
            raise input_error(path, error) from error
        yield frame, (*raw.notes, *frame.report["warnings"])


def white_lobes(frame: SeparatedFrame) -> tuple[Floats, Floats]:
    """Diffuse and specular image under white light of the same mean, as training's are: the lamp's colour over its mean
    is divided out, so that grey paper is grey and its mean s0 stays."""
    light = np.array(reported_light(frame), np.float32)
    gains = light / light.mean()
    return frame.diffuse / gains, frame.specular / gains


def _small_notes(frame: SeparatedFrame, size: int) -> Iterator[str]:
    """A line on a frame whose middle square has fewer pixels along a side than the maps, which then hold no more."""
    side = min(frame.diffuse.shape[:2])
    if side < size:
        yield f"{size} pixels or more across the middle square were expected, found {side}: maps show no finer detail"


def _whiter_notes(photographs: Photographs, white: tuple[float, ...]) -> Iterator[str]:
    """A line on each photograph whose diffuse light is that of something whiter than the white paper."""
    for source, view, level in zip(photographs.sources, photographs.views, white, strict=True):
        share = float(view[:3].mean(dim=0).median()) / level
        if share > 1:
            yield f"{source}: a sample darker than white paper was expected, found one {share:.3g} times as bright"


def flatness_notes(photographs: Photographs) -> list[str]:
    """A line for each photograph with large parts that are nearly black, as behind or on the side of an object that is
    not flat."""
    light = photographs.views.mean(dim=1, keepdim=True)
    parts = adaptive_avg_pool2d(light, FLAT_PARTS).flatten(1)
    shares = (parts.amin(dim=1) / parts.amax(dim=1)).tolist()
    return [
        f"{source}: a part of the middle square has {share:.1%} of the light of the brightest part: "
        "is the sample flat, does it fill the square, is it lit everywhere? (polished metal may be dark)"
        for source, share in zip(photographs.sources, shares, strict=True)
        if share < MIN_PART
    ]


def _middle_square(image: Tensor, size: int) -> Tensor:
    """The largest square in the middle of an image, resized; by area averages where it shrinks."""
    height, width = image.shape[-2:]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    square = image[None, :, top : top + side, left : left + side]
    if side >= size:
        return interpolate(square, (size, size), mode="area")[0]
    return interpolate(square, (size, size), mode="bilinear", align_corners=False)[0]


def find_white(views: Tensor, given: tuple[float, ...]) -> tuple[float, ...]:
    """The level of white paper for each view ``[V, 6, h, w]``: as given, or for a usual dielectric or metal.

    Raises ValueError unless there is one number, or one for each view.
    """
    count = len(views)
    if given and len(given) not in (1, count):
        raise ValueError(f"expected one level of white, or {count}, one for each photograph, found {len(given)}")
    if given:
        return given * count if len(given) == 1 else given
    levels = []
    for view in views:
        diffuse, total = (float(x.mean(dim=0).median()) for x in (view[:3], view[:3] + view[3:]))
        level = total / USUAL_METAL if total > MIRRORS * diffuse else diffuse / USUAL_DIFFUSE
        levels.append(max(level, 1e-6))
    return tuple(levels)


def draw_material(maps: Svbrdf, views: Tensor) -> Pixels:
    """A preview sheet: photograph, maps, and the material under other lights."""
    first = views[0, :3] + views[0, 3:]
    scale = max(float(maps.specular.max()), 1e-6)
    pictures = [
        Panel("Photograph", "", _shown(first)),
        Panel("Normal", "", _shown_linear(maps.normal * 0.5 + 0.5)),
        Panel("Diffuse", "", _shown(maps.diffuse)),
        Panel("Roughness", "", _shown_linear(maps.roughness.expand(3, -1, -1))),
        Panel("Specular", f"white {scale:.2g}", _shown(maps.specular / scale)),
    ]
    points, camera = plane_points(*maps.roughness.shape[-2:]), torch.tensor((0.0, 0.0, CAMERA_HEIGHT))[:, None, None]
    relit = []
    for position in PREVIEW_LIGHTS:
        image = relight(maps, points, camera, torch.tensor(position)[:, None, None])
        relit.append(Panel("Relit", "light {:g} {:g} {:g}".format(*position), _shown(image)))
    return titled_sheet([pictures, relit])


def _shown(image: Tensor) -> Pixels:
    """Linear light ``[3, h, w]`` as an sRGB picture of the preview."""
    return toned(_enlarged(image), 1.0)


def _shown_linear(image: Tensor) -> Pixels:
    """Numbers ``[3, h, w]`` from 0 to 1 as a picture without a tone curve."""
    return np.rint(np.clip(_enlarged(image), 0, 1) * 255).astype(np.uint8)


def _enlarged(image: Tensor) -> Floats:
    side = (PREVIEW_SIDE, PREVIEW_SIDE)
    return interpolate(image[None], side, mode="nearest")[0].movedim(0, -1).contiguous().numpy()
