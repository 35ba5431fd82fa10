"""The command line end to end: everything asked for is written, or one line says why not and nothing is left."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import click
import imagecodecs
import numpy as np
import pytest
import tifffile
import torch
from numpy.typing import NDArray
from test_bad_input import FILES

from polsep import batch, cli
from polsep.cli.app import RATE, app, has_extra, print_note
from polsep.cli.progress import Progress
from polsep.io.raw.genicam import pack_frame
from polsep.io.results.exr import read_exr_layers
from polsep.io.results.separation_writer import FORMATS, LAYERS
from polsep.io.store.atomic import OutputError
from polsep.methods import BEST, METHODS
from polsep.networks.engines import ENGINES
from polsep.physics.stokes import Stokes
from polsep.sensor.camera import IDEAL, Layout, expose
from polsep.shipped import NAMES

COLOR_LAYERS = {f"{image}.{color}" for image in ("diffuse", "specular") for color in "RGB"}
MAPS = {"dolp.Y", "aolp.Y", "valid.Y"}
#: The lamp, which small frames do not show.
WHITE = ("--light-color", "white")
LINE = re.compile(r"polsep: error: [^\n]+\n")

pytestmark = pytest.mark.usefixtures("compiled")


class Run(NamedTuple):
    """What a command left behind."""

    status: int
    out: str
    err: str


Cli = Callable[..., Run]


@pytest.fixture
def polsep(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Cli:
    """Run `polsep ARGS` inside this process."""

    return partial(run_here, monkeypatch, capfd)


def run_here(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], *args: str | Path) -> Run:
    """Run `polsep ARGS` inside this process."""
    monkeypatch.setattr(sys, "argv", ["polsep", *map(str, args)])
    monkeypatch.setattr("polsep.cli.progress.EVERY_S", 1e6)  # no lines on progress, however busy the machine is
    capfd.readouterr()
    status: Any = 0
    try:
        cli.main()
    except SystemExit as stop:
        status = stop.code
    return Run(status or 0, *capfd.readouterr())


def subprocess_run(*args: str | Path, **options: Any) -> Run:
    """Run `polsep ARGS` as a shell would."""
    command = [sys.executable, "-c", "from polsep.cli import main; main()", *map(str, args)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, **options)
    return Run(done.returncode, done.stdout, done.stderr)


def frame(seed: int = 0, layout: Layout | None = None, size: int = 32) -> NDArray[np.uint16]:
    """A coloured mosaic with white highlights of one angle, in 16-bit codes."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 4, 4, 4, generator=generator)
    fine = torch.nn.functional.interpolate(coarse, size=(size, size), mode="bilinear")[0]
    diffuse, specular = 0.2 + 0.5 * fine[:3], 0.7 * fine[3:]
    stokes = Stokes(diffuse + specular, (0.8 * specular).expand(3, -1, -1), (0.6 * specular).expand(3, -1, -1))
    signal = expose(stokes, layout or Layout(), IDEAL).data
    return torch.round(signal * 65535).to(torch.int32).numpy().astype(np.uint16)


def png(path: Path, array: NDArray[Any]) -> Path:
    path.write_bytes(imagecodecs.png_encode(array))
    return path


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, hidden ones too."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def assert_refused(run: Run, *words: str) -> None:
    """Exit status 2, nothing on stdout, one line on stderr that starts with the program's name and says why."""
    assert run.status == 2, run
    assert run.out == "", run
    assert LINE.fullmatch(run.err), run.err
    for word in words:
        assert word in run.err


def test_help_of_every_command(polsep: Cli) -> None:
    """--help and -h exit 0 and name every option; no command at all shows the help and exits 2."""
    assert polsep("--help").out.startswith("Usage: ")
    for name, command in cli.app.commands.items():
        for flag in ("--help", "-h"):
            run = polsep(name, flag)
            assert run.status == 0 and run.err == ""
            assert all(option in run.out for p in command.params for option in p.opts if option.startswith("--"))
        assert name in polsep("--help").out
    lists = [polsep(*group, "--help").out.partition("Commands:")[2] for group in ([], ["calibrate"])]
    assert all(lists) and "..." not in "".join(lists)  # no sentence is cut
    bare = polsep()
    assert bare.status == 2 and "Usage: " in bare.out


def test_version_and_methods(polsep: Cli) -> None:
    """--version names the version; methods lists every method once and marks the automatic one."""
    assert re.fullmatch(r"polsep \d+\.\d+\S*\n", polsep("--version").out)
    listed = polsep("methods")
    assert listed.status == 0
    assert [name for name in METHODS if re.search(rf"^{name}( |$)", listed.out, re.MULTILINE)] == list(METHODS)
    assert listed.out.count("(auto)") == 1


