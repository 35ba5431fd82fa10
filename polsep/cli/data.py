"""Commands that make data, weights and figures: render, train, bench."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from polsep.cli.app import DIR, app


@app.command()
@click.option("--shapes", type=int, required=True, metavar="N", help="Random shapes.")
@click.option("--views", type=int, required=True, metavar="N", help="Views of each shape.")
@click.option("--size", type=int, default=1024, metavar="PX", help="Side of the raw frames.")
@click.option("--seed", type=int, default=0, metavar="N", help="Another seed is another set.")
@click.option("-o", "--output", type=DIR, required=True, metavar="DIR", help="A new directory, or one to go on with.")
@click.option("--split", default="train", metavar="NAME", help="train, validation or test: none shares a seed.")
@click.option("--samples", type=int, default=2, metavar="N", help="N x N rays per pixel.")
@click.option("--format", type=click.Choice(["exr", "npz"]), default="exr", help="Of the truth.")
@click.option("--workers", type=int, metavar="N", help="Processes.  [default: one per core]")
@click.option("--engine", default="local", metavar="NAME", help="local, or ray: the cluster of RAY_ADDRESS.")
def render(output: Path, workers: int | None, engine: str, **options: Any) -> None:
    """Render random shapes as a polarization camera records them, with the exact diffuse and specular images.

    Every view becomes a raw mosaic (PNG, 12-bit codes in 16-bit words), the truth (EXR or NPZ) and a record (JSON);
    manifest.jsonl lists all files with their sha256, contact.png shows some. The same options make the same bytes, with
    however many workers. A run that was stopped or killed goes on when the same command is given again.

    \b
    polsep render --shapes 500 --views 20 --size 1024 -o train               the paper's set
    polsep render --shapes 25 --views 20 --size 1024 --split test -o test    shapes that no training saw
    """
    try:
        from polsep.datasets.rendered import RenderOptions, default_workers, render_dataset
        from polsep.io.results.dataset import read_fingerprint

        asked = RenderOptions(**options)
        total = asked.shapes * asked.views
        counts = render_dataset(asked, output, default_workers() if workers is None else workers, engine)
        _show_counts(counts, total)
    except ModuleNotFoundError as error:
        extra = {"embreex": "render", "ray": "ray"}.get((error.name or "").partition(".")[0])
        if extra is None:
            raise
        raise click.ClickException(
            f"expected the extra {extra!r} (pip install 'polsep[{extra}]'), found none"
        ) from None
    except (ValueError, RuntimeError) as error:
        raise click.ClickException(str(error)) from None
    print(f"{output}: {total} views, manifest sha256 {read_fingerprint(output)}")


def _show_counts(counts: Iterator[int], total: int) -> None:
    """A progress bar over how many views of a set are there, where someone watches."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (TextColumn("rendering"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty()) as progress:
        task = progress.add_task("views", total=total, completed=next(counts))  # earlier runs tell nothing of the speed
        for count in counts:
            progress.update(task, completed=count)


