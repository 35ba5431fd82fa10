"""`SeparatedImages`, the input and output of edits, and the images that edits name.

Images are linear light ``[h, w, C]``, float32, C = 3 or 1, 1.0 = one measurement at the white level.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from polsep.edit.parameters import EditError

Floats = NDArray[np.float32]
#: Textures ``[h', w', C]``, masks ``[h, w]`` in [0, 1] and normals ``[h, w, 3]`` by the names that edits use.
Maps = Mapping[str, Floats]


class Separated(Protocol):
    """Anything that has both images, such as `polsep.SeparatedFrame`."""

    @property
    def diffuse(self) -> Floats:
        """``[h, w, C]``."""

    @property
    def specular(self) -> Floats:
        """``[h, w, C]``."""


@dataclass(frozen=True, eq=False)
class SeparatedImages:
    """Diffuse and specular images of one size, non-negative. Raises EditError on other shapes and types."""

    diffuse: Floats
    specular: Floats

    def __post_init__(self) -> None:
        for name, image in (("diffuse", self.diffuse), ("specular", self.specular)):
            if not isinstance(image, np.ndarray):
                raise EditError(f"expected {name} as a NumPy array, found {image!r:.40}")
            if image.dtype != np.float32 or image.ndim != 3 or image.shape[2] not in (1, 3) or 0 in image.shape:
                raise EditError(f"expected {name} as float32 [h, w, 3 or 1], found {image.dtype} {list(image.shape)}")
        if self.diffuse.shape != self.specular.shape:
            sizes = f"diffuse {list(self.diffuse.shape)} and specular {list(self.specular.shape)}"
            raise EditError(f"expected diffuse and specular of one shape, found {sizes}")

    @property
    def combined(self) -> Floats:
        """The image of a camera: diffuse + specular."""
        return self.diffuse + self.specular

    @property
    def colors(self) -> int:
        """3, or 1 where the sensor has no colours."""
        return int(self.diffuse.shape[2])

    def light(self) -> dict[str, float]:
        """Mean light of each image over pixels and colours, which `edits` change or keep."""
        return {name: float(getattr(self, name).mean(dtype=np.float64)) for name in ("diffuse", "specular")}


def find_map(maps: Maps, kind: str, name: str, images: SeparatedImages) -> Floats:
    """The image that an edit names, checked for its kind: texture, mask or normals. Raises EditError."""
    if name not in maps:
        raise EditError(f"expected an image {name!r} as {kind}, found {', '.join(map(repr, maps)) or 'none'}")
    found = maps[name]
    if not isinstance(found, np.ndarray):
        raise EditError(f"expected {kind} {name!r} as a NumPy array, found {found!r:.40}")
    size = images.diffuse.shape[:2]
    if kind == "texture":
        fits = found.ndim == 3 and found.shape[2] in (1, images.colors) and 0 not in found.shape
        wanted = "[h, w, 1]" if images.colors == 1 else "[h, w, 3 or 1]"
    else:
        shape = size if kind == "mask" else (*size, 3)
        fits, wanted = found.shape == shape, f"{list(shape)} like the images"
    if not fits or found.dtype != np.float32:
        raise EditError(f"expected {kind} {name!r} as float32 {wanted}, found {found.dtype} {list(found.shape)}")
    if kind == "mask" and not (found.min() >= 0 and found.max() <= 1):
        raise EditError(f"expected mask {name!r} in [0, 1], found {found.min():g} to {found.max():g}")
    if kind == "texture" and not (found.min() >= 0 and found.max() < np.inf):
        raise EditError(f"expected texture {name!r} of 0 or more, found {found.min():g} to {found.max():g}")
    return found
