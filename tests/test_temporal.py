"""The temporal filter: noise falls where nothing moves, samples stay bit for bit where something does; its state."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tolerances import ROUNDING, SIGMAS, assert_within

from polsep.kernels import get_threads, set_threads
from polsep.sensor.camera import IMX250, Layout, Mosaic, Sensor, add_noise
from polsep.sensor.noise import BLOCK, Levels, Noise, blocks_of, estimate_noise, least_noise
from polsep.video.temporal import (
    FRAMES,
    REACH,
    SLOW_REACH,
    TemporalState,
    filter_frame,
    filter_frame_reference,
    filter_samples,
    make_rules,
    steady_images,
)
from polsep.video.temporal_kernel import filter_samples as filter_samples_by_kernel

SIZE = (96, 128)
LAYOUTS = {"color": Layout(), "mono": Layout(bayer=None), "cropped": Layout(origin=(1, 1))}
CODES = Levels(0.0, 4095.0, 1.0, 4095 * (1 - 2.0**-10))


def make_light(seed: int = 1, brightest: float = 0.7) -> torch.Tensor:
    """A smooth picture with its analysers' and colours' own levels, white at 1."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 1, 6, 8, generator=generator)
    smooth = torch.nn.functional.interpolate(coarse, size=SIZE, mode="bicubic", align_corners=True)[0, 0].clamp(0.02, 1)
    filters = 0.4 + 0.6 * torch.rand(BLOCK, BLOCK, generator=generator)
    return brightest * smooth * filters.repeat(SIZE[0] // BLOCK, SIZE[1] // BLOCK)


def shoot(light: torch.Tensor, seed: int, sensor: Sensor = IMX250, layout: Layout | None = None) -> Mosaic:
    """One frame of 12 bits."""
    signal = add_noise(light, sensor, torch.Generator().manual_seed(seed)).clamp(0, 1)
    return Mosaic(torch.round(signal * 4095).to(torch.uint16), layout or Layout(), 0.0, 4095.0)


def run(frames: list[Mosaic]) -> tuple[list[np.ndarray], TemporalState]:
    """Every frame filtered, and the last state."""
    state, found = None, []
    for frame in frames:
        filtered, state = filter_frame(frame, state)
        found.append(filtered.data.numpy())
    assert state is not None
    return found, state


def blob(rows: slice, cols: slice) -> torch.Tensor:
    """A small bright highlight on black."""
    spot = torch.zeros(SIZE)
    spot[rows, cols] = 0.25
    return spot


# Where nothing moves


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_a_still_scene_becomes_its_mean(layout: Layout) -> None:
    """After n frames the error's variance is the sensor's over n, and its mean is none."""
    light = make_light()
    frames = [shoot(light, seed, layout=layout) for seed in range(int(FRAMES))]
    found, state = run(frames)
    for number in (2, 4, 8, 16):
        kept = light > 0.01  # black clips: its mean is not its signal
        error = torch.from_numpy(found[number - 1]) / 4095 - light
        score = (error / (IMX250.noise_variance(light) / number).sqrt())[kept]
        assert_within(score.mean(), 0.0, SIGMAS / math.sqrt(score.numel()))
        # Some blocks begin anew without a cause, with their neighbours, and have the noise of fewer frames.
        assert 1 - SIGMAS * math.sqrt(2 / score.numel()) < float(score.var()) < 1.1 + 0.02 * number
    assert float(np.mean(state.count > FRAMES - 2)) > 0.85


def test_means_follow_at_most_sixteen_frames() -> None:
    """The weight of a frame never falls below 1 / FRAMES, so that undetected changes are forgotten."""
    light = make_light()
    found, state = run([shoot(light, seed) for seed in range(40)])
    assert float(state.count.max()) == FRAMES
    steps = np.concatenate([(b - a)[light.numpy() > 0.02] for a, b in zip(found[-4:-1], found[-3:], strict=True)])
    alone = np.concatenate(
        [(shoot(light, s).data.float() - shoot(light, s + 1).data.float())[light > 0.02].numpy() for s in (1, 2, 3)]
    )
    assert float(np.square(steps).mean()) < 0.02 * float(np.square(alone).mean())


@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16, torch.float32])
def test_noise_free_frames_stay_as_they_are(dtype: torch.dtype) -> None:
    """Bit for bit, in codes and in floats, for every kind of samples."""
    light = make_light()
    data = light if dtype == torch.float32 else (light * 250).round().to(dtype)
    frame = Mosaic(data, Layout(), 0.0, 1.0 if dtype == torch.float32 else 255.0)
    found, state = run([frame] * 5)
    assert all(np.array_equal(image, data.float().numpy()) for image in found)
    assert float(state.count.min()) == pytest.approx(5)


