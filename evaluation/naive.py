"""The edits of `polsep.edit` once more, as one would write them in NumPy: what they are measured against.

Written from docs/editing.md alone, in float32, without masks; images ``[h, w, 3]``, linear.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Pair = tuple[Floats, Floats]
Plain = Callable[[Any, Floats, Floats], Pair]


def _blurred(image: Floats, sigma: float) -> Floats:
    """Gaussian blur, mirrored at the border, one row of weights at a time."""
    reach = int(np.ceil(6 * sigma))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    weights /= weights.sum()
    for axis in (0, 1):
        padding = [(0, 0)] * 3
        padding[axis] = (reach, reach)
        padded = np.pad(image, padding, mode="symmetric")
        count = image.shape[axis]
        total = np.zeros_like(image)
        for k, weight in enumerate(weights):
            total += np.float32(weight) * np.take(padded, range(k, k + count), axis=axis)
        image = total
    return image


def _sharper(edit: Any, diffuse: Floats, specular: Floats) -> Pair:
    found = specular
    for _ in range(4):
        seen: Floats = np.maximum(_blurred(found, edit.sigma), np.float32(1e-30))
        ratio: Floats = specular / seen
        found = found * _blurred(ratio, edit.sigma)
    return diffuse, found


def _metallic(edit: Any, diffuse: Floats, specular: Floats) -> Pair:
    value = diffuse.max(axis=2, keepdims=True)
    hue = np.where(value > 0, diffuse / np.where(value > 0, value, 1), 1)
    metal = np.float32(edit.gain) * specular.max(axis=2, keepdims=True) * hue
    return diffuse, (1 - edit.amount) * specular + edit.amount * metal


def _recolor(edit: Any, diffuse: Floats, specular: Floats) -> Pair:
    color = np.array(edit.color, np.float32) / np.mean(edit.color, dtype=np.float32)
    return (1 - edit.amount) * diffuse + edit.amount * diffuse.mean(axis=2, keepdims=True) * color, specular


def _tint(edit: Any, diffuse: Floats, specular: Floats) -> Pair:
    color = np.array(edit.color, np.float32)
    return diffuse * color, specular * color


#: Every edit but the texture, by name: of the edit's values, diffuse and specular.
NAIVE: dict[str, Plain] = {
    "recolor": _recolor,
    "diffuse-gain": lambda edit, diffuse, specular: (np.float32(edit.gain) * diffuse, specular),
    "rougher": lambda edit, diffuse, specular: (diffuse, _blurred(specular, edit.sigma)),
    "sharper": _sharper,
    "metallic": _metallic,
    "specular-gain": lambda edit, diffuse, specular: (diffuse, np.float32(edit.gain) * specular),
    "remove-highlights": lambda edit, diffuse, specular: (diffuse, np.float32(1 - edit.amount) * specular),
    "isolate-highlights": lambda edit, diffuse, specular: (np.float32(1 - edit.amount) * diffuse, specular),
    "tint": _tint,
}


def naive_texture(texture: Floats) -> Plain:
    """The flat texture edit with this texture: linear between texels, and between halvings of it."""

    def sampled(image: Floats, repeats: float, size: tuple[int, int]) -> Floats:
        height, width = image.shape[:2]
        scale = repeats * width / size[1]
        y, x = np.meshgrid(*((np.arange(n) + 0.5) * scale - 0.5 for n in size), indexing="ij")
        top, left = np.floor(y).astype(int), np.floor(x).astype(int)
        down, across = (y - top)[..., None], (x - left)[..., None]
        rows, cols = (top % height, (top + 1) % height), (left % width, (left + 1) % width)
        upper = (1 - across) * image[rows[0], cols[0]] + across * image[rows[0], cols[1]]
        lower = (1 - across) * image[rows[1], cols[0]] + across * image[rows[1], cols[1]]
        mixed: Floats = ((1 - down) * upper + down * lower).astype(np.float32)
        return mixed

    def plain(edit: Any, diffuse: Floats, specular: Floats) -> Pair:
        size = (diffuse.shape[0], diffuse.shape[1])
        level = np.log2(max(edit.repeats * texture.shape[1] / size[1], 1.0))
        finer = texture
        for _ in range(int(level)):
            finer = (finer[::2, ::2] + finer[1::2, ::2] + finer[::2, 1::2] + finer[1::2, 1::2]) / np.float32(4)
        coarser = (finer[::2, ::2] + finer[1::2, ::2] + finer[::2, 1::2] + finer[1::2, 1::2]) / np.float32(4)
        share = level - int(level)
        pattern = (1 - share) * sampled(finer, edit.repeats, size) + share * sampled(coarser, edit.repeats, size)
        return (diffuse * (1 + edit.amount * (pattern - 1))).astype(np.float32), specular

    return plain
