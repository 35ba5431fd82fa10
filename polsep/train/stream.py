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
from torch.nn.functional import pixel_unshuffle
from torch.utils.data import IterableDataset, get_worker_info

from polsep.networks.channels import PERIOD
from polsep.networks.thumbnails import keep_color
from polsep.networks.whole_frame import make_thumbnail
from polsep.physics.stokes import Stokes
from polsep.render.materials import Materials, random_materials
from polsep.render.raycast import MeshScene, find_lit, find_view, shade_view
from polsep.render.room import Around, light_from_around, roughen
from polsep.render.sensor_errors import SensorErrors, cross_talk, random_analyser_angles, vary_gains
from polsep.render.simulate import HEADROOM, blur, filter_light
from polsep.render.sphere_tracing import PointLight, Scene
from polsep.render.views import MIN_LEVEL, random_shot, scene_seed, seeded_shape
from polsep.sensor.camera import CLIP_MARGIN, IMX250, Layout, Sensor
from polsep.train.constants import Constant, check_constant, constants_set
from polsep.train.reality import RealScene, Relit, as_ideal, disturb, random_darkness, random_errors
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
#: Distance of a room's lights, in sizes of the shape.
ROOM_DISTANCE = 20.0
#: The brightest object samples of a scene are kept as quantiles: from this share on, and how many.
LOWEST_QUANTILE, QUANTILES = 0.94, 601
#: Share of examples without clipping, and the range of their brightest sample, as a share of white.
UNCLIPPED_SHARE, BRIGHTEST = 0.25, (0.4, HEADROOM)
#: Range of the share of object samples that clip in the others; density falls with the inverse square root.
CLIPPED = (0.0005, 0.06)
#: Share of examples exposed for their median instead, whatever clips, in general and with glaring highlights. Glaring:
#: the brightest 0.3 % of the object's samples exceed the median of the lit ones by this factor. Range of that median,
#: as a share of white.
LEVEL_SHARE, GLARING_SHARE, GLARING, LEVELS = 0.25, 0.8, (0.003, 10.0), (0.05, 0.7)
#: Share of crops centred on one of the brightest object pixels, and the share of these pixels: highlights and white
#: surfaces clip there, which the networks must learn to distinguish.
BRIGHT_SHARE, BRIGHT_PIXELS = 0.3, 0.02
#: Least share of a crop on objects, and most draws to reach it.
MIN_COVERED, MAX_DRAWS = 0.6, 4

#: Largest light, in white levels: half precision holds it.
MAX_LIGHT = 2.0**14

#: Kinds of scenes: "real" has all of `variety` and `reality`; "varied" has all of `variety` under one perfect white
#: lamp; "usual", as the paper's training data, has smooth surfaces of usual gloss, diffuse light polarized by Fresnel
#: transmission, and none that keeps the lamp's polarization.
LOOK_KINDS = ("varied", "usual", "real")
#: Sony's order without colours.
MONO = Layout(bayer=None)
#: Analysers of the examples [rad].
ANGLES = Layout().angles


