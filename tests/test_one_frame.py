"""Shape from one frame: what the network sees turns with the frame and not with the exposure; its twin; its files."""

from __future__ import annotations

import itertools
import json
import math
import os
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from test_cli import Run, assert_refused, run_here
from torch import Tensor

pytest.importorskip("scipy")
pytest.importorskip("embreex")
pytest.importorskip("skimage")

import trimesh
from test_geometry import cap

import polsep
from polsep.geometry import frames, one_frame
from polsep.geometry.lamp import seen_under
from polsep.geometry.one_frame import (
    SIDE,
    UNKNOWN_LIGHT,
    ShapeEstimator,
    gather,
    polarized_as_usual,
    shape,
    spread,
    square_around,
)
from polsep.geometry.polarization import Cue, choose_outward
from polsep.geometry.shape_maps import (
    INPUTS,
    USUAL,
    Seen,
    Surface,
    decode,
    encode,
    mean_surface,
    mirror_seen,
    mirror_surface,
    projected_normal,
)
from polsep.io.assets.maps import read_object
from polsep.io.raw.frames import Frame, ReadOptions
from polsep.io.results.exr import read_exr_layers
from polsep.io.results.separation_reader import open_separated
from polsep.io.results.separation_writer import write_separation
from polsep.io.store.errors import InputError
from polsep.io.store.weights import write_weights
from polsep.light.light_color import stated_gains
from polsep.networks.shape import ShapeNetwork
from polsep.networks.sizes import ResidualSize
from polsep.physics.fresnel import diffuse_dolp
from polsep.physics.stokes import Stokes
from polsep.render.blobs import random_blob
from polsep.sensor.camera import IDEAL, Layout, Mosaic, expose
from polsep.separation.report import SeparatedFrame
from polsep.train.shape_examples import COUNT, PLANES, Examples, random_shape_example
from polsep.train.shape_losses import random_lamps, shape_loss
from polsep.train.shape_task import angles_deg, cut_example, score_shapes, seen_of, shift_errors, truth_of, turn_example

Cli = Callable[..., Run]
#: A small network, for what does not depend on weights.
SMALL = ResidualSize(4, (1, 1))


def sphere_planes(side: int = 48) -> Tensor:
    """An example of a sphere with the diffuse polarization of its normals, lit from the camera."""
    normals, mask = cap(side, 80)
    n = torch.from_numpy(np.moveaxis(normals, -1, 0)).float()
    inside = torch.from_numpy(mask).float()[None]
    planes = torch.zeros(COUNT, side, side)
    shading = n[2:] * inside
    twice = torch.polar(torch.from_numpy(diffuse_dolp(n[2].numpy())), 2 * torch.atan2(n[1], n[0])) * shading[0]
    planes[PLANES["stokes"]] = torch.cat([shading, twice.real[None], twice.imag[None]]).repeat_interleave(3, dim=0)
    for name in ("found", "true"):
        planes[PLANES[name]] = torch.cat([shading.expand(3, -1, -1), 0 * shading])
        planes[PLANES[f"{name}_polarized"]] = torch.stack([twice.real, twice.imag])
    planes[PLANES["found_error"]] = 0.01
    planes[PLANES["mask"]], planes[PLANES["normal"]] = inside, n * inside
    planes[PLANES["albedo"]], planes[PLANES["roughness"]], planes[PLANES["specular"]] = inside, 0.4 * inside, inside
    planes[PLANES["light"]] = torch.tensor([0.0, 0.0, 1.0])[:, None, None]
    return planes


