"""Light directions of photometric stereo: six named ones, or three numbers each.

Directions point from the object to the light, in the camera's frame: x right, y up, z to the camera.
Source of the six: Lichy, Wu, Sengupta, Jacobs 2021, Shape and material capture at home, CVPR, Sec. 3: right,
front-right, front (beside the camera), front-left, left, above. Note: the angles are this project's, those of a
hand-held flash around an object on a table.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def direction_at(right_deg: float, up_deg: float) -> tuple[float, float, float]:
    """The unit vector at these angles [degrees] to the right of the camera and above it."""
    right, up = math.radians(right_deg), math.radians(up_deg)
    return (math.sin(right) * math.cos(up), math.sin(up), math.cos(right) * math.cos(up))


#: The six lights, in the order of the photographs.
NAMED = {
    "right": direction_at(70, 0),
    "front-right": direction_at(35, 0),
    "front": direction_at(0, 0),
    "front-left": direction_at(-35, 0),
    "left": direction_at(-70, 0),
    "above": direction_at(0, 60),
}


def parse_lights(text: str) -> Floats:
    """Unit vectors ``[L, 3]`` of names, or of ``x,y,z``, with spaces between: ``"right 0,0,1 above"``.

    Raises ValueError.
    """
    found = []
    for word in text.split():
        if word in NAMED:
            found.append(NAMED[word])
            continue
        try:
            x, y, z = (float(part) for part in word.split(","))
        except ValueError:
            names = ", ".join(NAMED)
            raise ValueError(f"expected light directions of {names}, or x,y,z, found {word!r}") from None
        if not 1e-6 < math.hypot(x, y, z) < math.inf:
            raise ValueError(f"expected a light direction that points somewhere, found {word!r}")
        found.append((x, y, z))
    vectors = np.array(found, dtype=np.float64).reshape(-1, 3)
    if len(vectors) and vectors[:, 2].max() < 0:
        raise ValueError(
            f"expected lights on the camera's side (z > 0 points to it), found all behind the object: {text}"
        )
    unit: Floats = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return unit
