"""Charts of a frame as SVG text for pages: the histogram of its samples, and the rose of its angles."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from polsep.sensor.exposure import Histogram

#: Colours and words of channels.
CHANNELS = {"R": ("#ff6b6b", "red"), "G": ("#63d471", "green"), "B": ("#6ea8fe", "blue"), "Y": ("#d0d0d4", "all")}
_WIDTH, _HEIGHT, _FLOOR = 640, 220, 1e-6
#: Sectors of a rose over 180 degrees.
SECTORS = 36


def histogram_svg(found: Histogram) -> str:
    """Lines of all colours from black to white level; shares on a logarithmic scale."""
    shown = np.log10(np.maximum(found.shares, _FLOOR) / _FLOOR)
    top = max(float(shown.max()), 1.0)
    lines = []
    for name, row in zip(found.names, shown, strict=True):
        x = (np.arange(row.size) + 0.5) * _WIDTH / row.size
        points = " ".join(f"{a:.1f},{_HEIGHT - b / top * (_HEIGHT - 12):.1f}" for a, b in zip(x, row, strict=True))
        color = CHANNELS[name][0]
        lines.append(
            f'<polyline points="0,{_HEIGHT} {points} {_WIDTH},{_HEIGHT}" fill="{color}" fill-opacity=".13" '
            f'stroke="{color}" stroke-width="1.5" vector-effect="non-scaling-stroke"/>'
        )
    return (
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" preserveAspectRatio="none" role="img" '
        f'aria-label="histogram of raw samples">{"".join(lines)}</svg>'
    )


def rose_shares(aolp: NDArray[np.float32], power: NDArray[np.float32]) -> NDArray[np.float64]:
    """Shares of polarized light ``power`` by angle: `SECTORS` from 0 to 180 degrees, the first one around 0."""
    sectors = np.rint(aolp * (SECTORS / np.pi)).astype(np.int64) % SECTORS
    sums = np.bincount(sectors.ravel(), power.ravel().astype(np.float64), SECTORS)
    return sums / max(float(sums.sum()), 1e-12)


def rose_svg(shares: NDArray[np.float64], axes: dict[str, float]) -> str:
    """A rose of `rose_shares`, on both sides since angles turn by 180 degrees; radius: the root of a sector's share.

    ``axes``: angles in degrees that are drawn as lines, by class of the line. 0 is right, 90 is up.
    """
    largest = math.sqrt(max(float(shares.max()), 1e-12))
    half = 180 / SECTORS / 2
    sectors = []
    for k, share in enumerate(shares):
        radius = 88 * math.sqrt(share) / largest
        for turn in (0, 180):
            (x1, y1), (x2, y2) = (_point(k * 2 * half + turn + side, radius) for side in (-half, half))
            sectors.append(f"M0 0L{x1:.1f} {y1:.1f}A{radius:.1f} {radius:.1f} 0 0 0 {x2:.1f} {y2:.1f}Z")
    lines = []
    for name, angle in axes.items():
        x, y = _point(angle, 96)
        lines.append(f'<line class="{name}" x1="{-x:.1f}" y1="{-y:.1f}" x2="{x:.1f}" y2="{y:.1f}"/>')
    ticks = "".join(
        f'<text x="{_point(angle, 112)[0]:.0f}" y="{_point(angle, 112)[1] + 4:.0f}">{angle}°</text>'
        for angle in (0, 45, 90, 135)
    )
    return (
        '<svg viewBox="-130 -125 260 250" role="img" aria-label="angles of the polarized light">'
        '<circle r="96" class="rim"/><circle r="48" class="rim"/>'
        f'<path d="{"".join(sectors)}"/>{"".join(lines)}{ticks}</svg>'
    )


def _point(angle_deg: float, radius: float) -> tuple[float, float]:
    """x to the right and y down of a place, as SVG counts."""
    return radius * math.cos(math.radians(angle_deg)), -radius * math.sin(math.radians(angle_deg))
