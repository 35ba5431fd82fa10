"""Parts of the gallery and of `python -m evaluation view`: plain NumPy twins of the edits, pictures, normals."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from test_edit import random_images

from evaluation.naive import NAIVE, naive_texture
from evaluation.viewing import VALUES
from polsep.edit import EDITS, SeparatedImages, Texture, make_edit
from polsep.sensor.camera import Layout, Mosaic
from polsep.separation.report import SeparatedFrame


@pytest.mark.parametrize("name", EDITS)
def test_edits_agree_with_plain_numpy(name: str) -> None:
    """Edits and their timed twins compute the same, to rounding."""
    images, kind = random_images(size=(40, 56)), EDITS[name]
    texture = np.random.default_rng(1).random((64, 64, 3), dtype=np.float32)
    edit = make_edit(kind, VALUES.get(name, {}))
    plain = naive_texture(texture) if kind is Texture else NAIVE[name]
    after, expected = edit.change(images, {"texture": texture}), plain(edit, images.diffuse, images.specular)
    for found, wanted in zip((after.diffuse, after.specular), expected, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=2e-4, atol=2e-5)


def frame_of(images: SeparatedImages) -> SeparatedFrame:
    size = images.diffuse.shape[:2]
    zero = np.zeros(size, np.float32)
    return SeparatedFrame(images.diffuse, images.specular, np.ones(size, bool), zero, zero, {})


@pytest.mark.parametrize(("colors", "rows"), [(3, 2), (1, 1)])
def test_the_gallery_shows_every_edit_that_fits(colors: int, rows: int) -> None:
    """Ten pictures of a colour frame, in fives; of a grey one, those that need no colours."""
    pytest.importorskip("matplotlib", reason="needs the extra bench")
    from evaluation.appearance import CELL, GalleryCapture, draw_edits
    from evaluation.figures import GAP, TITLE

    size = (30, 30)
    capture = GalleryCapture("a frame", Mosaic(torch.zeros(60, 60), Layout(), 0.0, 1.0))
    pixels = draw_edits(capture, frame_of(random_images(size=size, colors=colors)))
    assert pixels.shape == (rows * (CELL + TITLE + GAP) + TITLE + GAP, 5 * (CELL + GAP) + GAP, 3)


def test_the_cloth_is_a_reflectance_that_repeats() -> None:
    """Between black and white, and the same at opposite borders, half a texel aside."""
    from evaluation.appearance import make_cloth

    cloth = make_cloth(256)
    assert cloth.min() >= 0 and cloth.max() <= 1
    np.testing.assert_array_equal(cloth, np.roll(cloth, 128, axis=0))
    np.testing.assert_array_equal(cloth, cloth[::-1, ::-1])


def test_normals_of_the_gallery_are_the_surfaces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a ball before the camera: x to the right, y up, z to the camera, nothing beside it."""
    pytest.importorskip("embreex", reason="needs the extra render")
    from evaluation import appearance
    from evaluation.testsets.casting import look_at
    from polsep.render.raycast import MeshScene
    from polsep.render.shapes import ellipsoid

    monkeypatch.setattr(appearance, "SIDE", 64)
    ball = MeshScene(ellipsoid(np.ones(3), [np.zeros((4, 4))]))
    normals = appearance.find_normals(ball, look_at(ball.mesh, 40.0, 20.0))
    assert normals.shape == (32, 32, 3) and not normals[0, 0].any()
    np.testing.assert_allclose(np.linalg.norm(normals[16, 16]), 1, rtol=1e-5)
    assert normals[16, 16, 2] > 0.98
    assert normals[16, 26, 0] > 0.5 and normals[16, 6, 0] < -0.5
    assert normals[6, 16, 1] > 0.5 and normals[26, 16, 1] < -0.5
