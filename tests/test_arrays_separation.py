"""The closed forms and the report give the same of NumPy arrays as of torch tensors."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from test_kernels_color_affine import random_frame
from torch.nn import functional

from polsep.compute.arrays import to_numpy
from polsep.compute.resizing import block_means, halve, resize_area, resize_bilinear
from polsep.demosaic.bilinear import demosaic_bilinear_half
from polsep.demosaic.guided import demosaic_guided, demosaic_guided_half
from polsep.physics.stokes import Measurements
from polsep.sensor.camera import IMX250, Layout
from polsep.separation.analytic import Separation, separate_analytic, separate_analytic_unclipped
from polsep.separation.color_affine import separate_color_affine
from polsep.separation.colored_specular import color_specular
from polsep.separation.multi_capture import separate_ding2021, separate_extremes
from polsep.separation.report import describe, images_of, in_light, under_white_light

#: Of white: rounding in another order, and where clipping leaves equations that amplify it.
ROUNDING, SOLVED = 1e-6, 1e-4
DEMOSAICKERS = (demosaic_bilinear_half, demosaic_guided_half, demosaic_guided)
LIGHT = (0.6, 1.0, 0.8)
MONO = Layout(bayer=None)


def as_numpy(seen: Measurements | None) -> Measurements | None:
    """The same measurements in NumPy's arrays."""
    if seen is None:
        return None
    arrays = {name: to_numpy(x) for name, x in vars(seen).items() if isinstance(x, torch.Tensor)}
    return replace(seen, uniform=as_numpy(seen.uniform), **arrays)


def assert_same(found: Separation, expected: Separation, solved: float = ROUNDING) -> None:
    """NumPy's arrays of the tensors' dtypes and values; ``solved`` bounds single differences."""
    for name, image in _images(found).items():
        twin = to_numpy(_images(expected)[name])
        assert isinstance(image, np.ndarray) and image.dtype == twin.dtype, name
        np.testing.assert_allclose(image, twin, rtol=0, atol=solved * max(1, twin.max()), err_msg=name)
        assert np.median(np.abs(image * 1.0 - twin)) <= ROUNDING, name


def _images(separation: Separation) -> dict[str, Any]:
    images = {**vars(separation), **vars(separation.stokes)}
    return {name: x for name, x in images.items() if hasattr(x, "dtype")}


@pytest.mark.parametrize("brightness", [0.5, 1.8, 5.0], ids=["unclipped", "clipped", "mostly clipped"])
@pytest.mark.parametrize("layout", [Layout(), Layout(origin=(1, 0)), MONO], ids=["color", "odd origin", "mono"])
@pytest.mark.parametrize("demosaic", DEMOSAICKERS)
def test_closed_forms_agree(demosaic: Any, layout: Layout, brightness: float, generator: torch.Generator) -> None:
    """Where samples clip, colour-affine separation solves equations that amplify rounding, to 4e-5 of white."""
    seen = demosaic(random_frame((91, 74), layout, IMX250, brightness, generator))
    arrays = as_numpy(seen)
    assert arrays is not None
    for separate in (separate_analytic, separate_analytic_unclipped, separate_extremes):
        assert_same(separate(arrays), separate(seen))
    assert_same(separate_ding2021(arrays, arrays), separate_ding2021(seen, seen))
    solved = ROUNDING if seen.clipped is None else SOLVED
    assert_same(separate_color_affine(arrays), separate_color_affine(seen), solved)


@pytest.mark.parametrize("brightness", [0.5, 1.8])
def test_batches_are_separated_one_by_one(brightness: float, generator: torch.Generator) -> None:
    frames = [random_frame((44, 52), Layout(), IMX250, brightness, generator) for _ in range(2)]
    mosaic = replace(frames[0], data=torch.stack([frame.data for frame in frames]).numpy())
    both = separate_color_affine(demosaic_guided_half(mosaic))
    for k, frame in enumerate(frames):
        alone = separate_color_affine(demosaic_guided_half(frame))
        np.testing.assert_allclose(both.specular[k], alone.specular.numpy(), rtol=0, atol=SOLVED)
        np.testing.assert_array_equal(both.valid[k], alone.valid.numpy())


@pytest.mark.parametrize("layout", [Layout(), MONO], ids=["color", "mono"])
def test_reports_agree(layout: Layout, generator: torch.Generator) -> None:
    """Images, statistics and coloured highlights of one frame, from samples with the light divided out."""
    light = LIGHT if layout.channels == 3 else LIGHT[:1]
    mosaic = random_frame((96, 84), layout, IMX250, 1.2, generator)
    seen = demosaic_guided_half(mosaic)
    found = []
    for samples, raw in ((as_numpy(seen), replace(mosaic, data=mosaic.data.numpy())), (seen, mosaic)):
        assert samples is not None
        white = separate_color_affine(under_white_light(samples, light))  # type: ignore[arg-type]
        found.append(color_specular(images_of(white, in_light(white, light)), raw, light))
    (images, colored), (expected, twin) = found
    for name, image in images.arrays().items():
        other = expected.arrays()[name]
        assert image.dtype == other.dtype and image.flags.c_contiguous == other.flags.c_contiguous
        np.testing.assert_allclose(image, other, rtol=0, atol=SOLVED if name != "aolp" else 1e-2)
    np.testing.assert_allclose(colored, twin, rtol=0, atol=ROUNDING)
    assert images.tally is not None and expected.tally is not None
    for name, value in describe(images.tally, False)["statistics"].items():
        assert value == pytest.approx(describe(expected.tally, False)["statistics"][name], rel=1e-5), name


@pytest.mark.parametrize("shape", [(8, 12), (7, 13), (1, 5), (1, 1)])
def test_resizing_is_torchs(shape: tuple[int, int], generator: torch.Generator) -> None:
    """Pooling with a rest at the border, bilinear interpolation and areas, of both kinds of arrays."""
    x = torch.rand(2, 3, *shape, generator=generator)
    larger, smaller = (2 * shape[0] - 1, 2 * shape[1] + 1), (-(-shape[0] // 2), -(-shape[1] // 3))
    for found, expected in (
        (halve, functional.avg_pool2d(x, 2, ceil_mode=True)),
        (lambda x: resize_bilinear(x, larger), functional.interpolate(x, larger, mode="bilinear")),
        (lambda x: resize_area(x, smaller), functional.interpolate(x, smaller, mode="area")),
        (lambda x: block_means(x, min(shape)), functional.avg_pool2d(x, min(shape))),
    ):
        torch.testing.assert_close(found(x), expected, rtol=0, atol=ROUNDING)
        assert found(x.numpy()).dtype == np.float32
        np.testing.assert_allclose(found(x.numpy()), expected.numpy(), rtol=0, atol=ROUNDING)
