"""``python -m evaluation NAME``: measure NAME, print its rows, write them to results/NAME.jsonl, draw its pictures."""

from __future__ import annotations

from pathlib import Path

import click

from evaluation.benches import BENCHES
from polsep.bench.run import Folders, list_benches, run_bench

DIR = click.Path(file_okay=False, path_type=Path)


@click.command()
@click.argument("name", metavar="NAME", default="list")
@click.option("--data", type=DIR, default=Path("../shared/data"), metavar="DIR", help="Captures and ground truth.")
@click.option("-o", "--output", type=DIR, default=Path("results"), metavar="DIR", help="Where NAME.jsonl goes.")
@click.option("--quick", is_flag=True, help="A part of it in minutes, to DIR/NAME-quick.jsonl.")
@click.option("--images", type=DIR, metavar="DIR", help="Where pictures go.  [default: docs/images/NAME]")
def main(name: str, data: Path, output: Path, quick: bool, images: Path | None) -> None:
    """Measure NAME; without NAME, list what can be measured."""
    if name == "list":
        print("\n".join(list_benches(BENCHES)))
        return
    try:
        run_bench(BENCHES, name, "python -m evaluation", Folders(data, output, images), quick)
    except ValueError as error:
        raise click.UsageError(str(error)) from None


if __name__ == "__main__":
    main()