def test_separate_writes_the_contract(tmp_path: Path) -> None:
    """A shell's `polsep separate` writes the layers of the contract, a preview and a sidecar, and says where."""
    source = png(tmp_path / "shot.png", frame(size=80))
    run = subprocess_run("separate", source, "-o", tmp_path / "out")
    assert run.status == 0, run
    assert run.err == ""
    files, facts = run.out.splitlines()
    assert files == f"{source} -> " + ", ".join(str(tmp_path / "out" / f"shot.{s}") for s in ("exr", "png", "json"))
    assert re.fullmatch(rf"  {BEST[0].name}; .* clipped; light: polarizer at \d+ deg, colour .*; no warnings", facts)
    layers = read_exr_layers(tmp_path / "out" / "shot.exr")
    errors = {"error.diffuse", "error.specular"} if BEST[0].name in NAMES else set()
    assert set(layers) == COLOR_LAYERS | MAPS | errors | set("RGB")
    assert {image.shape for image in layers.values()} == {(40, 40)}
    preview = imagecodecs.png_decode((tmp_path / "out" / "shot.png").read_bytes())
    assert preview.ndim == 3 and preview.dtype == np.uint8
    sidecar = json.loads((tmp_path / "out" / "shot.json").read_text())
    assert sidecar["source"] == "shot.png" and sidecar["report"]["method"] == BEST[0].name
    for entry in sidecar["files"]:
        assert hashlib.sha256((tmp_path / "out" / entry["name"]).read_bytes()).hexdigest() == entry["sha256"]


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize("layout", ["color", "mono"])
def test_every_format_of_both_sensors(tmp_path: Path, polsep: Cli, format: str, layout: str) -> None:
    """Each --format writes its documented files and nothing else, for colour and mono."""
    mosaic = frame(layout=Layout.parse(layout))
    run = polsep(
        "separate", png(tmp_path / "a.png", mosaic), "-o", tmp_path / "o", "--format", format, "--layout", layout
    )
    assert run.status == 0, run
    layers = {*LAYERS, "error"} if BEST[0].name in NAMES else set(LAYERS)
    images = {f"a_{layer}.{format}" for layer in layers} if format in ("tiff", "png") else {f"a.{format}"}
    assert set(contents(tmp_path / "o")) == images | {"a.png", "a.json"}
    if format == "npz":
        arrays = np.load(tmp_path / "o" / "a.npz")
        assert set(arrays.files) == layers
        assert arrays["diffuse"].shape == (16, 16, 3 if layout == "color" else 1)
    if format == "exr" and layout == "mono":
        expected = {"error.diffuse", "error.specular"} if "error" in layers else set()
        assert set(read_exr_layers(tmp_path / "o" / "a.exr")) == {"diffuse.Y", "specular.Y", "Y"} | MAPS | expected


@pytest.mark.parametrize("method", ["auto", *METHODS])
def test_every_method_and_full_resolution(tmp_path: Path, polsep: Cli, method: str) -> None:
    """--method runs the method it names, and --full gives an image of the raw size."""
    source = png(tmp_path / "a.png", frame())
    run = polsep("separate", source, "-o", tmp_path / "o", "--method", method, "--full")
    assert run.status == 0, run
    assert read_exr_layers(tmp_path / "o" / "a.exr")["diffuse.G"].shape == (32, 32)
    report = json.loads((tmp_path / "o" / "a.json").read_text())["report"]
    assert report["method"] == (BEST[0].name if method == "auto" else method) and report["full_resolution"]


def test_pages_become_numbered_frames(tmp_path: Path, polsep: Cli) -> None:
    """A TIFF of three pages gives three results, numbered from 0."""
    tifffile.imwrite(tmp_path / "run.tiff", np.stack([frame(k) for k in range(3)]), photometric="minisblack")
    run = polsep("separate", tmp_path / "run.tiff", "-o", tmp_path / "o")
    assert run.status == 0 and len(run.out.splitlines()) == 6
    assert set(contents(tmp_path / "o")) == {f"run_000{k}.{s}" for k in range(3) for s in ("exr", "png", "json")}


def test_four_angle_images(tmp_path: Path, polsep: Cli) -> None:
    """A template with {angle} and a stack of four pages are the same capture, and give the same images."""
    planes = [frame(k % 2)[:24, :20] for k in range(4)]
    for angle, plane in zip((0, 45, 90, 135), planes, strict=True):
        png(tmp_path / f"nir_{angle}.png", plane)
    tifffile.imwrite(tmp_path / "stack.tiff", np.stack(planes), photometric="minisblack")
    common = ("-o", tmp_path / "o", "--layout", "mono", "--format", "npz")
    run = polsep("separate", tmp_path / "nir_{angle}.png", *common)
    assert run.status == 0 and "{angle}" not in run.err
    assert polsep("separate", tmp_path / "stack.tiff", "--pages", "angles", *common).status == 0
    one, other = np.load(tmp_path / "o" / "nir.npz"), np.load(tmp_path / "o" / "stack.npz")
    assert one["diffuse"].shape == (24, 20, 1)
    for layer in LAYERS:
        assert np.abs(one[layer].astype(float) - other[layer]).max() == 0
    run = polsep("separate", *sorted(tmp_path.glob("nir_*.png")), *common)
    assert run.status == 0 and "nir_{angle}.png' makes one frame of four angles" in run.err


def test_headerless_raw_is_the_png(tmp_path: Path, polsep: Cli) -> None:
    """A packed dump of the codes of a PNG gives the same images."""
    codes = frame() >> 4
    png(tmp_path / "a.png", codes)
    (tmp_path / "b.raw").write_bytes(pack_frame(codes, "BayerRG12p"))
    common = ("-o", tmp_path / "o", "--format", "npz")
    assert polsep("separate", tmp_path / "a.png", "--white-level", "4095", *common).status == 0
    raw = ("--size", "32x32", "--pixel-format", "BayerRG12p")
    assert polsep("separate", tmp_path / "b.raw", *raw, *common).status == 0
    one, other = np.load(tmp_path / "o" / "a.npz"), np.load(tmp_path / "o" / "b.npz")
    for layer in LAYERS:
        assert np.abs(one[layer].astype(float) - other[layer]).max() == 0


