"""The viewer's command: view."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import click

from polsep.cli.app import (
    AMBIENT,
    CALIBRATION,
    COUNT,
    LAYOUT,
    PIXEL_FORMAT,
    SIZE,
    Number,
    app,
    print_note,
    require_extra,
    require_paths,
)
from polsep.io.raw.extensions import template_files


@app.command()
@click.argument("file", required=False, type=click.Path(path_type=Path), metavar="[FILE]")
@click.option(
    "--host", default="127.0.0.1", metavar="ADDRESS", help="Address to listen on; others let other machines connect."
)
@click.option(
    "--port",
    type=Number(int, 1, 65_535),
    metavar="N",
    help="Port to listen on.  [default: the first free one from 7860 on]",
)
@click.option("--open", "opens", is_flag=True, help="Open the page in this machine's browser.")
@click.option("--method", default="auto", metavar="NAME", help="Separation method; 'polsep methods' lists them.")
@LAYOUT
@click.option("--black-level", metavar="N", help="Sample value without light.")
@click.option("--white-level", metavar="N", help="Sample value at which the sensor clips.")
@click.option("--light-color", metavar="auto|white|R,G,B", help="Colour of the light.")
@CALIBRATION
@AMBIENT
@SIZE
@PIXEL_FORMAT
@click.option(
    "--upload-limit", type=COUNT, default=240, metavar="MB", help="Largest size of files that are uploaded together."
)
def view(file: Path | None, host: str, port: int | None, opens: bool, upload_limit: int, **options: Any) -> None:
    """Open raw frames and results in the browser: compare, inspect, edit, download.

    FILE is a raw frame, a file of several frames, an EXR or NPZ file of polsep, or a folder of raw frames or of 'polsep
    video'; 'shot_{angle}.png' is four images at 0, 45, 90 and 135 degrees. More files can be opened on the page. It
    is served to this machine alone unless --host says otherwise. It needs no network, and deletes uploaded files when
    it is closed. Needs the extra view.

    \b
    polsep view
    polsep view shot.tiff --white-level 4095 --open
    polsep view film/
    polsep view 'shot_{angle}.png'
    polsep view dump.raw --size 2448x2048 --pixel-format BayerRG12p
    """
    require_extra("view")
    if file is not None:
        require_paths(*template_files(file))
    from polsep.view.opening import find_sources, parse_settings, require_first
    from polsep.view.server import ViewOptions, serve

    names = {"black_level": "black", "white_level": "white", "light_color": "light"}
    settings = {names.get(name, name): value for name, value in options.items() if value not in (None, ())}
    read = parse_settings(settings).read
    if file is not None:
        require_first(find_sources(file), read)
    with serve(ViewOptions(host, port, file, settings, upload_limit)) as address:
        print(address, flush=True)
        print_note("serving until Ctrl-C")
        if opens:
            click.launch(address)
        threading.Event().wait()
