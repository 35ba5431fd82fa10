"""Diffuse light under highlights in exported graphs: what `under_highlights` makes, in batches, or nothing."""

from __future__ import annotations

import numpy as np
import numpy.testing as npt
import pytest
import torch
from numpy.typing import NDArray

from polsep.networks.fill import fill_holes
from polsep.sensor.camera import CLIP_MARGIN, Layout, Mosaic
from polsep.separation.images import FrameImages
from polsep.separation.under_highlights import fill_under_highlights

WHITE = 4095.0
#: Where CG ends: a graph adds up in another order, so it may end a step earlier or later.
ROUNDED = 5e-4


def frame(seed: int, layout: Layout, scale: int) -> tuple[NDArray[np.uint16], FrameImages]:
    """A dark frame with round clipped highlights, some at its border, and images that are wrong by 0.2 under them."""
    generator, (height, width) = np.random.default_rng(seed), (96, 128)
    data = generator.integers(80, 200, (height, width)).astype(np.uint16)
    rows, cols = np.mgrid[:height, :width]
    for _ in range(5):
        y, x, r = generator.integers(0, height), generator.integers(0, width), generator.integers(1, 7)
        inside = np.hypot(rows - y, cols - x) < r
        share = generator.uniform(0, 1, (2, 2))
        share[generator.integers(0, 2), generator.integers(0, 2)] = 1
        lit = (4095 * np.tile(share, (height // 2, width // 2))).astype(np.uint16)
        data = np.where(inside, np.maximum(data, lit), data)
    colors = 1 if layout.bayer is None else 3
    size = (height * scale // 2, width * scale // 2)
    y, x = np.mgrid[: size[0], : size[1]] / size[0]
    truth = 0.3 + 0.2 * np.stack([np.sin(3 * y + c) * np.cos(2 * x + c) for c in range(colors)], -1)
    truth += generator.normal(0, 0.003, truth.shape)
    clipped = (data >= 4000).reshape(height // 2, 2, width // 2, 2).any((1, 3)).repeat(scale, 0).repeat(scale, 1)
    diffuse = np.where(clipped[..., None], truth + 0.2, truth).astype(np.float32)
    error = np.where(clipped, 0.15, 0.004)[..., None] * np.ones(2)
    return data, FrameImages(diffuse, np.zeros_like(diffuse), ~clipped, error=error.astype(np.float32))


@pytest.mark.parametrize("scale", [1, 2])
@pytest.mark.parametrize("name", ["color", "mono"])
def test_holes_are_filled_as_the_kernels_fill_them(name: str, scale: int) -> None:
    """Each of a batch of frames; the third one clips all over, the fourth nowhere: both stay."""
    layout = Layout.parse(name)
    light = (1.0,) if name == "mono" else (0.5, 1.0, 0.7)
    gains = np.array([[light[min(layout.filter_at(r, c).channel, len(light) - 1)] for c in range(4)] for r in range(4)])
    frames = [frame(seed, layout, scale) for seed in range(4)]
    frames[2][0][:], frames[3][0][:] = 4095, frames[3][0].clip(max=3000)
    raw = torch.from_numpy(np.stack([data for data, _ in frames]).astype(np.float32) / WHITE)[:, None]
    clipped = raw >= 1 - CLIP_MARGIN
    samples = raw / torch.from_numpy(np.tile(gains, (24, 32))).float()
    images = [torch.from_numpy(np.stack([x.diffuse for _, x in frames])), torch.zeros(0)]
    images[1] = torch.from_numpy(np.stack([x.error[..., 0] for _, x in frames if x.error is not None]))
    channels = [int(min(layout.filter_at(r, c).channel, len(light) - 1)) for r in (0, 2) for c in (0, 2)]
    diffuse, error = fill_holes((images[0], images[1]), samples, clipped, channels, scale)
    shares = []
    for k, (data, own) in enumerate(frames):
        assert own.error is not None
        colored = FrameImages(
            own.diffuse * np.float32(light), own.specular, own.valid, error=own.error * np.float32(np.mean(light))
        )
        wanted, share = fill_under_highlights(colored, Mosaic(data, layout, 0.0, WHITE), light)
        assert wanted.error is not None
        npt.assert_allclose(diffuse[k].numpy(), wanted.diffuse / np.float32(light), rtol=0, atol=ROUNDED)
        npt.assert_allclose(error[k].numpy(), wanted.error[..., 0] / np.mean(light), rtol=2e-3, atol=1e-6)
        shares.append(share)
    assert min(shares[:2]) > 0.003 and shares[2:] == [0, 0]
    assert torch.equal(diffuse[2:], images[0][2:]) and torch.equal(error[2:], images[1][2:])
