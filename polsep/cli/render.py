"""The command that renders training data: render."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from polsep.cli.app import DIR, ENGINE, app, extra_needed, progress_bar


@app.command()
@click.option("--shapes", type=int, required=True, metavar="N", help="Number of random shapes.")
@click.option("--views", type=int, required=True, metavar="N", help="Views of each shape.")
@click.option("--size", type=int, default=1024, metavar="PX", help="Side of the raw frames.")
@click.option("--seed", type=int, default=0, metavar="N", help="Random seed; each gives another set.")
@click.option("-o", "--output", type=DIR, required=True, metavar="DIR", help="New directory, or one to resume.")
@click.option("--split", default="train", metavar="NAME", help="train, validation or test; they share no random draws.")
@click.option("--samples", type=int, default=2, metavar="N", help="Trace N x N rays per pixel.")
@click.option("--format", type=click.Choice(["exr", "npz"]), default="exr", help="Format of the ground truth.")
@click.option("--workers", type=int, metavar="N", help="Number of processes.  [default: one per core]")
@ENGINE
def render(output: Path, workers: int | None, engine: str, **options: Any) -> None:
    """Render random shapes as a polarization camera records them, with the exact diffuse and specular images.

    Every view becomes a raw mosaic (PNG, 12-bit codes in 16-bit words), the ground truth (EXR or NPZ) and a record
    (JSON). manifest.jsonl lists all files with their sha256, contact.png shows some of them. The same options give the
    same bytes with any number of workers. Run the same command again to resume a run that was stopped.

    \b
    polsep render --shapes 500 --views 20 --size 1024 -o train               the paper's set
    polsep render --shapes 25 --views 20 --size 1024 --split test -o test    shapes that no training uses
    """
    with extra_needed("render", "embreex"), extra_needed("ray", "ray"):
        from polsep.datasets.rendered import RenderOptions, default_workers, render_dataset
        from polsep.io.results.dataset import read_fingerprint

        dataset = RenderOptions(**options)
        total = dataset.shapes * dataset.views
        counts = render_dataset(dataset, output, default_workers() if workers is None else workers, engine)
        with progress_bar() as progress:
            # The first count is of earlier runs, so it says nothing about the speed.
            task = progress.add_task("rendering", total=total, completed=next(counts), speed="")
            for count in counts:
                progress.update(task, completed=count)
    print(f"{output}: {total} views, manifest sha256 {read_fingerprint(output)}")
