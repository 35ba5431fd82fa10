"""The surface behind one frame under one polarized lamp: normals, albedo, roughness, specular strength.

A network sees the object as a whole, in a square around its mask, and predicts its own errors
(`geometry.shape_maps`). Its predictions for the object and its mirror image at three scales, twice as fine as it was
trained and coarser, are averaged (test-time augmentation), once the lamp is found (`ShapeEstimator.find`). It was
trained on rendered frames that were separated as users' frames are. `polarization.choose_outward` is the same
task without training.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from numbers import Real
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polsep.compute.arguments import WrongType
from polsep.compute.resizing import block_means, resize_area, resize_bilinear
from polsep.geometry.lamp import search_lamp, seen_under
from polsep.geometry.object_mask import find_object_mask
from polsep.geometry.shape_maps import (
    INPUTS,
    Seen,
    Surface,
    decode,
    encode,
    lamp_direction,
    mean_surface,
    mirror_seen,
    mirror_surface,
)
from polsep.io.store.errors import as_path
from polsep.io.store.weights import read_weights, shipped_weights
from polsep.networks.graphs import core, require_own_threads, shape_model
from polsep.networks.sizes import ResidualSize
from polsep.physics.fresnel import ETA, diffuse_dolp
from polsep.pipeline import PolsepWarning
from polsep.separation.report import SeparatedFrame, reported_light, require_known_angles

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

#: Side of the square around the object [pixels]; over the longest side of the mask; sides of the blocks of pixels whose
#: means the network sees (training shows it squares of ``SIDE / 2``).
SIDE, WIDER, SCALES = 384, 1.1, (1, 2, 3)
#: Expected error of ln(roughness), and of ln(strength), from which on they count as unknown.
UNKNOWN = 0.5
#: Refractive indices of dielectrics, from water to diamond.
INDICES = (1.3, 2.5)
#: Share of the frame's border on the object from which on the mask is probably wrong; expected error of normals
#: [degrees], in the median, from which on they are called uncertain.
FILLED, UNCERTAIN_DEG = 0.2, 15.0
#: A note on a colour frame without the lamp's colour, as `read_separated` gives.
UNKNOWN_LIGHT = (
    'the lamp\'s colour is not known: taken for white, or set frame.report["light_color"] = [r, g, b] before'
)


@dataclass(frozen=True, eq=False)
class Shape:
    """The surface of a frame, ``[h, w]`` as its images; 0 outside the ``mask``.

    ``normals [h, w, 3]``: unit vectors, x right, y up, z to the camera. ``normal_error``: their expected deviation
    along each of two axes [rad]. ``albedo [h, w, C]``: relative, 1 where a surface that faces the lamp is as bright as
    the object in the mean. ``roughness``: GGX sqrt(alpha); ``specular``: strength of reflections, 1 = a dielectric of
    index 1.5; ``roughness_error``, ``specular_error``: expected deviations of their logarithms, unknown from `UNKNOWN`
    on. ``light [3]``: unit vector toward the lamp, given or found (`lamp.search_lamp`).
    ``mask_given``: the mask was given, not found.
    """

    normals: Floats
    normal_error: Floats
    albedo: Floats
    roughness: Floats
    roughness_error: Floats
    specular: Floats
    specular_error: Floats
    mask: Mask
    light: tuple[float, float, float]
    mask_given: bool = False

    def __repr__(self) -> str:
        share, error = float(self.mask.mean()), float(np.degrees(np.median(self.normal_error[self.mask])))
        size = list(self.mask.shape)
        return f"Shape(normals {size}, {share:.0%} on the object, expected error {error:.1f} degrees in the median)"

    def warnings(self) -> list[str]:
        """Lines on what the network does not know, or what it was not made for."""
        inside = self.mask
        unknown = float((self.roughness_error[inside] >= UNKNOWN).mean())
        error = float(np.degrees(np.median(self.normal_error[inside])))
        border = float(np.concatenate([inside[0], inside[-1], inside[:, 0], inside[:, -1]]).mean())
        notes = []
        if border > FILLED and not self.mask_given:
            notes.append(
                f"one object before a dark ground was expected, found light on {border:.0%} of the frame's border: say "
                "where the object is (mask)"
            )
        if unknown > 0.5:
            notes.append(f"the roughness of {unknown:.0%} of the object is unknown: no highlight shows it")
        if error > UNCERTAIN_DEG:
            notes.append(f"normals are uncertain: {error:.0f} degrees are expected in the median")
        return notes


class ShapeEstimator:
    """The network of a file of weights, for one input. State: its layers compiled, for one frame at a time."""

    def __init__(self, path: Path) -> None:
        arrays, metadata = read_weights(path)
        if metadata["method"] != "shape":
            raise ValueError(f"expected weights of a network for shape in {path}, found {metadata['method']!r}")
        size = json.loads(metadata["size"])
        self.size = ResidualSize(size["width"], tuple(size["blocks"]), size["entry"])
        self.input = "separated" if metadata["input"] == "perfect" else metadata["input"]
        self._layers = {}
        for side in (SIDE // block for block in SCALES):
            model = shape_model(arrays, self.size, (INPUTS[self.input], side, side))
            self._layers[side] = core().compile_model(model, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})

    def find(self, seen: Seen) -> Surface:
        """The surface in images ``[C, SIDE, SIDE]``: the mean of what they and their means over `SCALES` say.

        Small blocks show the detail, large ones the whole; for each, predictions for the object and its mirror image
        are averaged. Where the lamp is not given, it is found first (`find_lamp`).
        """
        seen = seen if np.any(seen.light) else seen_under(seen, self.find_lamp(seen))
        found = (self._find_mirrored(_means(seen, block)) for block in SCALES)
        return mean_surface(*(Surface(*(resize_bilinear(x, (SIDE, SIDE)) for x in surface)) for surface in found))

    def find_lamp(self, seen: Seen) -> tuple[float, float, float]:
        """The unit vector toward the lamp, which is not given (`lamp.search_lamp`).

        By the coarsest of `SCALES` in which whole blocks are on the object.
        """
        coarser = (_means(seen, block) for block in reversed(SCALES))
        return search_lamp(self._find_mirrored, next((means for means in coarser if means.mask.any()), seen))

    def _find_mirrored(self, seen: Seen) -> Surface:
        return mean_surface(self.predict(seen), mirror_surface(self.predict(mirror_seen(seen))))

    def predict(self, seen: Seen) -> Surface:
        """The surface by one run of the network on images of ``SIDE`` over one of `SCALES`."""
        require_own_threads()
        maps = np.ascontiguousarray(encode(seen, self.input), np.float32)[None]
        outputs = self._layers[maps.shape[-1]].create_infer_request().infer([maps])[0][0]
        return decode(outputs, seen.image, seen.mask)


def _means(seen: Seen, block: int) -> Seen:
    """Means over blocks of pixels; the mask is where all are of the object."""
    means = Seen(*(None if x is None else np.asarray(block_means(x, block), np.float32) for x in seen))
    return means._replace(mask=(means.mask > 0.99).astype(np.float32))


def load_estimator(path: Path | None = None) -> ShapeEstimator:
    """The shipped network, or the one in a file of `polsep train shape`, also when that changes. Raises ValueError."""
    path = shipped_weights("shape/separated") if path is None else path.resolve()
    return _load(path, path.stat().st_mtime_ns if path.is_file() else 0)


@lru_cache(maxsize=2)
def _load(path: Path, stamp: int) -> ShapeEstimator:
    return ShapeEstimator(path)


def shape(
    frame: SeparatedFrame,
    mask: Mask | None = None,
    light: Sequence[float] | None = None,
    weights: str | Path | None = None,
    index: float = ETA,
) -> Shape:
    """Find the surface of the object in a frame that `polsep.separate` separated; issue its `warnings`.

    ``mask [h, w]``: where the object is; None: where light falls (`mask_of`). ``light``: x, y, z toward the lamp,
    x right, y up, z to the camera; None: not known, as beside the camera it need not be. ``index``: refractive index of
    the object, in `INDICES`. Raises ValueError on masks of another size or without pixels, on frames without
    polarization, and on arguments of wrong types.
    """
    if not isinstance(frame, SeparatedFrame):
        raise WrongType(f"expected a frame that polsep.separate separated, found {type(frame).__name__}")
    if not isinstance(index, Real):
        raise WrongType(f"expected a refractive index that is a number, found {index!r:.40}")
    found = find_shape(frame, mask, light, None if weights is None else as_path(weights), float(index))
    remarks = () if "light_color" in frame.report or frame.diffuse.shape[-1] == 1 else (UNKNOWN_LIGHT,)
    for note in (*remarks, *found.warnings()):
        warnings.warn(note, PolsepWarning, stacklevel=2)
    return found


def find_shape(
    frame: SeparatedFrame,
    mask: Mask | None,
    light: Sequence[float] | None,
    weights: Path | None = None,
    index: float = ETA,
) -> Shape:
    """`shape` without warnings."""
    if not INDICES[0] <= index <= INDICES[1]:
        raise ValueError(f"expected a refractive index from {INDICES[0]} to {INDICES[1]}, found {index:g}")
    chosen = mask_of(frame) if mask is None else _as_mask(mask)
    if chosen.shape != frame.dolp.shape or not chosen.any():
        raise ValueError(
            f"expected a mask of {list(frame.dolp.shape)} that holds pixels, found {list(chosen.shape)}, "
            f"{int(chosen.sum())} set"
        )
    if not frame.dolp[chosen].any():
        raise ValueError("expected a frame with its polarization, found DoLP 0 everywhere")
    require_known_angles(frame)
    given = None if light is None else _as_direction(light)
    window = square_around(chosen)
    small = gather(images_of(frame, chosen), window, SIDE)
    small[4:6] = polarized_as_usual(small[4:6], small[:3].mean(axis=0), small[3:4] * on_object(small[7:8]), index)
    on = on_object(small[7:8]).astype(np.float32)
    seen = Seen(small[:3], small[3:4], small[4:6], small[6:7], on, np.zeros((3, SIDE, SIDE), np.float32))
    estimator = load_estimator(weights)
    if estimator.input != "separated":
        raise ValueError(f"expected weights of a network that sees separated images, found one for {estimator.input!r}")
    lamp = given or estimator.find_lamp(seen)
    found = estimator.find(seen_under(seen, lamp))
    planes = np.concatenate([np.asarray(x, np.float32) for x in found])
    wide = spread(planes, window, chosen.shape)
    normals = wide[:3] / np.maximum(np.linalg.norm(wide[:3], axis=0), 1e-6)
    maps = {
        "normals": np.moveaxis(normals, 0, -1),
        "albedo": np.moveaxis(wide[3:6], 0, -1)[..., : frame.diffuse.shape[-1]],
        "roughness": wide[6],
        "specular": wide[7],
        "normal_error": wide[8],
        "roughness_error": wide[9],
        "specular_error": wide[10],
    }
    inside = {name: _outside_zero(x, chosen) for name, x in maps.items()}
    return Shape(**inside, mask=chosen, light=lamp, mask_given=mask is not None)


def polarized_as_usual(polarized: Floats, diffuse: Floats, specular: Floats, index: float) -> Floats:
    """The polarized light ``[2, h, w]`` that the same surface of index 1.5, for which the network is made, would have.

    ``diffuse [h, w]`` and ``specular [1, h, w]`` light. What specular light leaves of the polarization (`encode`) is
    diffuse light of one zenith angle: its DoLP there is exchanged (`fresnel.diffuse_dolp`), its AoLP stays.
    """
    if index == ETA:
        return polarized
    lamp, _ = lamp_direction(polarized, specular)
    left = polarized - specular * lamp
    strength = np.hypot(*left) / np.maximum(diffuse, 1e-6)
    cosines = np.cos(np.linspace(0, np.radians(89.0), 500))
    usual = np.interp(strength, diffuse_dolp(cosines, index), diffuse_dolp(cosines))
    found: Floats = polarized + left * (usual / np.maximum(strength, 1e-6) - 1)
    return found


def _as_mask(mask: object) -> Mask:
    """A mask that was given, of bools or of numbers. Raises ValueError."""
    try:
        numbers = np.asarray(mask, np.float32)
    except (TypeError, ValueError):
        raise WrongType(f"expected a mask as an array of bools, found {mask!r:.40}") from None
    if np.isnan(numbers).any():
        raise ValueError("expected a mask of bools, found NaN")
    return np.asarray(numbers != 0)


def _as_direction(light: Sequence[float]) -> tuple[float, float, float]:
    """A direction that was given, as a unit vector. Raises ValueError."""
    try:
        numbers = [float(x) for x in light]
    except (TypeError, ValueError):
        numbers = []
    length = float(np.linalg.norm(numbers)) if len(numbers) == 3 else 0.0
    if not 1e-6 < length < float("inf") or numbers[2] <= 0:
        raise ValueError(f"expected a lamp's direction x, y, z in front of the object (z > 0), found {light!r:.60}")
    x, y, z = (number / length for number in numbers)
    return (x, y, z)


def _outside_zero(image: Floats, mask: Mask) -> Floats:
    return np.where(mask if image.ndim == 2 else mask[..., None], image, 0).astype(np.float32)


def mask_of(frame: SeparatedFrame) -> Mask:
    """The mask of an object before a dark ground (`find_object_mask`). Raises ValueError on a black frame."""
    diffuse = frame.diffuse.mean(axis=-1)
    return find_object_mask(diffuse + frame.specular.mean(axis=-1), diffuse)


def images_of(frame: SeparatedFrame, mask: Mask) -> Floats:
    """Diffuse (3), specular (1), s1, s2 of all colours, expected error of the diffuse image, mask: ``[8, h, w]``.

    In white light: the lamp's colour that the report names is divided out.
    """
    gain = np.array(reported_light(frame), np.float32)
    diffuse, specular = frame.diffuse / gain, (frame.specular / gain).mean(axis=-1)
    strength = frame.dolp * (diffuse.mean(axis=-1) + specular)
    error = np.zeros_like(strength) if frame.error is None else frame.error[..., 0] / gain.mean()
    planes = [*np.moveaxis(np.broadcast_to(diffuse, (*mask.shape, 3)), -1, 0), specular]
    planes += [strength * np.cos(2 * frame.aolp), strength * np.sin(2 * frame.aolp), error, mask]
    return np.stack(planes).astype(np.float32)


def square_around(mask: Mask) -> tuple[int, int, int]:
    """First row, first column and side of the square, `WIDER` than the mask's longest side, around its middle."""
    rows, cols = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    side = max(8, round(WIDER * (max(rows[-1] - rows[0], cols[-1] - cols[0]) + 1)))
    top, left = ((int(x[0]) + int(x[-1]) + 1 - side) // 2 for x in (rows, cols))
    return top, left, side


def gather(planes: Floats, window: tuple[int, int, int], side: int) -> Floats:
    """The planes ``[K, h, w]`` of a window at ``side`` pixels, 0 beyond the image; area means where it shrinks."""
    top, left, width = window
    height, length = planes.shape[-2:]
    cut = np.zeros((len(planes), width, width), np.float32)
    rows, cols = slice(max(top, 0), min(top + width, height)), slice(max(left, 0), min(left + width, length))
    cut[:, rows.start - top : rows.stop - top, cols.start - left : cols.stop - left] = planes[:, rows, cols]
    resize = resize_area if width >= side else resize_bilinear
    found: Floats = np.asarray(resize(cut, (side, side)), np.float32)
    return found


def on_object(share: Floats) -> Mask:
    """Pixels that count as the object's, by its share of each: more than half, or of thin objects half the largest."""
    return share > min(0.5, float(share.max()) / 2)


def spread(planes: Floats, window: tuple[int, int, int], shape: tuple[int, ...]) -> Floats:
    """The twin of `gather`: planes ``[K, side, side]`` at a window of images of a ``shape``, 0 elsewhere."""
    top, left, width = window
    large = np.asarray(resize_bilinear(planes, (width, width)), np.float32)
    found = np.zeros((len(planes), *shape), np.float32)
    rows, cols = slice(max(top, 0), min(top + width, shape[0])), slice(max(left, 0), min(left + width, shape[1]))
    found[:, rows, cols] = large[:, rows.start - top : rows.stop - top, cols.start - left : cols.stop - left]
    return found
