"""A method's compiled twin gives the frame and the report that the method's own functions in torch give."""

from __future__ import annotations

import logging
import math
import subprocess
import sys
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from polsep.compute import jit, warm_up
from polsep.compute.compiling import OPTIONS
from polsep.light.light_color import resolve_light
from polsep.methods import METHODS, run_reference
from polsep.physics.stokes import Measurements
from polsep.pipeline import SeparatedFrame, make_frame, separate_capture
from polsep.sensor.camera import Layout, Mosaic
from polsep.separation import analytic_kernel, color_affine_kernel
from polsep.shipped import NAMES

SONY = ((90, 45), (135, 0))
COLOR, MONO = Layout(), Layout(bayer=None)
CROPPED = Layout(SONY, "GRBG", (1, 1))
WHITE, ODD_LIGHT = (1.0, 1.0, 1.0), (1.25, 1.0, 0.75)
IMAGES = {"analytic": 2e-6, "color-affine": 2e-5}  # of white; guided demosaicking weighs by what rounding changes
ANGLE = 2e-5  # [rad], where DoLP is 1
STATISTICS = 1e-4


def capture(layout: Layout, shape: tuple[int, int] = (96, 120), light: tuple[float, ...] = WHITE) -> Mosaic:
    """A 12-bit frame of smooth light with highlights of which some clip, in the colour of ``light``."""
    y, x = torch.meshgrid(torch.linspace(0, 6, shape[0]), torch.linspace(0, 7, shape[1]), indexing="ij")
    highlight = 5 * torch.exp(-((x - 3) ** 2 + (y - 3) ** 2) / 0.3)
    data = torch.empty(shape)
    for row in range(4):
        for col in range(4):
            at = (slice(row, None, 4), slice(col, None, 4))
            filt = layout.filter_at(row, col)
            turn = math.cos(2 * (filt.angle_deg * math.pi / 180 - 0.5))
            albedo = 0.3 + 0.1 * torch.sin((2 + filt.channel) * x[at] + y[at]) * torch.cos(1.3 * y[at])
            data[at] = light[filt.channel] * (albedo * (1 + 0.1 * turn) + highlight[at] * (0.5 + 0.4 * turn))
    noise = 0.003 * torch.randn(shape, generator=torch.Generator().manual_seed(6))
    return Mosaic(((data + noise).clamp(0, 1) * 4095).round(), layout, 20.0, 4095.0)


def both(mosaic: Mosaic, method: str, light: tuple[float, ...], full: bool) -> tuple[SeparatedFrame, SeparatedFrame]:
    """The frame by the engine and by torch."""
    chosen, (light, *_) = METHODS[method], resolve_light(light, mosaic)
    by_torch = run_reference(chosen.reference, mosaic, light, full)
    images = (chosen.run(mosaic, light, full), by_torch)
    return tuple(make_frame(each, chosen, mosaic, light) for each in images)  # type: ignore[return-value]


@pytest.mark.parametrize(
    ("method", "layout", "shape", "light"),
    [
        ("analytic", COLOR, (96, 120), WHITE),
        ("analytic", COLOR, (96, 120), ODD_LIGHT),
        ("analytic", COLOR, (90, 70), WHITE),
        ("analytic", CROPPED, (97, 121), ODD_LIGHT),
        ("analytic", MONO, (96, 120), ODD_LIGHT),
        ("color-affine", COLOR, (96, 120), WHITE),
        ("color-affine", COLOR, (96, 120), ODD_LIGHT),
        ("color-affine", COLOR, (90, 70), WHITE),
        ("color-affine", CROPPED, (97, 121), ODD_LIGHT),
    ],
)
@pytest.mark.parametrize("full", [False, True])
def test_engine_and_torch_agree(
    method: str, layout: Layout, shape: tuple[int, int], light: tuple[float, ...], full: bool
) -> None:
    """Images, mask, DoLP, AoLP where it is defined, and every statistic, with clipped samples in the frame."""
    found, expected = both(capture(layout, shape, light if layout.bayer else WHITE), method, light, full)
    np.testing.assert_array_equal(found.valid, expected.valid)
    assert not bool(found.valid.all())
    assert float(found.valid.mean()) > 0.9
    for name in ("diffuse", "specular", "dolp"):
        image, twin = getattr(found, name), getattr(expected, name)
        assert image.dtype == twin.dtype and image.shape == twin.shape
        np.testing.assert_allclose(image, twin, rtol=IMAGES[method], atol=IMAGES[method] / min(light))
    away = np.abs((found.aolp - expected.aolp + math.pi / 2) % math.pi - math.pi / 2)
    assert float((away * expected.dolp).max()) < ANGLE
    assert found.report["statistics"] == pytest.approx(expected.report["statistics"], rel=STATISTICS)
    assert found.report["warnings"] == expected.report["warnings"]


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("method", METHODS)
def test_dolp_aolp_and_statistics_are_of_white_light(method: str, full: bool) -> None:
    """A scene in coloured light, with that colour said, has those of the scene in white light, by engine and torch."""
    white = Mosaic(0.5 * capture(COLOR).linear(), COLOR, 0.0, 1.0)
    colored = replace(white, data=replace(white, light_color=tuple(1 / gain for gain in ODD_LIGHT)).linear())
    one = separate_capture(white, method, "white", full=full)
    other = separate_capture(colored, method, ODD_LIGHT, full=full)
    rounded = method in NAMES  # layers may run in bfloat16
    np.testing.assert_allclose(other.dolp, one.dolp, rtol=0, atol=2e-3 if rounded else 1e-4)
    loose = {"rel": 2e-3, "abs": 2e-3} if rounded else {"rel": STATISTICS}
    assert other.report["statistics"] == pytest.approx(one.report["statistics"], **loose)
    np.testing.assert_allclose(
        other.specular, one.specular * np.float32(ODD_LIGHT), rtol=0, atol=1e-3 if rounded else 1e-5
    )


