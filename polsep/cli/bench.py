"""The command that measures: bench."""

from __future__ import annotations

from pathlib import Path

import click

from polsep.cli.app import DIR, app


@app.command()
@click.argument("name", metavar="NAME", default="list")
@click.option(
    "--data", type=DIR, envvar="POLSEP_DATA", metavar="DIR", help="Data of real, frontend.  [env: POLSEP_DATA]"
)
@click.option("-o", "--output", type=DIR, default=Path("results"), metavar="DIR", help="Folder of NAME.jsonl.")
@click.option("--quick", is_flag=True, help="Measure a part in minutes, to DIR/NAME-quick.jsonl.")
@click.option(
    "--images",
    type=DIR,
    metavar="DIR",
    help="Folder of NAME's pictures.  [default: docs/images/NAME; beside the rows with --quick]",
)
def bench(name: str, data: Path | None, output: Path, quick: bool, images: Path | None) -> None:
    """Measure NAME, print its rows and write them to DIR/NAME.jsonl; without NAME, list what can be measured.

    'polsep bench readme' writes the tables of README.md and docs from DIR. The paper's evaluation runs in a checkout
    of the repository: python -m evaluation.
    """
    from polsep.bench import BENCHES
    from polsep.bench.run import Folders, fill_tables_of_docs, list_benches, run_bench

    if name == "list":
        print("\n".join(list_benches(BENCHES)))
    elif name == "readme":
        fill_tables_of_docs(output, {bench: entry.measures for bench, entry in BENCHES.items()})
    else:
        try:
            run_bench(BENCHES, name, "polsep bench", Folders(data, output, images), quick)
        except ValueError as error:
            raise click.ClickException(f"{error}{_evaluation_hint(name)}") from None


def _evaluation_hint(name: str) -> str:
    """The command of a benchmark that is in ``evaluation``, outside the package."""
    known = "rendering sets joint ablations dynamic calibration material video geometry view gallery gallery_real paper"
    return f"; in a checkout of polsep: python -m evaluation {name}" if name in known.split() else ""
