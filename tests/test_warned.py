"""Frames of known condition, and the warnings that are counted on them."""

from __future__ import annotations

import pytest
import torch

from evaluation.warned import SAME, WORDS, score_warnings
from evaluation.warned_frames import CONDITIONS, KINDS, Known, own_frames
from polsep.sensor.camera import Layout, Mosaic


def test_every_condition_deserves_a_warning_that_there_is() -> None:
    """Conditions, kinds and words name the same warnings."""
    assert {kind for kind, _ in CONDITIONS.values()} - {None} <= set(KINDS)
    assert {SAME.get(kind, kind) for kind in KINDS} <= set(WORDS)


def test_frames_are_the_same_again() -> None:
    """Seeds decide all: of the scene, its exposure and its noise."""
    names = ("white lamp", "two lamps, 90 degrees")
    first, again = (list(own_frames("validation", range(1), 64, names))[:2] for _ in range(2))
    for one, other in zip(first, again, strict=True):
        torch.testing.assert_close(one.mosaic.data, other.mosaic.data, rtol=0, atol=0)


@pytest.mark.parametrize(("deserves", "right", "false"), [(None, 0.0, 1), ("exposure", 100.0, 0)])
def test_a_warning_is_right_or_false(deserves: str | None, right: float, false: int) -> None:
    """The same overexposed frame, called clean or not."""
    data = torch.rand(64, 64, generator=torch.Generator().manual_seed(1)).mul(1.2).clamp(max=1)
    frame = Known("noise", "bright", deserves, Mosaic(data, Layout(), 0.0, 1.0))
    rows = {(row.case, row.metric): row.value for row in score_warnings("own", [frame], "analytic")}
    assert next(value for (_, metric), value in rows.items() if metric == "right") == right
    assert rows["exposure", f"false, of {1 if deserves is None else 0}"] == false
