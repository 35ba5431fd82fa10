"""Large frames in overlapping strips of rows, for torch and for engines.

Strips begin at multiples of the network's grid and overlap by more than its receptive field, so that they agree with
the whole frame.
"""

from __future__ import annotations

from collections.abc import Iterator

from polsep.networks.channels import PERIOD
from polsep.networks.sizes import ResidualSize

#: Raw pixels of a frame, or of a strip with its margins, that are processed at once; half as many at full resolution.
#: More where a strip's own rows would be fewer than those of its margins: then most of the work would be theirs.
MAX_PIXELS = 6_400_000
#: Raw rows beyond the reach of the U-Net that demosaicking and the closed form see (a test measures that).
OTHER_REACH = 128
#: Least expected error that counts when separations are weighed.
LEAST_ERROR = 1e-5


def margin_of(size: ResidualSize) -> int:
    """Raw rows around a strip that its images depend on: whole rows of the network's grid."""
    grid = PERIOD * size.grid
    return -(-(PERIOD * size.reach + OTHER_REACH) // grid) * grid


def cut_rows(shape: tuple[int, int], size: ResidualSize, full: bool) -> Iterator[tuple[int, int]]:
    """First and last row of the strips of a frame of ``shape``: one, or several that begin at multiples of the grid."""
    (height, width), grid, margin = shape, PERIOD * size.grid, margin_of(size)
    most, rows, count = MAX_PIXELS // (2 if full else 1) // width, height, 1
    while count < height // (2 * margin) and rows + margin * min(count - 1, 2) > most:
        count += 1
        rows = -(-height // (count * grid)) * grid
    for first in range(0, height, rows):
        yield first, min(first + rows, height)
