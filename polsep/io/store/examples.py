"""Examples of materials on disk: one array per file, in half precision, written atomically."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from polsep.io.store.atomic import atomic_path


def write_example(path: Path, planes: Tensor) -> None:
    """Write planes ``[K, h, w]``; values beyond half precision become its largest number."""
    largest = float(np.finfo(np.float16).max)
    with atomic_path(path) as part, part.open("wb") as file:
        np.save(file, planes.clamp(-largest, largest).half().numpy())


def read_example(path: Path) -> Tensor:
    """Planes ``[K, h, w]`` in half precision. Raises ValueError on a file of anything else."""
    try:
        planes = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise ValueError(f"expected an example of a material in {path}, found {type(error).__name__}") from None
    if planes.dtype != np.float16 or planes.ndim != 3:
        raise ValueError(f"expected planes [K, h, w] of float16 in {path}, found {planes.dtype} {planes.shape}")
    return torch.from_numpy(planes)
