"""Examples of trainings on disk: one array per file, in half precision, written atomically, and what made them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from polsep.io.store.atomic import atomic_path, replace_text
from polsep.io.store.errors import one_line


def write_example(path: Path, planes: Tensor) -> None:
    """Write planes ``[K, h, w]``; values beyond half precision become its largest number."""
    largest = float(np.finfo(np.float16).max)
    with atomic_path(path) as part, part.open("wb") as file:
        np.save(file, planes.clamp(-largest, largest).half().numpy())


def read_example(path: Path) -> Tensor:
    """Planes ``[K, h, w]`` in half precision. Raises ValueError on a damaged file, and on one of anything else."""
    try:
        with path.open("rb") as file:
            planes = np.lib.format.read_array(file, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise ValueError(
            f"expected an example of a training in {path}, found {one_line(error, 80)}; once deleted, it is made again"
        ) from None
    if planes.dtype != np.float16 or planes.ndim != 3 or not planes.size:
        raise ValueError(f"expected planes [K, h, w] of float16 in {path}, found {planes.dtype} {planes.shape}")
    if not np.isfinite(planes).all():
        raise ValueError(
            f"expected finite planes in {path}, found NaN or infinite ones; once deleted, it is made again"
        )
    return torch.from_numpy(planes)


def read_makers(folder: Path, method: str) -> list[str]:
    """Digests of the code that made a folder's examples for a method; empty where nobody noted any."""
    path = _makers_path(folder, method)
    return path.read_text("utf-8").split() if path.is_file() else []


def write_makers(folder: Path, method: str, digests: Sequence[str]) -> None:
    """Replace what `read_makers` reads; the folder is made if missing."""
    folder.mkdir(parents=True, exist_ok=True)
    replace_text(_makers_path(folder, method), "".join(f"{digest}\n" for digest in digests))


def _makers_path(folder: Path, method: str) -> Path:
    return folder / f"{method}-made-by.txt"
