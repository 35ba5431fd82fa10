"""`polsep edit`: what polsep wrote goes in, whole files come out, sequences go on, what can't be is said in a line."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image
from test_cli import Run, assert_refused, contents, run_here
from test_edit import only, random_images, sphere

from polsep import cli
from polsep.edit import EDITS, Metallic, Recipe, Rougher, SeparatedImages, Sharper, SpecularGain, Texture, apply
from polsep.edit.files import EditTarget, Work, edit_sequence, load_work, read_recipe
from polsep.edit.recipe import recipe_as_text
from polsep.io.assets.maps import read_map
from polsep.io.results.exr import encode_exr, read_exr_layers
from polsep.io.results.separation_reader import find_numbered, read_separated
from polsep.io.results.separation_writer import write_separation
from polsep.io.results.sequences import PART, Picture, SequenceKind, write_exr
from polsep.io.store.atomic import OutputError
from polsep.io.store.errors import InputError
from polsep.physics.srgb import linear_from_srgb, srgb
from polsep.separation.report import SeparatedFrame

Cli = Callable[..., Run]

COUNT = PART + 4
#: Sequences without a film to watch, which needs the extra "video".
SILENT = SequenceKind(preview=False)


@pytest.fixture
def polsep(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Cli:
    """Run `polsep edit ARGS` inside this process."""

    return partial(run_here, monkeypatch, capfd, "edit")


def frame_of(images: SeparatedImages) -> SeparatedFrame:
    size = images.diffuse.shape[:2]
    ones = np.ones(size, np.float32)
    return SeparatedFrame(
        images.diffuse, images.specular, np.ones(size, bool), 0 * ones, 0 * ones, {"source": "raw.png"}
    )


def separated(folder: Path, stem: str = "shot", colors: int = 3, format: str = "exr") -> Path:
    """A file as `polsep separate` writes it."""
    return write_separation(frame_of(random_images(colors=colors)), folder, stem, format)[0]


def film(folder: Path, count: int = COUNT, first: int = 0, stem: str = "take") -> Path:
    """A sequence as `polsep video` writes it."""
    for k in range(count):
        images = random_images(k)
        write_exr(folder / f"{stem}_{first + k:06d}.exr", Picture(images.diffuse, images.specular, None, {}), "none")
    return folder


def image_of(path: Path, layer: str) -> NDArray[np.float32]:
    planes = read_exr_layers(path)
    return np.stack([planes[f"{layer}.{c}"] for c in ("RGB" if f"{layer}.R" in planes else "Y")], axis=-1)


def png(path: Path, pixels: NDArray[Any]) -> Path:
    path.write_bytes(imagecodecs.png_encode(pixels))
    return path


# Single frames.


@pytest.mark.parametrize("colors", [3, 1])
@pytest.mark.parametrize("format", ["exr", "npz"])
def test_a_frame_becomes_an_edited_one(tmp_path: Path, polsep: Cli, format: str, colors: int) -> None:
    """Layers are what the library makes, bit for bit; preview and sidecar tell what was done and did to light."""
    source = separated(tmp_path, colors=colors, format=format)
    run = polsep(source, "-o", tmp_path / "out", "--rougher", "3", "--specular-gain", "2")
    assert run.status == 0 and run.err == ""
    paths = [tmp_path / "out" / f"shot.{suffix}" for suffix in ("exr", "png", "json")]
    assert run.out == f"{source} -> {', '.join(map(str, paths))}\n"
    before = random_images(colors=colors)
    expected = apply(frame_of(before), Recipe((Rougher(sigma=3.0), SpecularGain(gain=2.0))))
    for layer in ("diffuse", "specular", "combined"):
        assert np.array_equal(image_of(paths[0], layer), getattr(expected, layer))
    names = "RGB" if colors == 3 else "Y"
    planes = read_exr_layers(paths[0])
    assert set(planes) == {f"{a}{c}" for a in ("diffuse.", "specular.", "combined.", "") for c in names}
    assert all(np.array_equal(planes[c], planes[f"combined.{c}"].astype(np.float16)) for c in names)
    said = json.loads(paths[2].read_text())
    assert said["recipe"]["edits"][0] == {"edit": "rougher", "sigma": 3.0}
    assert said["light"]["after"]["specular"] == pytest.approx(2 * said["light"]["before"]["specular"], rel=1e-5)
    assert said["light"]["after"]["diffuse"] == said["light"]["before"]["diffuse"]
    shown = np.rint(255 * srgb(said["exposure"] * expected.combined))
    assert np.array_equal(imagecodecs.png_decode(paths[1].read_bytes()), np.broadcast_to(shown, (*shown.shape[:2], 3)))


def test_edited_frames_can_be_edited(tmp_path: Path, polsep: Cli) -> None:
    """Two commands, one after the other, are one recipe."""
    source = separated(tmp_path)
    polsep(source, "-o", tmp_path / "a", "--rougher", "3")
    polsep(tmp_path / "a" / "shot.exr", "-o", tmp_path / "b", "--metallic", "0.5")
    polsep(source, "-o", tmp_path / "c", "--metallic", "0.5", "--rougher", "3")
    assert (tmp_path / "b" / "shot.exr").read_bytes() == (tmp_path / "c" / "shot.exr").read_bytes()


def test_archives_of_half_floats_are_read_as_exr_files_are(tmp_path: Path) -> None:
    """Truth of `polsep render --format npz` has them."""
    images = random_images()
    halves = {name: getattr(images, name).astype(np.float16) for name in ("diffuse", "specular")}
    np.savez(tmp_path / "view.npz", **halves)
    found = read_separated(tmp_path / "view.npz")
    assert found.diffuse.dtype == np.float32 and np.array_equal(found.specular, halves["specular"])


def test_recipes_find_their_images_from_linked_folders(
    tmp_path: Path, polsep: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the recipe's folder, or the one of the call, is a link to a deeper one."""
    source = separated(tmp_path)
    for name in ("own", "its"):
        (tmp_path / "far" / "away" / name).mkdir(parents=True)
        (tmp_path / name).symlink_to(tmp_path / "far" / "away" / name)
    png(tmp_path / "own" / "mask.png", np.full((21, 26), 255, np.uint8))
    monkeypatch.chdir(tmp_path / "own")
    saved = tmp_path / "its" / "look.json"
    assert polsep(source, "-o", "a", "--rougher", "2", "--mask", "mask.png", "--save-recipe", saved).status == 0
    assert polsep(source, "-o", "b", "--recipe", saved).status == 0


