"""The product on one page: raw frame -> mosaic -> demosaic -> separate -> NumPy images and a report.

A `Method` (`methods`) maps one frame, a `Mosaic` or co-sited `Measurements`, to its images. The light's colour is
divided out before a method runs and multiplied back into its diffuse and specular image, so methods see white light,
and DoLP, AoLP and statistics are of white light.
"""

from __future__ import annotations

import math
import os
import sys
import warnings
from collections.abc import Iterable, Mapping, Sequence
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
from polsep.light.find import Light, find_light
from polsep.methods import Capture, Method, find_method
from polsep.physics.stokes import Measurements
from polsep.sensor.ambient import unit_remarks
from polsep.sensor.calibration import Calibration, Corrections
from polsep.sensor.camera import Layout, Mosaic
from polsep.sensor.checks import check_mosaic
from polsep.sensor.falloff import Table, falloff_image
from polsep.sensor.levels import (
    as_layout,
    as_measurements,
    as_mosaic,
    has_levels_of,
    interleave_planes,
    require_plane_angles,
)
from polsep.separation.colored_specular import Colored, color_specular
from polsep.separation.images import FrameImages
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

LightColor = Sequence[float]
#: Formats by the endings of file names.
_ENDINGS = {".exr": "exr", ".npz": "npz", ".tiff": "tiff", ".tif": "tiff", ".png": "png"}
#: Words for the light's colour: found in the frame (two words for one thing), or white.
FOUND_WORDS = ("auto", "estimate")
LIGHT_WORDS = (*FOUND_WORDS, "white")


def _calm_torch() -> None:
    """Hold torch to one thread in a forked child, where its other threads are missing and would be waited for."""
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_calm_torch)


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
) -> Result:
    """Separate one raw mosaic ``[H, W]`` (uint8, uint16, float32) into diffuse and specular.

    Images are ``[H/2, W/2, C]``, the mean over each 2x2 polarizer cell; ``full=True`` gives ``[H, W, C]``. ``layout``
    None is Sony's colour order; text is "color", "mono" or a `Layout.spec`. ``white_level`` None is the dtype's maximum
    (1.0 for float): 12-bit codes in uint16 need 4095; moved to the left, to 65520, they need nothing.
    ``calibration``: a file of `polsep calibrate`, applied first. ``ambient``: a raw frame with the lamp off, or
    several, subtracted. ``light_color``: "auto" finds it in the frame (`find_light`), or "white", or camera RGB of the
    light. ``raw`` may also be four angle images at 0, 45, 90, 135 degrees, ``[4, H, W]`` or ``[4, H, W, 3]``, which
    keep their resolution, or what `read_frames` read. What the user should know is in ``report["warnings"]`` and
    issued as `PolsepWarning`. Raises ValueError, with one line of what was expected and what was found, on other input;
    of wrong types it is also a TypeError.
    """
    require_flags(full=full)
    if not isinstance(calibration, Calibration | str | PathLike | None):
        raise WrongType(f"expected a calibration or its file, found {type(calibration).__name__}")
    measured = calibration if isinstance(calibration, Calibration | None) else read_calibration(Path(calibration))
    if white_level is None and measured is not None and isinstance(raw, np.ndarray):
        white_level = measured.white_level_of(raw)
    if measured is not None:
        measured.require_black_level(black_level, "black_level")
        if isinstance(raw, np.ndarray):
            black_level = measured.black_level_of(raw, black_level, white_level)
    capture, notes = _as_capture(raw, layout, black_level, white_level)
    if isinstance(capture, Mosaic):
        corrections = Corrections(measured)
        if ambient is not None:
            four = isinstance(raw, np.ndarray) and raw.ndim == 3 and raw.shape[0] == 4
            kind = None if white_level is not None else getattr(raw, "dtype", None)
            found = [_as_ambient(dark, capture, kind) for dark in _ambient_frames(ambient, four)]
            said = unit_remarks(note for _, more in found for note in more)
            corrections = replace(corrections.with_ambient(frame for frame, _ in found), ambient_remarks=said)
        capture, more = corrections.apply_noting(capture)
        notes += more
    elif measured is not None or ambient is not None:
        raise ValueError("expected a raw mosaic to calibrate or to subtract room light from, found four angle images")
    frame = separate_capture(capture, method, light_color, device, bool(full))
    frame.report["warnings"] = [*notes, *frame.report["warnings"]]
    for note in frame.report["warnings"]:
        warnings.warn(note, PolsepWarning, stacklevel=2)
    return frame


def _as_capture(
    raw: NDArray[Any] | Capture, layout: Layout | str | None, black_level: float, white_level: float | None
) -> tuple[Capture, tuple[str, ...]]:
    """A capture of anything that `separate` accepts, with notes for the user."""
    if isinstance(raw, Mosaic | Measurements):
        if layout is not None or black_level != 0 or white_level is not None:
            raise ValueError(f"expected layout and levels with an array, found them with a {type(raw).__name__}")
        finite = namespace(raw.data).isfinite(raw.data)
        if not finite.all():
            raise ValueError(f"expected finite samples, found {int((~finite).sum())} that are not")
        return raw, ()
    four = isinstance(raw, np.ndarray) and raw.ndim in (3, 4) and raw.shape[0] == 4
    if not four or (raw.ndim == 3 and raw.shape[2] in (1, 3)):
        return as_mosaic(raw, layout, black_level, white_level)
    layout = as_layout(layout)
    if raw.ndim == 3 and layout is not None and layout.bayer is not None:
        return as_mosaic(interleave_planes(raw, layout), layout, black_level, white_level)
    if layout is not None:
        require_plane_angles(layout)
    return as_measurements(raw, black_level, white_level)


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
    light, facts, remarks = resolve_light(light_color, capture)  # before it moves: a device sends no raw frame back
    seen, capture = capture, move_capture(capture, device)
    images, colored, filled = chosen.run(capture, light, full), Colored(), 0.0
    if isinstance(capture, Mosaic):
        if chosen.assumes_white:
            images, colored = color_specular(images, capture, light)
        images, filled = fill_under_highlights(images, capture, light)
    frame = make_frame(images, chosen, capture, light, full)
    frame.report["light"] = facts
    frame.report.update(colored_specular=colored.share, retained_polarization=colored.retained)
    frame.report.update(lamp_dolp=colored.lamp_dolp, filled_under_highlights=filled)
    frame.report["warnings"] = [*remarks, *([colored.remark] if colored.remark else []), *frame.report["warnings"]]
    if checked:
        frame.report.update(checked.report)
        frame.report["warnings"] = [*checked.warnings, *frame.report["warnings"]]
    return replace(frame, capture=seen)


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


