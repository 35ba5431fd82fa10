"""The joint network as a function: its linear filter, closed form, resolutions, borders, and what it explains."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest
import torch
from tolerances import assert_close, assert_finite, assert_within
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, pad, pixel_shuffle, pixel_unshuffle

from polsep.demosaic.bilinear import demosaic_bilinear, demosaic_bilinear_half
from polsep.demosaic.guided import demosaic_guided_half
from polsep.networks.joint import (
    INPUTS,
    MAX_LOG_VARIANCE,
    PERIOD,
    Demosaicker,
    Joint,
    JointOutput,
    Polarization,
    bilinear_filter,
    find_moments,
    fit_diffuse_polarization,
    limit,
    pool_outputs,
    predict_samples,
)
from polsep.networks.sizes import ResidualSize
from polsep.physics.stokes import Stokes, fit_stokes, measure
from polsep.sensor.camera import CLIP_MARGIN, IDEAL, Layout, Mosaic, expose, sample_mosaic
from polsep.separation.closed_form import MAX_DIFFUSE_DOLP, white_specular
from polsep.train.joint_task import MARGIN

COLOR, MONO = Layout(), Layout(bayer=None)
LAYOUTS = [COLOR, MONO]
SIZE = ResidualSize(4, (1, 1))
#: Raw pixels from the border that depend on how frames are continued there: one packed pixel.
EDGE = 4
#: How far a uniform field's slope falls toward 0, and with it the separation: (trust / contrast)^2 of the colours.
TRUSTED = 1e-4
#: The same where specular light is twice the diffuse, so that colours differ by a tenth of the brightness only.
DRAWN = 0.08
#: What the floor under the brightness changes when the exposure of a bright frame is halved.
FLOORED = 5e-3
#: What bf16 changes in corrections of order one.
ROUNDED = 0.05


def spec(layout: Layout) -> str:
    return layout.spec


def untrained(layout: Layout) -> Joint:
    torch.manual_seed(0)
    return Joint(layout.channels, SIZE)


def random_net(layout: Layout, inputs: tuple[str, ...] = INPUTS) -> Joint:
    """A net whose every layer does something, as after training."""
    torch.manual_seed(3)
    net = Joint(layout.channels, SIZE, inputs)
    for name, weight in net.named_parameters():
        if name.endswith("weight"):
            torch.nn.init.normal_(weight, std=0.5 / weight[0].numel() ** 0.5)
    return net.eval()


def nothing_clipped(raw: Tensor) -> Tensor:
    return torch.zeros_like(raw, dtype=torch.bool)


def random_raw(count: int, height: int, width: int) -> Tensor:
    """Samples between 0.1 and 0.9 that no interpolation can guess."""
    generator = torch.Generator().manual_seed(height * width)
    return 0.1 + 0.8 * torch.rand(count, 1, height, width, generator=generator)


def as_mosaic(raw: Tensor, layout: Layout) -> Mosaic:
    return Mosaic(raw[:, 0], layout, 0.0, 1.0)


def crop(image: Tensor, edge: int) -> Tensor:
    return image[..., edge:-edge, edge:-edge]


def scene(layout: Layout, height: int, width: int) -> tuple[JointOutput, Polarization, Stokes]:
    """Random diffuse and specular light, slopes and directions of every packed pixel, and their Stokes images."""
    generator, c = torch.Generator().manual_seed(1), layout.channels
    diffuse, specular = (torch.rand(2, n, height, width, generator=generator) for n in (c, 1))
    slope = 0.3 * torch.rand(2, 2, height // PERIOD, width // PERIOD, generator=generator) - 0.15
    turn = 7 * torch.rand(2, 1, height // PERIOD, width // PERIOD, generator=generator)
    direction = torch.cat([torch.cos(turn), torch.sin(turn)], dim=1)
    a, e = (x.repeat_interleave(PERIOD, dim=-1).repeat_interleave(PERIOD, dim=-2) for x in (slope, direction))
    light = Stokes(diffuse + specular, *(a[:, k : k + 1] * diffuse + e[:, k : k + 1] * specular for k in (0, 1)))
    nothing = torch.zeros(2, 1, 1, 1)
    return JointOutput(diffuse, specular, *[nothing] * 6), Polarization(slope, direction), light


@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
def test_the_linear_filter_is_bilinear_demosaicking(layout: Layout) -> None:
    """s0 at full, s0, s1 and s2 at half resolution; diffuse and specular of an untrained network sum to that s0."""
    raw = random_raw(2, 24, 32)
    net = untrained(layout)
    full, half = (
        fit_stokes(demosaic(as_mosaic(raw, layout))) for demosaic in (demosaic_bilinear, demosaic_bilinear_half)
    )
    images, _ = net(raw, nothing_clipped(raw))
    assert_close(crop(images.diffuse + images.specular, EDGE), crop(full.s0, EDGE))
    found = net.half_resolution(raw, nothing_clipped(raw))
    assert_close(crop(found.diffuse + found.specular, EDGE // 2), crop(half.s0, EDGE // 2))
    assert_close(crop(found.s1, EDGE // 2), crop(half.s1, EDGE // 2))
    assert_close(crop(found.s2, EDGE // 2), crop(half.s2, EDGE // 2))


@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
def test_the_linear_filter_keeps_uniform_fields(layout: Layout) -> None:
    """Its weights add up, over what lies behind every filter, to a Stokes vector of each colour."""
    weight = bilinear_filter(layout).sum(dim=(-1, -2))
    c = layout.channels
    assert weight.shape == (24 * c, 16)
    for color in range(c):
        light = torch.zeros(c, 1, 1)
        light[color] = 1.0
        field = Stokes(light, 0.3 * light, -0.2 * light).map(lambda s: s.expand(-1, 4, 4))
        sums = weight @ pixel_unshuffle(expose(field, layout, IDEAL).data[None], 4).flatten()
        s0, s1, s2 = sums.split((16 * c, 4 * c, 4 * c))
        for found, level, count in ((s0, 1.0, 16), (s1, 0.3, 4), (s2, -0.2, 4)):
            assert_close(found.view(c, count), level * light[:, :, 0].expand(c, count))


@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
def test_a_guided_network_starts_at_guided_demosaicking(layout: Layout) -> None:
    """s0, s1 and s2 at half resolution; at full resolution diffuse and specular sum to what has these means."""
    raw = random_raw(2, 40, 48)
    net = Joint(layout.channels, SIZE, INPUTS, "guided")
    wanted = fit_stokes(demosaic_guided_half(as_mosaic(raw, layout)))
    found, full = net.half_resolution(raw, nothing_clipped(raw)), net(raw, nothing_clipped(raw))[0]
    for total in (found.diffuse + found.specular, avg_pool2d(full.diffuse + full.specular, 2)):
        assert_close(total, wanted.s0)
    assert_close(found.s1, wanted.s1)
    assert_close(found.s2, wanted.s2)


def test_crops_continued_by_less_differ_near_their_border_only() -> None:
    """What training saves: `Joint.margin` cells instead of all that filters reach."""
    raw = random_raw(1, 96, 96)
    net, brief = Joint(3, SIZE, INPUTS, "guided"), Joint(3, SIZE, INPUTS, "guided")
    brief.margin = MARGIN
    one, other = (n.demosaicked(pixel_unshuffle(raw, 4), full=False)[0] for n in (net, brief))
    assert_close(one[..., 10:-10, 10:-10], other[..., 10:-10, 10:-10])
    assert float((one - other).abs().max()) > 0


def test_pooled_weights_give_the_means_of_cells() -> None:
    weight, features = torch.rand(48, 5, 1, 1), torch.rand(2, 5, 3, 4)
    full, half = (conv2d(features, w) for w in (weight, pool_outputs(weight)))
    assert_close(pixel_shuffle(half, 2), avg_pool2d(pixel_shuffle(full, 4), 2))


@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
@pytest.mark.parametrize("make", [untrained, random_net])
def test_half_resolution_is_the_mean_over_cells_of_full(layout: Layout, make: Callable[[Layout], Joint]) -> None:
    raw = random_raw(2, 24, 32)
    clipped = raw > 0.85
    net = make(layout)
    full, half = net(raw, clipped)[0], net.half_resolution(raw, clipped)
    assert full.diffuse.shape == (2, layout.channels, 24, 32)
    assert full.specular.shape == (2, 1, 24, 32)
    assert_close(half.diffuse, avg_pool2d(full.diffuse, 2))
    assert_close(half.specular, avg_pool2d(full.specular, 2))
    for one, other in zip(full[2:], half[2:], strict=True):
        assert_close(one, other)


@pytest.mark.parametrize("angle", [0.0, 0.6, 1.5])
@pytest.mark.parametrize("exposure", [1.0, 0.25])
def test_the_closed_form_is_exact_on_uniform_colour(angle: float, exposure: float) -> None:
    """Diffuse light polarized by a quarter in one direction and specular light wholly in another are told apart."""
    diffuse = exposure * torch.tensor([0.9, 0.06, 0.04]).view(1, 3, 1, 1).expand(1, 3, 32, 32)
    specular = exposure * 0.12 * torch.ones(1, 1, 32, 32)
    a, e = 0.25 * unit(torch.tensor(angle)), unit(torch.tensor(angle + 0.9))
    light = Stokes(diffuse + specular, *(a[k] * diffuse + e[k] * specular for k in (0, 1)))
    raw = expose(light, COLOR, IDEAL).data[:, None]
    net = untrained(COLOR)
    images, polarization = net(raw, raw >= 1 - CLIP_MARGIN)
    assert_within(images.diffuse, diffuse, TRUSTED)
    assert_within(images.specular, specular, TRUSTED)
    assert_within(polarization.diffuse[0, :, 3, 3], a, 10 * TRUSTED)
    assert_within(polarization.specular[0, :, 3, 3], e, 10 * TRUSTED)
    half = net.half_resolution(raw, raw >= 1 - CLIP_MARGIN)
    assert_within(half.diffuse, avg_pool2d(diffuse, 2), TRUSTED)


def test_without_colours_unpolarized_diffuse_and_polarized_specular_come_out() -> None:
    """On mono frames and on grey ones, where the slope cannot be known."""
    for layout in LAYOUTS:
        diffuse = torch.full((1, layout.channels, 16, 16), 0.6)
        specular = torch.full((1, 1, 16, 16), 0.2)
        light = Stokes(diffuse + specular, 0.6 * specular.expand_as(diffuse), 0.8 * specular.expand_as(diffuse))
        raw = expose(light, layout, IDEAL).data[:, None]
        images, polarization = untrained(layout)(raw, nothing_clipped(raw))
        assert_within(images.diffuse, diffuse, TRUSTED)
        assert_within(images.specular, specular, TRUSTED)
        assert_within(polarization.diffuse, 0.0, TRUSTED)
        assert_within(polarization.specular[0, :, 2, 2], (0.6, 0.8), TRUSTED)


def unit(phase: Tensor) -> Tensor:
    return torch.stack([torch.cos(phase), torch.sin(phase)])


@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
def test_exposure_scales_the_separation(layout: Layout) -> None:
    """Half the light is half of both images, up to the floor under the brightness."""
    raw = random_raw(1, 32, 32)
    net = untrained(layout)
    one, two = (net.half_resolution(x, nothing_clipped(raw)) for x in (raw, 0.5 * raw))
    assert_within(two.diffuse, 0.5 * one.diffuse, FLOORED)
    assert_within(two.specular, 0.5 * one.specular, FLOORED)
    assert_within(two.local_brightness, 0.5 * one.local_brightness, FLOORED + 1e-3)


@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
def test_white_specular_solves_the_closed_form(layout: Layout) -> None:
    """b = s (e - a) with |e| = 1, for every s, in float32 and with the network's epsilon."""
    generator = torch.Generator().manual_seed(layout.channels)
    s = 2 * torch.rand(1, 1, 8, 8, generator=generator)
    phase = 7 * torch.rand(2, 1, 1, 8, 8, generator=generator)
    a = 0.3 * torch.cat([torch.cos(phase[0]), torch.sin(phase[0])], dim=1)
    b = s * (torch.cat([torch.cos(phase[1]), torch.sin(phase[1])], dim=1) - a)
    found = white_specular((b[:, :1], b[:, 1:]), (a[:, :1], a[:, 1:]), 1e-12)
    assert_close(found, s)