def test_same_command_same_bytes(tmp_path: Path, polsep: Cli) -> None:
    """Outputs depend on the input and the options alone: a second run writes the same bytes."""
    source = png(tmp_path / "a.png", frame())
    for folder in ("one", "two"):
        assert polsep("separate", source, "-o", tmp_path / folder).status == 0
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_warnings_are_lines_on_stderr(tmp_path: Path, polsep: Cli) -> None:
    """What the owner should know is said once, on stderr, with the file's name; stdout stays for results."""
    odd = frame()[:, :-1]
    run = polsep("separate", png(tmp_path / "odd.png", odd), "-o", tmp_path / "o", *WHITE)
    assert run.status == 0
    assert run.err.startswith(f"polsep: {tmp_path / 'odd.png'}: size 31x32 cuts polarizer cells")
    assert run.err.count("\n") == 1 and run.out.splitlines()[1].endswith("; 1 warning")


def test_forgotten_white_level_is_refused(tmp_path: Path, polsep: Cli) -> None:
    """12-bit values in 16-bit words without their white level: refused before anything is written, with what to say.

    A dark frame beside frames that use the range of their type is only warned of.
    """
    dim = png(tmp_path / "dim.png", frame() >> 4)
    assert_refused(
        polsep("separate", dim, "-o", tmp_path / "o"), "dim.png", "--white-level 4095", "--white-level 65535"
    )
    assert not (tmp_path / "o").exists()
    for level in ("4095", "65535"):
        run = polsep("separate", dim, "-o", tmp_path / level, "--white-level", level)
        assert run.status == 0 and "--white-level" not in run.err
    clipped = np.where(np.arange(32)[:, None] < 16, 65535, frame()).astype(np.uint16)  # which has a note of its own
    for name, codes in (("bright", frame()), ("over", clipped)):
        run = polsep("separate", png(tmp_path / f"{name}.png", codes), dim, "-o", tmp_path / name)
        assert run.status == 0 and "--white-level 4095 if so" in run.err
    eight = png(tmp_path / "eight.png", (frame() >> 8).astype(np.uint8))  # whose white level is another one
    run = polsep("separate", eight, dim, "-o", tmp_path / "o")
    assert run.status == 2 and "expected a white level" in run.err and not list((tmp_path / "o").glob("dim*"))
    for name, codes in (("eight", (frame() >> 8).astype(np.uint8)), ("dark", frame() >> 4)):  # angle images, too
        np.save(tmp_path / f"{name}.npy", np.stack([np.stack([codes] * 3, -1)] * 4))
    run = polsep(
        "separate", tmp_path / "eight.npy", tmp_path / "dark.npy", "-o", tmp_path / "p", "--method", "analytic"
    )
    assert run.status == 2 and "expected a white level" in run.err and not list((tmp_path / "p").glob("dark*"))


def test_folders_are_separated(tmp_path: Path, polsep: Cli) -> None:
    """A folder stands for its frames: single files in natural order, and four angle images as one frame."""
    (tmp_path / "in").mkdir()
    for name in ("shot10", "shot9", *(f"set_{angle}" for angle in (0, 45, 90, 135))):
        png(tmp_path / "in" / f"{name}.png", frame())
    run = polsep("separate", tmp_path / "in", "-o", tmp_path / "o", "--method", "analytic")
    assert run.status == 0, run
    sources = [line.split(" -> ")[0] for line in run.out.splitlines() if " -> " in line]
    assert sources == [str(tmp_path / "in" / name) for name in ("set_{angle}.png", "shot9.png", "shot10.png")]
    (tmp_path / "none").mkdir()
    assert_refused(polsep("separate", tmp_path / "none", "-o", tmp_path / "o"), "expected a folder of frames")
    run = polsep("separate", tmp_path / "none", png(tmp_path / "good.png", frame()), "-o", tmp_path / "beside")
    assert run.status == 2 and "expected a folder of frames" in run.err and (tmp_path / "beside" / "good.exr").exists()


def test_results_beside_their_frames_are_no_frames(tmp_path: Path, polsep: Cli) -> None:
    """Previews of frames that are no PNG files lie beside them; a raw frame beside the results of its name is one."""
    (tmp_path / "shot.tiff").write_bytes(imagecodecs.tiff_encode(frame()))
    words = ("-o", tmp_path, "--method", "analytic", "--overwrite")
    for _ in range(2):
        run = polsep("separate", tmp_path, *words)
        assert run.status == 0 and run.out.count(" -> ") == 1, run
    (tmp_path / "shot.tiff").unlink()
    png(tmp_path / "shot.png", frame())
    run = polsep("separate", tmp_path, "-o", tmp_path / "o", "--method", "analytic")
    assert run.status == 0 and run.out.count(" -> ") == 1, run


