"""Metrics at known points, and beside scikit-image."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from tolerances import SIGMAS, assert_close, assert_within
from torch import Tensor

from polsep.metrics import chroma, flip, highlights, psnr, psnr_unlimited, reliability, require_flip, ssim, worst_mean
from polsep.physics.srgb import srgb

EVERYWHERE = torch.ones(40, 50, dtype=torch.bool)


def pair(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    truth = torch.rand(3, 40, 50, generator=generator)
    return (truth + 0.1 * torch.randn(3, 40, 50, generator=generator)).clamp(0, 1), truth


def test_psnr_is_that_of_scikit_image() -> None:
    found, truth = pair()
    expected = peak_signal_noise_ratio(truth.numpy(), found.numpy(), data_range=1)
    assert psnr(found, truth, EVERYWHERE) == pytest.approx(expected, abs=1e-4)


def test_ssim_is_that_of_scikit_image() -> None:
    """With a Gaussian window; scikit-image averages over the same pixels, those whose window fits."""
    found, truth = (x.double().numpy() for x in pair(1))
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    expected = np.mean([structural_similarity(t, f, **options) for t, f in zip(truth, found, strict=True)])
    assert ssim(torch.from_numpy(found), torch.from_numpy(truth), EVERYWHERE) == pytest.approx(expected, abs=1e-6)


def test_limits_hide_what_lies_above_white() -> None:
    found, truth = torch.full((3, 40, 50), 1.5), torch.full((3, 40, 50), 2.0)
    assert psnr(found, truth, EVERYWHERE) == 120
    assert psnr_unlimited(found, truth, EVERYWHERE) == pytest.approx(6.0206, abs=1e-4)
    assert ssim(found, truth, EVERYWHERE) == pytest.approx(1)


def test_only_the_mask_counts() -> None:
    found, truth = pair(2)
    mask = torch.zeros_like(EVERYWHERE)
    mask[10:20, 10:30] = True
    spoilt = torch.where(mask, found, torch.zeros(()))
    assert psnr(spoilt, truth, mask) == psnr(found, truth, mask)


def test_masks_without_windows_are_refused() -> None:
    mask = torch.zeros_like(EVERYWHERE)
    mask[:3] = True
    with pytest.raises(ValueError, match="reaches 5 pixels inside"):
        ssim(*pair(), mask)


@pytest.mark.parametrize("score", [psnr, psnr_unlimited])
def test_nothing_and_no_numbers_have_no_score(score: Callable[[Tensor, Tensor, Tensor], float]) -> None:
    """Neither an empty mask nor NaN may pass for a perfect image."""
    found, truth = pair()
    with pytest.raises(ValueError, match="found an empty one"):
        score(found, truth, torch.zeros_like(EVERYWHERE))
    found[0, 3, 3] = torch.nan
    with pytest.raises(ValueError, match="found NaN in 1 pixels"):
        score(found, truth, EVERYWHERE)


@pytest.mark.parametrize("score", [ssim, flip])
def test_scores_of_windows_refuse_what_is_no_number(score: Callable[[Tensor, Tensor, Tensor], float]) -> None:
    if score is flip:
        pytest.importorskip("flip_evaluator")
    found, truth = pair()
    found[0, 20, 20] = torch.nan
    with pytest.raises(ValueError, match="expected numbers inside a mask, found NaN"):
        score(found, truth, EVERYWHERE)


def test_highlights_and_their_chroma() -> None:
    specular = torch.zeros(3, 40, 50)
    specular[:, 5:10, 5:10] = torch.tensor([0.5, 0.4, 0.3]).view(3, 1, 1)
    inside = highlights(specular, EVERYWHERE)
    assert int(inside.sum()) == 25
    assert chroma(specular, inside) == pytest.approx(0.5)
    assert_within(torch.tensor(chroma(torch.full((3, 40, 50), 0.7), EVERYWHERE)), 0.0, 1e-5)
    assert chroma(specular, torch.zeros_like(EVERYWHERE)) == 0


def test_the_worst_are_a_tenth_and_at_least_one() -> None:
    assert worst_mean([3.0, 1.0, 2.0]) == 1
    assert worst_mean([float(k) for k in range(20)]) == 0.5


def test_flip_is_zero_for_equal_images_and_grows() -> None:
    pytest.importorskip("flip_evaluator", reason="FLIP needs the extra 'bench'")
    _, truth = pair(3)
    noise = torch.randn(truth.shape, generator=torch.Generator().manual_seed(4))
    assert flip(truth, truth, EVERYWHERE) == 0
    scores = [flip(truth + size * noise, truth, EVERYWHERE) for size in (0.01, 0.05, 0.2)]
    assert 0 < scores[0] < scores[1] < scores[2] < 1


def test_flip_is_that_of_images_shown_in_srgb() -> None:
    """The library's own value for the encoded images, which count as limited, inside the mask alone."""
    pytest.importorskip("flip_evaluator", reason="FLIP needs the extra 'bench'")
    found, truth = pair(5)
    shown = [srgb(x.permute(1, 2, 0).numpy()).astype(np.float32) for x in (truth, found)]
    errors, _, _ = require_flip().evaluate(*shown, "LDR", applyMagma=False, computeMeanError=False)
    mask = torch.zeros_like(EVERYWHERE)
    mask[4:30, 7:33] = True
    assert flip(torch.where(found == 1, 1.5, found), truth, mask) == pytest.approx(errors[4:30, 7:33].mean(), abs=1e-5)