def test_recipes_are_saved_and_replayed(tmp_path: Path, polsep: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    """--save-recipe keeps the call; file names are relative to the recipe, from wherever it is replayed."""
    monkeypatch.chdir(tmp_path)
    source = separated(tmp_path)
    (tmp_path / "maps").mkdir()
    png(tmp_path / "maps" / "checks.png", np.full((4, 4, 3), 128, np.uint8))
    png(tmp_path / "maps" / "mask.png", np.full((21, 26), 255, np.uint8))
    options = (
        "--texture",
        "maps/checks.png",
        "--texture-repeats",
        "2.5",
        "--mask",
        "maps/mask.png",
        "--tint",
        "1,0.5,2",
    )
    first = polsep(source, "-o", "a", *options, "--save-recipe", "kept/look.json")
    assert first.status == 0 and first.out.startswith("kept/look.json\n")
    recipe = read_recipe(tmp_path / "kept" / "look.json")
    assert recipe.images() == {"../maps/checks.png": "texture", "../maps/mask.png": "mask"}
    assert [edit.name for edit in recipe.edits] == ["texture", "tint"]
    monkeypatch.chdir(tmp_path / "maps")
    saved = Path("../kept/look.json")
    saved.write_bytes(b"\xef\xbb\xbf" + saved.read_bytes())  # as editors on Windows save it
    assert polsep(source, "-o", "../b", "--recipe", "../kept/look.json").status == 0
    assert (tmp_path / "a" / "shot.exr").read_bytes() == (tmp_path / "b" / "shot.exr").read_bytes()
    hashes = [json.loads((tmp_path / k / "shot.json").read_text())["images"] for k in "ab"]
    assert list(hashes[0].values()) == list(hashes[1].values()) and len(hashes[0]) == 2
    assert_refused(
        polsep(source, "-o", "../c", *("--rougher", "1"), "--save-recipe", "../kept/look.json"), "--overwrite"
    )


def test_a_shell_edits(tmp_path: Path) -> None:
    """The program itself, with a warning about what sharpening can't do."""
    command = [sys.executable, "-c", "from polsep.cli import main; main()", "edit", str(separated(tmp_path))]
    done = subprocess.run(
        [*command, "-o", str(tmp_path / "out"), "--sharper", "1"],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0 and done.stderr == f"polsep: {Sharper.caution}\n"
    assert json.loads((tmp_path / "out" / "shot.json").read_text())["warnings"] == [Sharper.caution]


def test_every_edit_has_its_options(polsep: Cli) -> None:
    """The command line has an option for every value of every edit, and --list tells of all."""
    options = {option for parameter in cli.app.commands["edit"].params for option in parameter.opts}
    listed = polsep("--list").out
    for name, kind in EDITS.items():
        first, *others = kind.parameters()
        assert {f"--{name}", *(f"--{name}-{p.name}" if p.kind != "mask" else "--mask" for p in others)} <= options
        assert f"{name}: {kind.title}" in listed and kind.light in listed
        assert first.text in listed


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["shot.exr"], ["expected an edit such as --metallic 1, or --recipe FILE, found none"]),
        (["--metallic", "1"], ["expected a separated frame or a folder of them, found nothing to edit"]),
        (["none.exr", "--rougher", "1"], ["none.exr: expected a file, found nothing at this path"]),
        (["shot.png", "--rougher", "1"], ["expected a separated frame (.exr, .npz), found '.png'"]),
        (["shot.exr", "--rougher", "51"], ["expected sigma from 0 to 50, found 51"]),
        (["shot.exr", "--metallic-gain", "3"], ["expected --metallic beside --metallic-gain, found none"]),
        (["shot.exr", "--tint", "1,2"], ["expected --tint R,G,B like 0.8,0.1,0.05, found '1,2'"]),
        (["shot.exr", "--tint", "1,2,x"], ["found '1,2,x'"]),
        (["shot.exr", "--texture", "no.png"], ["no.png: expected a file, found nothing at this path"]),
        (["shot.exr", "--texture", "shot.json"], ["shot.json: expected an image (.png", "found '.json'"]),
        (
            ["shot.exr", "--rougher", "1", "--mask", "small.png"],
            ["edit 1, rougher: expected mask", "found float32 [3, 3]"],
        ),
        (["shot.exr", "--rougher", "1", "--recipe", "r.json"], ["expected --recipe or edits as options, found both"]),
        (["shot.exr", "--recipe", "no.json"], ["no.json: expected a file, found nothing"]),
        (["shot.exr", "--recipe", "shot.json"], ['shot.json: expected "polsep_recipe": 1, found no such key']),
        (
            ["mono.exr", "--metallic", "1"],
            ["mono.exr: edit 1, metallic: expected images in colour", "found one channel"],
        ),
        (
            ["other.exr", "--rougher", "1"],
            ["other.exr: expected channels diffuse.R, .G and .B, or diffuse.Y, found a.Y"],
        ),
        (
            ["negative.npz", "--rougher", "1"],
            ["negative.npz: expected finite diffuse light of 0 or more, found 1 other"],
        ),
        (["other.npz", "--rougher", "1"], ["other.npz: expected arrays diffuse and specular, found a"]),
        (["torn.npz", "--rougher", "1"], ["torn.npz: expected an intact NPZ file, found damage"]),
        (["torn.exr", "--rougher", "1"], ["error: torn.exr: expected a complete single-part EXR file"]),
        (["shot.exr", "--rougher", "1", "-o", "."], ["expected outputs apart from inputs", "is an input"]),
        (["shot.exr", "--rougher", "1", "-o", "taken"], ["expected no taken/shot.exr", "--overwrite replaces it"]),
        (
            ["shot.exr", "a/shot.exr", "--rougher", "1"],
            ["expected inputs of different names, found shot.exr, a/shot.exr"],
        ),
        (["a", "--rougher", "1"], ["a: expected a sequence STEM_000123.exr or .npz, found none"]),
    ],
)
def test_bad_calls_leave_nothing(
    tmp_path: Path, polsep: Cli, monkeypatch: pytest.MonkeyPatch, args: list[str], words: list[str]
) -> None:
    """Exit status 2, one line, and the folder as it was."""
    monkeypatch.chdir(tmp_path)
    separated(tmp_path)
    separated(tmp_path, "mono", colors=1)
    png(tmp_path / "small.png", np.full((3, 3), 255, np.uint8))
    (tmp_path / "a").mkdir()
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "shot.exr").write_bytes(b"mine")
    plane = np.zeros((4, 4), np.float32)
    (tmp_path / "other.exr").write_bytes(encode_exr({"a.Y": plane}, {}))
    (tmp_path / "torn.exr").write_bytes((tmp_path / "shot.exr").read_bytes()[:100])
    np.savez(tmp_path / "other.npz", a=plane)
    images = random_images()
    np.savez(tmp_path / "negative.npz", diffuse=images.diffuse, specular=images.specular)
    (tmp_path / "torn.npz").write_bytes((tmp_path / "negative.npz").read_bytes()[:900])
    images.diffuse[0, 0, 0] = -1
    np.savez(tmp_path / "negative.npz", diffuse=images.diffuse, specular=images.specular)
    before = contents(tmp_path)
    assert_refused(polsep(*args), *words)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("overwrite", [(), ("--overwrite",)])
