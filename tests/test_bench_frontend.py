"""The front-end benchmark: its metrics obey their laws, and its rows are whole without peers and without results."""

from __future__ import annotations

import math
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import torch

from polsep.bench import frontend
from polsep.bench.frontend import Case, demosaic_case, read_cases, score_cases, score_images, score_stokes
from polsep.bench.peers import PEERS_VARIABLE, find_peers, run_json
from polsep.bench.rows import Row, to_jsonl
from polsep.demosaic.bilinear import mean_cells
from polsep.io.store.rows import fill_tables
from polsep.physics.stokes import Measurements, Stokes, measure
from polsep.sensor.camera import Layout, Mosaic, sample_mosaic

EVERYWHERE = torch.ones(48, 64, dtype=torch.bool)


def random_truth(generator: torch.Generator) -> torch.Tensor:
    """Analyser images ``[4, 3, 48, 64]`` of polarized light that clips nowhere."""
    s0 = 0.3 + torch.rand(3, 48, 64, generator=generator)
    return measure(Stokes(s0, 0.3 * s0, -0.2 * s0), Layout().angles).data


def polarized_at(degrees: float) -> Stokes:
    """Half polarized light of one AoLP, ``[1, 4, 4]``."""
    angle, one = math.radians(degrees), torch.ones(1, 4, 4)
    return Stokes(one, 0.5 * math.cos(2 * angle) * one, 0.5 * math.sin(2 * angle) * one)


def write_captures(folder: Path, size: tuple[int, int]) -> None:
    """One four-angle capture of 8 bits, smooth and weakly polarized."""
    rows, cols = np.indices(size)
    for k, angle in enumerate((0, 45, 90, 135)):
        image = np.stack([100 + 40 * np.sin(rows / 9 + c) + 20 * np.cos(cols / 7 + k) for c in range(3)], -1)
        path = folder / "four_angle" / "smooth" / f"{angle}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(imagecodecs.png_encode(image.round().astype(np.uint8)))


def test_perfect_demosaicker_scores_the_cap(generator: torch.Generator) -> None:
    """The truth against itself: 120 dB and no angle or degree of error."""
    truth = random_truth(generator)
    found = score_images(truth, truth, EVERYWHERE)
    assert set(found) == set(frontend.UNITS)
    for metric, value in found.items():
        assert value == (120 if "PSNR" in metric else 0), metric


def test_known_error_has_its_psnr(generator: torch.Generator) -> None:
    """All analysers off by 0.01: 40 dB each, s0 off by 0.02, polarization not at all."""
    truth = random_truth(generator)
    found = score_images(truth + 0.01, truth, EVERYWHERE)
    assert found["analysers PSNR"] == pytest.approx(40, abs=1e-3)
    assert found["s0 PSNR"] == pytest.approx(-20 * math.log10(0.02), abs=1e-3)
    assert min(found["s1 PSNR"], found["s2 PSNR"]) > 110
    assert found["AoLP error"] < 0.01


@pytest.mark.parametrize(("found", "truth", "error"), [(1, 179, 2), (179, 1, 2), (90, 0, 90), (30, 20, 10)])
def test_angles_are_circular(found: float, truth: float, error: float) -> None:
    """AoLP counts modulo 180 degrees."""
    degree, angle = score_stokes(polarized_at(found), polarized_at(truth), torch.ones(4, 4, dtype=torch.bool))
    assert angle == pytest.approx(error, abs=1e-3)
    assert degree == pytest.approx(0, abs=1e-6)


def test_unpolarized_light_has_no_angle() -> None:
    """Below the bound of the true DoLP, angles do not count."""
    truth = Stokes(torch.ones(1, 4, 4), torch.full((1, 4, 4), 0.04), torch.zeros(1, 4, 4))
    assert score_stokes(polarized_at(50), truth, torch.ones(4, 4, dtype=torch.bool))[1] == 0


def test_half_resolution_is_the_mean_of_cells(generator: torch.Generator) -> None:
    """A full result at half resolution is the mean over each 2x2 cell."""
    full = random_truth(generator)
    half = mean_cells(full)
    assert half.shape == (4, 3, 24, 32)
    assert torch.allclose(half[1, 2, 5, 7], full[1, 2, 10:12, 14:16].mean())


