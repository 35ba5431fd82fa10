"""Reports of a recording that was separated: of all frames as one, and of the run, with each warning once."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from polsep.physics.stokes import aolp_of

if TYPE_CHECKING:
    from polsep.video.first_frame import FirstFrame


def shared_report(first: FirstFrame, lines: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Number and statistics of all good frames as one, and each warning once; None where all are damaged."""
    good = [line for line in lines if "damaged" not in line]
    if not good:
        return None
    names = [name for name in good[0] if name not in ("frame", "file", "warnings")]
    statistics = {name: float(np.mean([line[name] for line in good if name in line])) for name in names}
    for name in ("specular_aolp_deg", "light_polarizer_deg"):
        turned = complex((np.exp(2j * np.radians([line[name] for line in good])) * _weights(good)).sum())
        statistics[name] = math.degrees(aolp_of(turned.real, turned.imag))
    warnings = _each_once([*first.warnings, *(text for line in good for text in line.get("warnings", ()))])
    light = {"light_color": list(first.light), "light": first.facts}
    return {"frames": len(good), "method": first.method, "statistics": statistics, **light, "warnings": warnings}


def _weights(lines: list[dict[str, Any]]) -> NDArray[np.float64]:
    """Specular light of each frame that has the frame's angle: a black frame's angle of 0 says nothing."""
    names = ("mean_s0", "specular_fraction", "specular_aolp_concentration")
    weights = np.array([math.prod(line.get(name, 1.0) for name in names) for line in lines], np.float64)
    return weights if weights.any() else np.ones(len(lines))


def _each_once(warnings: Sequence[str]) -> list[str]:
    """The first of all warnings that differ in numbers alone."""
    found = dict[str, str]()
    for text in warnings:
        found.setdefault(_without_numbers(text), text)
    return list(found.values())


def _without_numbers(text: str) -> str:
    return re.sub(r"\d[\d.]*", "", text)


def describe_run(settings: dict[str, Any], first: FirstFrame, lines: list[dict[str, Any]]) -> dict[str, Any]:
    """The report of a run: settings, number of frames, the damaged ones, and how often frames gave each warning."""
    texts = [text for line in lines for text in line.get("warnings", ())]
    counts = Counter(map(_without_numbers, texts))
    warnings = {text: counts[_without_numbers(text)] for text in _each_once(texts)}
    damaged = [line for line in lines if "damaged" in line]
    return {
        "frames": len(lines),
        "damaged": damaged,
        "settings": settings,
        "first_frame_warnings": list(first.warnings),
        "warnings": warnings,
    }