def slopes_of(stokes: tuple[tuple[Tensor, ...], ...], light: Tensor, whole: list[Tensor]) -> list[Tensor]:
    return fit_diffuse_polarization(find_moments(stokes, whole)[:, :3], light)[0]


def test_slopes_are_those_of_polarization_over_colour() -> None:
    """p = a s0 + b with the same a and b in every colour gives a, whatever b; limited to what dielectrics can do."""
    s0 = tuple(torch.full((1, 4, 12, 12), level) for level in (1.8, 0.1, 0.1))
    light, whole = torch.full((1, 1, 12, 12), 2 / 3), [torch.ones(1, 1, 12, 12)] * 3
    for a, b in itertools.product((0.2, -0.1), (0.0, 0.4)):
        moments = find_moments((s0, *(tuple(a * x + b for x in s0) for _ in (1, 2))), whole)
        slopes, contrast = fit_diffuse_polarization(moments[:, :3], light)
        for slope in slopes[1:]:
            assert_within(slope, a, TRUSTED)
        deviations = torch.tensor([1.8, 0.1, 0.1]) - 2 / 3
        assert_within(contrast, float((deviations**2).mean().sqrt()) / (2 / 3), TRUSTED)
    for slope in slopes_of((s0, s0, s0), light, whole):
        assert_close(torch.linalg.vector_norm(slope, dim=1), torch.full((1, 12, 12), MAX_DIFFUSE_DOLP))