@pytest.mark.parametrize("ways", list(itertools.product((False, True), repeat=3)))
def test_a_turned_sphere_is_the_same_sphere(ways: tuple[bool, bool, bool]) -> None:
    """Normals, lamp, s1 and s2 turn with the image: a sphere lit from the camera looks alike in all eight ways."""
    planes = sphere_planes()
    torch.testing.assert_close(turn_example(planes, *ways), planes, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", INPUTS)
def test_what_is_seen_does_not_depend_on_the_exposure(name: str) -> None:
    """Twice the light gives the same maps, up to the floor that keeps logarithms finite; there are as many as said."""
    planes = sphere_planes()[None]
    first, second = (encode(seen_of(x, name), name) for x in (planes, _brighter(planes, 4.0)))
    assert first.shape[1] == INPUTS[name]
    torch.testing.assert_close(first, second, rtol=0, atol=0.02)


def _brighter(planes: Tensor, gain: float) -> Tensor:
    brighter = planes.clone()
    brighter[:, : PLANES["mask"].start] *= gain
    return brighter


@pytest.mark.parametrize("name", INPUTS)
def test_lamps_that_are_not_given_are_zeros(name: str) -> None:
    """One map says whether a lamp is known, three where it is; the last one is the mask."""
    seen = seen_of(sphere_planes()[None], name)
    for lamp, known in (((0.0, 0.0, 0.0), 0.0), ((0.6, 0.0, 0.8), 1.0)):
        maps = encode(seen._replace(light=torch.tensor(lamp).view(1, 3, 1, 1).expand(1, 3, 48, 48)), name)
        expected = torch.tensor([known, *lamp, 1.0]).view(1, 5, 1, 1) * seen.mask
        torch.testing.assert_close(maps[:, -5:], expected)


def test_means_weigh_normals_by_their_variances() -> None:
    """Of all else the geometric mean is taken, also of expected errors."""
    errors, ways = (0.1, 0.2), ((0.0, 0.6, 0.8), (0.6, 0.0, 0.8))
    predictions = [
        Surface(np.array(way).reshape(3, 1, 1), *[np.full((3, 1, 1), 1 / error)] * 3, *[np.full((1, 1, 1), error)] * 3)
        for error, way in zip(errors, ways, strict=True)
    ]
    mean = mean_surface(*predictions)
    expected = np.array(ways[0]) / 0.1**2 + np.array(ways[1]) / 0.2**2
    np.testing.assert_allclose(mean.normal[:, 0, 0], expected / np.linalg.norm(expected))
    np.testing.assert_allclose(mean.albedo, 50**0.5)
    np.testing.assert_allclose(mean.normal_error, 0.02**0.5)


def test_projected_normals_are_those_of_fresnel() -> None:
    """The sine of the zenith, at twice the azimuth, comes back from the diffuse polarization that it makes."""
    zeniths, azimuths = np.meshgrid(np.radians(np.arange(2, 85)), np.radians(np.arange(0, 360, 15)))
    dolp = diffuse_dolp(np.cos(zeniths))
    seen = np.stack([dolp * np.cos(2 * azimuths), dolp * np.sin(2 * azimuths)]).astype(np.float32)
    wanted = np.sin(zeniths) * np.stack([np.cos(2 * azimuths), np.sin(2 * azimuths)])
    np.testing.assert_allclose(projected_normal(seen), wanted, atol=5e-3)
    torch.testing.assert_close(projected_normal(torch.from_numpy(seen)).numpy(), projected_normal(seen))


@pytest.mark.parametrize("index", [1.33, 1.5, 1.8])
def test_other_indices_are_seen_as_the_usual_one(index: float) -> None:
    """Diffuse light of a sphere of any index looks like that of index 1.5, beside highlights of one AoLP."""
    normals, mask = (np.asarray(x) for x in cap(48, 75))
    cosine, twice = normals[..., 2], np.exp(2j * np.arctan2(normals[..., 1], normals[..., 0]))
    specular = np.where(mask, cosine**40, 0).astype(np.float32)

    def polarized(eta: float) -> NDArray[np.float32]:
        light = np.where(mask, cosine * diffuse_dolp(cosine, eta) * twice, 0) + specular * np.exp(1j)
        return np.stack([light.real, light.imag]).astype(np.float32)

    found = polarized_as_usual(polarized(index), np.where(mask, cosine, 0), specular[None], index)
    np.testing.assert_allclose(found, polarized(1.5), rtol=0, atol=1e-2)


def test_the_engine_is_the_network(tmp_path: Path) -> None:
    """OpenVINO's layers and torch's give the same surface; outputs mean unit normals toward the camera."""
    estimator, network = _untrained(tmp_path)
    planes = cut_example(sphere_planes(), 1.1, SIDE)[None]
    seen = seen_of(planes, "separated")
    with torch.no_grad():
        wanted = decode(network(encode(seen, "separated")), seen.image, seen.mask)
    found = estimator.predict(_as_seen(planes))
    for name in found._fields:
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name)[0].numpy(), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=0), 1, atol=1e-6)
    assert (found.normal[2] > 0).all()


@pytest.mark.parametrize("given", [False, True])
def test_mirrored_frames_give_mirrored_surfaces(tmp_path: Path, given: bool) -> None:
    """Of a random frame: mirror images are seen alike, as s2 and the lamp's x change their signs."""
    estimator, _ = _untrained(tmp_path)
    planes = cut_example(random_planes(), 1.1, SIDE)
    planes[PLANES["light"]] *= given
    mirrored = turn_example(planes, True, False, False)
    seen, other = (_as_seen(p[None]) for p in (planes, mirrored))
    for first, second in zip(other, mirror_seen(seen), strict=True):
        np.testing.assert_array_equal(first, second)
    found, wanted = estimator.find(other), mirror_surface(estimator.find(seen))
    for name in found._fields:
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=0), 1, atol=1e-6)


