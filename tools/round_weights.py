"""``python -m tools.round_weights FILE...``: write large layers of weights in 8 bits, which halves the file.

Of joint networks these are the layers that run in 8 bits where the processor multiplies those, and which compute the
same there from rounded weights, and those that see the whole frame. Of others, layers of `LEAST` numbers or more but
for the first and the last: small layers at high resolution cost most. docs/weights.md says what all this costs. A file
that is rounded already stays as it is.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from polsep.io.store.weights import read_weights, write_weights

#: Fewest numbers of a layer that is rounded where no ranges are known.
LEAST = 30_000
#: Parts of the names of first and last layers.
ENDS = ("encoders.0.0.", "last.")


def names_to_round(arrays: Mapping[str, NDArray[Any]], metadata: Mapping[str, str]) -> set[str]:
    """The names of the arrays that are written in 8 bits."""
    if "ranges" in metadata:
        whole = {name for name in arrays if name.startswith("whole_frame.") and arrays[name].ndim > 1}
        return whole | {f"{layer}.weight" for layer in json.loads(metadata["ranges"])} & arrays.keys()
    large = {name for name, array in arrays.items() if array.ndim > 1 and array.size >= LEAST}
    return {name for name in large if not any(end in name for end in ENDS)}


def main(paths: list[str]) -> None:
    """Round and write."""
    for path in map(Path, paths):
        arrays, metadata = read_weights(path)
        if "rounded_from" in metadata:
            continue
        names, before = names_to_round(arrays, metadata), path.stat().st_size
        exact = metadata.pop("sha256")
        write_weights(path, arrays, metadata | {"rounded_from": exact}, names)
        share = sum(arrays[name].size for name in names) / sum(array.size for array in arrays.values())
        print(f"{path}: {len(names)} arrays, {share:.0%} of the numbers, {before} to {path.stat().st_size} bytes")


if __name__ == "__main__":
    main(sys.argv[1:])
