"""The product on one page: raw frame -> mosaic -> demosaic -> separate -> NumPy images and a report.

A `Method` (`methods`) maps one frame, a `Mosaic` or co-sited `Measurements`, to its images. The light's colour is
divided out before a method runs and multiplied back into its diffuse and specular image, so methods see white light,
and DoLP, AoLP and statistics are of white light.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from array_api_compat import is_array_api_obj
from numpy.typing import NDArray

from polsep.compute.arguments import WrongType, require_flags
from polsep.compute.arrays import namespace, to_device
from polsep.compute.devices import find_device
from polsep.demosaic.measured_stokes import measured_stokes
from polsep.io.store.atomic import OutputError
from polsep.io.store.calibrations import read_calibration
from polsep.io.store.errors import as_path
from polsep.light.light_color import LightColor, resolve_light
from polsep.methods import Method, find_method
from polsep.physics.stokes import Measurements
from polsep.sensor.ambient import unit_remarks
from polsep.sensor.calibration import Calibration
from polsep.sensor.camera import Capture, Layout, Mosaic
from polsep.sensor.checks import check_mosaic
from polsep.sensor.corrections import Corrections
from polsep.sensor.falloff import Table, falloff_image
from polsep.sensor.levels import as_layout, as_mosaic, has_levels_of, planes_as_capture
from polsep.separation.colored_specular import Colored, color_specular
from polsep.separation.images import FrameImages
from polsep.separation.lamp_polarization import separate_by_known_lamp
from polsep.separation.report import (
    PAIR_LAYOUT,
    SeparatedFrame,
    describe,
    error_quantiles,
    light_statistics,
    on_host,
    tally_again,
)
from polsep.separation.under_highlights import fill_under_highlights

if TYPE_CHECKING:
    from polsep.io.results.previews import Picture

#: Formats by the endings of file names.
_ENDINGS = {".exr": "exr", ".npz": "npz", ".tiff": "tiff", ".tif": "tiff", ".png": "png"}


class PolsepWarning(UserWarning):
    """Something about a frame that the user should know: the layout, the bit depth, the exposure, the light."""


@dataclass(frozen=True, eq=False, repr=False)
class Result(SeparatedFrame):
    """A separated frame that can be saved and shown; its images are those of `SeparatedFrame`.

    ``capture``: what was separated, its defects repaired, from which `with_stokes` takes Stokes images.
    """

    capture: Capture | None = None

    def with_stokes(self) -> Result:
        """The same with ``stokes [3, h, w, C]``: s0, s1, s2 as measured. Raises ValueError where there is no capture.

        In the unit and the light of the images, and registered with them; not changed by the method
        (`demosaic.measured_stokes`).
        """
        if self.capture is None:
            raise ValueError("expected a frame with its capture, found one without: Stokes images are measured in it")
        light, full = tuple(self.report["light_color"]), self.report["full_resolution"]
        stokes = measured_stokes(self.capture, light, full)
        if isinstance(self.capture, Mosaic) and self.capture.falloff is not None:
            stokes = stokes / falloff_image(self.capture.falloff, *stokes.shape[1:3])[..., None]
        return replace(self, stokes=stokes)

    def save(self, path: str | PathLike[str], overwrite: bool = False, stokes: bool = False) -> list[Path]:
        """Write images, a preview STEM.png and the report STEM.json, as `polsep separate` does; return their paths.

        ``path``: DIR/STEM.exr, .npz, .tiff or .png (sets of one file per image); EXR without an ending. All or nothing.
        ``stokes``: EXR files also get the layers S0, S1, S2 of `with_stokes`. Raises ValueError where files exist and
        ``overwrite`` is False, on another ending, on a folder, or where writing fails.
        """
        from polsep.io.results.separation_writer import write_separation

        target = as_path(path)
        require_flags(overwrite=overwrite, stokes=stokes)
        if os.fspath(path).endswith(("/", os.sep)) or os.path.isdir(target):
            raise OutputError(f"expected a file name like {target / 'shot.exr'}, found a folder")
        stem = target.stem if target.suffix.lower() in _ENDINGS else target.name
        if (target.suffix and stem == target.name) or target.name.lower() in _ENDINGS or target.name.endswith("."):
            raise ValueError(f"expected a file name that ends in {', '.join(_ENDINGS)}, found {target.name!r:.80}")
        frame, kind = self.with_stokes() if stokes else self, _ENDINGS.get(target.suffix.lower(), "exr")
        try:
            return write_separation(frame, target.parent, stem, kind, overwrite)
        except OutputError as error:
            raise OutputError(str(error).replace("--overwrite replaces", "overwrite=True replaces")) from None

    def show(self) -> Picture:
        """Show the preview in the system's picture viewer and return it, which notebooks display instead."""
        from polsep.io.results.previews import show_frame

        return show_frame(self)