def _as_seen(planes: Tensor) -> Seen:
    return Seen(*(np.asarray(x)[0] for x in seen_of(planes, "separated")))


def random_planes() -> Tensor:
    """The sphere's example with other light everywhere: no part of it is symmetric."""
    planes = sphere_planes()
    noise = torch.rand(planes.shape, generator=torch.Generator().manual_seed(4))
    planes[: PLANES["mask"].start] *= 0.5 + noise[: PLANES["mask"].start]
    planes[PLANES["light"]] = torch.tensor([0.6, 0.0, 0.8])[:, None, None]
    return planes


def test_a_lamp_that_is_not_given_is_found(tmp_path: Path) -> None:
    """The surface of a lamp that is not given is that of the lamp which is found."""
    estimator, _ = _untrained(tmp_path)
    seen = _as_seen(cut_example(random_planes(), 1.1, SIDE)[None])
    unknown = seen._replace(light=0 * seen.light)
    lamp = estimator.find_lamp(unknown)
    assert math.hypot(*lamp) == pytest.approx(1, abs=1e-6)
    wanted = estimator.find(seen_under(unknown, lamp))
    np.testing.assert_array_equal(estimator.find(unknown).normal, wanted.normal)


def _untrained(folder: Path) -> tuple[ShapeEstimator, ShapeNetwork]:
    torch.manual_seed(3)
    network = ShapeNetwork(INPUTS["separated"], USUAL, SMALL)
    for weight in network.parameters():
        torch.nn.init.normal_(weight, std=0.1)
    arrays = {name: value.half().float() for name, value in network.state_dict().items()}
    network.load_state_dict(arrays)
    path = folder / "small.safetensors"
    write_weights(path, arrays, {"method": "shape", "input": "separated", "size": json.dumps(asdict(SMALL))})
    return ShapeEstimator(path), network


def test_expected_errors_are_shifted_alone() -> None:
    """All expected errors of normals are times a factor, and nothing else changes."""
    network = ShapeNetwork(INPUTS["separated"], USUAL, SMALL)
    planes = cut_example(sphere_planes(), 1.1, 48)[None]
    seen = seen_of(planes, "separated")
    with torch.no_grad():
        before = decode(network(encode(seen, "separated")), seen.image, seen.mask)
        shift_errors(network, 0.8)
        after = decode(network(encode(seen, "separated")), seen.image, seen.mask)
    torch.testing.assert_close(after.normal_error, 0.8 * before.normal_error)
    for name in set(before._fields) - {"normal_error"}:
        assert torch.equal(getattr(before, name), getattr(after, name))


def test_losses_are_least_at_the_truth() -> None:
    """Nothing but expected errors is left at the truth; a tilted normal, another albedo or roughness costs."""
    planes = sphere_planes()[None]
    truth, mask = truth_of(planes), planes[:, PLANES["mask"]]
    one = torch.ones_like(truth.roughness)
    truth = truth._replace(roughness=0.4 * one, specular=one, normal_error=one, roughness_error=one, specular_error=one)
    inside = torch.tensor([0.0, 0.0, 1.0]).view(1, 3, 1, 1)
    exact = truth._replace(normal=torch.where(mask > 0, truth.normal, inside), albedo=truth.albedo + 1e-3)

    def loss(**changed: Tensor) -> float:
        return float(shape_loss(exact._replace(**changed), exact, mask, torch.Generator().manual_seed(5)))

    least = loss()
    tilted = torch.nn.functional.normalize(exact.normal + torch.tensor([0.2, 0.0, 0.0]).view(1, 3, 1, 1), dim=1)
    ramp = torch.linspace(0.5, 2.0, mask.shape[-1]).expand_as(exact.albedo)
    assert least < 0.02
    assert loss(albedo=2 * exact.albedo) == pytest.approx(least, abs=5e-3)  # albedo is relative
    assert min(loss(normal=tilted), loss(albedo=ramp * exact.albedo), loss(roughness=0.8 * one)) > least + 0.05