@app.command()
@click.argument("rung")
@click.option("-o", "--output", type=DIR, required=True, metavar="DIR", help="A new directory, or one to go on with.")
@click.option(
    "--data",
    default="mosaic",
    metavar="NAME",
    help="mosaic: noisy frames; mono: without colours; co-sited: as the paper.",
)
@click.option(
    "--looks", default="varied", metavar="NAME", help="varied; usual: as in the paper, without glare and relief."
)
@click.option("--width", type=int, metavar="N", help="Channels of the network's first level; 32 on the ladder.")
@click.option("--levels", type=int, default=3, metavar="N", help="Halvings of a rung's networks.")
@click.option("--fold", type=int, default=2, metavar="N", help="N x N pixels are folded into channels; 1: none.")
@click.option("--blocks", metavar="N,N,...", help="Residual blocks per level of a joint network.")
@click.option("--entry", type=int, metavar="N", help="Channels that its maps are brought to first; 0: all.")
@click.option("--ablation", default="none", metavar="NAME", help="What a joint network goes without.")
@click.option(
    "--part", default="all", metavar="NAME", help="What of a joint network is trained: all, details or doubt."
)
@click.option("--input", "seen", default="separated", metavar="NAME", help="material: unseparated, separated, perfect.")
@click.option("--examples", type=int, default=768, metavar="N", help="material: how many it is trained on.")
@click.option("--cues", metavar="NAME,...", help="material: what it sees beside images (details), to find normals.")
@click.option("--folder", type=DIR, metavar="DIR", help="material: where these are, or go.  [default: DIR/../examples]")
@click.option("--steps", type=int, default=20_000, metavar="N", help="Batches of 8 crops, or of 4 materials.")
@click.option("--until", type=int, metavar="N", help="material: end at this step of the schedule.")
@click.option("--rate", type=float, default=1e-3, metavar="X", help="Peak learning rate.")
@click.option("--seed", type=int, default=0, metavar="N", help="Of the weights and of the data.")
@click.option("--workers", type=int, default=1, metavar="N", help="Processes that render, per device.")
@click.option("--devices", type=int, default=1, metavar="N", help="GPUs, where there are any.")
@click.option(
    "--start",
    type=click.Path(path_type=Path),
    multiple=True,
    metavar="FILE",
    help="Weights to begin with; several: mean.",
)
@click.option("--refit", is_flag=True, help="Fit the linear filter of a joint network anew, after --start.")
@click.option("--precision", default="bf16-mixed", metavar="NAME", help="bf16-mixed or 32-true.")
def train(rung: str, output: Path, data: str, **options: Any) -> None:
    """Train joint, joint-fast, material or a rung of the paper's ladder: paper, unpolarized, polarized, shared,
    signed, no-angle, stokes.

    Data are rendered while training, from seeds that no test has. A run that was stopped or killed goes on when the
    same command is given again. 'tensorboard --logdir DIR' shows its curves. Needs the extra train.

    \b
    polsep train joint -o runs/joint
    polsep train paper --data mono -o runs/mono                           for cameras without colour filters
    polsep train paper --width 64 --levels 4 --fold 1 -o runs/unet64      the classic U-Net
    polsep train material --input separated --steps 2000 -o runs/separated
    """
    try:
        from polsep.train.command import choose_options, plan_run, train_weights
        from polsep.train.loop import Run, Schedule
        from polsep.train.material_command import choose_material, train_material
        from polsep.train.stream import StreamOptions
    except ModuleNotFoundError as error:
        raise click.ClickException(
            f"expected the extra 'train' (pip install 'polsep[train]'), found no {error.name}"
        ) from None
    try:
        given = {name: options[name] for name in ("workers", "devices", "start", "refit")}
        if rung == "material":
            material, schedule = choose_material(options)
            folder = options["folder"] or output.parent / "examples"
            run = Run(output, schedule=schedule, until=options["until"], **given)
            path = train_material(material, run, folder, _show_training)
        else:
            asked = choose_options(rung, data, options)
            schedule = Schedule(options["steps"], options["rate"], precision=options["precision"])
            run = plan_run(Run(output, stream=StreamOptions(looks=options["looks"]), schedule=schedule, **given), asked)
            path = train_weights(asked, run, _show_training)
    except ValueError as error:
        raise click.ClickException(str(error)) from None
    print(path)


def _show_training(line: dict[str, Any]) -> None:
    """One line of a training's log."""
    values = (f"{name} {value:.4g}" for name, value in line.items())
    print(", ".join(values), file=sys.stderr, flush=True)


@app.command()
@click.argument("name", metavar="NAME", default="list")
@click.option("--data", type=DIR, default=Path("../shared/data"), metavar="DIR", help="For real and frontend.")
@click.option("-o", "--output", type=DIR, default=Path("results"), metavar="DIR", help="Where NAME.jsonl goes.")
@click.option("--quick", is_flag=True, help="A part of it in minutes, to DIR/NAME-quick.jsonl.")
@click.option(
    "--images",
    type=DIR,
    metavar="DIR",
    help="Where NAME's pictures go.  [default: docs/images/NAME; beside the rows with --quick]",
)
def bench(name: str, data: Path, output: Path, quick: bool, images: Path | None) -> None:
    """Measure NAME, print its rows and write them to DIR/NAME.jsonl; without NAME, list what can be measured.

    'polsep bench readme' makes the tables of README.md and docs anew from DIR. The paper's evaluation is run in a
    checkout of the repository: python -m evaluation.
    """
    from polsep.bench import BENCHES
    from polsep.bench.run import Folders, fill_tables_of_docs, list_benches, run_bench

    if name == "list":
        print("\n".join(list_benches(BENCHES)))
    elif name == "readme":
        fill_tables_of_docs(output)
    else:
        try:
            run_bench(BENCHES, name, "polsep bench", Folders(data, output, images), quick)
        except ValueError as error:
            raise click.ClickException(f"{error}{_in_the_laboratory(name)}") from None


def _in_the_laboratory(name: str) -> str:
    """Where benchmarks that left the package are run, for those who ask for one of them."""
    known = "rendering sets joint ablations dynamic calibration material video geometry view gallery gallery_real paper"
    return f"; in a checkout of polsep: python -m evaluation {name}" if name in known.split() else ""