@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["shot.exr", "--rougher", "1", "--save-recipe", "out/shot.json"], "expected --save-recipe apart from"),
        (["film", "--rougher", "1", "--save-recipe", "out/../out/take.json"], "expected --save-recipe apart from"),
        (["shot.exr", "--rougher", "1", "--save-recipe", "shot.exr"], "shot.exr is an input"),
        (["shot.exr", "--rougher", "1", "--mask", "out/shot.png"], "shot.png is an input"),
        (["shot.exr", "--rougher", "1", "--mask", "out/shot.png", "--save-recipe", "out/shot.png"], "is an input"),
        (["film", "--texture", "out/take.png"], "take.png is an input"),
        (["film", "--texture", "out/take_000001.exr"], "take_000001.exr is an input"),
        (["shot.exr", "empty", "film", "--recipe", "out/take.json"], "take.json is an input"),
    ],
)
def test_results_do_not_replace_what_made_them(
    tmp_path: Path,
    polsep: Cli,
    monkeypatch: pytest.MonkeyPatch,
    args: list[str],
    words: str,
    overwrite: tuple[str, ...],
) -> None:
    """Recipes, masks and textures in the folder of the results are refused by name, before anything is written."""
    monkeypatch.chdir(tmp_path)
    separated(tmp_path)
    film(tmp_path / "film", 2)
    (tmp_path / "empty").mkdir()
    (tmp_path / "out").mkdir()
    for name in ("shot.png", "take.png"):
        png(tmp_path / "out" / name, np.full((21, 26), 255, np.uint8))
    write_exr(tmp_path / "out" / "take_000001.exr", Picture(*2 * [np.ones((4, 4, 3), np.float32)], None, {}), "none")
    recipe = recipe_as_text(Recipe((Rougher(sigma=2.0),)))
    (tmp_path / "out" / "take.json").write_text(recipe)
    before = contents(tmp_path)
    assert_refused(polsep(*args, "-o", "out", "--no-preview", *overwrite), words)
    assert contents(tmp_path) == before


