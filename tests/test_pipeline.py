"""The public contract of `polsep.separate`: other people's scripts call it."""

from __future__ import annotations

import inspect
import json
import subprocess
import sys
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from tolerances import assert_close
from torch.nn.functional import interpolate

import polsep
from polsep.compute.devices import find_device
from polsep.io.results.previews import contact_sheet
from polsep.io.results.separation_reader import open_separated
from polsep.methods import BEST, FASTEST, METHODS, Method, find_method, run_reference
from polsep.networks.channels import MIN_BRIGHTNESS
from polsep.networks.joint import Joint
from polsep.networks.run import run_joint
from polsep.networks.sizes import ResidualSize
from polsep.physics.stokes import Measurements, Stokes, measure
from polsep.pipeline import PolsepWarning, separate, separate_capture
from polsep.sensor.calibration import Calibration
from polsep.sensor.camera import IDEAL, IMX250, Capture, Layout, Mosaic, expose
from polsep.sensor.levels import as_mosaic
from polsep.separation.analytic import Separation
from polsep.shipped import NAMES

SIZE = 96
#: What layers in bfloat16 make of other inputs by rounding.
ROUNDED = 2e-3
ODD_LIGHT = (1.25, 1.0, 0.75)


def lit_scene(light: tuple[float, ...] = (1.0, 1.0, 1.0), exposure: float = 1.0) -> Stokes:
    """Smooth coloured diffuse light and white highlights of one angle, times the light's colour, ``[3, H, W]``."""
    generator = torch.Generator().manual_seed(1)
    fields = interpolate(torch.rand(1, 5, 6, 6, generator=generator), size=(SIZE, SIZE), mode="bicubic")[0].clamp(0, 1)
    diffuse, specular = 0.1 + 0.5 * fields[:3], 0.9 * fields[3:4] ** 4
    color = exposure * torch.tensor(light).view(3, 1, 1)
    return Stokes((diffuse + specular) * color, (0.05 * diffuse + 0.8 * specular) * color, 0.6 * specular * color)


def raw_frame(dtype: str = "uint16", layout: Layout | None = None, **scene: Any) -> NDArray[Any]:
    """One noise-free mosaic in codes of the whole range of ``dtype``."""
    layout = Layout() if layout is None else layout
    signal = expose(lit_scene(**scene), layout, IDEAL).data.numpy()
    white = {"uint8": 255, "uint16": 65535, "float32": 1, "float64": 1}[dtype]
    return (np.rint(signal * white) if white > 1 else signal).astype(dtype)


def quietly(*args: Any, **kwargs: Any) -> polsep.Result:
    """`polsep.separate` under white light unless stated, without its warnings, which stay in the report."""
    kwargs.setdefault("light_color", "white")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", polsep.PolsepWarning)
        return polsep.separate(*args, **kwargs)


def test_signature_is_the_contract() -> None:
    """Names, order and defaults of the arguments are fixed."""
    parameters = inspect.signature(polsep.separate).parameters
    assert {name: p.default for name, p in parameters.items()} == {
        "raw": inspect.Parameter.empty,
        "method": "auto",
        "layout": None,
        "black_level": 0,
        "white_level": None,
        "light_color": "auto",
        "device": "auto",
        "full": False,
        "calibration": None,
        "ambient": None,
        "lamp_dolp": None,
    }
    assert list(parameters)[:5] == ["raw", "method", "layout", "black_level", "white_level"]


def test_public_names_are_there() -> None:
    """Every name of ``__all__`` is loaded on first use, listed by dir(), and an unknown one is refused."""
    for name in polsep.__all__:
        assert getattr(polsep, name) is not None
        assert name in dir(polsep)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = polsep.nothing


