"""Uploaded images of edits: textures, masks and normals at screen size; the files are kept for downloads.

Textures have any size. Masks and normals have the size of the separated frame and apply to all frames of that size.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from polsep.edit import EditError
from polsep.io.assets.maps import read_map
from polsep.io.store.errors import InputError
from polsep.io.store.header_checks import at_most
from polsep.view.opening import MAX_SAMPLES
from polsep.view.pictures import Floats, shrink

#: Kinds of images, in the order of the page.
KINDS = ("texture", "normals", "mask")
#: Longest side of a texture at screen size: twice the picture's.
TEXTURE = 1280


@dataclass(frozen=True)
class EditImage:
    """An image of a page: its ``name`` in recipes, the file, its ``size`` (height, width), and ``small``, read-only.

    ``step``: pixels of the frame on a side of one of ``small``; of textures, nothing depends on it.
    """

    kind: str
    name: str
    path: Path
    size: tuple[int, int]
    step: int
    small: Floats


def read_image(kind: str, name: str, path: Path, frame: tuple[int, int], step: int) -> EditImage:
    """An image of a page for a frame of the size ``frame`` (height, width), shown at ``step``. Raises InputError."""
    try:
        with at_most(MAX_SAMPLES):
            found = read_map(path, kind)
    except ValueError as error:
        raise InputError(str(error).replace(str(path), name)) from error
    size = (found.shape[0], found.shape[1])
    if kind != "texture":
        require_fit(kind, name, size, frame)
        small = shrink(found, step)
        if kind == "normals":
            length = np.linalg.norm(small, axis=2, keepdims=True)
            small = (small / np.where(length > 0, length, 1)).astype(np.float32)
    else:
        small = shrink(found, -(-max(size) // TEXTURE))
    small = np.ascontiguousarray(small)
    small.flags.writeable = False  # so that normals are unfolded once
    return EditImage(kind, name, path, size, step, small)


def require_fit(kind: str, name: str, size: tuple[int, int], frame: tuple[int, int]) -> None:
    """Raise EditError for a mask or normals of another size than the frame's."""
    if kind != "texture" and size != frame:
        raise EditError(
            f"{name}: expected {kind} of {frame[1]}x{frame[0]} pixels as the separated frame, found {size[1]}x{size[0]}"
        )
