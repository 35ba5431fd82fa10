"""Sample frames: samples."""

from __future__ import annotations

from pathlib import Path

import click

from polsep.cli.app import DIR, OVERWRITE, app


@app.command()
@click.option("-o", "--output", type=DIR, default=Path("polsep-samples"), metavar="DIR", help="Folder of the frames.")
@OVERWRITE
def samples(output: Path, overwrite: bool) -> None:
    """Write small sample frames to try polsep with, free for every use (CC0).

    Colour, mono, without the lamp's polarizer, overexposed, with another layout, and four angle images: rendered
    frames of 408x344 pixels, 12 bits in PNG files. DIR/README.md says what each shows.

    \b
    polsep samples -o samples
    polsep separate samples/color.png -o out --white-level 4095
    polsep separate samples/mono.png -o out --white-level 4095 --layout mono
    polsep separate 'samples/angle_{angle}.png' -o out --white-level 4095
    """
    from polsep.io.store.samples import write_samples

    for path in write_samples(output, overwrite):
        print(path)