def test_scores_in_a_mask_are_those_of_the_whole_frame() -> None:
    """What lies farther away than windows and filters reach is not looked at, and makes no difference."""
    pytest.importorskip("flip_evaluator", reason="FLIP needs the extra 'bench'")
    truth = torch.rand(3, 120, 130, generator=torch.Generator().manual_seed(7))
    found = truth + 0.2 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(8))
    mask = torch.zeros(120, 130, dtype=torch.bool)
    mask[50:70, 60:66] = True
    corner = mask.clone()
    corner[0, 0] = corner[-1, -1] = True
    images = (x.clamp(0, 1).permute(1, 2, 0).contiguous().numpy() for x in (truth, found))
    errors, _, _ = require_flip().evaluate(*images, "LDR", inputsRGB=False, applyMagma=False, computeMeanError=False)
    assert flip(found, truth, mask) == pytest.approx(errors[50:70, 60:66].mean(), abs=1e-6)
    assert flip(found, truth, corner) == pytest.approx(errors[..., 0][corner.numpy()].mean(), abs=1e-6)
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0, "full": True}
    limited = [x.clamp(0, 1).double().numpy() for x in (truth, found)]
    maps = [structural_similarity(t, f, **options)[1] for t, f in zip(*limited, strict=True)]
    assert ssim(found, truth, mask) == pytest.approx(np.mean(maps, axis=0)[mask.numpy()].mean(), abs=1e-6)


def test_flip_sees_grey_images_too() -> None:
    pytest.importorskip("flip_evaluator", reason="FLIP needs the extra 'bench'")
    found, truth = (x[:1] for x in pair(6))
    assert flip(found, truth, EVERYWHERE) == flip(found.expand(3, -1, -1), truth.expand(3, -1, -1), EVERYWHERE)
    with pytest.raises(ValueError, match="found an empty one"):
        flip(found, truth, torch.zeros_like(EVERYWHERE))


def test_flip_names_the_extra_that_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.raises(ValueError, match=r"expected the extra bench .*, found no flip_evaluator"):
        flip(*pair(), EVERYWHERE)


def drawn_errors(colors: int = 3) -> tuple[Tensor, Tensor]:
    """Gaussian errors ``[C, 160, 200]`` and their true standard deviations ``[160, 200]``, over two decades."""
    generator = torch.Generator().manual_seed(9)
    sigma = 10 ** (-3 + 2 * torch.rand(160, 200, generator=generator))
    return sigma * torch.randn(colors, 160, 200, generator=generator), sigma