def open_separated(path: Path, light_color: LightColor | str = "auto") -> tuple[SeparatedFrame, list[str]]:
    """A frame that was separated before, with the report beside its file, and notes for the user, a line each.

    ``light_color`` of the report is the one that is stated here, else the one beside the file; without either it is
    left out and a note says so. Raises InputError on what cannot be read.
    """
    from polsep.io.results.separation_reader import read_separated
    from polsep.io.results.sidecars import read_report

    frame = replace(read_separated(path), report=read_report(path))
    notes = list(frame.report.get("warnings", ()))
    if not is_to_be_found(light_color):
        frame.report["light_color"] = stated_gains(light_color, frame.diffuse.shape[-1])
        notes += color_notes(light_color, frame.diffuse.shape[-1])
    elif "light_color" not in frame.report and frame.diffuse.shape[-1] > 1:
        notes.append(f"the lamp's colour is neither stated nor in {path.stem}.json beside the file: taken for white")
    return frame, notes


def stated_gains(light_color: LightColor | str, channels: int) -> list[float]:
    """One gain per channel of a light whose colour is stated: three numbers or "white"; mono has one channel.

    Green is 1, as in lights that are found: of a colour only the ratios count, in whatever unit it was measured.
    """
    if isinstance(light_color, str) or channels == 1:
        return [1.0] * channels
    color = [float(gain) for gain in light_color]
    return [gain / color[1] for gain in color]


def color_notes(light_color: LightColor | str, channels: int) -> tuple[str, ...]:
    """A note where the colour that is stated of a light changes nothing: mono frames show none."""
    ignored = channels == 1 and not isinstance(light_color, str) and len(set(light_color)) > 1
    return ("the colour stated of the light changes nothing: mono frames show no colours",) * ignored


def parse_light_color(text: str) -> LightColor | str:
    """The light's colour as people write it: ``R,G,B``, ``white``, ``auto`` or ``estimate``. Raises ValueError."""
    if text in LIGHT_WORDS:
        return text
    color = _as_color(text.split(","))
    if color is None:
        raise ValueError(
            f'expected a light colour R,G,B like 1,0.9,0.7, all positive, "white" or "auto", found {text!r:.40}'
        )
    return color


def _as_color(parts: Iterable[Any]) -> tuple[float, ...] | None:
    """Three positive numbers of a light's colour; None of anything else. Raises TypeError on what are no parts."""
    try:
        color = tuple(float(part) for part in parts)
    except ValueError:
        return None
    return color if len(color) == 3 and all(1e-6 < c < 1e6 for c in color) else None


def light_of(capture: Capture) -> Light:
    """`find_light` in a frame whose black level and defects were put right, as `separate_capture` does first."""
    return find_light(check_mosaic(capture).mosaic if isinstance(capture, Mosaic) else capture)


def is_calibrated(capture: Capture) -> bool:
    """True if a calibration says the colour of the lamp, which mono frames have none of."""
    if not isinstance(capture, Mosaic) or capture.layout.channels == 1:
        return False
    return capture.lamp_measured or any(gain != 1 for gain in capture.light_color)


def is_to_be_found(light_color: LightColor | str) -> bool:
    """True if a light's colour, of any type, is one of `FOUND_WORDS`."""
    return isinstance(light_color, str) and light_color in FOUND_WORDS


def resolve_light(
    light_color: LightColor | str, capture: Capture
) -> tuple[tuple[float, ...], dict[str, Any], tuple[str, ...]]:
    """One gain per channel, green 1, the report's entry on the light, found in the frame or stated, and remarks on it.

    "auto" takes what a calibration says, else what the frame shows. Raises ValueError on anything but three positive
    numbers or one of `LIGHT_WORDS`.
    """
    channels = capture.layout.channels if isinstance(capture, Mosaic) else capture.data.shape[-3]
    if isinstance(light_color, str) and light_color not in LIGHT_WORDS:
        raise ValueError(f'expected a light colour of three numbers, "white" or "auto", found {light_color!r}')
    if is_to_be_found(light_color) and not is_calibrated(capture):
        found = find_light(capture)
        return found.color if channels == 3 else (1.0,), {"source": "found", **found.describe()}, found.remarks
    stated, source = light_color, "stated"
    if isinstance(light_color, str):
        stated = (1.0, 1.0, 1.0)
        if isinstance(capture, Mosaic) and light_color != "white":
            stated, source = capture.light_color, "calibrated"
    try:
        color = _as_color(stated)
    except TypeError:
        raise WrongType(f"expected a light colour of three positive numbers, found {light_color!r:.40}") from None
    if color is None:
        raise ValueError(f"expected a light colour of three positive numbers, found {light_color!r}")
    gains = stated_gains(color, channels)
    return tuple(gains), {"source": source, "color": gains}, color_notes(color, channels)
