"""Streamed training examples: the same wherever a stream starts, true to the camera model, never of the test split."""

from __future__ import annotations

import itertools
import math
from collections import deque
from dataclasses import replace

import pytest
import torch
from tolerances import SIGMAS, assert_close
from torch.nn.functional import max_pool2d
from torch.utils.data import DataLoader

pytest.importorskip("embreex")

from polsep.physics.stokes import Stokes
from polsep.render.sensor_errors import SensorErrors
from polsep.render.simulate import filter_light
from polsep.sensor.camera import CLIP_MARGIN, IMX250, Layout
from polsep.train import reality, stream, variety
from polsep.train.constants import constants_set, list_constants, read_constant
from polsep.train.stream import (
    BRIGHT_SHARE,
    BRIGHTEST,
    CLIPPED,
    GLARING_SHARE,
    LEVEL_SHARE,
    LEVELS,
    LIGHTS,
    LOWEST_QUANTILE,
    MIN_LEVEL,
    QUANTILES,
    UNCLIPPED_SHARE,
    VIEWS,
    Examples,
    ExampleStream,
    PooledScene,
    StreamOptions,
    add_gaussian_noise,
    pool_scenes,
    random_example,
    random_gain,
    stream_lane,
)
from polsep.train.variety import BLURS

#: Light spreads this many pixels beyond the mask: the lens's three standard deviations, and a pixel half covered.
FRINGE = math.ceil(3 * max(BLURS)) + 1
SMALL = StreamOptions(batch=3, crop=32, size=64, pool=3, uses=1)


def pooled(ranks: torch.Tensor, level: float) -> PooledScene:
    """A scene without pixels, of which only the brightness is asked."""
    nothing = torch.zeros(0)
    return PooledScene(nothing, torch.ones(3), torch.zeros(4), False, False, nothing, nothing, nothing, ranks, level)


def take(options: StreamOptions, lane: int, first: int, count: int) -> list[Examples]:
    return list(itertools.islice(stream_lane(options, lane, first), count))


def same(a: Examples, b: Examples) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


@pytest.fixture(scope="module")
def batches() -> list[Examples]:
    return take(SMALL, 0, 0, 8)


@pytest.mark.parametrize("first", [1, 5, 7])
def test_a_stream_that_starts_later_goes_on_alike(batches: list[Examples], first: int) -> None:
    assert same(take(SMALL, 0, first, 1)[0], batches[first])


def test_seeds_lanes_and_splits_differ(batches: list[Examples]) -> None:
    others = [take(replace(SMALL, seed=1), 0, 0, 1), take(SMALL, 1, 0, 1), take(replace(SMALL, split="test"), 0, 0, 1)]
    assert not any(same(other[0], batches[0]) for other in others)


