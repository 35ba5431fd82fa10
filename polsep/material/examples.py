"""A folder of training examples: rendered once, possibly in several runs, read by trainings and measurements."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import torch

from polsep.io.store.examples import read_example, write_example
from polsep.material.shots import RAW_SIZE, SMALL_SIZE, Example, random_example
from polsep.material.svbrdf import INPUTS, STACKED

#: Planes of one view.
PLANES = max(part.stop for part in INPUTS.values())


def example_path(folder: Path, split: str, seed: int, number: int) -> Path:
    """The file of an example."""
    return folder / f"{split}-{seed}-{number:06d}.npy"


def make_examples(folder: Path, split: str, seed: int, count: int, views: int) -> Iterator[int]:
    """Render the missing ones of the first ``count`` examples; yield how many exist, after each.

    Even ones are of frames of `RAW_SIZE`, odd ones of `SMALL_SIZE`.
    """
    for number in range(count):
        path = example_path(folder, split, seed, number)
        if not path.is_file():
            example = random_example(split, seed, number, views, SMALL_SIZE if number % 2 else RAW_SIZE)
            write_example(path, torch.cat([example.views.flatten(0, 1), example.maps]))
        yield number + 1


def load_example(path: Path) -> Example:
    """An example in half precision. Raises ValueError on other files."""
    planes = read_example(path)
    if len(planes) <= STACKED or (len(planes) - STACKED) % PLANES:
        raise ValueError(f"expected views of {PLANES} planes and {STACKED} maps in {path}, found {len(planes)} planes")
    return Example(planes[:-STACKED].view(-1, PLANES, *planes.shape[1:]), planes[-STACKED:])
