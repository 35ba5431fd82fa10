"""Recipes: edits in order, stored as small JSON files that can be applied to other frames.

    {"polsep_recipe": 1, "edits": [{"edit": "rougher", "sigma": 10.0}, {"edit": "metallic", "gain": 45.0}]}

Missing values are defaults; a written recipe has all values. Anything else is refused in one line. Images are named in
a recipe: by file names relative to the recipe, at the command line.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

from polsep.edit.edits import EDITS, Edit
from polsep.edit.images import Maps, Separated, SeparatedImages
from polsep.edit.parameters import IMAGES, EditError

#: The only version there is.
VERSION = 1
_KEY = "polsep_recipe"


@dataclass(frozen=True)
class Recipe:
    """Edits in the order in which they are applied.

    Raises EditError where one image name stands for two kinds, and on what are no edits.
    """

    edits: tuple[Edit, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.edits, tuple | list) or not all(isinstance(edit, Edit) for edit in self.edits):
            raise EditError(f"expected a recipe of edits, Recipe((Rougher(), Metallic())), found {_brief(self.edits)}")
        kinds: dict[str, str] = {}
        for edit in self.edits:
            for kind, name in edit.images():
                if kinds.setdefault(name, kind) != kind:
                    raise EditError(f"expected an image for each use, found {name!r} as {kinds[name]} and as {kind}")

    def images(self) -> dict[str, str]:
        """The kind of each image by its name."""
        return {name: kind for edit in self.edits for kind, name in edit.images()}

    def cautions(self) -> list[str]:
        """The limits of the edits that are not neutral, a line each."""
        return list(dict.fromkeys(edit.caution for edit in self.edits if edit.caution and not edit.is_neutral()))


def rename_images(recipe: Recipe, renaming: Callable[[str], str]) -> Recipe:
    """The recipe with other names of its images."""
    return Recipe(tuple(_renamed(edit, renaming) for edit in recipe.edits))


def _renamed(edit: Edit, renaming: Callable[[str], str]) -> Edit:
    names = {p.name: getattr(edit, p.name) for p in edit.parameters() if p.kind in IMAGES}
    return replace(edit, **{field: renaming(name) for field, name in names.items() if name is not None})


def apply(images: Separated, recipe: Recipe, maps: Maps | None = None) -> SeparatedImages:
    """The edits of a recipe on one frame, one after the other; ``maps``: the images that they name.

    ``images``: a `SeparatedFrame`, or anything with diffuse and specular images as float32 ``[h, w, 3 or 1]``, linear,
    0 or more. The frame itself is never changed; images that no edit changes are the same arrays.
    Raises EditError, naming the edit, if one does not fit the images.
    """
    if not isinstance(recipe, Recipe):
        raise EditError(f"expected a Recipe of edits, found {type(recipe).__name__}")
    if not (hasattr(images, "diffuse") and hasattr(images, "specular")):
        raise EditError(f"expected a frame with diffuse and specular images, found {type(images).__name__}")
    edited = SeparatedImages(images.diffuse, images.specular)
    for place, edit in enumerate(recipe.edits, 1):
        try:
            edited = edit.change(edited, maps or {})
        except EditError as error:
            raise EditError(f"edit {place}, {edit.name}: {error}") from error
    return edited


def recipe_as_data(recipe: Recipe) -> dict[str, Any]:
    """A recipe as JSON-able values, complete."""
    return {_KEY: VERSION, "edits": [_edit_as_data(edit) for edit in recipe.edits]}


def recipe_as_text(recipe: Recipe) -> str:
    """A recipe as the JSON that a file of it holds, an edit per line."""
    lines = ",\n".join(f"    {json.dumps(_edit_as_data(edit))}" for edit in recipe.edits)
    return f'{{\n  "{_KEY}": {VERSION},\n  "edits": [\n{lines}\n  ]\n}}\n'


def _edit_as_data(edit: Edit) -> dict[str, Any]:
    values = {p.name: getattr(edit, p.name) for p in edit.parameters()}
    kept = {n: list(v) if isinstance(v, tuple) else v for n, v in values.items() if v is not None}
    return {"edit": edit.name, **kept}


def recipe_from_text(text: str) -> Recipe:
    """The recipe that a JSON text holds, also behind a byte order mark. Raises EditError."""
    if not isinstance(text, str):
        raise EditError(f"expected a recipe as text, found {type(text).__name__}")
    try:
        data = json.loads(
            text.removeprefix("\ufeff"), object_pairs_hook=_without_repeats
        )  # edits check their numbers, and name themselves
    except EditError:
        raise
    except RecursionError:
        raise EditError("expected a recipe as JSON, found hundreds of levels") from None
    except ValueError as error:
        raise EditError(f"expected a recipe as JSON, found {error}") from error
    return recipe_from_data(data)


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        counts = Counter(name for name, _ in pairs)
        raise EditError(f"expected each key once, found {_brief(counts.most_common(1)[0][0])} again")
    return found


def recipe_from_data(data: object) -> Recipe:
    """The recipe of JSON values. Raises EditError."""
    if not isinstance(data, Mapping):
        raise EditError(f'expected a recipe {{"{_KEY}": {VERSION}, "edits": [...]}}, found {_brief(data)}')
    if _KEY not in data:
        raise EditError(f'expected "{_KEY}": {VERSION}, found no such key among {_names(data)}')
    if isinstance(data[_KEY], bool) or data[_KEY] != VERSION:
        raise EditError(f"expected a recipe of version {VERSION}, found {_brief(data[_KEY])}")
    _refuse_unknown(data, (_KEY, "edits"), "a recipe")
    edits = data.get("edits")
    if not isinstance(edits, list):
        raise EditError(f'expected a list as "edits", found {_brief(edits)}')
    return Recipe(tuple(_edit_from_data(edit, place) for place, edit in enumerate(edits, 1)))


def _edit_from_data(data: object, place: int) -> Edit:
    """One edit of a recipe; its ``place`` is named in errors."""
    if not isinstance(data, Mapping):
        raise EditError(f'edit {place}: expected {{"edit": NAME, ...}}, found {_brief(data)}')
    name = data.get("edit")
    if not isinstance(name, str) or name not in EDITS:
        raise EditError(f"edit {place}: expected an edit of {', '.join(EDITS)}, found {_brief(name)}")
    kind = EDITS[name]
    try:
        return make_edit(kind, {key: value for key, value in data.items() if key != "edit"})
    except EditError as error:
        raise EditError(f"edit {place}, {name}: {error}") from error


def make_edit(kind: type[Edit], values: Mapping[str, Any]) -> Edit:
    """An edit of a kind from values by name; those that are left out are defaults. Raises EditError."""
    if not (isinstance(kind, type) and issubclass(kind, Edit)):
        raise EditError(f"expected a kind of edit, such as Rougher or EDITS['rougher'], found {kind!r:.40}")
    parameters = kind.parameters()
    _refuse_unknown(values, tuple(p.name for p in parameters), kind.name)
    for parameter in parameters:
        if parameter.required and parameter.name not in values:
            raise EditError(f"expected {parameter.name}, found {_names(values)}")
    return kind(**values)


def _refuse_unknown(data: Mapping[str, Any], known: tuple[str, ...], where: str) -> None:
    unknown = [key for key in data if key not in known]
    if unknown:
        raise EditError(f"expected only {', '.join(known)} in {where}, found {_names(dict.fromkeys(unknown))}")


def _names(data: Mapping[str, Any]) -> str:
    names = [_brief(name) for name in islice(data, 4)]
    return ", ".join(names + ["..."] * (len(data) > len(names))) or "nothing"


def _brief(value: object) -> str:
    return f"{value!r:.60}"
