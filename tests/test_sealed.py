"""The sealed set: nothing in it is of another set, and the command that scores it only ever adds a line."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("embreex", reason="rendering needs the extra 'render'")
pytest.importorskip("scipy", reason="meshes need the extra 'render'")
pytest.importorskip("flip_evaluator", reason="scores need the extra 'bench'")

from click.testing import CliRunner

from evaluation import sealed
from evaluation.__main__ import app as laboratory
from evaluation.testsets import SETS, version_of
from evaluation.testsets.casting import LARGEST_ANGLE_DEG, look_at, random_light_near
from evaluation.testsets.expected import EXPECTED
from evaluation.testsets.sealed import ANGLES_DEG, GRID, PRACTICE, SEALED, SHAPES, span_grid, wrap
from polsep.bench import rows
from polsep.methods import METHODS

ROOT = Path(__file__).resolve().parents[1]
FINE = (60, 40)


def test_no_scene_shares_anything_with_the_selection_sets() -> None:
    """Neither a seed nor a file; records and the version in docs are those of the recipes."""
    others = [recipe for recipes in SETS.values() for recipe in recipes]
    assert not {r.seed for r in SEALED} & {r.seed for r in (*others, *PRACTICE)}
    assert not {file for r in SEALED for file in r.files} & {file for r in others for file in r.files}
    assert len({file for r in SEALED for file in r.files}) == sum(len(r.files) for r in SEALED)
    assert {r.name for r in SEALED} <= set(EXPECTED) and not {r.name for r in PRACTICE} & set(EXPECTED)
    page = (ROOT / "docs" / "testsets.md").read_text(encoding="utf-8")
    assert re.findall(r"\| `sealed` \|.*`(\w{12})` \|", page) == [version_of(SEALED)[:12]]


@pytest.mark.parametrize(("build", "closed"), SHAPES, ids=lambda x: getattr(x, "__name__", ""))
def test_shapes_are_solids_that_face_outward(build, closed: bool) -> None:  # type: ignore[no-untyped-def]
    """The volume is positive, normals are of unit length and on the side that triangles face."""
    for share in (np.zeros(3), np.array([0.3, 0.6, 0.9])):
        mesh = span_grid(build(FINE, share), closed)
        a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
        faced = np.cross(b - a, c - a)
        assert float((a * faced).sum()) > 0.05
        assert np.abs(np.linalg.norm(mesh.vertices, axis=1).max() - 1) < 1e-9
        used = np.unique(mesh.faces)
        assert np.abs(np.linalg.norm(mesh.normals[used], axis=1) - 1).max() < 1e-6
        mean = mesh.normals[mesh.faces].mean(axis=1)
        assert float(np.mean((mean * faced).sum(axis=1) > 0)) > 0.97
        assert mesh.vertices.shape[0] == math.prod(FINE)
    assert GRID[0] > FINE[0]


def test_lamps_are_farther_from_the_camera_than_others() -> None:
    mesh = span_grid(SHAPES[2][0](FINE, np.full(3, 0.5)), False)
    camera, found = look_at(mesh, 30, 20), []
    eye = np.array(camera.position)
    for seed in range(60):
        light = np.array(
            random_light_near(camera, torch.Generator().manual_seed(seed), ANGLES_DEG, (1.0, 2.5)).position
        )
        found.append(math.degrees(math.acos(light @ eye / np.linalg.norm(light) / np.linalg.norm(eye))))
        assert 1 <= np.linalg.norm(light) / np.linalg.norm(eye) <= 2.5
    assert 20 <= min(found) < 30 and LARGEST_ANGLE_DEG < max(found) <= 65


def test_textures_are_images_mirrored_through_space() -> None:
    """Along x an image of three pixels is passed to and fro; a step of depth moves it by half as much."""
    image = torch.tensor([[[0.0, 1.0, 2.0], [0.0, 1.0, 2.0]]])
    texture = wrap(image, 2.0)

    def at(x: float, z: float = 0.0) -> float:
        return float(texture(torch.tensor([x, 0.0, z])[:, None, None]))

    assert [at(x) for x in (0.0, 1.0, 2.0, 3.0, 4.0, -1.0)] == pytest.approx([0, 1, 2, 1, 0, 1], abs=2e-3)
    assert at(0.0, 2.0) == pytest.approx(1.0, abs=1e-3)


def run(*arguments: str) -> tuple[int, str]:
    done = CliRunner(env={"POLSEP_DATA": ""}).invoke(laboratory, ["sealed", *arguments])
    return done.exit_code, done.output


def test_every_score_is_a_line_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The quick form scores scenes of its own, and leaves the lines that were there."""
    monkeypatch.setattr(sealed, "METHODS", {"analytic": METHODS["analytic"]})
    log = tmp_path / "sealed-quick.log"
    log.write_text("before\n", encoding="utf-8")
    status, said = run("--quick", "-o", str(tmp_path))
    assert status == 0 and "half  analytic" in said and "full  analytic" in said
    before, line = log.read_text(encoding="utf-8").splitlines()
    found = json.loads(line)
    assert before == "before" and found["set"] == "practice" and found["scenes"] == len(PRACTICE)
    assert {"date", "version", "commit", "machine", "command"} <= set(found)
    score = found["dB"]["half"]["analytic"]["specular PSNR"]
    assert 10 < score["worst"] <= score["median"] == pytest.approx(score["mean"], abs=2e-3)  # of two
    assert score["standard error"] == pytest.approx(score["mean"] - score["worst"], abs=2e-3)
    assert found["dB"]["half"]["analytic"]["specular PSNR, unlimited"]["mean"] <= score["mean"]
    assert list(tmp_path.iterdir()) == [log]


def test_the_seal_is_kept_where_the_score_would_say_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the data, and in a tree with changes: one line, exit status 2, no log."""
    folder = tmp_path / "data"
    assert run("-o", str(tmp_path)) == (2, run("-o", str(tmp_path))[1])
    assert "expected --data DIR or POLSEP_DATA" in run("-o", str(tmp_path))[1]
    status, said = run("--data", str(folder), "-o", str(tmp_path))
    assert status == 2 and f"expected {folder}/svbrdf/" in said
    for recipe in SEALED:
        for file in recipe.files:
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_bytes(b"")
    monkeypatch.setattr(rows, "ask_git", lambda *_: "changed")
    status, said = run("--data", str(folder), "-o", str(tmp_path))
    assert status == 2 and "expected a checkout without changes" in said
    assert not (tmp_path / "sealed.log").exists()
