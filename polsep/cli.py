"""The command line: parse, call one function, print. Heavy imports stay inside the commands.

Exit status: 0 only when everything asked for was written; 2 after bad input, with one line per failure on stderr.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from polsep.batch import Outcome

SETTINGS = {"help_option_names": ["-h", "--help"], "show_default": True, "max_content_width": 100}


@click.group(context_settings=SETTINGS, no_args_is_help=True)
@click.version_option(package_name="polsep", message="polsep %(version)s")
def app() -> None:
    """One raw frame of a polarization camera in, a diffuse and a specular image out."""


def say(line: str) -> None:
    """One line for the user on stderr; stdout is for results."""
    print(f"polsep: {line}", file=sys.stderr)


def parse_light_color(text: str) -> tuple[float, ...] | str:
    """``R,G,B`` or ``estimate``."""
    if text == "estimate":
        return text
    try:
        r, g, b = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f'expected --light-color R,G,B like 1,0.9,0.7, or "estimate", found {text!r}') from None
    return (r, g, b)


def parse_size(text: str | None) -> tuple[int, int] | None:
    """``WIDTHxHEIGHT``."""
    if text is None:
        return None
    width, x, height = text.lower().partition("x")
    if not (x and width.isdecimal() and height.isdecimal()):
        raise ValueError(f"expected --size WIDTHxHEIGHT like 2448x2048, found {text!r}")
    return int(width), int(height)


DIR = click.Path(path_type=Path)


@app.command()
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@click.option("-o", "--output", type=DIR, default=Path("polsep-out"), metavar="DIR", help="Where results go.")
@click.option("--method", default="auto", metavar="NAME", help="See 'polsep methods'; auto is the best one installed.")
@click.option("--layout", metavar="color|mono|SPEC", default="color", help="The sensor's filters; see below.")
@click.option("--black-level", type=float, default=0.0, metavar="N", help="Sample value of no light.")
@click.option(
    "--white-level", type=float, metavar="N", help="Sample value where the sensor clips.  [default: the type's largest]"
)
@click.option("--light-color", default="1,1,1", metavar="R,G,B", help="Camera RGB of the light, or 'estimate'.")
@click.option(
    "--format",
    type=click.Choice(["exr", "npz", "tiff", "png"]),
    default="exr",
    help="A PNG preview always comes along.",
)
@click.option("--full", is_flag=True, help="Full resolution instead of one pixel per 2x2 cell.")
@click.option("--size", metavar="WxH", help="Size of headless raw, like 2448x2048.")
@click.option("--pixel-format", metavar="NAME", help="GenICam pixel format of headless raw, like BayerRG12p.")
@click.option(
    "--pages",
    type=click.Choice(["frames", "angles"]),
    default="frames",
    help="Pages of one file: single frames, or every four are the angles 0, 45, 90, 135.",
)
@click.option("--overwrite", is_flag=True, help="Replace results that exist.")
@click.option("--device", default="auto", metavar="NAME", help="auto, cpu or cuda.")
def separate(files: tuple[str, ...], **options: Any) -> None:
    """Separate raw frames of a polarization camera into diffuse and specular images.

    FILE is PNG, TIFF, NPY, NPZ, PGM or headless raw; 'shot_{angle}.png' names four images at 0, 45, 90 and 135 degrees.
    For every frame, DIR/STEM.exr gets the layers diffuse.R/G/B, specular.R/G/B, dolp.Y, aolp.Y [radians] and valid.Y
    (networks also write error.diffuse and error.specular, how far off they expect to be), DIR/STEM.png is a preview,
    and DIR/STEM.json tells settings and statistics.

    \b
    polsep separate shot.png -o out                   Sony colour mosaic, 8 or 16 bit
    polsep separate shot.tiff --white-level 4095      12-bit values in 16-bit words
    polsep separate mono.png --layout mono            a monochrome polarization sensor
    polsep separate dump.raw --size 2448x2048 --pixel-format BayerRG12p
    polsep separate 'shot_{angle}.png'                four images, one per analyser angle

    \b
    --layout color   Sony's 90 45 / 135 0 under RGGB
    --layout mono    the same without colours
    --layout SPEC    2x2 angles in reading order and the Bayer order, like 90,45,135,0/RGGB or 0,45,90,135/mono
    """
    from polsep.batch import SeparateOptions, WriteOptions, separate_files
    from polsep.camera import Layout
    from polsep.io.frames import ReadOptions
    from polsep.methods import check_method
    from polsep.pipeline import find_device

    try:
        given = click.get_current_context().get_parameter_source("layout") == click.core.ParameterSource.COMMANDLINE
        read = ReadOptions(
            Layout.parse(options["layout"]) if given else None,
            options["black_level"],
            options["white_level"],
            parse_size(options["size"]),
            options["pixel_format"],
            options["pages"],
        )
        check_method(options["method"])
        find_device(options["device"])
        light = parse_light_color(options["light_color"])
        run = SeparateOptions(options["method"], light, options["device"], options["full"])
        write = WriteOptions(options["output"], options["format"], options["overwrite"])
        outcomes = separate_files(files, read, run, write)
        failures = sum(_report(outcome) for outcome in _with_progress(outcomes, len(files)))
    except ValueError as error:
        raise click.ClickException(str(error)) from None
    if failures:
        sys.exit(2)


def _report(outcome: Outcome) -> int:
    """Print what became of a frame; 1 if it failed."""
    if outcome.error is not None:
        say(f"error: {outcome.error}")
        return 1
    for warning in outcome.warnings:
        say(f"{outcome.source}: {warning}")
    print(f"{outcome.source} -> {', '.join(str(path) for path in outcome.written)}")
    return 0


def _with_progress(outcomes: Iterator[Outcome], files: int) -> Iterator[Outcome]:
    """The same outcomes under a progress bar over files, where there are several and someone watches."""
    if files < 2 or not sys.stderr.isatty():
        yield from outcomes
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("separating", total=files)
        seen: set[str] = set()
        for outcome in outcomes:
            seen.add(outcome.source)
            progress.update(task, completed=len(seen), description=outcome.source)
            yield outcome


@app.command()
@click.option("--shapes", type=int, required=True, metavar="N", help="Random shapes.")
@click.option("--views", type=int, required=True, metavar="N", help="Views of each shape.")
@click.option("--size", type=int, default=1024, metavar="PX", help="Side of the raw frames.")
@click.option("--seed", type=int, default=0, metavar="N", help="Another seed is another set.")
@click.option("-o", "--output", type=DIR, required=True, metavar="DIR", help="A new directory, or one to go on with.")
@click.option("--split", default="train", metavar="NAME", help="train, validation or test: none shares a seed.")
@click.option("--samples", type=int, default=2, metavar="N", help="N x N rays per pixel.")
@click.option("--format", type=click.Choice(["exr", "npz"]), default="exr", help="Of the truth.")
@click.option("--workers", type=int, metavar="N", help="Processes.  [default: one per core]")
@click.option("--engine", default="local", metavar="NAME", help="local, or ray: the cluster of RAY_ADDRESS.")
def render(output: Path, workers: int | None, engine: str, **options: Any) -> None:
    """Render random shapes as a polarization camera records them, with the exact diffuse and specular images.

    Every view becomes a raw mosaic (PNG, 12-bit codes in 16-bit words), the truth (EXR or NPZ) and a record (JSON);
    manifest.jsonl lists all files with their sha256, contact.png shows some. The same options make the same bytes, with
    however many workers. A run that was stopped or killed goes on when the same command is given again.

    \b
    polsep render --shapes 500 --views 20 --size 1024 -o train               the paper's set
    polsep render --shapes 25 --views 20 --size 1024 --split test -o test    shapes that no training saw
    """
    try:
        from polsep.dataset import RenderOptions, default_workers, render_dataset
        from polsep.io.dataset import read_fingerprint

        asked = RenderOptions(**options)
        total = asked.shapes * asked.views
        counts = render_dataset(asked, output, default_workers() if workers is None else workers, engine)
        _show_counts(counts, total)
    except ModuleNotFoundError as error:
        extra = {"embreex": "render", "ray": "ray"}.get((error.name or "").partition(".")[0])
        if extra is None:
            raise
        raise click.ClickException(
            f"expected the extra {extra!r} (pip install 'polsep[{extra}]'), found none"
        ) from None
    except (ValueError, RuntimeError) as error:
        raise click.ClickException(str(error)) from None
    print(f"{output}: {total} views, manifest sha256 {read_fingerprint(output)}")


def _show_counts(counts: Iterator[int], total: int) -> None:
    """A progress bar over how many views of a set are there, where someone watches."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (TextColumn("rendering"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty()) as progress:
        task = progress.add_task("views", total=total, completed=next(counts))  # earlier runs tell nothing of the speed
        for count in counts:
            progress.update(task, completed=count)


