"""Metrics at known points, and beside scikit-image."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from tolerances import assert_within
from torch import Tensor

from polsep.metrics import chroma, highlights, psnr, psnr_unlimited, ssim, worst_mean

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
    with pytest.raises(ValueError, match="found NaN in 0 pixels"):
        score(found, truth, torch.zeros_like(EVERYWHERE))
    found[0, 3, 3] = torch.nan
    with pytest.raises(ValueError, match="found NaN in 2000 pixels"):
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
