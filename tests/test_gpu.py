"""Separation on a GPU, without one: where tensors are, what leaves the device, and what half precision changes.

The device "meta" has no numbers: whatever reads one, copies from it or mixes it with another device, fails there.
"""

from __future__ import annotations

import logging
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from polsep import pipeline
from polsep.bench import gpu
from polsep.compute.arrays import to_numpy_together
from polsep.light import light_color
from polsep.methods import METHODS
from polsep.networks import run
from polsep.networks.engines import ENGINES
from polsep.physics.stokes import Stokes
from polsep.sensor.camera import IDEAL, IMX250, Layout, Mosaic, expose
from polsep.separation.report import in_light, on_host, under_white_light

LIGHT = (0.9, 1.0, 0.8)
#: Noise of layers in float16 that is nothing: errors of separations are 40 dB and worse.
LEAST_PSNR = 60.0


def textured(generator: torch.Generator, size: int, tint: tuple[float, float, float] = (1, 0.8, 0.6)) -> Mosaic:
    """A frame of smooth coloured light with white highlights, some clipped, in uint16."""
    maps = interpolate(torch.rand(1, 4, 12, 12, generator=generator), size=(size, size), mode="bicubic")[0].clamp(min=0)
    highlights = (3 * (maps[3:] - 0.6)).clamp(min=0)
    s0 = 0.8 * maps[:3] * torch.tensor(tint).view(3, 1, 1) + highlights
    mosaic = expose(
        Stokes(s0, 0.8 * highlights.expand(3, -1, -1), 0.6 * highlights.expand(3, -1, -1)), Layout(), IMX250
    )
    return replace(mosaic, data=mosaic.data.to(torch.uint16))


def golden(generator: torch.Generator, size: int) -> Mosaic:
    """A frame of gold, whose highlights have its own colour."""
    maps = interpolate(torch.rand(1, 1, 12, 12, generator=generator), size=(size, size))[0]
    gold = 0.1 + 0.9 * maps * torch.tensor([1.0, 0.78, 0.34]).view(3, 1, 1)
    return expose(Stokes(gold, 0.6 * gold, 0.7 * gold), Layout(), IDEAL)


def psnr(found: Tensor, exact: Tensor) -> float:
    return -10 * float(torch.log10((found - exact).square().mean() + 1e-30))


@pytest.fixture
def meta(monkeypatch: pytest.MonkeyPatch) -> None:
    """torch without what it refuses to do for "meta"."""
    autocast = torch.autocast
    monkeypatch.setattr(
        torch, "autocast", lambda kind, **rest: nullcontext() if kind == "meta" else autocast(kind, **rest)
    )


