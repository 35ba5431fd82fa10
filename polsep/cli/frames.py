"""Commands on single frames: separate, demo, methods, export."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import polsep
from polsep.cli.app import (
    CORRECTING,
    DEVICE,
    DIR,
    FILE,
    LIGHT_COLOR,
    OVERWRITE,
    PIXEL_FORMAT,
    SIZE,
    STOKES,
    WEIGHTS,
    Number,
    Word,
    app,
    check_read_options,
    correcting_files,
    is_given,
    print_note,
    read_light,
    read_options,
    require_extra,
    require_paths,
)
from polsep.cli.photographs import find_photographs, photo_options, read_photo_options
from polsep.cli.progress import show_progress
from polsep.cli.summary import summary

if TYPE_CHECKING:
    from polsep.batch import Outcome


@app.command()
@click.argument("files", nargs=-1, metavar="FILE...")
@click.option("-o", "--output", type=DIR, default=Path("polsep-out"), metavar="DIR", help="Folder of the results.")
@click.option(
    "--method", default="auto", metavar="NAME", help="Method, see 'polsep methods'; auto is the best one installed."
)
@click.option("--layout", metavar="color|mono|SPEC", default="color", help="Filter layout of the sensor; see above.")
@CORRECTING
@LIGHT_COLOR
@click.option(
    "--lamp-dolp",
    type=Number(float, 0.3, 1),
    metavar="P",
    help="Degree of polarization of the lamp, where it is known; separates twice.  [default: found in the frame, or 1]",
)
@click.option(
    "--format",
    type=Word("exr", "npz", "tiff", "png"),
    default="exr",
    metavar="exr|npz|tiff|png",
    help="Format of the images; a PNG preview is always written.",
)
@click.option("--full", is_flag=True, help="Full resolution instead of one pixel per 2x2 cell.")
@STOKES
@SIZE
@PIXEL_FORMAT
@click.option(
    "--pages",
    type=Word("auto", "frames", "angles"),
    default="auto",
    metavar="auto|frames|angles",
    help="Pages of one file: frames, or every four are the angles 0, 45, 90, 135; auto looks at them.",
)
@photo_options
@OVERWRITE
@DEVICE
def separate(files: tuple[str, ...], **options: Any) -> None:
    """Separate raw frames of a polarization camera into diffuse and specular images.

    FILE is PNG, TIFF, NPY, NPZ, PGM or headerless raw, or a folder of such files or of 'polsep capture';
    'shot_{angle}.png' is four images at 0, 45, 90 and 135 degrees, and so is a TIFF of four such pages.
    With --parallel and --crossed, or with --angles, photographs of an ordinary camera through a polarizing filter:
    camera raw, TIFF, PNG, films; they are aligned first (extra photos).
    For every frame, DIR/STEM.exr gets the layers diffuse.R/G/B, specular.R/G/B, dolp.Y, aolp.Y [radians] and valid.Y
    (networks also write their expected errors, error.diffuse and error.specular), DIR/STEM.png is a preview, and
    DIR/STEM.json holds settings and statistics.

    \b
    polsep separate shot.png -o out                   Sony colour mosaic, 8 or 16 bit
    polsep separate shot.tiff --white-level 4095      12-bit values in 16-bit words
    polsep separate mono.png --layout mono            a monochrome polarization sensor
    polsep separate dump.raw --size 2448x2048 --pixel-format BayerRG12p
    polsep separate shots/                            every frame of a folder
    polsep separate 'shot_{angle}.png'                four images, one per analyser angle
    polsep separate --parallel p.nef --crossed c.nef  two photographs through a filter
    polsep separate --angles 0,60,120 a.tif b.tif c.tif
    polsep separate --angles unknown film.mkv         a filter that turns

    \b
    --layout color   Sony's 90 45 / 135 0 under RGGB
    --layout mono    the same without colours
    --layout SPEC    2x2 angles in reading order and the Bayer order, like 90,45,135,0/RGGB or 0,45,90,135/mono
    """
    if not is_given("layout"):
        options["layout"] = None  # files that say their own layout are read by it
    photographs = find_photographs(files, options)
    if len(files) == 1 and not photographs:  # of several the others are separated all the same
        require_paths(*files)
    check_read_options(options)
    from polsep.batch import SeparateOptions, WriteOptions, separate_files, separate_photographs
    from polsep.compute.devices import find_device
    from polsep.methods import check_method

    read = read_options(options)
    check_method(options["method"])
    find_device(options["device"])
    light = read_light(options)
    run = SeparateOptions(options["method"], light, options["device"], options["full"], options["lamp_dolp"])
    write = WriteOptions(
        options["output"], options["format"], options["overwrite"], options["stokes"], correcting_files(options)
    )
    if photographs:
        with show_progress(f"separating {len(photographs)} photographs"):
            outcome = separate_photographs(photographs, read_photo_options(options), read, run, write)
        _report(outcome)
        return
    paths, failures = _expand_files(files)
    paths = _without_ambient(paths, options["ambient"])
    seen = list[str]()
    with show_progress(f"separating {files[0]}" if len(files) == 1 else "separating", len(paths)) as progress:
        for outcome in separate_files(paths, read, run, write):
            if outcome.source not in seen:
                seen.append(outcome.source)
            progress.update(len(seen) - 1 + outcome.last)  # of videos, the number of frames may be a guess
            failures += _report(outcome)
    if failures:
        sys.exit(2)


def _expand_files(files: tuple[str, ...]) -> tuple[list[str], int]:
    """The files with folders replaced by their frames, and the number of folders without; that of one file raises."""
    from polsep.io.raw.sequences import angles_together, expand_folders

    for name in sorted(set(angles_together(map(Path, files))) - set(map(Path, files))):
        print_note(f"the four files of {name} are separated one by one: '{name}' makes one frame of four angles")
    paths, failures = list[str](), 0
    for file in files:
        try:
            paths += expand_folders([file])
        except (ValueError, OSError) as error:
            if len(files) == 1:  # of several the others are separated all the same
                raise
            print_note(f"error: {error}")
            failures += 1
    return paths, failures


def _without_ambient(paths: list[str], ambient: tuple[Path, ...]) -> list[str]:
    """The paths of frames without those of lamp-off frames, each with a note. Raises InputError if none is left."""
    from polsep.io.raw.sequences import input_files
    from polsep.io.store.errors import input_error

    dark = {os.path.realpath(file) for path in ambient for file in input_files(path)}
    kept = [path for path in paths if os.path.realpath(path) not in dark]  # also of links that lead in a circle
    if paths and not kept:
        raise input_error(paths[0], "expected frames with the lamp on, found the lamp-off frame alone")
    for path in paths:
        if path not in kept:
            print_note(f"{path} is the lamp-off frame: it is not separated")
    return kept


def _report(outcome: Outcome) -> int:
    """Print the outcome of a frame; 1 if it failed."""
    if outcome.error is not None:
        print_note(f"error: {outcome.error}")
        return 1
    for warning in outcome.warnings:
        print_note(f"{outcome.source}: {warning}")
    print(f"{outcome.source} -> {', '.join(str(path) for path in outcome.written)}")
    print(f"  {summary(outcome.report)}", flush=True)
    return 0


@app.command()
@click.argument("method")
@click.option("-o", "--output", type=FILE, required=True, metavar="FILE.onnx")
@click.option("--mono", is_flag=True, help="For cameras without colour filters.")
@click.option("--full", is_flag=True, help="Images of the mosaic's own resolution.")
@click.option("--no-fill", is_flag=True, help="No loops: nothing fills diffuse light under clipped highlights.")
@WEIGHTS
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
def export(method: str, output: Path, weights: Path | None, **options: bool) -> None:
    """Write a joint method as one ONNX file: raw uint16 frames in, diffuse, specular, expected error and valid out.

    METHOD is joint, joint-fast or joint-large (both of its networks). The file runs in onnxruntime and similar programs
    without polsep. Frames [N, H, W] are in Sony's order with sides that are multiples of 4; black_level and white_level
    are in their units; light_color is camera RGB of the light, 1, 1, 1 if it is white (graphs for mono have none).
    Images equal those of 'polsep separate' with layers in float32 (POLSEP_LAYERS=f32), where that finds no defects and
    no metals. Needs the extra export.
    """
    require_extra("export")
    if weights is not None:
        require_paths(weights)
    if output.suffix.lower() != ".onnx":
        raise ValueError(f"expected an output that ends in .onnx, found {output.name!r}")
    from polsep.io.store.atomic import refuse_existing, refuse_inputs
    from polsep.sensor.camera import Layout
    from polsep.shipped import find_joint

    refuse_inputs([output], [] if weights is None else [weights])
    refuse_existing(output.parent, [output], options["overwrite"])
    layout = Layout.sony(1 if options["mono"] else 3)
    networks, metadata = find_joint(method, layout, weights)
    print_note(f"exporting {method}, which may take minutes")
    with show_progress(f"exporting {method}") as progress:
        import torch

        from polsep.io.store.onnx import STEPS, write_onnx
        from polsep.networks.export import OUTPUT_NAMES, ExportedNetwork, describe_graph
        from polsep.networks.joint import Joint

        members = [Joint.of(network, torch.device("cpu")) for network in networks]
        graph = ExportedNetwork(members, options["full"], not options["no_fill"])
        metadata |= describe_graph(method, layout, options["full"], polsep.__version__)
        for number, step in enumerate(write_onnx(output, graph, OUTPUT_NAMES, metadata), 1):
            progress.update(0, None, f"exporting {method}, step {number} of {len(STEPS)}: {step}")
    print(output)


@app.command()
def methods() -> None:
    """List the installed separation methods."""
    from polsep.methods import BEST, METHODS

    for method in METHODS.values():
        best = "  (auto)" if method is BEST[0] else ""
        print(f"{method.name}{best}\n    {method.summary}\n    needs:  {method.needs}\n    source: {method.source}")


@app.command()
@click.option("-o", "--output", type=DIR, default=Path("polsep-demo"), metavar="DIR", help="Folder of the results.")
@click.option(
    "--all", "every", is_flag=True, help="With every method.  [default: the best one and the paper's formula]"
)
def demo(output: Path, every: bool) -> None:
    """Separate the example frame of polsep, and print what to compare.

    The frame is a rendered 2448x2048 12-bit colour mosaic: seven objects under one polarized light, whose angle the
    methods do not know.
    """
    from polsep.batch import SeparateOptions, WriteOptions, separate_files
    from polsep.io.raw.frames import ReadOptions
    from polsep.io.store.samples import DEMO, DEMO_WHITE
    from polsep.methods import BEST, METHODS

    best = BEST[0].name
    for name in METHODS if every else ("analytic", best):
        write = WriteOptions(output / name, overwrite=True)
        for outcome in separate_files([str(DEMO)], ReadOptions(white_level=DEMO_WHITE), SeparateOptions(name), write):
            if _report(outcome):
                sys.exit(2)
    print("The lamp's polarizer is at 25 deg; highlights show a few degrees more, as the lamp is not at the camera.")
    print(f"Compare {output / best / 'still_life.png'} with {output / 'analytic' / 'still_life.png'}:")
    print("  in 'specular', the analytic split leaves coloured rims of the objects, and holes where highlights clip;")
    print("  the networks remove the rims and fill most of the holes. The EXR files hold the linear images for")
    print("  Blender, Nuke or Python.")
