"""Photographs of an ordinary camera: aligned, read from camera raw, TIFF, sRGB and films, separated by the command."""

from __future__ import annotations

import io
import json
import math
import sys
from functools import cache, partial
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image
from test_cli import Cli, assert_refused, contents, run_here

from polsep.compute.registration import MOTIONS, find_motion, move_back, residual_shift
from polsep.io.raw.frames import ReadOptions, read_frames
from polsep.io.raw.photographs import MOST_FRAMES, read_photographs
from polsep.io.results.exr import read_exr_layers
from polsep.io.store.errors import InputError
from polsep.methods import METHODS
from polsep.photographs import PAIR, PAIR_DEG, PhotoOptions, read_measurements
from polsep.physics.srgb import srgb
from polsep.physics.stokes import Measurements, fit_stokes
from polsep.sensor.camera import Mosaic

pytestmark = pytest.mark.usefixtures("compiled")


@pytest.fixture
def polsep(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Cli:
    """Run `polsep ARGS` inside this process."""
    return partial(run_here, monkeypatch, capfd)


Floats = NDArray[np.float64]
#: Side of test scenes in pixels.
SIDE = 200
SIX = (0.0, 33.0, 70.0, 101.0, 128.0, 160.0)


def scene(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Diffuse light ``[3, ...]``, specular light and its direction [rad] at places: blobs, everywhere smooth."""
    rng = np.random.default_rng(1)
    diffuse, specular = np.full((3, *x.shape), 0.15), np.zeros_like(x)
    for _ in range(300):
        color, (cx, cy) = rng.uniform(0, 0.15, 3), rng.uniform(-20, SIDE + 20, 2)
        width = rng.uniform(1.5, 5)
        diffuse += color[:, None, None] * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * width**2))
    for cx, cy in rng.uniform(20, SIDE - 20, (6, 2)):
        specular += 0.25 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * 4.0**2))
    return diffuse, specular, 0.002 * (x - y)


@cache
def lobes(kind: str = "none") -> tuple[Floats, Floats, Floats]:
    """`scene` as seen by a camera that moved by `motion_of`: its pixels show the motion's places."""
    y, x = np.mgrid[:SIDE, :SIDE].astype(np.float64)
    places = np.linalg.inv(motion_of(kind)) @ np.stack([x, y, np.ones_like(x)]).reshape(3, -1)
    u, v = (places[:2] / places[2]).reshape(2, SIDE, SIDE)
    return scene(u, v)


def photograph(degrees: float, kind: str = "none", seed: int = 0) -> NDArray[np.float32]:
    """`lobes` behind an analyser ``[3, H, W]``, with noise."""
    diffuse, specular, angle = lobes(kind)
    image = diffuse / 2 + specular * (1 + np.cos(2 * (np.radians(degrees) - angle))) / 2
    noise = np.random.default_rng(seed).normal(0, 0.001, image.shape)
    return np.asarray(image + noise, np.float32)


def motion_of(kind: str) -> Floats:
    """A small motion of that kind."""
    if kind == "none":
        return np.eye(3)
    turn = math.radians(0.7) if kind != "shift" else 0.0
    matrix = np.array([[math.cos(turn), -math.sin(turn), 3.3], [math.sin(turn), math.cos(turn), -5.6], [0, 0, 1]])
    if kind in ("affine", "homography"):
        matrix[0, 0] *= 1.01
    if kind == "homography":
        matrix[2, 0] = 2e-5
    return matrix


def write_tiff(path: Path, image: NDArray[np.floating]) -> Path:
    """A 16-bit linear TIFF of a picture ``[3, H, W]``, white = 1."""
    codes = np.round(np.clip(np.moveaxis(image, 0, -1), 0, 1) * 65535).astype(np.uint16)
    tifffile.imwrite(path, codes, photometric="rgb")
    return path


@pytest.mark.parametrize("kind", MOTIONS)
def test_known_motions_are_found_to_a_twentieth_of_a_pixel(kind: str) -> None:
    """Between photographs behind crossed filters and of other exposure; moved back they agree."""
    pytest.importorskip("cv2")
    true = motion_of(kind)
    still, moved = photograph(0), 0.7 * photograph(90, kind, seed=1)
    found = find_motion(still.mean(axis=0), moved.mean(axis=0), kind)
    middle = np.array([[SIDE / 4, 3 * SIDE / 4, SIDE / 2], [SIDE / 2, SIDE / 4, 3 * SIDE / 4], [1, 1, 1]])
    places = [(m @ middle)[:2] / (m @ middle)[2] for m in (true, found.matrix)]
    assert float(np.abs(places[0] - places[1]).max()) < 0.05
    assert found.correlation > 0.8 > found.before
    back = move_back(moved, found.matrix)[:, 20:-20, 20:-20] / 0.7
    assert float(np.sqrt(((back - photograph(90)[:, 20:-20, 20:-20]) ** 2).mean())) < 0.003
    left = residual_shift(still.mean(axis=0), move_back(moved, found.matrix).mean(axis=0))
    assert left < 0.1 < residual_shift(still.mean(axis=0), moved.mean(axis=0))


def test_pictures_of_nothing_are_not_aligned() -> None:
    pytest.importorskip("cv2")
    with pytest.raises(ValueError, match="expected photographs of one scene"):
        find_motion(photograph(0).mean(axis=0), np.zeros((SIDE, SIDE), np.float32), "shift")


@pytest.mark.parametrize("shape", [(1, 40), (40, 1), (15, 400), (16, 4096)])
def test_photographs_too_small_to_align_are_refused(shape: tuple[int, int]) -> None:
    """In one line, with the size; strips are, whose coarse pictures are a few pixels wide."""
    pytest.importorskip("cv2")
    least, image = (32 if max(shape) > 4000 else 16), np.full(shape, 0.5, np.float32)
    said = f"at least {least}x{least} pixels to align, found {shape[1]}x{shape[0]}: --align none"
    with pytest.raises(ValueError, match=said):
        find_motion(image, image)


def test_two_angles_are_no_pair() -> None:
    """Degrees count from the picture's right, those of a pair from a direction that nobody measures."""
    for angles in (PAIR_DEG, (90.0, 0.0)):
        with pytest.raises(ValueError, match="expected three or more angles that differ"):
            PhotoOptions(angles)
    assert PhotoOptions(PAIR).known_deg() == PAIR_DEG and PhotoOptions(None).known_deg() is None
    with pytest.raises(ValueError, match="expected angles in degrees, None or 'pair', found 'crossed'"):
        PhotoOptions("crossed")  # type: ignore[arg-type]


def test_a_pair_comes_back_as_diffuse_and_specular(tmp_path: Path, polsep: Cli) -> None:
    """Aligned, exposures found: the lobes of the scene; named after the first; all in the report."""
    pytest.importorskip("cv2")
    pytest.importorskip("rawpy")
    parallel = write_tiff(tmp_path / "p.tif", 1.5 * photograph(0))
    crossed = write_tiff(tmp_path / "c.tif", photograph(90, "shift", seed=2))
    run = polsep("separate", "--parallel", parallel, "--crossed", crossed, "-o", tmp_path / "o", "--method", "analytic")
    assert run.status == 0 and "equal exposures were expected, found 1.5,1" in run.err
    assert set(contents(tmp_path / "o")) == {"p.exr", "p.png", "p.json"}
    report = json.loads((tmp_path / "o" / "p.json").read_text())["report"]
    facts = report["photographs"]
    assert report["layout"] == "two crossed photographs" and facts["exposures_source"] == "found"
    assert facts["exposures"][0] == pytest.approx(1.5, rel=0.03)
    assert facts["moved_pixels"][0] == pytest.approx(6.5, abs=0.05)
    layers = read_exr_layers(tmp_path / "o" / "p.exr")
    height, width = layers["specular.G"].shape
    assert SIDE - 9 <= height < SIDE and SIDE - 9 <= width < SIDE
    diffuse, specular, angle = lobes()
    seen = specular * np.cos(2 * angle)
    rows, cols = slice(SIDE - height, None), slice(0, width)  # the second photograph lacks the top and the right
    assert float(np.abs(layers["specular.G"] - seen[rows, cols])[5:-5, 5:-5].mean()) < 0.01
    assert float(np.abs(layers["diffuse.G"] - (diffuse[1] + specular - seen)[rows, cols])[5:-5, 5:-5].mean()) < 0.02


def test_photographs_that_stand_still_are_not_resampled(tmp_path: Path) -> None:
    """Their samples are those of the files, to the bit, whether aligned or not; stated exposures divide them."""
    pytest.importorskip("cv2")
    paths = [str(write_tiff(tmp_path / f"{angle:g}.tif", photograph(angle, seed=k))) for k, angle in enumerate(SIX)]
    aligned, facts = read_measurements(paths, PhotoOptions(SIX))
    plain, _ = read_measurements(paths, PhotoOptions(SIX, align="none"))
    assert isinstance(plain.data, Measurements) and isinstance(aligned.data, Measurements)
    assert (aligned.data.data == plain.data.data).all() and facts["contradiction"] < 0.01 and not aligned.notes
    codes = np.moveaxis(tifffile.imread(paths[3]), -1, 0)
    assert (plain.data.data[3] == codes.astype(np.float32) / np.float32(65535)).all()
    stated, facts = read_measurements(paths, PhotoOptions(SIX, exposures=(2, 1, 1, 1, 1, 4), align="none"))
    assert isinstance(stated.data, Measurements) and facts["exposures"] == [2, 1, 1, 1, 1, 4]
    assert (stated.data.data[5] == plain.data.data[5] / 4).all()
    assert any("of their light contradict" in note for note in stated.notes)


@pytest.mark.parametrize("strength", [1.0, 0.15])
def test_swapped_pairs_are_doubted(tmp_path: Path, strength: float) -> None:
    """The parallel photograph has the highlights, so it is the brighter one there, if by 1 % of all light alone."""
    parallel, crossed = (photograph(angle) for angle in PAIR_DEG)
    pair = {"p": crossed + strength * (parallel - crossed), "c": crossed}
    paths = [str(write_tiff(tmp_path / f"{name}.tif", image)) for name, image in pair.items()]
    assert strength == 1 or 1.005 < pair["p"].mean() / pair["c"].mean() < 1.02
    for order, count in ((paths, 0), (paths[::-1], 1)):
        frame, _ = read_measurements(
            order, PhotoOptions(PAIR, exposures=(1, 1), align="none"), ReadOptions(white_level=65535)
        )
        assert sum("are they swapped?" in note for note in frame.notes) == count


def test_unknown_angles_are_found(tmp_path: Path, polsep: Cli) -> None:
    """Of six photographs, named in an order; of light of one direction nothing is found, in one line."""
    paths = [write_tiff(tmp_path / f"{k}.tif", photograph(angle, seed=k)) for k, angle in enumerate(SIX)]
    common = ("--align", "none", "-o", tmp_path / "o", "--method", "color-affine")
    assert polsep("separate", "--angles", "unknown", *paths, *common).status == 0
    facts = json.loads((tmp_path / "o" / "0.json").read_text())["report"]["photographs"]
    assert np.abs(np.array(facts["angles_deg"]) - SIX).max() < 0.3
    assert facts["angles"] == "found, up to a common roll and mirror" and facts["angle_error_deg"] < 0.2
    flat = [write_tiff(tmp_path / f"f{k}.tif", 0.8 * photograph(0, seed=k)) for k in range(5)]
    assert_refused(polsep("separate", "--angles", "unknown", *flat, *common), "one direction", "say --angles")


def test_a_film_of_a_turning_filter(tmp_path: Path) -> None:
    """At most `MOST_FRAMES` frames of it, evenly spaced, exact; a lossy film only where sRGB is said."""
    av = pytest.importorskip("av")
    frames = [np.full((32, 48, 3), 1000 * k + 17, np.uint16) for k in range(30)]
    for name, codec, pixels in (("turn.mkv", "ffv1", "gbrp16le"), ("phone.mp4", "mpeg4", "yuv420p")):
        with av.open(tmp_path / name, "w") as film:
            stream = film.add_stream(codec, rate=10)
            stream.width, stream.height, stream.pix_fmt = 48, 32, pixels
            for frame in frames:
                picture = av.VideoFrame.from_ndarray(frame, format="rgb48le").reformat(format=pixels)
                film.mux(stream.encode(picture))
            film.mux(stream.encode())
    photos = read_photographs([tmp_path / "turn.mkv"])
    levels = photos.array[:, 0, 0, 0].tolist()
    assert len(levels) == MOST_FRAMES and levels[0] == 17 and levels[-1] == 29_017 and photos.array.dtype == np.uint16
    with pytest.raises(ValueError, match="expected lossless RGB or grey, or --encoding srgb for other films"):
        read_photographs([tmp_path / "phone.mp4"])
    assert read_photographs([tmp_path / "phone.mp4"], encoded=True).array.shape == (MOST_FRAMES, 32, 48, 3)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_srgb_is_decoded_only_where_it_is_said(tmp_path: Path, suffix: str) -> None:
    """8-bit pictures with the curve give the scene's light; taken as linear they are noted, JPEG is refused."""
    paths = []
    for k, angle in enumerate(PAIR_DEG):
        codes = np.round(255 * srgb(np.moveaxis(photograph(angle), 0, -1))).astype(np.uint8)
        encode = imagecodecs.png_encode if suffix == ".png" else lambda x: imagecodecs.jpeg_encode(x, level=98)
        paths.append(str(tmp_path / f"{k}{suffix}"))
        Path(paths[-1]).write_bytes(encode(np.ascontiguousarray(codes)))
    frame, _ = read_measurements(paths, PhotoOptions(PAIR, align="none", encoding="srgb"))
    assert isinstance(frame.data, Measurements)
    assert float(np.abs(frame.data.data[0] - photograph(0)).mean()) < (0.002 if suffix == ".png" else 0.01)
    with pytest.raises(ValueError, match="expected no black or white level"):
        read_measurements(paths, PhotoOptions(PAIR, encoding="srgb"), ReadOptions(white_level=255))
    if suffix == ".png":
        assert "8-bit" in read_measurements(paths, PhotoOptions(PAIR, align="none"))[0].notes[0]
    else:
        with pytest.raises(ValueError, match="or --encoding srgb for JPEG"):
            read_measurements(paths, PhotoOptions(PAIR, align="none"))


def test_turned_jpeg_stays_as_stored(tmp_path: Path) -> None:
    """With a note, as camera raw: angles count in the sensor's pixels."""
    exif = Image.Exif()
    exif[0x0112] = 6
    picture = Image.fromarray(np.random.default_rng(2).integers(0, 256, (24, 32, 3)).astype(np.uint8))
    for name, more in (("upright.jpg", {}), ("turned.jpg", {"exif": exif})):
        picture.save(tmp_path / name, **more)  # type: ignore[arg-type]
    upright, turned = (read_photographs([tmp_path / f"{name}.jpg"], True) for name in ("upright", "turned"))
    assert len(upright.notes) == 1 and "orientation is not applied" in turned.notes[1]
    np.testing.assert_array_equal(turned.array, upright.array)


@pytest.mark.parametrize("progressive", [False, True])
def test_truncated_jpeg_is_refused(tmp_path: Path, progressive: bool) -> None:
    """Decoders fill what is missing with grey; what follows the end of a whole picture says nothing."""
    codes = np.random.default_rng(0).integers(0, 256, (64, 96, 3), np.uint8)
    stream = io.BytesIO()
    Image.fromarray(codes).save(stream, "JPEG", progressive=progressive, exif=b"Exif\0\0\xff\xd9")
    path, data = tmp_path / "a.jpg", stream.getvalue()
    path.write_bytes(data + b"\0\xff trailer")
    assert read_photographs([path], encoded=True).array.shape == (1, 64, 96, 3)
    for cut in (40, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:cut])
        with pytest.raises(InputError, match="it is truncated"):
            read_photographs([path], encoded=True)


def write_dng(path: Path, codes: NDArray[np.uint16], black: int, white: int, orientation: int = 1) -> Path:
    """The least DNG of an RGGB mosaic, exposed 1/60 s at f/8 in May 2026. Source: Adobe, Digital Negative 1.7."""
    matrix = [n for row in np.eye(3, dtype=int) for value in row for n in (int(value), 1)]
    tags: list[tuple[int, Any, int, Any, bool]] = [
        (50706, "B", 4, (1, 4, 0, 0), True),
        (50708, "s", 0, "polsep test camera", True),
        (33421, "H", 2, (2, 2), True),
        (33422, "B", 4, (0, 1, 1, 2), True),
        (50714, "H", 1, black, True),
        (50717, "H", 1, white, True),
        (50721, "2i", 9, matrix, True),
        (50728, "2I", 3, (1,) * 6, True),
        (33434, "2I", 1, (1, 60), True),
        (33437, "2I", 1, (8, 1), True),
        (274, "H", 1, orientation, True),
    ]
    tifffile.imwrite(path, codes, photometric=32803, metadata=None, extratags=tags, datetime="2026:05:04 12:13:14")
    return path


@pytest.mark.parametrize("full", [False, True])
def test_camera_raw_is_linear_light_in_the_cameras_colours(tmp_path: Path, full: bool) -> None:
    """Black 0, white 1, no balance and no curve; what clips is white or more; time, aperture and clock are read."""
    pytest.importorskip("rawpy")
    y, x = np.mgrid[:128, :128]
    light = np.stack(
        [0.3 + 0.2 * np.sin(x / 20), 0.4 + 0.2 * np.cos(y / 15), 0.2 + 0.1 * np.sin((x + y) / 25)], axis=-1
    )
    mosaic = np.where(y % 2 == 0, np.where(x % 2 == 0, 0, 1), np.where(x % 2 == 0, 1, 2))
    codes = np.round(512 + np.take_along_axis(light, mosaic[..., None], 2)[..., 0] * (16000 - 512)).astype(np.uint16)
    codes[60:64, 60:64] = 16000
    photos = read_photographs([write_dng(tmp_path / "a.dng", codes, 512, 16000)], full=full)
    turned = read_photographs([write_dng(tmp_path / "turned.dng", codes, 512, 16000, orientation=6)], full=full)
    assert photos.notes == () and "orientation is not applied" in turned.notes[0]
    np.testing.assert_array_equal(turned.array, photos.array)
    image, scale = photos.array[0], 1 if full else 2
    expected = light if full else light.reshape(64, 2, 64, 2, 3).mean((1, 3))
    clipped = image >= 1
    assert image.shape == expected.shape and photos.exposures == (pytest.approx(1 / 60 / 64),)
    assert photos.exposure == pytest.approx(1 / 60) and str(photos.captured).startswith("2026-05-04T12:13:14")
    assert bool(clipped[60 // scale : 64 // scale, 60 // scale : 64 // scale].all()) and clipped.mean() < 0.01
    inside = (slice(4, -4), slice(4, -4))
    away = ~clipped.any(axis=-1)[inside] & (np.abs(np.indices(clipped.shape[:2])[1] - 62 / scale) > 8)[inside]
    assert float(np.abs(image - expected)[inside][away].max()) < 0.03


@pytest.mark.parametrize("pages", ["auto", "frames", "angles"])
def test_stacks_of_four_angles_are_read_as_such(tmp_path: Path, pages: str) -> None:
    """Colour pages, and grey ones that obey the law of four angles; four frames of a recording stay frames."""
    four = [np.round(65535 * photograph(angle)).astype(np.uint16) for angle in (0, 45, 90, 135)]
    tifffile.imwrite(tmp_path / "rgb.tif", np.moveaxis(np.stack(four), 1, -1), photometric="rgb")
    tifffile.imwrite(tmp_path / "grey.tif", np.stack(four)[:, 1], photometric="minisblack")
    noise = np.random.default_rng(3).normal(0, 300, (4, SIDE, SIDE))
    drift = np.arange(4)[:, None, None] * 900
    tifffile.imwrite(tmp_path / "film.tif", (four[0][1] + noise + drift).astype(np.uint16), photometric="minisblack")
    options = ReadOptions(pages=pages)

    def kind(name: str) -> list[type]:
        return [type(frame.data) for frame in read_frames(tmp_path / name, options)]

    assert kind("grey.tif") == ([Mosaic] * 4 if pages == "frames" else [Measurements])
    assert kind("film.tif") == ([Measurements] if pages == "angles" else [Mosaic] * 4)
    if pages != "frames":
        frame = next(read_frames(tmp_path / "rgb.tif", options))
        assert isinstance(frame.data, Measurements) and frame.data.data.shape == (4, 3, SIDE, SIDE)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--parallel", "p.tif"], "expected --parallel and --crossed together"),
        (["--parallel", "p.tif", "--crossed", "c.tif", "x.tif"], "expected two photographs"),
        (["--parallel", "p.tif", "--crossed", "no.tif"], "no.tif: expected a file, found nothing"),
        (["--parallel", "p.tif", "--crossed", "cut.png"], "cut.png: expected a PNG header"),
        (["--angles", "unknown", "film.mp4"], "film.mp4: expected lossless RGB or grey, or --encoding srgb"),
        (["--parallel", "p.tif", "--crossed", "small.tif"], "expected photographs of one size and type"),
        (["--parallel", "p.tif", "--crossed", "c.tif", "--method", "joint"], "two crossed photographs"),
        (["--parallel", "p.tif", "--crossed", "c.tif", "--layout", "mono"], "photographs without --layout"),
        (["--angles", "0,60", "p.tif", "c.tif"], "expected three or more angles that differ"),
        (["--angles", "0,90", "p.tif", "c.tif"], "expected three or more angles that differ"),
        (["--angles", "90,0", "p.tif", "c.tif"], "expected three or more angles that differ"),
        (["--angles", "0,60,120", "p.tif", "c.tif"], "expected as many angles as photographs (2), found 3"),
        (["--angles", "0,x", "p.tif", "c.tif"], "expected --angles as numbers"),
        (["--angles", "nan,60", "p.tif", "c.tif"], "expected --angles as numbers"),
        (["--angles", "0,inf", "p.tif", "c.tif"], "expected --angles as numbers"),
        (["--angles", "unknown", "p.tif", "c.tif"], "expected at least 5 photographs"),
        (["--angles", "unknown", "{angle}.tif"], "expected angles for a name with {angle}"),
        (["--angles", "0,60,120"], "Missing argument 'FILE...'"),
        (["--parallel", "p.tif", "--crossed", "./p.tif"], "p.tif: expected a photograph of each angle"),
        (["--angles", "0,60,120", "p.tif", "link.tif", "c.tif"], "link.tif: expected a photograph of each angle"),
        (["--parallel", "p.tif", "--crossed", "copy.tif"], "copy.tif: expected a photograph of each angle"),
        (["--exposures", "1,2", "p.tif"], "expected --exposures with --parallel and --crossed"),
        (["--parallel", "p.tif", "--crossed", "c.tif", "--exposures", "1,0"], "expected positive exposures"),
        ([], "Missing argument 'FILE...'"),
    ],
)
def test_wrong_photographs_get_one_line(
    tmp_path: Path, polsep: Cli, monkeypatch: pytest.MonkeyPatch, words: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, image in (("p", photograph(0)), ("c", photograph(90)), ("x", photograph(45))):
        write_tiff(Path(f"{name}.tif"), image)
    write_tiff(Path("small.tif"), photograph(90)[:, 1:])
    Path("cut.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    Path("link.tif").symlink_to("p.tif")
    Path("copy.tif").write_bytes(Path("p.tif").read_bytes())
    av = pytest.importorskip("av")
    with av.open("film.mp4", "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
        container.mux(stream.encode(av.VideoFrame(64, 64, "yuv420p")))
        container.mux(stream.encode())
    aligned = ["--align", "none"] if "--angles" in words or "--parallel" in words else []
    assert_refused(polsep("separate", *words, *aligned, "-o", "o"), said)
    assert not Path("o").exists()


@pytest.mark.parametrize(("angles", "warned"), [((0.0, 30.0, 60.0), False), ((0.0, 1.0, 2.0), True)])
def test_angles_that_lie_together_are_remarked_on(tmp_path: Path, angles: tuple[float, ...], warned: bool) -> None:
    """Degrees that were mistyped, or a filter that was hardly turned, make noise of everything."""
    paths = [str(write_tiff(tmp_path / f"{angle:g}.tif", photograph(angle))) for angle in angles]
    frame, _ = read_measurements(paths, PhotoOptions(angles, align="none"))
    assert [note for note in frame.notes if "half a turn were expected, found 0, 1, 2" in note] == [*frame.notes]
    assert bool(frame.notes) == warned


def test_an_extra_that_is_missing_is_named_before_any_work(
    tmp_path: Path, polsep: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules["polsep.cli.app"].EXTRAS, "photos", ("no_such_module",))
    paths = [write_tiff(tmp_path / f"{k}.tif", photograph(90 * k)) for k in range(2)]
    run = polsep("separate", "--parallel", paths[0], "--crossed", paths[1], "-o", tmp_path / "o")
    assert_refused(run, "expected the extra 'photos'")


@pytest.mark.parametrize("colors", [3, 1], ids=["colour", "mono"])
def test_networks_separate_co_sited_images_at_their_resolution(colors: int) -> None:
    """Their images sum to s0 of the samples, three angles give what four do, and both the scene's lobes."""
    diffuse, specular, _ = lobes()
    s0 = np.moveaxis(diffuse[:colors] + specular, 0, -1)
    for angles in ((0.0, 45.0, 90.0, 135.0), (0.0, 60.0, 120.0)):
        data = np.stack([photograph(angle, seed=k)[:colors] for k, angle in enumerate(angles)])
        samples = Measurements(data, tuple(math.radians(angle) for angle in angles))
        images = METHODS["joint-fast"].run(samples, (1.0,) * colors, False)
        total = np.moveaxis(fit_stokes(samples).s0, 0, -1)
        assert images.diffuse.shape == s0.shape and np.abs(images.diffuse + images.specular - total).max() < 1e-6
        assert images.diffuse.min() >= 0 and images.specular.min() >= 0
        assert np.abs(images.specular - specular[..., None]).mean() < 0.3 * specular.mean()
