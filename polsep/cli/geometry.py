"""Shape from six lights: geometry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from polsep.cli.app import DIR, app

FILE = click.Path(path_type=Path, dir_okay=False)
#: The order of photographs without --lights.
ORDER = "right front-right front front-left left above"


@app.command()
@click.argument("files", nargs=-1, type=FILE, metavar="FILE...")
@click.option("-o", "--output", type=DIR, default=Path("polsep-geometry"), metavar="DIR", help="Where results go.")
@click.option("--name", default="shape", metavar="STEM", help="Name of the output files.")
@click.option("--lights", default=ORDER, metavar="LIGHTS", help="A name or x,y,z per FILE; see below.")
@click.option("--mask", type=FILE, metavar="FILE", help="White on the object.  [default: where light falls]")
@click.option("--srgb", is_flag=True, help="Files are photographs: 8-bit sRGB, or linear TIFF, EXR, 16-bit PNG.")
@click.option("--method", default="auto", metavar="NAME", help="That separates raw frames; see 'polsep methods'.")
@click.option("--layout", metavar="color|mono|SPEC", help="Of raw frames, as in 'polsep separate'.")
@click.option("--black-level", type=float, default=0.0, metavar="N", help="Of raw frames.")
@click.option("--white-level", type=float, metavar="N", help="Of raw frames.  [default: the type's largest]")
@click.option("--fov", type=float, metavar="DEG", help="The camera's vertical field of view.  [default: orthographic]")
@click.option("--size", type=int, default=640, metavar="PX", help="Longer side of the maps at most.")
@click.option("--integration", default="bilateral", metavar="bilateral|smooth", help="Depth with jumps, or without.")
@click.option("--mesh", default="glb", metavar="glb|ply", help="Format of the mesh.")
@click.option("--turntable", is_flag=True, help="Also DIR/STEM.mp4: the mesh, turning. Needs the extra video.")
@click.option("--overwrite", is_flag=True, help="Replace results that exist.")
def geometry(files: tuple[Path, ...], **options: Any) -> None:
    """Normals, albedo, depth and a mesh of an object from frames under different lights.

    FILE is a raw frame or an EXR file of 'polsep separate', one per light; the camera stands still. The diffuse images
    show the shape without highlights, and their polarization says what shading leaves open. With --srgb, photographs
    of any camera do, less exactly.

    DIR/STEM.exr gets normal.X/Y/Z (x right, y up, z to the camera), albedo.R/G/B, depth.Z and mask.Y,
    DIR/STEM_normals.png normals for other programs, DIR/STEM.glb a mesh with colours, DIR/STEM.png is a preview.

    Lights need be known roughly only, 10 degrees off is fine: names (right, front-right, front, front-left, left,
    above), or x,y,z toward the light. Needs the extra render.

    \b
    polsep geometry right.png fr.png front.png fl.png left.png above.png -o out
    polsep geometry sep/*.exr --lights "0,0,1 0.5,0,0.9 -0.5,0,0.9 0,0.6,0.8" -o out
    polsep geometry --srgb [0-5].JPG --mask mask.png --turntable -o out
    """
    try:
        from polsep.geometry.files import (
            Asked,
            Source,
            find_object,
            find_shape,
            read_object,
            read_views,
            refuse_inputs,
            shrink,
        )
    except ModuleNotFoundError as error:
        raise click.ClickException(
            f"expected the extra 'render' (pip install 'polsep[render]'), found no {error.name}"
        ) from None
    from polsep.geometry.lights import parse_lights
    from polsep.io.assets.shapes import shape_targets, write_shape
    from polsep.io.raw.frames import ReadOptions
    from polsep.io.store.atomic import refuse_existing
    from polsep.methods import check_method
    from polsep.sensor.camera import Layout

    try:
        asked = Asked(options["mesh"], options["fov"], options["integration"], options["turntable"])
        directions = parse_lights(options["lights"])
        if len(files) != len(directions):
            raise ValueError(f"expected {len(directions)} files, one per light of --lights, found {len(files)}")
        check_method(options["method"])
        layout = None if options["layout"] is None else Layout.parse(options["layout"])
        read = ReadOptions(layout, options["black_level"], options["white_level"])
        targets = shape_targets(options["output"], options["name"], options["mesh"], asked.turntable)
        refuse_inputs(targets, [*files, *([options["mask"]] if options["mask"] else [])])
        refuse_existing(options["output"], targets, options["overwrite"])
        source = Source("photographs" if options["srgb"] else "frames", read, options["method"])
        views = read_views(files, source)
        size = views.images.shape[1:3]
        mask = find_object(views) if options["mask"] is None else read_object(options["mask"], size)
        if options["size"] < 1:
            raise ValueError(f"expected --size of 1 or more, found {options['size']}")
        views, mask = shrink(views, mask, options["size"])
        shape = find_shape(views, directions, mask, asked)
        write_shape(shape, targets)
    except (ValueError, RuntimeError) as error:
        raise click.ClickException(str(error)) from None
    for path in targets:
        print(path)
