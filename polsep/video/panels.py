"""The panels of a film to watch: input, diffuse and specular side by side."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.io.results.sequences import Picture
from polsep.physics.srgb import srgb_bytes
from polsep.video.panels_kernel import STEPS, make_panels

Floats = NDArray[np.float32]

#: Largest side of a panel.
PANEL = 640
#: The tone curve at equal steps of the square root of linear light.
_TONES = srgb_bytes((np.arange(STEPS + 1) / STEPS) ** 2)


def draw_panels(diffuse: Floats, specular: Floats, gain: float) -> NDArray[np.uint8]:
    """Panels of input, diffuse and specular ``[h, w, C]`` as sRGB ``uint8 [h', 3 w', 3]``, at a ``gain``."""
    return make_panels((diffuse, specular), gain, _TONES, PANEL)


def black_picture(size: tuple[int, ...], preview: bool, line: dict[str, Any]) -> Picture:
    """A black picture in place of a missing frame; ``line``: for the log."""
    black = np.zeros(size, np.float32)
    return Picture(black, black, draw_panels(black, black, 1.0) if preview else None, line)
