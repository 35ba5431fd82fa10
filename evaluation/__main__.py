"""``python -m evaluation NAME``: measure NAME, print its rows, write them to results/NAME.jsonl, draw its pictures."""

from __future__ import annotations

from pathlib import Path

import click

from evaluation import InputFailure
from evaluation.benches import BENCHES, MEASURES
from evaluation.faults import faults
from evaluation.house import house
from evaluation.reliability import reliability
from evaluation.sealed import sealed
from evaluation.soak import soak
from polsep.bench.rows import accept_partial
from polsep.bench.run import Folders, fill_tables_of_docs, run_bench
from polsep.cli.app import said_command

DIR = click.Path(file_okay=False, path_type=Path)
RESULTS = click.Option(["-o", "--output"], type=DIR, default=Path("results"), metavar="DIR", help="Of NAME.jsonl.")
OPTIONS = (
    click.Option(["--data"], type=DIR, envvar="POLSEP_DATA", metavar="DIR", help="Captures and truth; or POLSEP_DATA."),
    click.Option(["--quick"], is_flag=True, help="A part of it in minutes, to DIR/NAME-quick.jsonl."),
    click.Option(["--images"], type=DIR, metavar="DIR", help="Where pictures go.  [default: docs/images/NAME]"),
    RESULTS,
)


def measure(data: Path | None, output: Path, quick: bool, images: Path | None) -> None:
    """Run the benchmark that the command is called after."""
    name = click.get_current_context().info_name or ""
    try:
        run_bench(BENCHES, name, said_command("python -m evaluation"), Folders(data, output, images), quick)
    except ValueError as error:
        raise InputFailure(str(error)) from None


def fill_tables(output: Path) -> None:
    """Make the tables of README.md and docs anew, and say below them which are older than the code."""
    try:
        fill_tables_of_docs(output, MEASURES)
    except ValueError as error:
        raise InputFailure(str(error)) from None


def accept(name: str, output: Path) -> None:
    """Replace DIR/NAME.jsonl by DIR/NAME-partial.jsonl, where a benchmark no longer measures some cases; list those."""
    try:
        print("\n".join(f"dropped {case}" for case in accept_partial(output, name)))
    except ValueError as error:
        raise InputFailure(str(error)) from None


app = click.Group(help=__doc__)
app.add_command(faults)
app.add_command(house)
app.add_command(reliability)
app.add_command(sealed)
app.add_command(soak)
app.add_command(
    click.Command("accept", callback=accept, params=[click.Argument(["name"]), RESULTS], help=accept.__doc__)
)
app.add_command(click.Command("readme", callback=fill_tables, params=[RESULTS], help=fill_tables.__doc__))
for name, bench in BENCHES.items():
    app.add_command(click.Command(name, callback=measure, params=list(OPTIONS), help=bench.run.__doc__))

if __name__ == "__main__":
    app()
