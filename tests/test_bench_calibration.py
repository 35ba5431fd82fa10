"""The calibration sweep sees what it says: lights at right angles, errors that scale, one exposure."""

from __future__ import annotations

import math

import pytest
import torch
from tolerances import assert_close
from torch import Tensor

pytest.importorskip("embreex")

from polsep.bench import calibration
from polsep.bench.calibration import ERRORS_DEG, Seen, see_with_errors, separate_seen
from polsep.metrics import psnr
from polsep.views import seeded_shape


@pytest.fixture(scope="module")
def sweep() -> dict[int, Seen]:
    patch = pytest.MonkeyPatch()
    patch.setattr(calibration, "SIZE", (96, 96))
    found = dict(see_with_errors(seeded_shape("test", 1, 0), torch.Generator().manual_seed(1)))
    patch.undo()
    return found


def total_angle(polarized: tuple[Tensor, Tensor]) -> float:
    return math.degrees(math.atan2(float(polarized[1].sum()), float(polarized[0].sum())) / 2)


def test_lights_are_crossed_without_error(sweep: dict[int, Seen]) -> None:
    """The specular light of crossed lights is polarized at right angles, summed over the picture nearly so."""
    one, other = (scene.specular for scene in sweep[0].scenes)
    apart = abs(total_angle((one.s1, one.s2)) - total_angle((other.s1, other.s2))) % 180
    assert abs(apart - 90) < 15


def test_errors_do_not_touch_the_exposure_or_the_mask(sweep: dict[int, Seen]) -> None:
    """Turning the light's polarizer leaves the diffuse light nearly as it is, and the object where it is."""
    assert tuple(sweep) == ERRORS_DEG
    for seen in sweep.values():
        assert torch.equal(seen.scenes[0].mask, sweep[0].scenes[0].mask)
        ratio = float(seen.scenes[0].diffuse.s0.sum() / sweep[0].scenes[0].diffuse.s0.sum())
        assert abs(ratio - 1) < 0.05
    clipped = sweep[0].captures[0].clipped
    assert clipped is not None
    assert bool(clipped.any())


def test_methods_are_scored_against_what_they_saw(sweep: dict[int, Seen]) -> None:
    seen = sweep[20]
    found = separate_seen(seen)
    (one, other), mask = seen.scenes, seen.scenes[0].mask
    assert_close(found["Ding 2021, two lights"][1][1], (one.specular.s0 + other.specular.s0) / 2)
    assert_close(found["analytic"][1][0], one.diffuse.s0)
    scores = {name: psnr(split.diffuse, truth[0], mask) for name, (split, truth) in found.items()}
    assert scores["Ding 2021, two lights"] > scores["Debevec 2000, two photographs"] + 5
