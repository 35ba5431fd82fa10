"""Materials of flat samples: material."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from polsep.cli.app import (
    DIR,
    LIT_READING,
    OVERWRITE,
    PIXEL_FORMAT,
    SEPARATED_BY,
    STEM,
    WEIGHTS,
    Number,
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
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@click.option("-o", "--output", type=DIR, default=Path("polsep-material"), metavar="DIR", help="Folder of the results.")
@click.option("--name", type=STEM, metavar="NAME", help="Name of the results.  [default: that of the first file]")
@click.option(
    "--white", metavar="N,...", help="s0 of white paper in the middle: one number, or one for each photograph."
)
@click.option(
    "--size", "side", type=Number(int, 32, 1024), default=128, metavar="PX", help="Side of the maps; trained at 128."
)
@click.option(
    "--input", "network_input", default="separated", metavar="NAME", help="separated, or unseparated to compare."
)
@WEIGHTS
@SEPARATED_BY
@LIT_READING
@click.option("--frame-size", "size", metavar="WxH", help="Size of headerless raw frames, like 2448x2048.")
@PIXEL_FORMAT
@OVERWRITE
def material(files: tuple[str, ...], **options: Any) -> None:
    """Estimate normals, diffuse colour, roughness and specular reflectance of a flat material.

    FILE is a raw frame, as for 'polsep separate', or a separated one (.exr, .npz). All are photographs of one material
    from above by a camera that does not move, each under one polarized light: a flash beside the lens, or several
    lights in turn, in any order. The middle square is used. The lamp's colour is divided out; of bare metal, say it
    (--light-color white). Needs the extra torch.

    DIR/NAME.exr gets all maps; NAME_normal.png, NAME_diffuse.png, NAME_roughness.png and NAME_specular.png are
    textures; NAME.glb opens in Blender, NAME.mtlx in MaterialX viewers; NAME.png shows the maps and the material under
    other lights, and NAME.json holds settings and units.

    \b
    polsep material flash.png -o wood                        one photograph
    polsep material flash.png left.png right.png --white 0.8 several, where white paper has an s0 of 0.8
    polsep material out/flash.exr                            separated before
    """
    require_extra("torch")
    require_paths(*files, *filter(None, [options["weights"]]))
    wanted, text = "--white N or N,N,... above 0, at most 2, like 0.8", options["white"]
    white = () if text is None else parse_numbers(text, wanted, lambda levels: all(0 < x <= 2 for x in levels))
    read = read_options(options)
    from polsep.methods import check_method

    check_method(options["method"])
    light = read_light(options)
    from polsep.io.results.separation_reader import is_separated
    from polsep.material.files import MaterialOptions, estimate_files

    if all(is_separated(Path(file)) for file in files):
        refuse_frame_options(f"{files[0]}, which is separated")

    settings = MaterialOptions(
        read,
        options["method"],
        light,
        white,
        options["side"],
        options["network_input"],
        options["weights"],
        kept=correcting_files(options),
    )
    with show_progress("estimating the material"):
        written, notes = estimate_files(files, settings, options["output"], options["name"], options["overwrite"])
    print_results(notes, written)