def separate(
    raw: NDArray[Any] | Capture,
    method: str = "auto",
    layout: Layout | str | None = None,
    black_level: float = 0,
    white_level: float | None = None,
    light_color: LightColor | str = "auto",
    device: str = "auto",
    full: bool = False,
    calibration: Calibration | str | PathLike[str] | None = None,
    ambient: NDArray[Any] | Mosaic | Sequence[NDArray[Any] | Mosaic] | None = None,
    lamp_dolp: float | None = None,
) -> Result:
    """Separate one raw mosaic ``[H, W]`` (uint8, uint16, float32) into diffuse and specular.

    Images are ``[H/2, W/2, C]``, the mean over each 2x2 polarizer cell; ``full=True`` gives ``[H, W, C]``. ``layout``
    None is Sony's colour order; text is "color", "mono" or a `Layout.spec`. ``white_level`` None is the dtype's maximum
    (1.0 for float): 12-bit codes in uint16 need 4095; moved to the left, to 65520, they need nothing.
    ``calibration``: a file of `polsep calibrate`, applied first. ``ambient``: a raw frame with the lamp off, or
    several, subtracted. ``light_color``: "auto" finds it in the frame (`find_light`), or "white", or camera RGB of the
    light. ``lamp_dolp``: degree of polarization of the lamp where it is known, in twice the time; None: networks look
    for it in colour frames, and it is 1 where nothing shows it. ``raw`` may also be four angle images at 0, 45, 90,
    135 degrees, ``[4, H, W]`` or ``[4, H, W, 3]``, which keep their resolution, or what `read_frames` read. What the
    user should know is in ``report["warnings"]`` and issued as `PolsepWarning`. Raises ValueError, with one line of
    what was expected and what was found, on other input; of wrong types it is also a TypeError.
    """
    require_flags(full=full)
    if not isinstance(calibration, Calibration | str | PathLike | None):
        raise WrongType(f"expected a calibration or its file, found {type(calibration).__name__}")
    measured = calibration if isinstance(calibration, Calibration | None) else read_calibration(Path(calibration))
    if measured is not None:
        measured.require_black_level(black_level, "black_level")
        if isinstance(raw, np.ndarray):
            white_level = measured.white_level_of(raw) if white_level is None else white_level
            black_level = measured.black_level_of(raw, black_level, white_level)
    capture, notes = _as_capture(raw, layout, black_level, white_level)
    if isinstance(capture, Mosaic):
        corrections = Corrections(measured)
        if ambient is not None:
            four = isinstance(raw, np.ndarray) and raw.ndim == 3 and raw.shape[0] == 4
            kind = None if white_level is not None else getattr(raw, "dtype", None)
            corrections = _with_ambient(corrections, _ambient_frames(ambient, four), capture, kind)
        capture, more = corrections.apply_noting(capture)
        notes += more
    elif measured is not None or ambient is not None:
        raise ValueError("expected a raw mosaic to calibrate or to subtract room light from, found four angle images")
    capture = with_lamp_dolp(capture, lamp_dolp)
    frame = separate_capture(capture, method, light_color, device, bool(full))
    frame.report["warnings"] = [*notes, *frame.report["warnings"]]
    for note in frame.report["warnings"]:
        warnings.warn(note, PolsepWarning, stacklevel=2)
    return frame


