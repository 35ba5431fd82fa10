"""Alignment of pictures of one scene that differ by a small motion, to a fraction of a pixel, by OpenCV (extra photos).

Motions are 3x3 homographies that map pixels (x, y, 1) of the reference to those of the moved picture. They are found
by ECC (Evangelidis and Psarakis 2008, doi 10.1109/TPAMI.2008.113), which ignores differences of gain and offset, from
coarse to fine on a pyramid. What is compared are square roots of brightness without their slow parts, so that
highlights and shadings that a turned filter changes weigh little; pixels that differ most are left out of later
rounds.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

#: Motions by name, from the fewest unknowns to the most: 2, 3, 6 and 8.
MOTIONS = ("shift", "rigid", "affine", "homography")
#: Side of the coarsest pyramid level in pixels, and the longest side of the finest: larger pictures are halved.
COARSEST, FINEST = 96, 2048
#: Least side of the coarsest level: a smaller one is all border.
LEAST = 16
#: Standard deviations of the band of details that is compared, in pixels of a level.
FINE, SLOW = 0.8, 6.0
#: Share of pixels that later rounds on a level keep, those whose details agree best, and the number of these rounds.
KEPT, ROUNDS = 0.8, 2
#: Blocks along a side whose shifts show what a motion left, and the response from which a block's shift counts.
BLOCKS, TRUSTED = 6, 0.2
#: Steps of a level, and the change of the correlation below which it ends.
STEPS, CHANGE = 60, 1e-7


class Motion(NamedTuple):
    """A motion ``matrix [3, 3]``, how far it moves a corner at most, and the correlation of details that it reaches.

    ``shift``: in pixels. ``before``: the correlation without it.
    """

    matrix: Doubles
    shift: float
    correlation: float
    before: float


def find_motion(reference: Floats, moved: Floats, kind: str = "rigid") -> Motion:
    """The motion of ``moved [H, W]`` against ``reference [H, W]``, linear light. ``kind``: one of `MOTIONS`.

    Raises ValueError where the pictures show nothing in common, and on pictures that are too small or too narrow.
    """
    import cv2

    pyramid = [(reference, moved)]
    while max(pyramid[-1][0].shape) > FINEST or min(pyramid[-1][0].shape) > 2 * COARSEST:
        pyramid.append((_halved(pyramid[-1][0]), _halved(pyramid[-1][1])))
    if min(pyramid[-1][0].shape) < LEAST:
        least, (height, width) = LEAST << (len(pyramid) - 1), reference.shape
        raise ValueError(
            f"expected photographs of at least {least}x{least} pixels to align, found {width}x{height}: "
            "--align none takes them as they are"
        )
    matrix = np.eye(3)
    matrix[:2, 2] = _coarse_shift(*pyramid[-1])
    model = {"shift": cv2.MOTION_TRANSLATION, "rigid": cv2.MOTION_EUCLIDEAN, "affine": cv2.MOTION_AFFINE}.get(
        kind, cv2.MOTION_HOMOGRAPHY
    )
    details = (reference, moved)
    for level, pair in reversed(list(enumerate(pyramid))):
        if max(pair[0].shape) > FINEST:
            break
        details = (_details(pair[0]), _details(pair[1]))
        matrix = _refine(details, matrix, model, None)
        for _ in range(ROUNDS):
            matrix = _refine(details, matrix, model, _agreeing(details, matrix))
        if level == 0 or max(pyramid[level - 1][0].shape) > FINEST:
            break
        matrix = _scaled(matrix, 2.0)
    after, before = (_correlation(details, m) for m in (matrix, np.eye(3)))
    matrix = _scaled(matrix, 2.0**level)
    return Motion(matrix, _farthest(matrix, reference.shape), after, before)


def move_back(image: Floats, matrix: Doubles) -> Floats:
    """A moved picture ``[C, H, W]`` as the reference's pixels see it, by cubic interpolation; NaN outside of it."""
    import cv2

    size, flags = (image.shape[-1], image.shape[-2]), cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    planes = [
        cv2.warpPerspective(plane, matrix, size, flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=math.nan)
        for plane in image
    ]
    return np.stack(planes).astype(np.float32, copy=False)


