"""The lamp's colour in a frame: stated by the user, measured by a calibration, or found in the frame.

A colour is three positive numbers, camera RGB of the lamp, of which only the ratios count. It becomes gains, one per
channel of the frame, with green 1: (1.0,) of mono frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from polsep.compute.arguments import WrongType
from polsep.light.find import Light, find_light
from polsep.sensor.camera import Capture, Mosaic
from polsep.sensor.checks import check_mosaic

#: Camera RGB of the lamp.
LightColor = Sequence[float]
#: Words for a colour that is to be found in the frame, with the same meaning, and with them the word for white.
FOUND_WORDS = ("auto", "estimate")
LIGHT_WORDS = (*FOUND_WORDS, "white")


class LightGains(NamedTuple):
    """One gain per channel, green 1; ``facts``: the entry of reports on the light; ``remarks`` on it for the user."""

    gains: tuple[float, ...]
    facts: dict[str, Any]
    remarks: tuple[str, ...]


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


def find_light_after_checks(capture: Capture) -> Light:
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


def resolve_light(light_color: LightColor | str, capture: Capture) -> LightGains:
    """The gains of the light of a frame, stated, calibrated or found.

    "auto" takes what a calibration says, else what the frame shows. Raises ValueError on anything but three positive
    numbers or one of `LIGHT_WORDS`.
    """
    channels = capture.layout.channels if isinstance(capture, Mosaic) else capture.data.shape[-3]
    if isinstance(light_color, str) and light_color not in LIGHT_WORDS:
        raise ValueError(f'expected a light colour of three numbers, "white" or "auto", found {light_color!r}')
    if is_to_be_found(light_color) and not is_calibrated(capture):
        found = find_light(capture)
        gains = found.color if channels == 3 else (1.0,)
        return LightGains(gains, {"source": "found", **found.describe()}, found.remarks)
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
    said = stated_gains(color, channels)
    return LightGains(tuple(said), {"source": source, "color": said}, color_notes(color, channels))
