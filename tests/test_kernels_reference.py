"""Compiled kernels against formulas that stand here, in float64: errors that twins share show here.

Fields of light that grow linearly over the frame: every bilinear or guided interpolation keeps them, so that each pixel
must have the split of its own place. Equations: Dave et al. 2022, Eqs. 16 to 18, and the colour-affine model,
p_c = a tau_d,c + tau_s exp(2i phi), of `polsep.separation.color_affine`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from polsep.kernels import (
    AnalyticImages,
    AnalyticOptions,
    ColorAffineOptions,
    separate_analytic_full,
    separate_analytic_half,
    separate_color_affine_full,
    separate_color_affine_half,
)
from polsep.networks.joint import Joint
from polsep.networks.openvino_engine import OpenVinoEngine
from polsep.networks.sizes import ResidualSize
from polsep.sensor.camera import Layout

Doubles = NDArray[np.float64]
HEIGHT, WIDTH = 160, 192
SONY, OTHER = ((90, 45), (135, 0)), ((10, 75), (-30, 200))
LAYOUTS = [Layout(SONY, "RGGB"), Layout(OTHER, "GBRG"), Layout(SONY, "BGGR", (1, 0)), Layout(SONY, None)]
LIGHT = (0.8, 1.0, 1.25)
BLACK, WHITE = 200.0, 4000.0
#: Of white: float32 through filters; closed forms whose slopes have priors, and those of networks with stronger ones.
ROUNDING, PRIOR, DISTRUST = 4e-6, 2e-4, 5e-4
#: Of AoLP in radians: the polynomial's arctangent.
ANGLE = 1e-5
#: Pixels at the border whose windows see mirrored, so no longer linear, light.
REACH = {False: 24, True: 48}


class Light(NamedTuple):
    """Stokes images ``[h, w, C]`` and what they are made of: diffuse light and white specular light."""

    s0: Doubles
    s1: Doubles
    s2: Doubles
    diffuse: Doubles
    specular: Doubles


def light_at(rows: Doubles, cols: Doubles, colors: int) -> Light:
    """Light at places: colours that grow unlike, diffuse light of one polarization, and highlights that grow."""
    y, x = rows[:, None, None] / HEIGHT, cols[None, :, None] / WIDTH
    level, down, right = np.array([[0.9, 0.5, 0.3], [0.1, -0.1, 0.05], [-0.2, 0.15, 0.1]])[:, :colors]
    diffuse = level + down * y + right * x
    specular = 0.2 + 0.1 * y - 0.05 * x + 0 * level
    a, phi = 0.12 * np.exp(2j * np.radians(40)), np.radians(115)
    p = a * diffuse + specular * np.exp(2j * phi)
    return Light(diffuse + specular, p.real, p.imag, diffuse, specular)


def samples_of(layout: Layout) -> NDArray[np.float32]:
    """The raw frame: m = (s0 + s1 cos 2t + s2 sin 2t) / 2 of each pixel's colour and analyser, in the lamp's light."""
    light = light_at(np.arange(HEIGHT), np.arange(WIDTH), layout.channels)
    row, col = np.meshgrid(np.arange(HEIGHT), np.arange(WIDTH), indexing="ij")
    down, right = row - layout.origin[0], col - layout.origin[1]
    doubled = 2 * np.radians(np.array(layout.polarizer, float)[down % 2, right % 2])
    order = (
        np.array([["RGB".index(c) for c in pair] for pair in (layout.bayer[:2], layout.bayer[2:])])
        if layout.bayer
        else np.zeros((2, 2), int)
    )
    color = order[down // 2 % 2, right // 2 % 2]
    s0, s1, s2 = (s[row, col, color] for s in light[:3])
    raw = (s0 + s1 * np.cos(doubled) + s2 * np.sin(doubled)) / 2 * np.array(LIGHT)[color]
    return (BLACK + (WHITE - BLACK) * raw).astype(np.float32)


def light_seen(layout: Layout, full: bool) -> Light:
    """The light at the pixels of the images, whole polarizer cells: of the frame's own, or at the cells' middles."""
    places = []
    for first, length in zip(layout.origin, (HEIGHT, WIDTH), strict=True):
        cells = first + 2 * np.arange((length - first) // 2)
        places.append(np.sort([*cells, *(cells + 1)]) if full else cells + 0.5)
    return light_at(*places, layout.channels)


def assert_split(
    images: AnalyticImages, diffuse: Doubles, specular: Doubles, reach: int, tolerance: float = ROUNDING
) -> None:
    """Both images, away from the border; nothing clips, so that all is valid."""
    inside = (slice(reach, -reach), slice(reach, -reach))
    assert images.diffuse.shape == diffuse.shape and images.valid.all()
    np.testing.assert_allclose(images.diffuse[inside], diffuse[inside], rtol=0, atol=tolerance)
    np.testing.assert_allclose(images.specular[inside], specular[inside], rtol=0, atol=tolerance)


@pytest.mark.parametrize("full", [False, True], ids=["half", "full"])
@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.spec)
def test_the_analytic_split_is_equations_16_to_18(layout: Layout, full: bool) -> None:
    """tau_s = 2 A = sqrt(s1^2 + s2^2), tau_d = 2 (c - A) = s0 - tau_s; DoLP and AoLP of the mean over colours."""
    separate = separate_analytic_full if full else separate_analytic_half
    options = AnalyticOptions(LIGHT[: layout.channels], report=True)
    images = separate(samples_of(layout), layout, BLACK, WHITE, options)
    light = light_seen(layout, full)
    polarized = np.hypot(light.s1, light.s2)
    assert_split(images, light.s0 - polarized, polarized, 8)
    s0, s1, s2 = (s.mean(axis=2)[8:-8, 8:-8] for s in light[:3])
    assert images.dolp is not None and images.aolp is not None
    np.testing.assert_allclose(images.dolp[8:-8, 8:-8], np.hypot(s1, s2) / s0, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(images.aolp[8:-8, 8:-8], np.arctan2(s2, s1) / 2 % np.pi, rtol=0, atol=ANGLE)


@pytest.mark.parametrize("full", [False, True], ids=["half", "full"])
@pytest.mark.parametrize("guided", [False, True], ids=["bilinear", "guided"])
@pytest.mark.parametrize("layout", LAYOUTS[:3], ids=lambda layout: layout.spec)
def test_the_color_affine_split_undoes_its_model(layout: Layout, guided: bool, full: bool) -> None:
    separate = separate_color_affine_full if full else separate_color_affine_half
    images = separate(samples_of(layout), layout, BLACK, WHITE, ColorAffineOptions(LIGHT, guided=guided))
    light = light_seen(layout, full)
    assert_split(images, light.diffuse, light.specular, REACH[full], PRIOR)
    wrong = np.abs(light.specular - np.hypot(light.s1, light.s2))
    assert wrong.min() > 20 * PRIOR  # the analytic split is another one


@pytest.mark.parametrize("full", [False, True], ids=["half", "full"])
def test_a_joint_network_that_corrects_nothing_is_the_closed_form(full: bool) -> None:
    """Fresh weights leave the closed form of the kernels as it is; in the lamp's light."""
    layout = LAYOUTS[0]
    net = Joint(3, ResidualSize(16, (0, 1, 1)), demosaicker="guided").eval()
    engine = OpenVinoEngine(net.weights(), (HEIGHT, WIDTH), full, "f32")
    images = engine.run(samples_of(layout), (BLACK, WHITE), LIGHT)
    light = light_seen(layout, full)
    assert_split(images, light.diffuse * LIGHT, light.specular * LIGHT, REACH[full], DISTRUST)
