"""The state of the installation: doctor."""

from __future__ import annotations

import json
import sys
from typing import Any

import click

from polsep.cli.app import EXTRAS, app, print_note

#: Words for the precision of layers.
_PRECISIONS = {
    "bf16": "bfloat16 (AMX)",
    "i8": "8-bit integers (VNNI)",
    "i8-bf16": "8-bit integers (VNNI) and bfloat16",
    "f32": "float32",
}


@app.command()
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON.")
def doctor(as_json: bool) -> None:
    """Say what is installed, what will run a frame, and whether every method works.

    Separates a crop of the example frame by every method and writes and reads a file: a few seconds, or some minutes
    where kernels have to be compiled first. The exit status is 0 only if all that a bare install promises works; extras
    and cameras that are missing are no failure.
    """
    from polsep.doctor import examine

    facts = examine(EXTRAS)
    if as_json:
        print(json.dumps(facts, indent=2))
    else:
        print("\n".join(_lines(facts)))
    for problem in facts["problems"]:
        print_note(f"error: {problem}")
    if facts["problems"]:
        sys.exit(2)


def _lines(facts: dict[str, Any]) -> list[str]:
    """The facts, a line each."""
    cache, cameras = facts["cache"], facts["cameras"] or {"found": {}, "missing": {}}
    lines = [
        f"polsep      {facts['polsep']} in {facts['folder']}",
        f"python      {facts['python']}, {facts['system']}",
        f"packages    {', '.join(f'{name} {found}' for name, found in facts['packages'].items() if found)}",
        f"processor   {facts['cores']} cores, {facts['threads']} threads; {' '.join(facts['instructions'] or ['-'])}",
        f"kernels     {_of_kernels(facts['kernels'])}",
        f"networks    OpenVINO, layers in {_PRECISIONS.get(facts['precision'], facts['precision'])}",
        f"device      {facts['device']}",
    ]
    if cache and cache["folder"]:
        needed = "" if cache["needed"] else " (not needed for separating)"
        lines.append(f"cache       {cache['folder']}, {'' if cache['writable'] else 'not '}writable{needed}")
    lines += [f"camera      {name}: {text}" for name, text in cameras["found"].items()] or ["cameras     none found"]
    lines += [f"            no {name}: {reason}" for name, reason in cameras["missing"].items()]
    present = [name for name, missing in facts["extras"].items() if not missing]
    lines.append(f"extras      {', '.join(present) or 'none'}")
    if facts["extra_packages"]:
        lines.append(f"            {', '.join(f'{name} {found}' for name, found in facts['extra_packages'].items())}")
    for name, missing in facts["extras"].items():
        if missing:
            lines.append(f"            no {name} (no {', '.join(missing)}): pip install 'polsep[{name}]'")
    for name, test in facts["tests"].items():
        lines.append(f"self-test   {name}: {test['error'] or 'works'}, {test['seconds']:.1f} s")
    return lines


def _of_kernels(found: str | None) -> str:
    return "compiled ahead, comes with polsep" if found == "library" else f"compiled on first use by {found}"
