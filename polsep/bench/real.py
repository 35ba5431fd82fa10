"""Reference polarizers and the layout check on real frames."""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from itertools import permutations
from pathlib import Path

import numpy as np

from polsep.bench.rows import Row
from polsep.bench.truth import read_real_frames
from polsep.demosaic.bilinear import demosaic_bilinear_half
from polsep.physics.stokes import aolp, fit_stokes
from polsep.sensor.camera import Layout, Mosaic
from polsep.sensor.layout_check import SENSOR_SIZES, check_layout, crossed_pairs

#: The labelled polarizers of polarizer_IMX250MZR.png: label [deg], centre (row, col) and radius at half resolution.
REFERENCE_POLARIZERS = ((0, 544, 189, 88), (45, 544, 502, 88), (90, 544, 778, 88), (135, 553, 1055, 78))


def bench_real(data: Path) -> Iterator[Row]:
    """Reference polarizers and the layout check on the real frames of ``data``/raw."""
    mosaics = dict(read_real_frames(data))
    yield from _reference_angles(mosaics["polarizer_IMX250MZR"])
    right = total = 0
    for mosaic in mosaics.values():
        for verdict in _layout_verdicts(mosaic):
            right, total = right + verdict, total + 1
    yield Row("real", "layout check on real frames", "layout check", "right verdicts", right, f"of {total}")


def _reference_angles(mosaic: Mosaic) -> Iterator[Row]:
    """Median AoLP inside each polarizer; its labels count clockwise from the vertical, so label t is AoLP 90 - t."""
    stokes = fit_stokes(demosaic_bilinear_half(mosaic))
    rows, cols = np.ogrid[: stokes.s0.shape[-2], : stokes.s0.shape[-1]]
    errors = []
    for label, row, col, radius in REFERENCE_POLARIZERS:
        disc = (rows - row) ** 2 + (cols - col) ** 2 < radius**2
        found = 90 - np.rad2deg(aolp(stokes)[0][disc])
        error = float(np.median((found - label + 90) % 180 - 90))
        errors.append(error)
        yield Row("real", f"polarizer labelled {label}", "AoLP", "error", error, "deg")
    common = statistics.fmean(errors)
    worst = max(abs(error - common) for error in errors)
    yield Row("real", "polarizers, camera roll removed", "AoLP", "largest error", worst, "deg")
    yield Row("real", "polarizers, camera roll removed", "AoLP", "camera roll", common, "deg")


def _layout_verdicts(mosaic: Mosaic) -> Iterator[bool]:
    """Verdicts of the check, right or wrong: all 24 orders, transposed, mirrored, cropped, mono for colour.

    Right is silence under the true layout and under those that no frame can tell from it (see `layout_check`), and a
    warning whose fitting layouts hold the true one, or that names it, otherwise.
    """
    true, (height, width) = mosaic.layout, mosaic.data.shape[-2:]
    for a, b, c, d in permutations((0, 45, 90, 135)):
        claimed = Layout(((a, b), (c, d)), true.bayer)
        yield _right(Mosaic(mosaic.data, claimed, 0, 255), true, crossed_pairs(claimed) != crossed_pairs(true))
    other = Layout(true.polarizer, None if true.bayer else "RGGB")
    yield _right(Mosaic(mosaic.data, other, 0, 255), true, True)
    changed = (
        (np.flip(mosaic.data, -1), true.flipped_horizontal(width)),
        (np.flip(mosaic.data, -2), true.flipped_vertical(height)),
        (mosaic.data.mT, true.transposed()),
        (mosaic.data[1:, :], true.rolled(-1, 0)),
        (mosaic.data[:, 3:], true.rolled(0, -3)),
        (mosaic.data[2:, :], true.rolled(-2, 0)),
    )
    for data, layout in changed:
        stands = true.bayer is None and data.shape[-2:] in SENSOR_SIZES  # so it was turned
        seen = true.bayer is not None and (layout.origin != true.origin or _greens(layout) != _greens(true))
        yield _right(Mosaic(data, layout, 0, 255), layout, False)
        said = Mosaic(data, true, 0, 255)
        yield layout.spec in (check_layout(said).warning or "") if stands else _right(said, layout, seen)


def _greens(layout: Layout) -> bool:
    return layout.bayer in ("RGGB", "BGGR")


def _right(mosaic: Mosaic, true: Layout, wrong: bool) -> bool:
    check = check_layout(mosaic)
    if not wrong:
        return check.warning is None
    return check.warning is not None and any(
        fit.bayer == true.bayer and fit.origin == true.origin and crossed_pairs(fit) == crossed_pairs(true)
        for fit in check.fits
    )
