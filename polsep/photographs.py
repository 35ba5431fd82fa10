"""Photographs of an ordinary camera through a filter, as co-sited `Measurements`: read, aligned, exposed alike.

Under one linearly polarized lamp the specular light is polarized along one direction. A filter before the lens along it
(parallel) passes half the diffuse light and the specular light, one across it (crossed) half the diffuse light alone:

    m_parallel = diffuse / 2 + specular,   m_crossed = diffuse / 2

which is m = (s0 + s1 cos 2t + s2 sin 2t) / 2 at t = 0 and 90 degrees from the specular light's direction. So two
photographs give s0 and s1 there; s2, which only polarized diffuse light and oblique mirrors have, stays unknown. Three
or more at angles that are known give all of s0, s1 and s2 by least squares, five or more at angles that are not, too
(`physics.turned_analyser`).

Steps: read (`io.raw.photographs`), decode sRGB where it is said, align with the first photograph
(`compute.registration`) and crop to what all show, divide by the exposures, find the angles, correct the extinction.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from polsep.compute.registration import MOTIONS, Motion, find_motion, move_back, residual_shift
from polsep.compute.resizing import block_means
from polsep.io.raw.frames import Frame, ReadOptions, output_stem, refuse_forgotten
from polsep.io.raw.photographs import Photographs, read_photographs
from polsep.io.store.errors import naming
from polsep.physics.srgb import linear_from_srgb
from polsep.physics.stokes import Measurements, contradictions, correct_extinction, stokes_inverse
from polsep.physics.turned_analyser import find_angles, find_pair_exposure, gram
from polsep.sensor.levels import as_measurements
from polsep.separation.report import PICTURE

#: A pair of one colour pixel, to ask methods whether they take pairs.
ANY_PAIR = Measurements(np.zeros((2, 3, 1, 1), np.float32), (0.0, math.pi / 2))
ENCODINGS = ("linear", "srgb")
ALIGNMENTS = ("none", *MOTIONS)
#: In place of angles: two photographs through a parallel and a crossed filter. No degrees say it, for these count from
#: the specular light's direction, which nobody measures.
PAIR: Final = "pair"
#: Their angles in degrees from there.
PAIR_DEG = (0.0, 90.0)
Angles = tuple[float, ...] | Literal["pair"] | None
#: Where angles count from, by the angles that were stated: in all other cases from the picture's right.
_FRAMES: dict[Angles, str] = {None: "the first photograph", PAIR: "the specular light's direction"}

#: Largest logarithm of the ratio of a pair's exposures that counts as none: finding it may err by as much.
EQUAL = 0.12
#: Brightness of the parallel over the crossed photograph below which they may be swapped. So they may where the light
#: that it lacks is that many times the light that it has more, and is strongest: of 28 rendered pairs in none.
DARKER, LACKS = 0.97, 2.0
#: Largest contradiction of four and more photographs, relative to their brightness, of which nobody is warned.
MAX_CONTRADICTION = 0.03
#: Largest noise of Stokes images relative to that of as many angles, evenly spaced, of which nobody is warned: a third
#: angle 8 degrees beside another has it.
MOST_NOISE = 4.0
#: Largest error of angles that count as found [rad]; motion of a corner in pixels below which a photograph stays as it
#: is; motion left after alignment of which to warn; and least share of the picture that all photographs show.
MAX_ANGLE_ERROR, STILL, MAX_LEFT, LEAST_SHARED = math.radians(2), 0.1, 0.5, 0.5
#: Clipped light is marked within this many pixels in a photograph that was moved: the reach of cubic interpolation.
REACH = 2
#: Side of the blocks from whose means angles and exposures are found, in pixels.
BLOCK = 8


@dataclass(frozen=True)
class PhotoOptions:
    """Facts of photographs that files do not contain.

    ``angles_deg``: of the filter in each photograph [degrees], in their order; None: unknown. `PAIR` is a parallel and
    a crossed photograph. ``exposures``: relative ones, stated; None: what camera raw says, else equal, of pairs found.
    ``extinction``: of filters, parallel over crossed light of a mirror. ``align``: one of `ALIGNMENTS`. ``encoding``:
    one of `ENCODINGS`. ``full``: camera raw at full resolution. Raises ValueError on anything else.
    """

    angles_deg: Angles = None
    exposures: tuple[float, ...] | None = None
    extinction: float = math.inf
    align: str = "rigid"
    encoding: str = "linear"
    full: bool = False

    def __post_init__(self) -> None:
        if self.align not in ALIGNMENTS:
            raise ValueError(f"expected an alignment of {', '.join(ALIGNMENTS)}, found {self.align!r}")
        if self.encoding not in ENCODINGS:
            raise ValueError(f"expected an encoding of {', '.join(ENCODINGS)}, found {self.encoding!r}")
        if not self.extinction > 1:
            raise ValueError(f"expected an extinction ratio above 1, found {self.extinction:g}")
        if self.exposures is not None and not all(1e-3 < e < 1e3 for e in self.exposures):
            raise ValueError(f"expected positive exposures like 1,1.5, found {self.exposures}")
        if isinstance(self.angles_deg, str):
            if self.angles_deg != PAIR:
                raise ValueError(f"expected angles in degrees, None or {PAIR!r}, found {self.angles_deg!r:.40}")
        elif self.angles_deg is not None:
            try:
                stokes_inverse([math.radians(angle) for angle in self.angles_deg])
            except ValueError:
                found = ", ".join(f"{angle:g}" for angle in self.angles_deg)
                raise ValueError(
                    f"expected three or more angles that differ modulo 180 degrees, found {found}: of two photographs "
                    "say --parallel and --crossed"
                ) from None

    def known_deg(self) -> tuple[float, ...] | None:
        """The angle of each photograph [degrees]; None where they are to be found."""
        return PAIR_DEG if isinstance(self.angles_deg, str) else self.angles_deg


def read_measurements(
    paths: Sequence[str], options: PhotoOptions, read: ReadOptions | None = None
) -> tuple[Frame, dict[str, Any]]:
    """The `Measurements` of photographs as a frame with the first one's name, and what its report says of them.

    ``read``: black and white level count. Raises ValueError, in one line, on photographs that can't be read, aligned or
    compared, and where angles are to be found that the pictures do not show.
    """
    read = ReadOptions() if read is None else read
    photos = read_photographs([Path(path) for path in paths], options.encoding == "srgb", options.full)
    number = len(photos.array)
    for name, given in (("angles", options.known_deg()), ("exposures", options.exposures)):
        if given is not None and len(given) != number:
            raise ValueError(f"expected as many {name} as photographs ({number}), found {len(given)}")
    with naming(paths[0]):
        images, notes = _to_light(photos, options, read)
    refuse_forgotten(paths[0], Frame("", images, notes))
    images, motions, left = _align(images, photos.names, options.align)
    exposures, source = _exposures(images, photos, options)
    images = _divide(images, exposures)
    angles, error = _angles(images, options)
    data = correct_extinction(replace(images, angles=angles), options.extinction)
    means = data.data.mean(axis=(1, 2, 3))
    facts: dict[str, Any] = {
        "files": list(photos.names),
        "brightness": [round(float(mean), 5) for mean in means],
        "angles_deg": [round(math.degrees(t), 3) for t in angles],
        "angles": "found, up to a common roll and mirror" if options.angles_deg is None else "stated",
        "frame": _FRAMES.get(options.angles_deg, PICTURE),
        "exposures": [round(e, 5) for e in exposures],
        "exposures_source": source,
        "extinction": None if math.isinf(options.extinction) else options.extinction,
        "moved_pixels": [round(motion.shift, 3) for motion in motions],
        "left_pixels": left,
    }
    if error is not None:
        facts["angle_error_deg"] = round(math.degrees(error), 3)
    if number > 3:
        seen = _samples(data)
        missed = contradictions(Measurements(seen[:, None, None], angles))
        facts["contradiction"] = round(float(np.sqrt((missed**2).mean()) / seen.mean()), 5)
    remarks = tuple(_remarks(facts, options.angles_deg == PAIR and _may_be_swapped(data), options))
    frame = Frame(output_stem(paths[0]), data, (*photos.notes, *notes, *remarks))
    return replace(frame, exposure=photos.exposure, captured=photos.captured), facts


def _to_light(photos: Photographs, options: PhotoOptions, read: ReadOptions) -> tuple[Measurements, tuple[str, ...]]:
    """Codes as linear light, black 0 and white 1, with angles that are filled in later."""
    array, number = photos.array, len(photos.array)
    angles = [0.0] * number
    if options.encoding == "linear":
        white = photos.white_level if read.white_level is None else read.white_level
        images, notes = as_measurements(array, read.black_level, white, angles)
        eight = array.dtype == np.uint8
        return images, (*notes, *(("8-bit photographs are rarely linear: --encoding srgb if they are not",) * eight))
    if read.white_level is not None or read.black_level != 0:
        raise ValueError("expected no black or white level of sRGB photographs, found one")
    if array.dtype.kind != "u":
        raise ValueError(f"expected sRGB photographs of 8 or 16 bits, found {array.dtype}")
    images, notes = as_measurements(array, 0, photos.white_level, angles)
    return replace(images, data=linear_from_srgb(images.data)), notes


def _align(images: Measurements, names: Sequence[str], kind: str) -> tuple[Measurements, list[Motion], list[float]]:
    """Photographs as the first one's pixels see them, cropped to what all show; motions found and left [pixels]."""
    data, clipped = images.data, images.clipped
    if kind == "none" or clipped is None:
        return images, [], []
    grey = data.mean(axis=1)
    motions, left, moved, marks = [], [], [data[0]], [clipped[0]]
    for name, plane, image, mark in zip(names[1:], grey[1:], data[1:], clipped[1:], strict=True):
        with naming(name):
            motion = find_motion(grey[0], plane, kind)
        if motion.shift > STILL:
            image = move_back(image, motion.matrix)
            spread = move_back(mark.astype(np.float32), motion.matrix)
            mark = _near(np.nan_to_num(spread) > 0.01)
        motions.append(motion)
        moved.append(image)
        marks.append(mark)
        left.append(round(residual_shift(grey[0], image.mean(axis=0)), 3))
    rows, cols = _shared(np.isfinite(np.stack(moved)).all(axis=(0, 1)))
    if (rows.stop - rows.start) * (cols.stop - cols.start) < LEAST_SHARED * grey[0].size:
        raise ValueError("expected photographs that show the same, found less than half of the picture in all of them")
    inside = (..., rows, cols)
    data, clipped = (np.ascontiguousarray(np.stack(part)[inside]) for part in (moved, marks))
    return replace(images, data=data, clipped=clipped), motions, left


