"""The thumbnail of a whole frame: of any size, by both twins, and all that a network knows beyond its surroundings."""

from __future__ import annotations

import pytest
import torch
from tolerances import assert_close
from torch.nn.functional import pixel_unshuffle

from polsep.networks.channels import MIN_BRIGHTNESS, PERIOD
from polsep.networks.joint import Joint
from polsep.networks.sizes import ResidualSize
from polsep.networks.thumbnails import SIDE, keep_color, thumbnail_channels
from polsep.networks.whole_frame import make_thumbnail
from polsep.networks.whole_frame_kernel import thumbnail_of
from polsep.physics.stokes import Stokes
from polsep.sensor.camera import IDEAL, Layout, Mosaic, expose

COLOR, MONO = Layout(), Layout(bayer=None)
LIGHT = (1.2, 1.0, 0.8)


def random_mosaic(height: int, width: int, layout: Layout, seed: int = 0) -> Mosaic:
    raw = (4300 * torch.rand(height, width, generator=torch.Generator().manual_seed(seed))).clamp(max=4095)
    return Mosaic(raw.round().to(torch.uint16), layout, 16.0, 4095.0, LIGHT[: layout.channels])


def thumbnail(mosaic: Mosaic) -> torch.Tensor:
    planes, masks = (pixel_unshuffle(x[None, None].float(), PERIOD) for x in (mosaic.linear(), mosaic.clipped()))
    return make_thumbnail(planes, masks, mosaic.layout)


@pytest.mark.parametrize("layout", [COLOR, MONO], ids=lambda layout: layout.spec)
@pytest.mark.parametrize("size", [(512, 512), (96, 128), (260, 1000), (8, 4)])
def test_kernel_and_twin_agree(layout: Layout, size: tuple[int, int]) -> None:
    """Also on frames with fewer packed pixels than a thumbnail has cells."""
    mosaic = random_mosaic(*size, layout)
    levels = (mosaic.black_level, mosaic.white_level)
    found = thumbnail_of(mosaic.data.numpy(), layout, levels, mosaic.light_color)
    assert found.shape == (1, thumbnail_channels(layout.channels), SIDE, SIDE)
    assert_close(torch.from_numpy(found), thumbnail(mosaic), scale=10)


@pytest.mark.parametrize("layout", [COLOR, MONO], ids=lambda layout: layout.spec)
def test_even_light_is_found_exactly(layout: Layout) -> None:
    """s0, s1, s2 of an even field are in every cell, and so are its maxima."""
    c = layout.channels
    s0 = torch.tensor([0.5, 0.8, 0.3])[:c, None, None].expand(c, 64, 64)
    light = Stokes(s0, 0.3 * s0, -0.4 * s0)
    found = thumbnail(expose(light, layout, IDEAL))[0]
    means = torch.cat([light.s0, light.s1, light.s2, light.s0, 0.5 * light.s0])[:, :1, :1]
    brightness = float(s0.mean()) + MIN_BRIGHTNESS
    assert_close(found[:-2], torch.asinh(means / brightness).expand(-1, SIDE, SIDE))
    assert_close(found[-2], torch.zeros(SIDE, SIDE))
    assert_close(found[-1], torch.full((SIDE, SIDE), brightness).log())


@pytest.mark.parametrize("color", [0, 1, 2])
def test_one_color_of_a_thumbnail_is_that_of_a_sensor_without_filters(color: int) -> None:
    """Where light is even over a packed pixel: there both sensors see the same."""
    light = (
        torch.rand(3, 3, 16, 16, generator=torch.Generator().manual_seed(5))
        + torch.tensor([1.0, 0, 0])[:, None, None, None]
    )
    s0, s1, s2 = (0.3 * x.repeat_interleave(PERIOD, -2).repeat_interleave(PERIOD, -1) for x in light.unbind(1))
    colored = thumbnail(expose(Stokes(s0, s1, s2), COLOR, IDEAL))
    own = slice(color, color + 1)
    assert_close(
        keep_color(colored, color), thumbnail(expose(Stokes(s0[own], s1[own], s2[own]), MONO, IDEAL)), scale=10
    )


def test_a_crop_with_its_frames_thumbnail_is_the_frames_crop() -> None:
    """Away from the border; with its own thumbnail it differs."""
    torch.manual_seed(3)
    net = Joint(3, ResidualSize(8, (0, 1)), sees_frame=True).eval()
    assert net.whole_frame is not None
    for layer in (net.whole_frame.change, net.corrections):
        torch.nn.init.normal_(layer.weight, std=0.3)
    mosaic = random_mosaic(192, 192, COLOR)
    raw, clipped = mosaic.linear()[None, None], mosaic.clipped()[None, None]
    inside = (..., slice(32, 160), slice(32, 160))
    with torch.no_grad():
        whole = net.half_resolution(raw, clipped).diffuse[..., 40:56, 40:56]
        crop = net.half_resolution(raw[inside], clipped[inside], net.thumbnail(raw, clipped)).diffuse
        alone = net.half_resolution(raw[inside], clipped[inside]).diffuse
    assert_close(crop[..., 24:40, 24:40], whole, scale=10)
    assert float((alone[..., 24:40, 24:40] - whole).abs().max()) > 1e-3