def test_colours_that_clip_say_nothing_about_slopes() -> None:
    """Two colours are enough; with fewer the slope is 0, or that of what is around."""
    s0 = tuple(torch.full((1, 4, 12, 12), level) for level in (1.8, 0.1, 0.6))
    light, none, every = torch.ones(1, 1, 12, 12), torch.zeros(1, 1, 12, 12), torch.ones(1, 1, 12, 12)
    wrong = (s0, tuple(0.2 * x for x in s0), tuple(torch.zeros(1, 4, 12, 12) for _ in range(3)))
    wrong[1][2][:] = 9.0
    for whole in ([none] * 3, [none, every, none]):
        assert not bool(slopes_of(wrong, light, whole)[-1].any())
    assert_within(slopes_of(wrong, light, [every, every, none])[-1][:, 0], 0.2, 1e-3)
    here = torch.ones(1, 1, 12, 12)
    here[..., 6, 6] = 0
    right = (s0, tuple(0.2 * x for x in s0), wrong[2])
    right[1][0][..., 6, 6] = right[1][1][..., 6, 6] = 9.0
    assert_within(slopes_of(right, light, [here, here, here])[-1][:, 0], 0.2, 1e-3)


def fit_half(planes: Tensor) -> tuple[Tensor, Tensor]:
    """Offset ``[2, h, w]`` and s0 of each cell ``[4, h, w]`` of one frame's packed samples, for Sony's analysers and
    the slope of `clipping_scene`; all samples count.
    """
    turns = torch.deg2rad(2 * torch.tensor([90.0, 45.0, 135.0, 0.0])).repeat(4)
    rows = torch.tensor(
        [4 * r + c for top in (0, 2) for left in (0, 2) for r in (top, top + 1) for c in (left, left + 1)]
    )
    cells = torch.eye(4).repeat_interleave(4, dim=0) * (1 + 0.06 * turns.cos() + 0.08 * turns.sin())[:, None]
    system = torch.cat([turns.cos()[:, None], turns.sin()[:, None], cells], dim=1)
    values = 2 * planes[0, rows].flatten(1)
    found = torch.linalg.lstsq(system, values).solution.view(6, *planes.shape[-2:])
    return found[:2], found[2:]