@app.command()
@click.argument("rung")
@click.option("-o", "--output", type=DIR, required=True, metavar="DIR", help="A new directory, or one to go on with.")
@click.option(
    "--data",
    default="mosaic",
    metavar="NAME",
    help="mosaic: noisy frames; mono: without colours; co-sited: as the paper.",
)
@click.option("--width", type=int, metavar="N", help="Channels of the network's first level; 32 on the ladder.")
@click.option("--levels", type=int, default=3, metavar="N", help="Halvings of a rung's networks.")
@click.option("--fold", type=int, default=2, metavar="N", help="N x N pixels are folded into channels; 1: none.")
@click.option("--blocks", metavar="N,N,...", help="Residual blocks per level of a joint network.")
@click.option("--ablation", default="none", metavar="NAME", help="What a joint network goes without.")
@click.option("--steps", type=int, default=20_000, metavar="N", help="Batches of 8 crops.")
@click.option("--rate", type=float, default=1e-3, metavar="X", help="Peak learning rate.")
@click.option("--seed", type=int, default=0, metavar="N", help="Of the weights and of the data.")
@click.option("--workers", type=int, default=1, metavar="N", help="Processes that render, per device.")
@click.option("--devices", type=int, default=1, metavar="N", help="GPUs, where there are any.")
@click.option("--start", type=click.Path(path_type=Path), metavar="FILE", help="Weights to begin with.")
@click.option("--precision", default="bf16-mixed", metavar="NAME", help="bf16-mixed or 32-true.")
def train(rung: str, output: Path, data: str, **options: Any) -> None:
    """Train joint, joint-fast or a rung of the paper's ladder: paper, unpolarized, polarized, shared, signed,
    no-angle, stokes.

    Data are rendered while training, from seeds that no test has. A run that was stopped or killed goes on when the
    same command is given again. 'tensorboard --logdir DIR' shows its curves. Needs the extra train.

    \b
    polsep train joint -o runs/joint
    polsep train paper --data mono -o runs/mono                           for cameras without colour filters
    polsep train paper --width 64 --levels 4 --fold 1 -o runs/unet64      the classic U-Net
    """
    try:
        from polsep.train.command import choose_options, plan_run, train_weights
        from polsep.train.loop import Run, Schedule
    except ModuleNotFoundError as error:
        raise click.ClickException(
            f"expected the extra 'train' (pip install 'polsep[train]'), found no {error.name}"
        ) from None
    try:
        asked = choose_options(rung, data, options)
        schedule = Schedule(options["steps"], options["rate"], precision=options["precision"])
        given = {name: options[name] for name in ("workers", "devices", "start")}
        run = plan_run(Run(output, schedule=schedule, **given), asked)
        path = train_weights(asked, run, _show_training)
    except ValueError as error:
        raise click.ClickException(str(error)) from None
    print(path)