@pytest.mark.parametrize("colors", [1, 3])
@pytest.mark.parametrize("bins", [1, 16])
def test_expected_errors_that_are_the_true_ones_are_reliable(colors: int, bins: int) -> None:
    """Bin by bin within the statistics of that many samples, however wide the bins are."""
    error, sigma = drawn_errors(colors)
    everywhere = torch.ones_like(sigma, dtype=torch.bool)
    curve = reliability(error, sigma, everywhere, bins)
    assert curve.expected.shape == curve.found.shape == (bins,)
    assert bool((curve.expected.diff() > 0).all())
    groups = sigma.flatten().sort().values.double().view(bins, -1)
    assert_close(curve.expected, groups.square().mean(dim=1).sqrt())
    # The variance of a mean of squares of normal errors: twice the sum of fourth powers of their deviations.
    spread = (2 * (groups**4).sum(dim=1) / colors).sqrt() / (groups**2).sum(dim=1)
    assert bool(((curve.found / curve.expected).square() - 1 < SIGMAS * spread).all())
    assert bool((1 - (curve.found / curve.expected).square() < SIGMAS * spread).all())
    assert 0 <= curve.miss < SIGMAS * float(spread.max()) / (2 * math.log(2))


@pytest.mark.parametrize("factor", [0.5, 2.0, 4.0])
def test_expected_errors_miss_by_octaves(factor: float) -> None:
    """An expectation that is wrong by a factor everywhere misses by its logarithm, in either direction."""
    error, sigma = drawn_errors()
    everywhere = torch.ones_like(sigma, dtype=torch.bool)
    right, wrong = (reliability(error, k * sigma, everywhere, 8) for k in (1.0, factor))
    assert_close(wrong.found, right.found)
    assert_close(wrong.expected, factor * right.expected)
    assert_within(wrong.miss, abs(math.log2(factor)), right.miss + 1e-6)


def test_expectations_that_know_nothing_are_not_reliable() -> None:
    """Right on average, large where errors are small: one bin is content with that, many find out."""
    error, sigma = drawn_errors()
    everywhere = torch.ones_like(sigma, dtype=torch.bool)
    upside_down = 1e-4 / sigma
    assert reliability(error, upside_down, everywhere, 1).miss < 0.1
    assert reliability(error, upside_down, everywhere, 16).miss > 2


def test_reliability_counts_the_mask_alone_and_needs_numbers() -> None:
    error, sigma = drawn_errors()
    mask = torch.zeros_like(sigma, dtype=torch.bool)
    mask[10:20, 30:51] = True
    spoilt = [torch.where(mask, x, torch.nan) for x in (error, sigma)]
    one = reliability(error[:, 10:20, 30:51], sigma[10:20, 30:51], mask[10:20, 30:51], 4)
    other = reliability(*spoilt, mask, 4)
    assert torch.equal(one.found, other.found) and one.miss == other.miss
    with pytest.raises(ValueError, match="expected finite errors and deviations of 0 or more, found others in 31790"):
        reliability(*spoilt, torch.ones_like(mask), 4)
    with pytest.raises(ValueError, match="found others in 210 pixels"):
        reliability(error, -sigma, mask, 4)
    for bins, expected in ((0, "at least 1 pixels for 0 bins"), (211, "at least 211 pixels for 211 bins, found 210")):
        with pytest.raises(ValueError, match=expected):
            reliability(error, sigma, mask, bins)


def test_errors_of_zero_are_finite() -> None:
    """Nothing expected and nothing found is no miss, and a bin without error misses by a number."""
    nothing, mask = torch.zeros(3, 4, 4), torch.ones(4, 4, dtype=torch.bool)
    assert reliability(nothing, nothing[0], mask, 2).miss == 0
    assert reliability(nothing, torch.full((4, 4), 2e-6), mask, 2).miss == pytest.approx(1)
