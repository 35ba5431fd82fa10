"""`polsep train material`: from options to a file of weights of the network for materials."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from polsep.material.examples import example_path, make_examples
from polsep.material.network import MaterialSize
from polsep.train.from_folder import Makers, Recipe, train_recipe
from polsep.train.loop import Run, Schedule, Training
from polsep.train.material_task import MaterialOptions, material_training

#: Steps of warm-up, and decay of the moving average; trainings are shorter than those of separation.
WARM_UP, AVERAGE = 50, 0.99


def choose_material(asked: dict[str, Any]) -> tuple[MaterialOptions, Schedule]:
    """Return options and schedule from those of the command line; see `polsep train`."""
    cues = tuple(asked["cues"].split(",")) if asked["cues"] else ()
    size = replace(MaterialSize(), cues=cues) if asked["width"] is None else MaterialSize(asked["width"], cues=cues)
    options = MaterialOptions(asked["seen"], size, asked["seed"], examples=asked["examples"])
    due = {"checkpoint_every": 50, "validate_every": 200}
    return options, Schedule(asked["steps"], asked["rate"], WARM_UP, AVERAGE, precision=asked["precision"], **due)


def train_material(options: MaterialOptions, run: Run, folder: Path, report: Callable[[dict[str, Any]], None]) -> Path:
    """`from_folder.train_recipe` on examples in a ``folder``, which are made where they are missing."""

    makers = Makers(folder, "material", "polsep.material.examples")
    sizes = {"train": options.examples, "validation": options.validation}

    def make() -> Training:
        makers.note(example_path(folder, name, options.seed, k) for name in sizes for k in range(sizes[name]))
        for split, count in sizes.items():
            for made in make_examples(folder, split, options.seed, count, options.views):
                if made % 100 == 0:
                    report({f"{split} examples": made})
        return material_training(options, folder)

    counts = [options.seed, options.examples, options.views, options.validation]
    words: dict[str, object] = {"cues": ",".join(options.size.cues)} if options.size.cues else {}
    return train_recipe(Recipe("material", options, make, lambda: makers.digest(counts), words, {}), run, report)
