"""The slope's window that ends at edges: no light leaks across a crease, and without edges nothing changes."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from tolerances import assert_close
from torch import Tensor

from polsep.physics.stokes import Measurements, Stokes, fit_stokes, measure
from polsep.separation.color_affine import EDGE_RADIUS, EDGE_REACH, polarization_edges, separate_color_affine

ANGLES = tuple(math.radians(t) for t in (0.0, 45.0, 90.0, 135.0))
SIZE = 48
NOISE = 0.003


def crease(second: float) -> tuple[Measurements, Tensor]:
    """Two textured surfaces side by side whose diffuse light is polarized 0.3 along 0 and ``second`` along 45 degrees.

    Noisy samples ``[4, 3, 48, 48]`` under weak white specular light, and the true diffuse light.
    """
    generator = torch.Generator().manual_seed(5)
    diffuse = 0.2 + 0.6 * torch.rand(3, SIZE, SIZE, generator=generator)
    right = (torch.arange(SIZE) >= SIZE // 2).expand(3, SIZE, SIZE)
    first, other = torch.where(right, 0.0, 0.3), torch.where(right, second, 0.0)
    specular = torch.full_like(diffuse, 0.05)
    light = Stokes(diffuse + specular, first * diffuse + 0.6 * specular, other * diffuse + 0.8 * specular)
    exact = measure(light, ANGLES)
    noise = NOISE * torch.randn(exact.data.shape, generator=generator)
    return replace(exact, data=exact.data + noise), diffuse


def error_beside_edge(samples: Measurements, diffuse: Tensor) -> float:
    """Rms error of the diffuse light within the narrow window of the crease."""
    beside = slice(SIZE // 2 - 2, SIZE // 2 + 2)
    found = separate_color_affine(samples).diffuse
    return float((found - diffuse)[..., beside].square().mean().sqrt())


def test_edges_of_even_light_are_its_polarization() -> None:
    light = Stokes(torch.full((3, 9, 11), 0.5), torch.full((3, 9, 11), 0.1), torch.full((3, 9, 11), -0.2))
    edges = polarization_edges(measure(light, ANGLES), light)
    assert_close(edges[0], torch.full((9, 11), 0.1 / 0.501))
    assert_close(edges[1], torch.full((9, 11), -0.2 / 0.501))


def test_clipped_pixels_make_no_edges() -> None:
    light = Stokes(*(torch.full((3, 9, 11), s) for s in (0.5, 0.1, -0.2)))
    samples = measure(light, ANGLES)
    clipped = torch.zeros_like(samples.data, dtype=torch.bool)
    clipped[1, 2, 4, 5] = True
    spoilt = Stokes(light.s0, light.s1.clone(), light.s2)
    spoilt.s1[:, 4, 5] = 0.9
    edges = polarization_edges(replace(samples, clipped=clipped), spoilt)
    # The floor of the light weighs a little more where one of nine pixels is missing.
    assert float((edges[0] - 0.1 / 0.501).abs().max()) < 1e-4


def test_a_window_that_ends_at_a_crease_separates_better_beside_it() -> None:
    """`uniform` samples mark data of the guided demosaicker, whose windows end at edges."""
    samples, diffuse = crease(second=-0.3)
    apart = 0.3 * math.sqrt(2) * 0.8
    assert apart > EDGE_REACH
    boxes = error_beside_edge(samples, diffuse)
    ending = error_beside_edge(replace(samples, uniform=samples), diffuse)
    assert ending < 0.8 * boxes


def test_without_edges_both_windows_agree_within_noise() -> None:
    """On one surface both windows see the same slope."""
    samples, diffuse = crease(second=0.0)
    left = slice(EDGE_RADIUS, SIZE // 2 - 2 * EDGE_RADIUS)
    boxes = separate_color_affine(samples).diffuse[..., left]
    ending = separate_color_affine(replace(samples, uniform=samples)).diffuse[..., left]
    truth = diffuse[..., left]
    assert float((boxes - truth).square().mean()) < 1.2 * float((ending - truth).square().mean())
    assert float((ending - boxes).square().mean().sqrt()) < NOISE


def test_turning_the_picture_turns_the_result() -> None:
    """Half a turn leaves angles of polarization as they are."""
    samples, _ = crease(second=-0.3)
    turned = replace(samples, data=samples.data.flip(-1, -2))
    found = separate_color_affine(replace(turned, uniform=turned)).diffuse.flip(-1, -2)
    assert_close(found, separate_color_affine(replace(samples, uniform=samples)).diffuse)
    assert float(fit_stokes(samples).s0.min()) > 0