# Where something moves


def test_moving_samples_are_the_current_frames() -> None:
    """A highlight crosses a noisy picture: it, its trace and blocks around both are bit for bit as they came."""
    light, state = make_light(), None
    for number in range(24):
        left = 4 + 5 * number
        spot = blob(slice(40, 49), slice(left, left + 9))
        frame = shoot(light + spot, number)
        filtered, state = filter_frame(frame, state)
        before = blob(slice(40, 49), slice(left - 5, left + 4)) if number else spot
        changed = blocks_of((spot != before).numpy()).any(axis=-1)
        moving = torch.nn.functional.max_pool2d(torch.from_numpy(changed)[None].float(), 2 * REACH + 1, 1, REACH)[0] > 0
        moving = moving.numpy().repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)
        assert np.array_equal(filtered.data.numpy()[moving], frame.data.float().numpy()[moving])
        if number > 8:
            apart = np.ones(SIZE, bool)
            reach = BLOCK * (REACH + 2 * SLOW_REACH)
            apart[40 - reach : 49 + reach, max(0, left - 5 - reach) : left + 9 + reach] = False
            calm = state.count.repeat(BLOCK, axis=0).repeat(BLOCK, axis=1) > 1
            assert float(np.mean(calm[apart])) > 0.95


def test_a_highlight_leaves_no_trace() -> None:
    """Where it was a frame ago, the error is noise without a mean."""
    light, state, traces = make_light(), None, []
    for number in range(30):
        here = blob(slice(40, 50), slice(4 * number, 4 * number + 10))
        filtered, state = filter_frame(shoot(light + here, number), state)
        if number > 2:
            trace = slice(40, 50), slice(4 * number - 8, 4 * number)
            error = filtered.data[trace] / 4095 - light[trace]
            traces.append((error / IMX250.noise_variance(light[trace]).sqrt()).flatten())
    score = torch.cat(traces)
    assert_within(score.mean(), 0.0, SIGMAS / math.sqrt(score.numel()))
    assert float(score.var()) < 1.1


@pytest.mark.parametrize("rate", [0.999, 0.99, 0.97])
def test_a_fading_light_is_followed_within_the_noise(rate: float) -> None:
    """The mean lag of blocks stays below a third of a sample's deviation, however slowly light fades."""
    light, state, lags = make_light(), None, []
    for number in range(40):
        now = light * rate**number
        filtered, state = filter_frame(shoot(now, number), state)
        if number > 10:
            score = (filtered.data / 4095 - now) / IMX250.noise_variance(now).sqrt()
            lags.append(float(score[now > 0.02].mean()))
    assert max(lags) < 1 / 3
    assert min(lags) > -0.05


def test_clipped_samples_stay_clipped() -> None:
    """Every sample that clips is handed on as it is, and what never clips is never handed on as clipped."""
    light = make_light(brightest=1.6).clamp(max=1.02)
    state = None
    for number in range(12):
        frame = shoot(light, number)
        filtered, state = filter_frame(frame, state)
        clipped = frame.clipped()
        assert bool(clipped.any()) and torch.equal(filtered.data[clipped], frame.data[clipped].float())
        assert not bool((filtered.clipped() & (light < 0.95)).any())


def test_frames_that_are_no_numbers_do_not_stay() -> None:
    """A NaN in one frame is gone in the next."""
    light = make_light()
    broken = light.clone()
    broken[10, 11] = torch.nan
    frames = [Mosaic(x, Layout(), 0.0, 1.0) for x in (light, broken, light)]
    found, _ = run(frames)
    assert np.isnan(found[1]).sum() == 1 and np.array_equal(found[2], light.numpy())


# The state


def test_a_stream_goes_on_from_a_file_bit_for_bit(tmp_path: Path) -> None:
    """State to npz and back after every kind of frame; nothing that was handed over has changed."""
    light = make_light()
    frames = [shoot(light + blob(slice(40, 50), slice(4 * k, 4 * k + 10)), k) for k in range(12)]
    expected, last = run(frames)
    _, state = run(frames[:7])
    np.savez(tmp_path / "state.npz", **state.to_arrays())
    with np.load(tmp_path / "state.npz") as arrays:
        resumed = TemporalState.from_arrays(dict(arrays))
    copies = {name: array.copy() for name, array in resumed.to_arrays().items()}
    first = resumed
    for frame, image in zip(frames[7:], expected[7:], strict=True):
        filtered, resumed = filter_frame(frame, resumed)
        assert filtered.data.numpy().tobytes() == image.tobytes()
    assert all(np.array_equal(array, copies[name]) for name, array in first.to_arrays().items())
    assert all(np.array_equal(array, last.to_arrays()[name]) for name, array in resumed.to_arrays().items())


