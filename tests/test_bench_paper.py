"""The paper's evaluation: who is in it, what it costs, which rows make which table, pictures that are whole."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from click import ClickException
from click.testing import CliRunner
from torch import nn

pytest.importorskip("embreex", reason="rendering needs the extra 'render'")
pytest.importorskip("scipy", reason="meshes need the extra 'render'")
pytest.importorskip("flip_evaluator", reason="FLIP needs the extra 'bench'")
pytest.importorskip("matplotlib", reason="figures need the extra 'bench'")
from PIL import Image

from evaluation import gallery, ladder, paper, testsets
from evaluation.__main__ import app as laboratory
from evaluation.benches import BENCHES
from evaluation.calibration import Sweep
from evaluation.figures import (
    LARGEST_ERROR,
    Axes,
    Line,
    Panel,
    draw_grid,
    draw_plots,
    error_map,
    require_matplotlib,
    tone,
)
from evaluation.ladder import (
    CO_SITED,
    MOSAIC,
    SHIPPED,
    count_gflop,
    demosaic_regrouped,
    ladder_entries,
    measure_costs,
    read_curves,
    rung_of,
)
from evaluation.paper import QUICK, Extent, measure_paper, table_rows
from evaluation.testsets import Recipe
from polsep.bench.rows import Row
from polsep.cli import app
from polsep.io.store.image_codecs import write_jpeg
from polsep.io.store.rows import read_rows
from polsep.io.store.weights import write_weights
from polsep.networks.paper import Refinement
from polsep.networks.rungs import RUNGS
from polsep.networks.sizes import Size
from polsep.physics.stokes import Stokes
from polsep.render.sphere_tracing import Scene
from polsep.sensor.camera import Layout, Mosaic

ROOT = Path(__file__).resolve().parents[1]
SIZE = Size(2, 1, 1)
CURVE = [[1000, 30.0, 28.0], [2000, 31.5, 29.25]]


def write_rung(folder: Path, rung: str, variant: str) -> None:
    """Untrained weights, which start at the analytic split or at all light as diffuse."""
    metadata = {"method": "paper", "rung": rung, "colors": "3", "size": json.dumps(asdict(SIZE))}
    if variant == MOSAIC:
        metadata["curve"] = json.dumps(CURVE)
    network = Refinement(RUNGS[rung], 3, SIZE)
    write_weights(folder / f"ladder/{rung}-{variant}.safetensors", network.state_dict(), metadata)


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of weights in place of the shipped ones: two rungs of mosaics, one of them of co-sited data too."""
    folder = tmp_path / "weights"
    monkeypatch.setattr(ladder, "WEIGHTS", folder)
    for rung, variant in (("paper", MOSAIC), ("paper", CO_SITED), ("stokes", MOSAIC)):
        write_rung(folder, rung, variant)

    monkeypatch.setattr(ladder, "shipped_weights", lambda name: folder / f"{name}.safetensors")
    monkeypatch.setattr(ladder, "is_shipped", lambda name: (folder / f"{name}.safetensors").is_file())
    ladder_entries.cache_clear()
    yield folder
    ladder_entries.cache_clear()


def make_two_tones(_paths: list[Path], _generator: torch.Generator) -> Scene:
    """Two tones of unpolarized light with a bright and a faint specular."""
    diffuse = torch.full((3, 32, 32), 0.4)
    diffuse[:, :, 16:] = 0.7
    specular = torch.full((3, 32, 32), 0.5)
    specular[:, 16:] = 0.01
    mask = torch.zeros(32, 32, dtype=torch.bool)
    mask[2:-2, 2:-2] = True
    return Scene(Stokes(diffuse, 0 * diffuse, 0 * diffuse), Stokes(specular, specular, 0 * specular), mask)