def test_light_beyond_floats_is_refused(tmp_path: Path, polsep: Cli) -> None:
    """In a line, for whatever file; sharpening divided infinity by itself, with a warning of NumPy."""
    images = np.full((4, 4, 3), 3e38, np.float32)
    np.savez(tmp_path / "bright.npz", diffuse=images, specular=images)
    for edit in (("--sharper", "2"), ("--metallic", "1")):
        run = polsep(tmp_path / "bright.npz", "-o", tmp_path / "out", *edit)
        assert run.status == 2 and run.out == ""
        assert run.err.splitlines()[-1].endswith("expected light that 32-bit floats hold after the edits, found more")
    assert not (tmp_path / "out").exists()


def test_a_black_mask_is_refused(tmp_path: Path, polsep: Cli) -> None:
    """It would edit nothing, without a word."""
    mask = png(tmp_path / "mask.png", np.zeros((4, 4), np.uint8))
    run = polsep(separated(tmp_path), "-o", tmp_path / "out", "--rougher", "2", "--mask", mask)
    assert_refused(run, "mask.png: expected a mask that holds pixels, found none")


def test_good_files_go_on_beside_bad_ones(tmp_path: Path, polsep: Cli) -> None:
    """One bad frame costs exit status 2, not the others."""
    good, bad = separated(tmp_path), tmp_path / "bad.exr"
    bad.write_bytes(b"nothing")
    run = polsep(bad, good, "-o", tmp_path / "out", "--rougher", "1")
    assert run.status == 2 and "bad.exr: expected" in run.err and "shot.exr ->" in run.out
    assert sorted(contents(tmp_path / "out")) == ["shot.exr", "shot.json", "shot.png"]
    assert polsep(good, "-o", tmp_path / "out", "--rougher", "2", "--overwrite").status == 0


# Sequences.


def test_sequences_are_edited_frame_by_frame(tmp_path: Path, polsep: Cli) -> None:
    """Every frame is what the edit makes of it, in half floats; numbers stay; nothing else is left."""
    folder = film(tmp_path / "in", first=7)
    run = polsep(folder, "-o", tmp_path / "out", "--metallic", "1", "--no-preview")
    assert run.status == 0 and run.err == ""
    frames = {f"take_{7 + k:06d}.exr" for k in range(COUNT)}
    assert set(contents(tmp_path / "out")) == frames | {"take.json", "take.jsonl", "take.png"}
    assert run.out.splitlines() == [str(tmp_path / "out" / f"take.{s}") for s in ("png", "jsonl", "json")]
    for k in (0, COUNT - 1):
        name = f"take_{7 + k:06d}.exr"
        frame = read_separated(folder / name)
        expected = only(Metallic(), SeparatedImages(frame.diffuse, frame.specular))
        for layer in ("diffuse", "specular", "combined"):
            found = image_of(tmp_path / "out" / name, layer)
            np.testing.assert_allclose(found, getattr(expected, layer), rtol=1e-3, atol=1e-6)
    report = json.loads((tmp_path / "out" / "take.json").read_text())
    assert report["frames"] == COUNT and report["damaged"] == []
    assert report["settings"]["recipe"]["edits"][0]["gain"] == 45.0
    lines = [json.loads(line) for line in (tmp_path / "out" / "take.jsonl").read_text().splitlines()]
    assert [line["frame"] for line in lines] == list(range(7, 7 + COUNT))


def test_stopped_runs_go_on_with_the_same_bytes(tmp_path: Path) -> None:
    """Stopped after any frame, in the first part or behind it, and begun again: the files of a run that was not."""
    folder, work = film(tmp_path / "in"), Work(Recipe((Rougher(sigma=2.0),)))
    list(edit_sequence(folder, work, EditTarget(tmp_path / "whole", kind=SILENT)))
    whole = contents(tmp_path / "whole")
    for stop in (3, PART + 2):
        target = EditTarget(tmp_path / f"stopped{stop}", kind=SILENT)
        with closing(edit_sequence(folder, work, target)) as steps:
            assert len(list(islice(steps, stop))) == stop
        assert not (target.directory / "take.json").exists()
        assert next(edit_sequence(folder, work, target)).done == (PART if stop > PART else 0)
        list(edit_sequence(folder, work, target))
        assert contents(target.directory) == whole


