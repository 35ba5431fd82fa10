"""Endless training examples: random crops of rendered scenes, with a random exposure, camera and noise each.

A lane is the stream of one worker. It keeps a pool of rendered scenes; example number n is a random crop of one of
them, randomly mirrored and transposed, with permuted colours and its own exposure, camera and noise. Every few examples
the oldest scene is replaced. Examples depend on the options, the lane and n alone, so a stream can start at any batch.

Conventions: images at raw resolution, linear, 1 = the white level of one measurement.
"""

from __future__ import annotations

import hashlib
import zlib
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from polsep.physics.stokes import Stokes
from polsep.render.materials import random_materials
from polsep.render.raycast import MeshScene, find_lit, find_view, shade_view
from polsep.render.simulate import HEADROOM, blur, filter_light
from polsep.render.sphere_tracing import Scene
from polsep.render.views import MIN_LEVEL, random_shot, scene_seed, seeded_shape
from polsep.sensor.camera import IMX250, Layout, Sensor
from polsep.train.variety import (
    LitView,
    random_sensor,
    relight,
    render_sheen,
    vary_colors,
    vary_gloss,
    vary_normals,
    vary_polarization,
    vary_retention,
    vary_shot,
)

#: Views of a shape; lights, each with new materials, per view.
VIEWS, LIGHTS = 2, 3
#: The brightest object samples of a scene are kept as quantiles: from this share on, and how many.
LOWEST_QUANTILE, QUANTILES = 0.94, 601
#: Share of examples without clipping, and the range of their brightest sample, as a share of white.
UNCLIPPED_SHARE, BRIGHTEST = 0.25, (0.4, HEADROOM)
#: Range of the share of object samples that clip in the others; density falls with the inverse square root.
CLIPPED = (0.0005, 0.06)
#: Share of examples exposed for their median instead, whatever clips, in general and with glaring highlights. Glaring:
#: the brightest 0.3 % of the object's samples exceed the median of the lit ones by this factor. Range of that median,
#: as a share of white.
LEVEL_SHARE, GLARING_SHARE, GLARING, LEVELS = 0.2, 0.8, (0.003, 10.0), (0.05, 0.4)
#: Share of crops centred on one of the brightest object pixels, and the share of these pixels: highlights and white
#: surfaces clip there, which the networks must learn to distinguish.
BRIGHT_SHARE, BRIGHT_PIXELS = 0.3, 0.02
#: Least share of a crop on objects, and most draws to reach it.
MIN_COVERED, MAX_DRAWS = 0.6, 4

#: Largest light, in white levels: half precision holds it.
MAX_LIGHT = 2.0**14

#: Kinds of scenes: "varied" has all of `variety`; "usual", as the paper's training data, has smooth surfaces of usual
#: gloss, diffuse light polarized by Fresnel transmission, and none that keeps the lamp's polarization.
LOOK_KINDS = ("varied", "usual")
#: Sony's order without colours.
MONO = Layout(bayer=None)
#: Analysers of the examples [rad].
ANGLES = Layout().angles


