"""Appearance edits of separated frames: metal, matte, texture, highlights, light (Dave et al. 2022, Fig. 8, and more).

    from polsep.edit import Metallic, Recipe, Rougher, apply
    edited = apply(polsep.separate(raw), Recipe((Rougher(sigma=10), Metallic())))
    edited.diffuse, edited.specular, edited.combined   # linear, float32 [h, w, C]

`EDITS` holds every edit by name; each has ``parameters()`` as data: kinds, ranges, units, neutral values.
docs/editing.md tells what each does.
"""

from polsep.edit.edits import (
    EDITS,
    DiffuseGain,
    Edit,
    IsolateHighlights,
    Metallic,
    Recolor,
    RemoveHighlights,
    Rougher,
    Sharper,
    SpecularGain,
    Texture,
    Tint,
)
from polsep.edit.images import SeparatedImages
from polsep.edit.parameters import EditError, Parameter
from polsep.edit.recipe import (
    Recipe,
    apply,
    make_edit,
    recipe_as_data,
    recipe_as_text,
    recipe_from_data,
    recipe_from_text,
)

__all__ = [
    "EDITS",
    "DiffuseGain",
    "Edit",
    "EditError",
    "IsolateHighlights",
    "Metallic",
    "Parameter",
    "Recipe",
    "Recolor",
    "RemoveHighlights",
    "Rougher",
    "SeparatedImages",
    "Sharper",
    "SpecularGain",
    "Texture",
    "Tint",
    "apply",
    "make_edit",
    "recipe_as_data",
    "recipe_as_text",
    "recipe_from_data",
    "recipe_from_text",
]