def test_peers_images_are_scored_at_both_resolutions(generator: torch.Generator) -> None:
    """A peer that hands back the truth is perfect at both; one that has half resolution only is scored there only."""
    truth = random_truth(generator)
    mosaic = Mosaic(sample_mosaic(Measurements(truth, Layout().angles), Layout()), Layout(), 0.0, 1.0)
    case = Case("a", mosaic, truth, EVERYWHERE[::2, ::2])
    found = demosaic_case(case, {"full": {"a": truth}, "small": {"a": mean_cells(truth)}})
    rows = [row for row in score_cases("real", "mean", [(case, found)]) if row.metric == "s0 PSNR"]
    perfect = {(row.bench, row.case, row.method) for row in rows if row.value == 120}
    assert {(m, c) for b, c, m in perfect if b == "frontend/real"} == {
        ("full", "mean, half"),
        ("full", "mean, full"),
        ("small", "mean, half"),
    }


def test_real_captures_make_rows(tmp_path: Path) -> None:
    """A tiny four-angle folder without peers: every metric of every own method, per scene and as the mean over one."""
    write_captures(tmp_path, (66, 70))
    cases = list(read_cases(tmp_path))
    assert [case.name for case in cases] == ["smooth"]
    assert cases[0].truth.shape == (4, 3, 64, 68)
    rows = list(score_cases("real", "real captures", ((case, demosaic_case(case, {})) for case in cases)))
    means = [row for row in rows if row.bench == "frontend/real"]
    assert {row.metric for row in means} == set(frontend.UNITS)
    assert {row.method for row in means} == set(frontend.DEMOSAICKERS)
    assert len(rows) == 3 * len(means)
    worst = {(row.case, row.method, row.metric): row.value for row in rows if row.bench == "frontend/worst"}
    assert worst == {(row.case, row.method, row.metric): row.value for row in means}
    assert all(math.isfinite(row.value) and row.unit == frontend.UNITS[row.metric] for row in rows)
    assert min(row.value for row in means if row.metric == "analysers PSNR") > 30


def test_missing_pictures_are_one_line(tmp_path: Path) -> None:
    """Without the data folder the benchmark refuses before it measures anything."""
    with pytest.raises(ValueError, match=r"\Aexpected folders of four-angle captures in [^\n]+, found none\Z"):
        next(frontend.bench_frontend_quick(tmp_path))


def test_peers_are_named_and_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """No python named, or one that is not there: refused, as rows without peers are another table."""
    monkeypatch.delenv(PEERS_VARIABLE, raising=False)
    with pytest.raises(ValueError, match=r"expected the peers' python in POLSEP_PEERS .*, found none"):
        find_peers()
    monkeypatch.setenv(PEERS_VARIABLE, "/nowhere/python")
    with pytest.raises(ValueError, match="found no /nowhere/python"):
        find_peers()


def test_failing_program_is_one_line() -> None:
    """The last line of what a program said becomes the message."""
    with pytest.raises(ValueError, match=r"\Ash failed: no luck\Z"):
        run_json("sh", "-c", "echo much; echo no luck >&2; exit 3")


def test_tables_of_parts(tmp_path: Path) -> None:
    """A table takes the rows of its part, turned where asked; without results it says what makes them."""
    markdown = "<!-- table: a/x by method -->\n<!-- end -->\n"
    assert "Not measured yet: `a` of `polsep bench`" in fill_tables(markdown, tmp_path)
    rows = [
        Row("a/x", "case", "m", "diffuse PSNR", 30.0, "dB"),
        Row("a/x", "case", "m", "specular PSNR", 31.0, "dB"),
        Row("a/y", "case", "n", "time", 1.0, "s"),
    ]
    made = {"command": "c", "commit": "d", "machine": "e"}
    (tmp_path / "a.jsonl").write_text(to_jsonl(rows, made), encoding="utf-8")
    filled = fill_tables(markdown, tmp_path)
    assert "| case | method | diffuse / specular PSNR [dB] |\n| --- | --- | --- |\n| case | m | 30 / 31 |" in filled
    assert fill_tables(filled, tmp_path) == filled
    assert "| n |" not in filled
    assert "Not measured yet: `a` of `polsep bench`" in fill_tables(markdown.replace("a/x", "a/z"), tmp_path)