def test_memory_of_networks_is_given_back_before_the_last_frame_is_written(
    tmp_path: Path, polsep: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not before others are, which use it again."""
    idle, write = [], batch.write_separation

    def noting(*arguments: Any, **options: Any) -> Any:
        idle.append(len(ENGINES._idle))
        return write(*arguments, **options)

    monkeypatch.setattr(batch, "write_separation", noting)
    files = [png(tmp_path / f"{name}.png", frame()) for name in "ab"]
    assert polsep("separate", *files, "-o", tmp_path / "o", "--method", "joint-fast").status == 0
    assert idle[0] > 0 == idle[1]


def test_a_frame_that_fails_ends_its_file(tmp_path: Path, polsep: Cli) -> None:
    """The line says how many frames behind it are left out; those before it are written."""
    np.save(tmp_path / "run.npy", np.stack([frame(k) for k in range(4)]))
    (tmp_path / "o").mkdir()
    (tmp_path / "o" / "run_0001.exr").write_bytes(b"precious")
    run = polsep("separate", tmp_path / "run.npy", "-o", tmp_path / "o", "--method", "analytic", *WHITE)
    assert run.status == 2 and LINE.fullmatch(run.err) and run.err.endswith("; 2 frames behind it are left out\n")
    assert set(contents(tmp_path / "o")) == {"run_0001.exr", *(f"run_0000.{s}" for s in ("exr", "png", "json"))}


def test_an_output_without_a_name_is_refused() -> None:
    """An empty variable in a script would be the current folder: no command that writes takes it."""
    groups, asked = [app], 0
    for group in groups:
        for name, command in group.commands.items():
            groups += [command] if isinstance(command, click.Group) else []
            for output in (param for param in command.params if "--output" in param.opts):
                asked += 1
                with pytest.raises(click.BadParameter, match="expected a path, found an empty one"):
                    output.type_cast_value(click.Context(command, info_name=name), "")
    assert asked > 15


def test_a_calibration_is_not_replaced(tmp_path: Path, polsep: Cli) -> None:
    """No output takes the place of a file that corrects the frames, not even with --overwrite."""
    for name in ("rig", "dark"):
        png(tmp_path / f"{name}.png", frame() if name == "rig" else np.zeros((32, 32), np.uint16))
    kept = tmp_path / "rig.json"
    command = ("calibrate", "dark", tmp_path / "dark.png", "--white-level", "65535", "-o", kept)
    assert polsep(*command).status == 0
    before = kept.read_bytes()
    more = ("--calibration", kept, "-o", tmp_path, "--overwrite", "--format", "npz")
    run = polsep("separate", tmp_path / "rig.png", *more)
    assert run.status == 2 and "is an input" in run.err and kept.read_bytes() == before


def test_a_calibration_says_that_black_was_taken_to_be_at_0(tmp_path: Path, polsep: Cli) -> None:
    """Unless it was measured before or is said."""
    png(tmp_path / "flat.png", np.full((64, 64), 30_000, np.uint16))
    png(tmp_path / "dark.png", np.full((64, 64), 100, np.uint16))
    measure = ("calibrate", "flat", tmp_path / "flat.png", "--white-level", "65535", "-o")
    assert "black was taken to be at 0" in polsep(*measure, tmp_path / "a.json").out
    assert "black was" not in polsep(*measure, tmp_path / "b.json", "--black-level", "100").out
    dark = ("calibrate", "dark", tmp_path / "dark.png", "--white-level", "65535", "-o", tmp_path / "c.json")
    assert polsep(*dark).status == 0
    assert "black was" not in polsep(*measure, tmp_path / "c.json").out
    merged = tmp_path / "merged.tiff"
    assert polsep("merge", tmp_path / "flat.png", "--white-level", "65535", "-o", merged).status == 0
    found = polsep("calibrate", "flat", merged, "-o", tmp_path / "d.json")
    assert found.status == 0 and "black was" not in found.out  # black is subtracted in it


def test_names_of_any_bytes_are_printed(tmp_path: Path) -> None:
    """A name that is no text, and one that the terminal cannot show, stop nothing."""
    names = [os.fsencode(tmp_path) + b"/caf\xe9.png", os.fsencode(tmp_path) + "/日本.png".encode()]
    data = png(tmp_path / "a.png", frame()).read_bytes()
    try:
        for name in names:
            Path(os.fsdecode(name)).write_bytes(data)
    except OSError:
        pytest.skip("the disk takes names in UTF-8 alone")
    command = [sys.executable, "-m", "polsep", "separate", *names, "-o", str(tmp_path / "o"), "--method", "analytic"]
    settings = {**os.environ, "PYTHONIOENCODING": "ascii:strict", "PYTHONUTF8": "1"}
    run = subprocess.run(command, capture_output=True, env=settings, timeout=100)
    assert run.returncode == 0, run.stderr
    assert len(list((tmp_path / "o").iterdir())) == 6


def test_good_files_are_written_beside_bad_ones(tmp_path: Path, polsep: Cli) -> None:
    """One bad file of three: the others are written, one line says what was wrong, and the status is 2."""
    first, last = png(tmp_path / "a.png", frame()), png(tmp_path / "c.png", frame(1))
    (tmp_path / "b.png").write_bytes(first.read_bytes()[:99])
    run = polsep("separate", first, tmp_path / "b.png", last, "-o", tmp_path / "o", *WHITE)
    assert run.status == 2
    assert LINE.fullmatch(run.err) and "b.png" in run.err
    assert len(run.out.splitlines()) == 4
    assert set(contents(tmp_path / "o")) == {f"{stem}.{s}" for stem in "ac" for s in ("exr", "png", "json")}


def test_pages_before_a_damaged_one_are_written(tmp_path: Path, polsep: Cli) -> None:
    """Frames that were read before the damage are results; the damage is one line and status 2."""
    array = np.stack([frame(0), frame(1)]).astype(np.float32) / 65535
    array[1, 3, 5] = np.nan
    np.save(tmp_path / "run.npy", array)
    run = polsep("separate", tmp_path / "run.npy", "-o", tmp_path / "o", *WHITE)
    assert run.status == 2 and LINE.fullmatch(run.err) and "(3, 5)" in run.err
    assert set(contents(tmp_path / "o")) == {f"run_0000.{s}" for s in ("exr", "png", "json")}


@pytest.mark.parametrize("suffix", ["exr", "png", "json"])
def test_results_are_not_replaced_unasked(tmp_path: Path, polsep: Cli, suffix: str) -> None:
    """An existing output stops the frame: status 2, one line, every byte as before; --overwrite replaces it."""
    source = png(tmp_path / "a.png", frame())
    (tmp_path / "o").mkdir()
    (tmp_path / "o" / f"a.{suffix}").write_bytes(b"precious")
    assert_refused(polsep("separate", source, "-o", tmp_path / "o"), "--overwrite")
    assert contents(tmp_path / "o") == {f"a.{suffix}": b"precious"}
    assert polsep("separate", source, "-o", tmp_path / "o", "--overwrite").status == 0
    assert set(contents(tmp_path / "o")) == {"a.exr", "a.png", "a.json"}
    assert contents(tmp_path / "o")[f"a.{suffix}"] != b"precious"


@pytest.mark.parametrize("spelling", [".", "./", "../{name}", "link"])
def test_inputs_are_never_overwritten(
    tmp_path: Path, polsep: Cli, spelling: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Results that would fall on an input are refused before any work, however the directory is spelled."""
    source = png(tmp_path / "a.png", frame())
    before = source.read_bytes()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link").symlink_to(tmp_path, target_is_directory=True)
    run = polsep("separate", "a.png", "-o", spelling.format(name=tmp_path.name), "--overwrite")
    assert_refused(run, "is an input")
    assert source.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.png", "link"]


def test_numbered_pages_do_not_overwrite_an_input(tmp_path: Path, polsep: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    """Page 0 of run.tiff is run_0000: with --format tiff it must not replace the input run_0000_diffuse.tiff."""
    monkeypatch.chdir(tmp_path)
    tifffile.imwrite("run.tiff", np.stack([frame(0), frame(1)]), photometric="minisblack")
    tifffile.imwrite("run_0000_diffuse.tiff", frame(2))
    before = Path("run_0000_diffuse.tiff").read_bytes()
    polsep("separate", "run.tiff", "run_0000_diffuse.tiff", "-o", ".", "--format", "tiff", "--overwrite")
    assert Path("run_0000_diffuse.tiff").read_bytes() == before


def test_template_and_file_of_one_name_are_refused(tmp_path: Path, polsep: Cli) -> None:
    """shot_{angle}.png and shot.png would both write shot.exr: refused, also with --overwrite."""
    for angle in (0, 45, 90, 135):
        png(tmp_path / f"shot_{angle}.png", frame())
    png(tmp_path / "shot.png", frame(1))
    run = polsep("separate", tmp_path / "shot_{angle}.png", tmp_path / "shot.png", "-o", tmp_path / "o", "--overwrite")
    assert run.status == 2


def test_results_of_one_run_replace_none_of_each_other(tmp_path: Path, polsep: Cli) -> None:
    """The preview of shot_diffuse.png would be the diffuse image of shot.png: refused, also with --overwrite."""
    for name in ("shot", "shot_diffuse"):
        png(tmp_path / f"{name}.png", frame())
    inputs, out = [tmp_path / "shot.png", tmp_path / "shot_diffuse.png"], tmp_path / "o"
    run = polsep("separate", *inputs, "-o", out, "--format", "png", "--overwrite")
    assert run.status == 2
    assert "expected outputs of its own" in run.err and str(inputs[0]) in run.err
    kept = (out / "shot_diffuse.png").read_bytes()
    assert polsep("separate", inputs[0], "-o", out, "--format", "png", "--overwrite").status == 0
    assert (out / "shot_diffuse.png").read_bytes() == kept


def test_inputs_of_one_name_are_refused(tmp_path: Path, polsep: Cli) -> None:
    """Two inputs whose results would be one file are refused before any work."""
    for folder in ("x", "y"):
        (tmp_path / folder).mkdir()
        png(tmp_path / folder / "a.png", frame())
    run = polsep("separate", tmp_path / "x" / "a.png", tmp_path / "y" / "a.png", "-o", tmp_path / "o")
    assert_refused(run, "different names")
    assert not (tmp_path / "o").exists()


def cli_options(options: dict[str, Any]) -> list[str]:
    """Keyword options of `ReadOptions` as they are typed."""
    typed: list[str] = []
    for name, value in options.items():
        text = value.spec if isinstance(value, Layout) else "x".join(map(str, value)) if name == "size" else str(value)
        typed += [f"--{name.replace('_', '-')}={text}"]
    return typed


@pytest.mark.parametrize(("name", "data", "options"), [case[:3] for case in FILES], ids=[case[0] for case in FILES])
def test_bad_files(tmp_path: Path, polsep: Cli, name: str, data: bytes, options: dict[str, Any]) -> None:
    """Every damaged or unfit file: status 2, one line that names it, and no output at all."""
    (tmp_path / name).write_bytes(data)
    run = polsep("separate", tmp_path / name, "-o", tmp_path / "o", *cli_options(options))
    named = "--white-level" if "white_level" in options and not options["white_level"] > 0 else name
    assert_refused(run, named, "expected", "found")
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize("kind", ["missing", "directory", "unreadable", "missing angle", "sizes", "loop", "long name"])
def test_files_that_are_not_there(tmp_path: Path, polsep: Cli, kind: str) -> None:
    """Missing, unreadable and unequal files: status 2, one line, no output."""
    target = tmp_path / "shot.png"
    if kind == "directory":
        target.mkdir()
    elif kind == "loop":
        target.symlink_to(target)
    elif kind == "long name":
        target = tmp_path / f"shot{'a' * 300}.png"
    elif kind == "unreadable":
        if os.geteuid() == 0:
            pytest.skip("root reads everything")
        png(target, frame()).chmod(0)
    elif kind in ("missing angle", "sizes"):
        for angle in (0, 45, 90) if kind == "missing angle" else (0, 45, 90, 135):
            png(tmp_path / f"shot_{angle}.png", frame()[: 16 if angle == 90 else 32])
        target = tmp_path / "shot_{angle}.png"
    assert_refused(polsep("separate", target, "-o", tmp_path / "o"), "shot", "expected", "found")
    assert not (tmp_path / "o").exists()


BAD_OPTIONS: list[tuple[list[str], str]] = [
    (["--nothing"], "--nothing"),
    (["--layout"], "--layout"),
    (["--layout", "sony"], "--layout: expected"),
    (["--layout", ""], "expected"),
    (["--layout", "90,45,135,0/RGBG"], "bayer"),
    (["--layout", "90,45,135,0/RGGB@5,5"], "origin"),
    (["--layout", "0,1e-9,2e-9,3e-9/RGGB"], "angles"),
    (["--light-color", "1,2"], "R,G,B"),
    (["--light-color", "red"], "R,G,B"),
    (["--light-color", "1,0,1"], "light colour"),
    (["--light-color", "1,inf,1"], "light colour"),
    (["--light-color", "1e-300,1,1"], "expected"),
    (["--size", "64"], "--size"),
    (["--size", "64x"], "--size"),
    (["--size", "axb"], "--size"),
    (["--size", "-4x4"], "--size"),
    (["--size", "0x4"], "size"),
    (["--size", "1.5x4"], "--size"),
    (["--method", "magic"], "method"),
    (["--method", ""], "method"),
    (["--format", "jpeg"], "jpeg"),
    (["--pages", "all"], "all"),
    (["--device", "toaster"], "device"),
    (["--white-level", "bright"], "bright"),
    (["--white-level", "0"], "above the black level"),
    (["--white-level", "-1"], "above the black level"),
    (["--white-level", "inf"], "finite"),
    (["--black-level", "65535"], "above the black level"),
    (["--black-level", "nan"], "finite"),
    (["--pages", "angles"], "four pages"),
    (["--device", "meta"], "device"),
]


@pytest.mark.parametrize(("options", "word"), BAD_OPTIONS)
def test_bad_options(tmp_path: Path, polsep: Cli, options: list[str], word: str) -> None:
    """Every wrong option: status 2, one line that names what was wrong, and no output."""
    source = png(tmp_path / "a.png", frame())
    assert_refused(polsep("separate", source, "-o", tmp_path / "o", *options), word)
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize("args", [["separate"], ["nothing"], ["--nothing"], ["methods", "more"], ["separate", "-o"]])
def test_bad_commands(polsep: Cli, args: list[str]) -> None:
    """Unknown commands and missing arguments: status 2, one line."""
    assert_refused(polsep(*args))


def test_rates_may_be_ratios() -> None:
    """Film shot for NTSC runs at 24000/1001 frames per second."""
    assert [RATE.convert(text, None, None) for text in ("24", "24000/1001", 25.0)] == [24, 24000 / 1001, 25]


@pytest.mark.parametrize(
    ("words", "option"),
    [
        ("separate a.png --frame-size 64", "--size"),
        ("shape a.png --size 64 --mesh none", "--size"),
        ("shape a.png --index 9 --mesh none", "--index"),
        ("material a.png --frame-size 64", "--frame-size"),
        ("video in -o o --rate -2", "--rate"),
        ("video in -o o --rate 24/0", "--rate"),
        ("video in -o o --frames 0", "--frames"),
        ("video in -o o --compression rar", "--compression"),
        ("video in -o o --format gif", "--format"),
        ("render --shapes 0 --views 1 -o o", "--shapes"),
        ("render --shapes 1 --views 1 -o o --size 33", "--size"),
        ("render --shapes 1 --views 1 -o o --engine fog", "--engine"),
        ("render --shapes 1 --views 1 -o o --format gif", "--format"),
        ("geometry a.png --fov 400", "--fov"),
        ("geometry a.png --integration rough", "--integration"),
        ("material a.png --size 9", "--size"),
        ("material a.png --white 0", "--white"),
        ("train joint -o o --rate 0", "--rate"),
        ("train everything -o o", "RUNG"),
        ("train joint -o o --seed first", "--seed"),
        ("train joint -o o --entry -1", "--entry"),
        ("capture --seconds 0", "--seconds"),
        ("view --port 99999", "--port"),
        ("view --upload-limit 0", "--upload-limit"),
        ("edit a.png --metallic 7", "--metallic"),
        ("edit a.png --rougher much", "--rougher"),
        ("edit a.png --damaged hide", "--damaged"),
        ("edit a.png --rougher 1 --rate 24", "--rate"),
        ("video in -o o --rate 24 --no-preview", "--rate"),
        ("calibrate analysers a.png --polarizer-extinction 1", "--polarizer-extinction"),
        ("merge a.png -o m.tiff --times soon", "--times"),
    ],
)
def test_wrong_ranges_name_the_option(
    tmp_path: Path, polsep: Cli, monkeypatch: pytest.MonkeyPatch, words: str, option: str
) -> None:
    """A number out of range or an unknown word is a line that names the option as typed."""
    monkeypatch.chdir(tmp_path)
    png(tmp_path / "a.png", frame())
    (tmp_path / "in").mkdir()
    assert_refused(polsep(*words.split()), option, "expected", "found")
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    "words",
    [
        "separate no.png",
        "separate a.png --ambient no.png",
        "separate a.png --calibration no.json",
        "video no -o o",
        "edit no.exr --metallic 1",
        "material no.png",
        "geometry no.png",
        "calibrate dark no.png",
        "merge no.png -o m.tiff",
        "train joint -o o --start no.safetensors",
        "export joint -o o.onnx --weights no.safetensors",
        "view no.png",
    ],
)
def test_missing_paths_are_named_before_any_import(tmp_path: Path, words: str) -> None:
    """A path where nothing is costs one line and no library: not even NumPy is loaded by then."""
    png(tmp_path / "a.png", frame())
    program = (
        "import sys, polsep.cli\n"
        "cli = sys.modules['polsep.cli.app']\n"
        "cli.EXTRAS = dict.fromkeys(cli.EXTRAS, ())\n"
        "try: cli.app(sys.argv[1:], standalone_mode=False)\n"
        "except ValueError as error: print(error, 'numpy' in sys.modules)"
    )
    command = [sys.executable, "-c", program, *words.split()]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=120, check=True)
    assert re.fullmatch(r"no\S*: expected a file, found nothing at this path False\n", done.stdout), done


