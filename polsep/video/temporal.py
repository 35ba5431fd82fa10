"""Less flicker in video: where nothing moves, raw samples are averaged over frames before any method sees them.

The filter works on blocks of 4x4 samples, one period of any layout, with the noise that `noise` measures in the stream.
Changes of a block are detected in the differences of its samples to their means, in standard deviations; without a
change, these have mean 0 and mean square 1:

* sudden: the mean square of one block exceeds `SUDDEN`. It and the blocks around it restart.
* slow: over 5x5 blocks, differences behind the same filter have one sign (fading light, soft moving highlights). Their
  excess over the noise is the lag of the means, squared, in variances of a sample.
* rough: the mean square over 3x3 blocks exceeds `ROUGH` (fine texture that moves slowly); the excess counts as lag too.

A block that has averaged ``n`` frames has averaged min(1 + 1 / (1/n + lag), `FRAMES`) with the next: the optimal weight
(Kalman 1960) of a mean that is off by the lag. Beyond `LAG` it restarts: where something moves, the samples of the
current frame are returned unchanged, bit for bit, so that no highlight leaves a trace. A clipped sample is returned
unchanged too; its mean, of clipped values, is only a reference for later frames.

Moving objects also disturb the separated images of still ones near them, through the windows of demosaickers, methods
and networks. `steady_images` averages those too, over fewer frames.

The only state of a stream is its `TemporalState`, a value: the same state and frame give the same bytes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from polsep.compute.arrays import of_kind, to_numpy
from polsep.sensor.camera import Mosaic, clip_level
from polsep.sensor.noise import BLOCK, Floats, Levels, Noise, blocks_of, code_step, estimate_noise, least_noise

if TYPE_CHECKING:
    from polsep.video.temporal_kernel import Rules

#: Diffuse, specular, or other images of a method, ``[h, w, C]`` each.
Images = tuple[Floats, ...]

#: Largest number of averaged frames.
FRAMES = 16.0
#: Largest number of averaged frames of separated images: their disturbances are not noise, but move.
IMAGE_FRAMES = 4.0
#: Mean square of the 16 differences of a block from which it has changed: 5 blocks in 100 000 of a still picture.
SUDDEN = 3.0
#: Mean square of the signed sums over 5x5 blocks, and of the differences of 3x3 blocks, up to which lag is 0.
SLOW, ROUGH = 1.75, 1.5
#: Squared lag from which a block restarts, in variances of a sample: a quarter of its standard deviation.
LAG = 0.05
#: Blocks on either side that make up the windows of slow and of rough changes, and that restart with a sudden one.
SLOW_REACH, REACH = 2, 1
#: The noise is measured in each of the first frames, then in every fourth; number of averaged estimates.
FIRST_FRAMES, EVERY, ESTIMATES = 8, 4, 16


@dataclass(frozen=True)
class TemporalState:
    """The state of a stream between frames.

    ``mean [H, W]`` float32, in the unit of the samples, including clipped ones. ``count [H/4, W/4]`` float32: number
    of frames in each block's mean. ``noise``: measured so far, from ``estimates`` of it. ``frames`` so far.
    ``levels``: black and white.
    """

    mean: Floats
    count: Floats
    noise: Noise
    estimates: int
    frames: int
    levels: tuple[float, float]

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """The state as arrays for an npz file, exactly."""
        numbers = (self.noise.gain, self.noise.floor, *self.levels)
        counts = np.array([self.estimates, self.frames], np.int64)
        return {"mean": self.mean, "count": self.count, "numbers": np.array(numbers, np.float64), "counts": counts}

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[Any]]) -> TemporalState:
        """The inverse of `to_arrays`. Raises ValueError on other arrays."""
        expected = {
            "mean": (np.float32, 2),
            "count": (np.float32, 2),
            "numbers": (np.float64, 1),
            "counts": (np.int64, 1),
        }
        found = {name: (arrays[name].dtype.type, arrays[name].ndim) for name in expected if name in arrays}
        fits = found == expected and arrays["numbers"].size == 4 and arrays["counts"].size == 2
        if not fits or arrays["count"].shape != _blocks(arrays["mean"].shape):
            raise ValueError(f"expected the arrays {', '.join(expected)} of a temporal state, found {sorted(arrays)}")
        gain, floor, black, white = (float(x) for x in arrays["numbers"])
        estimates, frames = (int(x) for x in arrays["counts"])
        return cls(arrays["mean"], arrays["count"], Noise(gain, floor), estimates, frames, (black, white))


def filter_frame(mosaic: Mosaic, state: TemporalState | None = None) -> tuple[Mosaic, TemporalState]:
    """The next raw frame of a stream with less noise where nothing moves, and the state for the one after it.

    The frame is ``[H, W]``, of any layout; the filtered one is float32 in the same unit. ``state`` None: the stream
    begins, and the frame is returned unchanged. Nothing is changed in place. Frames share memory with states: write to
    neither. Raises ValueError on a batch, and on a frame of another size or other levels.
    """
    from polsep.video import temporal_kernel as temporal

    return _filter(mosaic, state, temporal.filter_samples)


def filter_frame_reference(mosaic: Mosaic, state: TemporalState | None = None) -> tuple[Mosaic, TemporalState]:
    """`filter_frame` by the readable `filter_samples` instead of compiled code; the same to rounding."""
    return _filter(mosaic, state, filter_samples)


def steady_images(images: Images, before: Images | None, state: TemporalState) -> Images:
    """Separated images ``[h, w, C]`` of a filtered frame, steadier where its blocks have been still for frames.

    The images are of half or full resolution; ``before``: the result for the frame before, None at first;
    ``state``: as `filter_frame` returned it with the frame. A restarted block is returned unchanged. Raises
    ValueError on images of another size than before, or of neither resolution.
    """
    if before is None:
        return images
    from polsep.video.temporal_kernel import blend_images

    weight = 1 / np.minimum(state.count, np.float32(IMAGE_FRAMES))
    sides = _sides(images, before, state.mean.shape)
    return tuple(blend_images((new, old), weight, side) for new, old, side in zip(images, before, sides, strict=True))


def _sides(images: Images, before: Images, frame: tuple[int, ...]) -> list[int]:
    """The side of a block of the frame in pixels of each image."""
    shapes, old = ([image.shape for image in some] for some in (images, before))
    if shapes != old:
        raise ValueError(f"expected images of {old} as before, found {shapes}")
    known = {frame: BLOCK, tuple(n // 2 for n in frame): BLOCK // 2}
    wrong = [shape for shape in shapes if len(shape) != 3 or shape[:2] not in known]
    if wrong:
        raise ValueError(f"expected images [h, w, C] of {' or '.join(map(str, known))} pixels, found {wrong[0]}")
    return [known[shape[:2]] for shape in shapes]


def _filter(mosaic: Mosaic, state: TemporalState | None, apply: Any) -> tuple[Mosaic, TemporalState]:
    raw = _raw_samples(mosaic, state)
    samples = _padded(raw)
    levels = _levels_of(mosaic, samples)
    if state is None:
        estimate = estimate_noise(samples, None, levels, 0)
        noise = estimate or least_noise(levels)
        count = np.ones(_blocks(raw.shape), np.float32)
        mean = raw.astype(np.float32)
        state = TemporalState(mean, count, noise, 0, 1, (levels.black, levels.white))
        return replace(mosaic, data=of_kind(mean, mosaic.data)), state
    before = (_padded(state.mean), state.count)
    noise, estimates = _next_noise(samples, before, levels, state)
    filtered, mean, count = apply(samples, before, make_rules(noise, levels))
    filtered, mean = (np.ascontiguousarray(x[: raw.shape[0], : raw.shape[1]]) for x in (filtered, mean))
    state = TemporalState(mean, count, noise, estimates, state.frames + 1, state.levels)
    return replace(mosaic, data=of_kind(filtered, mosaic.data)), state


def _raw_samples(mosaic: Mosaic, state: TemporalState | None) -> NDArray[Any]:
    """The samples of a frame for the kernel. Raises ValueError if they do not continue the stream."""
    data, levels = mosaic.data, (float(mosaic.black_level), float(mosaic.white_level))
    if data.ndim != 2 or min(data.shape) < BLOCK:
        raise ValueError(f"expected one raw frame [H, W] of at least {BLOCK}x{BLOCK}, found {tuple(data.shape)}")
    if state is not None and tuple(data.shape) != state.mean.shape:
        sizes = ["x".join(str(n) for n in shape) for shape in (state.mean.shape, data.shape)]
        raise ValueError(f"expected frames of {sizes[0]} as before, found {sizes[1]}")
    if state is not None and levels != state.levels:
        raise ValueError(f"expected black and white at {state.levels} as before, found {levels}")
    samples = to_numpy(data)
    return samples if samples.dtype in (np.uint8, np.uint16, np.float32) else samples.astype(np.float32)


def _blocks(shape: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(-(-n // BLOCK) for n in shape)


def _padded(image: NDArray[Any]) -> NDArray[Any]:
    """The image padded to complete blocks, with samples one period before, behind the same filters."""
    for axis in (0, 1):
        missing = -image.shape[axis] % BLOCK
        if missing:
            n = image.shape[axis]
            image = np.concatenate([image, image.take(range(n - BLOCK, n - BLOCK + missing), axis)], axis)
    return image


def _levels_of(mosaic: Mosaic, samples: NDArray[Any]) -> Levels:
    """Levels of a frame; a row of samples shows the step between their codes."""
    black, white = float(mosaic.black_level), float(mosaic.white_level)
    step = code_step(samples[samples.shape[0] // 2][None], white - black)
    return Levels(black, white, step, clip_level(black, white))


def _next_noise(
    samples: NDArray[Any], before: tuple[Floats, Floats], levels: Levels, state: TemporalState
) -> tuple[Noise, int]:
    """The noise that is known when a frame has come, and from how many estimates."""
    if state.frames > FIRST_FRAMES and state.frames % EVERY:
        return state.noise, state.estimates
    found = estimate_noise(samples, before, levels, state.frames)
    if found is None:
        return state.noise, state.estimates
    number = state.estimates + 1
    weight, old = 1 / min(number, ESTIMATES), state.noise
    gain, floor = old.gain + weight * (found.gain - old.gain), old.floor + weight * (found.floor - old.floor)
    return Noise(gain, floor), number


def make_rules(noise: Noise, levels: Levels) -> Rules:
    """The parameters of the filter for a frame."""
    from polsep.video.temporal_kernel import Rules

    numbers = (noise.gain, noise.floor, levels.black, levels.clip, FRAMES, SUDDEN, SLOW, ROUGH, LAG)
    return Rules(*(np.float32(x) for x in numbers))


def filter_samples(raw: NDArray[Any], before: tuple[Floats, Floats], rules: Rules) -> tuple[Floats, Floats, Floats]:
    """Samples ``[H, W]`` filtered, and new means and counts ``[H/4, W/4]`` from those ``before``; see the module.

    H and W are multiples of 4. Twin of `video.temporal_kernel.filter_samples`.
    """
    (mean, count), samples = before, raw.astype(np.float32)
    anew, lag = find_changes(samples, before, rules)
    grown = np.minimum(1 + 1 / (1 / count + lag), rules.most)
    count = np.where(anew, np.float32(1), grown).astype(np.float32)
    weight = _per_sample(1 / count)
    mean = np.where(weight == 1, samples, mean + (samples - mean) * weight)
    return np.where(samples >= rules.clip, samples, mean), mean, count


def find_changes(samples: Floats, before: tuple[Floats, Floats], rules: Rules) -> tuple[NDArray[np.bool_], Floats]:
    """The blocks ``[H/4, W/4]`` that restart, and the squared lag of their means in variances."""
    mean, count = before
    variance = rules.gain * np.maximum(mean - rules.black, 0) + rules.floor
    score = (samples - mean) / np.sqrt(variance * _per_sample(1 + 1 / count))
    scores = blocks_of(score)
    square = np.square(scores).mean(axis=-1)
    calm = square <= rules.sudden  # not so where a sample is no number
    scores, square, kept = np.where(calm[..., None], scores, 0), np.where(calm, square, 0), calm.astype(np.float32)
    blocks = np.maximum(_window_sum(kept, SLOW_REACH), 1)
    slow = np.square(_window_sum(scores, SLOW_REACH)).mean(axis=-1) / blocks
    rough = _window_sum(square, REACH) / np.maximum(_window_sum(kept, REACH), 1)
    excess = np.maximum((slow - rules.slow) / blocks, rough - rules.rough)
    lag = np.maximum(excess, 0) * (1 + 1 / count)
    return (_window_sum(1 - kept, REACH) > 0) | (lag > rules.lag), lag


def _per_sample(blocks: NDArray[Any]) -> Floats:
    return blocks.astype(np.float32).repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)


def _window_sum(values: Floats, reach: int) -> Floats:
    """Sums over 2 ``reach`` + 1 blocks along both first axes, fewer at the borders."""
    for axis in (0, 1):
        padding = [(reach, reach) if k == axis else (0, 0) for k in range(values.ndim)]
        padded, n = np.pad(values, padding), values.shape[axis]
        values = sum((padded.take(range(k, k + n), axis) for k in range(2 * reach + 1)), np.zeros_like(values))
    return values
