"""The picture of docs/material.md, in the manner of the paper's Fig. 9: maps from each input beside the true ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from evaluation.figures import Panel, Pixels, draw_grid, tone
from evaluation.material import load_estimators, metal_examples, novel_lights, photograph_under
from polsep.bench.rows import Row
from polsep.io.store.image_codecs import write_jpeg
from polsep.material.shots import Example, random_example
from polsep.material.svbrdf import INPUTS, Svbrdf, unstack

#: Held-out procedural materials that are shown, and with how many photographs.
SHOWN, VIEWS = (1, 8), 1
#: Which of `novel_lights` the relit picture is under.
LIGHT = 4
#: Reflectance that is white in the pictures of specular maps, of dielectrics and of samples with metal.
WHITE_SPECULAR, WHITE_METAL = 0.1, 1.0


def draw_material(rows: Sequence[Row], data: Path, folder: Path) -> Iterator[Path]:
    """Write a picture for every material shown, and give its path."""
    del rows, data
    for number in SHOWN:
        path = folder / f"material-{number}.jpg"
        write_jpeg(path, draw_example(random_example("test", 0, number, VIEWS), WHITE_SPECULAR))
        yield path
    (example,) = metal_examples(1)
    path = folder / "material-metal.jpg"
    write_jpeg(path, draw_example(example, WHITE_METAL))
    yield path


def draw_example(example: Example, white: float) -> Pixels:
    """A row for the truth and for each input: what the network saw, what it found, and that under another light.

    ``white``: reflectance that is white in the pictures of specular maps.
    """
    views = example.views.float()
    shown = [_row("truth", views[0, INPUTS["unseparated"]], unstack(example.maps.float()), white)]
    for name, estimator in load_estimators().items():
        part = INPUTS[name]
        found = estimator.estimate(views[:VIEWS, part])
        shown.append(_row(name, views[0, part], found, white))
    return draw_grid(shown, "Maps of a held-out procedural material from one photograph")


def _row(name: str, seen: Tensor, maps: Svbrdf, white: float) -> list[Panel]:
    pictures = [seen[:3], seen[3:]] if len(seen) == 6 else [seen, torch.zeros_like(seen)]
    light = novel_lights()[LIGHT]
    return [
        Panel(f"{name}: sees" if name != "truth" else "photograph", tone(pictures[0], 1.0)),
        Panel("and", tone(pictures[1], 1.0)) if len(seen) == 6 else Panel("", None),
        Panel("normal", _plain(maps.normal * 0.5 + 0.5)),
        Panel("diffuse", tone(maps.diffuse, 1.0)),
        Panel("roughness", _plain(maps.roughness.expand(3, -1, -1))),
        Panel("specular", tone(maps.specular, 1 / white)),
        Panel("under another light", tone(photograph_under(maps, light), 1.0)),
    ]


def _plain(image: Tensor) -> Pixels:
    """Numbers from 0 to 1 as they are."""
    pixels: Pixels = np.rint(255 * image.clamp(0, 1).permute(1, 2, 0).numpy()).astype(np.uint8)
    return pixels
