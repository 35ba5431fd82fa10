"""A picture of a selection set for people: a row per scene, with its light and its polarization."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import interpolate

from evaluation.testsets.cases import Case
from polsep.demosaic.bilinear import demosaic_bilinear_half
from polsep.io.results.previews import Pixels, aolp_wheel, dolp_map, exposure_of
from polsep.physics.srgb import srgb_bytes
from polsep.physics.stokes import Stokes, aolp, dolp, fit_stokes

#: Pixels per side of one picture of the sheet.
TILE = 240


def draw_sheet(cases: Iterable[Case]) -> Pixels:
    """Rows of s0, diffuse, specular; DoLP and AoLP (darkened by DoLP) of the exact light; and s0 of the noisy mosaic.

    ``uint8 [h, w, 3]``. The first three share one gain, so that the diffuse is well exposed.
    """
    return np.concatenate([draw_row(case) for case in cases])


def draw_row(case: Case) -> Pixels:
    """One row of `draw_sheet`."""
    diffuse, specular = case.scene.diffuse, case.scene.specular
    light = diffuse + specular
    gain = exposure_of(diffuse.s0.permute(1, 2, 0).numpy())
    white = _shrunk(light.map(lambda s: s.mean(dim=0, keepdim=True)))
    degree, angle = dolp(white)[0].numpy(), aolp(white)[0].numpy()
    noisy = fit_stokes(demosaic_bilinear_half(case.noisy)).s0
    tones = [_toned(image, gain) for image in (light.s0, diffuse.s0, specular.s0)]
    return np.concatenate([*tones, dolp_map(degree), aolp_wheel(angle, degree), _toned(noisy, gain)], axis=1)


def _toned(image: Tensor, gain: float) -> Pixels:
    linear: NDArray[np.float32] = _fit(image).permute(1, 2, 0).numpy()
    return srgb_bytes(gain * linear)


def _shrunk(stokes: Stokes) -> Stokes:
    return stokes.map(_fit)


def _fit(image: Tensor) -> Tensor:
    """An image ``[C, H, W]`` on a black square of `TILE` pixels, by area where it shrinks."""
    height, width = image.shape[-2:]
    scale = TILE / max(height, width)
    size = (max(1, round(height * scale)), max(1, round(width * scale)))
    small = interpolate(image[None], size=size, mode="area")[0]
    tile = image.new_zeros(image.shape[0], TILE, TILE)
    top, left = (TILE - size[0]) // 2, (TILE - size[1]) // 2
    tile[:, top : top + size[0], left : left + size[1]] = small
    return tile
