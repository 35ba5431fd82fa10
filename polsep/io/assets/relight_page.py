"""One HTML file that shows a surface under a lamp that follows the pointer; it holds all it needs and asks nobody.

Its textures are PNG: normals and gloss in 8 bits, albedo as sRGB. The shading is that of `physics.gltf`, in WebGL.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from polsep.io.store.image_codecs import encode_png
from polsep.physics.srgb import srgb

Floats = NDArray[np.float32]

#: Specular strength that the gloss texture's green channel shows as 1.
LARGEST_STRENGTH = 4.0


@dataclass(frozen=True)
class RelightMaps:
    """Square maps: unit ``normals [n, n, 3]``, ``albedo [n, n, 3]`` in [0, 1], ``roughness``, ``strength``, ``mask``
    ``[n, n]``."""

    normals: Floats
    albedo: Floats
    roughness: Floats
    strength: Floats
    mask: NDArray[np.bool_]


def encode_relight_page(maps: RelightMaps, title: str, lamp: Sequence[float]) -> bytes:
    """The page; ``lamp``: unit vector toward the first lamp, x right, y up, z to the camera."""
    gloss = np.stack([maps.roughness, maps.strength / LARGEST_STRENGTH, maps.mask.astype(np.float32)], axis=-1)
    textures = {
        "NORMALS": (maps.normals + 1) / 2,
        "ALBEDO": srgb(np.clip(maps.albedo, 0, 1)),
        "GLOSS": gloss,
    }
    page = files("polsep.io.assets").joinpath("relight.html").read_text("utf-8")
    for name, image in textures.items():
        pixels = np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)
        page = page.replace(f"__{name}__", "data:image/png;base64," + base64.b64encode(encode_png(pixels, 3)).decode())
    words = {
        "SIDE": str(len(maps.mask)),
        "LAMP": ", ".join(f"{x:.5f}" for x in lamp),
        "STRENGTH": f"{LARGEST_STRENGTH:.1f}",
        "TITLE": html.escape(title),
    }
    for name, text in words.items():
        page = page.replace(f"__{name}__", text)
    return page.encode()