@pytest.mark.usefixtures("meta")
@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("method", ["joint-fast", "joint", "joint-large"])
def test_networks_never_leave_the_device(method: str, full: bool) -> None:
    """From raw codes to images in the light's colour, without a look at any number."""
    raw = Mosaic(torch.empty(96, 128, dtype=torch.uint16, device="meta"), Layout(), 0.0, 4095.0)
    found = in_light(METHODS[method].reference(under_white_light(raw, LIGHT), full), LIGHT)
    assert found.expected_error is not None
    for image in (found.diffuse, found.specular, found.valid, found.stokes.s1, found.expected_error):
        assert image.device.type == "meta"
        assert image.shape[-2:] == ((96, 128) if full else (48, 64))


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize(("method", "answers"), [("analytic", [False]), ("color-affine", [False, True])])
def test_formulas_look_at_clipping_alone(
    method: str, answers: list[bool], full: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether any sample clips, and whether all pixels are known then: two numbers of a frame."""
    said = iter(answers)
    monkeypatch.setattr(Tensor, "__bool__", lambda self: next(said))
    raw = Mosaic(torch.empty(96, 128, dtype=torch.uint16, device="meta"), Layout(), 0.0, 4095.0)
    found = METHODS[method].reference(under_white_light(raw, LIGHT), full)
    assert found.diffuse.device.type == "meta" and found.diffuse.shape[-2:] == ((96, 128) if full else (48, 64))
    assert list(said) == []


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """CPU tensors pass for those of a device; numbers of values of each copy from there."""
    copied: list[int] = []
    cpu = Tensor.cpu

    def copy(self: Tensor) -> Tensor:
        copied.append(self.numel())
        return cpu(self)

    for module in ("methods", "separation.report"):
        monkeypatch.setattr(f"polsep.{module}.on_cpu", lambda x: not isinstance(x, Tensor))
    monkeypatch.setattr(Tensor, "cpu", copy)
    monkeypatch.setattr(Tensor, "__array__", lambda *rest: pytest.fail("a tensor was taken for an array"))
    return copied


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("frame", [textured, golden])
def test_images_come_together(
    frame: Any, full: bool, elsewhere: list[int], monkeypatch: pytest.MonkeyPatch, generator: torch.Generator
) -> None:
    """A frame's images are those of the CPU; before they come, only sums and means over places do."""
    monkeypatch.setattr("polsep.separation.colored_specular.MANY", 100)
    capture, light = frame(generator, 160), LIGHT if frame is textured else (1.0, 1.0, 1.0)
    method = METHODS["joint-fast"]
    images, colored = pipeline.color_specular(method.run(capture, light, full), capture, light)
    assert isinstance(images.diffuse, Tensor) and isinstance(images.valid, Tensor)
    assert (colored.share > 0.5) == (frame is golden)
    assert sum(elsewhere) < capture.data.numel() / 2
    images, _ = pipeline.fill_under_highlights(images, capture, light)  # brings what lies in and around holes
    elsewhere.clear()
    found = on_host(images)
    assert sorted(elsewhere) == sorted(x.numel() for x in vars(images).values() if isinstance(x, Tensor))
    monkeypatch.undo()
    monkeypatch.setattr("polsep.networks.openvino_engine.usual_precision", lambda: "f32")
    ENGINES.clear()
    expected = pipeline.separate_capture(replace(capture, data=capture.data.numpy()), "joint-fast", light, "cpu", full)
    assert found.arrays().keys() == {"diffuse", "specular", "valid", "dolp", "aolp", "error"}
    for name in ("diffuse", "specular"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=0, atol=5e-3)
    assert np.mean(found.valid != expected.valid) < 0.01
    assert found.diffuse.flags.c_contiguous and found.error is not None


def test_the_light_is_found_before_the_frame_moves(monkeypatch: pytest.MonkeyPatch, generator: torch.Generator) -> None:
    """What is on the host anyway is never copied back."""
    seen, find_light = [], light_color.find_light

    def find(capture: Mosaic) -> Any:
        seen.append(type(capture.data))
        return find_light(capture)

    monkeypatch.setattr(light_color, "find_light", find)
    monkeypatch.setattr(pipeline, "find_device", lambda name: name)
    frame = textured(generator, 96)
    with pytest.raises(RuntimeError, match="meta"):  # where there are no numbers to look at
        pipeline.separate_capture(replace(frame, data=frame.data.numpy()), "analytic", device="meta")
    assert seen == [np.ndarray]


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("method", ["joint-fast", "joint"])
def test_half_precision_loses_nothing(
    method: str, full: bool, monkeypatch: pytest.MonkeyPatch, generator: torch.Generator
) -> None:
    """Layers in float16: far less noise than the errors of the networks, in float32 images."""
    frame, noise = textured(generator, 64), []
    exact = METHODS[method].reference(frame, full)
    for layers in (torch.float16, torch.bfloat16):
        monkeypatch.setattr(run, "LAYERS", {"cpu": layers})
        found = METHODS[method].reference(frame, full)
        assert found.diffuse.dtype == found.specular.dtype == torch.float32
        assert torch.equal(found.valid, exact.valid)
        noise.append(min(psnr(found.diffuse, exact.diffuse), psnr(found.specular, exact.specular)))
    assert 120 > noise[0] > max(LEAST_PSNR, noise[1] + 10)


@pytest.mark.parametrize("kind", ["black", "white", "hot", "noise"])
def test_half_precision_holds_any_frame(kind: str, monkeypatch: pytest.MonkeyPatch, generator: torch.Generator) -> None:
    """Float16 ends at 65504: no frame makes features that large."""
    data = torch.zeros(64, 64)
    if kind == "white":
        data += 4095
    elif kind == "hot":
        data[30, 31] = 4095
    elif kind == "noise":
        data = torch.randint(0, 4096, (64, 64), generator=generator).float()
    monkeypatch.setattr(run, "LAYERS", {"cpu": torch.float16})
    for method in ("joint-fast", "joint"):
        found = METHODS[method].reference(Mosaic(data, Layout(), 0.0, 4095.0), full=True)
        assert all(torch.isfinite(x).all() for x in (found.diffuse, found.specular, found.expected_error))


def test_compiled_networks_are_the_same(monkeypatch: pytest.MonkeyPatch, generator: torch.Generator) -> None:
    frame, compiled = textured(generator, 64), []

    def network(*arguments: Any) -> list[Tensor]:
        compiled.append(len(arguments))
        return run.run_images(*arguments)

    exact = METHODS["joint-fast"].reference(frame, False)
    monkeypatch.setattr(run, "_compiled", lambda: network)
    monkeypatch.setattr(run.State, "compiled", True)
    assert torch.equal(METHODS["joint-fast"].reference(frame, False).diffuse, exact.diffuse)
    assert compiled == [4] and run.State.compiled


def test_networks_that_do_not_compile_run(
    monkeypatch: pytest.MonkeyPatch, generator: torch.Generator, caplog: pytest.LogCaptureFixture
) -> None:
    """One warning that says why, and images all the same."""
    frame = textured(generator, 64)

    def network(*arguments: Any) -> list[Tensor]:
        raise RuntimeError("no compiler\nat all")

    exact = METHODS["joint-fast"].reference(frame, False)
    monkeypatch.setattr(run, "_compiled", lambda: network)
    monkeypatch.setattr(run.State, "compiled", True)
    with caplog.at_level(logging.WARNING, "polsep"):
        for _ in range(2):
            assert torch.equal(METHODS["joint-fast"].reference(frame, False).diffuse, exact.diffuse)
    assert caplog.messages == ["networks run uncompiled: RuntimeError: no compiler"]


def test_arrays_come_together() -> None:
    whole, mask = torch.arange(6.0).view(2, 3), torch.tensor([True, False])
    found = to_numpy_together(whole.requires_grad_(), mask)
    assert [x.dtype for x in found] == [np.float32, np.bool_]
    assert to_numpy_together(*found)[0] is found[0]
    assert to_numpy_together() == []


def test_benchmark_needs_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match=r"\Aexpected a GPU that torch [^\n]+ can use \(CUDA\), found none\Z"):
        next(gpu.bench_gpu())


def test_benchmark_is_whole(monkeypatch: pytest.MonkeyPatch, generator: torch.Generator) -> None:
    """Every method at both resolutions, each rate, and the float16 rows of networks."""
    monkeypatch.setattr(gpu, "SECONDS", 0.0)
    monkeypatch.setattr(gpu, "FIRST", 1)
    monkeypatch.setattr(gpu, "COMPILED", ())
    rows = list(gpu.measure("cpu", textured(generator, 96), ("joint-fast", "analytic")))
    assert all(row.value > 0 for row in rows)
    rates = ["raw frame in, images out", "on the device", "polsep.separate"]
    for case in ("half resolution", "full resolution"):
        found = {name: [row.metric for row in rows if (row.case, row.method) == (case, name)] for name in METHODS}
        assert found["analytic"] == rates
        assert set(found["joint-fast"]) > {*rates, "on the device, float32", "specular PSNR of float16 layers"}
