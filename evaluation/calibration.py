"""PSNR of every method when the light's polarizer is not at its nominal angle (Fig. 5 of Dave et al. 2022).

Random objects of the test split, the paper's protocol: co-sited samples, clipped at 1, no noise. A calibrated rig has
its light's polarizer at a nominal angle, and at right angles to it in the second capture of Ding 2021; each time it is
off by another normal deviate, evenly spread over the views. Debevec 2000 sees two photographs under one light, behind
analysers that are parallel and crossed to the highlights of the nominal light. Snapshot methods see the first capture
alone, through a sensor that never turns. Every method is scored against the truth of what it saw, Ding 2021 against the
mean of both captures.

A polarizer that is off is another light: another truth, other samples that clip. So a snapshot method scores otherwise
on a single capture, though it has no calibration that could be wrong. Here every view is seen at `NOMINAL_DEG`, half a
turn in equal steps, and the same deviate is added to all of them. Errors then shift a full set of lights, over which
the mean tells what the error itself does; what single lights do is measured beside it, without errors.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from evaluation.ladder import CO_SITED, ladder_entries, rung_of
from evaluation.scoring import Entry
from polsep.bench.rows import Row
from polsep.metrics import psnr
from polsep.physics.stokes import Measurements, Stokes, measure
from polsep.render.simulate import expose_to_clip
from polsep.render.sphere_tracing import Scene
from polsep.sensor.camera import IDEAL, Layout
from polsep.separation.analytic import Separation
from polsep.separation.multi_capture import separate_debevec2000, separate_ding2021

if TYPE_CHECKING:
    from polsep.render.raycast import MeshScene

#: Standard deviations of the polarizer's error [degrees].
ERRORS_DEG = (0, 5, 10, 15, 20)
#: Angles of the light's polarizer without error [degrees]. Scores repeat after 180, and nearly so after the 45 between
#: analysers, as other samples clip; steps of half of these leave up to 0.2 dB of that in the mean, these 0.04.
NOMINAL_DEG = tuple(11.25 * k for k in range(16))
#: Size of the views, the user's seed of their shapes, and the share of object samples that clips.
SIZE, SEED, CLIPPED = (320, 320), 77, 0.01
#: Where the quasirandom sequence of the deviates starts, and its steps: powers of the inverse plastic number.
STARTS, STEPS = (0.5, 0.5), (0.7548776662466927, 0.5698402909980532)
#: The methods that need more than one capture.
DEBEVEC, DING = "Debevec 2000, two photographs", "Ding 2021, two lights"

#: True diffuse and specular s0.
Truth = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Sweep:
    """Extent of a sweep: so many ``views``, each at all of `NOMINAL_DEG`, and errors of ``errors_deg``.

    Raises ValueError where 0 is not among the errors.
    """

    views: int = 16
    errors_deg: tuple[int, ...] = ERRORS_DEG

    def __post_init__(self) -> None:
        if 0 not in self.errors_deg:
            raise ValueError(f"expected errors that begin at 0 degrees, found {self.errors_deg}")


@dataclass(frozen=True)
class TurnableScene:
    """A scene under one light behind any polarizer: its lobes are ``mean`` + cos 2 nu ``cosine`` + sin 2 nu ``sine``.

    Exact, because light is linear and the Stokes vector behind a polarizer at nu is (1, cos 2 nu, sin 2 nu).
    """

    mean: Scene
    cosine: Scene
    sine: Scene

    def under(self, polarizer: float) -> Scene:
        """The scene under the light behind a polarizer at that angle [rad]."""
        c, s = math.cos(2 * polarizer), math.sin(2 * polarizer)
        return _mixed(((self.mean, 1.0), (self.cosine, c), (self.sine, s)))


@dataclass(frozen=True)
class Captures:
    """A view as every method captures it: the scenes under both lights, and their photographs and captures.

    ``photographs``: ``[3, H, W]`` of the first scene, parallel and crossed to the nominal highlights. ``captures``: one
    per scene.
    """

    scenes: tuple[Scene, Scene]
    photographs: tuple[Tensor, Tensor]
    captures: tuple[Measurements, Measurements]


def bench_calibration() -> Iterator[Row]:
    """PSNR of every method over the error of the light's polarizer. Needs the extra render."""
    yield from measure_sweep("calibration", Sweep(), snapshot_entries(ladder_entries(CO_SITED, ("paper",))))


