"""What the joint network learns from: its loss piece by piece, its linear filter, its ablations; whole trainings."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tolerances import assert_close, assert_finite
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, interpolate, pad, pixel_shuffle, pixel_unshuffle

pytest.importorskip("embreex")
pytest.importorskip("lightning_fabric")
pytest.importorskip("tensorboard")

from test_training import die_at

from polsep.io.store.weights import read_weights, write_weights
from polsep.metrics import psnr
from polsep.networks.channels import INPUTS
from polsep.networks.joint import Joint, JointOutput, Polarization, bilinear_filter
from polsep.networks.ranges import pruned
from polsep.networks.sizes import ResidualSize
from polsep.networks.unet import count_parameters
from polsep.physics.stokes import Stokes
from polsep.render.simulate import filter_light
from polsep.sensor.camera import CLIP_MARGIN, IDEAL, IMX250, Layout, expose
from polsep.train import command, loop
from polsep.train import joint_task as module
from polsep.train.command import JointOptions, plan_run, train_weights
from polsep.train.digest import digest_examples
from polsep.train.growth import grow
from polsep.train.inputs import JointInputs, joint_inputs, joint_mono_inputs
from polsep.train.joint_losses import (
    DATA_SCALE,
    MIN_ERROR,
    SURPRISE,
    Goal,
    beyond_white,
    joint_loss,
    mean_decibels,
    paper_difference,
    sample_residual,
    variance_loss,
)
from polsep.train.joint_task import (
    ABLATIONS,
    FIT_LANE,
    FIT_REACH,
    JOINT_VARIANTS,
    SIZES,
    fit_filter,
    joint_task,
    reach_of_filter,
)
from polsep.train.loop import Run, Schedule, train
from polsep.train.losses import diffuse_loss
from polsep.train.stream import Examples, StreamOptions, stream_lane
from polsep.train.tasks import Task
from polsep.train.validation import score, validation_batches

STREAM = StreamOptions(batch=2, crop=32, size=64, pool=2, uses=1)
SCHEDULE = Schedule(steps=2, warm_up=1, checkpoint_every=2, validate_every=100, precision="32-true")
TINY = ResidualSize(4, (0, 1))
COLOR, MONO = Layout(), Layout(bayer=None)


@pytest.fixture
def shortened(monkeypatch: pytest.MonkeyPatch) -> None:
    """The linear filter from a few examples instead of hundreds, and a batch of validation views instead of eight."""
    monkeypatch.setattr(module, "FIT_BATCHES", 4)
    monkeypatch.setattr(module, "FIT_POOL", 2)
    for user in (loop, command):
        monkeypatch.setattr(user, "validation_batches", lambda stream: validation_batches(stream, 1))


@pytest.fixture(scope="module")
def batches() -> list[Examples]:
    """Examples of another lane than the one the filter is fitted to."""
    return list(itertools.islice(stream_lane(replace(STREAM, batch=4, pool=4), 0, 0), 4))


def small_task(ablation: str = "none", variant: str = "mosaic") -> Task[JointInputs]:
    torch.manual_seed(1)
    return joint_task(variant, TINY, ABLATIONS[ablation])


def truth_of(seen: JointInputs) -> JointOutput:
    """True light as the network would give it, with an expected variance of 1."""
    s1, s2 = avg_pool2d(seen.polarized, 2).chunk(2, dim=1)
    count, _, height, width = seen.raw.shape
    log_variance, light = torch.zeros(count, 2, height // 2, width // 2), torch.ones(count, 1, height // 4, width // 4)
    nothing = torch.zeros(count, 0)
    images = (seen.full_diffuse, seen.full_specular, s1, s2)
    return JointOutput(*images, log_variance, light, torch.zeros_like(light), nothing)


def explained(layout: Layout) -> tuple[JointOutput, Polarization, JointInputs]:
    """Images, the polarization of their light, and an example without noise that they explain, part of it clipped."""
    generator, c = torch.Generator().manual_seed(5), layout.channels
    diffuse, specular = (3 * torch.rand(2, n, 16, 16, generator=generator) ** 2 for n in (c, 1))
    a, e = torch.tensor([0.1, -0.2]), torch.tensor([0.6, 0.8])
    light = Stokes(diffuse + specular, *(a[k] * diffuse + e[k] * specular for k in (0, 1)))
    raw = expose(light, layout, IDEAL).data[:, None]
    half = [avg_pool2d(x, 2) for x in (diffuse, specular)]
    polarized = torch.cat([light.s1, light.s2], dim=1)
    ones = torch.ones(2, 1, 16, 16)
    clipped, inside = raw >= 1 - CLIP_MARGIN, ones[:, 0, ::2, ::2] > 0
    whole = torch.zeros(0), torch.zeros(2, 4)
    seen = JointInputs(raw, clipped, *half, inside, layout, diffuse, specular, ones, polarized, *whole)
    polarization = Polarization(*(x.view(1, 2, 1, 1).expand(2, 2, 4, 4) for x in (a, e)))
    return truth_of(seen), polarization, seen


def as_variable(images: JointOutput) -> JointOutput:
    return JointOutput(*(x.detach().clone().requires_grad_() for x in images))


@pytest.mark.parametrize("see", [joint_inputs, joint_mono_inputs])
def test_examples_hold_raw_samples_and_the_truth_behind_them(
    batches: list[Examples], see: Callable[[Examples], JointInputs]
) -> None:
    """The truth, through the camera, is the samples up to noise; half resolution is the mean of full."""
    seen = see(batches[0])
    c = seen.layout.channels
    assert_close(seen.diffuse, avg_pool2d(seen.full_diffuse, 2))
    assert_close(seen.specular, avg_pool2d(seen.full_specular, 2))
    light = Stokes(seen.full_diffuse + seen.full_specular, seen.polarized[:, :c], seen.polarized[:, c:])
    error = (filter_light(light, seen.layout, IMX250) - seen.raw[:, 0])[~seen.clipped[:, 0]]
    assert abs(float(error.mean())) < 2e-3
    assert float(error.abs().median()) < 1e-2
    assert torch.equal(seen.mask, avg_pool2d(seen.weight, 2)[:, 0] == 1)
    assert torch.equal(seen.clipped, seen.raw >= 1 - CLIP_MARGIN)  # under white light


def test_decibels_are_minus_the_score() -> None:
    """Of `metrics.psnr` under a mask of ones, the floor of the error apart."""
    generator = torch.Generator().manual_seed(0)
    found, truth = (1.5 * torch.rand(3, 3, 8, 8, generator=generator) for _ in range(2))
    everywhere = torch.ones(8, 8, dtype=torch.bool)
    scores = [psnr(x, t, everywhere) for x, t in zip(found, truth, strict=True)]
    expected = sum(10 * math.log10(10 ** (-s / 10) + MIN_ERROR) for s in scores) / 3
    assert float(mean_decibels(found, truth, torch.ones(3, 1, 8, 8))) == pytest.approx(expected, abs=1e-4)
    assert expected == pytest.approx(-sum(scores) / 3, abs=0.01)


def test_decibels_are_taken_under_the_weight() -> None:
    """Pixels without weight count nothing, also where the score is blind; crops count alike, whatever their weight."""
    generator = torch.Generator().manual_seed(1)
    found, truth = (torch.rand(2, 3, 8, 8, generator=generator) for _ in range(2))
    weight = (torch.rand(2, 1, 8, 8, generator=generator) > 0.5).float()
    spoilt = torch.where(weight > 0, found, 5.0)
    assert_close(mean_decibels(spoilt, truth, weight), mean_decibels(found, truth, weight))
    assert_close(mean_decibels(found, truth, 0.1 * weight), mean_decibels(found, truth, weight), scale=10)
    each = [-psnr(x, t, w[0] > 0) for x, t, w in zip(found, truth, weight, strict=True)]
    assert float(mean_decibels(found, truth, weight)) == pytest.approx(sum(each) / 2, abs=0.01)
    assert float(mean_decibels(truth + 2, truth * 0 + 1, weight)) == pytest.approx(10 * math.log10(MIN_ERROR))


def test_the_loss_of_the_paper_is_that_of_its_network() -> None:
    found, truth = torch.rand(2, 1, 3, 8, 8).unbind(0)
    assert_close(paper_difference(found, truth, torch.zeros(1, 1, 8, 8)), 100 * diffuse_loss(found, truth), scale=100)


def test_light_beyond_white_counts() -> None:
    """Where the score is blind; the darker of two highlights of a true 3 is the worse one, none is -50 dB."""
    truth, weight = torch.full((1, 1, 4, 4), 3.0), torch.ones(1, 1, 4, 4)
    losses = [float(beyond_white(torch.full_like(truth, level), truth, weight)) for level in (1.0, 2.0, 3.0)]
    assert losses[0] > losses[1] > losses[2] == pytest.approx(10 * math.log10(MIN_ERROR))
    assert losses[1] == pytest.approx(20 * math.log10(math.log(4 / 3)), abs=0.01)


@pytest.mark.parametrize("share", [1e-4, 0.01, 0.3])
def test_the_variance_is_best_where_it_is_the_squared_error(share: float) -> None:
    """Relative to the light around: the log variance that the likelihood wants, for each of both images."""
    light = torch.full((1, 1, 2, 2), 0.4)
    errors = (torch.full((1, 3, 4, 4), 0.4 * share), torch.full((1, 1, 4, 4), -0.8 * share))
    best = torch.log(torch.tensor([share**2, 4 * share**2]) + 1e-7).view(1, 2, 1, 1).expand(1, 2, 4, 4)

    def loss(log_variance: Tensor) -> Tensor:
        nothing = torch.zeros(1)
        return variance_loss(
            JointOutput(*[nothing] * 4, log_variance, light, nothing, nothing), errors, torch.ones(1, 1, 4, 4)
        )

    log_variance = best.clone().requires_grad_()
    loss(log_variance).backward()
    assert_close(log_variance.grad, torch.zeros_like(best))
    for step in (-0.5, 0.5):
        assert float(loss(best + step)) > float(loss(best))


def test_a_pixel_that_is_far_off_does_not_outweigh_the_others() -> None:
    """Its pull on the variance ends at that of an error of `SURPRISE` variances, however sure the network was."""
    light, nothing = torch.ones(1, 1, 2, 2), torch.zeros(1)
    errors = torch.ones(1, 3, 4, 4), torch.ones(1, 1, 4, 4)
    pulls = []
    for sure in (0.0, -math.log(2 * SURPRISE), -200.0):
        log_variance = torch.full((1, 2, 4, 4), sure, requires_grad=True)
        loss = variance_loss(
            JointOutput(*[nothing] * 4, log_variance, light, nothing, nothing), errors, torch.ones(1, 1, 4, 4)
        )
        loss.backward()
        assert log_variance.grad is not None
        assert_finite(loss, log_variance.grad)
        pulls.append(float(log_variance.grad.sum()))
    assert abs(pulls[0]) < 1e-6
    assert pulls[1:] == pytest.approx([0.5 * (1 - SURPRISE)] * 2, rel=1e-5)


def test_the_variance_moves_nothing_but_itself() -> None:
    images = as_variable(explained(COLOR)[0])
    diffuse, specular = avg_pool2d(images.diffuse, 2), avg_pool2d(images.specular, 2)
    variance_loss(images, (diffuse - 0.3, specular - 0.1), torch.ones(2, 1, 8, 8)).backward()
    assert images.diffuse.grad is None and images.specular.grad is None
    assert images.log_variance.grad is not None and bool(images.log_variance.grad.any())


@pytest.mark.parametrize("layout", [COLOR, MONO], ids=lambda layout: layout.spec)
def test_the_truth_explains_all_samples_that_did_not_clip(layout: Layout) -> None:
    """The misfit is 0 although a part of the frame clips, and not where anything else is claimed."""
    images, polarization, seen = explained(layout)
    assert 0.02 < float(seen.clipped.float().mean()) < 0.5
    assert float(sample_residual(images, polarization, seen)) < 1e-8
    darker = images._replace(diffuse=0.9 * images.diffuse)
    turned = polarization._replace(specular=polarization.specular.flip(1))
    assert float(sample_residual(darker, polarization, seen)) > 0.1
    assert float(sample_residual(images, turned, seen)) > 0.1


def test_clipped_samples_have_no_misfit() -> None:
    """Their values and the light behind them change nothing and get no gradient; nor do wholly clipped frames."""
    images, polarization, seen = explained(MONO)
    clipped = seen.clipped
    variable = as_variable(images._replace(diffuse=images.diffuse + 0.5))
    sample_residual(variable, polarization, seen).backward()
    gradient = variable.diffuse.grad
    assert gradient is not None
    assert not bool(gradient[clipped].any())
    assert bool((gradient[~clipped] != 0).all())
    assert float(sample_residual(images, polarization, seen._replace(clipped=torch.ones_like(clipped)))) == 0


def test_misfit_is_quadratic_for_noise_and_linear_beyond() -> None:
    images, polarization, seen = explained(MONO)
    nothing = seen._replace(raw=torch.zeros_like(seen.raw), clipped=torch.zeros_like(seen.clipped))
    flat = Polarization(torch.zeros_like(polarization.diffuse), polarization.specular)

    def misfit(sample: float) -> float:
        level = torch.full_like(images.diffuse, 2 * sample * DATA_SCALE)
        return float(sample_residual(images._replace(diffuse=level, specular=0 * level), flat, nothing))

    assert misfit(0.5) == pytest.approx(0.125)
    assert misfit(1.0) == pytest.approx(0.5)
    assert misfit(3.0) == pytest.approx(2.5)


@pytest.mark.parametrize("layout", [COLOR, MONO], ids=lambda layout: layout.spec)
def test_nothing_is_better_than_the_truth(layout: Layout) -> None:
    """The whole loss, with the variances that go with each."""
    images, polarization, seen = explained(layout)
    floor = math.log(1e-7)
    known = images._replace(log_variance=torch.full_like(images.log_variance, floor))
    best = joint_loss((known, polarization), seen, Goal())
    for change in (-0.05, 0.05):
        for other in (
            images._replace(diffuse=images.diffuse + change),
            images._replace(specular=images.specular + change),
        ):
            certain = other._replace(log_variance=torch.full_like(images.log_variance, 2 * math.log(abs(change))))
            assert float(joint_loss((certain, polarization), seen, Goal())) > float(best) + 1


def known_views(layout: Layout, weight: Tensor) -> list[JointInputs]:
    """Random samples, whose truth is what a packed filter makes of them."""
    generator, c = torch.Generator().manual_seed(2), layout.channels
    views = []
    for _ in range(2):
        raw = 0.1 + 0.8 * torch.rand(2, 1, 64, 64, generator=generator)
        found = conv2d(pad(pixel_unshuffle(raw, 4), (1, 1, 1, 1), mode="replicate"), weight)
        s0, s1, s2 = found.split((16 * c, 4 * c, 4 * c), dim=1)
        polarized = interpolate(torch.cat([pixel_shuffle(s, 2) for s in (s1, s2)], dim=1), scale_factor=2.0)
        diffuse, specular = pixel_shuffle(s0, 4), torch.zeros_like(raw)
        mask = torch.ones(2, 32, 32, dtype=torch.bool)
        views.append(
            JointInputs(
                raw,
                torch.zeros_like(raw) > 0,
                avg_pool2d(diffuse, 2),
                specular[..., ::2, ::2],
                mask,
                layout,
                diffuse,
                specular,
                torch.ones_like(raw),
                polarized,
                torch.zeros(0),
                torch.zeros(2, 4),
            )
        )
    return views


def known_filter(layout: Layout) -> Tensor:
    """Not the bilinear one; it sees what a fitted one does, and leaves even light as it is."""
    weight = bilinear_filter(layout)
    near = reach_of_filter(layout.channels).view_as(weight).float()
    change = 0.1 * near * torch.randn(weight.shape, generator=torch.Generator().manual_seed(4))
    for own in colors_of_samples(layout):
        seen = near * own.view(1, 16, 1, 1)
        change -= seen * ((change * seen).sum(dim=(1, 2, 3), keepdim=True) / seen.sum(dim=(1, 2, 3), keepdim=True))
    return weight + change


def colors_of_samples(layout: Layout) -> Tensor:
    """Which of a period's samples lie behind a filter of each colour: ``[C, 16]``, 1 or 0."""
    channels = torch.tensor([layout.filter_at(place // 4, place % 4).channel for place in range(16)])
    return (channels == torch.arange(layout.channels)[:, None]).float()


@pytest.mark.parametrize("layout", [COLOR, MONO], ids=lambda layout: layout.spec)
def test_the_filter_sees_raw_samples_within_its_reach(layout: Layout) -> None:
    """Sample by sample: one bright sample changes the pixels and cells no farther than `FIT_REACH` from it."""
    weight = reach_of_filter(layout.channels).float().view(-1, 16, 3, 3)
    c = layout.channels
    for row, col in ((12, 12), (13, 14), (15, 15)):
        raw = torch.zeros(1, 1, 28, 28)
        raw[..., row, col] = 1
        s0, s1, s2 = conv2d(pad(pixel_unshuffle(raw, 4), (1,) * 4), weight).split((16 * c, 4 * c, 4 * c), dim=1)
        for image, size in ((pixel_shuffle(s0, 4), 1), (pixel_shuffle(s1, 2), 2), (pixel_shuffle(s2, 2), 2)):
            reached = image[0].repeat_interleave(size, -1).repeat_interleave(size, -2) > 0
            rows, cols = (torch.arange(28) // size * size for _ in range(2))
            near = [
                (place - FIT_REACH <= x) & (x < place + size + FIT_REACH) for place, x in ((rows, row), (cols, col))
            ]
            assert torch.equal(reached, (near[0][:, None] & near[1]).expand(c, -1, -1))


@pytest.mark.parametrize("layout", [COLOR, MONO], ids=lambda layout: layout.spec)
def test_the_fit_recovers_a_known_filter(layout: Layout) -> None:
    weight = known_filter(layout)
    found = fit_filter(known_views(layout, weight))
    assert found.shape == weight.shape and found.dtype == torch.float32
    assert float((found - weight).abs().max()) < 0.01
    assert float((found - weight).square().mean()) < 1e-4 * float((weight - bilinear_filter(layout)).square().mean())


@pytest.mark.parametrize("layout", [COLOR, MONO], ids=lambda layout: layout.spec)
def test_the_fit_leaves_even_light_as_it_is(layout: Layout) -> None:
    """Whatever the examples say: s0 of its own colour, no light of another, nothing polarized."""
    c = layout.channels
    weight = fit_filter(known_views(layout, 0.5 * bilinear_filter(layout)))
    for k, own in enumerate(colors_of_samples(layout)):
        found = (weight * 0.5 * own.view(1, 16, 1, 1)).sum(dim=(1, 2, 3))
        expected = torch.zeros(24 * c)
        expected[16 * k : 16 * (k + 1)] = 1
        assert_close(found, expected)


def test_samples_near_clipped_ones_say_nothing_about_the_filter() -> None:
    """Samples raised to white, whose truth does not follow them, leave what the others say."""
    weight = known_filter(COLOR)
    views = known_views(COLOR, weight)
    clipped = torch.rand(views[0].raw.shape, generator=torch.Generator().manual_seed(6)) < 0.002
    spoilt = [view._replace(raw=torch.where(clipped, 1.0, view.raw), clipped=clipped) for view in views]
    assert float((fit_filter(spoilt) - weight).abs().max()) < 0.01


def test_what_examples_leave_open_stays_bilinear() -> None:
    """A single packed pixel of another filter hardly moves it; without one there is nothing to fit."""
    known = known_filter(COLOR)
    views = known_views(COLOR, known)
    corner = [view._replace(weight=pad(torch.ones(2, 1, 4, 4), (0, 60, 0, 60))) for view in views]
    bilinear = bilinear_filter(COLOR)
    assert_finite(fit_filter(corner))
    assert float((fit_filter(corner) - bilinear).square().mean()) < 0.5 * float((known - bilinear).square().mean())
    outside = [view._replace(weight=torch.zeros_like(view.weight)) for view in views]
    with pytest.raises(ValueError, match="expected examples to fit a filter to, found none"):
        fit_filter(outside)
    with pytest.raises(ValueError, match="expected examples to fit a filter to, found none"):
        fit_filter([])


@pytest.mark.parametrize("variant", JOINT_VARIANTS)
def test_the_fitted_filter_beats_bilinear_on_other_examples(variant: str) -> None:
    """s0 where nothing clips, relative to its brightness, of scenes that it was not fitted to."""
    see, colors = JOINT_VARIANTS[variant]
    options = replace(STREAM, batch=8, pool=8)
    fitted = fit_filter(see(batch) for batch in itertools.islice(stream_lane(options, FIT_LANE, 0), 10))
    net = Joint(colors, TINY)
    views = [see(batch) for batch in itertools.islice(stream_lane(options, 0, 0), 4)]
    before = relative_error(net, views)
    net.demosaic.copy_(fitted)
    assert relative_error(net, views) < 0.9 * before


def relative_error(net: Joint, views: list[JointInputs]) -> float:
    """Mean squared error of s0 over the squared light around, where nothing near clips."""
    total, count = 0.0, 0
    for seen in views:
        with torch.no_grad():
            images = net(seen.raw, seen.clipped)[0]
        light = interpolate(images.local_brightness, scale_factor=4.0)
        near = interpolate(avg_pool2d(seen.clipped.float(), 8, 4, 2), scale_factor=4.0)[..., :32, :32]
        kept = ((seen.weight > 0) & (near == 0)).expand_as(images.diffuse)
        error = (images.diffuse + images.specular - seen.full_diffuse - seen.full_specular) / light
        total, count = total + float(error[kept].square().sum()), count + int(kept.sum())
    return total / count


def test_sizes_and_ablations_are_told_apart() -> None:
    assert set(SIZES) == {"joint-large", "joint", "joint-fast"}
    assert {name for name, ablation in ABLATIONS.items() if ablation == ABLATIONS["none"]} == {"none"}
    parameters = {name: count_parameters(Joint(3, size)) for name, size in SIZES.items()}
    assert parameters["joint-large"] > 3 * parameters["joint"] > 6 * parameters["joint-fast"]


@pytest.mark.parametrize("variant", JOINT_VARIANTS)
@pytest.mark.parametrize("ablation", ABLATIONS)
def test_every_ablation_learns(ablation: str, variant: str, batches: list[Examples]) -> None:
    """It sees what it says, a step has finite gradients of every parameter, and changes what it separates."""
    task = small_task(ablation, variant)
    seen = task.prepare(batches[0])
    before = task.separate(seen)
    optimizer = torch.optim.Adam(task.network.parameters(), 1e-2)
    for _ in range(2):
        optimizer.zero_grad()
        task.loss(task.network, seen, 1.0).backward()
        assert_finite(*(p.grad for p in task.network.parameters()))
        optimizer.step()
    after = task.separate(seen)
    for one, other in ((before.diffuse, after.diffuse), (before.specular, after.specular)):
        assert one.shape == other.shape == (4, JOINT_VARIANTS[variant][1], 16, 16)
        assert float(other.min()) >= 0
        assert float((one - other).abs().mean()) > 1e-4


@pytest.mark.parametrize("ablation", ["none", "no-closed-form", "paper-loss"])
def test_gradients_are_finite_on_black_and_clipped_frames(ablation: str) -> None:
    task = small_task(ablation)
    for level in (0.0, 0.5, 3.0):
        light, nothing = torch.full((1, 3, 16, 16), level), torch.zeros(1, 1, 16, 16)
        raw, mask = torch.full((1, 16, 16), min(level / 2, 1.0)), torch.full((1, 16, 16), level > 0)
        clipped, common = raw >= 1 - CLIP_MARGIN, (torch.zeros(1, 17, 64, 64), torch.zeros(1, 4))
        seen = task.prepare(Examples(raw, clipped, light, nothing, torch.zeros(1, 6, 16, 16), mask, *common))
        task.network.zero_grad()
        task.loss(task.network, seen, 1.0).backward()
        assert_finite(*(p.grad for p in task.network.parameters()))


@pytest.mark.parametrize("variant", JOINT_VARIANTS)
def test_ablations_differ_in_what_they_see_or_in_what_they_minimize(variant: str, batches: list[Examples]) -> None:
    """Never in both, and in nothing else: at the beginning all separate alike."""
    seen = JOINT_VARIANTS[variant][0](batches[0])
    whole = small_task("none", variant)
    for ablation, (inputs, goal) in ABLATIONS.items():
        assert (inputs != INPUTS) + (goal != Goal()) == (ablation != "none")
        task = small_task(ablation, variant)
        assert isinstance(task.network, Joint)
        assert task.network.inputs == inputs
        assert count_parameters(task.network) <= count_parameters(whole.network)
        assert torch.equal(task.separate(seen).specular, whole.separate(seen).specular)


@pytest.mark.parametrize("variant", JOINT_VARIANTS)
def test_training_ends_in_weights_that_say_all(variant: str, tmp_path: Path, shortened: None) -> None:
    options = JointOptions("joint-fast", variant, TINY)
    run = Run(tmp_path, "a test", STREAM, SCHEDULE, workers=0)
    lines: list[dict[str, Any]] = []
    path = train_weights(options, run, lines.append)
    assert path.name == f"joint-fast-{variant}.safetensors"
    weights, metadata = read_weights(path)
    data = digest_examples(asdict(STREAM), "polsep.train.stream")
    known = {"method": "joint-fast", "ablation": "none", "variant": variant, "seed": "0", "data": data}
    assert known.items() <= metadata.items()
    colors = int(metadata["colors"])
    assert colors == JOINT_VARIANTS[variant][1]
    assert json.loads(metadata["inputs"]) == list(INPUTS)
    assert json.loads(metadata["size"]) == {"width": 4, "blocks": [0, 1], "entry": 0}
    last = [round(lines[-1][f"{image} PSNR"], 3) for image in ("diffuse", "specular")]
    assert json.loads(metadata["curve"]) == [[2, *last]]
    halves = json.loads(metadata["validation"])
    assert [halves[f"{image} PSNR"] for image in ("diffuse", "specular")] == pytest.approx(last, abs=0.1)
    assert set(json.loads(metadata["reference"])) == {"analytic", "color-affine"}
    assert metadata["command"].startswith("polsep train joint-fast ")
    size, inputs = ResidualSize(**json.loads(metadata["size"])), tuple(json.loads(metadata["inputs"]))
    sees_frame = json.loads(metadata["sees_frame"])
    assert sees_frame
    network = Joint(colors, size, inputs, sees_frame=sees_frame)
    network.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()})
    assert metadata["parameters"] == str(count_parameters(network))
    examples = itertools.islice(stream_lane(STREAM, FIT_LANE, 0), 4)
    fitted = fit_filter(JOINT_VARIANTS[variant][0](batch) for batch in examples)
    assert torch.equal(network.demosaic, fitted.half().float())


@pytest.mark.parametrize(("part", "name_in_files"), [("details", "details."), ("errors", "doubt.")])
def test_of_a_network_a_part_can_be_trained_alone(
    part: str, name_in_files: str, tmp_path: Path, shortened: None
) -> None:
    """Everything else stays bit by bit as it began, and with it all images at half resolution."""
    run = Run(tmp_path / "all", "a test", STREAM, SCHEDULE, workers=0)
    start = train_weights(JointOptions("joint-fast", size=TINY), run, lambda _: None)
    run = replace(run, out=tmp_path / "part", start=(start,))
    held = train_weights(JointOptions("joint-fast", size=TINY, part=part), run, lambda _: None)
    (before, _), (after, metadata) = read_weights(start), read_weights(held)
    moved = {name for name in before if not np.array_equal(before[name], after[name])}
    assert moved and all(name.startswith(name_in_files) for name in moved)
    assert f"--part {part}" in metadata["command"]
    assert int(metadata["parameters"]) == sum(x.size for name, x in after.items() if name != "demosaic")


@pytest.mark.parametrize("sees_frame", [False, True])
def test_a_network_grows_without_a_change_of_its_images(sees_frame: bool) -> None:
    """More channels and blocks, and a look at the whole frame, change nothing until they are trained."""
    torch.manual_seed(1)
    small = Joint(3, ResidualSize(8, (0, 1, 1)), sees_frame=sees_frame)
    for weight in small.parameters():
        torch.nn.init.normal_(weight, std=0.1)
    large = Joint(3, ResidualSize(12, (2, 1, 3)), sees_frame=True)
    large.load_state_dict(grow(small.state_dict(), large))
    raw = torch.rand(2, 1, 32, 32)
    clipped = raw > 0.9
    with torch.no_grad():
        (before, a), (after, b) = small(raw, clipped), large(raw, clipped)
    for name in ("diffuse", "specular", "log_variance", *(("light",) if sees_frame else ())):
        assert_close(getattr(after, name), getattr(before, name), scale=10)
    if sees_frame:
        assert_close(b.specular, a.specular, scale=10)


@pytest.mark.parametrize("entry", [0, 6])
def test_a_mono_network_begins_as_the_colour_network_on_grey_frames(entry: int) -> None:
    """The specular image, errors and light are the same; the diffuse image is the mean over the colours."""
    torch.manual_seed(3)
    color, mono = (Joint(colors, ResidualSize(8, (0, 1, 1), entry), sees_frame=True) for colors in (3, 1))
    for weight in color.parameters():
        torch.nn.init.normal_(weight, std=0.1)
    own = mono.demosaic
    assert own is not None and color.demosaic is not None
    grey = torch.cat([part.repeat(3, 1, 1, 1) for part in own.split((16, 4, 4))])  # s0, s1, s2 of three equal colours
    color.demosaic.copy_(grey)
    mono.load_state_dict(grow(color.state_dict(), mono))
    assert mono.demosaic is not None and torch.equal(mono.demosaic, own)
    raw, seen = torch.rand(2, 1, 32, 32), torch.rand(2, 7, 64, 64)
    none = torch.zeros_like(raw, dtype=torch.bool)
    equal = torch.cat([seen[:, :5].repeat_interleave(3, dim=1), seen[:, 5:]], dim=1)
    with torch.no_grad():
        (expected, a), (found, b) = color(raw, none, equal), mono(raw, none, seen)
    assert_close(found.diffuse, expected.diffuse.mean(dim=1, keepdim=True), scale=10)
    for name in ("specular", "log_variance", "light"):
        assert_close(getattr(found, name), getattr(expected, name), scale=10)
    assert_close(b.specular, a.specular, scale=10)


@pytest.mark.parametrize("layer", ["net.ups.1", "net.encoders.1.0.second"])
def test_what_was_inactive_becomes_zero_and_trains_again(layer: str) -> None:
    """Inactive parts change no image, before and after; a training that starts from them can move them again."""
    torch.manual_seed(2)
    network = Joint(1, ResidualSize(8, (0, 1, 1)))
    for weight in network.parameters():
        torch.nn.init.normal_(weight, std=0.1)
    state = network.state_dict()
    before = "net.encoders.2.0.second" if layer == "net.ups.1" else "net.encoders.1.0.first"
    state[f"{before}.bias"] -= 1000  # below zero everywhere
    raw, none = torch.rand(1, 1, 32, 32), torch.zeros(1, 1, 32, 32, dtype=torch.bool)
    expected = network(raw, none)[0].diffuse
    arrays = pruned({name: value.numpy() for name, value in state.items()}, {layer: (0.0, 0.0), "net.ups.0": (0, 1)})
    zeros = {name for name, array in arrays.items() if not array.any()}
    rest = "net.downs.1." if layer == "net.ups.1" else "net.encoders.1.0.first."
    assert rest + "weight" in zeros and len(zeros) == (7 if layer == "net.ups.1" else 3)
    network.load_state_dict({name: torch.from_numpy(array) for name, array in arrays.items()})
    assert_close(network(raw, none)[0].diffuse, expected, scale=10)
    fast = Joint.of(network.weights(), torch.device("cpu"))  # leaves such a block out
    assert_close(fast(raw, none)[0].diffuse, expected, scale=10)
    assert [name for name, part in fast.named_modules() if getattr(part, "inactive", False)] == [
        before.rpartition(".")[0]
    ]
    network.load_state_dict(grow(network.state_dict(), Joint(1, network.size)))
    found = network(raw, none)[0].diffuse
    assert_close(found, expected, scale=10)
    found.sum().backward()
    last = network.get_parameter("net.ups.1.weight" if layer == "net.ups.1" else f"{layer}.weight")
    assert last.grad is not None and bool(last.grad.any()) and not bool(last.any())


def test_a_network_grows_from_a_part_of_itself_alone() -> None:
    small, large = (Joint(3, ResidualSize(width, (0, 1, 1))) for width in (8, 12))
    with pytest.raises(ValueError, match=r"expected weights of a part of \(8"):
        grow(large.state_dict(), small)
    with pytest.raises(ValueError, match="expected weights of the same parts"):
        grow(Joint(3, ResidualSize(8, (0, 1))).state_dict(), large)
    with pytest.raises(ValueError, match="expected weights of the same parts"):
        grow(Joint(3, ResidualSize(8, (0, 1, 2)), sees_frame=True).state_dict(), large)


def test_filters_are_fitted_anew_only_when_asked(tmp_path: Path, shortened: None) -> None:
    """`--start` goes on with the filter of the weights; `--refit` fits one to today's examples, and nothing else."""
    run = Run(tmp_path / "first", "a test", STREAM, SCHEDULE, workers=0)
    first = train_weights(JointOptions("joint-fast", size=TINY), run, lambda _: None)
    before, metadata = read_weights(first)
    fitted = before["demosaic"]
    write_weights(first, before | {"demosaic": np.full_like(fitted, 0.25)}, {"method": metadata["method"]})
    on = replace(run, start=(first,), schedule=replace(SCHEDULE, steps=0))
    for refit, expected in ((False, np.full_like(fitted, 0.25)), (True, fitted)):
        asked = replace(on, out=tmp_path / str(refit), refit=refit)
        found, metadata = read_weights(train_weights(JointOptions("joint-fast", size=TINY), asked, lambda _: None))
        assert found.keys() == before.keys()
        assert all(
            np.array_equal(value, expected if name == "demosaic" else before[name]) for name, value in found.items()
        )
        assert ("--refit" in metadata["command"]) == refit


def test_a_mono_training_from_colour_weights_fits_its_own_filter(tmp_path: Path, shortened: None) -> None:
    """Without `--refit` it would keep the bilinear filter that it begins with."""
    run = Run(tmp_path / "color", "a test", STREAM, SCHEDULE, workers=0)
    start = train_weights(JointOptions("joint-fast", size=TINY), run, lambda _: None)
    mono = JointOptions("joint-fast", "mono", TINY)
    on = replace(run, out=tmp_path / "mono", start=(start,), stream=replace(STREAM, size=256))
    with pytest.raises(ValueError, match=f"expected --refit with weights for colour frames, found {start.name}"):
        plan_run(on, mono)
    planned = replace(plan_run(replace(on, refit=True), mono), stream=STREAM)
    arrays, metadata = read_weights(train_weights(mono, planned, lambda _: None))
    assert metadata["colors"] == "1"
    assert not np.array_equal(arrays["demosaic"], bilinear_filter(MONO).half().float().numpy())


def test_resumed_training_ends_with_the_same_bits(tmp_path: Path, shortened: None, monkeypatch: Any) -> None:
    """The filter is fitted once, before the first step, and kept."""
    schedule = replace(SCHEDULE, steps=5, checkpoint_every=2, validate_every=3)
    run = Run(tmp_path / "killed", "a test", STREAM, schedule, workers=0)
    whole = train(small_task(), replace(run, out=tmp_path / "whole"), lambda _: None)
    with pytest.raises(KeyboardInterrupt):
        train(small_task(), run, die_at(3))
    monkeypatch.setattr(module, "fit_filter", None)
    resumed = train(small_task(), run, lambda _: None)
    assert whole is not None and resumed is not None
    assert set(whole) == set(resumed)
    assert all(torch.equal(whole[name], resumed[name]) for name in whole)


def test_it_learns_a_picture_by_heart() -> None:
    """One 32 x 32 example of which 1 % clips, 220 steps: both outputs reach 40 dB, 15 dB above the closed form."""
    examples = next(itertools.islice(stream_lane(replace(STREAM, batch=1), 0, 0), 2, None))
    torch.manual_seed(0)
    task = joint_task("mosaic", ResidualSize(16, (1, 1)), ABLATIONS["none"])
    seen = task.prepare(examples)
    everywhere = [seen._replace(mask=torch.ones_like(seen.mask))]
    before = score(task.separate, everywhere)
    optimizer = torch.optim.Adam(task.network.parameters(), 3e-3)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 220)
    for _ in range(220):
        optimizer.zero_grad()
        task.loss(task.network, seen, 1.0).backward()
        optimizer.step()
        falling.step()
    for name, end in score(task.separate, everywhere).items():
        assert end > 40
        assert end > before[name] + 15


@pytest.mark.parametrize("demosaicker", ["linear", "guided"])
def test_processes_agree_on_buffers(demosaicker: Any) -> None:
    """`--devices 2` copies the buffers of the first process at every step, also where there is but one of them."""
    torch.distributed.init_process_group("gloo", store=torch.distributed.HashStore(), rank=0, world_size=1)
    try:
        network = Joint(3, ResidualSize(8, (0, 1)), demosaicker=demosaicker).to(memory_format=torch.channels_last)
        before = [buffer.clone() for buffer in network.buffers()]
        torch.nn.parallel.DistributedDataParallel(network)._sync_buffers()
        assert before and all(map(torch.equal, network.buffers(), before))
    finally:
        torch.distributed.destroy_process_group()