def test_squares_come_back() -> None:
    """A smooth image survives the way into the network's square and back, also where the object touches the border."""
    rows, cols = np.mgrid[:90, :120] / 100.0
    image = np.stack([rows, np.sin(3 * cols)]).astype(np.float32)
    mask = np.zeros((90, 120), np.bool_)
    mask[5:90, 60:118] = True
    window = square_around(mask)
    again = spread(gather(image, window, SIDE), window, mask.shape)
    inner = mask.copy()
    inner[84:] = False  # beyond the border there is no light
    np.testing.assert_allclose(again[:, inner], image[:, inner], atol=0.02)


def test_polarization_alone_finds_a_sphere() -> None:
    """From exact azimuths up to half a turn, those that point outward are a sphere's."""
    normals, mask = cap(64, 80)
    turned = normals * np.array([-1.0, -1.0, 1.0])
    swap = np.random.default_rng(1).random(mask.shape) < 0.5
    cue = Cue(
        np.where(swap[..., None], turned, normals),
        np.where(swap[..., None], normals, turned),
        np.full(mask.shape, 0.1),
    )
    cosine = (choose_outward(cue, mask) * normals).sum(axis=-1)[mask]
    assert float((cosine > 0.99).mean()) > 0.97


@pytest.mark.parametrize("seed", [1, 2, 3, 14])
def test_bodies_are_closed_and_face_outward(seed: int) -> None:
    """Every edge belongs to two triangles, which wind counter-clockwise seen from outside, as their normals do."""
    body = random_blob(torch.Generator().manual_seed(seed))
    mesh = trimesh.Trimesh(body.vertices, body.faces, process=True, merge_norm=True, merge_tex=True)
    _, shared = np.unique(mesh.edges_unique_inverse, return_counts=True)
    assert float((shared == 2).mean()) > 0.9995 and mesh.is_winding_consistent and mesh.volume > 0  # slivers merge
    corners = body.vertices[body.faces]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert float(((facing * body.normals[body.faces].mean(axis=1)).sum(axis=1) > 0).mean()) > 0.995
    np.testing.assert_allclose(np.linalg.norm(body.normals, axis=1), 1, atol=1e-6)


def test_examples_depend_on_their_numbers_alone() -> None:
    """The same numbers give the same planes; images and surface belong together, finite, inside the mask."""
    first, second, other = (random_shape_example(Examples("test", 5), n, 96) for n in (1, 1, 3))
    torch.testing.assert_close(first, second, rtol=0, atol=0)
    assert first.shape == (COUNT, 48, 48) and not torch.equal(first, other)
    mask = first[PLANES["mask"]][0] > 0
    assert bool(torch.isfinite(first).all()) and 0.02 < float(mask.float().mean()) < 1
    length = first[PLANES["normal"]].norm(dim=0)[mask]
    torch.testing.assert_close(length, torch.ones_like(length), rtol=0, atol=1e-4)
    true, found = first[PLANES["true"]][:3, mask], first[PLANES["found"]][:3, mask]
    assert float((true - found).abs().mean()) < 0.3 * float(true.abs().mean())


def sphere_frame() -> SeparatedFrame:
    """The sphere as a separated frame."""
    planes = sphere_planes(64)
    found, (s1, s2) = planes[PLANES["found"]].numpy(), planes[PLANES["found_polarized"]].numpy()
    diffuse, specular = (np.ascontiguousarray(np.moveaxis(x, 0, -1)) for x in (found[:3], found[3:].repeat(3, axis=0)))
    dolp = np.hypot(s1, s2) / np.maximum(found[0], 1e-6)
    aolp = np.mod(np.arctan2(s2, s1) / 2, np.pi)
    error = np.full((64, 64, 2), 0.01, np.float32)
    return SeparatedFrame(diffuse, specular, dolp >= 0, dolp, aolp, {"warnings": []}, error)


def test_the_shipped_network_finds_a_sphere() -> None:
    """Normals of an unseen sphere, its expected errors, and an albedo without its shading."""
    frame = sphere_frame()
    normals, mask = cap(64, 80)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = polsep.shape(frame, mask, (0.0, 0.0, 1.0))
    # Its report names no lamp's colour.
    assert [str(note.message) for note in said] == [UNKNOWN_LIGHT, *found.warnings()]
    angle = angles_deg(
        torch.from_numpy(found.normals).movedim(-1, 0)[None], torch.from_numpy(normals).movedim(-1, 0)[None]
    )
    inside = angle[0][torch.from_numpy(mask)]
    assert float(inside.mean()) < 8  # 6.5 when it was shipped
    assert (
        0.3
        < float(np.degrees(np.sqrt(2 * (found.normal_error[mask] ** 2).mean()))) / float(inside.square().mean().sqrt())
        < 4
    )
    assert np.log(found.albedo[mask] + 1e-3).std() < 0.6 * np.log(frame.diffuse[mask] + 1e-3).std()
    assert "Shape(normals [64, 64]" in repr(found) and not found.normals[~mask].any()
    np.testing.assert_allclose(np.linalg.norm(found.normals[mask], axis=-1), 1, atol=1e-5)


