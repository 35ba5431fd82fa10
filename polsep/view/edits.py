"""Edits as controls: from the registry of `polsep.edit` to controls of a page, and from their values to recipes.

The panel is generated: an edit in `EDITS` appears by itself. Every control starts where its edit is the identity.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from polsep.edit import EDITS, Edit, EditError, Parameter, Recipe, SeparatedImages, apply, make_edit
from polsep.edit.images import Maps
from polsep.physics.srgb import linear_from_srgb, srgb
from polsep.view.pictures import Floats, Small


@dataclass(frozen=True)
class Control:
    """The control of one parameter of an edit; ``start``: its first value."""

    edit: type[Edit]
    parameter: Parameter
    start: float | str

    @property
    def label(self) -> str:
        """The parameter's name with its unit."""
        name = self.parameter.name.capitalize()
        return f"{name} [{self.parameter.unit}]" if self.parameter.unit else name

    @property
    def step(self) -> float:
        """A round step, about a thousandth of the range, so that the slider can stand where its box says."""
        span = float(self.parameter.high - self.parameter.low) / 1000
        power = 10.0 ** math.floor(math.log10(span))
        return next(n * power for n in (5, 2, 1) if n * power <= span * (1 + 1e-9))


def list_controls() -> tuple[Control, ...]:
    """The controls of every edit, in the order in which edits are applied. Images are uploaded instead."""
    return tuple(
        Control(kind, parameter, _start(parameter))
        for kind in EDITS.values()
        for parameter in kind.parameters()
        if parameter.kind in ("number", "color")
    )


def _start(parameter: Parameter) -> float | str:
    """The neutral value, else the default; colours as sRGB text."""
    value: Any = parameter.default if parameter.neutral is None else parameter.neutral
    if parameter.kind == "number":
        return float(value)
    return "#" + "".join(f"{round(255 * float(part)):02x}" for part in srgb(np.asarray(value)))


def recipe_of(values: Sequence[Any], images: Mapping[str, str] | None = None) -> Recipe:
    """The recipe of values of the controls, in the order of `list_controls`, without neutral edits.

    ``images``: names of uploaded images, by kind; the mask is that of all edits, as with `polsep edit --mask`. Edits
    without their image are left out. Raises ValueError on values out of range.
    """
    sent = images or {}
    said: dict[type[Edit], dict[str, Any]] = {}
    for control, value in zip(list_controls(), values, strict=True):
        kept = _color(value) if control.parameter.kind == "color" else value
        said.setdefault(control.edit, {})[control.parameter.name] = kept
    named = {kind: {p.name: sent[p.kind] for p in kind.parameters() if p.kind in sent} for kind in said}
    ready = [kind for kind in said if all(p.name in named[kind] for p in kind.parameters() if p.required)]
    edits = (make_edit(kind, said[kind] | named[kind]) for kind in ready)
    return Recipe(tuple(edit for edit in edits if not edit.is_neutral()))


def _color(text: object) -> tuple[float, ...]:
    """Linear light of ``#rrggbb`` or ``rgba(r, g, b, a)``, the formats of browsers."""
    said = str(text)
    if (found := re.fullmatch(r"#([0-9a-fA-F]{6})", said)) is not None:
        codes = [float(code) for code in bytes.fromhex(found[1])]
    elif (found := re.fullmatch(r"rgba?\(([\d.]+),\s*([\d.]+),\s*([\d.]+)(?:,\s*[\d.]+)?\)", said)) is not None:
        codes = [float(found[k]) for k in (1, 2, 3)]
    else:
        raise ValueError(f"expected a colour like #c04020, found {said!r:.40}")
    return tuple(float(part) for part in linear_from_srgb(np.array(codes) / 255))


def edit_small(small: Small, recipe: Recipe, maps: Maps | None = None) -> Floats:
    """The edited picture at screen size, linear; lengths in pixels shrink with it. ``maps``: images, as small.

    Raises EditError.
    """
    shown = Recipe(tuple(at_scale(edit, small.step) for edit in recipe.edits))
    return apply(SeparatedImages(small.diffuse, small.specular), shown, maps).combined


def keep_fitting(small: Small, recipe: Recipe, maps: Maps) -> tuple[Recipe, tuple[str, ...]]:
    """The edits of a recipe that fit a frame at screen size, and a remark on each of the others."""
    kept, remarks, images = [], [], SeparatedImages(small.diffuse, small.specular)
    for edit in recipe.edits:
        try:
            at_scale(edit, small.step).change(images, maps)
        except EditError as error:
            remarks.append(f"{edit.title} is left out: {error}")
        else:
            kept.append(edit)
    return Recipe(tuple(kept)), tuple(remarks)


def at_scale(edit: Edit, step: int) -> Edit:
    """The edit of images whose pixels are ``step`` pixels of the frame wide."""
    lengths = {p.name: getattr(edit, p.name) / step for p in edit.parameters() if p.unit == "px"}
    return replace(edit, **lengths)