@app.command()
@click.argument("method")
@click.option("-o", "--output", type=click.Path(path_type=Path, dir_okay=False), required=True, metavar="FILE.onnx")
@click.option("--mono", is_flag=True, help="For cameras without colour filters.")
@click.option("--full", is_flag=True, help="Images of the mosaic's own resolution.")
@click.option("--weights", type=click.Path(path_type=Path), metavar="FILE", help="Of polsep train; default: shipped.")
def export(method: str, output: Path, mono: bool, full: bool, weights: Path | None) -> None:
    """Write joint or joint-fast as one ONNX file: raw uint16 frames in, diffuse, specular and expected error out.

    It runs in onnxruntime and its like without polsep. Frames [N, H, W] are in Sony's order with sides that are
    multiples of 4; black_level and white_level are in their units. Needs the extra export.
    """
    from polsep.camera import Layout
    from polsep.graph import OUTPUT_NAMES, Graph
    from polsep.io.onnx import write_onnx
    from polsep.mosaic_network import find_joint

    try:
        network, metadata = find_joint(method, Layout(bayer=None) if mono else Layout(), weights)
        write_onnx(output, Graph(network, full), OUTPUT_NAMES, metadata)
    except ValueError as error:
        raise click.ClickException(str(error)) from None
    print(output)


def _show_training(line: dict[str, Any]) -> None:
    """One line of a training's log."""
    values = (f"{name} {value:.4g}" for name, value in line.items())
    print(", ".join(values), file=sys.stderr, flush=True)


@app.command()
def methods() -> None:
    """List the separation methods that this installation has."""
    from polsep.methods import BEST, METHODS

    for method in METHODS.values():
        best = "  (auto)" if method is BEST[0] else ""
        print(f"{method.name}{best}\n    {method.summary}\n    needs:  {method.needs}\n    source: {method.source}")


