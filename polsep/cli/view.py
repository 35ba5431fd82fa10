"""The viewer's command: view."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import click

from polsep.cli.app import app, say


@app.command()
@click.argument("file", required=False, type=click.Path(path_type=Path), metavar="[FILE]")
@click.option("--host", default="127.0.0.1", metavar="ADDRESS", help="Where to listen; others can come in elsewhere.")
@click.option("--port", type=int, metavar="N", help="Port to listen on.  [default: the first free one from 7860 on]")
@click.option("--open", "opens", is_flag=True, help="Open the page in this machine's browser.")
@click.option("--method", default="auto", metavar="NAME", help="See 'polsep methods'.")
@click.option("--layout", metavar="color|mono|SPEC", help="The sensor's filters, as for 'polsep separate'.")
@click.option("--black-level", metavar="N", help="Sample value of no light.")
@click.option("--white-level", metavar="N", help="Sample value where the sensor clips.")
@click.option("--light-color", metavar="R,G,B", help="Camera RGB of the light, or 'estimate'.")
@click.option("--size", metavar="WxH", help="Size of headerless raw, like 2448x2048.")
@click.option("--pixel-format", metavar="NAME", help="GenICam pixel format of headerless raw, like BayerRG12p.")
@click.option("--upload-limit", type=click.IntRange(1), default=240, metavar="MB", help="Largest file taken.")
def view(file: Path | None, host: str, port: int | None, opens: bool, upload_limit: int, **options: Any) -> None:
    """Open raw frames and results in the browser: compare, inspect, edit, download.

    FILE is a raw frame, a file of several, an EXR or NPZ file of polsep, or a folder of 'polsep video'; others are
    opened on the page. The page is served to this machine alone unless --host says otherwise, needs no network, and
    forgets what was opened when it is closed. Needs the extra view.

    \b
    polsep view
    polsep view shot.tiff --white-level 4095 --open
    polsep view film/
    polsep view dump.raw --size 2448x2048 --pixel-format BayerRG12p
    """
    from polsep.view.opening import find_sources, parse_settings
    from polsep.view.server import ViewOptions, serve

    names = {"black_level": "black", "white_level": "white", "light_color": "light"}
    settings = {names.get(name, name): value for name, value in options.items() if value is not None}
    try:
        parse_settings(settings)
        if file is not None and not file.exists():
            raise ValueError(f"{file}: expected a file, found nothing")
        if file is not None:
            find_sources(file)
        with serve(ViewOptions(host, port, file, settings, upload_limit)) as address:
            print(address, flush=True)
            say("serving until Ctrl-C")
            if opens:
                click.launch(address)
            threading.Event().wait()
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "gradio":
            raise
        raise click.ClickException("expected the extra 'view' (pip install 'polsep[view]'), found none") from None
    except ValueError as error:
        raise click.ClickException(str(error)) from None
