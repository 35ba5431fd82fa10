"""Training examples without end: random views rendered in the background, cut, exposed and measured anew every time.

A lane is one worker's stream. It keeps a pool of rendered scenes; example number n is a random crop of one of them,
mirrored and turned at random, with its colours permuted, its own exposure and noise. After every few examples the
oldest scene gives way to a new one. Everything follows from the options, the lane and n, so a stream that starts at
any batch gives what one from the beginning would.

Conventions: images at raw resolution, linear, 1 = the white level of one measurement.
"""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from polsep.camera import IMX250, Layout, Mosaic, Sensor
from polsep.materials import random_materials
from polsep.raycast import MeshScene, find_view, light_view, shade_view
from polsep.render import PointLight, Scene
from polsep.simulate import HEADROOM, blur, filter_light
from polsep.stokes import Stokes, flip_horizontal, flip_vertical, transpose
from polsep.views import random_clip, random_light, random_shot, scene_seed, seeded_shape

#: Views of a shape, and lights with materials of their own under which each is seen.
VIEWS, LOOKS = 4, 2
#: Brightness of object samples is kept at so many quantiles above this share, for exposures that clip the rest.
LOWEST_QUANTILE, QUANTILES = 0.94, 121
#: Where nothing is to clip, the brightest sample may lie this much lower than `HEADROOM`.
DIMMEST = 0.4


#: Analysers of the examples [rad].
ANGLES = Layout().angles


@dataclass(frozen=True)
class StreamOptions:
    """What a stream gives: ``batch`` crops of ``crop`` x ``crop`` raw pixels from views of ``size`` x ``size``.

    ``pool``: scenes to draw from, per lane; ``reuse``: examples before one of them is replaced. ``samples``: rays along
    a pixel's side. Raises ValueError when crops do not fit or are no multiples of the mosaic's period.
    """

    split: str = "train"
    seed: int = 0
    batch: int = 8
    crop: int = 256
    size: int = 512
    samples: int = 1
    pool: int = 48
    reuse: int = 32

    def __post_init__(self) -> None:
        if self.crop % 4 or not 4 <= self.crop <= self.size:
            raise ValueError(f"expected crops of a multiple of 4 up to {self.size} pixels, found {self.crop}")
        if min(self.batch, self.samples, self.pool, self.reuse) < 1:
            raise ValueError(f"expected batch, samples, pool and reuse of at least 1, found {self}")


class Examples(NamedTuple):
    """A batch: noisy ``raw [B, H, W]``, clipped at 1, and the truth behind it.

    ``diffuse``, ``specular``: s0 ``[B, 3, H, W]``. ``polarized``: s1 and s2 of their sum ``[B, 6, H, W]``. ``mask``:
    bool ``[B, H, W]``, on objects. Truth in half precision.
    """

    raw: Tensor
    diffuse: Tensor
    specular: Tensor
    polarized: Tensor
    mask: Tensor


@dataclass(frozen=True)
class Pooled:
    """A scene in half precision, with the ``places [N, 2]`` and the ``brightness`` quantiles of its object's pixels.

    ``diffuse [9, H, W]``: s0, s1, s2 of three colours each; ``specular [3, H, W]``: of white light.
    """

    diffuse: Tensor
    specular: Tensor
    mask: Tensor
    places: Tensor
    brightness: Tensor