#: Kernels of each method, at half and at full resolution.
KERNELS = {
    "analytic": ("separate_analytic_half", "separate_analytic_full"),
    "color-affine": ("separate_color_affine_half", "separate_color_affine_full"),
}


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the kernels that ran."""
    names: list[str] = []
    for module, name in (
        (analytic_kernel, "separate_analytic_half"),
        (analytic_kernel, "separate_analytic_full"),
        (color_affine_kernel, "separate_color_affine_half"),
        (color_affine_kernel, "separate_color_affine_full"),
    ):
        kernel = getattr(module, name)

        def record(*given: Any, kernel: Any = kernel, name: str = name) -> Any:
            names.append(name)
            return kernel(*given)

        monkeypatch.setattr(module, name, record)
    return names


@pytest.mark.parametrize("method", KERNELS)
@pytest.mark.parametrize("data", [torch.rand(2, 32, 32), torch.rand(32, 32).double()], ids=["batch", "double"])
def test_kernels_leave_other_frames_to_torch(method: str, data: torch.Tensor, calls: list[str]) -> None:
    """Batches and double precision."""
    for full in (False, True):
        METHODS[method].run(Mosaic(data, COLOR, 0.0, 1.0), WHITE, full)
    assert calls == []


@pytest.mark.parametrize("data", [torch.zeros(2, 32, 32), torch.zeros(32, 32, device="meta")], ids=str)
def test_the_engine_leaves_other_frames_to_torch(data: torch.Tensor, monkeypatch: pytest.MonkeyPatch) -> None:
    """Batches and other devices."""
    seen: list[str] = []
    monkeypatch.setattr("polsep.methods.run_reference", lambda reference, *rest: seen.append(reference.args[0]))
    METHODS["joint"].run(Mosaic(data, COLOR, 0.0, 1.0), WHITE, False)
    assert seen == ["joint"]


def test_small_and_mono_frames_of_color_affine_are_left_to_torch(calls: list[str]) -> None:
    """Frames on which guided demosaicking falls back to bilinear, and mono frames, which the kernel does not accept."""
    for layout, shape in ((COLOR, (14, 64)), (MONO, (64, 64)), (COLOR, (4, 4))):
        out = separate_capture(Mosaic(torch.full(shape, 0.5), layout, 0.0, 1.0), "color-affine", device="cpu")
        assert out.diffuse.shape == (shape[0] // 2, shape[1] // 2, layout.channels)
    assert calls == []


@pytest.mark.parametrize("method", KERNELS)
def test_kernels_separate_mosaics_and_torch_the_rest(method: str, calls: list[str]) -> None:
    """No kernel runs for co-sited measurements."""
    mosaic = capture(COLOR, (32, 32))
    separate_capture(Measurements(torch.rand(4, 3, 16, 16), COLOR.angles), method, device="cpu")
    assert calls == []
    for full in (False, True):
        separate_capture(mosaic, method, full=full, device="cpu")
    assert calls == list(KERNELS[method])


def test_slow_compilation_is_said_once(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    """Loading says nothing, however long it takes; compiling for long says so in one line, and not again."""
    monkeypatch.setattr(warm_up, "PATIENCE", 0.0)

    def load() -> None:
        time.sleep(0.2)

    def compile_something() -> None:
        jit.make_dispatcher(lambda x: x + 1, OPTIONS, cached=False)(1)
        time.sleep(0.2)

    with caplog.at_level(logging.WARNING, "polsep"):
        warm_up.make_ready(load)
        assert caplog.messages == []
        warm_up.make_ready(compile_something)
        warm_up.make_ready(compile_something)
    assert len(caplog.messages) == 1 and "compiling this method" in caplog.messages[0]


def test_kernels_are_loaded_with_the_first_frame() -> None:
    """``polsep.separate`` can be named without numba."""
    code = "import sys, polsep; polsep.separate; print('numba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True)
    assert done.stdout.strip() == "False"


ELSEWHERE = """
import sys, warnings
import numpy, polsep, torch
warnings.simplefilter("ignore")
raw = numpy.random.default_rng(1).integers(0, 4000, (64, 64), numpy.uint16)
if sys.argv[1] == "double":
    torch.set_default_dtype(torch.float64)
for method in sys.argv[2:]:
    for full in (False, True):
        found = polsep.separate(raw, method, white_level=4095, full=full)
        print(method, full, found.diffuse.dtype, f"{found.diffuse.mean():.3f} {found.specular.mean():.3f}")
"""


def test_a_programs_default_type_does_not_matter() -> None:
    """Whoever sets torch's default to double gets the same images, in float32."""
    said = []
    for kind in ("single", "double"):
        command = [sys.executable, "-c", ELSEWHERE, kind, *METHODS]
        said.append(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert said[0] == said[1]
    assert said[0].count("float32") == 2 * len(METHODS)