def snapshot_entries(entries: Sequence[Entry]) -> tuple[Entry, ...]:
    """Swept entries among those for co-sited samples: formulas, and the networks of the paper's method."""
    return tuple(entry for entry in entries if entry.network is None or rung_of(entry.name) == "paper")


def measure_sweep(bench: str, sweep: Sweep, entries: Sequence[Entry]) -> Iterator[Row]:
    """Rows of ``bench`` over the error, and of ``bench``_light over the light's angle without error.

    Raises ValueError without the extra render.
    """
    try:
        from polsep.render.views import scene_seed, seeded_shape
    except ImportError as error:
        raise ValueError(f"expected the extra render, found no {error.name}") from None
    # Scores by error, method, output and angle, one per view
    scores: dict[tuple[int, str, str], dict[float, list[float]]] = {}
    for index in range(sweep.views):
        generator = torch.Generator().manual_seed(scene_seed("test", SEED, index, 0))
        scene = make_turnable(seeded_shape("test", SEED, index), SIZE, generator)
        deviates = normal_deviates(index)
        for degrees in sweep.errors_deg:
            for nominal in NOMINAL_DEG:
                captured = capture_with_errors(
                    scene, math.radians(nominal), [math.radians(degrees) * d for d in deviates]
                )
                for method, output, value in score_captures(captured, entries):
                    by_angle = scores.setdefault((degrees, method, f"{output} PSNR"), {})
                    by_angle.setdefault(nominal, []).append(value)
    yield from _error_rows(bench, scores)
    yield from _light_rows(f"{bench}_light", scores)


Scores = dict[tuple[int, str, str], dict[float, list[float]]]


def _error_rows(bench: str, scores: Scores) -> Iterator[Row]:
    """Means over views and angles by error, and the most that they differ from those without error."""
    means = {key: statistics.fmean(v for values in angles.values() for v in values) for key, angles in scores.items()}
    for (degrees, method, metric), mean in means.items():
        yield Row(bench, f"light polarizer off by {degrees} degrees rms", method, metric, mean, "dB")
    for method, metric in dict.fromkeys((method, metric) for _, method, metric in means):
        changes = [value - means[0, method, metric] for (_, *key), value in means.items() if key == [method, metric]]
        most = max(changes, key=abs)
        yield Row(bench, "largest change by an error", method, metric, most, "dB")


def _light_rows(bench: str, scores: Scores) -> Iterator[Row]:
    """Means over views by the light's angle without error, and the mean range of a single view."""
    for (degrees, method, metric), angles in scores.items():
        if degrees == 0:
            for nominal, values in angles.items():
                yield Row(
                    bench, f"light polarizer at {nominal:g} degrees", method, metric, statistics.fmean(values), "dB"
                )
            ranges = [max(view) - min(view) for view in zip(*angles.values(), strict=True)]
            yield Row(bench, "range of one view, mean", method, metric, statistics.fmean(ranges), "dB")


def normal_deviates(index: int) -> list[float]:
    """The two normal deviates of a view: number ``index`` of a sequence that is spread evenly wherever it ends.

    Source: Roberts 2018, the quasirandom sequence R2, through the inverse of the normal distribution.
    """
    shares = ((start + (index + 1) * step) % 1 for start, step in zip(STARTS, STEPS, strict=True))
    return [statistics.NormalDist().inv_cdf(share) for share in shares]


