"""Details of cells: Haar's transform, what smooth images have of them, and what is believed of the others."""

from __future__ import annotations

import torch
from tolerances import assert_close, assert_within
from torch import Tensor
from torch.nn.functional import avg_pool2d, pixel_unshuffle

from polsep.networks.details import Details, interpolating_filter, join_cells, split_cells

COLORS, WIDTH = 3, 5


def random_images(channels: int, height: int = 24, width: int = 32) -> Tensor:
    return torch.rand(2, channels, height, width, generator=torch.Generator().manual_seed(channels))


def look(details: Details, images: Tensor) -> Tensor:
    """Full resolution from the cells' means of ``images``, diffuse colours and specular, and from their true sum."""
    n, _, height, width = images.shape
    total = pixel_unshuffle(images[:, :-1] + images[:, -1:], 4)
    features, light = torch.rand(n, WIDTH, height // 4, width // 4), torch.ones(n, 1, height // 4, width // 4)
    found: Tensor = details(avg_pool2d(images, 2), total, features, light)
    return found.detach()


def smooth_images(details: Details, images: Tensor) -> Tensor:
    """What is guessed from the means of cells."""
    means = avg_pool2d(images, 2).split(1, dim=1)
    return torch.cat([join_cells(mean, details.smooth_details(mean).detach()) for mean in means], dim=1)


def test_cells_are_split_and_joined() -> None:
    image = random_images(1)
    cells = split_cells(image)
    assert cells.shape == (2, 4, 12, 16)
    assert_close(cells[:, :1], avg_pool2d(image, 2))
    assert_close(join_cells(cells[:, :1], cells[:, 1:]), image)


def test_details_are_left_less_right_top_less_bottom_and_diagonal() -> None:
    for k, pixels in enumerate(([[1.0, -1.0], [1.0, -1.0]], [[1.0, 1.0], [-1.0, -1.0]], [[1.0, -1.0], [-1.0, 1.0]])):
        wanted = torch.zeros(4)
        wanted[k + 1] = 1
        assert_close(split_cells(torch.tensor(pixels)[None, None])[0, :, 0, 0], wanted)


def test_ramps_are_guessed_from_their_means() -> None:
    """Cubic convolution keeps what is linear; uniform images have no details."""
    y, x = torch.meshgrid(torch.arange(24.0), torch.arange(32.0), indexing="ij")
    ramp = (0.3 + 0.02 * x - 0.01 * y)[None, None]
    cells = split_cells(ramp)
    found = Details(COLORS, WIDTH).smooth_details(cells[:, :1]).detach()
    assert_close(found[..., 2:-2, 2:-2], cells[:, 1:, 2:-2, 2:-2])
    assert_close(interpolating_filter().sum(dim=(-1, -2)), torch.zeros(3, 1))


def test_at_first_the_images_sum_to_what_was_demosaicked() -> None:
    """All that the sum has beyond a smooth image is the diffuse light's."""
    images, details = random_images(COLORS + 1), Details(COLORS, WIDTH)
    found = look(details, images)
    assert_close(found[:, :-1] + found[:, -1:], images[:, :-1] + images[:, -1:])
    assert_close(found[:, -1:], smooth_images(details, images[:, -1:]))


def test_what_is_not_believed_is_gone() -> None:
    """Images are smooth then, and have the same means."""
    images, details = random_images(COLORS + 1), Details(COLORS, WIDTH)
    torch.nn.init.zeros_(details.belief[-1].bias)  # type: ignore[arg-type, union-attr]
    found = look(details, images)
    assert_close(avg_pool2d(found, 2), avg_pool2d(images, 2))
    assert_close(found, smooth_images(details, images))


def test_details_of_white_light_are_the_specular_images() -> None:
    """Where only the specular light varies, and all of it is believed to be that."""
    images, details = random_images(COLORS + 1), Details(COLORS, WIDTH)
    images[:, :-1] = 0.5
    last = details.belief[-1]
    torch.nn.init.zeros_(last.bias[:12])  # type: ignore[arg-type, union-attr]
    torch.nn.init.ones_(last.bias[12:])  # type: ignore[arg-type, union-attr]
    assert_close(look(details, images), images)


def test_exposure_scales_details() -> None:
    """Beliefs depend on details relative to the light around, so they stay as they are; so do corrections."""
    torch.manual_seed(0)
    details, images = Details(COLORS, WIDTH), random_images(COLORS + 1)
    for layer in (details.belief[-1], details.change):
        torch.nn.init.normal_(layer.weight, std=0.1)  # type: ignore[arg-type, union-attr]
    total = pixel_unshuffle(images[:, :-1] + images[:, -1:], 4)
    features, light = torch.rand(2, WIDTH, 6, 8), 0.5 + torch.rand(2, 1, 6, 8)
    half = avg_pool2d(images, 2)
    with torch.no_grad():
        one, other = details(half, total, features, light), details(3 * half, 3 * total, features, 3 * light)
        assert_within(other, 3 * one, 1e-5)
        assert float((one - smooth_images(details, images)).abs().max()) > 0.01
