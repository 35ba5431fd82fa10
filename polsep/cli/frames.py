"""Commands on single frames: separate, demo, methods, export."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import polsep
from polsep.cli.app import DIR, app, parse_size, say

if TYPE_CHECKING:
    from polsep.batch import Outcome


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
@click.option("--size", metavar="WxH", help="Size of headerless raw, like 2448x2048.")
@click.option("--pixel-format", metavar="NAME", help="GenICam pixel format of headerless raw, like BayerRG12p.")
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

    FILE is PNG, TIFF, NPY, NPZ, PGM or headerless raw; 'shot_{angle}.png' names four images at 0, 45, 90 and 135
    degrees. For every frame, DIR/STEM.exr gets the layers diffuse.R/G/B, specular.R/G/B, dolp.Y, aolp.Y [radians] and
    valid.Y (networks also write error.diffuse and error.specular, how far off they expect to be), DIR/STEM.png is a
    preview, and DIR/STEM.json tells settings and statistics.

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
    from polsep.io.raw.frames import ReadOptions
    from polsep.methods import check_method
    from polsep.pipeline import find_device, parse_light_color
    from polsep.sensor.camera import Layout

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
@click.argument("method")
@click.option("-o", "--output", type=click.Path(path_type=Path, dir_okay=False), required=True, metavar="FILE.onnx")
@click.option("--mono", is_flag=True, help="For cameras without colour filters.")
@click.option("--full", is_flag=True, help="Images of the mosaic's own resolution.")
@click.option("--weights", type=click.Path(path_type=Path), metavar="FILE", help="Of polsep train; default: shipped.")
@click.option("--overwrite", is_flag=True, help="Replace a file that exists.")
def export(method: str, output: Path, weights: Path | None, **options: bool) -> None:
    """Write joint or joint-fast as one ONNX file: raw uint16 frames in, diffuse, specular and expected error out.

    It runs in onnxruntime and its like without polsep. Frames [N, H, W] are in Sony's order with sides that are
    multiples of 4; black_level and white_level are in their units. Needs the extra export.
    """
    from polsep.io.store.atomic import refuse_existing
    from polsep.io.store.onnx import write_onnx
    from polsep.networks.export import OUTPUT_NAMES, Graph
    from polsep.networks.run import find_joint
    from polsep.sensor.camera import Layout

    try:
        refuse_existing(output.parent, [output], options["overwrite"])
        network, metadata = find_joint(method, Layout(bayer=None) if options["mono"] else Layout(), weights)
        say(f"writing the graph of {method}, which takes a minute or a few")
        write_onnx(output, Graph(network, options["full"]), OUTPUT_NAMES, metadata)
    except ValueError as error:
        raise click.ClickException(str(error)) from None
    print(output)


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
    from polsep.io.raw.frames import ReadOptions
    from polsep.methods import METHODS

    capture = Path(polsep.__file__).parent / "data" / "still_life.png"
    for name in METHODS:
        write = WriteOptions(output / name, overwrite=True)
        for outcome in separate_files([str(capture)], ReadOptions(white_level=4095.0), SeparateOptions(name), write):
            if _report(outcome):
                sys.exit(2)
            _print_demo(name, outcome.report["statistics"])
    print(f"Look at {output / 'joint' / 'still_life.png'} beside {output / 'analytic' / 'still_life.png'}:")
    print("  in 'specular', the analytic split leaves coloured rims of the objects, and holes where highlights clip;")
    print("  the network removes the rims and fills most of the holes. The EXR files hold the linear images for")
    print("  Blender, Nuke or Python.")


def _print_demo(name: str, statistics: dict[str, Any]) -> None:
    print(
        f"  {name}: {statistics['clipped_fraction']:.2%} of the pixels hold clipped samples, "
        f"light polarizer about {statistics['light_polarizer_deg']:.0f} deg (25 deg in the scene)"
    )
