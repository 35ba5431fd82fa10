"""One code for NumPy arrays and torch tensors: the same numbers from the sensor to the light, and none need torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from test_without_torch import run
from torch.nn import functional

from polsep.compute.arrays import Array, of_kind, pad_mirror, pad_repeat, to_numpy
from polsep.compute.filters import box_mean
from polsep.demosaic.bilinear import demosaic_bilinear, demosaic_bilinear_half, demosaic_dave2022, interleave
from polsep.demosaic.guided import demosaic_guided, demosaic_guided_half
from polsep.light.find import find_light
from polsep.physics.stokes import (
    Stokes,
    analyser_residual,
    aolp,
    dolp,
    fit_stokes,
    fit_stokes_unclipped,
    flip_horizontal,
    flip_vertical,
    intensity_behind,
    measure,
    polarized_intensity,
    rotate_frame,
    rotate_quarter,
    transpose,
)
from polsep.sensor.camera import IDEAL, Layout, Mosaic, Sensor, expose, sample_mosaic
from polsep.sensor.checks import check_mosaic
from polsep.sensor.corrections import mean_mosaic, subtract_ambient
from polsep.sensor.defects import find_defects, repair
from polsep.sensor.orient import orient

#: Both kinds round in other orders; of white.
ROUNDING = 1e-6
LAYOUTS = ("color", "mono", "0,45,90,135/GBRG@1,0", "90,45,135,0/BGGR@1,1", "30,80,120,10/RGGB")
SHAPES = ((48, 56), (2, 34, 30), (14, 12))
DEMOSAICKERS = (demosaic_bilinear, demosaic_bilinear_half, demosaic_dave2022, demosaic_guided, demosaic_guided_half)
MOVES = (flip_horizontal, flip_vertical, rotate_quarter, transpose, lambda stokes: rotate_frame(stokes, 0.3))

#: Rooms up to the light, in an interpreter that finds no torch.
WITHOUT_TORCH = """
import numpy as np
import polsep.io.store.calibrations
from polsep.calibrate.dark_flat import measure_dark
from polsep.calibrate.exposures import merge_exposures
from polsep.calibrate.lamp import measure_lamp
from polsep.demosaic import bilinear, guided
from polsep.light.find import find_light
from polsep.physics.stokes import fit_stokes, fit_stokes_unclipped
from polsep.sensor.calibration import correct_mosaic
from polsep.sensor.corrections import mean_mosaic, subtract_ambient
from polsep.sensor.camera import Layout
from polsep.sensor.checks import check_mosaic
from polsep.sensor.defects import find_defects
from polsep.sensor.levels import as_measurements, as_mosaic
from polsep.sensor.orient import orient

