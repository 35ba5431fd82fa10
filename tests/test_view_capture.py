"""The page of `polsep capture --show`: what it says of a frame, and how it looks in Chromium."""

from __future__ import annotations

import json
import urllib.request
from io import BytesIO
from typing import Any

import imagecodecs
import numpy as np
import pytest
from PIL import Image
from view_page import DEMO, browser, needs_browser

from polsep.capture.live import Shown
from polsep.capture.page import serve_page
from polsep.capture.shot import Shot
from polsep.pipeline import separate_capture
from polsep.sensor.camera import Layout, Mosaic
from polsep.sensor.exposure import BLACK, CLIPPED, edge_contrast, exposure_flags

__all__ = ["browser"]  # a fixture


@pytest.fixture(scope="module")
def shot() -> Shot:
    """A part of the demo capture with a clipped highlight."""
    codes = imagecodecs.png_decode(DEMO.read_bytes())[812:1132, 140:524].astype(np.float32)
    mosaic = Mosaic(codes, Layout(), 0.0, 4095.0)
    return Shot(mosaic, separate_capture(mosaic, "color-affine"), ("light of <b>many</b> angles",))


def test_flags_are_those_of_the_cells() -> None:
    """One clipped sample marks its cell, four black ones do; an odd origin moves the cells."""
    codes = np.full((8, 12), 100.0, np.float32)
    codes[2, 5], codes[4:6, 8:10], codes[6, 0] = 255, 0, 0
    flags = exposure_flags(Mosaic(codes, Layout(), 0.0, 255.0))
    expected = np.zeros((4, 6), np.uint8)
    expected[1, 2], expected[2, 4] = CLIPPED, BLACK
    np.testing.assert_array_equal(flags, expected)
    moved = exposure_flags(Mosaic(np.pad(codes, ((1, 0), (1, 0))), Layout(origin=(1, 1)), 0.0, 255.0))
    np.testing.assert_array_equal(moved, expected)


def test_focus_falls_with_blur_and_not_with_exposure(shot: Shot) -> None:
    """The number is largest for the sharpest picture, and the same at half the light."""
    light = np.random.default_rng(0).uniform(0.1, 1, (40, 50)).astype(np.float32)
    blurred = (light + np.roll(light, 1, 0) + np.roll(light, 1, 1) + np.roll(light, (1, 1), (0, 1))) / 4
    sharp, soft = (np.quantile(edge_contrast(image), 0.995) for image in (light, blurred))
    assert sharp > 1.3 * soft and shot.focus > 0
    np.testing.assert_allclose(edge_contrast(light / 2), edge_contrast(light), rtol=1e-4)
    assert (edge_contrast(np.full((5, 6), 0.3, np.float32)) == 0).all()


def test_the_page_tells_the_facts_of_the_frame(shot: Shot) -> None:
    """Numbers are the report's; marks lie on clipped cells alone; the JSON is strict."""
    facts = shot.facts
    statistics = shot.frame.report["statistics"]
    assert facts["light_deg"] == statistics["light_polarizer_deg"] and facts["remarks"] == list(shot.remarks)
    assert sum(share for _, share in facts["clipped"]) > 0 and "<svg" in facts["histogram"] and "<svg" in facts["rose"]
    json.dumps(facts, allow_nan=False)
    plain, marked = (
        np.asarray(Image.open(BytesIO(shot.picture(marks)))).astype(int)
        for marks in (frozenset[str](), frozenset({"clipped"}))
    )
    red = np.abs(marked - (255, 40, 40)).sum(axis=2) < 120
    flags = exposure_flags(shot.capture) if isinstance(shot.capture, Mosaic) else None
    assert flags is not None and red[(flags & CLIPPED) > 0].mean() > 0.95
    changed = np.abs(marked - plain).sum(axis=2) > 150
    assert 0 < changed.sum() < 1.5 * np.count_nonzero(flags)
    with serve_page(0, lambda: Shown(b"", 1, 0.0, (), shot), lambda: "1 received") as address:
        with urllib.request.urlopen(f"{address}state.json", timeout=20) as answer:
            assert json.loads(answer.read())["shot"]["focus"] == shot.focus
        with urllib.request.urlopen(f"{address}shot.jpg?sharp,clipped&1", timeout=20) as answer:
            assert answer.read(2) == b"\xff\xd8"


@needs_browser
def test_the_page_shows_what_setting_up_a_shot_needs(shot: Shot, browser: Any) -> None:
    """Clipping, focus, the light's angles and warnings as text; the marks follow their boxes, also on a phone."""
    failed: list[str] = []
    picture = shot.picture(frozenset())
    with serve_page(0, lambda: Shown(picture, 1, 0.0, (), shot), lambda: "1 received") as address:
        for width, height in ((1440, 900), (390, 844)):
            page = browser.new_page(viewport={"width": width, "height": height})
            page.on("pageerror", lambda error: failed.append(str(error)))
            page.goto(address)
            page.wait_for_selector("#rose svg")
            said = page.inner_text("#right")
            assert "Clipped red" in said and "Focus" in said and "Polarizer of the light" in said
            assert "light of <b>many</b> angles" in said
            assert page.locator("#histogram polyline").count() == 3
            page.wait_for_function("document.querySelector('#marked').naturalWidth > 0")
            box = page.locator("#marked").bounding_box()
            assert box["y"] + box["height"] <= height
            page.check("#sharp")
            page.wait_for_function("document.querySelector('#marked').src.includes('clipped,sharp')")
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            page.close()
    assert failed == []
