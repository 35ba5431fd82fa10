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
from collections.abc import Mapping, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from array_api_compat import is_array_api_obj
from numpy.typing import NDArray

from polsep.compute.arrays import to_device
from polsep.io.store.calibrations import read_calibration
from polsep.light.find import find_light
from polsep.methods import Capture, Method, find_method
from polsep.sensor.calibration import Calibration, Corrections, falloff_image, mean_mosaic, subtract_ambient
from polsep.sensor.camera import Layout, Mosaic
from polsep.sensor.checks import check_mosaic
from polsep.sensor.levels import as_mosaic
from polsep.separation.colored_specular import Colored, color_specular
from polsep.separation.images import FrameImages
from polsep.separation.report import SeparatedFrame, describe, on_host

LightColor = Sequence[float]
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
    """Something about a frame that its owner should know: the layout, the bit depth, the exposure, the light."""


def separate(
    raw: NDArray[Any],
    method: str = "auto",
    layout: Layout | str | None = None,
    black_level: float = 0,
    white_level: float | None = None,
    light_color: LightColor | str = "auto",
    device: str = "auto",
    full: bool = False,
    calibration: Calibration | str | PathLike[str] | None = None,
    ambient: NDArray[Any] | Sequence[NDArray[Any]] | None = None,
) -> SeparatedFrame:
    """Separate one raw mosaic ``[H, W]`` (uint8, uint16, float32) into diffuse and specular.

    Images are ``[H/2, W/2, C]``, the mean over each 2x2 polarizer cell; ``full=True`` gives ``[H, W, C]``. ``layout``
    None is Sony's colour order; text is "color", "mono" or a `Layout.spec`. ``white_level`` None is the dtype's maximum
    (1.0 for float): 12-bit data in uint16 need 4095 or 65520 said. ``calibration``: a file of `polsep calibrate`,
    applied first. ``ambient``: a raw frame with the lamp off, or several, subtracted. ``light_color``: "auto" finds it
    in the frame (`find_light`), or "white", or camera RGB of the light. What the owner should know is in
    ``report["warnings"]`` and issued as `PolsepWarning`. Raises ValueError, with one line of what was expected and what
    was found, on input that is not a mosaic.
    """
    measured = calibration if isinstance(calibration, Calibration | None) else read_calibration(Path(calibration))
    if white_level is None and measured is not None:
        white_level = measured.white_level_of(raw)
    mosaic, notes = as_mosaic(raw, layout, black_level, white_level)
    corrections = Corrections(measured)
    mosaic = corrections.apply(mosaic)
    if ambient is not None:
        rooms = [ambient] if isinstance(ambient, np.ndarray) and ambient.ndim == 2 else list(ambient)
        lamp_off = [corrections.apply(as_mosaic(room, layout, black_level, white_level)[0]) for room in rooms]
        mosaic = subtract_ambient(mosaic, mean_mosaic(lamp_off))
    frame = separate_capture(mosaic, method, light_color, device, full)
    frame.report["warnings"] = [*notes, *frame.report["warnings"]]
    for note in frame.report["warnings"]:
        warnings.warn(note, PolsepWarning, stacklevel=2)
    return frame


def separate_capture(
    capture: Capture,
    method: str = "auto",
    light_color: LightColor | str = "auto",
    device: str = "auto",
    full: bool = False,
) -> SeparatedFrame:
    """`separate` for a frame that is already a `Mosaic`, or co-sited `Measurements` (which keep their resolution)."""
    chosen = find_method(method, capture)
    checked = check_mosaic(capture) if isinstance(capture, Mosaic) else None
    capture, device = checked.mosaic if checked else capture, find_device(device)
    light, facts, remarks = resolve_light(light_color, capture)  # before it moves: a device sends no raw frame back
    capture = move_capture(capture, device)
    images, colored = chosen.run(capture, light, full), Colored()
    if chosen.assumes_white and isinstance(capture, Mosaic):
        images, colored = color_specular(images, capture, light)
    frame = make_frame(images, chosen, capture, light, full)
    frame.report["light"] = facts
    frame.report.update(colored_specular=colored.share, retained_polarization=colored.retained)
    frame.report["lamp_dolp"] = colored.lamp_dolp
    frame.report["warnings"] = [*remarks, *frame.report["warnings"]]
    if checked:
        frame.report.update(checked.report)
        frame.report["warnings"] = [*checked.warnings, *frame.report["warnings"]]
    return frame


