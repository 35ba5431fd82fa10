"""Fixed selection sets of known truth: random objects, statues and scans, and crossed-polarizer photographs.

A set is a tuple of `Recipe`; `build_cases` makes its scenes one by one. Every scene's inputs and outputs are recorded
in `expected`, and `version_of` is a sha256 over these records, so that nobody changes a selection set unknowingly. No
network is trained on them; docs/testsets.md lists the choices made by their scores. Needs the extra ``render``.
"""

from __future__ import annotations

from evaluation.testsets.cases import Case, Recipe, build_case, build_cases, check_case, fingerprint, version_of
from evaluation.testsets.objects import OBJECTS
from evaluation.testsets.photographs import PHOTOGRAPHS
from evaluation.testsets.sheet import draw_sheet
from evaluation.testsets.statues import STATUES

#: The selection sets by name: (a), (b) and (c) of docs/testsets.md. `sealed` is apart: nobody scores it by chance.
SETS: dict[str, tuple[Recipe, ...]] = {"objects": OBJECTS, "statues": STATUES, "photographs": PHOTOGRAPHS}

__all__ = [
    "OBJECTS",
    "PHOTOGRAPHS",
    "SETS",
    "STATUES",
    "Case",
    "Recipe",
    "build_case",
    "build_cases",
    "check_case",
    "draw_sheet",
    "fingerprint",
    "version_of",
]