def clipping_scene(layout: Layout) -> tuple[JointOutput, Tensor, Tensor]:
    """Uniform diffuse light, specular light on the middle packed pixels, and frames of both: whole, and clipped at 1.

    Red clips everywhere; in the middle, green clips behind two analysers and blue behind none.
    """
    c = layout.channels
    diffuse = torch.tensor([2.4, 0.8, 0.1])[-c:, None, None].expand(1, c, 96, 96)
    specular = torch.zeros(1, 1, 96, 96)
    specular[..., 40:56, 40:56] = 1.0
    turn = torch.tensor([0.8, 0.6]).view(1, 2, 1, 1).expand(1, 2, 24, 24)
    images = JointOutput(diffuse, specular, *[torch.zeros(1, 1, 1, 1)] * 6)
    raw = predict_samples(images, Polarization(0.1 * turn.flip(1), turn), layout)
    return images, raw, raw.clamp(max=1)


def test_what_is_left_determines_what_clipped() -> None:
    """For the true slope: of green s0 exactly, and of the offset b all that half of the samples lack."""
    _, _, clipped = clipping_scene(COLOR)
    turn = torch.tensor([0.8, 0.6])
    slope = 0.1 * turn.flip(0).view(1, 2, 1, 1).expand(1, 2, 24, 24)
    planes, masks = (pixel_unshuffle(x, PERIOD)[..., 11:13, 11:13] for x in (clipped, (clipped >= 1).float()))
    assert float(masks.mean()) == 0.5
    moved, lift = untrained(COLOR).unclip(planes, masks, slope[..., :2, :2])
    seen = fit_half(planes)
    assert_close(seen[1][1] + lift[:, 1], torch.full((1, 2, 2), 1.8))
    assert_close(seen[0] + moved[0], (turn - 0.1 * turn.flip(0)).view(2, 1, 1).expand(2, 2, 2))
    assert not bool(lift[:, ::2].any())