def _as_capture(
    raw: NDArray[Any] | Capture, layout: Layout | str | None, black_level: float, white_level: float | None
) -> tuple[Capture, tuple[str, ...]]:
    """A capture of anything that `separate` accepts, with notes for the user."""
    if isinstance(raw, Capture):
        if layout is not None or black_level != 0 or white_level is not None:
            raise ValueError(f"expected layout and levels with an array, found them with a {type(raw).__name__}")
        finite = namespace(raw.data).isfinite(raw.data)
        if not finite.all():
            raise ValueError(f"expected finite samples, found {int((~finite).sum())} that are not")
        return raw, ()
    four = isinstance(raw, np.ndarray) and raw.ndim in (3, 4) and raw.shape[0] == 4
    if four and not (raw.ndim == 3 and raw.shape[2] in (1, 3)):
        return planes_as_capture(raw, as_layout(layout), black_level, white_level)
    return as_mosaic(raw, layout, black_level, white_level)


def _with_ambient(
    corrections: Corrections,
    frames: Sequence[NDArray[Any] | Mosaic],
    capture: Mosaic,
    kind: np.dtype[Any] | None,
) -> Corrections:
    """Corrections with the light of ``frames`` with the lamp off, and remarks on their samples; see `_as_ambient`."""
    found = [_as_ambient(dark, capture, kind) for dark in frames]
    remarks = unit_remarks(note for _, notes in found for note in notes)
    return replace(corrections.with_ambient(mosaic for mosaic, _ in found), ambient_remarks=remarks)


def _as_ambient(
    dark: NDArray[Any] | Mosaic, capture: Mosaic, kind: np.dtype[Any] | None
) -> tuple[Mosaic, tuple[str, ...]]:
    """A frame with the lamp off, of the layout and the levels of the frame with it, before both are corrected.

    With notes on its samples. ``kind``: the type of the frame's samples, where that says the white level. Raises
    ValueError on samples of other levels.
    """
    if isinstance(dark, Mosaic):
        return dark, ()
    if isinstance(dark, np.ndarray) and not has_levels_of(dark, capture.white_level, kind):
        levels = f"white {capture.white_level:g}" if kind is None else f"{kind}, white {capture.white_level:g}"
        samples = f"{dark.dtype} up to {float(dark.max()):g}"
        raise ValueError(f"expected a lamp-off frame like the frame ({levels}), found {samples}")
    found, notes = _as_capture(dark, capture.layout, capture.black_level, capture.white_level)
    if not isinstance(found, Mosaic):
        raise ValueError(f"expected a raw frame with the lamp off, found shape {'x'.join(map(str, dark.shape))}")
    return found, notes


def _ambient_frames(
    ambient: NDArray[Any] | Mosaic | Sequence[NDArray[Any] | Mosaic], four: bool
) -> list[NDArray[Any] | Mosaic]:
    """One frame or several as a list; ``four``: a frame is four planes of a mosaic."""
    if isinstance(ambient, Mosaic):
        return [ambient]
    if isinstance(ambient, np.ndarray):
        gray = not four and ambient.ndim == 3 and ambient.shape[-1] in (1, 3)  # as `as_mosaic` takes them
        return [ambient] if gray or ambient.ndim == 2 + four else list(np.atleast_1d(ambient))
    if isinstance(ambient, str) or not isinstance(ambient, Sequence):
        raise WrongType(f"expected a raw frame with the lamp off, or several, found {type(ambient).__name__}")
    return list(ambient)


