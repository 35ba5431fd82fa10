"""Chains that `polsep.bench.speed` times of polsep: from a raw frame of 12 bits to diffuse and specular images.

* "METHOD, one frame": `polsep.separate`, frame after frame, all cores for each;
* "METHOD, many frames": the same, as many frames at once as there are cores and each on one of them, as `polsep video`;
* "FORMULA, stream": the functions of `polsep.kernels` into the same images again and again, without report.

A name begins with the resolution, "half: " or "full: ". `stopwatch` runs this file, so it imports what frames need.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import Any

import polsep
from polsep.compute.threads import get_threads, own_threads
from polsep.compute.workers import map_ahead
from polsep.io.store.rows import read_array

WHITE_LEVEL = 4095
#: Streams by name: "guided" demosaicking or bilinear, and frames at half the light, in which nothing clips.
STREAMS = (
    "analytic",
    "color-affine bilinear",
    "color-affine guided",
    "color-affine bilinear, nothing clipped",
    "color-affine guided, nothing clipped",
)


def chain_names(resolution: str) -> list[str]:
    """Every chain of polsep at "half" or "full" resolution."""
    ways = [f"{method}, {way}" for way in ("one frame", "many frames") for method in polsep.METHODS]
    return [f"{resolution}: {name}" for name in (*ways, *(f"{stream}, stream" for stream in STREAMS))]


def frames(chain: str, path: str) -> tuple[Iterator[Any], int]:
    """The frames of a chain, for ever, of the raw file at ``path``, and how many it works on at once."""
    warnings.simplefilter("ignore")
    raw, (resolution, _, name) = read_array(Path(path)), chain.partition(": ")
    title, _, way = name.rpartition(", ")
    full = resolution == "full"
    if way == "stream":
        return _stream(raw // 2 if "nothing clipped" in title else raw, title, full), 1
    separate = partial(polsep.separate, method=title, white_level=WHITE_LEVEL, full=full)
    if way == "one frame":
        return map(separate, repeat(raw)), 1
    cores = get_threads()

    def separate_alone(frame: Any) -> Any:
        with own_threads(1):
            return separate(frame)

    return map_ahead(separate_alone, repeat(raw), cores), cores


def _stream(raw: Any, title: str, full: bool) -> Iterator[Any]:
    """A formula of `polsep.kernels`, which only streams import, into the same images again and again."""
    from polsep import kernels

    layout = polsep.Layout()
    out = kernels.AnalyticImages.empty(raw.shape, layout, full=full)
    if title == "analytic":
        separate: Any = kernels.separate_analytic_full if full else kernels.separate_analytic_half
        options: Any = kernels.AnalyticOptions(out=out)
    else:
        separate = kernels.separate_color_affine_full if full else kernels.separate_color_affine_half
        options = kernels.ColorAffineOptions(out=out, guided="guided" in title)
    return (separate(raw, layout, 0.0, WHITE_LEVEL, options) for _ in repeat(None))