@app.command()
@click.option("-o", "--output", type=DIR, default=Path("polsep-demo"), metavar="DIR", help="Where results go.")
def demo(output: Path) -> None:
    """Separate the capture that comes with polsep, with every method, and say what to look at.

    The capture is a 2448x2048 12-bit colour mosaic that polsep rendered itself: seven objects under one light polarized
    at an angle that the methods are not told.
    """
    from polsep.batch import SeparateOptions, WriteOptions, separate_files
    from polsep.io.frames import ReadOptions
    from polsep.methods import METHODS

    capture = Path(__file__).parent / "data" / "still_life.png"
    for name in METHODS:
        write = WriteOptions(output / name, overwrite=True)
        for outcome in separate_files([str(capture)], ReadOptions(white_level=4095.0), SeparateOptions(name), write):
            if _report(outcome):
                sys.exit(2)
            _print_demo(name, outcome.report["statistics"])
    print(f"Look at {output / 'color-affine' / 'still_life.png'} beside {output / 'analytic' / 'still_life.png'}:")
    print("  in 'specular', the analytic split leaves coloured rims of the objects, and holes where highlights clip;")
    print("  the closed form removes both. The EXR files hold the linear images for Blender, Nuke or Python.")


def _print_demo(name: str, statistics: dict[str, Any]) -> None:
    print(
        f"  {name}: {statistics['clipped_fraction']:.2%} of the pixels hold clipped samples, "
        f"light polarizer about {statistics['light_polarizer_deg']:.0f} deg (25 deg in the scene)"
    )


@app.command()
@click.argument("name", metavar="NAME", default="list")
@click.option(
    "--data", type=DIR, default=Path("../shared/data"), metavar="DIR", help="For real, frontend, sets, paper."
)
@click.option("-o", "--output", type=DIR, default=Path("results"), metavar="DIR", help="Where NAME.jsonl goes.")
@click.option("--quick", is_flag=True, help="A part of it in minutes, to DIR/NAME-quick.jsonl.")
@click.option(
    "--images",
    type=DIR,
    metavar="DIR",
    help="Where NAME's pictures go.  [default: docs/images/NAME; beside the rows with --quick]",
)
def bench(name: str, data: Path, output: Path, quick: bool, images: Path | None) -> None:
    """Measure NAME, print its rows and write them to DIR/NAME.jsonl; without NAME, list what can be measured.

    'polsep bench readme' makes the tables of README.md and docs anew from DIR.
    """
    from polsep.bench import BENCHES, provenance, to_jsonl
    from polsep.io.results import fill_readme, write_text

    if name == "list":
        for known, entry in BENCHES.items():
            print(f"{known}: {(entry.run.__doc__ or '').splitlines()[0]}")
        return
    if name == "readme":
        for page in ("README.md", "docs/joint.md", "docs/paper.md"):
            fill_readme(Path(page), output)
        return
    if name not in BENCHES:
        raise click.ClickException(f"expected a benchmark of {', '.join([*BENCHES, 'readme'])}, found {name!r}")
    chosen = BENCHES[name]
    measure = chosen.quick if quick else chosen.run
    if measure is None:
        known = ", ".join(n for n, entry in BENCHES.items() if entry.quick)
        raise click.ClickException(f"expected a benchmark with a quick version for --quick ({known}), found {name!r}")
    stem, command = (f"{name}-quick", f"polsep bench {name} --quick") if quick else (name, f"polsep bench {name}")
    folder = images or (output / stem if quick else Path("docs/images") / name)
    rows = []
    try:
        for row in measure(data):
            print(f"{row.case:48} {row.method:20} {row.metric:28} {row.value:10.4g} {row.unit}", flush=True)
            rows.append(row)
        write_text(output / f"{stem}.jsonl", to_jsonl(rows, provenance(command)))
        for path in chosen.draw(rows, data, folder) if chosen.draw else ():
            print(path, flush=True)
    except ValueError as error:
        raise click.ClickException(str(error)) from None


def main() -> None:
    """Entry point: bad input is one line on stderr and exit status 2."""
    try:
        app(standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        print(error.format_message())
        sys.exit(2)
    except click.ClickException as error:
        say(f"error: {' '.join(error.format_message().split())}")
        sys.exit(2)
    except (KeyboardInterrupt, click.Abort):
        say("stopped")
        sys.exit(130)
    except BrokenPipeError:
        sys.stderr.close()  # the reader of our output has gone: nothing to tell it
        sys.exit(1)
    except OSError as error:
        say(f"error: {error}")
        sys.exit(2)
