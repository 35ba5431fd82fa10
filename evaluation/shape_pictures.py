"""The pictures of docs/geometry.md in the manner of Fig. 10 of Dave et al. 2022: meshes under six lights, by input."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from evaluation.figures import Panel, Pixels, draw_grid, tone
from evaluation.shape_scores import angular_error, appearances_of
from evaluation.six_lights import SEED, Subject, photograph
from polsep.geometry.integration import integrate_bilateral
from polsep.geometry.photometric import Appearance
from polsep.geometry.surface import draw_views, relight, span_surface

Floats = NDArray[np.float64]

#: What is compared, and what the rows are called.
ROWS = {
    "s0, least squares": "unseparated",
    "s0, robust": "unseparated, robust",
    "joint, polarization": "separated",
    "truth": "truth",
}
#: Error that is white [degrees]; side of pictures of meshes; from where they are seen.
LARGEST_DEG, SIDE, VIEW = 30.0, 240, (35.0, 15.0)


def draw_subject(subject: Subject, number: int) -> Pixels:
    """Normals, their error, albedo, another light and the mesh of an object, by input; ``number`` makes its seed."""
    shoot = photograph(subject, SEED + 1000 + number)
    found = {name: shape for name, shape in appearances_of(shoot) if name in ROWS}
    best = found["joint, polarization"]
    found["truth"] = Appearance(np.where(shoot.mask[..., None], shoot.normals, 0), best.albedo, shoot.mask)
    gain = 0.9 / float(np.percentile(best.albedo[shoot.mask], 99))
    return draw_grid([list(_row(name, found[name], shoot.normals, gain)) for name in ROWS], subject.name)


def _row(name: str, found: Appearance, truth: Floats, gain: float) -> Sequence[Panel]:
    mask = found.mask
    error = np.where(mask, angular_error(found.normals, truth), 0)
    shown = Appearance(found.normals, np.minimum(gain * found.albedo, 1), mask)
    surface = span_surface(shown, integrate_bilateral(found.normals, mask))
    (mesh,) = draw_views(surface, SIDE, [VIEW])
    grey = np.repeat(error[..., None] / LARGEST_DEG, 3, axis=-1)
    pictures = (
        (f"{ROWS[name]}: normals", (found.normals + 1) / 2 * mask[..., None], False),
        (f"error, {error[mask].mean():.1f} degrees", grey, False),
        ("albedo", shown.albedo, True),
        ("another light", relight(shown), True),
        ("mesh", mesh, True),
    )
    return [Panel(title, _pixels(image, mask, toned)) for title, image, toned in pictures]


def _pixels(image: Floats, mask: NDArray[np.bool_], toned: bool) -> Pixels:
    """A picture, around the mask if it has its size."""
    if image.shape[:2] == mask.shape:
        rows, cols = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
        middle, half = ((rows[0] + rows[-1]) // 2, (cols[0] + cols[-1]) // 2), 0
        half = max(int(rows[-1] - rows[0]), int(cols[-1] - cols[0])) // 2 + 6
        padded = np.pad(image, ((half, half), (half, half), (0, 0)))
        image = padded[middle[0] : middle[0] + 2 * half, middle[1] : middle[1] + 2 * half]
    if toned:
        return tone(torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1), 1.0)
    return np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)