def test_a_run_that_damage_stopped_goes_on_without_the_frame(tmp_path: Path) -> None:
    """No byte of what is done depends on how damage is met."""
    folder, work = film(tmp_path / "in"), Work(Recipe((Rougher(sigma=2.0),)))
    path = sorted(folder.glob("*.exr"))[PART + 2]
    path.write_bytes(b"damaged")
    target = EditTarget(tmp_path / "out", kind=SILENT)
    with pytest.raises(InputError):
        list(edit_sequence(folder, work, target))
    steps = list(edit_sequence(folder, work, replace(target, damaged="skip")))
    assert steps[0].done == PART and steps[-1].damaged and steps[-1].written


def test_films_that_were_separated_anew_are_not_mixed(tmp_path: Path) -> None:
    """Their first frames may be equal: a filter changes only later ones. The report tells them apart."""
    folder, work = film(tmp_path / "in"), Work(Recipe((Rougher(sigma=2.0),)))
    report = folder / "take.json"
    report.write_text('{"settings": {"filter": "temporal"}}')
    target = EditTarget(tmp_path / "out", kind=SILENT)

    def stop() -> None:
        with closing(edit_sequence(folder, work, target)) as steps:
            list(islice(steps, PART + 2))

    stop()
    report.write_text('{"settings": {"filter": "none"}}')
    with pytest.raises(OutputError, match=r"expected film take\.json .* was begun, found film take\.json"):
        next(edit_sequence(folder, work, target))
    report.unlink()
    target = replace(target, directory=tmp_path / "other")
    stop()
    images = random_images(99)
    write_exr(folder / "take_000000.exr", Picture(images.diffuse, images.specular, None, {}), "none")
    with pytest.raises(OutputError, match=r"expected film take_000000\.exr .* was begun"):
        next(edit_sequence(folder, work, target))


def test_other_settings_are_not_mixed(tmp_path: Path) -> None:
    """A run begun with another recipe is not gone on with; finished results and strange frames are not replaced."""
    folder = film(tmp_path / "in", 3)
    target = EditTarget(tmp_path / "out", kind=SILENT)
    with closing(edit_sequence(folder, Work(Recipe((Rougher(sigma=2.0),))), target)) as steps:
        next(steps)
    other = Work(Recipe((Rougher(sigma=3.0),)))
    with pytest.raises(OutputError, match=r"recipe edits .*--overwrite begins anew"):
        list(edit_sequence(folder, other, target))
    list(edit_sequence(folder, other, EditTarget(tmp_path / "out", overwrite=True, kind=SILENT)))
    with pytest.raises(OutputError, match=r"expected no .*found one from before"):
        list(edit_sequence(folder, other, target))
    film(tmp_path / "strange", 3)
    with pytest.raises(OutputError, match=r"expected no .*take_000000.exr, found one from before"):
        list(edit_sequence(folder, other, EditTarget(tmp_path / "strange", kind=SILENT)))
    before = contents(folder)
    with pytest.raises(OutputError, match="expected another directory than that of the input"):
        list(edit_sequence(folder, other, EditTarget(folder, overwrite=True, kind=SILENT)))
    assert contents(folder) == before


def test_gaps_and_damage_are_never_silent(tmp_path: Path, polsep: Cli) -> None:
    """A missing frame, a torn one and one of another size end a run, or are named, left out, and cost status 2."""
    folder = film(tmp_path / "in", 6)
    os.remove(folder / "take_000002.exr")
    assert_refused(polsep(folder, "-o", tmp_path / "a", "--rougher", "1", "--no-preview"), "found none of number 2;")
    assert not (tmp_path / "a").exists()
    (folder / "take_000000.exr").write_bytes(b"torn")
    small = random_images(size=(5, 6))
    write_exr(folder / "take_000004.exr", Picture(small.diffuse, small.specular, None, {}), "none")
    run = polsep(folder, "-o", tmp_path / "b", "--rougher", "1", "--no-preview", "--damaged", "skip")
    assert run.status == 2
    for number in (0, 2, 4):
        assert f"frame {number} is left out: " in run.err
    assert [p for p in sorted(contents(tmp_path / "b")) if p.endswith(".exr")] == [
        f"take_{k:06d}.exr" for k in (1, 3, 5)
    ]
    report = json.loads((tmp_path / "b" / "take.json").read_text())
    assert [line["frame"] for line in report["damaged"]] == [0, 2, 4]
    write_exr(folder / "take_000002.exr", Picture(small.diffuse, small.specular, None, {}), "none")
    assert_refused(polsep(folder, "-o", tmp_path / "c", "--rougher", "1", "--no-preview"), "take_000000.exr: expected")
    os.remove(folder / "take_000000.exr")
    assert_refused(polsep(folder, "-o", tmp_path / "c", "--rougher", "1", "--no-preview"), "found [5, 6, 3]")


