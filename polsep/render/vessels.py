"""Random objects that stand: bowls, plates, cups, vases, bottles, cans, boxes and lids, +y up, as closed meshes.

A vessel is a profile that is turned about +y: a flat foot, an outer wall, and either a lid, flat or domed, or a rim and
an inside. Its cross section is round, oval, squared or fluted. Rings, waves and folds move its points. Some carry a few
ellipsoids, as plates do fruits and lids knobs.

Conventions are those of `render.shapes`: centred, about as large as an average random shape. Slots are the parts of the
profile, or one for all of them, and one for each ellipsoid. Needs the extra ``render``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator

from polsep.render.materials import USUAL_SIZE
from polsep.render.shapes import (
    Floats,
    Mesh,
    ellipsoid,
    fitted,
    join,
    moved,
    random_heights,
    rotation_about,
    smooth_patch,
    uv_grid,
)
from polsep.render.waves import Draw, bumps, draw_log, draw_one, drawn_from, folds

#: Height over diameter, log-uniform, from plates to bottles; below `LOW` a wall only widens upward.
PROPORTIONS, LOW = (0.06, 3.0), 0.35
#: Share of straight walls; the others' number of knots, and the smallest radius there, of 1.
STRAIGHT_SHARE, KNOTS, NARROWEST = 0.3, (2, 6), 0.35
#: Share of vessels with an inside; thickness of their walls over the radius, and depth of the inside over the height.
HOLLOW_SHARE, THICKNESSES, DEPTHS = 0.8, (0.02, 0.12), (0.08, 0.97)
#: Share of flat lids; height of the others over the radius; exponents of the superellipses of these and of insides.
FLAT_SHARE, DOMES, ROUNDINGS = 0.5, (0.05, 0.8), (1.5, 8.0)
#: Shares of squared cross sections and exponents of their superellipses, of oval ones and their other axis, and of
#: fluted ones and the number of flutes.
SQUARED_SHARE, SQUARED, OVAL_SHARE, OVAL, FLUTED_SHARE, FLUTES = 0.25, (3.0, 14.0), 0.35, (0.4, 1.0), 0.2, (4, 24)
#: Share of walls with rings and their number; steepest slope of rings and flutes.
RINGED_SHARE, RINGS, STEEPEST = 0.2, (2, 20), 0.6
#: Shares of vessels with waves, whose heights are smaller than those of bodies, and with folds.
WAVED_SHARE, HEIGHTS, FOLDED_SHARE = 0.4, (0.001, 0.02), 0.15
#: Shares of vessels of one material, and of those that carry objects; the number of these, and their semi-axes.
PLAIN_SHARE, LADEN_SHARE, LOADS, LOAD_AXES = 0.5, 0.3, (1, 7), (0.15, 0.6)
#: Cells along a wall, a lid or an inside; along a rim or a foot; and around.
ALONG, ACROSS, AROUND = 80, 16, 256

#: A factor on the radius at azimuths.
Section = Callable[[Floats], Floats]


class Profile(NamedTuple):
    """Parts of a profile, each radii and heights ``[2, n]``: from the axis outward, downward, and along the foot back.

    ``place``: radius and height of where objects lie.
    """

    parts: list[Floats]
    place: tuple[float, float]


def random_vessel(generator: torch.Generator) -> Mesh:
    """Return a random vessel that stands on its foot."""
    draw = drawn_from(generator)
    profile = random_profile(draw)
    azimuth = 2 * math.pi * np.linspace(0, 1, AROUND + 1)
    azimuth[-1] = 0  # closes exactly
    around = _section(draw)(azimuth) * np.stack([np.cos(azimuth), -_oval(draw) * np.sin(azimuth)])
    turned = [
        np.stack([r[:, None] * around[0], y[:, None] + 0 * around[0], r[:, None] * around[1]], -1)
        for r, y in profile.parts
    ]
    moved_parts = _displaced(turned, draw)
    vessel = join(*(smooth_patch(points, uv_grid(len(points) - 1, AROUND)) for points in moved_parts))
    if draw_one(draw) < PLAIN_SHARE:
        vessel = replace(vessel, slots=np.zeros_like(vessel.slots))
    if draw_one(draw) < LADEN_SHARE:
        vessel = join(vessel, *_loads(profile.place, draw, generator))
    return replace(vessel, vertices=fitted(vessel.vertices, USUAL_SIZE))


def random_profile(draw: Draw) -> Profile:
    """Return a profile whose largest radius is about 1."""
    proportion = draw_log(draw, PROPORTIONS)
    height, wall = 2 * proportion, _wall(proportion < LOW, draw)
    thick, down, rounding = draw_log(draw, THICKNESSES), height * draw_one(draw, DEPTHS), draw_log(draw, ROUNDINGS)
    ringed, rings, steep = draw_one(draw) < RINGED_SHARE, round(draw_log(draw, RINGS)), STEEPEST * draw_one(draw)
    hollow, flat, dome = draw_one(draw) < HOLLOW_SHARE, draw_one(draw) < FLAT_SHARE, draw_one(draw, DOMES)
    along = np.linspace(1, 0, ALONG + 1)
    ring = ringed * min(steep * height / (2 * math.pi * rings), thick / 3) * np.sin(2 * math.pi * rings * along)
    edge = float(wall(np.ones(1))[0])
    outside = np.stack([wall(along) + np.where(along % 1 == 0, 0, ring), height * along])
    across = np.linspace(1, 0, ACROSS + 1)
    foot = np.stack([outside[0, -1] * across, 0 * across])
    turn = np.linspace(math.pi / 2, 0, ALONG + 1)
    out, up = (np.clip(f(turn), 0, 1) ** (2 / rounding) for f in (np.cos, np.sin))
    out[0], up[-1] = 0, 0
    if not hollow:
        lid = np.stack([edge * (1 - along if flat else out), height + (0 if flat else dome * edge) * up])
        return Profile([lid, outside, foot], (edge, height + (0 if flat else dome * edge)))
    inside = np.stack([(wall(1 - down * up / height) - thick) * out, height - down * up])
    bent = np.linspace(0, math.pi, ACROSS + 1)
    rim = np.stack([edge - thick / 2 * (1 + np.cos(bent)), height + thick / 2 * np.clip(np.sin(bent), 0, 1)])
    rim[:, 0], rim[:, -1] = inside[:, -1], outside[:, 0]
    return Profile([inside, rim, outside, foot], (float(inside[0, ALONG // 4]), height - down))


def _wall(low: bool, draw: Draw) -> Callable[[Floats], Floats]:
    """The radius of a wall at shares of its height; ``low``: it only widens upward."""
    straight, count = draw_one(draw) < STRAIGHT_SHARE, round(draw_one(draw, (KNOTS[0] - 0.49, KNOTS[1] + 0.49)))
    radii = draw(NARROWEST, 1, count)
    radii = np.sort(radii) if low else radii
    knots = PchipInterpolator(np.linspace(0, 1, count), radii / radii.max())
    return lambda share: np.ones_like(share) if straight else np.asarray(knots(np.clip(share, 0, 1)))


def _section(draw: Draw) -> Section:
    """The cross section: a circle or a superellipse, and flutes."""
    squared, power = draw_one(draw) < SQUARED_SHARE, draw_log(draw, SQUARED)
    fluted, count, steep = draw_one(draw) < FLUTED_SHARE, round(draw_log(draw, FLUTES)), STEEPEST * draw_one(draw)

    def factor(azimuth: Floats) -> Floats:
        across, along = np.abs(np.cos(azimuth)), np.abs(np.sin(azimuth))
        radius = (across**power + along**power) ** (-1 / power) if squared else np.ones_like(azimuth)
        return radius * (1 + fluted * steep / count * np.cos(count * azimuth))

    return factor


def _oval(draw: Draw) -> float:
    """The other axis of the cross section."""
    share, axis = draw_one(draw), draw_one(draw, OVAL)
    return axis if share < OVAL_SHARE else 1.0


def _displaced(parts: list[Floats], draw: Draw) -> list[Floats]:
    """The parts with waves and folds, which move points away from the axis and up by functions of the place alone."""
    size = max(float(np.abs(part).max()) for part in parts)
    lengths = [len(part) for part in parts]
    points = np.concatenate(parts)
    place, shifts = points / size, np.zeros((2, *points.shape[:2]))
    if draw_one(draw) < WAVED_SHARE:
        shifts += np.stack([bumps(place, draw, HEIGHTS) for _ in range(2)])
    if draw_one(draw) < FOLDED_SHARE:
        shifts += folds(place, draw)
    shifts = np.where(np.hypot(points[..., 0], points[..., 2]) > 0, shifts, shifts[:, :, :1])
    spread = 1 + shifts[0][..., None] * np.array([1.0, 0, 1.0])
    found = points * spread + size * shifts[1][..., None] * np.array([0, 1.0, 0])
    return np.split(found, np.cumsum(lengths)[:-1])


def _loads(place: tuple[float, float], draw: Draw, generator: torch.Generator) -> list[Mesh]:
    """Ellipsoids with relief that lie about a height within a radius."""
    radius, height = place
    found = []
    for _ in range(round(draw_one(draw, (LOADS[0] - 0.49, LOADS[1] + 0.49)))):
        axes = radius * draw(*LOAD_AXES, 3)
        heights = random_heights(float(0.3 * axes.min()), generator)
        far = 0.7 * radius * draw_one(draw)
        turn, spin = (2 * math.pi * draw(0, 1, 2)).tolist()
        at = np.array([far * math.cos(turn), height + axes[1] * draw_one(draw), far * math.sin(turn)])
        found.append(moved(ellipsoid(axes, [heights]), rotation_about(1, spin), at))
    return found
