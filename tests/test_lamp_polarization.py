"""The lamp's degree of polarization: found from the white light that its highlights leave in the diffuse image."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from test_colored_specular import IDEAL, scene, separated
from tolerances import assert_close
from torch import Tensor

from polsep.compute.resizing import block_means
from polsep.io.raw.frames import ReadOptions
from polsep.io.raw.sequences import open_sequence
from polsep.pipeline import separate_capture
from polsep.sensor.camera import Layout, expose
from polsep.separation.colored_specular import Colored, color_specular
from polsep.separation.lamp_polarization import MIN_PART, SIDE, find_unpolarized, measure_places
from polsep.separation.places_kernel import measure_places_fast
from polsep.video.first_frame import separate_first
from polsep.video.recordings import VideoOptions

SIZE = 96
#: Errors of a slope, since the mean colour of a place holds a little of what is left.
SLOPE = 1e-3


def bodies(saturation: float = 1.0) -> tuple[Tensor, Tensor]:
    """Colours ``[3, SIZE, SIZE]`` in patches, with smooth shading, and highlights ``[1, SIZE, SIZE]`` on them."""
    generator = torch.Generator().manual_seed(3)
    patches = torch.rand(3, SIZE // SIDE, SIZE // SIDE, generator=generator).mul(0.4).add(0.1)
    colors = patches.repeat_interleave(SIDE, dim=1).repeat_interleave(SIDE, dim=2)
    grey = colors.mean(dim=0, keepdim=True)
    y, x = torch.meshgrid(*[(torch.arange(SIZE) % SIDE - (SIDE - 1) / 2) / SIDE] * 2, indexing="ij")
    shade = (1 + 0.4 * x)[None]  # to one side, so that it does not follow the highlights
    return (grey + saturation * (colors - grey)) * shade, 0.3 * torch.exp(-(x * x + y * y) / 0.05)[None]


def found_in(diffuse: Tensor, specular: Tensor) -> float:
    return find_unpolarized(measure_places(diffuse.numpy(), specular.numpy()))


@pytest.mark.parametrize("degree", [0.7, 0.8, 0.9, 0.95])
def test_what_is_left_says_the_degree(degree: float) -> None:
    """A method finds p S and leaves (1 - p) S in the diffuse image: their ratio, whatever the bodies' colours."""
    body, mirrored = bodies()
    found = found_in(body + (1 - degree) * mirrored, degree * mirrored)
    assert found == pytest.approx((1 - degree) / degree, abs=SLOPE)


def test_scale_does_not_matter() -> None:
    """Darker exposures have the same ratio, down to where highlights fade."""
    body, mirrored = bodies()
    one, two = (found_in(gain * (body + 0.2 * mirrored), gain * 0.8 * mirrored) for gain in (1.0, 0.5))
    assert one == pytest.approx(two, rel=1e-4)


@pytest.mark.parametrize("degree", [1.0, 1 / (1 + 0.8 * MIN_PART)])
def test_a_good_polarizer_changes_nothing(degree: float) -> None:
    body, mirrored = bodies()
    assert found_in(body + (1 - degree) * mirrored, degree * mirrored) == 0


def test_what_clips_in_a_strong_colour_shows_nothing() -> None:
    """Samples of a colour in which the lamp is brightest clip first: at 1 over its gain in white light."""
    body, mirrored = bodies()
    places = measure_places((body + 0.2 * mirrored).numpy(), (0.8 * mirrored).numpy())
    assert find_unpolarized(places, 1.0) > 0 == find_unpolarized(places, 3.0)


def test_grey_bodies_show_nothing() -> None:
    """White light on grey bodies is not told from shading."""
    body, mirrored = bodies(saturation=0.05)
    assert found_in(body + 0.2 * mirrored, 0.8 * mirrored) == 0


