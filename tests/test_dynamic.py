"""The films of known truth, and how flicker on them is measured."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from tolerances import SIGMAS, assert_close

pytest.importorskip("embreex", reason="rendering needs the extra 'render'")
pytest.importorskip("scipy", reason="meshes need the extra 'render'")

from evaluation.dynamic import APART, Tally, find_regions, score_film
from evaluation.testsets import dynamic
from evaluation.testsets.dynamic import FILMS, Film, FilmFrame, Look, Prop, check_frame, move, play
from evaluation.testsets.expected import EXPECTED_FRAMES
from polsep.methods import METHODS
from polsep.render.materials import look_up, random_materials
from polsep.render.raycast import MeshScene
from polsep.render.shapes import ellipsoid
from polsep.render.simulate import filter_light
from polsep.render.sphere_tracing import PointLight
from polsep.sensor.camera import IMX250, Layout


@pytest.fixture(scope="module")
def light() -> list[FilmFrame]:
    """Frames of the moving light, from its last one at rest."""
    return list(play(FILMS["light"], range(20, 22)))


@pytest.mark.parametrize("name", ["turning", "crossing"])
def test_films_are_the_recorded_ones(name: str) -> None:
    """The first frame comes out as recorded, whatever is played after it."""
    frame = next(play(FILMS[name], range(1)))
    assert (name, 0) in EXPECTED_FRAMES
    check_frame(FILMS[name], frame)
    assert not bool(frame.still.any())
    with pytest.raises(ValueError, match=rf"expected {name}, frame 50, of fingerprint"):
        check_frame(FILMS[name], FilmFrame(50, frame.mosaic, frame.scene, frame.still))


def test_every_record_is_of_a_film() -> None:
    assert {name for name, _ in EXPECTED_FRAMES} == set(FILMS)
    assert len({film.seed for film in FILMS.values()}) == len(FILMS)


def test_noise_is_the_sensors_and_another_in_every_frame(light: list[FilmFrame]) -> None:
    """Deviations have the sensor's variance, and those of two frames nothing in common."""
    scores = []
    for frame in light:
        mean = filter_light(frame.scene.diffuse + frame.scene.specular, Layout(), IMX250)
        kept = (mean > 0.01) & (mean < 0.9)
        score = (frame.mosaic.linear() - mean) / IMX250.noise_variance(mean).sqrt()
        assert float(score[kept].var()) == pytest.approx(1, abs=SIGMAS * math.sqrt(2 / int(kept.sum())))
        scores.append(torch.where(kept, score, 0))
    product = scores[0] * scores[1]
    assert abs(float(product.mean())) < SIGMAS / math.sqrt(product.numel())


def test_what_is_still_has_the_truth_of_before(light: list[FilmFrame]) -> None:
    """All of it while the light rests; then the shadows only."""
    rest, moving = light
    assert bool(torch.equal(rest.still, rest.scene.mask))
    assert 0.02 < float(moving.still.float().mean()) < 0.3
    change = (moving.scene.diffuse.s0 - rest.scene.diffuse.s0).abs().amax(dim=0)
    assert float(change[moving.still].max()) <= 1e-6
    assert float((change > 1e-6)[moving.scene.mask & ~moving.still].float().mean()) > 0.95


def test_patterns_move_with_their_props() -> None:
    """A point of the surface has the same material wherever the prop is."""
    generator = torch.Generator().manual_seed(3)
    mesh = ellipsoid(np.array([1.0, 0.7, 0.5]), [np.zeros((36, 36))])
    prop = Prop(mesh, random_materials(1, generator, 1.0))
    turn = np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0], [-0.8, 0.0, 0.6]])
    other = move(prop, turn, np.array([0.3, -2.0, 1.0]))
    assert prop.materials.textures is not None
    slot = torch.zeros(len(mesh.vertices), dtype=torch.int64)
    found = [look_up(p.materials, slot, torch.from_numpy(p.mesh.vertices.T[..., None]).float()) for p in (prop, other)]
    difference = (found[0][0] - found[1][0]).abs().amax(dim=0)
    assert float((difference < 0.01).float().mean()) > 0.97  # cells have edges, and rounding chooses the side


def test_regions_of_a_frame() -> None:
    """Cells are still where all their pixels are, and apart that many cells from any other."""
    mask, still = torch.ones(40, 60, dtype=torch.bool), torch.ones(80, 120, dtype=torch.bool)
    still[41, 5] = False
    regions = find_regions(mask, still)
    assert int(regions["moving"].sum()) == 1 and bool(regions["moving"][20, 2])
    assert int(regions["still"].sum()) == 40 * 60 - 1
    rows, cols = (torch.nonzero(~regions["apart"])[:, k] for k in (0, 1))
    assert (int(rows.min()), int(rows.max()), int(cols.max())) == (20 - APART, 20 + APART, 2 + APART)


def test_flicker_is_how_much_errors_change() -> None:
    """An error that stays is none, however large; one that alternates by a step is that step."""
    mask, truth = (
        torch.ones(20, 20, dtype=torch.bool),
        torch.rand(3, 20, 20, generator=torch.Generator().manual_seed(1)),
    )
    tally = Tally()
    for number in range(4):
        found = (truth + 0.1, truth + 0.05 * (number % 2))
        tally.add(found, (truth, truth), {"still": mask, "moving": mask})
    scores = {(region, metric): value for region, metric, _, value in tally.scores()}
    assert_close(scores["still", "diffuse flicker"] + 1, 1.0, 10)
    assert scores["still", "specular flicker"] == pytest.approx(0.05, rel=1e-4)
    assert ("moving", "diffuse flicker") not in scores and ("moving", "diffuse PSNR") in scores


def test_the_filter_halves_the_flicker_of_a_still_film(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows of one method on a film of one ellipsoid."""

    def stage(generator: torch.Generator) -> Callable[[int], Look]:
        mesh = ellipsoid(np.array([1.0, 1.2, 1.0]), [np.zeros((36, 36))])
        model = (MeshScene(mesh), random_materials(1, generator))

        def look(number: int) -> Look:
            return model, PointLight((1.0, 2.0, 8.0), 64.0, 0.3)

        return look

    monkeypatch.setattr(dynamic, "FILM_SIDE", 96)
    rows = list(score_film(Film("still", 5, stage), range(5), [METHODS["analytic"]]))
    change = {(r.case, r.method, r.metric): r.value for r in rows if r.bench == "dynamic/change"}
    assert change["still", "analytic, filtered", "specular flicker, still"] < 0.5
    assert change["still", "analytic, steady", "diffuse flicker, still"] < 0.5
    assert change["still", "analytic, filtered", "diffuse PSNR, still"] > 0
    assert {row.unit for row in rows} == {"dB", "white", "1"}
