"""The pictures of docs/shape.md: one frame of an object, and its surface by what a network sees."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from evaluation.figures import Panel, Pixels, draw_grid, tone
from evaluation.one_frame import KINDS, classical, estimate, list_methods, photograph
from evaluation.six_lights import Subject
from polsep.geometry.shape_maps import Surface, relight
from polsep.io.assets.relight_page import RelightMaps, encode_relight_page

Floats = NDArray[np.float32]

#: Rows: what a network sees, and what the row is called.
ROWS = {"rgb": "s0 alone", "stokes": "s0, s1, s2", "separated": "separated", "classical": "no network"}
#: Added to a subject's number: lamps of pictures are not those of scores.
OTHER_LAMPS = 450
#: Error that is white [degrees]; the lamp of the relit pictures.
LARGEST_DEG, LAMP = 30.0, (-0.6, 0.35, 0.72)


def draw_object(subject: Subject, number: int) -> Pixels:
    """Normals, their errors, albedo and another lamp for a glossy object and a matte one, by input, and the truth."""
    rows = []
    for kind in ("glossy", "matte"):
        shot = photograph(subject, OTHER_LAMPS + number, KINDS[kind])
        for name, title in ROWS.items():
            if name not in (*list_methods(), "classical"):
                continue
            found, truth, mask = classical(shot) if name == "classical" else estimate(name, shot)
            rows.append(list(_row(f"{kind}, {title}", found, truth, mask)))
        rows.append(list(_row(f"{kind}, truth", truth, truth, mask)))
    return draw_grid(rows, f"{subject.name}: shape from one frame")


def relight_object(subject: Subject, number: int) -> bytes:
    """The page that relights a glossy object, from one frame of it."""
    found, _, mask = estimate("separated", photograph(subject, OTHER_LAMPS + number, KINDS["glossy"]))
    inside = mask[0] > 0
    albedo = np.moveaxis(found.albedo * (0.9 / np.percentile(found.albedo[:, inside], 99)), 0, -1)
    maps = RelightMaps(np.moveaxis(found.normal, 0, -1), albedo, found.roughness[0], found.specular[0], inside)
    return encode_relight_page(maps, f"{subject.name}, from one frame", (0.0, 0.0, 1.0))


def _row(title: str, found: Surface, truth: Surface, mask: Floats) -> Iterator[Panel]:
    error = np.degrees(np.arccos(np.clip((found.normal * truth.normal).sum(axis=0), -1, 1))) * mask[0]
    inside = mask[0] > 0
    gain = np.median(truth.albedo[:, inside]) / max(float(np.median(found.albedo[:, inside])), 1e-6)
    found = found._replace(albedo=found.albedo * gain)
    lamp = np.array(LAMP, np.float32) / np.float32(np.linalg.norm(LAMP))
    yield Panel(f"{title}: normals", _pixels((found.normal + 1) / 2 * mask))
    yield Panel(f"error, {error[inside].mean():.1f} degrees", _pixels(np.repeat(error[None] / LARGEST_DEG, 3, axis=0)))
    yield Panel("albedo", _toned(found.albedo * mask))
    yield Panel("another lamp", _toned(relight(found, lamp) * mask))


def _pixels(image: Floats) -> Pixels:
    return np.rint(255 * np.clip(np.moveaxis(image, 0, -1), 0, 1)).astype(np.uint8)


def _toned(image: Floats) -> Pixels:
    import torch

    return tone(torch.from_numpy(np.ascontiguousarray(image)).float(), 1.0)
