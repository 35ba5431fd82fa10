"""The command that measures: bench."""

from __future__ import annotations

from pathlib import Path

import click

from polsep.cli.app import DIR, app, said_command

#: Benchmarks of ``evaluation``, which the package does not hold.
EVALUATED = (
    "rendering sets joint ablations repeats dynamic calibration sensors material video geometry shape install web "
    "agreement warned view gallery gallery_real paper"
)


@app.command()
@click.argument("name", metavar="NAME", default="list")
@click.option(
    "--data", type=DIR, envvar="POLSEP_DATA", metavar="DIR", help="Data of real, frontend, reality.  [env: POLSEP_DATA]"
)
@click.option("-o", "--output", type=DIR, default=Path("results"), metavar="DIR", help="Folder of NAME.jsonl.")
@click.option("--quick", is_flag=True, help="Measure a part in minutes, to DIR/NAME-quick.jsonl.")
@click.option(
    "--images",
    type=DIR,
    metavar="DIR",
    help="Folder of NAME's pictures.  [default: docs/images/NAME; beside the rows with --quick]",
)
@click.option("--rows", metavar="A;B", help="Only these rows, of 'reality'; implies --quick.")
@click.option("--methods", metavar="A,B", help="Only these methods, of 'reality'; implies --quick.")
@click.option(
    "--split", metavar="NAME", help="Split that 'reality' draws scenes from: test, or validation for choices."
)
def bench(
    name: str,
    data: Path | None,
    output: Path,
    quick: bool,
    images: Path | None,
    rows: str | None,
    methods: str | None,
    split: str | None,
) -> None:
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
            benches = BENCHES
            if name == "reality":
                from polsep.bench.reality import RealityOptions, select_reality

                options = RealityOptions(split or "test", _words(rows, ";"), _words(methods, ","))
                quick = quick or options != RealityOptions()
                if not quick and (data is None or not (data / "raw").is_dir()):
                    raise ValueError(
                        "expected --data DIR with raw frames in DIR/raw, which all of reality needs, found none"
                    )
                benches = BENCHES | {name: select_reality(BENCHES[name], options, data)}
            elif rows or methods or split:
                raise ValueError(f"expected --rows, --methods and --split with reality, found them with {name!r}")
            run_bench(benches, name, said_command("polsep"), Folders(data, output, images), quick)
        except ValueError as error:
            raise click.ClickException(f"{error}{_evaluation_hint(name)}") from None


def _words(text: str | None, separator: str) -> tuple[str, ...]:
    """The words of an option, none without it."""
    return tuple(word.strip() for word in text.split(separator)) if text else ()


def _evaluation_hint(name: str) -> str:
    """The command of a benchmark that is in ``evaluation``, outside the package."""
    return f"; in a checkout of polsep: python -m evaluation {name}" if name in EVALUATED.split() else ""
