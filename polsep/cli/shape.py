"""The surface of an object from one frame: shape."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from polsep.cli.app import (
    DIR,
    FILE,
    INTEGRATION,
    LIT_READING,
    OVERWRITE,
    PIXEL_FORMAT,
    SIZE,
    STEM,
    TURNTABLE,
    WEIGHTS,
    Number,
    Word,
    app,
    correcting_files,
    parse_numbers,
    print_results,
    read_light,
    read_options,
    refuse_frame_options,
    require_extra,
    require_paths,
)
from polsep.cli.progress import show_progress


@app.command()
@click.argument("file", type=FILE, metavar="FILE")
@click.option("-o", "--output", type=DIR, default=Path("polsep-shape"), metavar="DIR", help="Folder of the results.")
@click.option("--name", type=STEM, metavar="STEM", help="Name of the output files.  [default: that of FILE]")
@click.option(
    "--light",
    "lamp",
    default="auto",
    metavar="x,y,z|auto",
    help="Direction toward the lamp: right, up, to the camera; auto: somewhere beside the camera.",
)
@click.option(
    "--mask", type=FILE, metavar="FILE", help="Image that is white on the object.  [default: where light falls]"
)
@click.option(
    "--index",
    type=Number(float, 1.3, 2.5),
    default=1.5,
    metavar="N",
    help="Refractive index of the object: 1.33 water, 1.4 skin, 1.5 glass and most paints, 1.6 polycarbonate.",
)
@click.option(
    "--method",
    default="joint",
    metavar="NAME",
    help="Method that separates a raw frame; the network for shape was mostly trained on images by joint.",
)
@LIT_READING
@SIZE
@PIXEL_FORMAT
@click.option(
    "--mesh",
    type=Word("glb", "ply", "none"),
    default="glb",
    metavar="glb|ply|none",
    help="Format of the mesh; none: no depth and no mesh, which need the extra mesh.",
)
@INTEGRATION
@TURNTABLE
@WEIGHTS
@OVERWRITE
def shape(file: Path, **options: Any) -> None:
    """Estimate normals, albedo, roughness, depth and a mesh of an object from one frame under one polarized lamp.

    FILE is a raw frame, as for 'polsep separate', or an EXR or NPZ file that it wrote. The object stands before a dark
    ground, or --mask says where it is. A network finds the surface in the separated images and in the polarization of
    the diffuse light, and says how far off it may be.

    DIR/STEM.exr gets normal.X/Y/Z (x right, y up, z to the camera), albedo.R/G/B, roughness, specular, their expected
    errors, depth.Z and mask.Y; DIR/STEM_normals.png normals for other programs, DIR/STEM.glb a mesh with colours;
    DIR/STEM.png is a preview with pictures under other lamps, DIR/STEM.html a page where you move the lamp.

    \b
    polsep shape frame.png -o out
    polsep shape sep/frame.exr --light 0.3,0.5,0.8 --mask mask.png -o out
    polsep shape frame.png --layout mono --mesh none -o out          normals alone, without the extra mesh
    """
    if options["mesh"] != "none":
        require_extra("mesh", "--mesh none")
    elif options["turntable"]:
        raise ValueError("expected a mesh with --turntable, found --mesh none")
    if options["turntable"]:
        require_extra("video")
    require_paths(file, *filter(None, [options["mask"], options["weights"]]))
    wanted = "--light x,y,z with z > 0, like 0.3,0.5,0.8, or auto"
    lamp = None if options["lamp"] == "auto" else parse_numbers(options["lamp"], wanted, _is_toward_camera)
    light = read_light(options)
    from polsep.io.assets.shapes import shape_targets, write_shape
    from polsep.io.raw.frames import output_stem
    from polsep.io.results.separation_reader import is_separated
    from polsep.io.store.atomic import refuse_existing, refuse_inputs
    from polsep.methods import check_method

    check_method(options["method"])
    name = options["name"] or output_stem(str(file))
    targets = shape_targets(options["output"], name, options["mesh"], options["turntable"], True)
    if is_separated(file):
        refuse_frame_options(f"{file}, which is separated")
    beside = [file.with_suffix(".json")] if is_separated(file) else []  # its report is read, too
    more = filter(None, [options["mask"], options["weights"]])
    refuse_inputs(targets, [file, *beside, *more, *correcting_files(options)])
    refuse_existing(options["output"], targets, options["overwrite"])
    from polsep.geometry.one_frame_files import ShapeSettings, find_shape_of

    names = ("method", "mask", "mesh", "integration", "turntable", "weights", "index")
    settings = ShapeSettings(
        read_options(options), light_color=light, lamp=lamp, **{key: options[key] for key in names}
    )
    with show_progress("finding the shape"):
        files, notes = find_shape_of(file, settings)
        write_shape(files, targets)
    print_results(notes, targets)


def _is_toward_camera(way: tuple[float, ...]) -> bool:
    """True for a direction (x, y, z) of which z is above 0."""
    return len(way) == 3 and way[2] > 0 and all(abs(part) < 1e9 for part in way)