def test_floor_of_the_shipped_weights() -> None:
    """On objects that no training saw, made here, the shipped network is no worse than when it was shipped."""
    examples = [cut_example(random_shape_example(Examples("test", 11), n, 256), 1.1, SIDE // 2) for n in range(6)]
    network = ShapeNetwork(INPUTS["separated"], USUAL, one_frame.load_estimator().size)
    arrays = polsep_weights()
    network.load_state_dict({name: torch.from_numpy(array) for name, array in arrays.items()})
    scores = score_shapes(network.eval(), examples, "separated")
    assert scores["normals, mean deg"] < FLOOR_DEG, scores


#: Mean angular error of the shipped weights on six objects, two of each kind (30.7), and a tenth more.
FLOOR_DEG = 33.8


def polsep_weights() -> dict[str, NDArray[np.float32]]:
    from polsep.io.store.weights import read_weights, shipped_weights

    return read_weights(shipped_weights("shape/separated"))[0]


def test_bad_arguments_are_refused() -> None:
    """Masks of another size or empty ones, lamps behind the object, frames without polarization or light."""
    frame = sphere_frame()
    with pytest.raises(ValueError, match="expected a mask of"):
        shape(frame, np.ones((3, 3), np.bool_))
    with pytest.raises(ValueError, match="holds pixels"):
        shape(frame, np.zeros((64, 64), np.bool_))
    with pytest.raises(ValueError, match="expected a mask of bools, found NaN"):
        shape(frame, np.full((64, 64), np.nan))  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="expected a mask as an array of bools, found"):
        shape(frame, [[1], [1, 2]])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="lamp's direction"):
        shape(frame, light=(0.0, 0.0, -1.0))
    dark = replace(frame, diffuse=0 * frame.diffuse, specular=0 * frame.specular)
    with pytest.raises(ValueError, match="black frame"):
        shape(dark)
    with pytest.raises(ValueError, match="with its polarization"):
        shape(replace(frame, dolp=0 * frame.dolp))
    for light in (5, "0,0,1", [[0, 0, 1]]):
        with pytest.raises(ValueError, match="expected a lamp's direction x, y, z"):
            shape(frame, light=light)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"expected a frame that polsep\.separate separated, found ndarray"):
        shape(frame.diffuse)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"expected a refractive index that is a number, found '1\.5'"):
        shape(frame, index="1.5")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"expected weights in .*nothing\.safetensors"):
        shape(frame, weights="nothing.safetensors")


@pytest.mark.parametrize(
    ("report", "said"),
    [
        ({"layout": "two crossed photographs"}, "expected polarization in all directions, found that of two crossed"),
        ({"photographs": {"frame": "the first photograph"}}, "found them counted from the first photograph"),
    ],
)
def test_angles_that_nobody_knows_are_refused(report: dict[str, object], said: str) -> None:
    """Two photographs show s1 alone, and unknown angles turn all normals: both would give a wrong shape unsaid."""
    with pytest.raises(ValueError, match=said):
        shape(replace(sphere_frame(), report={"light_color": [1.0, 1.0, 1.0], **report}))


def test_networks_of_other_inputs_are_refused(tmp_path: Path) -> None:
    """They would see images that they were not trained on; a file that changes is read again."""
    frame, path = sphere_frame(), tmp_path / "shape.safetensors"
    found = []
    for k, name in enumerate(("separated", "separated", "stokes")):
        torch.manual_seed(k)
        network = ShapeNetwork(INPUTS[name], USUAL, SMALL)
        torch.nn.init.normal_(network.last.weight, std=0.1)
        arrays = {name: value.detach().numpy() for name, value in network.state_dict().items()}
        write_weights(path, arrays, {"method": "shape", "input": name, "size": json.dumps(asdict(SMALL))})
        os.utime(path, ns=(k, k))
        if name == "stokes":
            with pytest.raises(ValueError, match="network that sees separated images, found one for 'stokes'"):
                one_frame.find_shape(frame, cap(64, 80)[1], None, path)
        else:
            found.append(one_frame.find_shape(frame, cap(64, 80)[1], None, path).normals)
    assert not np.array_equal(*found)


