"""Twins of ideal frames: they differ in what they say, and truth, units and patterns are measured as documented."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch

pytest.importorskip("embreex", reason="needs the extra render")

from polsep.bench.period import measure_pattern
from polsep.bench.reality import Kind, RealityOptions, _bench_kind, bench_reality, score
from polsep.datasets.corners import add_traced
from polsep.datasets.reality import (
    DISTURBANCES,
    MONO,
    Frame,
    Stage,
    build_mannequin,
    build_stage,
    ideal_frame,
    ideal_mannequin,
    light_room,
    light_stage,
)
from polsep.physics.stokes import Stokes
from polsep.render.disturbances import LAMPS, add_scenes, specular_angle
from polsep.render.sphere_tracing import Scene
from polsep.sensor.camera import Layout

SIZE = 64


@lru_cache(maxsize=1)
def stage() -> Stage:
    return build_stage("train", 0, SIZE)


@lru_cache(maxsize=32)
def frame(name: str) -> Frame:
    return DISTURBANCES[name](stage())


@pytest.mark.parametrize("name", DISTURBANCES)
def test_frames_are_ordinary_frames(name: str) -> None:
    """Codes of the sensor's range, truth at half resolution, a mask with pixels."""
    found = frame(name)
    assert found.raw.shape == (SIZE, SIZE)
    assert found.raw.max() <= found.white_level
    assert found.diffuse.shape == found.specular.shape == (3, SIZE // 2, SIZE // 2)
    assert bool(found.mask.any())
    assert float(found.diffuse.min()) > -1e-3  # bicubic interpolation overshoots
    assert float(found.specular.min()) > -1e-3


def test_frames_are_always_the_same() -> None:
    """Every draw is the stage's."""
    for name in ("bad sensor", "two lamps", "metals"):
        assert np.array_equal(frame(name).raw, DISTURBANCES[name](stage()).raw)


def test_units_bring_twins_together() -> None:
    """Over its unit, truth in another light and at another exposure is that of the ideal twin."""
    ideal = frame("white lamp")
    for name in ("daylight balance", "tungsten", "a tenth of the exposure", "clipped 5 %"):
        found = frame(name)
        torch.testing.assert_close(found.diffuse / found.unit, ideal.diffuse, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(found.specular / found.unit, ideal.specular, rtol=1e-4, atol=1e-5)


def test_what_is_stated_is_true() -> None:
    """The formula, given the light's colour, the black level or the room, loses nothing but noise."""
    ideal = score(ideal_frame(stage()), "analytic", True)
    for name in ("daylight balance", "black level 240", "room light 30 %, lamp-off frame"):
        stated = score(frame(name), "analytic", True)
        assert ideal.diffuse - stated.diffuse < 0.5
        assert ideal.specular - stated.specular < 0.5
    assert frame("daylight balance").options == {"light_color": LAMPS["daylight"]}


def test_rooms_are_diffuse_and_have_their_share() -> None:
    """Specular truth is that of the lamp; the room's polarization has nothing of the lamp's."""
    lamp, room = light_stage(stage()), light_room(stage(), 0.3)
    assert float(room.specular.s0.abs().max()) == 0
    share = room.diffuse.s0[:, room.mask].mean() / lamp.diffuse.s0[:, lamp.mask].mean()
    assert 0.3 < float(share) < 0.6  # its specular reflection comes on top
    turned = light_room(replace(stage(), light=replace(stage().light, polarizer=1.0)), 0.3).diffuse
    scale = room.diffuse.s0.sum() / turned.s0.sum()
    torch.testing.assert_close(turned.s1 * scale, room.diffuse.s1, rtol=1e-4, atol=1e-6)
    with_room = frame("room light 30 %")
    torch.testing.assert_close(with_room.specular / with_room.unit, frame("white lamp").specular, rtol=1e-4, atol=1e-5)


def test_metals_are_scored_apart() -> None:
    """Dielectrics beside metals are the same frame on fewer pixels."""
    every, some = frame("metals"), frame("dielectrics beside metals")
    assert np.array_equal(every.raw, some.raw)
    assert 0 < int(some.mask.sum()) < int(every.mask.sum())
    assert not bool((some.mask & ~every.mask).any())


def test_mannequins_have_unpolarized_bodies() -> None:
    """All polarization is specular, so the formula's error is the mosaic's and the noise's."""
    found = score(ideal_mannequin(build_mannequin("train", 0, SIZE)), "analytic", True)
    assert min(found.diffuse, found.specular) > 20


def test_traced_light_is_counted_as_behind_crossed_polarizers() -> None:
    """Light along the lamp's highlights is specular, unpolarized light and that across them is diffuse."""
    one, angle = torch.ones(1, 4, 4), math.radians(40)
    lit = Stokes(one, one * math.cos(2 * angle), one * math.sin(2 * angle))
    direct = Scene(Stokes(one, 0 * one, 0 * one), lit, one[0] > 0)
    assert float(specular_angle(direct)) == pytest.approx(angle)
    across = Stokes(one, -0.5 * lit.s1, -0.5 * lit.s2)
    for mirrored, expected in ((lit, 2.0), (lit * 0.5, 1.5), (across, 1.0), (Stokes(one, 0 * one, 0 * one), 1.0)):
        indirect = Scene(Stokes(0 * one, 0 * one, 0 * one), mirrored, direct.mask)
        found = add_traced(direct, indirect)
        torch.testing.assert_close(found.specular.s0, expected * one)
        total, all_light = found.diffuse + found.specular, add_scenes(direct, indirect)
        torch.testing.assert_close(total.s1, (all_light.diffuse + all_light.specular).s1)
        torch.testing.assert_close(total.s0, (all_light.diffuse + all_light.specular).s0)


def test_bench_measures_losses() -> None:
    """An ideal twin loses nothing; names that there are not are one line."""
    rows = list(bench_reality(RealityOptions("validation", ("white lamp",), ("analytic",), 1, SIZE)))
    losses = [row.value for row in rows if row.bench == "reality/loss"]
    assert losses == pytest.approx([0.0, 0.0], abs=2.0)
    with pytest.raises(ValueError, match="test or validation, found 'train'"):
        RealityOptions("train")
    with pytest.raises(ValueError, match=r"expected rows of white lamp; .*, found moon"):
        next(bench_reality(RealityOptions(rows=("moon",))))


def test_mono_frames_hold_the_green_light() -> None:
    """A mono frame has the truth of the colour frame's green, at its own exposure, and no colour to state."""
    color, mono = (build_stage("train", 0, SIZE, Layout(bayer=bayer)) for bayer in ("RGGB", None))
    for name in ("usual rig", "room light 30 %, lamp-off frame", "clipped 1 %"):
        assert name in MONO
        frame, wanted = (DISTURBANCES[name](stage) for stage in (mono, color))
        assert frame.layout.channels == frame.diffuse.shape[0] == len(frame.unit) == 1
        assert "light_color" not in (frame.options or {})
        scale = frame.diffuse.sum() / wanted.diffuse[1].sum()
        torch.testing.assert_close(frame.diffuse[0], scale * wanted.diffuse[1])
        torch.testing.assert_close(frame.specular[0], scale * wanted.specular[1], rtol=1e-4, atol=1e-5)
    clipped = DISTURBANCES["clipped 5 %"](mono)
    lit = clipped.raw.reshape(SIZE // 2, 2, SIZE // 2, 2).swapaxes(1, 2)[clipped.mask.numpy()]
    assert (lit >= clipped.white_level).mean() == pytest.approx(0.05, abs=0.01)


def test_patterns_of_the_period_are_found() -> None:
    """Noise and texture have as much power beside the frequencies; a faint checkerboard in one tile has not."""
    generator = torch.Generator().manual_seed(1)
    image = 0.5 + 0.02 * torch.randn(3, 256, 256, generator=generator)
    clean = measure_pattern(image, 2)
    assert -4 < clean.whole < 1
    rows, cols = torch.meshgrid(torch.arange(32), torch.arange(32), indexing="ij")
    image[:, 64:96, 128:160] += 0.05 * (1 - 2.0 * ((rows + cols) % 2))
    found = measure_pattern(image, 2)
    assert found.place == (64, 128)
    assert found.worst > 15
    assert found.amplitude == pytest.approx(0.05 / 0.5, rel=0.2)


def test_rows_of_fewer_pixels_are_compared_on_those(monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame that is its own ideal twin loses nothing on a part of its mask."""
    twin = ideal_frame(stage())
    some = replace(twin, mask=twin.mask & (torch.arange(twin.mask.shape[-1]) > twin.mask.shape[-1] // 2))
    kind = Kind("objects", lambda split, number, size: stage(), 1, lambda _: twin, {"part": lambda _: some})
    rows = list(_bench_kind(kind, ("analytic",), RealityOptions(scenes=1)))
    losses = [row.value for row in rows if row.bench == "reality/told" and "loss" in row.metric]
    assert losses == [0, 0]