@pytest.mark.parametrize("demosaicker", ["linear", "guided"])
def test_clipped_highlights_are_not_lost(demosaicker: Demosaicker) -> None:
    """The closed form's specular light where half of the samples clip, away from edges; taken as they are, they hide
    a sixth of it. Nothing says how red it is there.
    """
    images, _, clipped = clipping_scene(COLOR)
    net, inside = Joint(3, SIZE, INPUTS, demosaicker), (..., slice(22, 26), slice(22, 26))
    wanted = [avg_pool2d(x, 2)[inside] for x in (images.diffuse[:, 1:], images.specular)]
    found, as_it_is = (net.half_resolution(clipped, mask) for mask in (clipped >= 1, nothing_clipped(clipped)))
    for image, true in zip((found.diffuse[:, 1:], found.specular), wanted, strict=True):
        assert_within(image[inside], true, DRAWN)
    assert bool((as_it_is.specular[inside] < found.specular[inside] - DRAWN).all())


@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
def test_only_frames_that_clip_in_part_and_in_colour_lack_something(layout: Layout) -> None:
    """Nothing where no sample clips, or all do."""
    net, (_, raw, clipped) = untrained(layout), clipping_scene(layout)
    planes, slope = pixel_unshuffle(raw, PERIOD), torch.zeros(1, 2, 24, 24)
    for masks in (torch.zeros_like(planes), torch.ones_like(planes)):
        assert not any(bool(lacking.any()) for lacking in net.unclip(planes, masks, slope))
    partly = (planes > planes.median()).float()
    moved, lift = net.unclip(pixel_unshuffle(clipped, PERIOD).clamp(max=0.5), partly, slope)
    assert moved.shape == (1, 2, 24, 24) and lift.shape == (1, layout.channels, 24, 24)
    assert bool(moved.any() or lift.any()) == (layout == COLOR)


@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
def test_images_of_a_batch_are_independent(layout: Layout) -> None:
    raw = random_raw(3, 16, 24)
    net = random_net(layout)
    (together, polarization), (alone, own) = (net(x, x > 0.85) for x in (raw, raw[1:2]))
    for a, b in zip((*together, *polarization), (*alone, *own), strict=True):
        assert_close(a[1:2], b)