@dataclass(frozen=True)
class StreamOptions:
    """Options of a stream: ``batch`` crops of ``crop`` x ``crop`` raw pixels from views of ``size`` x ``size``.

    ``pool``: scenes per lane; ``uses``: mean number of times that a scene's pixels are used before it is replaced; 0
    for one crop of each. ``samples``: rays along a pixel's side. ``looks``: one of `LOOK_KINDS`. ``constants``: of
    `train.constants`, where they are not the usual ones. Raises ValueError when crops do not fit or are no multiples of
    the mosaic's period.
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
    constants: tuple[Constant, ...] = ()

    def __post_init__(self) -> None:
        if self.crop % PERIOD or self.size % PERIOD or not PERIOD <= self.crop <= self.size:
            raise ValueError(f"expected crops and views of multiples of 4, found {self.crop} and {self.size} pixels")
        if min(self.batch, self.samples, self.pool, self.uses + 1) < 1:
            raise ValueError(f"expected batch, samples and pool of at least 1 and uses of at least 0, found {self}")
        if self.looks not in LOOK_KINDS:
            raise ValueError(f"expected looks of {' or '.join(LOOK_KINDS)}, found {self.looks!r}")
        for constant in self.constants:
            check_constant(constant)

    @property
    def reuse(self) -> int:
        """Examples before a scene is replaced."""
        return max(1, self.uses * self.size**2 // self.crop**2)


class Examples(NamedTuple):
    """A batch: noisy ``raw [B, H, W]`` less the colour of the lamp that is told, ``clipped``, and the truth behind it.

    ``diffuse [B, 3, H, W]``, ``specular [B, 1, H, W]``: s0, the latter a mean over colours. ``polarized``: s1 and s2 of
    their sum ``[B, 6, H, W]``. ``mask``: bool ``[B, H, W]``, on objects. Truth in half precision, less the told colour
    too. ``thumbnail [B, K, h, w]``, ``light [B, 4]``: of the whole frame, see `networks.whole_frame`.
    """

    raw: Tensor
    clipped: Tensor
    diffuse: Tensor
    specular: Tensor
    polarized: Tensor
    mask: Tensor
    thumbnail: Tensor
    light: Tensor


@dataclass(frozen=True)
class PooledScene:
    """A scene of the pool, in half precision, scaled so that the brightest object sample is 1.

    ``light [18, H, W]``: s0, s1, s2 of three colours each, diffuse, then specular. ``told [3]``: the lamp's colour that
    is divided out; ``common [4]``: truth of `networks.whole_frame.LIGHT`; ``dark``, ``errors``: what sensors may have.
    ``places [N, 2]``: all object pixels; ``bright [M, 2]``: the brightest ones; ``brightness``: quantiles of the
    object's samples; ``level``: median of the lit ones.
    """

    light: Tensor
    told: Tensor
    common: Tensor
    dark: bool
    errors: bool
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
    with constants_set(options.constants):
        while len(pool) < options.pool:
            pool.append(next(scenes))
            newest += 1
    oldest = newest - options.pool + 1
    while True:
        examples, number = [], first * options.batch
        with constants_set(options.constants):
            for k in range(options.batch):
                if (number + k) // options.reuse > oldest:
                    pool.append(next(scenes))
                    oldest += 1
                examples.append(random_example(pool, options.crop, _generator(options, lane, number + k)))
        yield Examples(*(torch.stack(values) for values in zip(*examples, strict=True)))
        first += 1


def _generator(options: StreamOptions, lane: int, number: int) -> torch.Generator:
    label = f"example/{options.split}/{options.seed}/{lane}/{number}"
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
    varied = options.looks != "usual"
    if varied:
        view = vary_normals(view, generator)
    light = shot.light
    scenes = []
    for _ in range(LIGHTS):
        materials = vary_colors(random_materials(shape.mesh.slot_count, generator, shape.size), generator)
        if varied:
            materials = vary_gloss(materials, generator)
        other = relight(shape, shot, generator)
        lit_view = LitView(view, materials, light, find_lit(shape, view, light))
        scene = blur(shade_view(*lit_view), shot.blur)
        if varied:
            scene = vary_retention(vary_polarization(scene, generator), partial(render_sheen, lit_view), generator)
        if options.looks == "real":
            real = disturb(scene, relit_of(shape, lit_view._replace(light=other), shot.blur), generator)
        else:
            real = as_ideal(scene)
        scenes.append(_as_pooled(real, options.looks == "real"))
        light = other
    return scenes


def relit_of(shape: MeshScene, lit_view: LitView, sigma: float) -> Relit:
    """Return the renderers of a view behind a lens of blur ``sigma`` [pixels]; its light is the second lamp."""

    def light_by(light: PointLight, materials: Materials = lit_view.materials) -> Scene:
        lit = find_lit(shape, lit_view.view, light)
        return blur(shade_view(lit_view.view, materials, light, lit), sigma)

    def around(lights: tuple[Tensor, Tensor], roughness: float) -> Scene:
        rough = roughen(lit_view.materials, roughness)
        return light_from_around(partial(light_by, materials=rough), Around(*lights, ROOM_DISTANCE * shape.size))

    return Relit(lambda: light_by(lit_view.light), around)


def _as_pooled(real: RealScene, dark: bool) -> PooledScene:
    """The scene for the pool; ``dark``: with exposures that are darker than usual."""
    scene = real.scene
    signal = filter_light(scene.diffuse + scene.specular, Layout(), IMX250)
    samples = signal[scene.mask]
    lowest = int(LOWEST_QUANTILE * (samples.numel() - 1))
    brightest = np.sort(np.partition(samples.numpy(), lowest)[lowest:])
    ranks = np.linspace(0, brightest.size - 1, QUANTILES).round().astype(np.int64)
    brightness = torch.from_numpy(brightest[ranks])
    bright = (scene.mask & (signal >= float(brightness[_rank(BRIGHT_PIXELS)]))).nonzero()
    gain, lit = 1 / max(float(brightness[-1]), 1e-12), samples[samples > 0]
    level = gain * float(lit.median()) if lit.numel() else 1.0
    planes = [getattr(light, name) for light in (scene.diffuse, scene.specular) for name in ("s0", "s1", "s2")]
    light = torch.cat(planes).mul_(gain).half()
    places, brightness = scene.mask.nonzero(), brightness * gain
    return PooledScene(
        light, real.told, real.light, dark, dark and real.errors, scene.mask, places, bright, brightness, level
    )


def random_example(pool: deque[PooledScene], crop: int, generator: torch.Generator) -> Examples:
    """Return a random crop of one of the scenes, as the sensor records it, and the truth; without a batch's dimension.

    The whole frame is randomly mirrored and transposed, with permuted colours. Mirroring changes the sign of s2,
    transposing that of s1 (`stokes.flip_horizontal`, `stokes.transpose`).
    """
    scene = pool[_integer(len(pool), generator)]
    rows, cols = _random_place(scene, crop, generator)
    across, down, transposed = (_integer(2, generator) for _ in range(3))
    colors = torch.randperm(3, generator=generator)
    light = scene.light[torch.cat([colors + 3 * k for k in range(6)])]
    turned = [axis for axis, wanted in ((-1, across), (-2, down)) if wanted]
    light, mask = light.flip(turned), scene.mask.flip(turned)
    height, width = mask.shape
    rows = slice(height - rows.stop, height - rows.start) if down else rows
    cols = slice(width - cols.stop, width - cols.start) if across else cols
    if transposed:
        light, mask, rows, cols = light.transpose(-1, -2), mask.T, cols, rows
    s1, s2 = 1 - 2 * transposed, (1 - 2 * across) * (1 - 2 * down)
    signs = torch.tensor([1.0] * 3 + [s1] * 3 + [s2] * 3).repeat(2)[:, None, None]
    gain = random_gain(scene, generator) * (random_darkness(generator) if scene.dark else 1.0)
    total = ((light[:9].float() + light[9:]) * (gain * signs[:9])).clamp(-MAX_LIGHT, MAX_LIGHT)
    codes = record(Stokes(*total.chunk(3)), scene.errors, generator)
    clipped = codes >= 1 - CLIP_MARGIN
    told = scene.told[colors]
    told_order = told / told[1]
    raw = codes / spread_color(told_order, mask.shape)
    planes, masks = (pixel_unshuffle(x[None, None].float(), PERIOD) for x in (raw, clipped))
    thumbnail = make_thumbnail(planes, masks, Layout())[0]
    own = (light[..., rows, cols].float() * (gain * signs)).clamp(-MAX_LIGHT, MAX_LIGHT)
    own = own / told_order.repeat(6)[:, None, None]
    polarized = own[3:9] + own[12:18]
    common = torch.cat([_permuted_error(scene, colors), scene.common[2:]])
    truth = (own[:3].half(), own[9:12].mean(dim=0, keepdim=True).half(), polarized.half(), mask[rows, cols])
    return Examples(raw[rows, cols], clipped[rows, cols], *truth, thumbnail, common)


def _permuted_error(scene: PooledScene, colors: Tensor) -> Tensor:
    """The first two of `networks.whole_frame.LIGHT` after a permutation of colours."""
    red, blue = scene.common[:2].tolist()
    errors = torch.tensor([red, 0.0, blue])[colors]
    return (errors - errors[1])[[0, 2]]


def record(light: Stokes, errors: bool, generator: torch.Generator) -> Tensor:
    """Return codes ``[H, W]`` from 0 to 1 of ``light [3, H, W]`` by a random sensor, with or without its errors."""
    layout, wrong = Layout(), random_errors(generator) if errors else SensorErrors()
    turned = random_analyser_angles(layout, wrong.angles_deg, generator)
    signal = cross_talk(filter_light(light, layout, IMX250, turned), wrong.cross_talk)
    signal = vary_gains(signal, layout, (wrong.gains, wrong.period_gains), generator)
    return add_gaussian_noise(signal, random_sensor(generator), generator, wrong.black)


def spread_color(color: Tensor, size: tuple[int, ...]) -> Tensor:
    """A colour ``[3]`` as the factor of every sample of a frame ``[H, W]`` of whole periods, in Sony's order."""
    layout = Layout()
    period = torch.stack([color[layout.filter_at(k // PERIOD, k % PERIOD).channel] for k in range(PERIOD**2)])
    return period.view(PERIOD, PERIOD).repeat(size[-2] // PERIOD, size[-1] // PERIOD)


def _integer(limit: int, generator: torch.Generator) -> int:
    return int(torch.randint(limit, (1,), generator=generator))


def _random_place(scene: PooledScene, crop: int, generator: torch.Generator) -> tuple[slice, slice]:
    """Rows and columns of a crop around a random object pixel, moved into the frame, with much of the object in it."""
    bright = float(torch.rand(1, generator=generator)) < BRIGHT_SHARE
    places = scene.bright if bright else scene.places
    for _ in range(MAX_DRAWS):
        center = places[_integer(len(places), generator)].tolist()
        starts = [min(max(c - crop // 2, 0), n - crop) for c, n in zip(center, scene.mask.shape, strict=True)]
        starts = [start - start % PERIOD for start in starts]
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


def add_gaussian_noise(signal: Tensor, sensor: Sensor, generator: torch.Generator, black: float = 0.0) -> Tensor:
    """Return a frame of ``signal``, white = 1, with Gaussian noise for shot and read noise, clipped and quantized.

    ``black``: what is added after the noise.

    Ten times faster than the Poisson noise of `camera.add_noise`, and the same except for the few electrons of black
    pixels.
    """
    source = np.random.default_rng(_integer(2**31, generator))
    noise = torch.from_numpy(source.standard_normal(signal.shape, np.float32))
    variance = signal.clamp(min=0) / sensor.full_well + (sensor.read_noise / sensor.full_well) ** 2
    noisy = (signal + variance.sqrt() * noise + black).clamp(0, 1)
    return torch.round(noisy * sensor.white_level) / sensor.white_level


def expose_mono(examples: Examples) -> Examples:
    """Return examples as a camera without colour filters records their green light: one colour, single precision.

    The seed of noise and sensors is a checksum of the colour frames, so that a batch always gives the same frames.
    """
    diffuse, specular, polarized = (x.float().cpu() for x in (examples.diffuse, examples.specular, examples.polarized))
    diffuse, polarized = diffuse[:, 1:2], polarized[:, 1::3]
    signal = filter_light(Stokes(diffuse + specular, polarized[:, :1], polarized[:, 1:]), MONO, IMX250)
    generator = torch.Generator().manual_seed(zlib.crc32(examples.raw.cpu().numpy().tobytes()))
    raw = torch.stack([add_gaussian_noise(x, random_sensor(generator), generator) for x in signal])
    clipped = raw >= 1 - CLIP_MARGIN
    mono = examples._replace(raw=raw, clipped=clipped, diffuse=diffuse, specular=specular, polarized=polarized)
    mono = mono._replace(thumbnail=keep_color(examples.thumbnail.cpu(), 1))
    return Examples(*(x.to(examples.raw.device) for x in mono))
