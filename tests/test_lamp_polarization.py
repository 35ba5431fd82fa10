"""The lamp's degree of polarization: found from the white light that its highlights leave in the diffuse image."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from test_colored_specular import IDEAL, scene, separated
from tolerances import assert_close
from torch import Tensor

from polsep.cli.app import app
from polsep.compute.resizing import block_means
from polsep.io.raw.frames import ReadOptions
from polsep.io.raw.sequences import open_sequence
from polsep.pipeline import separate, separate_capture
from polsep.sensor.camera import Layout, Mosaic, expose
from polsep.sensor.mosaic_fields import MIN_LAMP_DOLP
from polsep.separation.colored_specular import Colored, color_specular
from polsep.separation.lamp_polarization import MIN_PART, SIDE, find_unpolarized, less_unpolarized, measure_places
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
    assert "found one of 80%" in colored.remarks[0] and not Colored().remarks
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


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("spec", ["color", "mono", "90,45,135,0/RGGB@1,0", "0,45,90,135/GBRG"])
def test_a_stated_degree_separates_exactly(spec: str, full: bool) -> None:
    """Even light of a lamp of degree p: the formula gives p S alone, and S where p is stated; samples in any unit."""
    layout, degree, specular = Layout.parse(spec), 0.8, 0.4
    body = torch.tensor([0.3, 0.5, 0.2][: layout.channels]).view(-1, 1, 1).expand(-1, SIZE + 1, SIZE)
    white = torch.full_like(body, specular)
    mosaic = expose(scene(body + (1 - degree) * white, degree * white), layout, replace(IDEAL, bits=None))
    mosaic = replace(mosaic, data=600 + mosaic.data * 3000 / mosaic.white_level, black_level=600, white_level=3600)
    assumed, stated = (
        separate_capture(replace(mosaic, lamp_dolp=p), "analytic", "white", full=full) for p in (None, degree)
    )
    np.testing.assert_allclose(assumed.specular, degree * specular, atol=1e-4)
    np.testing.assert_allclose(stated.specular, specular, atol=1e-4)
    np.testing.assert_allclose(stated.diffuse, np.broadcast_to(body[:, 0, 0].numpy(), stated.diffuse.shape), atol=1e-4)
    np.testing.assert_allclose(stated.dolp, assumed.dolp)
    assert (assumed.report["lamp_dolp"], stated.report["lamp_dolp"]) == (1, degree)


@pytest.mark.parametrize(("method", "saturation", "less"), [("joint-fast", 0.05, 0.7), ("color-affine", 1.0, 0.9)])
def test_a_stated_degree_helps_where_none_is_found(method: str, saturation: float, less: float) -> None:
    """Both images come nearer to the truth, in a coloured light: of networks, on grey bodies, which show no degree."""
    body, mirrored = (x.repeat_interleave(4, dim=1).repeat_interleave(4, dim=2) for x in bodies(saturation))
    white, degree, light = mirrored.expand_as(body), 0.8, (0.6, 1.0, 0.8)
    gains = torch.tensor(light).view(3, 1, 1)
    mosaic = expose(scene(gains * (body + (1 - degree) * white), gains * degree * white), Layout(), IDEAL)
    truth = [block_means(gains * x, 2).movedim(0, -1).numpy() for x in (body, white)]
    errors = []
    for p in (None, degree):
        found = separate_capture(replace(mosaic, lamp_dolp=p), method, light)
        images = zip((found.diffuse, found.specular), truth, strict=True)
        errors.append([float(np.sqrt(np.mean((image - wanted) ** 2))) for image, wanted in images])
    assert errors[1][0] < less * errors[0][0] and errors[1][1] < less * errors[0][1]


def test_unpolarized_light_is_subtracted_where_nothing_clips() -> None:
    """Half of it from each sample, of its own colour; on arrays of either kind."""
    mosaic = Mosaic(torch.full((9, 8), 0.5), Layout.parse("90,45,135,0/RGGB@1,0"), 0.0, 1.0)
    mosaic.data[4, 4] = 1.0
    part = np.full((4, 4, 3), [0.1, 0.2, 0.3], np.float32)
    found = less_unpolarized(mosaic, part).data
    layout = mosaic.layout
    for y, x in ((0, 0), (1, 0), (2, 3), (7, 6), (8, 7)):
        inside, channel = y >= 1, layout.filter_at(y, x).channel
        assert float(found[y, x]) == pytest.approx(0.5 - inside * part[0, 0, channel] / 2)
    assert float(found[4, 4]) == 1
    same = less_unpolarized(replace(mosaic, data=mosaic.data.numpy()), part).data
    np.testing.assert_array_equal(same, found.numpy())


@pytest.mark.parametrize(
    ("degree", "line"),
    [
        (0.2, "expected lamp_dolp from 0.3 to 1, found 0.2"),
        (float("nan"), "expected lamp_dolp from 0.3 to 1, found nan"),
        ("0.9", "expected lamp_dolp as a number, found '0.9'"),
        (True, "expected lamp_dolp as a number, found True"),
    ],
)
def test_other_degrees_are_one_line(degree: object, line: str) -> None:
    with pytest.raises(ValueError, match=line):
        separate(np.full((16, 16), 0.5, np.float32), "analytic", lamp_dolp=degree)
    with pytest.raises(ValueError, match=r"expected a raw mosaic .* found angle images"):
        separate(np.full((4, 16, 16), 0.5, np.float32), "analytic", lamp_dolp=0.9)


def test_the_command_takes_the_degree(tmp_path: Path) -> None:
    """It is in the report; the range is that of frames; photographs, whose lamp a filter sees, have no such option."""
    np.save(tmp_path / "frame.npy", np.full((16, 16), 0.5, np.float32))
    words = ["separate", str(tmp_path / "frame.npy"), "-o", str(tmp_path), "--method", "analytic", "--lamp-dolp"]
    found = CliRunner().invoke(app, [*words, "0.9"])
    assert found.exit_code == 0, found.output
    assert json.loads((tmp_path / "frame.json").read_text())["report"]["lamp_dolp"] == 0.9
    for degree in (MIN_LAMP_DOLP - 0.01, 1.01):
        refused = CliRunner().invoke(app, [*words, str(degree)])
        assert refused.exit_code == 2 and "--lamp-dolp" in refused.output
    photographs = ["separate", "--parallel", "p.png", "--crossed", "c.png", "--lamp-dolp", "0.9"]
    refused = CliRunner().invoke(app, photographs)
    assert "expected photographs without --lamp-dolp" in str(refused.exception)
