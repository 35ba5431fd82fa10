"""`polsep train shape`: from options to a file of weights of the network for shape."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from polsep.io.assets.objects import hash_files, list_meshes, read_mesh
from polsep.render.models import creased
from polsep.train.from_folder import Makers, Recipe, train_recipe
from polsep.train.loop import Run, Schedule, Training
from polsep.train.shape_examples import Examples, make_examples
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


def train_shape(
    options: ShapeOptions, run: Run, folder: Path, report: Callable[[dict[str, Any]], None], meshes: Path | None = None
) -> Path:
    """`from_folder.train_recipe` on examples in a ``folder``, which are made where they are missing.

    ``meshes``: a folder of meshes, +y up, which as many examples again show.
    """
    found = [] if meshes is None else list_meshes(meshes)
    if found:
        options = replace(options, meshes=hash_files(found))
    makers = Makers(folder, "shape", "polsep.train.shape_examples")
    counts = dict.fromkeys(options.splits, options.examples) | {"validation": options.validation}

    def make() -> Training:
        shown = [creased(read_mesh(path)) for path in found]
        every = {split: Examples(split, options.seed, shown, options.meshes) for split in counts}
        makers.note(every[split].path(folder, k) for split in counts for k in range(counts[split]))
        for split, examples in every.items():
            for number in make_examples(examples, folder, range(counts[split])):
                if number % 100 == 99:
                    report({f"{split} examples": number + 1})
        return shape_training(options, folder)

    def data() -> str:
        return makers.digest([options.seed, options.examples, options.meshes])

    words: dict[str, object] = {"side": options.side, "part": options.part}
    words |= {} if meshes is None else {"meshes": meshes.name}
    return train_recipe(Recipe("shape", options, make, data, words, {"side": str(options.side)}), run, report)
