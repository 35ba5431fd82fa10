"""Right and false warnings, on frames of known condition: `warned_frames`.

A warning is right on a frame that deserves it, and false on a clean frame. "beside" counts frames that deserve another
warning: there a second line may be true as well, but the owner would rather not read it. Rules are chosen on the split
validation, which the quick version measures; the full one measures the split test and real frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from polsep.bench.rows import Row
from polsep.compute.arrays import to_numpy
from polsep.pipeline import separate_capture
from polsep.sensor.levels import level_notes

if TYPE_CHECKING:
    from evaluation.warned_frames import Known

#: Words by which the line of each warning is known.
WORDS = {
    "light": ("one angle", "one polarized lamp"),
    "color": ("white highlights",),
    "layout": ("--layout", "layout "),
    "black level": ("--black-level", "black frame"),
    "encoding": ("gamma", "JPEG"),
    "defects": ("dead or hot",),
    "exposure": ("overexposed", "every sample is clipped"),
}
#: Several lamps are warned of by the line on light.
SAME = {"lamps": "light"}
#: Methods, stages of each look and the size of their frames.
METHODS, STAGES, SIZE = ("analytic", "joint"), 4, 512


def bench_warned(data: Path) -> Iterator[Row]:
    """Share of right and of false warnings: own renders of the split test, and real frames of ``data``."""
    from evaluation.warned_frames import own_frames, real_frames

    for method in METHODS:
        yield from score_warnings("own", own_frames("test", range(STAGES), SIZE), method)
        yield from score_warnings("real", real_frames(data), method)


def bench_warned_quick(data: Path) -> Iterator[Row]:
    """The same of own renders of the split validation, by the formula."""
    del data
    from evaluation.warned_frames import own_frames

    yield from score_warnings("own", own_frames("validation", range(STAGES), SIZE), METHODS[0])


def warned_kinds(frame: Known, method: str) -> set[str]:
    """The kinds of warnings in the report of a frame."""
    mosaic = frame.mosaic
    lines = [
        *level_notes(to_numpy(mosaic.data), mosaic.black_level, mosaic.white_level),
        *separate_capture(mosaic, method).report["warnings"],
    ]
    return {kind for kind, words in WORDS.items() for line in lines if any(word in line for word in words)}


def score_warnings(part: str, frames: Iterable[Known], method: str) -> Iterator[Row]:
    """Yield rows: by condition the share warned rightly, by warning the share of clean and of other frames with it."""
    right: dict[str, list[bool]] = {}
    clean: list[set[str]] = []
    other: list[tuple[str, set[str]]] = []
    for frame in frames:
        found = warned_kinds(frame, method)
        if frame.deserves is None:
            clean.append(found)
            right.setdefault(f"{frame.condition}, silent", []).append(not found)
        else:
            deserved = SAME.get(frame.deserves, frame.deserves)
            other.append((deserved, found))
            right.setdefault(f"{frame.condition}, {frame.deserves}", []).append(deserved in found)
        name = f"{frame.look}, {frame.condition}"
        yield Row("warned/scenes", name, method, "warned of: " + (", ".join(sorted(found)) or "nothing"), 1, "")
    for condition, verdicts in right.items():
        yield Row(f"warned/{part}", condition, method, "right", 100 * sum(verdicts) / len(verdicts), "%")
    for kind in WORDS:
        beside = [kind in found for deserved, found in other if deserved != kind]
        yield Row(f"warned/{part}_false", kind, method, f"false, of {len(clean)}", sum(kind in w for w in clean), "")
        yield Row(f"warned/{part}_false", kind, method, f"beside, of {len(beside)}", sum(beside), "")