def test_words_of_options_are_those_of_the_library() -> None:
    """The words that the command line knows, without loading anything, are those that the library knows."""
    from polsep.geometry.files import INTEGRATIONS
    from polsep.geometry.one_frame import INDICES
    from polsep.io.results.exr import COMPRESSIONS
    from polsep.io.results.sequences import FORMATS as kinds
    from polsep.networks.rungs import RUNGS
    from polsep.render.views import SPLITS as splits
    from polsep.video.recordings import ENGINES, FILTERS, ON_DAMAGE

    def words(command: str, option: str) -> set[str]:
        parameter = next(p for p in cli.app.commands[command].params if option in p.opts)
        return set(parameter.type.words)  # type: ignore[attr-defined]

    assert words("video", "--format") == set(kinds) and words("video", "--compression") == set(COMPRESSIONS)
    assert words("video", "--filter") == set(FILTERS) and words("video", "--engine") == set(ENGINES)
    assert words("edit", "--damaged") == words("video", "--damaged") == set(ON_DAMAGE)
    assert words("geometry", "--integration") == set(INTEGRATIONS)
    assert words("shape", "--integration") == set(INTEGRATIONS)
    index = next(p.type for p in cli.app.commands["shape"].params if "--index" in p.opts)
    assert (index.low, index.high) == INDICES  # type: ignore[attr-defined]
    assert words("render", "--split") == set(splits)
    assert words("train", "rung") == {*RUNGS, *NAMES, "material", "shape"}