@pytest.mark.parametrize("method", ["auto", *METHODS])
@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("layout", [None, Layout(bayer=None)], ids=["color", "mono"])
def test_shapes_and_types(method: str, full: bool, layout: Layout | None) -> None:
    """[H/2, W/2, C], or [H, W, C] at full resolution; float32 images, a bool mask, and ranges as documented."""
    out = quietly(raw_frame(layout=layout), method=method, layout=layout, full=full)
    side, channels = (SIZE if full else SIZE // 2), (1 if layout else 3)
    for image in (out.diffuse, out.specular):
        assert image.shape == (side, side, channels) and image.dtype == np.float32
        assert image.flags.c_contiguous and float(image.min()) >= 0
    assert out.valid.shape == (side, side) and out.valid.dtype == np.bool_
    for image in (out.dolp, out.aolp):
        assert image.shape == (side, side) and image.dtype == np.float32
    assert float(out.aolp.min()) >= 0 and float(out.aolp.max()) < np.pi
    assert float(out.dolp.min()) >= 0


@pytest.mark.parametrize(
    "layout", [None, Layout(bayer=None), Layout(((0, 45), (90, 135)))], ids=["color", "mono", "odd"]
)
@pytest.mark.parametrize(("choice", "choices"), [("auto", BEST), ("auto-fast", FASTEST)])
def test_auto_is_the_best_that_takes_a_frame(layout: Layout | None, choice: str, choices: tuple[Method, ...]) -> None:
    """And the report says which method ran."""
    mosaic = Mosaic(torch.zeros(SIZE, SIZE), layout or Layout(), 0.0, 1.0)
    best = next(method.name for method in choices if method.accepts(mosaic))
    auto, named = (quietly(raw_frame(layout=layout), method=name, layout=layout) for name in (choice, best))
    assert auto.report["method"] == best
    assert np.array_equal(auto.specular, named.specular) is True


@pytest.mark.parametrize(("dtype", "tolerance"), [("uint8", 0.02), ("uint16", 1e-4), ("float64", 1e-6)])
@pytest.mark.parametrize("method", METHODS)
def test_sample_types_agree(method: str, dtype: str, tolerance: float) -> None:
    """uint8, uint16 and float frames of one scene give the same images up to their quantization.

    Nothing clips: whether a sample just below white does is a question that quantization decides. Layers of networks
    may run in bfloat16.
    """
    tolerance = max(tolerance, ROUNDED if method in NAMES else 0)
    reference, other = (quietly(raw_frame(kind, exposure=0.5), method=method) for kind in ("float32", dtype))
    total = reference.diffuse + reference.specular
    assert float(np.abs(other.diffuse + other.specular - total).max()) < tolerance
    assert float(np.abs(other.specular - reference.specular).mean()) < tolerance


def test_stored_forms_do_not_matter() -> None:
    """Byte order, memory order, read-only arrays and a trailing axis of one channel change nothing."""
    raw = raw_frame()
    frozen = raw.copy()
    frozen.flags.writeable = False
    want = quietly(raw).specular
    for other in (raw.astype(">u2"), np.asfortranarray(raw), frozen, raw[..., None]):
        assert float(np.abs(quietly(other).specular - want).max()) == 0


def test_input_is_not_modified() -> None:
    """The caller's array is only read, and later changes to it don't reach the result."""
    raw = raw_frame("float32")
    before = raw.copy()
    out = quietly(raw)
    kept = out.diffuse.copy()
    assert np.array_equal(raw, before) is True
    raw[:] = 0
    assert np.array_equal(out.diffuse, kept) is True


@pytest.mark.parametrize("method", METHODS)
def test_levels_are_a_change_of_unit(method: str) -> None:
    """12-bit codes over a black level, with both levels said, are the same light."""
    tolerance = ROUNDED if method in NAMES else 1e-4
    light = raw_frame("float32")
    codes = (240 + light * (4095 - 240)).astype(np.float32)
    one = quietly(light, method=method)
    other = quietly(codes, method=method, black_level=240, white_level=4095)
    assert float(np.abs(one.diffuse - other.diffuse).max()) < tolerance
    assert float(np.abs(one.specular - other.specular).max()) < tolerance


def test_warnings_are_issued_and_reported() -> None:
    """What the owner should know is issued as PolsepWarning and stands in the report in the same words."""
    twelve_bit = (raw_frame() >> 4).astype(np.uint16)
    with pytest.warns(polsep.PolsepWarning, match="12-bit right-justified") as caught:
        out = polsep.separate(twelve_bit)
    assert [str(w.message) for w in caught] == out.report["warnings"]
    assert all("\n" not in note for note in out.report["warnings"])
    assert caught[0].filename == __file__


def test_good_frames_are_silent() -> None:
    """A well exposed frame with its levels said gives no warning at all."""
    out = polsep.separate(raw_frame())
    assert out.report["warnings"] == []


def test_wrong_layout_is_reported() -> None:
    """A frame under a wrong order of analysers says so."""
    with pytest.warns(polsep.PolsepWarning, match="contradicts layout 0,45,90,135/RGGB"):
        polsep.separate(raw_frame(), layout=Layout(((0, 45), (90, 135))))


def test_unpolarized_light_is_reported() -> None:
    """Specular light of every angle at once is not one polarized light: the report says so."""
    generator = torch.Generator().manual_seed(2)
    turn = 6.28318 * interpolate(torch.rand(1, 1, 12, 12, generator=generator), size=(SIZE, SIZE))[0]
    mixed = Stokes(torch.full((3, SIZE, SIZE), 0.8), *(0.3 * f(turn).expand(3, -1, -1) for f in (torch.cos, torch.sin)))
    with pytest.warns(polsep.PolsepWarning, match="polarized light of one angle was expected"):
        polsep.separate(expose(mixed, Layout(bayer=None), IDEAL).data.numpy(), layout=Layout(bayer=None))


@pytest.mark.parametrize("method", ["joint", "color-affine"])
def test_metals_are_reported(method: str) -> None:
    """Highlights in the metal's own colour, and nothing else, are no white light on a coloured object."""
    generator = torch.Generator().manual_seed(2)
    light = interpolate(torch.rand(1, 1, 12, 12, generator=generator), size=(SIZE, SIZE))[0]
    gold = 0.1 + 0.9 * light * torch.tensor([1.0, 0.78, 0.34]).view(3, 1, 1)
    frame = expose(Stokes(gold, 0.6 * gold, 0.7 * gold), Layout(), IDEAL).data.numpy()
    with pytest.warns(polsep.PolsepWarning, match="white highlights on coloured objects were expected"):
        polsep.separate(frame, method=method, light_color="white")


def test_statistics_are_what_a_method_measures() -> None:
    """The closed form tells how well its model fits and the noise; the analytic split has neither, so says neither."""
    ours, theirs = (set(quietly(raw_frame(), name).report["statistics"]) for name in ("color-affine", "analytic"))
    assert ours - theirs == {"fit_residual", "sample_noise"}
    assert theirs < ours


@pytest.fixture
def expecting(monkeypatch: pytest.MonkeyPatch) -> Joint:
    """A random network that expects errors, installed as the method ``joint``."""
    torch.manual_seed(3)
    network = Joint(3, ResidualSize(4, (0, 1, 1))).eval()
    for weight in network.log_variance.parameters():
        torch.nn.init.normal_(weight, std=0.5)

    def reference(capture: Capture, full: bool = False) -> Separation:
        assert isinstance(capture, Mosaic)
        return run_joint(network, replace(capture, data=torch.as_tensor(capture.data)), full)

    run = partial(run_reference, reference)
    method = replace(METHODS["analytic"], name="joint", reference=reference, run=run, expects_errors=True)
    monkeypatch.setitem(METHODS, "joint", method)
    return network


@pytest.mark.parametrize("full", [False, True])
def test_expected_errors_reach_their_owner(expecting: Joint, full: bool) -> None:
    """The frame holds what the method expects, and the report their rms; other methods have neither."""
    raw = raw_frame("float32", exposure=0.5)
    out = quietly(raw, method="joint", full=full)
    expected = run_joint(expecting, Mosaic(torch.from_numpy(raw), Layout(), 0.0, 1.0), full).expected_error
    assert expected is not None and out.error is not None
    assert out.error.shape == (*out.valid.shape, 2) and out.error.dtype == np.float32
    assert out.error.flags.c_contiguous and float(out.error.min()) > 0 and float(np.ptp(out.error)) > 0
    assert_close(torch.from_numpy(out.error).movedim(-1, 0), expected)
    typical = np.sqrt(np.square(out.error, dtype=np.float64).mean(axis=(0, 1))).tolist()
    said = [out.report["statistics"][f"expected_{image}_error"] for image in ("diffuse", "specular")]
    assert said == pytest.approx(typical, rel=1e-6)
    assert json.loads(json.dumps(out.report, allow_nan=False)) == out.report
    other = quietly(raw, method="color-affine", full=full)
    assert other.error is None and "expected_diffuse_error" not in other.report["statistics"]


@pytest.mark.parametrize("full", [False, True])
def test_expected_errors_are_in_the_light(expecting: Joint, full: bool) -> None:
    """Under a said light, errors grow by the mean over its colours as images do; statistics stay of white light."""
    del expecting
    white = quietly(raw_frame("float32", exposure=0.5), method="joint", full=full)
    light = {"light": ODD_LIGHT, "exposure": 0.5}
    colored = quietly(raw_frame("float32", **light), method="joint", light_color=ODD_LIGHT, full=full)
    assert white.error is not None and colored.error is not None
    assert_close(torch.from_numpy(colored.error), torch.from_numpy(white.error * np.float32(np.mean(ODD_LIGHT))))
    statistics = (frame.report["statistics"]["expected_specular_error"] for frame in (white, colored))
    assert next(statistics) == pytest.approx(next(statistics), rel=1e-4)


@pytest.mark.parametrize("frame", ["plain", "black", "clipped", "random"])
@pytest.mark.parametrize("method", list(METHODS))
def test_report_is_json(frame: str, method: str) -> None:
    """Every report survives JSON without NaN, and has the documented statistics."""
    raw = {
        "plain": raw_frame(),
        "black": np.zeros((SIZE, SIZE), np.uint16),
        "clipped": np.full((SIZE, SIZE), 65535, np.uint16),
        "random": np.random.default_rng(3).integers(0, 65536, (SIZE, SIZE)).astype(np.uint16),
    }[frame]
    report = quietly(raw, method=method).report
    assert json.loads(json.dumps(report, allow_nan=False)) == report
    assert {"clipped_fraction", "valid_fraction", "mean_s0", "light_polarizer_deg"} <= set(report["statistics"])
    assert report["layout"] == Layout().spec and report["full_resolution"] is False


@pytest.mark.parametrize("method", METHODS)
def test_extreme_frames(method: str) -> None:
    """Black gives zeros, valid; all clipped gives finite images, nowhere valid; neither is NaN; both are remarked.

    Networks do not know zero, but less than what they take for black, and white only about.
    """
    black = quietly(np.zeros((SIZE, SIZE), np.uint8), method=method)
    floor, least = (MIN_BRIGHTNESS, 1.5) if method in (*NAMES, "paper") else (0.0, 2 - 1e-5)
    assert float(black.diffuse.max()) <= floor and float(black.specular.max()) <= floor and bool(black.valid.all())
    assert float(black.dolp.max()) == 0
    assert any("black frame" in note for note in black.report["warnings"])
    white = quietly(np.full((SIZE, SIZE), 255, np.uint8), method=method)
    assert not bool(white.valid.any())
    assert bool(np.isfinite(white.diffuse).all() and np.isfinite(white.specular).all())
    assert float((white.diffuse + white.specular).min()) >= least
    assert any("every sample is clipped" in note for note in white.report["warnings"])


def test_odd_sizes_are_cropped_aloud() -> None:
    """An odd last row or column is left out, with a note, and nothing else changes."""
    raw = raw_frame()
    with pytest.warns(polsep.PolsepWarning, match="size 95x93 cuts polarizer cells of the layout: cropped to 94x92"):
        out = polsep.separate(raw[:93, :95], light_color="white")
    assert float(np.abs(out.diffuse - quietly(raw[:92, :94]).diffuse).max()) == 0


#: A sensor of which the dark was measured.
DARK = polsep.Calibration(Layout(), 255, black_level=2.0)

REFUSED: list[tuple[Any, dict[str, Any], str]] = [
    (np.full((8, 8), np.nan, np.float32), {}, "expected finite values"),
    (np.zeros((8, 8), np.int32), {}, "expected samples of uint8, uint16"),
    (np.zeros((3, 64), np.uint8), {}, "at least 4x4"),
    (np.zeros((2, 8, 8, 2), np.uint8), {}, "expected a mosaic"),
    (np.random.default_rng(0).random((8, 8, 3)), {}, "demosaicked picture"),
    ([[1, 2], [3, 4]], {}, "expected a NumPy array, found list"),
    (np.ma.array(np.zeros((8, 8), np.uint8), mask=True), {}, "expected a NumPy array, found MaskedArray"),
    (np.zeros((8, 8), np.uint8), {"method": "magic"}, "expected a method of auto"),
    (np.zeros((8, 8), np.uint8), {"method": "Analytic"}, "expected a method of auto"),
    (np.zeros((8, 8), np.uint8), {"device": "toaster"}, "expected a device"),
    (np.zeros((8, 8), np.uint8), {"light_color": "red"}, "expected a light colour"),
    (np.zeros((8, 8), np.uint8), {"light_color": (1, 2)}, "expected a light colour"),
    (np.zeros((8, 8), np.uint8), {"light_color": (1, 0, 1)}, "expected a light colour"),
    (np.zeros((8, 8), np.uint8), {"light_color": (1, -1, 1)}, "expected a light colour"),
    (np.zeros((8, 8), np.uint8), {"light_color": (1, float("nan"), 1)}, "expected a light colour"),
    (np.zeros((8, 8), np.uint8), {"black_level": 300}, "above the black level"),
    (np.zeros((8, 8), np.uint8), {"white_level": float("inf")}, "expected finite black and white"),
]


@pytest.mark.parametrize(
    ("raw", "options", "message"), REFUSED, ids=[f"{k}-{r[2][:24]}" for k, r in enumerate(REFUSED)]
)
def test_bad_arguments_are_one_line(raw: Any, options: dict[str, Any], message: str) -> None:
    """Whatever is not a mosaic or a known setting is a ValueError of one line that says what was expected."""
    with pytest.raises(ValueError, match=message) as caught:
        polsep.separate(raw, **options)
    assert "\n" not in str(caught.value) and "found" in str(caught.value)


@pytest.mark.parametrize("options", [{"device": "meta"}, {"device": None}, {"light_color": 5}, {"light_color": None}])
def test_arguments_of_other_kinds_are_one_line(options: dict[str, Any]) -> None:
    """A device without data or none, or a light colour that is no sequence, is a ValueError of one line too."""
    with pytest.raises(ValueError, match="expected") as caught:
        polsep.separate(raw_frame(), **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("raw", "options", "advice"),
    [
        (torch.zeros(8, 8), {}, r"found Tensor: say raw.numpy\(force=True\)"),
        ("shot.png", {}, "found str: read files by polsep.read_frames"),
        (None, {}, "found NoneType"),
        (np.zeros((8, 8), np.uint8), {"layout": 3}, "found int"),
        (np.zeros((8, 8), np.uint8), {"white_level": "4095"}, "white level that is a number"),
        (np.zeros((8, 8), np.uint8), {"method": 3}, "name of a method"),
        (np.zeros((8, 8), np.uint8), {"light_color": 3}, "light colour of three"),
        (np.zeros((8, 8), np.uint8), {"device": 3}, "device"),
        (np.zeros((8, 8), np.uint8), {"calibration": 3}, "calibration"),
        (np.zeros((8, 8), np.uint8), {"ambient": 3}, "lamp off"),
        (np.zeros((8, 8), np.uint8), {"full": "yes"}, "True or False"),
        (np.zeros((8, 8), np.uint8), {"black_level": "8", "calibration": DARK}, "black level that is a number"),
    ],
)
def test_wrong_types_are_type_errors(raw: Any, options: dict[str, Any], advice: str) -> None:
    """An argument of a wrong type is a TypeError of one line that says what to do."""
    with pytest.raises(TypeError, match=advice) as caught:
        polsep.separate(raw, **options)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 120


def test_captures_and_four_angle_images_are_separated_as_files_are() -> None:
    """A `Mosaic` gives what its array gives; four angle images keep their size; planes of a mosaic go back to it."""
    raw = raw_frame()
    mosaic = as_mosaic(raw)[0]
    assert (quietly(mosaic, method="analytic").diffuse == quietly(raw, method="analytic").diffuse).all()
    with pytest.raises(ValueError, match="levels with an array"):
        polsep.separate(mosaic, white_level=65535)
    planes = np.stack([raw] * 4)
    assert quietly(planes, method="analytic").diffuse.shape == (*raw.shape, 1)
    assert quietly(np.stack([planes] * 3, -1), method="analytic").diffuse.shape == (*raw.shape, 3)
    cells = np.stack([raw[1::2, 1::2], raw[::2, 1::2], raw[::2, ::2], raw[1::2, ::2]])
    assert (quietly(cells, "analytic", layout="color").diffuse == quietly(raw, "analytic").diffuse).all()
    with pytest.raises(ValueError, match="expected a layout of the angles 0, 45, 90, 135 for four planes"):
        polsep.separate(planes, layout="0,60,90,150/mono")
    assert quietly(planes, "analytic", layout="0,45,90,135/mono").diffuse.shape == (*raw.shape, 1)


def test_lamp_off_frames_come_as_the_frame_does() -> None:
    """Beside a `Mosaic` and beside planes, arrays have its layout and levels; a `Mosaic` its own."""
    raw, room = raw_frame(), raw_frame(exposure=0.1)
    plain = quietly(raw, "analytic", ambient=room, light_color="white").diffuse
    assert plain.mean() < 0.95 * quietly(raw, "analytic", light_color="white").diffuse.mean()

    def cells(codes: NDArray[Any]) -> NDArray[Any]:
        return np.stack([codes[1::2, 1::2], codes[::2, 1::2], codes[::2, ::2], codes[1::2, ::2]])

    mosaics = [as_mosaic(codes)[0] for codes in (raw, room)]
    for frame, ambient, options in (
        (mosaics[0], room, {}),
        (mosaics[0], mosaics[1], {}),
        (mosaics[0], [room, mosaics[1]], {}),
        (cells(raw), cells(room), {"layout": "color"}),
        (cells(raw), [cells(room)] * 2, {"layout": "color"}),
    ):
        found = quietly(frame, "analytic", ambient=ambient, light_color="white", **options)
        np.testing.assert_allclose(found.diffuse, plain, atol=1e-6)


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_lamp_off_frames_of_other_levels_are_refused(dtype: str) -> None:
    """Nothing would be subtracted, or all of it, without a word."""
    raw, room = raw_frame(), raw_frame(dtype, exposure=0.1)
    with pytest.raises(ValueError, match="expected a lamp-off frame like the frame"):
        polsep.separate(raw, "analytic", ambient=room)
    with pytest.raises(ValueError, match="expected a lamp-off frame like the frame"):
        polsep.separate(room, "analytic", ambient=raw)
    if dtype == "float32":
        with pytest.raises(ValueError, match="expected a lamp-off frame like the frame"):
            polsep.separate(as_mosaic(raw)[0], "analytic", ambient=room)


def test_a_lamp_off_frame_of_codes_at_the_other_end_of_words_is_noted() -> None:
    """A sixteenth of the room is subtracted, or sixteen times it; frames alike, and means of several, say nothing."""
    codes, room = (raw_frame(exposure=light) // 16 for light in (1.0, 0.1))
    gains = Calibration(Layout(), 4095.0, gains=((1.0, 1.1, 0.9, 1.0),) * 4)

    def said(frame: NDArray[Any], ambient: Any, **options: Any) -> str:
        notes = quietly(frame, "analytic", ambient=ambient, **options).report["warnings"]
        return " ".join(note for note in notes if "left-justified in 16 bits?" in note)

    assert "16 times too little is subtracted" in said(16 * codes, room)
    assert "16 times too little is subtracted" in said(16 * codes, [16 * room, room], calibration=gains)
    assert "16 times too much is subtracted" in said(codes, 16 * room, white_level=4095)
    assert not said(16 * codes, 16 * room) and not said(codes, room, white_level=4095)
    assert not said(16 * codes, (16 * codes) // 3) and not said(16 * codes, 0 * room)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_a_lamp_off_frame_of_floats_of_another_scale_is_noted(kind: type) -> None:
    """Codes of 12 bits over 65535 beside such over 4095, or at the other end of words."""
    codes, room = ((raw_frame(exposure=light) // 16).astype(kind) for light in (1.0, 0.1))

    def said(frame: NDArray[Any], ambient: NDArray[Any], white: float = 1) -> str:
        notes = quietly(frame, "analytic", ambient=ambient, white_level=white).report["warnings"]
        return " ".join(note for note in notes if "are both of one unit?" in note)

    for large, much in ((codes / 4095, room / 4095), (16 * codes / 65535, 16 * room / 65535)):
        assert "16 times too little is subtracted" in said(large, room / 65535)
        assert "16 times too much is subtracted" in said(codes / 65535, much, 4095 / 65535)
        assert not said(large, much) and not said(large, 0 * room) and not said(large, room / 65535 + 1e-7 * codes)
    assert not said(codes / 65535, room / 65535, 4095 / 65535)


def test_lamp_off_frames_with_an_axis_of_colours_are_one_frame() -> None:
    """``[H, W, 1]`` and three equal channels are one frame, as beside the lamp; an axis before them holds several."""
    raw, room = raw_frame()[..., None], raw_frame(exposure=0.1)[..., None]
    plain = quietly(raw, "analytic", ambient=room[..., 0]).diffuse
    for ambient in (room, np.repeat(room, 3, axis=2), np.stack([room, room])):
        assert (quietly(raw, "analytic", ambient=ambient).diffuse == plain).all()


def test_lamp_off_frames_of_the_same_unit_are_taken() -> None:
    """Means of frames, other byte orders, other floats, black ones and such with a bright spot."""
    raw, room = raw_frame(), raw_frame(exposure=0.1)
    plain = quietly(raw, "analytic", ambient=room, light_color="white").diffuse
    for frame, ambient in ((raw, room.astype(np.float64)), (raw, room.astype(">u2")), (raw.astype(">u2"), room)):
        found = quietly(frame, "analytic", ambient=ambient, light_color="white").diffuse
        np.testing.assert_allclose(found, plain, atol=1e-6)
    light, dark = raw_frame("float32"), raw_frame("float32", exposure=0.1).astype(np.float64)
    dark[3, 5] = 3.0
    for frame, ambient, white in ((light, dark, None), (8 * light, dark, 8.0), (raw, 0 * dark, 65535)):
        assert quietly(frame, "analytic", ambient=ambient, white_level=white).diffuse.any()
    with pytest.raises(TypeError, match="expected a NumPy array"):
        polsep.separate(raw, ambient=["dark.tiff"])  # type: ignore[list-item]


@pytest.mark.parametrize("method", ["analytic", "joint-fast"])
def test_statistics_are_of_images_without_falloff(method: str) -> None:
    """The mean light and the expected errors of a frame whose lens darkens corners are those of what is returned."""
    mosaic = replace(as_mosaic(raw_frame(light=ODD_LIGHT))[0], falloff=((0.8, 0.0), (0.0, 0.0), (-0.2, 0.0)))
    found = separate_capture(mosaic, method, ODD_LIGHT)
    facts, gain = found.report["statistics"], np.array(ODD_LIGHT, np.float32)
    light = (found.diffuse + found.specular) / gain
    assert facts["mean_s0"] == pytest.approx(float(light.mean()), rel=1e-4)
    share = float((found.specular / gain).mean() / light.mean())
    assert facts["specular_fraction"] == pytest.approx(share, rel=1e-4)
    if found.error is not None:
        for k, name in enumerate(("diffuse", "specular")):
            rms = float(np.sqrt(np.square(found.error[..., k], dtype=np.float64).mean()) / gain.mean())
            assert facts[f"expected_{name}_error"] == pytest.approx(rms, rel=1e-4)


def test_results_are_short_texts() -> None:
    """What people see of results in Python is one short line, not the arrays."""
    out = quietly(raw_frame(), method="analytic")
    assert repr(out) == f"Result(analytic: diffuse and specular [{SIZE // 2}, {SIZE // 2}, 3], no warnings)"
    for thing in (as_mosaic(raw_frame())[0], measure(lit_scene(), (0.0, 1.0, 2.0)), lit_scene()):
        assert len(repr(thing)) < 300 and "float32 [" in repr(thing)


def test_results_can_be_compared_and_collected() -> None:
    """Things that hold arrays are equal to themselves alone: lists, sets and ``==`` take them."""
    frame = raw_frame()
    results = [quietly(frame, method="analytic") for _ in range(2)]
    for one, other in (results, [as_mosaic(frame)[0] for _ in range(2)], [lit_scene() for _ in range(2)]):
        assert one == one and one != other and other in [one, other] and len({one, other}) == 2


def test_reports_hold_what_people_add(tmp_path: Path) -> None:
    """Numbers and arrays of NumPy are written as JSON has them; what it has not is named, and nothing is written."""
    out = quietly(raw_frame(), method="analytic")
    out.report.update(celsius=np.float32(36.5), good=np.bool_(True), place=np.arange(3, dtype=np.uint8))
    out.save(tmp_path / "shot.npz")
    report = json.loads((tmp_path / "shot.json").read_text("utf-8"))["report"]
    assert (report["celsius"], report["good"], report["place"]) == (36.5, True, [0, 1, 2])
    out.report["camera"] = tmp_path
    with pytest.raises(ValueError, match=r"^expected numbers, text, lists and mappings in a report, found PosixPath$"):
        out.save(tmp_path / "other.npz")
    assert not list(tmp_path.glob("other*"))


class Stubborn(np.ndarray):
    """An array that has no operations, as those with units refuse some."""

    def __array_ufunc__(self, *arguments: Any, **options: Any) -> Any:
        raise RuntimeError("no operations")


def test_arrays_of_subclasses_are_arrays() -> None:
    """Only their samples count."""
    raw = raw_frame()
    found, wanted = (quietly(frame, method="analytic") for frame in (raw.view(Stubborn), raw))
    assert (found.diffuse == wanted.diffuse).all() and type(found.diffuse) is np.ndarray


class OnDevice:
    """As CuPy's arrays look."""

    __cuda_array_interface__: ClassVar[dict[str, Any]] = {}


@pytest.mark.parametrize(
    ("raw", "advice"),
    [
        (OnDevice(), "found OnDevice: copy it from the GPU, as cupy.asnumpy does"),
        ([[1, 2], [3, 4]], "found list: say numpy.array"),
        (memoryview(b"ab"), "found memoryview: say numpy.array"),
        (torch.zeros(4, 4), "found Tensor: say raw.numpy"),
    ],
)
def test_what_is_no_array_gets_advice(raw: Any, advice: str) -> None:
    """One line says how to make it one."""
    with pytest.raises(TypeError, match=advice):
        polsep.separate(raw)


@pytest.mark.parametrize("name", ["shot.exr", "shot.npz", "shot.tif", "shot.png", "shot"])
def test_results_are_saved(tmp_path: Path, name: str) -> None:
    """`save` writes what the command line writes; files from before stay unless they are to be replaced."""
    out = quietly(raw_frame(), method="analytic")
    written = out.save(tmp_path / "new" / name)
    assert {path.name for path in written} >= {"shot.png", "shot.json"} and all(path.is_file() for path in written)
    with pytest.raises(ValueError, match="found one from before; overwrite=True replaces it"):
        out.save(tmp_path / "new" / name)
    assert out.save(tmp_path / "new" / name, overwrite=True) == written
    assert quietly(raw_frame(), method="analytic", full=np.True_).save(tmp_path / "full" / name)
    if name.endswith(("exr", "npz")):
        assert (polsep.read_separated(written[0]).diffuse == out.diffuse).all()


def test_results_of_unknown_endings_are_refused(tmp_path: Path) -> None:
    """An ending that no format has, or one without a name, is refused before anything is written."""
    with pytest.raises(ValueError, match=r"ends in \.exr"):
        quietly(raw_frame(), method="analytic").save(tmp_path / "shot.jpg")
    with pytest.raises(ValueError, match=r"ends in \.exr.*, found 'shot\.'"):
        quietly(raw_frame(), method="analytic").save(tmp_path / "shot.")
    with pytest.raises(ValueError, match=r"expected a file name that ends in .*, found '\.exr'"):
        quietly(raw_frame(), method="analytic").save(tmp_path / "new" / ".exr")
    assert not list(tmp_path.iterdir())


def test_results_are_not_saved_under_a_name_too_long(tmp_path: Path) -> None:
    """Which is refused as every file that cannot be written is."""
    with pytest.raises(ValueError, match="expected to write 'xxx"):
        quietly(raw_frame(), method="analytic").save(tmp_path / f"{'x' * 300}.exr")


def test_results_are_not_saved_as_a_folder(tmp_path: Path) -> None:
    """A folder is no name of a frame: the files would lie beside it, with its name."""
    for folder in (f"{tmp_path}/new/", tmp_path):
        with pytest.raises(ValueError, match=r"expected a file name like .*shot\.exr, found a folder"):
            quietly(raw_frame(), method="analytic").save(folder)
    assert not list(tmp_path.iterdir()) and not tmp_path.with_suffix(".exr").exists()
    assert list(tmp_path.iterdir()) == []


def test_results_are_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    """`show` opens the preview, and returns it; in a notebook it only returns it."""
    opened: list[Image.Image] = []
    monkeypatch.setattr(Image.Image, "show", lambda image: opened.append(image))
    out = quietly(raw_frame(), method="analytic")
    shown = out.show()
    assert opened == [shown] and (np.asarray(shown) == contact_sheet(out)).all()
    monkeypatch.setattr("builtins.__IPYTHON__", True, raising=False)
    out.show()
    assert len(opened) == 1


def test_expected_errors_of_ordinary_pixels_stand_beside_the_mean() -> None:
    """Median and 95 % of the expected errors are in the report, in white light as the mean is."""
    out = quietly(raw_frame(), method="joint-fast", light_color=(0.5, 1, 1.5))
    facts = out.report["statistics"]
    assert out.error is not None
    for k, image in enumerate(("diffuse", "specular")):
        np.testing.assert_allclose(facts[f"expected_{image}_error_median"], np.median(out.error[..., k]), rtol=1e-5)
        assert facts[f"expected_{image}_error_median"] <= facts[f"expected_{image}_error_95"]


def test_every_shipped_method_and_device_is_found() -> None:
    """Method names find themselves; auto devices exist; the table of methods describes each."""
    for name, method in METHODS.items():
        assert find_method(name, Mosaic(torch.zeros(8, 8), Layout(), 0, 1)) is method and method.name == name
        assert method.summary and method.needs and method.source
    assert find_device("cpu") == "cpu" and find_device("auto") in ("cpu", "cuda")


@pytest.mark.parametrize("method", ["analytic", "color-affine"])
def test_said_light_color_undoes_the_light(method: str) -> None:
    """With the light's colour said, a scene in coloured light is the scene in white light times that colour."""
    white = quietly(raw_frame("float32", exposure=0.5), method=method)
    colored = quietly(raw_frame("float32", light=ODD_LIGHT, exposure=0.5), method=method, light_color=ODD_LIGHT)
    gain = np.array(ODD_LIGHT, np.float32)
    assert float(np.abs(colored.specular - white.specular * gain).max()) < 1e-5
    assert float(np.abs(colored.diffuse - white.diffuse * gain).max()) < 1e-5


@pytest.mark.parametrize("method", METHODS)
def test_only_the_ratios_of_a_light_color_count(method: str) -> None:
    """A grey card may be measured in codes: the same colour in another unit gives the same images and report."""
    raw = raw_frame(light=ODD_LIGHT)
    one = quietly(raw, method=method, light_color=ODD_LIGHT)
    other = quietly(raw, method=method, light_color=tuple(2048 * gain for gain in ODD_LIGHT))
    assert other.report == one.report and one.report["light_color"] == list(ODD_LIGHT)
    assert (other.diffuse == one.diffuse).all() and (other.specular == one.specular).all()


def test_the_light_color_may_be_an_array() -> None:
    """A NumPy array of three numbers is a light colour as a tuple is."""
    raw = raw_frame()
    stated = quietly(raw, method="analytic", light_color=ODD_LIGHT)
    assert (stated.specular == quietly(raw, method="analytic", light_color=np.array(ODD_LIGHT)).specular).all()
    with pytest.raises(ValueError, match="light colour of three positive numbers"):
        polsep.separate(raw, light_color=np.ones(4))  # type: ignore[arg-type]


def test_a_device_that_is_none_is_refused_in_few_words() -> None:
    """Without torch's list of all devices that it knows."""
    with pytest.raises(ValueError, match=r"expected a device like auto, cpu or cuda, found 'gpu'$"):
        find_device("gpu")


def test_mono_ignores_the_light_color(tmp_path: Path) -> None:
    """One channel has no colour: the light's colour changes nothing, which is said."""
    mono = Layout(bayer=None)
    raw = raw_frame(layout=mono)
    one, other = quietly(raw, layout=mono), quietly(raw, layout=mono, light_color=ODD_LIGHT)
    assert float(np.abs(one.specular - other.specular).max()) == 0
    notes = ["the colour stated of the light changes nothing: mono frames show no colours"]
    assert other.report["warnings"] == notes + one.report["warnings"]
    assert open_separated(one.save(tmp_path / "shot")[0], ODD_LIGHT)[1] == one.report["warnings"] + notes


def test_light_of_a_report_is_that_of_the_images() -> None:
    """Where highlights were filled, and where s0 of co-sited samples replaces that of a network."""
    y, x = np.mgrid[:SIZE, :SIZE]
    glow = 3.0 * np.exp(-((x - 40) ** 2 + (y - 50) ** 2) / 30)
    light = torch.from_numpy(np.stack([0.3 + 0.1 * np.sin(x / (9 + k)) + glow for k in range(3)]))
    polarized = torch.from_numpy(0.9 * glow).expand(3, -1, -1)
    scene = Stokes(light, polarized * 0.6, polarized * 0.8)
    mosaic = expose(scene, Layout(), IDEAL)
    samples = measure(scene, tuple(np.radians([0, 45, 90, 135]).tolist()))
    clipped = replace(samples, data=samples.data.clamp(max=1), clipped=samples.data >= 1)
    for capture in (replace(mosaic, data=mosaic.data.numpy().astype(np.float32)), clipped):
        found = separate_capture(capture, "joint-fast", "white")
        facts = found.report["statistics"]
        assert facts["mean_s0"] == pytest.approx(float((found.diffuse + found.specular).mean()), rel=2e-5)
        assert isinstance(capture, Mosaic) == (found.report["filled_under_highlights"] > 0)


def test_cosited_captures_keep_their_resolution() -> None:
    """Four angle images are separated at their own resolution, by the same methods."""
    angles = tuple(np.radians([0, 45, 90, 135]).tolist())
    out = separate_capture(measure(lit_scene(), angles))
    assert out.diffuse.shape == (SIZE, SIZE, 3)
    assert out.report["layout"] == "four co-sited angle images"


@pytest.mark.parametrize("method", list(METHODS))
def test_thread_count_does_not_matter(method: str) -> None:
    """One thread or all: the same images within 1e-5."""
    mosaic = expose(lit_scene(exposure=1.5), Layout(), IMX250, torch.Generator().manual_seed(5))
    threads = torch.get_num_threads()
    many = separate_capture(mosaic, method, "white")
    try:
        torch.set_num_threads(1)
        one = separate_capture(mosaic, method, "white")
    finally:
        torch.set_num_threads(threads)
    assert float(np.abs(many.diffuse - one.diffuse).max()) < 1e-5
    assert float(np.abs(many.specular - one.specular).max()) < 1e-5
    assert bool((many.valid == one.valid).all())


def test_crops_agree_with_the_whole() -> None:
    """A crop by whole periods is the crop of the result, away from its border by the widest window."""
    raw = np.tile(raw_frame(), (2, 2))
    whole, crop = quietly(raw, method="analytic"), quietly(raw[40:, 40:], method="analytic")
    assert float(np.abs(whole.specular[20:, 20:] - crop.specular)[2:, 2:].max()) < 1e-6


def test_mosaic_refuses_what_it_cannot_hold() -> None:
    """A `Mosaic` smaller than its period, or with white not above black, is refused."""
    with pytest.raises(ValueError, match="at least 4x4"):
        Mosaic(torch.zeros(3, 8), Layout(), 0.0, 1.0)
    with pytest.raises(ValueError, match="a white level above"):
        Mosaic(torch.zeros(8, 8), Layout(), 1.0, 1.0)
    with pytest.raises(ValueError, match=r"expected a Layout \(Layout.parse reads text\), found 'color'"):
        Mosaic(torch.zeros(8, 8), "color", 0.0, 1.0)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"expected levels that are numbers, found black 0\.0, white None"):
        Mosaic(torch.zeros(8, 8), Layout(), 0.0, None)  # type: ignore[arg-type]


def test_angles_of_measurements_are_radians() -> None:
    """Degrees would give images of any other angles without a word."""
    with pytest.raises(ValueError, match=r"expected analyser angles in radians, found \[0.0, 45.0, 90.0, 135.0\]"):
        Measurements(np.zeros((4, 1, 8, 8), np.float32), (0, 45, 90, 135))


@pytest.mark.parametrize("shape", [(1, 4, 1, 8, 8), (4, 2, 8, 8)])
def test_angle_images_that_are_no_frame_are_one_line(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"expected angle images \[K, C, H, W\] of 1 or 3 colours, found \("):
        polsep.separate(Measurements(np.ones(shape, np.float32), Layout().angles), "analytic")


@pytest.mark.parametrize("method", ["joint-fast", "analytic"])
def test_captures_that_are_no_frame_are_one_line(method: str) -> None:
    """Batches, which a `Mosaic` holds too, and samples that no array would be taken with."""
    mosaic = as_mosaic(raw_frame())[0]
    with pytest.raises(ValueError, match=r"expected one mosaic \[H, W\], found a batch of shape \(2, 96, 96\)"):
        polsep.separate(replace(mosaic, data=np.stack([mosaic.data] * 2)), method)
    mosaic.data[7, 5] = np.nan
    with pytest.raises(ValueError, match="expected finite samples, found 1 that are not"):
        polsep.separate(mosaic, method)


def test_frames_are_separated_where_numpy_is_to_raise() -> None:
    """Settings of NumPy for the caller's own code change nothing."""
    raw = raw_frame(light=ODD_LIGHT)
    plain = quietly(raw, "joint-fast", light_color="auto")
    with np.errstate(all="raise"):
        found = quietly(raw, "joint-fast", light_color="auto")
        assert polsep.find_light(raw) == polsep.find_light(raw.copy())
    assert (found.diffuse == plain.diffuse).all()


def run_python(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_import_is_cheap() -> None:
    """``import polsep`` loads neither torch nor NumPy nor any codec."""
    heavy = "{'torch', 'numpy', 'imagecodecs', 'tifffile', 'OpenEXR', 'PIL', 'click', 'rich'}"
    assert run_python(f"import sys, polsep; print(sorted({heavy} & set(sys.modules)))") == "[]"


@pytest.mark.parametrize(("method", "most"), [("analytic", 480), ("color-affine", 600)])
def test_memory_of_a_whole_frame(method: str, most: float, compiled: None) -> None:
    """A 5-megapixel frame needs so many MiB at most, Python, torch and numba included, once kernels are compiled."""
    code = (
        "import warnings, numpy as np, polsep;"
        "from polsep.io.store.rows import read_peak_memory;"
        "warnings.simplefilter('ignore');"
        "raw = np.random.default_rng(0).integers(0, 40000, (2048, 2448), np.uint16); raw[:300, :300] = 65535;"
        f"polsep.separate(raw, {method!r}, device='cpu'); print(read_peak_memory())"
    )
    assert float(run_python(code)) < most


@pytest.mark.parametrize("text", ["color", "mono", "0,45,135,90/BGGR"])
def test_layouts_may_be_text(text: str) -> None:
    """Text means the layout that `Layout.parse` reads."""
    raw = np.random.default_rng(5).integers(0, 4096, (32, 32), np.uint16)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PolsepWarning)
        named, meant = (separate(raw, "analytic", layout, white_level=4095) for layout in (text, Layout.parse(text)))
    np.testing.assert_array_equal(named.diffuse, meant.diffuse)
    with pytest.raises(ValueError, match='expected "color", "mono" or angles'):
        separate(raw, layout="monochrome")