def test_bodies_of_one_hue_show_nothing() -> None:
    """There a lamp that is too yellow by a tenth leaves light on yellow bodies that looks like white light."""
    body, mirrored = bodies()
    skin = torch.tensor([0.6, 0.4, 0.2]).view(3, 1, 1) * body.mean(dim=0, keepdim=True)
    assert found_in(skin + 0.2 * mirrored, 0.8 * mirrored) == 0


@pytest.mark.parametrize("tint", [(0.3, 0, -0.3), (-0.2, 0.2, 0), (0, -0.3, 0.3), (0.5, 0.1, 0.1), (0.1, 0.3, 0.3)])
def test_a_wrong_color_of_the_lamp_is_no_polarizer(tint: tuple[float, float, float]) -> None:
    """It leaves coloured light, beside white, in the diffuse image."""
    body, mirrored = bodies()
    assert found_in(body + torch.tensor(tint).view(3, 1, 1) * mirrored, mirrored) == 0


def test_clipped_places_do_not_count() -> None:
    body, mirrored = bodies()
    assert found_in(body + mirrored, 4 * mirrored) == 0


@pytest.mark.parametrize("side", [1, 2])
def test_light_that_is_left_moves_to_the_specular_image(side: int) -> None:
    """Both images become the scene's, at half and full resolution; their sum stays."""
    body, mirrored = (x.repeat_interleave(2, dim=1).repeat_interleave(2, dim=2) for x in bodies())
    white, degree = mirrored.expand_as(body), 0.8
    images = separated(body + (1 - degree) * white, degree * white, side)
    mosaic = expose(scene(body + (1 - degree) * white, degree * white), Layout(), IDEAL)
    found, colored = color_specular(images, mosaic, (1.0, 1.0, 1.0))
    assert colored.lamp_dolp == pytest.approx(degree, abs=SLOPE) and colored.share == colored.retained == 0
    assert colored.remark is not None and "found one of 80%" in colored.remark and Colored().remark is None
    assert_close(torch.from_numpy(found.diffuse + found.specular), torch.from_numpy(images.diffuse + images.specular))
    truth = white[:, ::side, ::side].movedim(0, -1)
    torch.testing.assert_close(torch.from_numpy(found.specular), truth, rtol=0, atol=SLOPE)


def test_films_say_of_a_weak_polarizer_what_frames_say(tmp_path: Path) -> None:
    """Films are made without this step, and the line says so wherever it is read."""
    body, mirrored = (x.repeat_interleave(4, dim=1).repeat_interleave(4, dim=2) for x in bodies())
    white = mirrored.expand_as(body)
    mosaic = expose(scene(body + 0.4 * white, 0.6 * white), Layout(), IDEAL)
    (alone,) = separate_capture(mosaic, "joint-fast", "white").report["warnings"]
    np.save(tmp_path / "film.npy", mosaic.data.numpy().astype(np.uint16)[None])
    film = open_sequence(tmp_path / "film.npy", ReadOptions(white_level=mosaic.white_level))
    (said,) = separate_first(film, VideoOptions("joint-fast", light_color="white")).warnings
    assert alone == said and "moves to the specular one, but not in films" in alone


@pytest.mark.parametrize("cell", [1, 2])
def test_the_kernel_measures_the_same_places(cell: int) -> None:
    """Of images whose sides are no multiples, in a coloured light, at half and full resolution."""
    generator = np.random.default_rng(1)
    diffuse, specular = generator.random((2, cell * 50 + cell - 1, cell * 67, 3)).astype(np.float32)
    gains = np.array([0.5, 1.0, 1.5], np.float32)
    halves = [block_means(np.moveaxis(image / gains, -1, 0), cell) for image in (diffuse, specular)]
    expected = measure_places(halves[0], halves[1].mean(axis=0, keepdims=True))
    for found, wanted in zip(measure_places_fast(diffuse, specular, gains, cell), expected, strict=True):
        assert found.shape == wanted.shape
        np.testing.assert_allclose(found, wanted, rtol=2e-6)