def test_masks_of_odd_raw_frames_are_taken(tmp_path: Path) -> None:
    """The last row or column that cuts a cell is in no separated image."""
    mask = np.zeros((65, 67), np.uint8)
    mask[10:30, 20:40] = 255
    np.save(tmp_path / "mask.npy", mask)
    found = read_object(tmp_path / "mask.npy", (32, 33))
    assert found.shape == (32, 33) and found[5:15, 10:20].all() and found.sum() == 100
    whole = read_object(tmp_path / "mask.npy", (64, 66))  # full resolution
    assert whole.shape == (64, 66) and whole.sum() == 400
    np.save(tmp_path / "mask.npy", mask[1:, 1:])  # a crop to 64x66, whose first whole cells begin at 1, 1
    cropped = read_object(tmp_path / "mask.npy", (31, 32))
    assert cropped[4:14, 9:19].all() and cropped.sum() == 100


def test_a_frame_that_is_full_is_said() -> None:
    """A mask that reaches around the border has a line that says what to do; an object inside has none."""
    one = np.ones((64, 64), np.float32)
    found = one_frame.Shape(
        np.dstack([0 * one, 0 * one, one]),
        0.05 * one,
        np.dstack([one] * 3),
        one,
        0.1 * one,
        one,
        one,
        one > 0,
        (0, 0, 1),
    )
    assert any("(mask)" in line for line in found.warnings())
    assert replace(found, mask_given=True).warnings() == []
    assert replace(found, mask=cap(64, 80)[1]).warnings() == []


def test_specks_and_lines_are_not_the_object() -> None:
    """The mask is the sphere alone, whole, though a bright line and a speck are beside it."""
    frame = sphere_frame()
    diffuse = np.pad(frame.diffuse, ((16, 16), (0, 64), (0, 0)))
    diffuse[4:6, :] = diffuse[60:63, 100:104] = 1
    grown = replace(frame, diffuse=diffuse, specular=0 * diffuse)
    found = one_frame.mask_of(grown)
    sphere = np.pad(frame.diffuse.mean(axis=-1), ((16, 16), (0, 64))) > 0.1
    np.testing.assert_array_equal(found[sphere], True)
    assert not found[:8].any() and not found[:, 80:].any()


def test_a_small_object_is_found_in_a_noisy_frame() -> None:
    """A thousandth of the frame is enough: noise around it is not the object, and its highlight is no other level."""
    rows, cols = np.mgrid[:640, :768] - np.array([[[300]], [[200]]])
    radius = np.hypot(rows, cols) / 14
    light = np.where(radius < 1, 0.3 * np.sqrt(np.maximum(1 - radius**2, 0.05)), 0.0)
    noisy = light + 0.002 * np.abs(np.random.default_rng(0).standard_normal(light.shape))
    highlight = np.where(radius < 0.2, 2.0, 0.0)
    color = [np.repeat(image[..., None], 3, axis=-1).astype(np.float32) for image in (noisy, highlight)]
    frame = replace(sphere_frame(), diffuse=color[0], specular=color[1])
    found = one_frame.mask_of(frame)
    assert float((found & (radius < 1)).sum() / (found | (radius < 1)).sum()) > 0.97
    assert 0.0012 < (radius < 1).mean() < 0.0013


def test_lamps_are_in_front() -> None:
    """Random lamps are unit vectors toward the camera's side."""
    lamps = random_lamps(50, torch.Generator().manual_seed(1))
    torch.testing.assert_close(lamps.norm(dim=1), torch.ones(50))
    assert float(lamps[:, 2].min()) >= math.cos(math.radians(70)) - 1e-6


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Cli:
    """Run `polsep shape ARGS` inside this process."""
    return partial(run_here, monkeypatch, capfd, "shape")


def test_a_file_becomes_maps_and_a_mesh(run: Cli, tmp_path: Path) -> None:
    """All files appear, maps agree with the function's, and a second run is refused without --overwrite."""
    frame = sphere_frame()
    path = write_separation(frame, tmp_path / "in", "ball")[0]
    out = tmp_path / "out"
    done = run(path, "-o", out, "--light", "0,0,1")
    names = ["ball.exr", "ball_normals.png", "ball.glb", "ball.png", "ball.html", "ball.json"]
    assert (done.status, done.out.split()) == (0, [str(out / name) for name in names]), done
    planes = read_exr_layers(out / "ball.exr")
    found = one_frame.find_shape(polsep.read_separated(path), None, (0.0, 0.0, 1.0), None)
    np.testing.assert_allclose(planes["normal.X"], found.normals[..., 0], atol=1e-6)
    np.testing.assert_allclose(planes["normal_error.Y"], np.degrees(found.normal_error), rtol=1e-5)
    assert np.isfinite(planes["depth.Z"]).all() and np.ptp(planes["depth.Z"][found.mask]) > 10
    facts = json.loads((out / "ball.json").read_text())
    assert (facts["light"], facts["light_is"]) == ([0, 0, 1], "given") and set(facts["units"]) == {
        name.split(".")[0] for name in planes
    }
    assert (facts["index"], facts["mask_is"]) == (1.5, "found where light falls")
    assert [f"polsep: {line}" for line in facts["warnings"]] == done.err.splitlines()
    assert_refused(run(path, "-o", out), "--overwrite")


