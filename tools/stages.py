"""``python -m tools.stages [--full] [--frames N] [METHOD...]``: where the time of one `polsep.separate` call goes.

The demo capture, 2448x2048, 12 bits in uint16. Of every stage the least milliseconds of some frames, those of stages
inside of it included. Another tree of the sources is measured by ``PYTHONPATH=TREE python tools/stages.py``.
"""

from __future__ import annotations

import argparse
import importlib
import time
import warnings
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import polsep
from polsep import methods
from polsep.bench.truth import read_demo_codes

#: Functions that are timed, by the module whose name they are called by: a deeper stage is part of the one above it.
STAGES = {
    "pipeline": (
        "as_mosaic",
        "check_mosaic",
        "resolve_light",
        "color_specular",
        "fill_under_highlights",
        "make_frame",
    ),
    "sensor.checks": ("phase_means", "check_black_level", "encoding_warning", "check_layout", "remove_defects"),
    "sensor.defects": ("make_rules",),
    "sensor.defects_kernel": ("find_candidates", "confirm"),
    "light.find": ("find_tiles", "_light_of_tiles"),
    "separation.colored_specular": ("_measure_places", "find_unpolarized", "_measure_periods", "find_retained"),
    "separation.under_highlights": ("_clipped_cells", "_find_holes", "_fit_planes", "_contrast", "_solve_laplace"),
}
WHITE_LEVEL = 4095

Spent = defaultdict[str, float]


def timed(function: Callable[..., Any], name: str, spent: Spent) -> Callable[..., Any]:
    """The function, adding its seconds to ``spent``."""

    def run(*args: Any, **kwargs: Any) -> Any:
        start = time.perf_counter()
        try:
            return function(*args, **kwargs)
        finally:
            spent[name] += time.perf_counter() - start

    return run


def main() -> None:
    """Time the methods of the command line and print a table of each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("method", nargs="*", default=["analytic", "color-affine", "joint-fast", "joint"])
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    spent: Spent = defaultdict(float)
    for module, names in STAGES.items():
        place = importlib.import_module(f"polsep.{module}")
        for name in names:
            setattr(place, name, timed(getattr(place, name), f"{module}.{name}", spent))
    raw = read_demo_codes()
    for title in asked.method:
        method = methods.METHODS[title]
        methods.METHODS[title] = replace(method, run=timed(method.run, "the method itself", spent))
        rows = []
        for _ in range(2 + asked.frames):
            spent.clear()
            timed(polsep.separate, "all", spent)(raw, title, white_level=WHITE_LEVEL, full=asked.full)
            rows.append(dict(spent))
        print(f"{title}, {'full' if asked.full else 'half'} resolution, ms")
        for name in rows[-1]:
            print(f"  {name:48} {1000 * min(row.get(name, 0.0) for row in rows[2:]):7.2f}")


if __name__ == "__main__":
    main()
