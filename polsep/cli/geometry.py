"""Shape of an object from frames under several lights: geometry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from polsep.cli.app import (
    COUNT,
    DIR,
    FILE,
    INTEGRATION,
    OVERWRITE,
    READING,
    SEPARATED_BY,
    STEM,
    TURNTABLE,
    Number,
    Word,
    app,
    correcting_files,
    print_results,
    read_options,
    refuse_frame_options,
    require_extra,
    require_paths,
)
from polsep.cli.progress import show_progress

#: The order of photographs without --lights.
ORDER = "right front-right front front-left left above"


@app.command()
@click.argument("files", nargs=-1, type=FILE, metavar="FILE...")
@click.option("-o", "--output", type=DIR, default=Path("polsep-geometry"), metavar="DIR", help="Folder of the results.")
@click.option("--name", type=STEM, default="shape", metavar="STEM", help="Name of the output files.")
@click.option("--lights", default=ORDER, metavar="LIGHTS", help="A name or x,y,z per FILE; see above.")
@click.option(
    "--mask", type=FILE, metavar="FILE", help="Image that is white on the object.  [default: where light falls]"
)
@click.option("--srgb", is_flag=True, help="Files are photographs: 8-bit sRGB, or linear TIFF, EXR, 16-bit PNG.")
@SEPARATED_BY
@READING
@click.option(
    "--fov",
    type=Number(float, 0, 120, above=True),
    metavar="DEG",
    help="The camera's vertical field of view.  [default: orthographic]",
)
@click.option("--size", "longest", type=COUNT, default=640, metavar="PX", help="Longer side of the maps at most.")
@INTEGRATION
@click.option("--mesh", type=Word("glb", "ply"), default="glb", metavar="glb|ply", help="Format of the mesh.")
@TURNTABLE
@OVERWRITE
def geometry(files: tuple[Path, ...], **options: Any) -> None:
    """Estimate normals, albedo, depth and a mesh of an object from frames under different lights.

    FILE is a raw frame, or an EXR or NPZ file of 'polsep separate', one per light; the camera does not move. The
    diffuse images show the shape without highlights, and their polarization resolves what shading leaves ambiguous.
    With --srgb, photographs of any camera work too, less exactly.

    DIR/STEM.exr gets normal.X/Y/Z (x right, y up, z to the camera), albedo.R/G/B, depth.Z and mask.Y,
    DIR/STEM_normals.png normals for other programs, DIR/STEM.glb a mesh with colours, DIR/STEM.png is a preview.

    Light directions may be off by 10 degrees. Each is a name (right, front-right, front, front-left, left, above), or
    x,y,z toward the light. Needs the extra mesh.

    \b
    polsep geometry right.png fr.png front.png fl.png left.png above.png -o out
    polsep geometry sep/*.exr --lights "0,0,1 0.5,0,0.9 -0.5,0,0.9 0,0.6,0.8" -o out
    polsep geometry --srgb [0-5].JPG --mask mask.png --turntable -o out
    """
    require_extra("mesh")
    if options["turntable"]:
        require_extra("video")
    if options["srgb"]:
        refuse_frame_options("--srgb")
    require_paths(*files, *filter(None, [options["mask"]]))
    from polsep.geometry.lights import parse_lights
    from polsep.io.assets.maps import read_object
    from polsep.io.assets.shapes import shape_targets, write_shape
    from polsep.io.results.separation_reader import is_separated
    from polsep.io.store.atomic import refuse_existing, refuse_inputs
    from polsep.methods import check_method

    directions = parse_lights(options["lights"])
    if len(files) != len(directions):
        raise ValueError(f"expected {len(directions)} files, one per light of --lights, found {len(files)}")
    check_method(options["method"])
    if all(map(is_separated, files)):
        refuse_frame_options(f"{files[0]}, which is separated")
    read = read_options(options)
    targets = shape_targets(options["output"], options["name"], options["mesh"], options["turntable"])
    beside = [file.with_suffix(".json") for file in files if is_separated(file)]  # reports are read, too
    refuse_inputs(targets, [*files, *beside, *filter(None, [options["mask"]]), *correcting_files(options)])
    refuse_existing(options["output"], targets, options["overwrite"])
    from polsep.geometry.files import ShapeOptions, Source, find_object, find_shape, read_views, shrink

    shape_options = ShapeOptions(options["mesh"], options["fov"], options["integration"], options["turntable"])
    with show_progress("finding the shape"):
        views = read_views(files, Source("photographs" if options["srgb"] else "frames", read, options["method"]))
        size = views.images.shape[1:3]
        mask = find_object(views) if options["mask"] is None else read_object(options["mask"], size)
        views, mask = shrink(views, mask, options["longest"])
        shape = find_shape(views, directions, mask, shape_options)
        write_shape(shape, targets)
    print_results(shape.facts["warnings"], targets)
