"""Metals in a frame, whose highlights do not have the lamp's colour.

A metal has no diffuse light: all that comes from it is specular, as in highlights, but over an area. Gold, copper and
their alloys reflect more red than green and more green than blue. So a frame holds such metal where the tiles of
specular light alone have another colour than the others show for the lamp, and it is another one in just that way. Grey
metals reflect the lamp's colour and need nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from polsep.light.color import Doubles, planes_along
from polsep.light.tiles import Tiles

Flags = NDArray[np.bool_]

#: Least polarized over diffuse light of a tile of specular light alone. Tiles of rendered dielectrics: 98 % below 0.6;
#: of metals: 90 % above 2.4.
PURE_SPECULAR = 1.0
#: Fewest such tiles that say something.
MIN_SPECULAR_TILES = 3
#: Reflectance of copper and gold (`render.disturbances.METALS`) as log-ratios; brass and bronze lie beside their line.
COPPER, GOLD = np.array([0.403, -0.170]), np.array([0.246, -0.821])
#: Largest distance from that line of a metal's colour.
METAL_DISTANCE = 0.28


def only_specular(tiles: Tiles, axis: Doubles) -> Flags:
    """Return which tiles hold hardly any diffuse light, specular light being polarized along ``axis`` of (s1, s2)."""
    planes = planes_along(tiles, axis)
    along, diffuse = (np.trace(sums, axis1=1, axis2=2) for sums in (planes.qq, planes.dd))
    found: Flags = along > PURE_SPECULAR**2 * np.maximum(diffuse, 1e-9)
    return found


def beside(tiles: Tiles, chosen: Flags) -> Flags:
    """Return which tiles are chosen or touch a chosen one, also at a corner."""
    rows, cols = (int(n) + 3 for n in tiles.place.max(0))
    marked = np.zeros((rows, cols), bool)
    r, c = tiles.place.T + 1
    marked[r[chosen], c[chosen]] = True
    found: Flags = np.any([marked[r + i, c + j] for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)
    return found


def is_metal(log_ratio: Doubles) -> Flags:
    """Return whether colours ``[..., 2]`` (ln R/G, ln B/G), relative to the lamp's, are those of coloured metals."""
    line = GOLD - COPPER
    place = ((log_ratio - COPPER) @ line / (line @ line)).clip(0, 1)
    found: Flags = np.hypot(*np.moveaxis(log_ratio - COPPER - place[..., None] * line, -1, 0)) < METAL_DISTANCE
    return found


def metal_share(tiles: Tiles, axis: Doubles, lamp: Doubles) -> float:
    """Return the share of the lit points that are in tiles of coloured metal; ``lamp``: its log-ratios."""
    power = np.maximum(np.diagonal(planes_along(tiles, axis).qq, axis1=1, axis2=2), 1e-12)
    own = 0.5 * np.log(power[:, [0, 2]] / power[:, [1]]) - lamp
    metal = only_specular(tiles, axis) & is_metal(own)
    return float(tiles.counts[metal].sum() / max(float(tiles.counts.sum()), 1.0))