def make_turnable(shape: MeshScene, size: tuple[int, int], generator: torch.Generator) -> TurnableScene:
    """A random view of a shape, exposed so that `CLIPPED` of the object's samples clips under the light at 0."""
    from polsep.render.materials import random_materials
    from polsep.render.raycast import find_lit, find_view, shade_view
    from polsep.render.views import random_shot

    shot = random_shot(shape, generator)
    view = find_view(shape, shot.camera, size, 2)
    materials = random_materials(shape.mesh.slot_count, generator, shape.size)
    lit = find_lit(shape, view, shot.light)
    angles = [k * math.pi / 3 for k in range(3)]
    thirds = [shade_view(view, materials, replace(shot.light, polarizer=angle), lit) for angle in angles]
    # The discrete Fourier transform of the three gives mean, cosine and sine.
    weights = ([1 / 3] * 3, [2 / 3 * math.cos(2 * a) for a in angles], [2 / 3 * math.sin(2 * a) for a in angles])
    scene = TurnableScene(*(_mixed(list(zip(thirds, w, strict=True))) for w in weights))
    nominal = scene.under(0.0)
    gain = float(expose_to_clip(nominal, CLIPPED, Layout(), IDEAL).diffuse.s0.sum() / nominal.diffuse.s0.sum())
    return TurnableScene(*(_mixed([(term, gain)]) for term in (scene.mean, scene.cosine, scene.sine)))


def _mixed(terms: Sequence[tuple[Scene, float]]) -> Scene:
    """The weighted sum of the lobes of scenes that share a mask."""
    (first, weight), *others = terms
    diffuse, specular = first.diffuse * weight, first.specular * weight
    for scene, weight in others:
        diffuse, specular = diffuse + scene.diffuse * weight, specular + scene.specular * weight
    return Scene(diffuse, specular, first.mask)


def capture_with_errors(scene: TurnableScene, nominal: float, errors: Sequence[float]) -> Captures:
    """A view whose light should be at ``nominal`` and at right angles to it, but is off by two ``errors`` [rad]."""
    first, second = (scene.under(nominal + k * math.pi / 2 + error) for k, error in enumerate(errors))
    parallel = find_aolp(scene.under(nominal).specular)
    both = measure(first.diffuse + first.specular, (parallel, parallel + math.pi / 2)).data.clamp(max=1)
    return Captures((first, second), (both[0], both[1]), (_capture(first), _capture(second)))


def find_aolp(light: Stokes) -> float:
    """AoLP [rad] of all light together, by which an analyser is set that makes highlights vanish or shine."""
    return math.atan2(float(light.s2.double().sum()), float(light.s1.double().sum())) / 2 % math.pi


def _capture(scene: Scene) -> Measurements:
    exact = measure(scene.diffuse + scene.specular, Layout().angles)
    return Measurements(exact.data.clamp(max=1), exact.angles, exact.data >= 1)


def separate_captures(captured: Captures, entries: Sequence[Entry]) -> Iterator[tuple[str, Separation, Truth]]:
    """Name of every method, its separation of its captures, and the truth that it is scored against."""
    (one, other), (first, second) = captured.scenes, captured.captures
    truth = (one.diffuse.s0, one.specular.s0)
    mean = ((truth[0] + other.diffuse.s0) / 2, (truth[1] + other.specular.s0) / 2)
    yield DEBEVEC, separate_debevec2000(*captured.photographs), truth
    yield DING, separate_ding2021(first, second), mean
    for entry in entries:
        yield entry.name, entry.separate(first), truth


def score_captures(captured: Captures, entries: Sequence[Entry]) -> Iterator[tuple[str, str, float]]:
    """Method, output and PSNR [dB] inside the mask."""
    mask = captured.scenes[0].mask
    for method, found, (diffuse, specular) in separate_captures(captured, entries):
        yield method, "diffuse", psnr(found.diffuse, diffuse, mask)
        yield method, "specular", psnr(found.specular, specular, mask)
