"""The page that relights a surface: in Chromium its pictures are those of `physics.gltf`, and it asks nobody."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("playwright")

from chromium import browser, fresh_page
from test_geometry import cap

from polsep.geometry.shape_maps import Surface, relight
from polsep.io.assets.relight_page import LARGEST_STRENGTH, RelightMaps, encode_relight_page
from polsep.physics.srgb import srgb

__all__ = ["browser"]

SIDE = 96


def sphere_maps() -> RelightMaps:
    """A sphere of two colours and two roughnesses."""
    normals, mask = cap(SIDE, 80)
    left = np.broadcast_to(np.arange(SIDE) < SIDE // 2, (SIDE, SIDE))
    albedo = np.where(left[..., None], (0.7, 0.2, 0.1), (0.1, 0.3, 0.6)).astype(np.float32)
    rough = np.where(left, 0.3, 0.6).astype(np.float32)
    return RelightMaps(normals.astype(np.float32), albedo, rough, np.ones((SIDE, SIDE), np.float32), mask)


def picture(maps: RelightMaps, lamp: tuple[float, float, float]) -> Any:
    """What the page should show, in 8 bits, from its textures."""

    def stored(image: Any) -> Any:
        return np.rint(255 * np.clip(image, 0, 1)) / 255

    normals = stored((maps.normals + 1) / 2) * 2 - 1
    normals = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6)
    display = stored(srgb(maps.albedo))
    albedo = np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)
    planes = (np.moveaxis(x, -1, 0) for x in (normals, albedo))
    strength = LARGEST_STRENGTH * stored(maps.strength / LARGEST_STRENGTH)
    none = np.zeros((1, SIDE, SIDE))
    surface = Surface(*planes, stored(maps.roughness)[None], strength[None], none, none, none)
    lit = np.moveaxis(relight(surface, np.array(lamp)), 0, -1)
    return np.where(maps.mask[..., None], np.rint(255 * srgb(lit)), 40)


def shown(page: Any) -> Any:
    """The pixels of the canvas."""
    import base64

    text = page.evaluate("document.getElementById('view').toDataURL('image/png')")
    data = base64.b64decode(text.partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), np.float64)


def test_the_page_shows_what_the_shading_says(browser: Any, tmp_path: Path) -> None:
    """Under the first lamp, after a drag to the upper right, and as normals."""
    maps = sphere_maps()
    path = tmp_path / "ball.html"
    path.write_bytes(encode_relight_page(maps, "a <ball>", (0.0, 0.0, 1.0)))
    with fresh_page(browser, path.as_uri(), 900) as page:
        page.wait_for_selector("canvas[data-ready=yes]")
        assert page.title() == "a <ball>"
        np.testing.assert_allclose(shown(page), picture(maps, (0.0, 0.0, 1.0)), atol=2.01)
        box = page.locator("#view").bounding_box()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        page.mouse.down()
        page.mouse.move(box["x"] + 0.75 * box["width"], box["y"] + 0.3 * box["height"])
        page.mouse.up()
        moved = page.evaluate("lamp")
        np.testing.assert_allclose(moved, (0.5, 0.4, (1 - 0.25 - 0.16) ** 0.5), atol=0.01)
        np.testing.assert_allclose(shown(page), picture(maps, tuple(moved)), atol=2.01)
        page.get_by_role("button", name="Normals").click()
        wanted = np.where(maps.mask[..., None], np.rint(255 * (maps.normals + 1) / 2), 40)
        np.testing.assert_allclose(shown(page), wanted, atol=1.01)
        page.locator("#view").focus()
        page.keyboard.press("ArrowLeft")
        assert page.evaluate("lamp[0]") < moved[0]
