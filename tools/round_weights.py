"""``python -m tools.round_weights FILE...``: write large layers of weights in 8 bits (`polsep.io.store.rounding`).

That halves the file. What is inactive in a joint network becomes 0, also in a file that is rounded already.
``--examples DIR`` rounds networks for shape so that what they say of the examples of `polsep train shape` there stays
(`polsep.train.rounding`).
"""

from __future__ import annotations

import json
from itertools import islice
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from polsep.io.store.rounding import coarsened, names_to_round, steps_of
from polsep.io.store.weights import read_weights, write_weights
from polsep.networks.ranges import pruned

#: Batches of 8 examples that are looked at.
BATCHES = 8


@click.command()
@click.argument("paths", type=click.Path(path_type=Path), nargs=-1, metavar="FILE...")
@click.option("--examples", type=click.Path(exists=True, file_okay=False, path_type=Path), metavar="DIR")
def main(paths: tuple[Path, ...], examples: Path | None) -> None:
    """Round and write."""
    for path in paths:
        arrays, metadata = read_weights(path)
        names, before, own = names_to_round(arrays, metadata), path.stat().st_size, metadata.pop("sha256")
        arrays = pruned(arrays, json.loads(metadata.get("ranges", "{}")))
        if "rounded_from" in metadata:
            write_weights(path, arrays, metadata, names)
            continue
        counts = {name: steps_of(arrays[name], metadata["method"]) for name in names}
        if examples is not None:
            arrays = _rounded_by_examples(arrays, metadata, counts, examples)
        else:
            arrays |= {name: coarsened(arrays[name], n) for name, n in counts.items() if n < 127}
        write_weights(path, arrays, metadata | {"rounded_from": own}, names)
        share = sum(arrays[name].size for name in names) / sum(array.size for array in arrays.values())
        print(f"{path}: {len(names)} arrays, {share:.0%} of the numbers, {before} to {path.stat().st_size} bytes")


def _rounded_by_examples(
    arrays: dict[str, NDArray[Any]], metadata: dict[str, str], counts: dict[str, int], folder: Path
) -> dict[str, NDArray[Any]]:
    """The arrays of a network for shape, rounded by what its layers see of training examples in a folder."""
    import torch

    from polsep.geometry.shape_maps import encode
    from polsep.networks.sizes import ResidualSize
    from polsep.train.rounding import round_layers
    from polsep.train.shape_task import ShapeOptions, batches, encoding_of, seen_of

    if metadata["method"] != "shape":
        raise click.ClickException(f"expected a network for shape with --examples, found {metadata['method']!r}")
    size = json.loads(metadata["size"])
    sides = ResidualSize(size["width"], tuple(size["blocks"]), size["entry"])
    options = ShapeOptions(metadata["input"], sides, side=int(metadata["side"]))
    paths = [path for path in sorted(folder.glob("shape-*.npy")) if not path.name.startswith("shape-validation")]
    if not paths:
        raise click.ClickException(f"expected examples of polsep train shape in {folder}, found none")
    network = options.network()
    network.load_state_dict({name: torch.from_numpy(array.astype(np.float32)) for name, array in arrays.items()})
    seen = (seen_of(batch.planes, options.input) for batch in islice(batches(options, paths, 0, (0, 1)), BATCHES))
    inputs = [encode(images, encoding_of(options.input)) for images in seen]
    round_layers(network, {name.removesuffix(".weight"): count for name, count in counts.items()}, inputs)
    return {name: value.numpy() for name, value in network.state_dict().items()}


if __name__ == "__main__":
    main()