codes = np.random.default_rng(0).integers(0, 1100, (64, 72)).astype(np.uint16)
for layout in ("color", "mono"):
    mosaic, _ = as_mosaic(codes, layout, 64, 1023)
    mosaic = check_mosaic(mosaic).mosaic
    find_defects(mosaic), find_light(mosaic), orient(mosaic, mosaic.layout).turn(mosaic.data)
    for demosaic in (bilinear.demosaic_bilinear, bilinear.demosaic_bilinear_half, guided.demosaic_guided,
                     guided.demosaic_guided_half):
        measurements = demosaic(mosaic)
        assert type(measurements.data) is np.ndarray and measurements.data.dtype == np.float32
        fit_stokes(measurements), fit_stokes_unclipped(measurements), find_light(measurements)
    dark = measure_dark(as_mosaic(codes[::turn] // 8, layout, 64, 1023)[0] for turn in (1, -1))
    correct_mosaic(mosaic, dark), subtract_ambient(mosaic, mean_mosaic([mosaic, mosaic]))
    merge_exposures([mosaic], [1.0])
find_light(as_measurements(np.stack([codes] * 4), 64, 1023)[0])
"""


def frame(spec: str, shape: tuple[int, ...], dtype: type = np.float32) -> Mosaic:
    """Waves with noise, bright enough to clip, under a light of unequal colours."""
    layout, rng = Layout.parse(spec), np.random.default_rng(len(spec) + sum(shape))
    rows, cols = (np.linspace(0, 6, n) for n in shape[-2:])
    light = 1.2 * (0.5 + 0.4 * np.sin(2 * rows[:, None] + cols) + 0.05 * rng.random(shape))
    if dtype is np.uint16:
        return Mosaic((3800 * light + 64).astype(np.uint16), layout, 64, 4095, (0.8, 1.0, 1.3))
    return Mosaic(light.astype(dtype), layout, 0.0, 1.0)


def as_tensors(value: Any) -> Any:
    """A dataclass or array with tensors in place of arrays, which share no memory with them."""
    if isinstance(value, np.ndarray):
        return torch.tensor(value)
    if is_dataclass(value) and not isinstance(value, (type, Layout)):
        return replace(value, **{f.name: as_tensors(getattr(value, f.name)) for f in fields(value)})
    return value


def assert_same(found: Any, wanted: Any, tolerance: float = ROUNDING) -> None:
    """What NumPy arrays gave, as arrays, is what tensors gave, as tensors, to rounding."""
    if isinstance(wanted, torch.Tensor):
        assert isinstance(found, np.ndarray) and found.dtype == wanted.detach().numpy().dtype
        assert found.shape == tuple(wanted.shape)
        if found.dtype == np.bool_:
            np.testing.assert_array_equal(found, wanted)
        else:
            np.testing.assert_allclose(found, wanted, rtol=0, atol=tolerance)
    elif isinstance(wanted, tuple):
        for one, other in zip(found, wanted, strict=True):
            assert_same(one, other, tolerance)
    elif is_dataclass(wanted) and not isinstance(wanted, Layout):
        for f in fields(wanted):
            assert_same(getattr(found, f.name), getattr(wanted, f.name), tolerance)
    else:
        assert found == wanted


def assert_agreed(function: Callable[..., Any], *arguments: Any, tolerance: float = ROUNDING) -> None:
    """A function gives the same of arrays and of tensors."""
    assert_same(function(*arguments), function(*(as_tensors(x) for x in arguments)), tolerance)


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.uint16])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("spec", LAYOUTS)
def test_demosaicked_arrays_are_demosaicked_tensors(spec: str, shape: tuple[int, ...], dtype: type) -> None:
    """Linear samples, clip masks and every demosaicker, of colour and mono, cropped and clipped frames and batches."""
    mosaic = frame(spec, shape, dtype)
    before = mosaic.data.copy()
    assert mosaic.linear().dtype == (np.float64 if dtype is np.float64 else np.float32)
    assert bool(mosaic.clipped().any())
    assert_agreed(Mosaic.linear, mosaic)
    assert_agreed(Mosaic.clipped, mosaic)
    for demosaic in DEMOSAICKERS:
        assert_agreed(demosaic, mosaic, tolerance=2 * ROUNDING)  # s0 reaches 2
    np.testing.assert_array_equal(mosaic.data, before)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("spec", LAYOUTS)
def test_stokes_arrays_are_stokes_tensors(spec: str, shape: tuple[int, ...]) -> None:
    """Least squares with and without clipped samples, what follows from it, and mirror images."""
    measurements = demosaic_bilinear_half(frame(spec, shape))
    assert measurements.clipped is not None and bool(measurements.clipped.any())
    for function in (fit_stokes, fit_stokes_unclipped, analyser_residual):
        # Of three analysers a few degrees apart the inverse amplifies rounding.
        assert_agreed(function, measurements, tolerance=(1 if spec[0] != "3" else 30) * ROUNDING)
    stokes = fit_stokes(measurements)
    for image in (polarized_intensity, dolp, *MOVES):
        assert_agreed(image, stokes)
    assert_agreed(lambda s: intensity_behind(s, 0.4), stokes)
    assert_agreed(lambda s: measure(s, (0.1, 0.9, 2.0)), stokes)
    difference = aolp(stokes) - to_numpy(aolp(as_tensors(stokes)))
    assert float((np.abs(np.sin(difference)) * dolp(stokes)).max()) < ROUNDING


def test_sensors_of_arrays_are_those_of_tensors() -> None:
    """The forward sensor without noise: samples, quantization, and a variance."""
    stokes = Stokes(*np.random.default_rng(1).random((3, 3, 16, 20)).astype(np.float32))
    measurements = measure(stokes, Layout().angles)
    assert_agreed(lambda m: sample_mosaic(m, Layout()), measurements)
    assert_agreed(lambda s: expose(s, Layout(), Sensor(bits=8)).data, stokes, tolerance=1.0)
    assert_agreed(lambda s: expose(s, Layout(), IDEAL).data, stokes)
    assert_agreed(Sensor(1e4, 2.0, 12).noise_variance, stokes.s0)


@pytest.mark.parametrize("dtype", [np.float32, np.uint16])
@pytest.mark.parametrize("spec", LAYOUTS[:4])
def test_checks_and_light_see_the_same_in_both(spec: str, dtype: type) -> None:
    """Checks, defects, the light of mosaics and of measurements, means and room light do not depend on the kind."""
    mosaic = frame(spec, (64, 72), dtype)
    tensors = as_tensors(mosaic)
    mosaic.data[20, 30] = tensors.data[20, 30] = mosaic.black_level
    mask = find_defects(mosaic)
    np.testing.assert_array_equal(mask, find_defects(tensors))
    assert_same(repair(mosaic, mask).data, repair(tensors, mask).data, 1e-3)
    assert_same(check_mosaic(mosaic), check_mosaic(tensors), 1e-3)
    assert find_light(mosaic) == find_light(tensors)
    assert find_light(demosaic_bilinear_half(mosaic)).color == pytest.approx(
        find_light(demosaic_bilinear_half(tensors)).color, rel=1e-4
    )
    for function in (lambda m: mean_mosaic([m, m]), lambda m: subtract_ambient(m, replace(m, data=m.data))):
        assert_same(function(mosaic), function(tensors), 1e-3)
    room = subtract_ambient(tensors, mosaic)
    assert isinstance(room.data, torch.Tensor)


@pytest.mark.parametrize("spec", LAYOUTS)
def test_turned_arrays_are_turned_tensors(spec: str) -> None:
    """Frames and images of both resolutions, turned and turned back."""
    mosaic = frame(spec, (2, 34, 30))
    wanted = replace(mosaic.layout, origin=(0, 0)).transposed()
    how = orient(mosaic, wanted if wanted.bayer is None else replace(wanted, bayer="RGGB"))
    assert_agreed(how.turn, mosaic.data)
    turned = how.turn(mosaic.data)
    for scale, images in ((2, turned), (1, turned[..., ::2, ::2])):
        assert_agreed(lambda x, scale=scale: how.turn_back(x, scale), images)
        assert_agreed(lambda x, scale=scale: how.turn_back(x > 0.6, scale), images)


@pytest.mark.parametrize("axis", [-1, -2])
@pytest.mark.parametrize("margin", [1, 3, 5])
def test_continuations_are_those_of_torch(axis: int, margin: int) -> None:
    """Mirrored and repeated borders, box means and interleaved images of both kinds."""
    x = np.random.default_rng(2).random((2, 3, 6, 7)).astype(np.float32)
    pads = (margin, margin, 0, 0) if axis == -1 else (0, 0, margin, margin)
    for pad, mode in ((pad_mirror, "reflect"), (pad_repeat, "replicate")):
        wanted = functional.pad(torch.tensor(x), pads, mode=mode)
        np.testing.assert_array_equal(pad(x, margin, axis), wanted)
        assert_agreed(lambda a, pad=pad: pad(a, margin, axis), x, tolerance=0)
    widths = [(5 * margin, 5 * margin) if k == x.ndim + axis else (0, 0) for k in range(x.ndim)]
    np.testing.assert_array_equal(pad_mirror(x, 5 * margin, axis), np.pad(x, widths, mode="reflect"))
    assert_agreed(lambda a: box_mean(a, margin), x)
    assert_agreed(lambda a: interleave(a, 2 * a, axis), x)


@pytest.mark.parametrize("image", [np.arange(6, dtype=np.uint16), torch.arange(6.0)])
def test_kinds_are_kept(image: Array) -> None:
    """An array becomes one of the other's kind and keeps its own dtype."""
    found = of_kind(np.ones(2, np.float32), image)
    assert type(found) is type(image) and to_numpy(found).dtype == np.float32


def test_gradients_reach_the_samples() -> None:
    """Tensors keep their gradients on the whole way, finite also where samples clip."""
    data = torch.tensor(frame("color", (2, 34, 30)).data, requires_grad=True)
    stokes, _ = fit_stokes_unclipped(demosaic_guided_half(Mosaic(data, Layout(), 0.0, 1.0)))
    (polarized_intensity(stokes) + dolp(stokes) + stokes.s0).sum().backward()
    assert data.grad is not None and bool(torch.isfinite(data.grad).all()) and float(data.grad.abs().min()) > 0


def test_nothing_of_it_needs_torch() -> None:
    """Reading, checking, calibrating, demosaicking and finding the light, where torch cannot be imported."""
    done = run(WITHOUT_TORCH, "blocked")
    assert done.returncode == 0, done.stderr