def test_bytes_do_not_depend_on_threads() -> None:
    frames = [shoot(make_light() + blob(slice(40, 50), slice(4 * k, 4 * k + 10)), k) for k in range(4)]
    before = get_threads()
    try:
        found = []
        for count in (1, 3):
            set_threads(count)
            found.append(run(frames)[0][-1].tobytes())
    finally:
        set_threads(before)
    assert found[0] == found[1]


@pytest.mark.parametrize("size", [(96, 128), (94, 127), (5, 6), (8, 40)])
def test_the_kernel_is_the_reference(size: tuple[int, int]) -> None:
    """On still, moving, clipping and odd frames, to rounding."""
    light, state, readable = make_light(brightest=1.2), None, None
    for number in range(6):
        frame = shoot(light + blob(slice(40, 50), slice(4 * number, 4 * number + 10)), number)
        frame = replace(frame, data=frame.data[: size[0], : size[1]].contiguous())
        found, state = filter_frame(frame, state)
        expected, readable = filter_frame_reference(frame, readable)
        assert_within(found.data / 4095, expected.data / 4095, ROUNDING[torch.float32])
        assert_within(state.count, readable.count, 16 * ROUNDING[torch.float32])
        assert found.data.shape == frame.data.shape and found.data.is_contiguous()


#: Noise, black and white of frames whose every number is known, and of how many frames their means are.
GAIN, FLOOR, BLACK, BEFORE = 0.5, 9.0, 240.0, 4
KNOWN = Levels(BLACK, 4095.0, 1.0, 4091.0)
FILTERS = {"kernel": filter_samples_by_kernel, "reference": filter_samples}


