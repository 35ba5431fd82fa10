"""The contact sheet of a rendered set: which view, which picture and which colour is where."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from polsep.io.results.dataset import GAP, GAP_LEVEL, SHEET_COLS, THUMBNAIL, contact_sheet
from polsep.physics.srgb import srgb

RED, GREEN, BLUE = 0.25, 0.5, 1.5


def plain(side: int, color: tuple[float, float, float]) -> dict[str, NDArray[Any]]:
    """A view whose raw frame, polarized along 0 degrees at DoLP 0.4, has s0 of that colour; half of it is diffuse."""
    red, green, blue = color
    bayer = np.kron(np.array([[red, green], [green, blue]]), np.ones((2, 2)))  # s0 of RGGB blocks of 2x2 analysers
    shares = np.tile(1 + 0.4 * np.cos(2 * np.radians([[90, 45], [135, 0]])), (2, 2)) / 2
    codes = np.tile(np.rint(4095 * bayer * shares), (side // 4, side // 4))
    diffuse = np.broadcast_to(np.array(color) / 2, (side, side, 3)).astype(np.float16)
    return {"mosaic": codes.astype(np.uint16), "diffuse": diffuse, "specular": 0 * diffuse}


@pytest.mark.parametrize("side", [32, 160, 500])
def test_pictures_have_their_colours(side: int) -> None:
    """Raw frame, diffuse and specular below one another, s0 of 2 white, from sides below and above a picture's."""
    sheet = contact_sheet(iter([plain(side, (RED, GREEN, BLUE))]))
    assert sheet.shape == (3 * THUMBNAIL + GAP, SHEET_COLS * (THUMBNAIL + GAP), 3)
    raw, diffuse, specular = (sheet[k * THUMBNAIL : (k + 1) * THUMBNAIL, :THUMBNAIL] for k in range(3))
    color = np.array([RED, GREEN, BLUE])
    for picture, s0 in ((raw, color), (diffuse, color / 2), (specular, 0 * color)):
        expected = np.broadcast_to(255 * srgb(s0 / 2), picture.shape)
        np.testing.assert_allclose(picture, expected, rtol=0, atol=1)
    assert bool((sheet[:, THUMBNAIL:] == GAP_LEVEL).all())


def test_views_are_in_reading_order() -> None:
    """One more view than fits begins a second row; what is left of it is grey."""
    levels = np.linspace(0.1, 1.9, SHEET_COLS + 1)

    def views() -> Iterator[dict[str, NDArray[Any]]]:
        yield from (plain(32, (level, level, level)) for level in levels)

    sheet = contact_sheet(views())
    height, width = 3 * THUMBNAIL + GAP, THUMBNAIL + GAP
    assert sheet.shape == (2 * height, SHEET_COLS * width, 3)
    found = [sheet[k // SHEET_COLS * height + 5, k % SHEET_COLS * width + 5, 1] for k in range(SHEET_COLS + 1)]
    np.testing.assert_allclose(found, 255 * srgb(levels / 2), rtol=0, atol=1)
    assert bool((sheet[height:, width:] == GAP_LEVEL).all())