def test_a_gap_of_an_earlier_run_still_counts(tmp_path: Path) -> None:
    """A run that leaves a frame out, is stopped behind it and goes on, ends as damaged: the command fails."""
    folder, work = film(tmp_path / "in"), Work(Recipe((Rougher(sigma=2.0),)))
    os.remove(folder / "take_000003.exr")
    target = EditTarget(tmp_path / "out", kind=SILENT, damaged="skip")
    with closing(edit_sequence(folder, work, target)) as steps:
        assert sum(step.damaged for step in islice(steps, PART + 2)) == 1
    *again, last = edit_sequence(folder, work, target)
    assert again[0].done == PART and not any(step.damaged for step in again)
    assert last.written and last.damaged
    film(tmp_path / "whole", 3)
    assert not list(edit_sequence(tmp_path / "whole", work, EditTarget(tmp_path / "fine", kind=SILENT)))[-1].damaged


def test_a_film_that_is_not_finished_is_said(tmp_path: Path, polsep: Cli) -> None:
    """As `polsep video` leaves it where it was stopped; its frames so far are edited."""
    folder = film(tmp_path / "in", 3)
    (folder / ".polsep-take").mkdir()
    run = polsep(folder, "-o", tmp_path / "out", "--rougher", "1", "--no-preview")
    assert run.status == 0 and "in: the run that writes it is not finished, " in run.err
    assert json.loads((tmp_path / "out" / "take.json").read_text())["warnings"] == [run.err.strip()[len("polsep: ") :]]
    (folder / "take.json").write_text("{}")
    assert not polsep(folder, "-o", tmp_path / "finished", "--rougher", "1", "--no-preview").err


def test_good_folders_go_on_beside_bad_ones(tmp_path: Path, polsep: Cli) -> None:
    """A folder with a gap costs a line and exit status 2, not the next folder; nor does a folder without a sequence."""
    gap, good, empty = film(tmp_path / "gap", 4), tmp_path / "good", tmp_path / "empty"
    os.remove(gap / "take_000001.exr")
    empty.mkdir()
    film(good, 3, stem="other")
    run = polsep(gap, empty, good, "-o", tmp_path / "out", "--rougher", "1", "--no-preview")
    first, second = run.err.splitlines()
    assert run.status == 2 and first.startswith(f"polsep: error: {gap}: expected frames without gaps, found none of")
    assert second.startswith(f"polsep: error: {empty}: expected a sequence")
    assert run.out.splitlines() == [str(tmp_path / "out" / f"other.{s}") for s in ("png", "jsonl", "json")]
    assert json.loads((tmp_path / "out" / "other.json").read_text())["settings"]["source"] == "good"


@pytest.mark.parametrize(
    ("inputs", "shared"),
    [
        (["a", "b"], "take.png"),
        (["take.exr", "a"], "take.png"),
        (["take_000001.exr", "a"], "take_000001.exr"),
        (["a", "a"], "take_000000.exr"),
    ],
)
def test_inputs_of_one_name_are_refused(
    tmp_path: Path, polsep: Cli, monkeypatch: pytest.MonkeyPatch, inputs: list[str], shared: str
) -> None:
    """Folders and files whose results would replace each other's, also with --overwrite, before any work."""
    monkeypatch.chdir(tmp_path)
    film(tmp_path / "a", 2)
    film(tmp_path / "b", 2, first=5)
    for stem in ("take", "take_000001"):
        separated(tmp_path, stem)
    before = contents(tmp_path)
    run = polsep(*inputs, "-o", "out", "--rougher", "1", "--no-preview", "--overwrite")
    same = f"found {inputs[0]}, {inputs[1]}: both would write {Path('out', shared)}"
    assert_refused(run, f"expected inputs of different names, {same}")
    assert contents(tmp_path) == before


def test_films_to_watch(tmp_path: Path, polsep: Cli) -> None:
    """With the extra video, a sequence gets its film."""
    pytest.importorskip("av", reason="needs the extra 'video'")
    folder = film(tmp_path / "in", 3)
    assert polsep(folder, "-o", tmp_path / "out", "--rougher", "1").status == 0
    assert (tmp_path / "out" / "take_preview.mp4").stat().st_size > 500


def test_sequences_are_found(tmp_path: Path) -> None:
    """Numbers count as numbers, holes are known, and two sequences are not one."""
    for name in ("a_0008.npz", "a_0010.npz", "note.txt", "a.exr"):
        (tmp_path / name).touch()
    found = find_numbered(tmp_path)
    assert (found.stem, found.first, found.missing()) == ("a", 8, [9])
    (tmp_path / "a_00010.npz").touch()
    with pytest.raises(InputError, match="expected each number once"):
        find_numbered(tmp_path)
    os.remove(tmp_path / "a_00010.npz")
    (tmp_path / "b_0001.exr").touch()
    with pytest.raises(InputError, match=r"expected one sequence, found 2: a.npz, b.exr"):
        find_numbered(tmp_path)