@dataclass(frozen=True)
class StreamOptions:
    """Options of a stream: ``batch`` crops of ``crop`` x ``crop`` raw pixels from views of ``size`` x ``size``.

    ``pool``: scenes per lane; ``uses``: mean number of times that a scene's pixels are used before it is replaced; 0
    for one crop of each. ``samples``: rays along a pixel's side. ``looks``: one of `LOOK_KINDS`. Raises ValueError when
    crops do not fit or are no multiples of the mosaic's period.
    """

    split: str = "train"
    seed: int = 0
    batch: int = 8
    crop: int = 256
    size: int = 512
    samples: int = 2
    pool: int = 48
    uses: int = 6
    looks: str = "varied"

    def __post_init__(self) -> None:
        if self.crop % 4 or not 4 <= self.crop <= self.size:
            raise ValueError(f"expected crops of a multiple of 4 up to {self.size} pixels, found {self.crop}")
        if min(self.batch, self.samples, self.pool, self.uses + 1) < 1:
            raise ValueError(f"expected batch, samples and pool of at least 1 and uses of at least 0, found {self}")
        if self.looks not in LOOK_KINDS:
            raise ValueError(f"expected looks of {' or '.join(LOOK_KINDS)}, found {self.looks!r}")

    @property
    def reuse(self) -> int:
        """Examples before a scene is replaced."""
        return max(1, self.uses * self.size**2 // self.crop**2)


class Examples(NamedTuple):
    """A batch: noisy ``raw [B, H, W]``, clipped at 1, and the truth behind it.

    ``diffuse [B, 3, H, W]``, white ``specular [B, 1, H, W]``: s0. ``polarized``: s1 and s2 of their sum
    ``[B, 6, H, W]``. ``mask``: bool ``[B, H, W]``, on objects. Truth in half precision.
    """

    raw: Tensor
    diffuse: Tensor
    specular: Tensor
    polarized: Tensor
    mask: Tensor


@dataclass(frozen=True)
class PooledScene:
    """A scene of the pool, in half precision, scaled so that the brightest object sample is 1.

    ``diffuse [9, H, W]``: s0, s1, s2 of three colours each; ``specular [3, H, W]``: of white light. ``places [N, 2]``:
    all object pixels; ``bright [M, 2]``: the brightest ones; ``brightness``: quantiles of the object's samples;
    ``level``: median of the lit ones.
    """

    diffuse: Tensor
    specular: Tensor
    mask: Tensor
    places: Tensor
    bright: Tensor
    brightness: Tensor
    level: float


class ExampleStream(IterableDataset[Examples]):
    """Batches from number ``start`` on, for a `DataLoader` without batching; its workers are the lanes.

    ``process``: rank and number of the processes that train together; each has its own lanes.
    """

    def __init__(self, options: StreamOptions, start: int = 0, process: tuple[int, int] = (0, 1)) -> None:
        super().__init__()
        self.options, self.start, self.process = options, start, process

    def __iter__(self) -> Iterator[Examples]:
        """Yield batches ``start``, ``start`` + 1, ... of which every lane makes its share."""
        worker = get_worker_info()
        lane, lanes = (worker.id, worker.num_workers) if worker else (0, 1)
        # The loader asks its first worker first, wherever the stream starts.
        lane = (self.start + lane) % lanes
        first = -(-(self.start - lane) // lanes)
        return stream_lane(self.options, self.process[0] * lanes + lane, first)


def stream_lane(options: StreamOptions, lane: int, first: int) -> Iterator[Examples]:
    """Yield the batches of one lane from its number ``first`` on."""
    scenes = pool_scenes(options, lane, first * options.batch // options.reuse)
    pool: deque[PooledScene] = deque(maxlen=options.pool)
    newest = first * options.batch // options.reuse - 1
    while len(pool) < options.pool:
        pool.append(next(scenes))
        newest += 1
    oldest = newest - options.pool + 1
    while True:
        crops, number = [], first * options.batch
        for k in range(options.batch):
            if (number + k) // options.reuse > oldest:
                pool.append(next(scenes))
                oldest += 1
            crops.append(random_crop(pool, options.crop, _generator(options, lane, number + k)))
        yield expose_crops(crops, _generator(options, lane, number, "noise"))
        first += 1


def _generator(options: StreamOptions, lane: int, number: int, use: str = "crop") -> torch.Generator:
    label = f"{use}/{options.split}/{options.seed}/{lane}/{number}"
    return torch.Generator().manual_seed(int.from_bytes(hashlib.sha256(label.encode()).digest()[:8]) >> 1)


def pool_scenes(options: StreamOptions, lane: int, first: int) -> Iterator[PooledScene]:
    """Yield the scenes of a lane from number ``first`` on: `VIEWS` of every shape, each under `LIGHTS` lights."""
    per_shape = VIEWS * LIGHTS
    number = first - first % per_shape
    while True:
        # Lanes take shapes from ranges of their own.
        shape_number = lane * 2**24 + number // per_shape
        shape = seeded_shape(options.split, options.seed, shape_number)
        for view in range(VIEWS):
            if number + LIGHTS > first:
                generator = torch.Generator().manual_seed(scene_seed(options.split, options.seed, shape_number, view))
                scenes = _render_view(shape, options, generator)
                yield from scenes[max(first - number, 0) :]
            number += LIGHTS


def _render_view(shape: MeshScene, options: StreamOptions, generator: torch.Generator) -> list[PooledScene]:
    """A view of a shape under several lights, with new materials under each."""
    shot = vary_shot(shape, random_shot(shape, generator), generator)
    view = find_view(shape, shot.camera, (options.size, options.size), options.samples)
    varied = options.looks == "varied"
    if varied:
        view = vary_normals(view, generator)
    light = shot.light
    scenes = []
    for _ in range(LIGHTS):
        materials = vary_colors(random_materials(shape.mesh.slot_count, generator, shape.size), generator)
        if varied:
            materials = vary_gloss(materials, generator)
        lit_view = LitView(view, materials, light, find_lit(shape, view, light))
        scene = blur(shade_view(*lit_view), shot.blur)
        if varied:
            scene = vary_retention(vary_polarization(scene, generator), partial(render_sheen, lit_view), generator)
        scenes.append(_as_pooled(scene))
        light = relight(shape, shot, generator)
    return scenes


def _as_pooled(scene: Scene) -> PooledScene:
    """The scene for the pool."""
    signal = filter_light(scene.diffuse + scene.specular, Layout(), IMX250)
    samples = signal[scene.mask]
    lowest = int(LOWEST_QUANTILE * (samples.numel() - 1))
    brightest = np.sort(np.partition(samples.numpy(), lowest)[lowest:])
    ranks = np.linspace(0, brightest.size - 1, QUANTILES).round().astype(np.int64)
    brightness = torch.from_numpy(brightest[ranks])
    bright = (scene.mask & (signal >= float(brightness[_rank(BRIGHT_PIXELS)]))).nonzero()
    gain, lit = 1 / max(float(brightness[-1]), 1e-12), samples[samples > 0]
    level = gain * float(lit.median()) if lit.numel() else 1.0
    white = scene.specular.map(lambda s: s[:1])
    diffuse, specular = (torch.cat([s.s0, s.s1, s.s2]).mul_(gain).half() for s in (scene.diffuse, white))
    return PooledScene(diffuse, specular, scene.mask, scene.mask.nonzero(), bright, brightness * gain, level)


class Crop(NamedTuple):
    """A crop before its exposure: ``light [12, h, w]``, half precision, the scene's diffuse and specular planes.

    ``factors [12]`` bring them to the white level, with the signs that mirroring gives s1 and s2. ``mask [h, w]``.
    """

    light: Tensor
    factors: Tensor
    mask: Tensor


def random_crop(pool: deque[PooledScene], crop: int, generator: torch.Generator) -> Crop:
    """Return a random crop of one of the scenes, randomly mirrored and transposed, with permuted colours.

    Mirroring changes the sign of s2, transposing that of s1 (`stokes.flip_horizontal`, `stokes.transpose`).
    """
    scene = pool[_integer(len(pool), generator)]
    rows, cols = _random_place(scene, crop, generator)
    across, down, transposed = (_integer(2, generator) for _ in range(3))
    colors = torch.randperm(3, generator=generator)
    planes = torch.cat([colors, colors + 3, colors + 6])
    light = torch.cat([scene.diffuse[:, rows, cols][planes], scene.specular[:, rows, cols]])
    turned = [axis for axis, wanted in ((-1, across), (-2, down)) if wanted]
    light, mask = light.flip(turned), scene.mask[rows, cols].flip(turned)
    if transposed:
        light, mask = light.transpose(-1, -2), mask.T
    s1, s2 = 1 - 2 * transposed, (1 - 2 * across) * (1 - 2 * down)
    signs = torch.tensor([1.0] * 3 + [s1] * 3 + [s2] * 3 + [1.0, s1, s2])
    return Crop(light, random_gain(scene, generator) * signs, mask)


def expose_crops(crops: list[Crop], generator: torch.Generator) -> Examples:
    """Return a batch of crops as the sensor records them, and the truth."""
    factors = torch.stack([crop.factors for crop in crops])[..., None, None]
    light = (torch.stack([crop.light for crop in crops]).float() * factors).clamp(-MAX_LIGHT, MAX_LIGHT)
    diffuse, specular = light[:, :3], light[:, 9:10]
    s1, s2 = light[:, 3:6] + light[:, 10:11], light[:, 6:9] + light[:, 11:12]
    signal = filter_light(Stokes(diffuse + specular, s1, s2), Layout(), IMX250)
    raw = torch.stack([add_gaussian_noise(x, random_sensor(generator), generator) for x in signal])
    polarized = torch.cat([s1.half(), s2.half()], dim=1)
    return Examples(raw, diffuse.half(), specular.half(), polarized, torch.stack([crop.mask for crop in crops]))


def _integer(limit: int, generator: torch.Generator) -> int:
    return int(torch.randint(limit, (1,), generator=generator))


def _random_place(scene: PooledScene, crop: int, generator: torch.Generator) -> tuple[slice, slice]:
    """Rows and columns of a crop around a random object pixel, moved into the frame, with much of the object in it."""
    bright = float(torch.rand(1, generator=generator)) < BRIGHT_SHARE
    places = scene.bright if bright else scene.places
    for _ in range(MAX_DRAWS):
        center = places[_integer(len(places), generator)].tolist()
        starts = [min(max(c - crop // 2, 0), n - crop) for c, n in zip(center, scene.mask.shape, strict=True)]
        rows, cols = (slice(start, start + crop) for start in starts)
        if float(scene.mask[rows, cols].float().mean()) >= MIN_COVERED:
            break
    return rows, cols


def random_gain(scene: PooledScene, generator: torch.Generator) -> float:
    """Return a gain at which a random share of the samples clips, or none, or at which the median has a random level.

    At least that of `views.capture_shot`.
    """
    none, place, level = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
    glaring = float(scene.brightness[_rank(GLARING[0])]) > GLARING[1] * scene.level
    if level < (GLARING_SHARE if glaring else LEVEL_SHARE):
        gain = (LEVELS[0] + (LEVELS[1] - LEVELS[0]) * place) / max(scene.level, 1e-6)
    elif none < UNCLIPPED_SHARE:
        gain = BRIGHTEST[0] + (BRIGHTEST[1] - BRIGHTEST[0]) * place
    else:
        share = CLIPPED[0] + (CLIPPED[1] - CLIPPED[0]) * place**2
        gain = 1 / max(float(scene.brightness[_rank(share)]), 1e-6)
    return float(max(gain, MIN_LEVEL / scene.level))


def _rank(share: float) -> int:
    """Index of the quantile that this share of the object's samples exceeds."""
    return round((1 - share - LOWEST_QUANTILE) / (1 - LOWEST_QUANTILE) * (QUANTILES - 1))


def add_gaussian_noise(signal: Tensor, sensor: Sensor, generator: torch.Generator) -> Tensor:
    """Return a frame of ``signal``, white = 1, with Gaussian noise for shot and read noise, clipped and quantized.

    Ten times faster than the Poisson noise of `camera.add_noise`, and the same except for the few electrons of black
    pixels.
    """
    source = np.random.default_rng(_integer(2**31, generator))
    noise = torch.from_numpy(source.standard_normal(signal.shape, np.float32))
    variance = signal.clamp(min=0) / sensor.full_well + (sensor.read_noise / sensor.full_well) ** 2
    noisy = (signal + variance.sqrt() * noise).clamp(0, 1)
    return torch.round(noisy * sensor.white_level) / sensor.white_level


def expose_mono(examples: Examples) -> Examples:
    """Return examples as a camera without colour filters records their green light: one colour, single precision.

    The seed of noise and sensors is a checksum of the colour frames, so that a batch always gives the same frames.
    """
    diffuse, specular, polarized = (x.float().cpu() for x in examples[1:4])
    diffuse, polarized = diffuse[:, 1:2], polarized[:, 1::3]
    signal = filter_light(Stokes(diffuse + specular, polarized[:, :1], polarized[:, 1:]), MONO, IMX250)
    generator = torch.Generator().manual_seed(zlib.crc32(examples.raw.cpu().numpy().tobytes()))
    raw = torch.stack([add_gaussian_noise(x, random_sensor(generator), generator) for x in signal])
    device = examples.raw.device
    raw, diffuse, specular, polarized = (x.to(device) for x in (raw, diffuse, specular, polarized))
    return Examples(raw, diffuse, specular, polarized, examples.mask)
