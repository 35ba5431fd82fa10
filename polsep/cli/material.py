"""Materials of flat samples: material."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from polsep.cli.app import DIR, app, parse_size, say


@app.command()
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@click.option("-o", "--output", type=DIR, default=Path("polsep-material"), metavar="DIR", help="Where results go.")
@click.option("--name", metavar="NAME", help="Of the results.  [default: the first file's]")
@click.option("--white", metavar="N,...", help="s0 of white paper in the middle, for each photograph or for all.")
@click.option("--size", "side", type=int, default=128, metavar="PX", help="Side of the maps; trained at 128.")
@click.option("--input", "seen", default="separated", metavar="NAME", help="separated, or unseparated to compare.")
@click.option("--weights", type=click.Path(path_type=Path), metavar="FILE", help="Of polsep train; default: shipped.")
@click.option("--method", default="auto", metavar="NAME", help="What separates raw frames; see 'polsep methods'.")
@click.option("--layout", metavar="color|mono|SPEC", help="The sensor's filters; see 'polsep separate'.")
@click.option("--black-level", type=float, default=0.0, metavar="N", help="Sample value of no light.")
@click.option("--white-level", type=float, metavar="N", help="Sample value where the sensor clips.")
@click.option("--light-color", default="1,1,1", metavar="R,G,B", help="Camera RGB of the light, or 'estimate'.")
@click.option("--frame-size", metavar="WxH", help="Size of headerless raw, like 2448x2048.")
@click.option("--pixel-format", metavar="NAME", help="GenICam pixel format of headerless raw, like BayerRG12p.")
@click.option("--overwrite", is_flag=True, help="Replace results that exist.")
def material(files: tuple[str, ...], **options: Any) -> None:
    """Estimate normals, diffuse colour, roughness and specular reflectance of a flat material.

    FILE is a raw frame, as 'polsep separate' takes it, or a separated one (.exr); all are photographs of one material
    from above by a camera that did not move, each under one polarized light: a flash beside the lens, or several lights
    in turn, in any order. The middle square is used. Materials are taken for dielectrics, and their light for white.

    DIR/NAME.exr gets all maps; NAME_normal.png, NAME_diffuse.png, NAME_roughness.png and NAME_specular.png are
    textures; NAME.glb opens in Blender, NAME.mtlx in MaterialX viewers; NAME.png shows the maps and the material under
    other lights, and NAME.json tells settings and units.

    \b
    polsep material flash.png -o wood                        one photograph
    polsep material flash.png left.png right.png --white 0.8 several, and white paper showed 0.8
    polsep material out/flash.exr                            separated before
    """
    from polsep.io.raw.frames import ReadOptions
    from polsep.material.files import MaterialOptions, estimate_files
    from polsep.methods import check_method
    from polsep.pipeline import parse_light_color
    from polsep.sensor.camera import Layout

    try:
        check_method(options["method"])
        read = ReadOptions(
            Layout.parse(options["layout"]) if options["layout"] else None,
            options["black_level"],
            options["white_level"],
            parse_size(options["frame_size"]),
            options["pixel_format"],
        )
        asked = MaterialOptions(
            read,
            options["method"],
            parse_light_color(options["light_color"]),
            _parse_levels(options["white"]),
            options["side"],
            options["seen"],
            options["weights"],
        )
        target = (options["output"], options["name"], options["overwrite"])
        written, notes = estimate_files(files, asked, target)
    except (ValueError, RuntimeError) as error:
        raise click.ClickException(str(error)) from None
    for note in notes:
        say(note)
    for path in written:
        print(path)


def _parse_levels(text: str | None) -> tuple[float, ...]:
    """``N`` or ``N,N,...``; none for None."""
    if text is None:
        return ()
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"expected --white N or N,N,... like 0.8, found {text!r}") from None