def test_hidden_files_are_no_sequence(tmp_path: Path) -> None:
    """macOS leaves ._NAME beside each file on other disks; they do not count."""
    for name in ("film_000001.exr", "._film_000001.exr", "film_000002.exr", "._film_000002.exr"):
        (tmp_path / name).touch()
    found = find_numbered(tmp_path)
    assert (found.stem, found.first) == ("film", 1)
    assert [path.name for path in found.files if path is not None] == ["film_000001.exr", "film_000002.exr"]


def test_times_are_no_numbers_of_frames(tmp_path: Path) -> None:
    """Numbers far apart are refused at once, without a place for each in between; a gap of a thousand is one."""
    for name in ("cam_0001.exr", "cam_1020.exr"):
        (tmp_path / name).touch()
    assert len(find_numbered(tmp_path).missing()) == 1018
    os.rename(tmp_path / "cam_1020.exr", tmp_path / "cam_1021.exr")
    with pytest.raises(InputError, match=r"expected consecutive numbers, found 2 from 1 to 1021; name single files"):
        find_numbered(tmp_path)
    (tmp_path / "cam_1021.exr").unlink()
    (tmp_path / "cam_1699999999123456789.exr").touch()
    with pytest.raises(InputError, match=r"found 2 from 1 to 1699999999123456789"):
        find_numbered(tmp_path)


def test_targets_are_checked(tmp_path: Path) -> None:
    """Kinds of sequences that edits do not write."""
    with pytest.raises(ValueError, match="expected exr as format"):
        EditTarget(tmp_path, kind=SequenceKind("ffv1"))
    with pytest.raises(ValueError, match="expected stop or skip"):
        EditTarget(tmp_path, damaged="guess")


# Images that edits name.


def test_textures_are_decoded_once(tmp_path: Path) -> None:
    """8 bits are sRGB, everything else is linear; the decoding is the inverse of the previews' encoding."""
    codes = np.arange(256, dtype=np.uint8).reshape(16, 16)
    eight = read_map(png(tmp_path / "a.png", codes), "texture")
    assert eight.shape == (16, 16, 1)
    assert np.array_equal(np.rint(255 * srgb(eight[..., 0])), codes)
    sixteen = read_map(png(tmp_path / "b.png", codes.astype(np.uint16) * 257), "texture")
    np.testing.assert_allclose(sixteen[..., 0], codes / 255, atol=1e-7)
    np.save(tmp_path / "c.npy", eight)
    planes = dict(zip("RGB", np.repeat(eight, 3, axis=2).transpose(2, 0, 1), strict=True))
    (tmp_path / "d.exr").write_bytes(encode_exr(planes, {}))
    assert np.array_equal(read_map(tmp_path / "c.npy", "texture"), eight)
    assert np.array_equal(read_map(tmp_path / "d.exr", "texture"), np.repeat(eight, 3, axis=2))
    stream = io.BytesIO()
    Image.new("RGB", (8, 8), (188, 188, 188)).save(stream, "JPEG", quality=95)
    (tmp_path / "e.jpg").write_bytes(stream.getvalue())
    np.testing.assert_allclose(read_map(tmp_path / "e.jpg", "texture"), linear_from_srgb(188 / 255), atol=0.01)


@pytest.mark.parametrize(("orientation", "turns"), [(1, 0), (3, 2), (6, 3), (8, 1)])
def test_photographs_are_turned_upright(tmp_path: Path, orientation: int, turns: int) -> None:
    """By the EXIF data of the JPEG, as people see them; masks too."""
    stored = np.zeros((16, 32), np.uint8)
    stored[:8, :8] = 255
    exif = Image.Exif()
    exif[274] = orientation
    Image.fromarray(stored).save(tmp_path / "a.jpg", quality=95, exif=exif)
    for kind in ("texture", "mask"):
        found = read_map(tmp_path / "a.jpg", kind).reshape(np.rot90(stored, turns).shape)
        np.testing.assert_array_equal(found > 0.5, np.rot90(stored, turns) > 0)


@pytest.mark.parametrize("bits", [12, 16])
def test_white_is_the_largest_value_of_the_bits(tmp_path: Path, bits: int) -> None:
    """Of 12 bits 4095 is 1: textures, masks, and normals."""
    white = 2**bits - 1
    grey, ball = np.linspace(0, 1, 64, dtype=np.float32).reshape(8, 8), sphere()
    tifffile.imwrite(tmp_path / "g.tiff", np.rint(grey * white).astype(np.uint16), bitspersample=bits)
    for kind in ("texture", "mask"):
        np.testing.assert_allclose(read_map(tmp_path / "g.tiff", kind).reshape(8, 8), grey, atol=1e-3)
    codes = np.rint((ball + 1) / 2 * white).astype(np.uint16)
    tifffile.imwrite(tmp_path / "n.tiff", codes, bitspersample=bits, photometric="rgb")
    found, solid = read_map(tmp_path / "n.tiff", "normals"), ball[..., 2] > 0.05
    np.testing.assert_allclose(found[solid], ball[solid], atol=1e-3)