class ExampleStream(IterableDataset[Examples]):
    """Batches from number ``start`` on, for a `DataLoader` without batching; its workers are the lanes.

    ``process``: which of how many processes that train together this one is; each has lanes of its own.
    """

    def __init__(self, options: StreamOptions, start: int = 0, process: tuple[int, int] = (0, 1)) -> None:
        super().__init__()
        self.options, self.start, self.process = options, start, process

    def __iter__(self) -> Iterator[Examples]:
        """Batches ``start``, ``start`` + 1, ... of which every lane makes its share."""
        worker = get_worker_info()
        lane, lanes = (worker.id, worker.num_workers) if worker else (0, 1)
        # The loader asks its first worker first, wherever the stream starts.
        lane = (self.start + lane) % lanes
        first = -(-(self.start - lane) // lanes)
        return stream_lane(self.options, self.process[0] * lanes + lane, first)


def stream_lane(options: StreamOptions, lane: int, first: int) -> Iterator[Examples]:
    """Batches of one lane, from its own number ``first`` on."""
    scenes = pool_scenes(options, lane, first * options.batch // options.reuse)
    pool: deque[Pooled] = deque(maxlen=options.pool)
    newest = first * options.batch // options.reuse - 1
    while len(pool) < options.pool:
        pool.append(next(scenes))
        newest += 1
    oldest = newest - options.pool + 1
    number = first * options.batch
    while True:
        examples = []
        for _ in range(options.batch):
            if number // options.reuse > oldest:
                pool.append(next(scenes))
                oldest += 1
            examples.append(random_example(pool, options, _generator(options, lane, number)))
            number += 1
        yield Examples(*(torch.stack(images) for images in zip(*examples, strict=True)))


def _generator(options: StreamOptions, lane: int, number: int) -> torch.Generator:
    label = f"example/{options.split}/{options.seed}/{lane}/{number}"
    return torch.Generator().manual_seed(int.from_bytes(hashlib.sha256(label.encode()).digest()[:8]) >> 1)


def pool_scenes(options: StreamOptions, lane: int, first: int) -> Iterator[Pooled]:
    """Scenes of a lane from number ``first`` on: shape after shape, `VIEWS` of each, `LOOKS` of each view."""
    per_shape = VIEWS * LOOKS
    number = first - first % per_shape
    while True:
        # Lanes take shapes from ranges of their own.
        shape_number = lane * 2**24 + number // per_shape
        shape = seeded_shape(options.split, options.seed, shape_number)
        for view in range(VIEWS):
            if number + LOOKS > first:
                generator = torch.Generator().manual_seed(scene_seed(options.split, options.seed, shape_number, view))
                looks = _look_at(shape, options, generator)
                yield from looks[max(first - number, 0) :]
            number += LOOKS


def _look_at(shape: MeshScene, options: StreamOptions, generator: torch.Generator) -> list[Pooled]:
    """One view of a shape under several lights, with other materials under each."""
    shot = random_shot(shape, generator)
    view = find_view(shape, shot.camera, (options.size, options.size), options.samples)
    light: PointLight = shot.light
    looks = []
    for _ in range(LOOKS):
        materials = random_materials(shape.mesh.slot_count, generator, shape.size)
        scene = blur(shade_view(view, materials, light, light_view(shape, view, light)), shot.blur)
        looks.append(_as_pooled(scene))
        light = random_light(shot.camera, shape.size / 2, generator)
    return looks


def _as_pooled(scene: Scene) -> Pooled:
    """A scene for the pool, scaled so that its brightest object sample is 1."""
    samples = filter_light(scene.diffuse + scene.specular, Layout(), IMX250)[scene.mask]
    shares = torch.linspace(LOWEST_QUANTILE, 1, QUANTILES)
    ranks = (shares * (samples.numel() - 1)).round().long()
    brightness = samples.sort().values[ranks]
    gain = 1 / max(float(brightness[-1]), 1e-12)
    white = scene.specular.map(lambda s: s[:1])
    diffuse, specular = (torch.cat([s.s0, s.s1, s.s2]).mul_(gain).half() for s in (scene.diffuse, white))
    return Pooled(diffuse, specular, scene.mask, scene.mask.nonzero(), brightness * gain)


def random_example(pool: deque[Pooled], options: StreamOptions, generator: torch.Generator) -> Examples:
    """One crop of one of the scenes, without the batch's dimension; see the module."""
    scene = pool[_integer(len(pool), generator)]
    rows, cols = _random_place(scene, options.crop, generator)
    lobes = (scene.diffuse, scene.specular)
    light = [Stokes(*x[:, rows, cols].float().view(3, -1, options.crop, options.crop)) for x in lobes]
    mask = scene.mask[None, rows, cols].float()
    for mirror in (flip_horizontal, flip_vertical, transpose):
        if _integer(2, generator):
            light = [mirror(stokes) for stokes in light]
            mask = mirror(Stokes(mask, mask, mask)).s0
    gain, colors = random_gain(scene.brightness, generator), torch.randperm(3, generator=generator)
    diffuse, specular = light[0].map(lambda s: gain * s[colors]), light[1].map(lambda s: gain * s)
    total = diffuse + specular
    raw = add_gaussian_noise(filter_light(total, Layout(), IMX250), IMX250, generator)
    polarized = torch.cat([total.s1.half(), total.s2.half()])
    return Examples(raw, diffuse.s0.half(), specular.s0.half().expand(3, -1, -1), polarized, mask[0] == 1)


def _integer(limit: int, generator: torch.Generator) -> int:
    return int(torch.randint(limit, (1,), generator=generator))


def _random_place(scene: Pooled, crop: int, generator: torch.Generator) -> tuple[slice, slice]:
    """A crop about a random pixel of the object, as far as the frame allows."""
    center = scene.places[_integer(len(scene.places), generator)].tolist()
    starts = [min(max(c - crop // 2, 0), n - crop) for c, n in zip(center, scene.mask.shape, strict=True)]
    rows, cols = (slice(start, start + crop) for start in starts)
    return rows, cols


def random_gain(brightness: Tensor, generator: torch.Generator) -> float:
    """A gain at which a share of the samples clips as `views.random_clip` draws it, or none."""
    share, dim = random_clip(generator), float(torch.rand(1, generator=generator))
    if not share:
        return HEADROOM * (1 - (1 - DIMMEST) * dim)
    place = (1 - share - LOWEST_QUANTILE) / (1 - LOWEST_QUANTILE) * (QUANTILES - 1)
    return 1 / max(float(brightness[round(place)]), 1e-6)


def add_gaussian_noise(signal: Tensor, sensor: Sensor, generator: torch.Generator) -> Tensor:
    """A frame of ``signal``, white = 1: noise, clipping and quantization, a Gaussian for shot and read noise together.

    Ten times faster than `camera.add_noise`, and the same but for the few electrons of black pixels.
    """
    source = np.random.default_rng(_integer(2**31, generator))
    noise = torch.from_numpy(source.standard_normal(signal.shape, np.float32))
    variance = signal.clamp(min=0) / sensor.full_well + (sensor.read_noise / sensor.full_well) ** 2
    noisy = (signal + variance.sqrt() * noise).clamp(0, 1)
    return torch.round(noisy * sensor.white_level) / sensor.white_level


def as_mosaic(raw: Tensor) -> Mosaic:
    """Raw frames of a batch for the demosaickers."""
    return Mosaic(raw, Layout(), 0.0, 1.0)
