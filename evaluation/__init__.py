"""The laboratory: the paper's tables, the selection sets, galleries and peers, from a checkout of the repository."""

from __future__ import annotations

from pathlib import Path

import click

#: Weights of networks that are measured here alone, and so are not in the package.
WEIGHTS = Path(__file__).parent / "weights"


class InputFailure(click.ClickException):
    """Something that cannot be measured here: one line, exit status 2."""

    exit_code = 2