def test_masks_and_normals_are_read(tmp_path: Path) -> None:
    """Masks are never decoded; normals come back as unit vectors, and none where there are none."""
    mask = np.array([[0, 51], [102, 255]], np.uint8)
    np.testing.assert_allclose(read_map(png(tmp_path / "m.png", mask), "mask"), mask / 255, atol=1e-7)
    rgb = png(tmp_path / "rgb.png", np.repeat(mask[..., None], 3, axis=2))
    np.testing.assert_allclose(read_map(rgb, "mask"), mask / 255, atol=1e-7)
    ball = sphere()
    codes = np.rint((ball + 1) / 2 * 65535).astype(np.uint16)
    found = read_map(png(tmp_path / "n.png", codes), "normals")
    solid = ball[..., 2] > 0.01
    np.testing.assert_allclose(found[solid], ball[solid], atol=1e-4)
    assert not found[ball[..., 2] == 0].any()
    assert not found.flags.writeable
    np.save(tmp_path / "n.npy", ball * 0.9)
    np.testing.assert_allclose(read_map(tmp_path / "n.npy", "normals")[solid], ball[solid], atol=1e-6)


@pytest.mark.parametrize(
    ("array", "kind", "said"),
    [
        (np.full((2, 2, 3), [1, 2, 3], np.uint8), "mask", "expected a grey image as mask, found colours"),
        (np.array([[0, 1], [1, 0]], np.uint8), "mask", "expected a mask of codes from 0 to 255, found none above 1"),
        (np.full((2, 2), 1.5, np.float32), "mask", r"expected a mask in \[0, 1\], found 1.5 to 1.5"),
        (np.full((2, 2), np.nan, np.float32), "mask", r"expected a mask in \[0, 1\], found nan"),
        (np.full((2, 2), np.inf, np.float32), "texture", "expected finite values"),
        (np.full((2, 2), -1, np.float32), "texture", "expected reflectance of 0 or more, found -1"),
        (np.zeros((2, 2), np.int32), "texture", "expected unsigned integers or floats, found int32"),
        (np.zeros((2, 2), np.float32), "normals", "expected normals of three channels"),
        (np.zeros((3, 2, 2), np.float32), "texture", "expected one image, found 3"),
        (np.zeros((2, 2, 4), np.float32), "texture", "expected an image of 1 or 3 channels"),
    ],
)
def test_bad_images_are_refused(tmp_path: Path, array: NDArray[Any], kind: str, said: str) -> None:
    """In one line that names the file."""
    np.save(tmp_path / "x.npy", array)
    with pytest.raises(InputError, match=rf"^{tmp_path / 'x.npy'}: {said}"):
        read_map(tmp_path / "x.npy", kind)


@pytest.mark.parametrize("kind", ["texture", "mask"])
def test_a_matte_in_the_alpha_channel_is_not_left_out(tmp_path: Path, kind: str) -> None:
    """Programs write one with colours, or beside white: refused, unless it is even or what the colours are."""
    matte = np.eye(8, dtype=np.float32)

    def written(light: NDArray[Any], alpha: NDArray[Any]) -> Path:
        (tmp_path / "m.exr").write_bytes(encode_exr({**dict.fromkeys("RGB", light), "A": alpha}, {}))
        return tmp_path / "m.exr"

    with pytest.raises(InputError, match=r"m\.exr: expected an image without alpha, found a channel A from 0 to 1"):
        read_map(written(np.ones_like(matte), matte), kind)
    for alpha in (matte, np.ones_like(matte), np.zeros_like(matte)):
        found = read_map(written(matte, alpha), kind)
        assert (found.reshape(8, 8, -1) == matte[..., None]).all()


@pytest.mark.parametrize("suffix", ["png", "jpg", "exr", "npy", "tiff"])
def test_files_of_another_kind_are_refused(tmp_path: Path, suffix: str) -> None:
    """Once by name, in one line."""
    path = tmp_path / f"x.{suffix}"
    path.write_bytes(b"hello")
    with pytest.raises(InputError, match=rf"^{path}: expected a") as caught:
        read_map(path, "texture")
    assert str(caught.value).count(path.name) == 1
    with pytest.raises(InputError, match=r"expected a file, found nothing") as caught:
        read_map(tmp_path / f"none.{suffix}", "texture")
    assert str(caught.value).count("none") == 1


def test_work_names_its_files(tmp_path: Path) -> None:
    """Images are found from the recipe's folder, and known by their hash."""
    png(tmp_path / "t.png", np.zeros((2, 2), np.uint8))
    work = load_work(Recipe((Texture(image="t.png"),)), tmp_path)
    assert work.maps["t.png"].shape == (2, 2, 1)
    assert len(work.as_data()["images"]["t.png"]) == 64