def test_the_lamp_of_a_separated_file_is_read_beside_it(run: Cli, tmp_path: Path) -> None:
    """A tinted lamp whose colour the sidecar names is divided out: the same normals; without one, a line says so."""
    frame, tint = sphere_frame(), np.array([0.5, 1.0, 0.7], np.float32)
    tinted = replace(frame, diffuse=frame.diffuse * tint, report={"warnings": [], "light_color": tint.tolist()})
    tinted = replace(tinted, error=frame.error * tint.mean())
    planes = []
    for name, one in (("white", frame), ("tinted", tinted)):
        path = write_separation(one, tmp_path, name)[0]
        assert run(path, "-o", tmp_path / "out", "--mesh", "none").status == 0
        planes.append(read_exr_layers(tmp_path / "out" / f"{name}.exr"))
    np.testing.assert_allclose(planes[1]["normal.X"], planes[0]["normal.X"], atol=1e-3)
    for end in ("exr", "json"):  # also where both were given another name
        (tmp_path / f"cup.{end}").write_bytes((tmp_path / f"tinted.{end}").read_bytes())
    renamed = run(tmp_path / "cup.exr", "-o", tmp_path / "out", "--mesh", "none")
    assert renamed.status == 0 and "colour is neither stated" not in renamed.err
    write_separation(frame, tmp_path, "cup", "npz", overwrite=True)  # of another run, in another format
    other = run(tmp_path / "cup.exr", "-o", tmp_path / "out", "--mesh", "none", "--overwrite")
    assert other.status == 0 and "colour is neither stated" in other.err
    (tmp_path / "tinted.json").unlink()
    alone = run(tmp_path / "tinted.exr", "-o", tmp_path / "other", "--mesh", "none")
    assert alone.status == 0 and "colour is neither stated nor in" in alone.err
    gray = replace(frame, diffuse=frame.diffuse[..., :1], specular=frame.specular[..., :1])
    assert not open_separated(write_separation(gray, tmp_path, "gray")[0])[1]  # mono has no lamp's colour


@pytest.mark.parametrize("beside", ["nothing", "another colour"])
def test_a_lamp_that_is_stated_goes_before_the_file_beside(tmp_path: Path, beside: str) -> None:
    """The colour stated of a separated file is divided out, and no note says that it is unknown; so is white."""
    frame, tint = sphere_frame(), np.array([0.5, 1.0, 0.7], np.float32)
    report = {"warnings": [], "light_color": [1.0, 0.3, 0.3]}
    specular, error = frame.specular * tint, frame.error * tint.mean()
    tinted = replace(frame, diffuse=frame.diffuse * tint, specular=specular, error=error, report=report)
    seen = []
    for name, one, stated in (("white", replace(frame, report=report), "white"), ("tinted", tinted, (0.5, 1.0, 0.7))):
        path = write_separation(one, tmp_path, name)[0]
        if beside == "nothing":
            (tmp_path / f"{name}.json").unlink()
        found, notes = frames.open_frame(path, ReadOptions(), "joint", stated)
        assert notes == []
        seen.append(one_frame.images_of(found, frame.valid))
    np.testing.assert_allclose(seen[1], seen[0], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("light", "channels", "gains"),
    [("white", 3, [1, 1, 1]), ((2, 1, 0.5), 3, [2, 1, 0.5]), ((2, 1, 0.5), 1, [1]), ((512, 256, 128), 3, [2, 1, 0.5])],
)
def test_stated_lamps_have_a_gain_per_channel(
    light: str | tuple[float, ...], channels: int, gains: list[float]
) -> None:
    """Mono has one, whatever the colour; green is 1, whatever the unit."""
    assert stated_gains(light, channels) == gains