def filtered_by(name: str, score: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Samples that differ from means of four frames by ``score`` standard deviations; filtered; the means; counts."""
    mean = (BLACK + 50 + 40 * np.random.default_rng(4).random(score.shape)).astype(np.float32)
    sigma = np.sqrt((GAIN * (mean.astype(np.float64) - BLACK) + FLOOR) * (1 + 1 / BEFORE))
    samples = (mean + score * sigma).astype(np.float32)
    count = np.full([n // BLOCK for n in score.shape], BEFORE, np.float32)
    found, new, number = FILTERS[name](samples, (mean, count), make_rules(Noise(GAIN, FLOOR), KNOWN))
    assert np.array_equal(found, new)
    return samples, found, mean, number


@pytest.mark.parametrize("name", FILTERS)
def test_a_drift_is_weighed_as_kalman_says(name: str) -> None:
    """All samples 0.3 deviations high: 25 blocks' sum squared is 25 times 0.09, beyond 1.75 by 0.5, a lag of 0.02.

    With the 5/4 of means of four frames, 0.025: 1 + 1 / (1/4 + 0.025) frames. At 0.2 deviations there is no lag; at
    0.35, 0.066 exceeds 0.05 and the current frame alone counts.
    """
    inside = (slice(2, -2), slice(2, -2))
    for size, expected in ((0.2, 5.0), (0.3, 1 + 1 / (0.25 + 0.025)), (0.35, 1.0)):
        samples, found, mean, number = filtered_by(name, np.full((32, 40), size))
        np.testing.assert_allclose(number[inside], expected, rtol=1e-3)
        mixed = mean + (samples - mean) / expected
        np.testing.assert_allclose(found[8:-8, 8:-8], mixed[8:-8, 8:-8], rtol=1e-5)


@pytest.mark.parametrize("name", FILTERS)
def test_rough_and_sudden_changes_have_their_limits(name: str) -> None:
    """Signs that cancel over blocks: beyond a mean square of 1.5 the excess is lag. One block alone restarts at 3."""
    signs = np.indices((8, 10)).sum(0).repeat(BLOCK, 0).repeat(BLOCK, 1) % 2 * 2 - 1
    for square, expected in ((1.45, 5.0), (1.52, 1 + 1 / (0.25 + 0.025)), (1.56, 1.0)):
        _, _, _, number = filtered_by(name, math.sqrt(square) * signs)
        np.testing.assert_allclose(number[2:-2, 2:-2], expected, rtol=1e-3)
    alone = np.zeros((32, 40))
    alone[16:20, 20:24] = 1
    for square, expected in ((2.95, 5.0), (3.05, 1.0)):
        _, _, _, number = filtered_by(name, math.sqrt(square) * alone)
        np.testing.assert_allclose(number[3:6, 4:7], expected, rtol=1e-3)
        assert (np.delete(number, (3, 4, 5), axis=0) == 5).all()


# Separated images


@pytest.mark.parametrize(("size", "side"), [((48, 64), 2), ((96, 128), 4), ((47, 63), 2), ((94, 126), 4)])
def test_images_follow_their_blocks(size: tuple[int, int], side: int) -> None:
    """Blocks of one frame are handed on as they are, others are means over up to four, at both resolutions."""
    frame = (4 * size[0] // side, 4 * size[1] // side)
    rng = np.random.default_rng(3)
    light = make_light()[: frame[0], : frame[1]].contiguous()
    _, state = filter_frame(Mosaic(light, Layout(), 0.0, 1.0))
    count = rng.integers(1, 7, state.count.shape).astype(np.float32)
    state = replace(state, count=count)
    images = tuple(rng.random((*size, channels), np.float32) for channels in (3, 1))
    before = tuple(rng.random((*size, channels), np.float32) for channels in (3, 1))
    found = steady_images(images, before, state)
    weight = (1 / np.minimum(count, 4)).repeat(side, axis=0).repeat(side, axis=1)[: size[0], : size[1], None]
    for new, old, image in zip(images, before, found, strict=True):
        assert np.abs(image - (old + weight * (new - old))).max() < ROUNDING[torch.float32]
        assert np.array_equal(image[weight[..., 0] == 1], new[weight[..., 0] == 1])
    assert steady_images(images, None, state) is images
    with pytest.raises(ValueError, match="as before, found"):
        steady_images(images, before[::-1], state)
    with pytest.raises(ValueError, match=r"expected images \[h, w, C\] of"):
        steady_images((images[0][:-2],), (before[0][:-2],), state)


# The noise


@pytest.mark.parametrize(
    "sensor", [IMX250, Sensor(2500.0, 2.4, 12), Sensor(10_500.0, 40.0, 12)], ids=["", "gain", "read"]
)
@pytest.mark.parametrize("moving", [0.0, 0.3])
def test_the_noise_is_the_cameras(sensor: Sensor, moving: float) -> None:
    """Its variance at a twentieth, a third and 0.7 of white is found within 20 %, with 30 % of the frame moving too."""
    light = make_light().clamp(min=0.03)
    changed = light.clone()
    changed[:, : int(moving * SIZE[1])] = make_light(2).clamp(min=0.03)[:, : int(moving * SIZE[1])]
    frames = [shoot(light, 1, sensor).data.float().numpy(), shoot(changed, 2, sensor).data.float().numpy()]
    count = np.ones((SIZE[0] // BLOCK, SIZE[1] // BLOCK), np.float32)
    found = estimate_noise(frames[1], (frames[0], count), CODES, 0)
    assert found is not None
    for signal in (0.05, 0.33, 0.7):
        expected = float(sensor.noise_variance(torch.tensor(signal))) * 4095**2
        assert float(found.variance(np.float32(4095 * signal))) == pytest.approx(expected, rel=0.2)


def test_clipped_parts_say_nothing_of_the_noise() -> None:
    """It is that of the others, a little more where neighbours alone tell."""
    light = make_light().clamp(min=0.03)
    light[: SIZE[0] // 2] = 2
    frames = [shoot(light, seed).data.float().numpy() for seed in (1, 2)]
    count = np.ones((SIZE[0] // BLOCK, SIZE[1] // BLOCK), np.float32)
    for before, more in ((None, 1.2), ((frames[0], count), 1.0)):
        found = estimate_noise(frames[1], before, CODES, 0)
        assert found is not None
        expected = float(IMX250.noise_variance(torch.tensor(0.5))) * 4095**2
        assert float(found.variance(np.float32(4095 * 0.5))) == pytest.approx(more * expected, rel=0.2)


@pytest.mark.parametrize("frames", [1, 9])
def test_the_noise_over_a_black_level_is_the_same(frames: int) -> None:
    """A signal counts from black on, and means of nine frames have a ninth of the noise."""
    light, black = make_light().clamp(min=0.03), 240
    shots = [shoot(light, seed).data.float().numpy() + black for seed in range(frames + 1)]
    count = np.full((SIZE[0] // BLOCK, SIZE[1] // BLOCK), frames, np.float32)
    levels = Levels(black, 4095.0 + black, 1.0, 4091.0 + black)
    found = estimate_noise(shots[0], (np.mean(shots[1:], axis=0, dtype=np.float32), count), levels, 0)
    assert found is not None
    for signal in (0.05, 0.33, 0.7):
        expected = float(IMX250.noise_variance(torch.tensor(signal))) * 4095**2
        assert float(found.variance(np.float32(4095 * signal))) == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize(
    ("change", "share", "expected"), [(0.0, 0.0, 1.0), (3.0, 0.3, 1.0), (1e3, 1.0, 1.15)], ids=["still", "busy", "pan"]
)
def test_the_noise_of_flat_light_is_known_to_percents(change: float, share: float, expected: float) -> None:
    """Blocks are counted by the median of what is left of them without moving ones; neighbours by 1.15 times theirs.

    ``change``: variance by which a ``share`` of blocks differs more from the frame before, in variances of the noise.
    """
    rng, size, variance = np.random.default_rng(8), (512, 512), 400.0
    now, before = (1500 + variance**0.5 * rng.standard_normal(size) for _ in range(2))
    moving = (rng.random([n // BLOCK for n in size]) < share).repeat(BLOCK, 0).repeat(BLOCK, 1)
    before += moving * (2 * change * variance) ** 0.5 * rng.standard_normal(size)
    count = np.ones([n // BLOCK for n in size], np.float32)
    found = estimate_noise(now.astype(np.float32), (before.astype(np.float32), count), CODES, 0)
    assert found is not None
    assert float(found.variance(np.float32(1500))) == pytest.approx(expected * variance, rel=0.04)


def test_the_noise_of_a_stream_is_the_mean_of_its_estimates() -> None:
    """Every frame tells for the first eight, every fourth from then on; the latest sixteen estimates count."""
    light = make_light().clamp(min=0.03)
    state, estimates, gains = None, [], []
    for number in range(24):
        frame = shoot(light, number)
        before = state
        _, state = filter_frame(frame, state)
        if before is None:
            continue
        if before.frames <= 8 or before.frames % 4 == 0:
            data = frame.data.float().numpy()
            found = estimate_noise(data, (before.mean, before.count), CODES, before.frames)
            assert found is not None
            estimates.append(found.gain)
        gains.append(float(np.mean(estimates)))
        assert state.estimates == len(estimates)
        assert state.noise.gain == pytest.approx(gains[-1], rel=1e-6)


def test_the_noise_of_a_pan_is_that_of_its_smooth_parts() -> None:
    """Where every sample has changed, neighbours tell; the filter then hands every frame on as it is."""
    frames = [shoot(make_light(seed), seed) for seed in (1, 2)]
    found, state = run(frames)
    assert float(state.noise.variance(np.float32(1500))) == pytest.approx(0.39 * 1500 + 1, rel=0.5)
    same = found[1] == frames[1].data.float().numpy()
    assert float(np.mean(same)) > 0.98


def test_black_or_clipped_frames_have_the_least_noise() -> None:
    """No block can tell: the noise is that of rounding."""
    for value in (0, 4095):
        frame = Mosaic(torch.full(SIZE, value, dtype=torch.uint16), Layout(), 0.0, 4095.0)
        _, state = run([frame, frame])
        assert state.noise == least_noise(CODES)


# Bad input


def test_frames_that_do_not_go_on_are_refused() -> None:
    """One line says what was expected and what was found."""
    frame = shoot(make_light(), 1)
    _, state = filter_frame(frame)
    with pytest.raises(ValueError, match=r"expected frames of 96x128 as before, found 92x128"):
        filter_frame(replace(frame, data=frame.data[:92]), state)
    with pytest.raises(
        ValueError, match=r"expected black and white at \(0.0, 4095.0\) as before, found \(16.0, 4095.0\)"
    ):
        filter_frame(replace(frame, black_level=16.0), state)
    with pytest.raises(ValueError, match=r"expected one raw frame \[H, W\] of at least 4x4, found \(2, 96, 128\)"):
        filter_frame(replace(frame, data=torch.stack([frame.data] * 2)))
    arrays = state.to_arrays()
    with pytest.raises(ValueError, match="expected the arrays mean, count, numbers, counts of a temporal state"):
        TemporalState.from_arrays({name: arrays[name] for name in ("mean", "count")})
    with pytest.raises(ValueError, match="expected the arrays"):
        TemporalState.from_arrays(arrays | {"count": arrays["count"][1:]})
