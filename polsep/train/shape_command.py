"""`polsep train shape`: from options to a file of weights of the network for shape."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from polsep.train.from_folder import Makers, Recipe, train_recipe
from polsep.train.loop import Run, Schedule, Training
from polsep.train.shape_examples import example_path, make_examples
from polsep.train.shape_task import ShapeOptions, shape_training

#: Steps of warm-up, and decay of the moving average.
WARM_UP, AVERAGE = 100, 0.995


def choose_shape(asked: dict[str, Any]) -> tuple[ShapeOptions, Schedule]:
    """Return options and schedule from those of the command line; see `polsep train`."""
    usual = ShapeOptions()
    size = usual.size if asked["width"] is None else replace(usual.size, width=asked["width"])
    kind = {name: asked[name] for name in ("side", "examples", "part")}
    options = ShapeOptions(asked["seen"], size, asked["seed"], **kind)
    due = {"checkpoint_every": 200, "validate_every": 500}
    return options, Schedule(asked["steps"], asked["rate"], WARM_UP, AVERAGE, precision=asked["precision"], **due)


def train_shape(options: ShapeOptions, run: Run, folder: Path, report: Callable[[dict[str, Any]], None]) -> Path:
    """`from_folder.train_recipe` on examples in a ``folder``, which are made where they are missing."""

    makers = Makers(folder, "shape", "polsep.train.shape_examples")
    counts = {"train": options.examples, "validation": options.validation}

    def make() -> Training:
        makers.note(example_path(folder, name, options.seed, k) for name in counts for k in range(counts[name]))
        for split, count in counts.items():
            for number in make_examples(folder, split, options.seed, range(count)):
                if number % 100 == 99:
                    report({f"{split} examples": number + 1})
        return shape_training(options, folder)

    def data() -> str:
        return makers.digest([options.seed, options.examples])

    words: dict[str, object] = {"side": options.side, "part": options.part}
    return train_recipe(Recipe("shape", options, make, data, words, {"side": str(options.side)}), run, report)