def raw_sphere() -> NDArray[np.uint16]:
    """The sphere as a mosaic of 16 bits."""
    planes = sphere_planes(128)[PLANES["stokes"]]
    codes = expose(Stokes(planes[:3], planes[3:6], planes[6:]), Layout(), IDEAL).data * 65535
    return codes.round().to(torch.int32).numpy().astype(np.uint16)


def test_raw_frames_come_in_npz_too(run: Cli, tmp_path: Path) -> None:
    """Archives with a raw frame are separated, those with separated images are taken as they are, others refused."""
    np.savez(tmp_path / "raw.npz", raw=raw_sphere())
    write_separation(sphere_frame(), tmp_path, "separated", "npz")
    np.savez(tmp_path / "other.npz", a=np.zeros((4, 4)), b=np.zeros((4, 4)))
    words = ("-o", tmp_path / "out", "--mesh", "none")
    for name, method in (("raw", "analytic"), ("separated", "separated before")):
        done = run(tmp_path / f"{name}.npz", *words, *(("--method", method) if name == "raw" else ()))
        assert done.status == 0, done
        assert json.loads((tmp_path / "out" / f"{name}.json").read_text())["method"] == method
    assert_refused(run(tmp_path / "other.npz", *words), "other.npz: expected one array, or raw", "found arrays: a, b")


def test_of_many_frames_two_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file of several frames is refused as soon as the second is there; one of none, too."""
    one = Frame("film_0000", Mosaic(raw_sphere(), Layout(), 0.0, 65535.0), (), count=9000)

    def film(path: Path, options: ReadOptions) -> Iterator[Frame]:
        yield from (one, one)
        pytest.fail("a third frame was read")

    monkeypatch.setattr(frames, "read_frames", film)
    with pytest.raises(InputError, match=r"film.npy: expected one frame, found 9000"):
        frames.open_frame(tmp_path / "film.npy", ReadOptions(), "analytic")
    monkeypatch.setattr(frames, "read_frames", lambda path, options: iter(()))
    with pytest.raises(InputError, match=r"film.npy: expected one frame, found 0"):
        frames.open_frame(tmp_path / "film.npy", ReadOptions(), "analytic")


@pytest.mark.parametrize(("wide", "meshed"), [(1, False), (4, False), (14, True)])
def test_thin_things_have_maps_but_no_mesh(run: Cli, tmp_path: Path, wide: int, meshed: bool) -> None:
    """A line of a few pixels has its maps; of a mesh a line says, with the file, how wide objects have to be."""
    ones = np.ones((48, 600), np.float32)
    light = 0.3 * ones[..., None].repeat(3, axis=2)
    frame = SeparatedFrame(light, 0.2 * light, ones > 0, 0.2 * ones, 0.5 * ones, {"warnings": []})
    path = write_separation(frame, tmp_path, "wire")[0]
    mask = np.zeros((48, 600), np.float32)
    mask[20 : 20 + wide] = 1
    np.save(tmp_path / "mask.npy", mask)
    words = (path, "-o", tmp_path / "out", "--mask", tmp_path / "mask.npy", "--overwrite")
    done = run(*words)
    if meshed:
        assert done.status == 0, done
        return
    assert_refused(done, f"{path}: expected an object of 11 pixels across or more for a mesh", "say --mesh none")
    assert run(*words, "--mesh", "none").status == 0
    assert (read_exr_layers(tmp_path / "out" / "wire.exr")["normal.Z"][mask > 0] > 0).all()


def test_a_mesh_is_left_out_on_request(run: Cli, tmp_path: Path) -> None:
    """Without a mesh there are no depth and no mesh file."""
    path = write_separation(sphere_frame(), tmp_path, "ball")[0]
    done = run(path, "-o", tmp_path / "out", "--mesh", "none")
    assert done.status == 0 and not (tmp_path / "out" / "ball.glb").exists(), done
    assert "depth.Z" not in read_exr_layers(tmp_path / "out" / "ball.exr")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--light", "0,0,-1"), "z > 0"),
        (("--light", "left"), "x,y,z"),
        (("--mesh", "none", "--turntable"), "--turntable"),
        (("--mesh", "obj"), "glb"),
        (("--index", "1"), "'--index': expected a finite number from 1.3 to 2.5"),
    ],
)
def test_wrong_options_are_refused(run: Cli, tmp_path: Path, words: tuple[str, ...], said: str) -> None:
    """In one line, before any work, and without a file."""
    path = write_separation(sphere_frame(), tmp_path, "ball")[0]
    assert_refused(run(path, "-o", tmp_path / "out", *words), said)
    assert not (tmp_path / "out").exists()