def _near(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels within `REACH` of a mask ``[C, H, W]``."""
    padded = np.pad(mask, ((0, 0), (REACH, REACH), (REACH, REACH)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (2 * REACH + 1, 2 * REACH + 1), axis=(1, 2))
    return np.asarray(windows.any(axis=(-2, -1))) if mask.any() else mask


def _shared(seen: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Rows and columns of a rectangle without a pixel that is not seen: the worst border goes until none has one."""
    top, bottom, left, right = 0, seen.shape[0], 0, seen.shape[1]
    while bottom - top > 1 and right - left > 1:
        part = ~seen[top:bottom, left:right]
        lacks = [part[0].mean(), part[-1].mean(), part[:, 0].mean(), part[:, -1].mean()]
        worst = int(np.argmax(lacks))
        if lacks[worst] == 0:
            break
        top, bottom = top + (worst == 0), bottom - (worst == 1)
        left, right = left + (worst == 2), right - (worst == 3)
    return slice(top, bottom), slice(left, right)


def _block_side(images: Measurements) -> int:
    height, width = images.data.shape[-2:]
    return int(min(BLOCK, max(1, height // 32), max(1, width // 32)))


def _samples(images: Measurements) -> NDArray[np.float32]:
    """Samples ``[K, N]`` to find angles and exposures in: means of blocks that no photograph clips, of every colour.

    Means keep the law of Malus, and lose noise and what alignment has left at edges.
    """
    side = _block_side(images)
    means = block_means(images.data, side).reshape(len(images.data), -1)
    assert images.clipped is not None
    clipped = block_means(images.clipped.astype(np.float32), side).reshape(len(means), -1).any(axis=0)
    if np.count_nonzero(~clipped) < 100:
        raise ValueError(
            f"expected photographs that do not clip, found {np.count_nonzero(~clipped)} places that none does"
        )
    return np.asarray(means[:, ~clipped])


def _exposures(images: Measurements, photos: Photographs, options: PhotoOptions) -> tuple[tuple[float, ...], str]:
    """Exposure of each photograph relative to the least, and where that is from: only a pair's ratio can be found."""
    if options.exposures is not None:
        return _over_least(options.exposures), "stated"
    said = (1.0,) * len(images.data) if photos.exposures is None else _over_least(photos.exposures)
    if options.angles_deg == PAIR:
        ratio = find_pair_exposure(images.data[0], images.data[1])
        if abs(math.log(ratio * said[1] / said[0])) > EQUAL:
            return _over_least((ratio, 1.0)), "found"
    return said, "assumed equal" if photos.exposures is None else "of the files"


def _over_least(exposures: Sequence[float]) -> tuple[float, ...]:
    return tuple(float(e / min(exposures)) for e in exposures)


def _divide(images: Measurements, exposures: Sequence[float]) -> Measurements:
    """Photographs as with the least exposure; what clipped is clipped at less than white then."""
    if all(e == 1 for e in exposures):
        return images
    return replace(images, data=images.data / np.array(exposures, np.float32)[:, None, None, None])


def _angles(images: Measurements, options: PhotoOptions) -> tuple[tuple[float, ...], float | None]:
    """Angles [rad], stated or found; found ones with their error."""
    known = options.known_deg()
    if known is not None:
        return tuple(math.radians(angle) for angle in known), None
    found = find_angles(*gram(_samples(images)))
    if not found.error < MAX_ANGLE_ERROR:
        uncertain = f"angles uncertain by {math.degrees(min(found.error, math.pi / 2)):.0f} deg"
        raise ValueError(
            "expected light of several directions of polarization and five different angles of the filter to find them "
            f"in, found one direction or fewer angles ({uncertain}): say --angles"
        )
    return found.angles, found.error


def _may_be_swapped(pair: Measurements) -> bool:
    """True if the first photograph of a pair is darker, and where they differ most: highlights are few and small."""
    parallel, crossed = block_means(pair.data, _block_side(pair))
    more = parallel - crossed
    lowest, highest = np.quantile(more, (0.001, 0.999))
    lacks = -float(more.clip(max=0).sum()) > LACKS * float(more.clip(min=0).sum()) and -lowest > highest
    return bool(lacks or pair.data[0].mean() < DARKER * pair.data[1].mean())


def _remarks(facts: dict[str, Any], swapped: bool, options: PhotoOptions) -> Iterator[str]:
    """Remarks for whoever took the photographs."""
    if swapped:
        yield "a parallel photograph brighter than the crossed one was expected, found the reverse: are they swapped?"
    if facts["exposures_source"] == "found":
        said = ",".join(f"{e:.3g}" for e in facts["exposures"])
        yield f"equal exposures were expected, found {said}, good to about 5 %: say --exposures, or expose by hand"
    if facts.get("contradiction", 0) > MAX_CONTRADICTION:
        yield (
            f"photographs that agree were expected, found {facts['contradiction']:.1%} of their light contradict: "
            "did exposure, lamp or an angle change, or are they not linear?"
        )
    if options.angles_deg != PAIR and (noise := _relative_noise(facts["angles_deg"])) > MOST_NOISE:
        said = ", ".join(f"{angle:g}" for angle in facts["angles_deg"])
        yield f"angles all over half a turn were expected, found {said}: they multiply noise by {noise:.0f}"
    if max(facts["left_pixels"], default=0) > MAX_LEFT:
        yield (
            f"aligned photographs were expected, found them {max(facts['left_pixels']):.1f} pixels apart after "
            f"--align {options.align}: use a tripod, or try --align homography"
        )


def _relative_noise(angles_deg: Sequence[float]) -> float:
    """The noise of Stokes images from photographs at these angles over that from as many, evenly spaced."""
    even = np.arange(len(angles_deg)) * math.pi / len(angles_deg)
    found, least = (np.linalg.norm(stokes_inverse(list(angles))) for angles in (np.radians(angles_deg), even))
    return float(found / least)