@np.errstate(under="ignore")  # also for callers to whom NumPy is to raise: small chances are 0
def separate_capture(
    capture: Capture,
    method: str = "auto",
    light_color: LightColor | str = "auto",
    device: str = "auto",
    full: bool = False,
) -> Result:
    """`separate` for a frame that is already a `Mosaic`, or co-sited `Measurements` (which keep their resolution)."""
    if isinstance(capture, Mosaic) and capture.data.ndim != 2:
        raise ValueError(f"expected one mosaic [H, W], found a batch of shape {tuple(capture.data.shape)}")
    if isinstance(capture, Measurements) and (capture.data.ndim != 4 or capture.data.shape[1] not in (1, 3)):
        raise ValueError(f"expected angle images [K, C, H, W] of 1 or 3 colours, found {tuple(capture.data.shape)}")
    chosen = find_method(method, capture)
    checked = check_mosaic(capture) if isinstance(capture, Mosaic) else None
    capture, device = checked.mosaic if checked else capture, find_device(device)
    light = resolve_light(light_color, capture)  # before it moves: a device sends no raw frame back
    moved = move_capture(capture, device)
    degree, colored, filled = None, Colored(), 0.0
    if isinstance(moved, Mosaic):
        degree = moved.lamp_dolp
        images = separate_by_known_lamp(lambda mosaic: chosen.run(mosaic, light.gains, full), moved, light.gains)
        if chosen.assumes_white:
            images, colored = color_specular(images, moved, light.gains)
        images, filled = fill_under_highlights(images, moved, light.gains)
    else:
        images = chosen.run(moved, light.gains, full)
    frame = make_frame(images, chosen, moved, light.gains, full)
    facts: dict[str, Any] = {
        "light": light.facts,
        "colored_specular": colored.share,
        "retained_polarization": colored.retained,
        "lamp_dolp": degree or colored.lamp_dolp,
        "filled_under_highlights": filled,
        **(checked.report if checked else {}),
    }
    warned = [*(checked.warnings if checked else ()), *light.remarks, *colored.remarks, *frame.report["warnings"]]
    return replace(frame, report=frame.report | facts | {"warnings": warned}, capture=capture)


def with_lamp_dolp(capture: Capture, degree: float | None) -> Capture:
    """The capture under a lamp of that degree of polarization. Raises ValueError where it is no mosaic."""
    if degree is None:
        return capture
    if not isinstance(capture, Mosaic):
        raise ValueError("expected a raw mosaic with the lamp's degree of polarization, found angle images")
    return replace(capture, lamp_dolp=degree)


def make_frame(
    images: FrameImages, method: Method, capture: Capture, light: tuple[float, ...], full: bool = False
) -> Result:
    """Images that a method made of a capture, in the computer's own memory, with their report."""
    images = on_host(images)
    dolp, aolp = images.dolp, images.aolp
    assert dolp is not None and aolp is not None and images.tally is not None
    report = describe(images.tally, method.expects_errors)
    if isinstance(capture, Mosaic) and capture.falloff is not None:
        images = without_falloff(images, capture.falloff, light)
        assert images.tally is not None
        report["statistics"] |= light_statistics(images.tally)
    if images.error is not None:
        report["statistics"] |= error_quantiles(images.error, math.fsum(light) / len(light))
    layout = capture.layout.spec if isinstance(capture, Mosaic) else _describe_angles(capture)
    report |= {"method": method.name, "light_color": list(light), "full_resolution": full, "layout": layout}
    if isinstance(capture, Mosaic):
        report |= {"black_level": float(capture.black_level), "white_level": float(capture.white_level)}
    if not _is_finite(report):
        raise ValueError(f"expected finite images of {method.name}, found others: is the white level far too low?")
    return Result(images.diffuse, images.specular, images.valid, dolp, aolp, report, images.error)


def without_falloff(images: FrameImages, falloff: Table, light: tuple[float, ...]) -> FrameImages:
    """Images as a lens without a ``falloff`` would give them, with sums of their own."""
    fall = falloff_image(falloff, *images.diffuse.shape[:2])[..., None]
    error = None if images.error is None else images.error / fall
    even = replace(images, diffuse=images.diffuse / fall, specular=images.specular / fall, error=error)
    return tally_again(even, light)


def _describe_angles(samples: Measurements) -> str:
    """Co-sited measurements in a few words."""
    number = len(samples.angles)
    return PAIR_LAYOUT if number == 2 else f"{'four' if number == 4 else number} co-sited angle images"


def _is_finite(facts: Any) -> bool:
    """True unless a number in a report, which sums up the images, is NaN or infinite."""
    if isinstance(facts, Mapping):
        facts = facts.values()
    elif not isinstance(facts, list | tuple):
        return not isinstance(facts, float) or math.isfinite(facts)
    return all(map(_is_finite, facts))


def move_capture(capture: Capture, device: str) -> Capture:
    """The capture with its arrays on a device: on the CPU as they are, on others as torch tensors."""
    moved = {name: to_device(value, device) for name, value in vars(capture).items() if is_array_api_obj(value)}
    return replace(capture, **moved)