@pytest.mark.parametrize(
    ("shape", "layout"),
    [
        ((1, 1), "color"),
        ((3, 3), "color"),
        ((1, 1), "mono"),
        ((4, 4), "90,45,135,0/RGGB@1,1"),
        ((4, 4), "90,45,135,0/RGGB@0,1"),
    ],
)
def test_frames_too_small(tmp_path: Path, polsep: Cli, shape: tuple[int, int], layout: str) -> None:
    """A frame without one whole period is refused in one line."""
    source = png(tmp_path / "a.png", np.full(shape, 99, np.uint8))
    assert_refused(polsep("separate", source, "-o", tmp_path / "o", "--layout", layout), "at least")
    assert not (tmp_path / "o").exists()


def test_smallest_mono_frame(tmp_path: Path, polsep: Cli) -> None:
    """2x2 pixels are one whole cell of a mono sensor: separated."""
    source = png(tmp_path / "a.png", np.array([[90, 80], [70, 60]], np.uint8))
    assert polsep("separate", source, "-o", tmp_path / "o", "--layout", "mono").status == 0


@pytest.mark.parametrize("place", ["file", "under a file", "not writable"])
def test_bad_output_directories(tmp_path: Path, polsep: Cli, place: str) -> None:
    """An output path that is a file, or cannot be made: status 2, one line, nothing changed."""
    source = png(tmp_path / "a.png", frame())
    (tmp_path / "taken").write_bytes(b"precious")
    folders = {
        "file": tmp_path / "taken",
        "under a file": tmp_path / "taken" / "o",
        "not writable": Path("/proc/polsep"),
    }
    if place == "not writable" and not Path("/proc/self").exists():
        pytest.skip("no place here that even root cannot write")
    assert_refused(polsep("separate", source, "-o", folders[place]), "expected", "found")
    assert (tmp_path / "taken").read_bytes() == b"precious"
    assert sorted(contents(tmp_path)) == ["a.png", "taken"]


