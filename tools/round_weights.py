"""``python -m tools.round_weights FILE...``: write large layers of weights in 8 bits (`polsep.io.store.rounding`).

That halves the file. A file that is rounded already stays as it is.
"""

from __future__ import annotations

import sys
from pathlib import Path

from polsep.io.store.rounding import coarsened, names_to_round, steps_of
from polsep.io.store.weights import read_weights, write_weights


def main(paths: list[str]) -> None:
    """Round and write."""
    for path in map(Path, paths):
        arrays, metadata = read_weights(path)
        if "rounded_from" in metadata:
            continue
        names, before = names_to_round(arrays, metadata), path.stat().st_size
        exact = metadata.pop("sha256")
        for name in names:
            if (count := steps_of(arrays[name], metadata["method"])) < 127:
                arrays[name] = coarsened(arrays[name], count)
        write_weights(path, arrays, metadata | {"rounded_from": exact}, names)
        share = sum(arrays[name].size for name in names) / sum(array.size for array in arrays.values())
        print(f"{path}: {len(names)} arrays, {share:.0%} of the numbers, {before} to {path.stat().st_size} bytes")


if __name__ == "__main__":
    main(sys.argv[1:])