@pytest.mark.parametrize("start", [0, 3])
def test_workers_are_lanes_in_turn(start: int) -> None:
    """Batch k is of lane k modulo their number, whichever batch is the first."""
    loader = DataLoader(ExampleStream(SMALL, start), batch_size=None, num_workers=2)
    found = list(itertools.islice(loader, 3))
    for k, batch in enumerate(found, start):
        assert same(Examples(*batch), take(SMALL, k % 2, k // 2, 1)[0])


def test_scenes_follow_their_number() -> None:
    whole = list(itertools.islice(pool_scenes(SMALL, 0, 0), VIEWS * LIGHTS + 2))
    later = next(pool_scenes(SMALL, 0, VIEWS * LIGHTS + 1))
    assert torch.equal(whole[-1].light, later.light)


def test_raw_is_the_truth_behind_its_filters(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where nothing clips, raw minus the filtered truth is noise of the sensor's size; here all have one sensor."""
    monkeypatch.setattr(stream, "random_sensor", lambda _: IMX250)
    deviations = []
    for b in take(SMALL, 0, 0, 8):
        for k in range(SMALL.batch):
            diffuse, specular, polarized = (x[k].float() for x in (b.diffuse, b.specular, b.polarized))
            signal = filter_light(Stokes(diffuse + specular, polarized[:3], polarized[3:]), Layout(), IMX250)
            kept = (signal > 0.01) & (signal < 0.9)
            deviations.append(((b.raw[k] - signal) / IMX250.noise_variance(signal).sqrt())[kept])
    z = torch.cat(deviations)
    assert abs(float(z.mean())) < SIGMAS / math.sqrt(z.numel()) + 0.02  # halves round the truth by up to 2^-12
    assert abs(float(z.std()) - 1) < 0.05


def test_real_frames_less_the_stated_color_are_the_truth_behind_its_filters(monkeypatch: pytest.MonkeyPatch) -> None:
    """As above under lamps of any stated colour, in lit rooms, where all specular light has the lamp's colour."""
    monkeypatch.setattr(stream, "random_sensor", lambda _: IMX250)
    monkeypatch.setattr(stream, "random_errors", lambda _: SensorErrors())
    monkeypatch.setattr(reality, "COLOR_ERROR_SHARES", (1.0, 0.0, 0.0, 0.0))
    for share in ("IDEAL_SHARE", "METAL_SHARE", "RETAINING_SHARE", "INDIRECT_SHARE", "ABERRATION_SHARE"):
        monkeypatch.setattr(reality, share, 0.0)
    deviations, tinted = [], 0
    for b in take(replace(SMALL, looks="real"), 0, 0, 8):
        assert_close(b.light[:, :2], torch.zeros(SMALL.batch, 2))
        for k in range(SMALL.batch):
            light = Stokes(b.diffuse[k].float() + b.specular[k].float(), *b.polarized[k].float().chunk(2))
            signal = filter_light(light, Layout(), IMX250)
            kept = (signal > 0.05) & ~b.clipped[k]
            tinted += float(b.raw[k][b.clipped[k]].max()) > 1.01 if bool(b.clipped[k].any()) else 0
            deviations.append(((b.raw[k] - signal) / signal)[kept])
    errors = torch.cat(deviations)
    assert abs(float(errors.median())) < 2e-3
    assert float(errors.abs().median()) < 0.03
    assert tinted > 0


def test_a_thumbnail_is_of_the_whole_frame() -> None:
    """Crops of one frame have one, whatever they show."""
    torch.manual_seed(0)
    light, mask = torch.rand(18, 64, 64).half(), torch.ones(64, 64, dtype=torch.bool)
    light[3:9], light[12:] = 0, 0
    color, common, ranks = torch.ones(3), torch.zeros(4), torch.linspace(LOWEST_QUANTILE, 1, QUANTILES)
    places = [torch.tensor([[k, k]]) for k in (8, 56)]
    scenes = [PooledScene(light, color, common, False, False, mask, place, place, ranks, 0.5) for place in places]
    one, other = (random_example(deque([scene]), 16, torch.Generator().manual_seed(1)) for scene in scenes)
    assert torch.equal(one.thumbnail, other.thumbnail)
    assert not torch.equal(one.raw, other.raw)


def test_truth_is_physical(batches: list[Examples]) -> None:
    for b in batches:
        assert float(b.diffuse.min()) >= 0
        assert float(b.specular.min()) >= 0
        total = b.diffuse.float() + b.specular.float()
        polarized = torch.hypot(b.polarized[:, :3].float(), b.polarized[:, 3:].float())
        assert float((polarized - total).max()) < 2e-3 * float(total.max())
        assert float(b.raw.min()) >= 0
        assert float(b.raw.max()) <= 1
        near = max_pool2d(b.mask[:, None].float(), 2 * FRINGE + 1, 1, FRINGE)
        assert float((total * (near == 0)).max()) == 0


def test_exposures_clip_what_was_drawn() -> None:
    """Some clip nothing, others a share of evenly spread samples whose square law's place is uniform in [0, 1].

    The rest is exposed for the median, far below here.
    """
    ranks = torch.linspace(LOWEST_QUANTILE, 1, QUANTILES)
    scene = pooled(ranks, 2.0)
    gains = [random_gain(scene, torch.Generator().manual_seed(k)) for k in range(500)]
    leveled = [gain for gain in gains if gain < BRIGHTEST[0]]
    assert LEVELS[0] / 2 <= min(leveled) <= max(leveled) <= LEVELS[1] / 2
    assert abs(len(leveled) - 500 * LEVEL_SHARE) < SIGMAS * math.sqrt(500 * LEVEL_SHARE * (1 - LEVEL_SHARE))
    unclipped = [gain for gain in gains if BRIGHTEST[0] <= gain < 1]
    share = UNCLIPPED_SHARE * (1 - LEVEL_SHARE)
    assert abs(len(unclipped) - 500 * share) < SIGMAS * math.sqrt(500 * share * (1 - share))
    assert BRIGHTEST[0] <= min(unclipped) <= max(unclipped) <= BRIGHTEST[1]
    step = (1 - LOWEST_QUANTILE) / QUANTILES
    shares = torch.tensor([1 - 1 / gain for gain in gains if gain >= 1], dtype=torch.float64)
    assert float(shares.min()) >= CLIPPED[0] - step
    assert float(shares.max()) <= CLIPPED[1] + step
    places = ((shares - CLIPPED[0]).clamp(min=0) / (CLIPPED[1] - CLIPPED[0])).sqrt().sort().values
    # Kolmogorov and Smirnov's distance, which exceeds 1.95 / sqrt(n) once in a thousand times.
    assert float((places - torch.linspace(0, 1, len(places))).abs().max()) < 1.95 / math.sqrt(len(places)) + 0.02


def test_some_crops_are_about_the_brightest_pixels() -> None:
    """The others are about any pixel: of one bright pixel among thousands nearly all crops that hold it mean to."""
    size, crop, draws = 128, 16, 400
    mask = torch.ones(size, size, dtype=torch.bool)
    light, bright = torch.zeros(18, size, size), torch.tensor([[40, 90]])
    light[9:12, 40, 90] = 1
    color, common, ranks = torch.ones(3), torch.zeros(4), torch.ones(QUANTILES)
    scene = PooledScene(light, color, common, False, False, mask, mask.nonzero(), bright, ranks, 0.5)
    crops = [random_example(deque([scene]), crop, torch.Generator().manual_seed(k)) for k in range(draws)]
    about = sum(bool(drawn.specular.any()) for drawn in crops)
    expected = BRIGHT_SHARE + (1 - BRIGHT_SHARE) * (crop / size) ** 2
    assert abs(about - draws * expected) < SIGMAS * math.sqrt(draws * expected * (1 - expected))


def test_glaring_scenes_are_mostly_exposed_for_the_rest() -> None:
    """Where the brightest are far above the median, most exposures let them clip."""
    glaring = pooled(torch.linspace(LOWEST_QUANTILE, 1, QUANTILES), 0.01)
    gains = [random_gain(glaring, torch.Generator().manual_seed(k)) for k in range(300)]
    leveled = [gain for gain in gains if gain > 2 * MIN_LEVEL / 0.01]
    assert LEVELS[0] / 0.01 <= min(leveled) <= max(leveled) <= LEVELS[1] / 0.01
    assert abs(len(leveled) - 300 * GLARING_SHARE) < SIGMAS * math.sqrt(300 * GLARING_SHARE * (1 - GLARING_SHARE))


def test_dark_scenes_are_exposed_to_the_floor() -> None:
    dark = pooled(torch.linspace(LOWEST_QUANTILE, 1, QUANTILES), 1e-4)
    assert all(random_gain(dark, torch.Generator().manual_seed(k)) >= MIN_LEVEL / 1e-4 for k in range(20))


def test_fast_noise_has_the_sensors_statistics() -> None:
    signal = torch.full((200, 200), 0.3)
    raw = add_gaussian_noise(signal, IMX250, torch.Generator().manual_seed(3))
    assert abs(float(raw.mean()) - 0.3) < SIGMAS * math.sqrt(
        float(IMX250.noise_variance(signal)[0, 0]) / signal.numel()
    )
    assert abs(float(raw.var()) / float(IMX250.noise_variance(signal)[0, 0]) - 1) < 0.05
    codes = raw * IMX250.white_level
    assert_close(codes, codes.round(), scale=IMX250.white_level)
    assert float(add_gaussian_noise(torch.full((8, 8), 3.0), IMX250, torch.Generator()).min()) >= 1 - CLIP_MARGIN


@pytest.mark.parametrize("wrong", [{"crop": 30}, {"size": 514}, {"crop": 128, "size": 64}, {"pool": 0}, {"batch": 0}])
def test_bad_options_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="expected"):
        replace(SMALL, **wrong)


@pytest.mark.parametrize("kind", ["vary_normals", "vary_gloss", "vary_polarization", "vary_retention"])
def test_usual_looks_go_without(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither relief nor matte, glaring and rough looks are drawn for them; varied ones have each."""

    def drawn(*_: object) -> None:
        raise LookupError(kind)

    monkeypatch.setattr(stream, kind, drawn)
    assert len(list(itertools.islice(pool_scenes(replace(SMALL, looks="usual"), 0, 0), 3))) == 3
    with pytest.raises(LookupError, match=kind):
        next(pool_scenes(SMALL, 0, 0))


def test_unknown_looks_are_refused() -> None:
    with pytest.raises(ValueError, match="varied or usual or real, found 'odd'"):
        replace(SMALL, looks="odd")


# Constants


def test_constants_of_a_stream_change_its_examples_alone() -> None:
    """Batches are other ones; the modules keep their numbers, and other streams in the same process theirs."""
    usual, set_ = SMALL, replace(SMALL, constants=(("stream.LEVEL_SHARE", (1.0,)), ("stream.LEVELS", (0.01, 0.02))))
    before = list_constants()
    dark, plain = (stream_lane(options, 0, 0) for options in (set_, usual))
    first, other = next(dark), next(plain)
    assert list_constants() == before
    assert float(first.raw.max()) > 0 and float(first.raw.mean()) < 0.5 * float(other.raw.mean())
    alone = next(stream_lane(usual, 0, 0))
    assert all(torch.equal(a, b) for a, b in zip(other, alone, strict=True))
    known = list_constants(set_.constants)
    assert (
        known["stream.LEVELS"] == [0.01, 0.02] and known["variety.MATTE_STRENGTH"] == before["variety.MATTE_STRENGTH"]
    )
    assert before["variety.BITS"] == [8, 10, 12] and "reality.IDEAL_SHARE" in before


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("variety.NOTHING=1", "expected a constant such as variety.MATTE_SHARE .*, found 'variety.NOTHING'"),
        ("variety.MATTE_STRENGTH=0.02", "expected variety.MATTE_STRENGTH of 2 numbers, found 1"),
        ("variety.MATTE_SHARE", "expected NAME=NUMBER,..., found 'variety.MATTE_SHARE'"),
        ("variety.MATTE_SHARE=much", "expected NAME=NUMBER,..., found 'variety.MATTE_SHARE=much'"),
    ],
)
def test_constants_are_read_by_name(text: str, said: str) -> None:
    assert read_constant("variety.MATTE_STRENGTH=0.02,1") == ("variety.MATTE_STRENGTH", (0.02, 1.0))
    with pytest.raises(ValueError, match=said):
        read_constant(text)


def test_numbers_stay_of_their_kind() -> None:
    """Bits and octaves are whole."""
    with constants_set((("variety.BITS", (10.0, 10.0, 12.0)), ("variety.MAX_OCTAVES", (2.0,)))):
        assert variety.BITS == (10, 10, 12) and all(isinstance(bits, int) for bits in variety.BITS)
        assert variety.MAX_OCTAVES == 2 and isinstance(variety.MAX_OCTAVES, int)
    assert variety.BITS == (8, 10, 12) and variety.MAX_OCTAVES == 3
