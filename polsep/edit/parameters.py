"""Parameters of edits as data, for recipes, sliders, options and tests.

A field of an edit is declared by `number_field`, `color_field` or `image_field`; its metadata make a `Parameter`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

Value = float | str | tuple[float, ...] | None

#: Kinds of images that edits name: any size; ``[h, w]`` in [0, 1]; unit vectors ``[h, w, 3]``.
IMAGES = ("texture", "mask", "normals")
KINDS = ("number", "color", *IMAGES)


class EditError(ValueError):
    """An unusable edit, recipe or image: one line of what was expected and what was found."""


@dataclass(frozen=True)
class Parameter:
    """One value of an edit.

    ``kind``: of `KINDS`: a number from ``low`` to ``high``, a colour of three such numbers (linear, camera RGB), or the
    name of an image. ``neutral``: the value at which the edit is the identity, whatever its other values; None if
    there is none. ``required``: there is no ``default``.
    """

    name: str
    kind: str
    default: Value = None
    low: float = 0.0
    high: float = 1.0
    unit: str = ""
    text: str = ""
    neutral: Value = None
    required: bool = False

    def check(self, value: object) -> Value:
        """The value as the edit keeps it: float, tuple or name. Raises EditError on any other."""
        if self.kind in IMAGES:
            return self._check_name(value)
        if self.kind == "number":
            return self._check_number(value)
        if not isinstance(value, Sequence | np.ndarray) or isinstance(value, str) or len(value) != 3:
            raise EditError(f"expected three numbers R, G, B as {self.name}, found {value!r:.60}")
        return tuple(self._check_number(part) for part in value)

    def _check_name(self, value: object) -> str | None:
        if isinstance(value, str) and value:
            return value
        if value is None and not self.required:
            return None
        raise EditError(f"expected the name of an image as {self.name}, found {value!r:.60}")

    def _check_number(self, value: object) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
            raise EditError(f"expected a number as {self.name}, found {value!r:.60}")
        if not self.low <= value <= self.high:
            raise EditError(f"expected {self.name} from {self.low:g} to {self.high:g}, found {value!r:.60}")
        return float(value)


def number_field(
    default: float, limits: tuple[float, float], text: str, unit: str = "", neutral: float | None = None
) -> Any:
    """A field for a number within ``limits``."""
    return field(default=default, metadata=_about("number", limits, text, unit, neutral))


def color_field(default: tuple[float, float, float], high: float, text: str, neutral: Value = None) -> Any:
    """A field for a linear colour of three numbers from 0 to ``high``."""
    return field(default=default, metadata=_about("color", (0.0, high), text, "", neutral))


def image_field(kind: str, text: str, required: bool = False) -> Any:
    """A field for the name of an image of a ``kind`` of `IMAGES`."""
    about = _about(kind, (0.0, 1.0), text, "", None)
    return field(metadata=about) if required else field(default=None, metadata=about)


def _about(kind: str, limits: tuple[float, float], text: str, unit: str, neutral: Value) -> dict[str, Any]:
    return {"kind": kind, "low": limits[0], "high": limits[1], "text": text, "unit": unit, "neutral": neutral}


def parameters_of(edit: Any) -> tuple[Parameter, ...]:
    """The parameters of an edit or of its class, in order."""
    found = []
    for declared in dataclasses.fields(edit):
        required = declared.default is dataclasses.MISSING
        default: Any = None if required else declared.default
        found.append(Parameter(declared.name, default=default, required=required, **declared.metadata))
    return tuple(found)