def _halved(image: Floats) -> Floats:
    height, width = (n // 2 * 2 for n in image.shape)
    return np.asarray(image[:height, :width].reshape(height // 2, 2, width // 2, 2).mean((1, 3)), np.float32)


def _scaled(matrix: Doubles, factor: float) -> Doubles:
    """A motion between pixels of a level ``factor`` times as fine; pixels are areas, so middles move."""
    scale = np.array([[factor, 0, (factor - 1) / 2], [0, factor, (factor - 1) / 2], [0, 0, 1]])
    found = scale @ matrix @ np.linalg.inv(scale)
    return np.asarray(found / found[2, 2])


def _details(image: Floats) -> Floats:
    """Square roots without their slow parts, limited to three standard deviations; NaN where the border shows."""
    import cv2

    root = np.sqrt(np.clip(image, 0, 1)).astype(np.float32)
    band = cv2.GaussianBlur(root, (0, 0), FINE) - cv2.GaussianBlur(root, (0, 0), SLOW)
    most = 3 * float(band.std())
    band = np.asarray(np.clip(band, -most, most), np.float32)
    margin = min(round(2 * SLOW), min(band.shape) // 8)
    band[:margin] = band[-margin:] = band[:, :margin] = band[:, -margin:] = np.nan
    return band


def _coarse_shift(reference: Floats, moved: Floats) -> tuple[float, float]:
    """Shift (x, y) of the coarsest level, by the phase of its spectrum."""
    import cv2

    window = cv2.createHanningWindow((reference.shape[1], reference.shape[0]), cv2.CV_32F)
    fixed, free = (np.nan_to_num(_details(image)) for image in (reference, moved))
    (x, y), response = cv2.phaseCorrelate(fixed, free, window)
    return (x, y) if response > 0.1 else (0.0, 0.0)


def _refine(details: tuple[Floats, Floats], matrix: Doubles, model: int, mask: NDArray[np.uint8] | None) -> Doubles:
    """A motion improved by ECC on one level. Raises ValueError where it finds nothing in common.

    ECC sees the picture moved back already: its linear interpolation blurs, and so misleads by up to 0.1 pixel, except
    near motion zero.
    """
    import cv2

    there = move_back(details[1][None], matrix)[0]
    seen = np.isfinite(there) & np.isfinite(details[0])
    here, there = (np.where(seen, image, 0).astype(np.float32) for image in (details[0], there))
    mask = seen.astype(np.uint8) if mask is None else mask & seen
    rest = np.eye(3, dtype=np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, STEPS, CHANGE)
    try:
        start = rest if model == cv2.MOTION_HOMOGRAPHY else rest[:2]
        _, found = cv2.findTransformECC(here, there, start, model, criteria, mask, 1)
    except cv2.error:
        raise ValueError(
            "expected photographs of one scene, found nothing in common: --align none takes them as they are"
        ) from None
    rest[: len(found)] = found
    whole = matrix @ rest
    return np.asarray(whole / whole[2, 2])


def _agreeing(details: tuple[Floats, Floats], matrix: Doubles) -> NDArray[Any]:
    """Mask of the pixels whose details differ least, 1 or 0, of a gain that is fitted."""
    here, there = details[0], move_back(details[1][None], matrix)[0]
    seen = np.isfinite(there) & np.isfinite(here)
    gain = float((here[seen] * there[seen]).sum() / max(float((there[seen] ** 2).sum()), 1e-20))
    distance = np.where(seen, np.abs(here - gain * there), np.inf)
    most = np.quantile(distance[seen], KEPT) if seen.any() else 0.0
    return np.asarray(distance <= most, np.uint8)


def _correlation(details: tuple[Floats, Floats], matrix: Doubles) -> float:
    """Correlation of details after a motion, where both are seen."""
    there = move_back(details[1][None], matrix)[0]
    seen = np.isfinite(there) & np.isfinite(details[0])
    return float(np.corrcoef(details[0][seen], there[seen])[0, 1]) if np.count_nonzero(seen) > 9 else 0.0


def _farthest(matrix: Doubles, shape: tuple[int, ...]) -> float:
    """The largest distance that a motion moves a corner of the picture."""
    height, width = shape
    corners = np.array([[0, 0, 1], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1]], np.float64).T
    moved = matrix @ corners
    return float(np.hypot(*(moved[:2] / moved[2] - corners[:2])).max())


def residual_shift(reference: Floats, aligned: Floats) -> float:
    """Median shift [pixels] that blocks of an aligned picture still have; 0 where no block has details to tell.

    It shows what one motion cannot undo: depth seen from two places, objects that moved.
    """
    import cv2

    details = [np.nan_to_num(_details(np.nan_to_num(image))) for image in (reference, aligned)]
    height, width = (max(n // BLOCKS, min(n, 48)) for n in reference.shape)
    window = cv2.createHanningWindow((width, height), cv2.CV_32F)
    shifts = []
    for top in range(0, reference.shape[0] - height + 1, height):
        for left in range(0, reference.shape[1] - width + 1, width):
            here, there = (np.ascontiguousarray(d[top : top + height, left : left + width]) for d in details)
            (x, y), response = cv2.phaseCorrelate(here, there, window)
            if response > TRUSTED:
                shifts.append(math.hypot(x, y))
    return float(np.median(shifts)) if shifts else 0.0