@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
@pytest.mark.parametrize("make", [untrained, random_net])
def test_crop_and_frame_agree_away_from_the_border(layout: Layout, make: Callable[[Layout], Joint]) -> None:
    """No statistics of the frame; crops begin where the strided convolutions do."""
    raw = random_raw(1, 160, 160)
    net, start, reach = make(layout), PERIOD * 2, 64
    part = raw[..., start:, start:]
    frame, cut = net(raw, raw > 0.85)[0], net(part, part > 0.85)[0]
    for whole, piece in ((frame.diffuse, cut.diffuse), (frame.specular, cut.specular)):
        assert_close(
            crop(piece, reach)[..., :16, :16],
            whole[..., start:, start:][..., reach:-reach, reach:-reach][..., :16, :16],
        )
    assert_close(
        crop(cut.log_variance, reach // 2), frame.log_variance[..., start // 2 :, start // 2 :][..., 32:-32, 32:-32]
    )


@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
@pytest.mark.parametrize("shape", [(4, 4), (4, 12), (8, 4), (20, 28), (36, 12)])
def test_any_multiple_of_four_goes_in(layout: Layout, shape: tuple[int, int]) -> None:
    raw = random_raw(1, *shape)
    net = random_net(layout)
    images, polarization = net(raw, nothing_clipped(raw))
    half = net.half_resolution(raw, nothing_clipped(raw))
    cells, packed = tuple(n // 2 for n in shape), tuple(n // 4 for n in shape)
    assert images.diffuse.shape == (1, layout.channels, *shape)
    assert half.diffuse.shape == half.s1.shape == half.s2.shape == (1, layout.channels, *cells)
    assert half.log_variance.shape == (1, 2, *cells)
    assert half.local_brightness.shape == (1, 1, *packed)
    assert polarization.diffuse.shape == polarization.specular.shape == (1, 2, *packed)
    assert_finite(*images, *polarization, *half)


@pytest.mark.parametrize("inputs", [INPUTS, ("samples", "clipping"), ("cosine", "split")], ids=",".join)
@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
@pytest.mark.parametrize("level", [0.0, 0.4, 1.0])
def test_gradients_are_finite_on_extreme_frames(layout: Layout, level: float, inputs: tuple[str, ...]) -> None:
    """Black, uniform without noise, and wholly clipped frames; every parameter has a gradient."""
    raw = torch.full((1, 1, 16, 16), level)
    net = random_net(layout, inputs)
    images, polarization = net(raw, raw >= 1 - CLIP_MARGIN)
    total = sum(x.square().mean() for x in (images.diffuse, images.specular, images.log_variance, *polarization))
    assert isinstance(total, Tensor)
    total.backward()
    assert_finite(*images, *polarization)
    assert_finite(*(p.grad for p in net.parameters()))


def test_the_linear_filter_is_no_subject_of_training() -> None:
    net = untrained(COLOR)
    assert "demosaic" in net.state_dict()
    assert "demosaic" not in dict(net.named_parameters())


@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
def test_networks_see_the_maps_they_were_asked_to_see(layout: Layout) -> None:
    """Those of all inputs, in their order, and the logarithm of the brightness; what is left out, is not there."""
    planes = pixel_unshuffle(random_raw(1, 16, 16), 4)
    masks = (planes > 0.85).float()
    half = untrained(layout).demosaicked(planes, full=False)[0]
    single = [Joint(layout.channels, SIZE, (name,)).closed_form(half, planes, masks) for name in INPUTS]
    whole = Joint(layout.channels, SIZE).closed_form(half, planes, masks)
    assert torch.equal(
        whole.inputs, torch.cat([*(guess.inputs[:, :-1] for guess in single), torch.log(whole.local_brightness)], dim=1)
    )
    for name, guess in zip(INPUTS, single, strict=True):
        net = random_net(layout, tuple(other for other in INPUTS if other != name))
        assert net.closed_form(half, planes, masks).inputs.shape[1] == whole.inputs.shape[1] - guess.inputs.shape[1] + 1
        assert bool(net(pixel_shuffle(planes, 4), pixel_shuffle(masks, 4))[0].diffuse.any())


@pytest.mark.parametrize("layout", [*LAYOUTS, Layout(((0, 45), (90, 135)), "GRBG")], ids=spec)
def test_true_images_predict_the_samples(layout: Layout) -> None:
    """Truth, true slope and direction give what `camera.sample_mosaic` measures of that light."""
    images, polarization, light = scene(layout, 16, 24)
    expected = sample_mosaic(measure(light, layout.angles), layout)
    assert_close(predict_samples(images, polarization, layout)[:, 0], expected)


@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
def test_random_weights_do_something(layout: Layout) -> None:
    """Or else what is claimed of them here says nothing."""
    raw = random_raw(1, 16, 16)
    (one, polarization), (other, own) = (net(layout)(raw, raw > 0.85) for net in (untrained, random_net))
    for a, b in zip((*one[:2], one.log_variance, *polarization), (*other[:2], other.log_variance, *own), strict=True):
        assert float((a - b).detach().abs().mean()) > 0.02


@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
def test_half_precision_is_kept_out_of_the_closed_form(layout: Layout) -> None:
    """Under bf16 images are single precision; those of an untrained network are the same to the bit."""
    raw = random_raw(1, 16, 16)
    for make, tolerance in ((untrained, 0.0), (random_net, ROUNDED)):
        net = make(layout)
        with torch.no_grad():
            exact, half = net(raw, raw > 0.85)[0], net.half_resolution(raw, raw > 0.85)
            with torch.autocast("cpu", torch.bfloat16):
                coarse, coarse_half = net(raw, raw > 0.85)[0], net.half_resolution(raw, raw > 0.85)
        for one, other in ((exact, coarse), (half, coarse_half)):
            assert other.diffuse.dtype == other.specular.dtype == other.log_variance.dtype == torch.float32
            assert_within(other.diffuse, one.diffuse, tolerance)
            assert_within(other.specular, one.specular, tolerance)
            assert torch.equal(other.s1, one.s1)


@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
def test_directions_are_unit_vectors(layout: Layout) -> None:
    raw = random_raw(1, 16, 16)
    direction = random_net(layout)(raw, nothing_clipped(raw))[1].specular
    assert_within(torch.linalg.vector_norm(direction, dim=1), 1.0, 1e-3)


@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
def test_samples_beyond_the_border_are_repeated_by_periods(layout: Layout) -> None:
    """A frame continued by its own packed pixels gives the same linear s0 up to the border."""
    raw = random_raw(1, 16, 16)
    planes = pad(pixel_unshuffle(raw, 4), (1, 1, 1, 1), mode="replicate")
    wide = pixel_shuffle(planes, 4)
    net = untrained(layout)
    one, two = (net(x, nothing_clipped(x))[0] for x in (raw, wide))
    assert_close(one.diffuse + one.specular, crop(two.diffuse + two.specular, 4))


def test_expected_errors_stay_finite() -> None:
    """However far off a network expects to be, files can hold it."""
    net, raw = untrained(COLOR), random_raw(1, 16, 16)
    torch.nn.init.constant_(net.log_variance[2].bias, 1e6)  # type: ignore[arg-type]
    with torch.no_grad():
        images = net.half_resolution(raw, nothing_clipped(raw))
    assert images.log_variance.amin(dim=(0, 2, 3)).tolist() == list(MAX_LOG_VARIANCE)
    assert_finite(*limit(images))


@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
def test_distrust_moves_the_closed_form_s_specular_light_to_the_diffuse(layout: Layout) -> None:
    net, raw = untrained(layout), random_raw(1, 16, 16)
    clipped = nothing_clipped(raw)
    assert net.closed_form_gain is not None
    believed = net.half_resolution(raw, clipped), net(raw, clipped)[0]
    torch.nn.init.constant_(net.closed_form_gain.bias, -1.0)  # type: ignore[arg-type]
    refused = net.half_resolution(raw, clipped), net(raw, clipped)[0]
    for before, after in zip(believed, refused, strict=True):
        assert bool((before.specular > 0).any())
        assert_within(after.specular, torch.zeros_like(after.specular), 1e-6)
        assert_close(after.diffuse, before.diffuse + before.specular)