@pytest.fixture
def tiny_sets(monkeypatch: pytest.MonkeyPatch) -> None:
    """One scene of two tones in place of the selection sets, and small views under two lights for the sweep."""
    recipe = Recipe("two-tones", 1, (), make_two_tones)
    monkeypatch.setattr(testsets, "SETS", {"objects": (recipe, recipe)})
    monkeypatch.setattr(testsets, "check_case", lambda _: None)
    monkeypatch.setattr("evaluation.calibration.SIZE", (48, 48))
    monkeypatch.setattr("evaluation.calibration.NOMINAL_DEG", (0.0, 45.0))
    monkeypatch.setattr(gallery, "VIEW_SIZE", (48, 48))
    monkeypatch.setattr(gallery, "SCENES", ("two-tones", "two-tones"))
    frame = Mosaic(0.5 * torch.ones(32, 32), Layout(), 0.0, 1.0)
    monkeypatch.setattr(paper, "read_demo_capture", lambda: frame)


def test_rungs_without_weights_are_left_out(weights: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With one line each; those that have none of co-sited data are named so."""
    expected = [
        "analytic",
        "analytic, regrouped",
        "min and max",
        "paper",
        "stokes",
        "color-affine, bilinear",
        "color-affine",
    ]
    assert [entry.name for entry in ladder_entries(MOSAIC)] == expected
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == len(RUNGS) - 2
    assert "polsep: the rung unpolarized is left out: no weights ladder/unpolarized-mosaic" in lines
    expected = ["analytic", "min and max", "paper", "stokes, trained on mosaics", "color-affine"]
    assert [entry.name for entry in ladder_entries(CO_SITED)] == expected


def test_regrouped_analysers_are_bayer_mosaics_of_their_own() -> None:
    """A sample of its own colour stays, others are the mean of the 2 or 4 nearest; light that is even stays even."""
    layout = Layout()
    samples = torch.arange(64.0).reshape(8, 8) / 100
    samples[4, 4] = 1  # 90 in a red cell
    found = demosaic_regrouped(Mosaic(samples, layout, 0.0, 1.0))
    ninety = 2  # of 0, 45, 90, 135
    own = samples[0::2, 0::2]
    assert found.data.shape == (4, 3, 4, 4) and found.angles == layout.angles
    torch.testing.assert_close(found.data[ninety, 0, 2, 2], own[2, 2])
    torch.testing.assert_close(found.data[ninety, 0, 2, 1], (own[2, 0] + own[2, 2]) / 2)
    torch.testing.assert_close(found.data[ninety, 0, 1, 1], (own[0, 0] + own[0, 2] + own[2, 0] + own[2, 2]) / 4)
    torch.testing.assert_close(found.data[ninety, 1, 2, 2], (own[1, 2] + own[3, 2] + own[2, 1] + own[2, 3]) / 4)
    torch.testing.assert_close(found.data[ninety, 2, 1, 1], own[1, 1])
    assert found.clipped is not None
    assert (
        found.clipped[ninety, 0, 1:4, 1:4].all() and not found.clipped[ninety, 1:].any() and not found.clipped[0].any()
    )
    even = demosaic_regrouped(Mosaic(torch.full((10, 14), 0.3), layout, 0.0, 1.0))
    torch.testing.assert_close(even.data, torch.full((4, 3, 5, 7), 0.3))


def test_the_method_paper_is_in_where_it_is_shipped(weights: Path) -> None:
    (weights / "ladder/paper-mosaic.safetensors").rename(weights / "paper-mosaic.safetensors")
    assert SHIPPED in [entry.name for entry in ladder_entries(MOSAIC)]
    assert [rung_of(name) for name in (SHIPPED, "stokes, trained on mosaics", "analytic")] == ["paper", "stokes", ""]


def test_weights_of_another_rung_are_refused(weights: Path) -> None:
    (weights / "ladder/stokes-mosaic.safetensors").rename(weights / "ladder/shared-mosaic.safetensors")
    with pytest.raises(ValueError, match=r"expected weights of the rung shared in .* found stokes"):
        ladder_entries(MOSAIC)


def test_operations_are_those_counted_by_hand() -> None:
    """Of the linear map alone, 2 K C per pixel; then of a U-Net of one level without folding."""
    rung = RUNGS["unpolarized"]
    network = Refinement(rung, 3, SIZE)
    linear = 2 * 3 * 6
    nets, network.nets = network.nets, nn.ModuleList()
    network.forward = lambda x: (network.linear(x),) * 2  # type: ignore[method-assign]
    assert count_gflop(network) == pytest.approx(1e6 * linear / 1e9)
    del network.forward
    network.nets = nets
    # 3 -> 2 -> 2 at the top, 2 -> 4 -> 4 at a quarter of the pixels, up to 2, 4 -> 2 -> 2 and the last 1x1 to 3
    top, bottom = 9 * (3 * 2 + 2 * 2), 9 * (2 * 4 + 4 * 4) / 4
    up, decoder, last = 4 * 2, 9 * (4 * 2 + 2 * 2), 2 * 3
    expected = 2 * 2 * (top + bottom + up + decoder + last) + linear
    assert count_gflop(network) == pytest.approx(1e6 * expected / 1e9)


def test_costs_are_of_networks_and_of_whole_chains(weights: Path) -> None:
    frame = Mosaic(0.5 * torch.ones(32, 48), Layout(), 0.0, 1.0)
    rows = list(measure_costs(ladder_entries(MOSAIC), frame, 1))
    assert {row.case for row in rows} == {"48x32 raw frame, 24x16 images"}
    counted = {row.method: row.value for row in rows if row.metric == "parameters"}
    expected = sum(p.numel() for p in Refinement(RUNGS["stokes"], 3, SIZE).parameters())
    assert set(counted) == {"paper", "stokes"} and counted["stokes"] == expected
    ratios = {row.method: row.value for row in rows if row.metric == "times as long as analytic"}
    assert ratios["analytic"] == 1 and set(ratios) == {entry.name for entry in ladder_entries(MOSAIC)}


def test_everything_is_scored_on_one_path(weights: Path, tiny_sets: None, tmp_path: Path) -> None:
    """Untrained networks score as what they start at: the analytic split, in both protocols and in the sweep."""
    rows = list(measure_paper(tmp_path, Extent({"objects": 1}, Sweep(1, (0, 20)), 1)))
    value = {(row.bench, row.case, row.method, row.metric): row.value for row in rows}
    for bench, case in (
        ("paper/baselines", "objects, mosaic"),
        ("paper/ablations", "objects, mosaic"),
        ("paper/metrics", "objects, mosaic"),
        ("paper/baselines_co_sited", "objects, co-sited"),
        ("paper/scenes", "two-tones, mosaic"),
        ("paper/calibration", "light polarizer off by 20 degrees rms"),
    ):
        for metric in ("diffuse PSNR", "specular PSNR"):
            assert value[bench, case, "paper", metric] == pytest.approx(
                value[bench, case, "analytic", metric], abs=0.05
            )
    assert {row.metric for row in rows if row.bench == "paper/baselines"} == {"diffuse PSNR", "specular PSNR"}
    assert "specular FLIP" in {row.metric for row in rows if row.bench == "paper/metrics"}
    assert {row.unit for row in rows if row.bench == "paper/costs"} == {"1", "GFLOP", "s", "x"}


def test_rows_know_their_tables() -> None:
    """The paper's method is in both tables; ablations in Table 2, all else in Table 3; scenes in neither."""

    def tables(method: str, metric: str = "diffuse PSNR", bench: str = "paper/mosaic") -> list[str]:
        return [row.bench.removeprefix("paper/") for row in table_rows(Row(bench, "c", method, metric, 1.0, "dB"))]

    assert tables("paper") == tables("analytic") == tables(SHIPPED) == ["ablations", "baselines", "metrics"]
    assert tables("no-angle") == ["ablations", "metrics"]
    assert tables("polarized") == tables("color-affine") == ["baselines", "metrics"]
    assert tables("polarized", "diffuse SSIM") == ["metrics"]
    assert tables("shared, trained on mosaics", bench="paper/co-sited") == ["ablations_co_sited", "metrics_co_sited"]
    assert tables("paper", bench="paper/scenes") == ["scenes"]


def test_quick_is_a_part_of_the_whole() -> None:
    """Fewer scenes of every set, views and errors, each of them measured by the full one too."""
    full = Extent()
    assert set(QUICK.scenes) == set(testsets.SETS) and not full.scenes
    assert all(0 < count < len(testsets.SETS[name]) for name, count in QUICK.scenes.items() if count is not None)
    assert QUICK.sweep.views < full.sweep.views and set(QUICK.sweep.errors_deg) < set(full.sweep.errors_deg)
    assert BENCHES["paper"].quick is not None and BENCHES["sets"].quick is None


def test_quick_scenes_score_as_in_the_whole(weights: Path, tiny_sets: None, tmp_path: Path) -> None:
    def scenes(extent: Extent) -> list[Row]:
        return [row for row in measure_paper(tmp_path, extent) if row.bench == "paper/scenes"]

    sweep = Sweep(1, (0,))
    part, whole = scenes(Extent({"objects": 1}, sweep, 1)), scenes(Extent({}, sweep, 1))
    assert whole[: len(part)] == part
    assert len(whole) == 2 * len(part)


def test_curves_are_those_of_the_weights(weights: Path) -> None:
    assert read_curves() == {name: [tuple(point) for point in CURVE] for name in ("paper", "stokes")}
    metadata = {"method": "paper", "rung": "stokes", "colors": "3", "size": json.dumps(asdict(SIZE))}
    state = Refinement(RUNGS["stokes"], 3, SIZE).state_dict()
    write_weights(weights / "ladder/stokes-mosaic.safetensors", state, metadata)
    assert list(read_curves()) == ["paper"]


def test_curves_show_what_they_are_compared_with(weights: Path) -> None:
    """A method without training is a flat line, from the first step to the last."""
    metadata = {"method": "paper", "rung": "stokes", "colors": "3", "size": json.dumps(asdict(SIZE))}
    metadata |= {"curve": json.dumps([[3000, 33, 30]]), "reference": json.dumps({"analytic": [30.2, 30.0]})}
    state = Refinement(RUNGS["stokes"], 3, SIZE).state_dict()
    write_weights(weights / "ladder/stokes-mosaic.safetensors", state, metadata)
    assert read_curves()["analytic"] == [(1000.0, 30.2, 30.0), (3000.0, 30.2, 30.0)]


def test_figures_are_written_whole_and_the_same_again(
    weights: Path, tiny_sets: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every figure but that of real frames, whose data are not there, which one line says."""
    rows = list(measure_paper(tmp_path, Extent({"objects": 1}, Sweep(1, (0, 20)), 1)))
    paths = list(gallery.draw_paper(rows, tmp_path / "no-data", tmp_path / "a"))
    assert [path.name for path in paths] == [
        f"{n}.jpg" for n in ("fig3a", "fig3b", "fig4", "fig5", "fig5-light", "curves")
    ]
    assert "polsep: the picture fig6 is left out: nothing to show in it" in capsys.readouterr().err
    for path in paths:
        picture = np.asarray(Image.open(path))
        assert picture.shape[2] == 3 and min(picture.shape[:2]) > 100 and picture.std() > 5
        assert path.stat().st_size < 500_000
    again = gallery.draw_paper(rows, tmp_path / "no-data", tmp_path / "b")
    assert all(path.read_bytes() == other.read_bytes() for path, other in zip(paths, again, strict=True))


def test_real_frames_are_shown_where_they_are(weights: Path, shared: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The others are left out."""
    monkeypatch.setattr(gallery, "REAL", (gallery.REAL[-1], ("raw/nowhere.png", "nothing", 1.0)))
    pixels = gallery.draw_fig6(shared / "data")
    assert pixels is not None and pixels.shape[2] == 3


def test_the_shipped_method_stands_in_for_the_rung() -> None:
    assert gallery.shown_of(gallery.COLUMNS, {SHIPPED, "analytic"}) == ["analytic", SHIPPED]
    assert gallery.shown_of(gallery.COLUMNS, {SHIPPED, "analytic", "paper"}) == ["analytic", "paper"]


def test_crops_hold_the_mask_and_are_not_higher_than_wide() -> None:
    mask = torch.zeros(100, 120, dtype=torch.bool)
    mask[20:80, 50:60] = True
    cut = gallery.crop(mask[None].float(), mask)
    assert cut.shape == (1, 76, 76)
    assert int(cut.sum()) == int(mask.sum())


def test_tone_and_errors_at_known_points() -> None:
    assert tone(torch.tensor([0.0, 0.5, 1.0, 4.0]).view(1, 2, 2), 1.0)[..., 0].tolist() == [[0, 186], [255, 255]]
    truth = torch.full((3, 1, 3), 0.5)
    found = truth + LARGEST_ERROR * torch.tensor([0.0, 1.0, -2.0])
    pixels = error_map(found, truth)
    assert pixels[0, 0].max() < 5
    assert pixels[0, 1].tolist() == pixels[0, 2].tolist() and pixels[0, 1, 0] > 200


def test_grids_and_plots_have_the_size_that_they_say() -> None:
    panel = Panel("x", np.zeros((20, 10, 3), np.uint8))
    one, two = (draw_grid([[panel, Panel("", None)]] * rows, "c") for rows in (1, 2))
    assert one.shape[1] == two.shape[1] and two.shape[0] > 1.8 * one.shape[0] - 40
    line = Line("x", (0, 1), (30, 31))
    assert draw_plots([Axes("d", "x", [line])] * 2).shape == (430, 880, 3)


def test_pictures_are_refused_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"expected pixels uint8 \[h, w, 3\], found float64 \(4, 4\)"):
        write_jpeg(tmp_path / "x.jpg", np.zeros((4, 4)))  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


def test_the_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    for need in (require_matplotlib, lambda: next(measure_paper(tmp_path, QUICK))):
        with pytest.raises(ValueError, match=r"expected the extra bench .* found no matplotlib"):
            need()


def test_the_command_measures_and_draws(weights: Path, tiny_sets: None, tmp_path: Path) -> None:
    """Rows and pictures of a quick run lie together, away from those of the full one."""
    laboratory(["paper", "--quick", "--data", str(tmp_path), "-o", str(tmp_path / "out")], standalone_mode=False)
    rows = read_rows(tmp_path / "out" / "paper-quick.jsonl")
    assert {row["command"] for row in rows} == {"python -m evaluation paper --quick"}
    assert {row["bench"] for row in read_rows(tmp_path / "out" / "scenes" / "paper-quick.jsonl")} == {"paper/scenes"}
    assert not any(row["bench"] == "paper/scenes" for row in rows)
    assert (tmp_path / "out" / "paper-quick" / "fig5.jpg").is_file()


def test_benches_without_a_quick_version_say_so() -> None:
    names = "dynamic, sensors, material, video, geometry, shape, web, agreement, warned, paper"
    expected = rf"expected a benchmark with a quick version for --quick \({names}\), found 'sets'"
    with pytest.raises(ClickException, match=expected):
        laboratory(["sets", "--quick"], standalone_mode=False)


@pytest.mark.parametrize("name", [name for name, bench in BENCHES.items() if bench.data])
def test_missing_data_are_one_line_and_keep_what_was_measured(name: str, tmp_path: Path) -> None:
    """Without a folder, and with one that lacks a part; exit status 2, and the rows from before stay."""
    before = tmp_path / f"{name}.jsonl"
    before.write_text("measured before\n", encoding="utf-8")
    for data, expected in (("", "expected --data DIR or POLSEP_DATA"), (str(tmp_path), f"expected {tmp_path}/")):
        done = CliRunner(env={"POLSEP_DATA": data}).invoke(laboratory, [name, "-o", str(tmp_path)])
        assert done.exit_code == 2
        assert expected in done.output and len(done.output.splitlines()) == 1
        assert before.read_text(encoding="utf-8") == "measured before\n"


def test_readme_fills_all_pages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "docs").mkdir()
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "speed.jsonl").touch()
    for page in ("README.md", "docs/joint.md", "docs/paper.md"):
        (tmp_path / page).write_text("<!-- table: paper/costs -->\n<!-- end -->\n", encoding="utf-8")
    app(["bench", "readme"], standalone_mode=False)
    for page in ("README.md", "docs/joint.md", "docs/paper.md"):
        assert "Not measured yet: `paper` of `polsep bench`" in (tmp_path / page).read_text(encoding="utf-8")