@pytest.mark.parametrize(
    "words",
    [
        "separate a.png b.png -o out/deep",
        "video frames -o out",
        "demo -o out",
        "samples -o out",
        "merge a.png -o out/m.tiff",
        "calibrate dark a.png -o out/rig.json",
        "calibrate dark a.png -o out/deep/rig.json",
        "shape a.png --mesh none -o out",
        "export joint-fast -o out/a.onnx",
        "render --shapes 1 --views 1 -o out",
        "train joint -o out",
    ],
)
def test_folders_without_permission_are_refused_before_work(
    tmp_path: Path, polsep: Cli, monkeypatch: pytest.MonkeyPatch, words: str
) -> None:
    """In one line, before anything is read, compiled or trained, and with nothing made there."""
    if missing := {"shape", "export", "render", "train"} & {words.partition(" ")[0]} - set(_usable()):
        pytest.skip(f"needs what {missing.pop()} needs")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out").mkdir()
    (tmp_path / "frames").mkdir()
    for name in ("a.png", "b.png", "frames/a.png"):
        png(tmp_path / name, frame())
    allowed = os.access

    def refuse_writing(path: Any, mode: int, **more: Any) -> bool:
        return allowed(path, mode, **more) and not (mode & os.W_OK and Path(path).name == "out")

    monkeypatch.setattr(os, "access", refuse_writing)
    assert_refused(polsep(*words.split()), "expected a directory to write into", "found one without permission")
    assert list((tmp_path / "out").iterdir()) == []