def make_frame(
    images: FrameImages, method: Method, capture: Capture, light: tuple[float, ...], full: bool = False
) -> SeparatedFrame:
    """Images that a method made of a capture, in the computer's own memory, with their report."""
    images = on_host(images)
    assert images.dolp is not None and images.aolp is not None and images.tally is not None
    report = describe(images.tally, method.expects_errors)
    layout = capture.layout.spec if isinstance(capture, Mosaic) else "four co-sited angle images"
    report |= {"method": method.name, "light_color": list(light), "full_resolution": full, "layout": layout}
    if not _is_finite(report):
        raise ValueError(f"expected finite images of {method.name}, found others: is the white level far too low?")
    diffuse, specular, error = images.diffuse, images.specular, images.error
    if isinstance(capture, Mosaic) and capture.falloff is not None:
        fall = falloff_image(capture.falloff, *diffuse.shape[:2])[..., None]
        diffuse, specular, error = diffuse / fall, specular / fall, None if error is None else error / fall
    return SeparatedFrame(diffuse, specular, images.valid, images.dolp, images.aolp, report, error)


def _is_finite(facts: Any) -> bool:
    """True unless a number in a report, which sums up the images, is NaN or infinite."""
    if isinstance(facts, Mapping):
        facts = facts.values()
    elif not isinstance(facts, list | tuple):
        return not isinstance(facts, float) or math.isfinite(facts)
    return all(map(_is_finite, facts))


def find_device(name: str) -> str:
    """Name of a device: ``auto`` is CUDA where torch and a GPU are, else the CPU, which needs no torch.

    Raises ValueError on a device that is not there.
    """
    if not isinstance(name, str):
        raise ValueError(f"expected a device like auto, cpu or cuda, found {name!r}")
    if name == "cpu" or (name == "auto" and not _may_have_gpu()):
        return "cpu"
    try:
        import torch

        if name == "auto":
            return "cuda" if torch.cuda.is_available() else "cpu"
        torch.zeros(1, device=name).cpu()
    except (ImportError, RuntimeError, TypeError, AssertionError, NotImplementedError) as error:
        if name == "auto":
            return "cpu"
        reason = "install polsep[torch]" if isinstance(error, ImportError) else str(error).splitlines()[0][:120]
        raise ValueError(f"expected a device like auto, cpu or cuda, found {name!r}: {reason}") from None
    return name


def _may_have_gpu() -> bool:
    """True if torch is loaded anyway, or may find a GPU: asking it takes a second and 200 MB of memory."""
    return "torch" in sys.modules or Path("/dev/nvidiactl").exists() or sys.platform == "win32"


def move_capture(capture: Capture, device: str) -> Capture:
    """The capture with its arrays on a device: on the CPU as they are, on others as torch tensors."""
    moved = {name: to_device(value, device) for name, value in vars(capture).items() if is_array_api_obj(value)}
    return replace(capture, **moved)


def parse_light_color(text: str) -> LightColor | str:
    """The light's colour as people write it: ``R,G,B``, ``white``, ``auto`` or ``estimate``. Raises ValueError."""
    if text in LIGHT_WORDS:
        return text
    try:
        r, g, b = (float(part) for part in text.split(","))
    except ValueError:
        expected = 'expected a light colour R,G,B like 1,0.9,0.7, "white" or "auto"'
        raise ValueError(f"{expected}, found {text!r:.40}") from None
    return (r, g, b)


def is_calibrated(capture: Capture) -> bool:
    """True if a calibration says the colour of the lamp."""
    return isinstance(capture, Mosaic) and any(gain != 1 for gain in capture.light_color)


def resolve_light(
    light_color: LightColor | str, capture: Capture
) -> tuple[tuple[float, ...], dict[str, Any], tuple[str, ...]]:
    """One gain per channel, what the report says of the light, found in the frame or told, and remarks on it.

    "auto" takes what a calibration says, else what the frame shows. Raises ValueError on anything but three positive
    numbers or one of `LIGHT_WORDS`.
    """
    channels = capture.layout.channels if isinstance(capture, Mosaic) else capture.data.shape[-3]
    if isinstance(light_color, str) and light_color not in LIGHT_WORDS:
        raise ValueError(f'expected a light colour of three numbers, "white" or "auto", found {light_color!r}')
    if light_color in FOUND_WORDS and not is_calibrated(capture):
        found = find_light(capture)
        return found.color if channels == 3 else (1.0,), {"source": "found", **found.describe()}, found.remarks
    told = light_color
    if isinstance(told, str):
        told = capture.light_color if isinstance(capture, Mosaic) and told != "white" else (1.0, 1.0, 1.0)
    try:
        color = tuple(float(c) for c in told)
    except (TypeError, ValueError):
        color = ()
    if len(color) != 3 or not all(1e-6 < c < 1e6 for c in color):
        raise ValueError(f"expected a light colour of three positive numbers, found {light_color!r}")
    color = color if channels == 3 else (1.0,)
    source = "calibrated" if isinstance(light_color, str) and light_color != "white" else "told"
    return color, {"source": source, "color": list(color)}, ()
