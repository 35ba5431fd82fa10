"""Diffuse light that keeps the lamp's polarization: its share, the same all over a frame.

Skin, wax and paint scatter 2 to 10 % of their diffuse light so early that it keeps the lamp's polarization, in the
body's colour (Ma et al. 2007). Crossed polarizers count it as specular. Methods with
white specular light leave it in the diffuse image.

In a place, the polarization along the lamp's is regressed on the diffuse image, both as deviations from their mean over
colours, so that white highlights do not count. Slopes have two reasons. Transmitted light is polarized by Fresnel's
equations, along and across the lamp's polarization, as the normals are, and hardly where surfaces face the camera: the
densest slope of a frame is near 0. Retained light moves all slopes along the lamp's polarization, by its share. So the
densest slope is that share, where it clearly lies along. The median must agree, since a frame of few planes has dense
slopes anywhere; and a frame of one plane, all of whose slopes are alike, shows nothing. Nor does a frame of
one hue, where highlights of a wrong colour look like it.

Slopes are often too large, and a network's specular image may hold a part of retained light already. What may move is
at most what the polarization along the lamp's has beyond the specular image, over the whole frame (`find_missing`).
"""

from __future__ import annotations

import numpy as np

from polsep.compute.averages import weighted_median
from polsep.compute.resizing import block_means
from polsep.separation.lamp_polarization import Floats, has_hues

#: Places along the shorter side of a frame, fewest samples along the side of one, and fewest places.
PLACES, MIN_SIDE, MIN_PLACES = 16, 4, 20
#: Contrast of colours that counts as none: variance [white^2], and over the squared brightness. Least brightness.
MIN_CONTRAST, MIN_RELATIVE, MIN_BRIGHTNESS = 3e-4, 3e-3, 0.03
#: Width of the density of slopes; largest slope that counts: metals have more.
WIDTH, MAX_SLOPE = 0.02, 0.4
#: Range of shares that are believed, the largest slope across, and the largest part of the places within `WIDTH`.
#: Chosen on validation stages of `datasets.reality` (docs/experiments.md).
RETAINED, MAX_ACROSS, MAX_ALIKE = (0.02, 0.15), 0.03, 0.75
#: Least specular light over the diffuse light of a frame from which the lamp's polarization is known; chosen on one
#: photograph of a selection set (docs/testsets.md).
MIN_SPECULAR = 0.01
#: Taken off a share, which is found a little too high more often than too low.
CAUTION = 0.005
STEPS = 10


def find_retained(along: Floats, across: Floats, diffuse: Floats) -> float:
    """The share of the diffuse light that keeps the lamp's polarization all over a frame; 0 where none is proven.

    ``along``, ``across``: polarized light in the direction of the lamp's specular reflections and at 45 degrees to it;
    ``diffuse``: a method's diffuse image; all ``[3, h, w]``, in white light.
    """
    side = max(MIN_SIDE, min(diffuse.shape[-2:]) // PLACES)
    colors = _deviations(diffuse)
    sums = [(x * colors).sum(axis=0) for x in (_deviations(along), _deviations(across), colors)]
    first, second, contrast, brightness = (block_means(x, side).reshape(-1) for x in (*sums, diffuse.mean(axis=0)))
    shown = (contrast > MIN_CONTRAST + MIN_RELATIVE * brightness**2) & (brightness > MIN_BRIGHTNESS)
    slopes, weight = np.stack([first, second])[:, shown] / contrast[shown], np.sqrt(contrast[shown])
    kept = np.abs(slopes[0]) < MAX_SLOPE
    slopes, weight = slopes[:, kept], weight[kept]
    body = block_means(diffuse, side).reshape(3, -1)[:, shown]
    if len(weight) < MIN_PLACES or not has_hues(body / np.linalg.norm(body, axis=0)):
        return 0.0
    (densest, beside), alike = find_densest(slopes, weight)
    share = min(densest, weighted_median(slopes[0], weight))
    if not RETAINED[0] < share < RETAINED[1] or abs(beside) > MAX_ACROSS or alike > MAX_ALIKE:
        return 0.0
    return share - CAUTION


def find_missing(along: Floats, specular: Floats, diffuse: Floats) -> float:
    """The light that ``along`` has beyond polarized ``specular`` light, over the diffuse light of a frame; at least 0.

    All ``[3, h, w]``, in white light. Transmitted light, polarized along and across, adds up to little. 0 where there
    are hardly any highlights: then the lamp's polarization is not known, and ``along`` may be that of leaning walls.
    """
    polarized, found, body = (float(image.mean(dtype=np.float64)) for image in (along, specular, diffuse))
    if found < MIN_SPECULAR * body:
        return 0.0
    return max(polarized - found, 0.0) / max(body, 1e-9)


def find_densest(slopes: Floats, weight: Floats) -> tuple[tuple[float, float], float]:
    """The densest of slopes ``[2, N]`` with weights ``[N]``, and the part of the weight around it: a mean shift."""
    far = ((slopes[:, :, None] - slopes[:, None]) ** 2).sum(axis=0)
    center = slopes[:, int((np.exp(-0.5 * far / WIDTH**2) @ weight).argmax())]
    near = weight
    for _ in range(STEPS):
        near = weight * np.exp(-0.5 * ((slopes - center[:, None]) ** 2).sum(axis=0) / WIDTH**2)
        center = (slopes * near).sum(axis=1) / near.sum()
    return (float(center[0]), float(center[1])), float(near.sum() / weight.sum())


def _deviations(image: Floats) -> Floats:
    deviations: Floats = image - image.mean(axis=0, keepdims=True)
    return deviations
