"""The command that renders training data: render."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from polsep.cli.app import COUNT, DIR, ENGINE, Number, Word, app, print_note, require_extra
from polsep.cli.progress import show_progress


@app.command()
@click.option("--shapes", type=Number(int, 1, 99_999), required=True, metavar="N", help="Number of random shapes.")
@click.option("--views", type=Number(int, 1, 10_000), required=True, metavar="N", help="Views of each shape.")
@click.option("--size", type=Number(int, 32, 16_384), default=1024, metavar="PX", help="Side of the raw frames.")
@click.option("--seed", type=Number(int, 0, 2**63), default=0, metavar="N", help="Random seed; each gives another set.")
@click.option("-o", "--output", type=DIR, required=True, metavar="DIR", help="New directory, or one to resume.")
@click.option(
    "--split",
    type=Word("train", "validation", "test"),
    default="train",
    metavar="NAME",
    help="train, validation or test; they share no random draws.",
)
@click.option("--samples", type=Number(int, 1, 16), default=2, metavar="N", help="Trace N x N rays per pixel.")
@click.option("--format", type=Word("exr", "npz"), default="exr", metavar="exr|npz", help="Format of the ground truth.")
@click.option("--workers", type=COUNT, metavar="N", help="Number of processes.  [default: one per core]")
@ENGINE
def render(output: Path, workers: int | None, engine: str, **options: Any) -> None:
    """Render random shapes as a polarization camera records them, with the exact diffuse and specular images.

    Every view becomes a raw mosaic (PNG, 12-bit codes in 16-bit words), the ground truth (EXR or NPZ) and a record
    (JSON). manifest.jsonl lists all files with their sha256, contact.png shows some of them. The same options give the
    same bytes with any number of workers. Run the same command again to resume a run that was stopped. Needs the extra
    render.

    \b
    polsep render --shapes 500 --views 20 --size 1024 -o train               the paper's set
    polsep render --shapes 25 --views 20 --size 1024 --split test -o test    shapes that no training uses
    """
    require_extra("render")
    if options["size"] % 4:
        raise ValueError(f"expected --size a multiple of 4, found {options['size']}")
    if engine == "ray":
        require_extra("ray")
    from polsep.datasets.rendered import RenderOptions, default_workers, render_dataset
    from polsep.io.results.dataset import read_fingerprint
    from polsep.io.store.atomic import require_writable

    require_writable(output)
    dataset = RenderOptions(**options)
    total = dataset.shapes * dataset.views
    counts = render_dataset(dataset, output, default_workers() if workers is None else workers, engine)
    with show_progress("rendering", total) as progress:
        if done := next(counts):
            progress.resume(done)
            print_note(f"resuming: {done} of {total} views are there from before")
        for count in counts:
            progress.update(count)
    print(f"{output}: {total} views, manifest sha256 {read_fingerprint(output)}")