def _usable() -> list[str]:
    """Commands whose extras are installed."""
    needs = {"export": "export", "render": "render", "train": "train"}
    return ["shape", *(command for command, extra in needs.items() if has_extra(extra))]


def test_notes_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    """Also those with a name of several."""
    print_note("a\nb.png: \x1b[2J")
    assert capsys.readouterr().err == "polsep: a\\nb.png: \\x1b[2J\n"


def test_commands_without_their_files(tmp_path: Path, polsep: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    """bench refuses in one line what it cannot measure or find."""
    monkeypatch.chdir(tmp_path)
    assert_refused(polsep("bench", "nothing"), "expected a benchmark of")
    assert_refused(polsep("bench", "readme"), "expected a folder of measured rows, found no results")
    (page := tmp_path / "README.md").write_text(
        table := "<!-- table: speed -->\n| 1 |\n<!-- end -->\n", encoding="utf-8"
    )
    assert_refused(polsep("bench", "readme", "-o", "result"), "found no result")
    assert_refused(polsep("bench", "readme", "-o", "."), "found no NAME.jsonl in .")
    assert page.read_text(encoding="utf-8") == table and list(tmp_path.iterdir()) == [page]
    page.unlink()
    assert_refused(polsep("bench", "readme", "-o", str(tmp_path)), "expected the checkout of polsep")


def test_full_disk_ends_the_run(tmp_path: Path, polsep: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other frames would only be separated in vain."""

    def write_nothing(*given: Any) -> None:
        raise OutputError("expected to write 'a', found none") from OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(batch, "write_separation", write_nothing)
    sources = [png(tmp_path / f"{name}.png", frame()) for name in "ab"]
    assert_refused(polsep("separate", *sources, "-o", tmp_path / "o"), "expected to write 'a'")


def test_full_disk_leaves_nothing(tmp_path: Path) -> None:
    """A write that the system stops half way: status 2, one line, no file and no directory left."""
    source = png(tmp_path / "a.png", frame())
    limit = 2048
    run = subprocess_run(
        "separate",
        source,
        "-o",
        tmp_path / "o",
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
    )
    assert_refused(run, "expected to write 'a'")
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("sent", "said"), [(signal.SIGINT, "polsep: stopped"), (signal.SIGTERM, ""), (signal.SIGHUP, "")]
)
def test_interrupt_leaves_whole_frames_only(tmp_path: Path, sent: signal.Signals, said: str) -> None:
    """Ctrl-C or a system's end in the middle of many frames: every frame's files are all there or all absent."""
    np.save(tmp_path / "run.npy", np.stack([frame(size=64)] * 400))
    out = tmp_path / "o"
    command = [sys.executable, "-c", "from polsep.cli import main; main()", "separate", tmp_path / "run.npy", "-o", out]
    with subprocess.Popen([*command, *WHITE], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 60
        while not (out / "run_0001.json").exists() and time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.01)
        process.send_signal(sent)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 128 + sent, err
    assert err.strip() == said  # after the line break that a terminal needs behind ^C
    names = set(contents(out))
    stems = {name.split(".")[0] for name in names}
    assert 2 <= len(stems) < 400
    assert names == {f"{stem}.{suffix}" for stem in stems for suffix in ("exr", "png", "json")}
    assert [p.name for p in out.iterdir() if p.name.startswith(".")] == []


def test_reader_of_our_output_may_leave(tmp_path: Path) -> None:
    """A closed pipe ends the command without a traceback."""
    command = [sys.executable, "-c", "from polsep.cli import main; main()", "methods"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert "Traceback" not in process.stderr.read()
        process.wait(timeout=60)


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="no terminals here")
def test_results_stay_on_stdout_beside_a_terminal(tmp_path: Path) -> None:
    """With progress on a terminal, what is printed for other programs still goes to them."""
    files = [png(tmp_path / f"{name}.png", frame()) for name in "ab"]
    main, terminal = os.openpty()
    command = [sys.executable, "-m", "polsep", "separate", *map(str, files), "-o", str(tmp_path / "o")]
    process = subprocess.Popen([*command, "--method", "analytic"], stdout=subprocess.PIPE, stderr=terminal, text=True)
    os.close(terminal)
    drawn = b""
    with suppress(OSError):  # Linux ends a closed terminal so
        while read := os.read(main, 4096):
            drawn += read
    os.close(main)
    assert process.communicate(timeout=60)[0].count(" -> ") == 2 and process.returncode == 0
    assert b"separating" in drawn and b" -> " not in drawn


def test_progress_says_how_much_is_left() -> None:
    """Without a terminal the state is one line: what, how many, since when, and for how long."""
    progress = Progress("separating", None, None)
    assert progress.line() == "separating: 0 s"
    progress.resume(500)
    progress.update(750, 1000)
    assert re.fullmatch(r"separating: 750 of 1000, 0 s, 0 s left", progress.line())
