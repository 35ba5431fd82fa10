"""Maps of materials on disk: published ones as pictures, read for measurements."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from polsep.io.raw.png import read_png
from polsep.io.store.errors import naming

#: Panels of a picture of Deschaintre et al. 2018: the photograph, normals, diffuse, roughness, specular.
PANELS = 5


def read_panels(path: Path) -> tuple[Tensor, ...]:
    """Normal, diffuse, roughness and specular ``[C, H, W]`` of a picture of five square panels, as `svbrdf` has them.

    Normals are encoded from -1 to 1; albedos and roughness are linear, whose rendering resembles the first panel.
    Raises InputError on other pictures.
    """
    with naming(path):
        page = next(read_png(path)).array
        height, width = page.shape[:2]
        if page.ndim != 3 or width != PANELS * height:
            raise ValueError(f"expected {PANELS} square panels in colour, found {width}x{height}")
    panels = torch.from_numpy(page.astype(np.float32) / np.iinfo(page.dtype).max).permute(2, 0, 1)
    _, normal, diffuse, roughness, specular = panels.split(height, dim=2)  # type: ignore[no-untyped-call]
    normal = torch.nn.functional.normalize(2 * normal - 1, dim=0)
    return normal, diffuse, roughness.mean(dim=0, keepdim=True), specular


def find_panels(folder: Path) -> list[Path]:
    """The pictures in a folder, by name; none where there is no folder."""
    return sorted(folder.glob("*.png")) if folder.is_dir() else []
