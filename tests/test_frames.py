"""Every container gives back the exact samples, and notes say what nobody else would."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import pytest
import tifffile
import torch
from numpy.typing import NDArray

from polsep.io.raw.frames import READERS, Frame, Reader, ReadOptions, read_frames
from polsep.io.raw.genicam import PIXEL_FORMATS, pack_frame
from polsep.io.raw.page import Page
from polsep.io.store.errors import InputError
from polsep.physics.stokes import Measurements
from polsep.sensor.camera import Layout, Mosaic, sample_mosaic
from polsep.sensor.levels import ForgottenLevel, as_measurements, as_mosaic, interleave_planes

Array = NDArray[Any]
LUCID = "PolarizedAngles_0d_45d_90d_135d_"


def random_codes(dtype: str, shape: tuple[int, ...] = (12, 16), top: int | None = None) -> Array:
    """Samples that reach both ends of the dtype."""
    generator = np.random.default_rng(sum(shape))
    if np.dtype(dtype).kind == "f":
        return generator.random(shape).astype(dtype)
    top = int(np.iinfo(dtype).max) if top is None else top
    codes = generator.integers(0, top + 1, shape).astype(dtype)
    codes.flat[:2] = 0, top
    return codes


def only(path: Path | str, **options: Any) -> Frame:
    frames = list(read_frames(path, ReadOptions(**options)))
    assert len(frames) == 1
    return frames[0]


def mosaic_of(frame: Frame) -> Mosaic:
    assert isinstance(frame.data, Mosaic)
    return frame.data


def measurements_of(frame: Frame) -> Measurements:
    assert isinstance(frame.data, Measurements)
    return frame.data


def assert_samples(mosaic: Mosaic, expected: Array) -> None:
    assert mosaic.data.dtype == np.float32
    np.testing.assert_array_equal(mosaic.data, expected.astype(np.float32))


def write_png(path: Path, array: Array) -> None:
    path.write_bytes(imagecodecs.png_encode(array))


def write_pgm(path: Path, array: Array, maxval: int | None = None) -> None:
    maxval = int(np.iinfo(array.dtype).max) if maxval is None else maxval
    header = f"P5\n# a comment\n{array.shape[1]} {array.shape[0]}\n{maxval}\n".encode()
    path.write_bytes(header + array.astype(">u2" if maxval > 255 else "u1").tobytes())


def write_npz(path: Path, array: Array) -> None:
    np.savez_compressed(path, raw=array, exposure=np.float64(3.0))


WRITERS: dict[str, Callable[[Path, Array], object]] = {
    ".png": write_png,
    ".tiff": lambda path, array: tifffile.imwrite(path, array),
    ".TIF": lambda path, array: tifffile.imwrite(path, array, byteorder=">"),
    ".npy": lambda path, array: np.save(path, array),
    ".npz": write_npz,
    ".pgm": write_pgm,
}


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("suffix", WRITERS)
def test_integer_containers_are_exact(tmp_path: Path, suffix: str, dtype: str) -> None:
    path, codes = tmp_path / f"shot{suffix}", random_codes(dtype)
    WRITERS[suffix](path, codes)
    frame = only(path)
    mosaic = mosaic_of(frame)
    assert_samples(mosaic, codes)
    assert frame.stem == "shot" and frame.notes == ()
    assert (mosaic.layout, mosaic.black_level) == (Layout(), 0.0)
    assert mosaic.white_level == np.iinfo(dtype).max


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("suffix", [".tiff", ".npy", ".npz"])
def test_float_containers_are_exact(tmp_path: Path, suffix: str, dtype: str) -> None:
    path, samples = tmp_path / f"shot{suffix}", random_codes(dtype)
    WRITERS[suffix](path, samples)
    frame = only(path)
    assert_samples(mosaic_of(frame), samples)
    assert mosaic_of(frame).white_level == 1.0 and frame.notes == ()


@pytest.mark.parametrize("compression", ["zlib", "deflate", "lzw", "packbits", "zstd", "lzma", "jpeg2000", "lerc"])
@pytest.mark.parametrize("tile", [None, (16, 16)])
def test_tiff_compressions_are_exact(tmp_path: Path, compression: str, tile: tuple[int, int] | None) -> None:
    path, codes = tmp_path / "shot.tif", random_codes("uint16", (40, 34))
    tifffile.imwrite(path, codes, compression=compression, tile=tile, rowsperstrip=None if tile else 16)
    assert_samples(mosaic_of(only(path)), codes)


@pytest.mark.parametrize(
    ("compression", "arguments", "dtype", "found"),
    [
        ("jpeg2000", {"level": 60}, "uint16", "JPEG 2000 of the irreversible wavelet"),
        ("lerc", {"level": 20}, "uint16", "LERC with errors up to 20"),
        ("lerc", {"level": 0.01}, "float32", "LERC with errors up to 0.01"),
    ],
)
def test_lossy_tiff_is_refused(
    tmp_path: Path, compression: str, arguments: dict[str, float], dtype: str, found: str
) -> None:
    path = tmp_path / "shot.tif"
    tifffile.imwrite(path, random_codes(dtype, (40, 34)), compression=compression, compressionargs=arguments)
    with pytest.raises(InputError, match=f"expected lossless samples, found {found}"):
        only(path)


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_packed_tiff_says_its_white_level(tmp_path: Path, bits: int) -> None:
    path, codes = tmp_path / "shot.tiff", random_codes("uint16", top=2**bits - 1)
    tifffile.imwrite(path, codes, bitspersample=bits)
    frame = only(path)
    assert_samples(mosaic_of(frame), codes)
    assert mosaic_of(frame).white_level == 2**bits - 1 and frame.notes == ()


def test_pgm_says_its_white_level(tmp_path: Path) -> None:
    path, codes = tmp_path / "shot.pgm", random_codes("uint16", top=4095)
    write_pgm(path, codes, 4095)
    assert_samples(mosaic_of(only(path)), codes)
    assert mosaic_of(only(path)).white_level == 4095
    assert mosaic_of(only(path, white_level=4000.0)).white_level == 4000


def test_pages_come_lazily_and_are_numbered(tmp_path: Path) -> None:
    codes = random_codes("uint16", (3, 12, 16))
    tifffile.imwrite(tmp_path / "run.tiff", codes, photometric="minisblack")
    np.save(tmp_path / "run.npy", codes)
    np.save(tmp_path / "fortran.npy", np.asfortranarray(codes))
    for name in ("run.tiff", "run.npy", "fortran.npy"):
        frames = list(read_frames(tmp_path / name))
        stem = name.split(".")[0]
        assert [frame.stem for frame in frames] == [f"{stem}_0000", f"{stem}_0001", f"{stem}_0002"]
        for frame, page in zip(frames, codes, strict=True):
            assert_samples(mosaic_of(frame), page)


@pytest.mark.parametrize("order", "<>")
def test_thumbnails_are_no_frames(tmp_path: Path, order: str) -> None:
    """Wherever they stand, and what is left counts; a note says so. A file of nothing else is read."""
    codes = random_codes("uint16", (2, 16, 16))
    small = codes[0, ::2, ::2].astype(np.uint8)
    with tifffile.TiffWriter(tmp_path / "run.tiff", byteorder=order, bigtiff=order == ">") as file:
        for page, kind in ((small, 1), (codes[0], 0), (small, 1), (codes[1], 2), (small, 1)):
            jpeg = {} if order == ">" else {"compression": "jpeg" if kind & 1 else None}
            file.write(page, subfiletype=kind, photometric="minisblack", contiguous=False, **jpeg)
    frames = list(read_frames(tmp_path / "run.tiff"))
    assert [frame.stem for frame in frames] == ["run_0000", "run_0001"]
    for frame, page in zip(frames, codes, strict=True):
        assert_samples(mosaic_of(frame), page)
        assert frame.notes == ("3 of 5 TIFF pictures left out: thumbnails or masks of others",)
    tifffile.imwrite(tmp_path / "small.tiff", small, subfiletype=1)
    assert_samples(mosaic_of(only(tmp_path / "small.tiff")), small)


def test_damage_in_one_of_four_pages_comes_after_the_good_ones(tmp_path: Path) -> None:
    """Also where four pages might be four angles."""
    path = tmp_path / "run.tiff"
    with tifffile.TiffWriter(path) as file:
        for page in random_codes("uint16", (4, 32, 32)):
            file.write(page, compression="zlib", contiguous=False)
    with tifffile.TiffFile(path) as file:
        place = file.pages[2].dataoffsets[0]  # type: ignore[union-attr]  # a page, not a frame of it
    data = bytearray(path.read_bytes())
    data[place : place + 8] = bytes(8)
    path.write_bytes(data)
    frames = read_frames(path)
    assert [next(frames).index, next(frames).index] == [0, 1]
    with pytest.raises(InputError, match="damage"):
        next(frames)


def test_damage_in_a_later_page_comes_after_the_good_ones(tmp_path: Path) -> None:
    codes = random_codes("float32", (2, 12, 16))
    codes[1, 3, 5] = np.nan
    np.save(tmp_path / "run.npy", codes)
    frames = read_frames(tmp_path / "run.npy")
    assert_samples(mosaic_of(next(frames)), codes[0])
    with pytest.raises(ValueError, match=r"run\.npy: expected finite values, found 1 that are not.*\(3, 5\)"):
        next(frames)


@pytest.mark.parametrize("name", PIXEL_FORMATS)
def test_headerless_frames_of_every_format(tmp_path: Path, name: str) -> None:
    fmt = PIXEL_FORMATS[name]
    layout = Layout(bayer=fmt.bayer)
    mosaics = [random_codes("uint16", (8 + 2 * k, 16), top=2**fmt.bits - 1)[:8] for k in range(2)]
    path = tmp_path / "run.raw"
    angles = [mosaic_planes(mosaic, layout) if fmt.planes == 4 else mosaic for mosaic in mosaics]
    path.write_bytes(b"".join(pack_frame(codes, name) for codes in angles))
    size = (8, 4) if fmt.planes == 4 else (16, 8)
    frames = list(read_frames(path, ReadOptions(size=size, pixel_format=name)))
    assert [frame.stem for frame in frames] == ["run_0000", "run_0001"]
    for frame, codes in zip(frames, mosaics, strict=True):
        assert_samples(mosaic_of(frame), codes)
        assert mosaic_of(frame).layout == layout
        assert mosaic_of(frame).white_level == fmt.white_level
        assert bool(frame.notes) == (fmt.bayer not in (None, "RGGB"))


def mosaic_planes(mosaic: Array, layout: Layout) -> Array:
    """Twin of `interleave_planes`: the four angle planes of a mosaic, written out per pixel."""
    planes = np.empty((4, mosaic.shape[0] // 2, mosaic.shape[1] // 2), mosaic.dtype)
    for row in range(mosaic.shape[0]):
        for col in range(mosaic.shape[1]):
            k = (0, 45, 90, 135).index(int(layout.filter_at(row, col).angle_deg))
            planes[k, row // 2, col // 2] = mosaic[row, col]
    return planes


def test_a_layout_given_wins_over_the_pixel_format(tmp_path: Path) -> None:
    path = tmp_path / "shot.bin"
    path.write_bytes(pack_frame(random_codes("uint16", top=4095), "BayerRG12p"))
    frame = only(path, size=(16, 12), pixel_format="BayerRG12p", layout=Layout(bayer=None))
    assert mosaic_of(frame).layout == Layout(bayer=None)
    assert any("is used although BayerRG12p says RGGB" in note for note in frame.notes)


@pytest.mark.parametrize(("written", "read"), [("BayerRG12p", "BayerRG12Packed"), ("BayerRG12Packed", "BayerRG12p")])
@pytest.mark.parametrize("layout", [None, Layout()])
def test_the_other_packing_of_as_many_bytes_is_noted(
    tmp_path: Path, written: str, read: str, layout: Layout | None
) -> None:
    """Half of the codes are right in either, so that neither layout nor levels show it."""
    rows, cols = np.indices((64, 96))
    light = 900 + 20 * rows + 15 * cols + np.random.default_rng(0).normal(0, 10, rows.shape)
    (tmp_path / "shot.raw").write_bytes(pack_frame(light.astype(np.uint16), written))
    assert only(tmp_path / "shot.raw", size=(96, 64), pixel_format=written, layout=layout).notes == ()
    (note,) = only(tmp_path / "shot.raw", size=(96, 64), pixel_format=read, layout=layout).notes
    assert f"every other column of {read} is noise" in note and note.endswith(written.removeprefix("BayerRG"))


def test_size_given_for_a_container_is_noted(tmp_path: Path) -> None:
    write_png(tmp_path / "shot.png", random_codes("uint8"))
    assert "own header is used" in only(tmp_path / "shot.png", size=(8, 8)).notes[0]


@pytest.mark.parametrize(
    "layout", [Layout(), Layout(bayer=None), Layout(((0, 45), (135, 90)), "GBRG"), Layout(origin=(1, 1))]
)
def test_interleaving_undoes_splitting(layout: Layout) -> None:
    mosaic = random_codes("uint16")
    np.testing.assert_array_equal(interleave_planes(mosaic_planes(mosaic, layout), layout), mosaic)


def test_interleaving_agrees_with_the_forward_sensor() -> None:
    layout = Layout()
    planes = torch.arange(4.0)[:, None, None, None].expand(4, 3, 8, 8)  # the value is the index of the angle
    mosaic = sample_mosaic(Measurements(planes, layout.angles), layout).numpy()
    constant = np.broadcast_to(np.arange(4, dtype=np.float32)[:, None, None], (4, 4, 4))
    np.testing.assert_array_equal(interleave_planes(constant, layout), mosaic)


def test_angle_pages_under_a_colour_layout_go_back_to_the_mosaic(tmp_path: Path) -> None:
    mosaic = random_codes("uint16")
    planes = mosaic_planes(mosaic, Layout())
    tifffile.imwrite(tmp_path / "a.tiff", planes, photometric="minisblack")
    np.save(tmp_path / "a.npy", planes)
    np.savez(tmp_path / "a.npz", i0=planes[0], i45=planes[1], i90=planes[2], I135=planes[3])
    for name in ("a.tiff", "a.npy", "a.npz"):
        frame = only(tmp_path / name, pages="angles", layout=Layout())
        assert frame.stem == "a"
        assert_samples(mosaic_of(frame), mosaic)


def test_angle_pages_without_a_colour_layout_are_co_sited(tmp_path: Path) -> None:
    planes = random_codes("uint16", (4, 5, 7))
    np.save(tmp_path / "a.npy", planes)
    for layout in (None, Layout(bayer=None)):
        data = measurements_of(only(tmp_path / "a.npy", pages="angles", layout=layout, black_level=100.0))
        assert data.angles == (0, math.pi / 4, math.pi / 2, 3 * math.pi / 4)
        assert data.data.shape == (4, 1, 5, 7) and data.clipped is not None
        expected = (planes.astype(np.float64) - 100) / (65535 - 100)
        np.testing.assert_allclose(data.data[:, 0], expected, rtol=0, atol=1e-6)
        np.testing.assert_array_equal(data.clipped[:, 0], expected >= 1 - 2.0**-10)


def test_every_four_pages_are_one_set_of_angles(tmp_path: Path) -> None:
    planes = random_codes("uint8", (8, 6, 6))
    np.save(tmp_path / "a.npy", planes)
    frames = list(read_frames(tmp_path / "a.npy", ReadOptions(pages="angles")))
    assert [frame.stem for frame in frames] == ["a_0000", "a_0001"]
    np.testing.assert_array_equal((measurements_of(frames[1]).data[:, 0] * 255).round(), planes[4:])


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".npy"])
@pytest.mark.parametrize("shape", [(6, 8), (6, 8, 3)])
def test_templates_of_gray_and_colour(tmp_path: Path, suffix: str, shape: tuple[int, ...]) -> None:
    images = [random_codes("uint8", shape) // (k + 1) for k in range(4)]
    for image, angle in zip(images, (0, 45, 90, 135), strict=True):
        WRITERS[suffix](tmp_path / f"nir_{angle}{suffix}", image)
    frame = only(tmp_path / f"nir_{{angle}}{suffix}")
    data = measurements_of(frame).data
    assert frame.stem == "nir"
    assert data.shape == (4, 1 if len(shape) == 2 else 3, 6, 8)
    expected = np.stack(images).reshape(4, 6, 8, -1).transpose(0, 3, 1, 2)
    np.testing.assert_array_equal((data * 255).round(), expected)


def test_templates_in_folders_keep_the_file_name(tmp_path: Path) -> None:
    for angle in (0, 45, 90, 135):
        (tmp_path / str(angle)).mkdir()
        write_png(tmp_path / str(angle) / "shot.png", random_codes("uint8"))
    assert only(str(tmp_path / "{angle}" / "shot.png")).stem == "shot"
    assert only(str(tmp_path / "{angle}" / "shot.png"), layout=Layout()).stem == "shot"


def test_mosaics_do_not_share_memory_with_the_caller() -> None:
    samples = random_codes("float32")
    mosaic, _ = as_mosaic(samples)
    before = mosaic.data.copy()
    samples[:] = 0
    np.testing.assert_array_equal(mosaic.data, before)


def notes_of(array: Array, **levels: Any) -> str:
    return " | ".join(as_mosaic(array, **levels)[1])


@pytest.mark.parametrize("bits", [8, 10, 12, 14])
def test_right_justified_data_are_noted_not_rescaled(bits: int) -> None:
    codes = random_codes("uint16", top=2**bits - 1)
    mosaic, notes = as_mosaic(codes)
    assert mosaic.white_level == 65535
    top = 2**bits - 1
    seen = f"values never exceed {top} of 65535: looks like {bits}-bit right-justified data"
    assert notes == (f"{seen}; say --white-level {top} if so",)
    assert notes_of(codes, white_level=float(top)) == ""


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("bits", [8, 10, 12, 14])
def test_right_justified_data_as_floats_are_noted(bits: int, dtype: str) -> None:
    """Codes over 65535, as some readers give them; other floats are not taken for such codes."""
    top = 2**bits - 1
    codes = random_codes("uint16", top=top).astype(dtype)
    codes[0, 0] = 1
    floats = codes / np.asarray(65535, dtype)
    (note,) = as_mosaic(floats)[1]
    assert isinstance(note, ForgottenLevel) and f"{bits}-bit right-justified data; say --white-level" in note
    said = float(note.split("--white-level ")[1].split()[0])
    assert bool(as_mosaic(floats, white_level=said)[0].clipped()[0, 1]) and notes_of(floats, white_level=said) == ""
    even = np.full_like(floats, 0.2)  # which is 13107/65535
    for other in (floats + np.asarray(3e-6, dtype), codes / top, np.rint(codes % 60) / 255, even.astype(dtype)):
        assert notes_of(other.astype(dtype)) == ""


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_left_justified_data_are_noted_and_clip_at_65535(bits: int) -> None:
    mosaic, notes = as_mosaic(random_codes("uint16", top=2**bits - 1) << (16 - bits))
    assert notes == (
        f"the lowest {16 - bits} bits are always zero: {bits}-bit left-justified data; white level 65535 fits",
    )
    assert bool(mosaic.clipped()[0, 1])


def test_8_bit_left_justified_data_need_their_own_white_level() -> None:
    codes = random_codes("uint16", top=255) << 8
    mosaic, notes = as_mosaic(codes)
    assert "say --white-level 65280" in notes[0]
    assert not bool(mosaic.clipped().any())
    assert bool(as_mosaic(codes, white_level=65280.0)[0].clipped()[0, 1])


def test_dark_left_justified_data_are_not_taken_for_right_justified() -> None:
    assert "left-justified" in notes_of((random_codes("uint16", top=200) << 4).astype(np.uint16))


def test_full_range_data_need_no_note() -> None:
    for dtype in ("uint8", "uint16", "float32", "float64"):
        assert notes_of(random_codes(dtype)) == ""


def test_exposure_notes() -> None:
    dark, bright = np.full((4, 4), 64, np.uint8), np.full((4, 4), 255, np.uint8)
    assert notes_of(dark, black_level=64.0).startswith("black frame: no sample exceeds the black level 64")
    assert notes_of(dark) == ""
    assert notes_of(bright).startswith("every sample is clipped")
    assert notes_of(random_codes("uint8"), white_level=250.0).count("they count as clipped") == 1
    assert "no sample can count as clipped" in notes_of(random_codes("uint8"), white_level=4095.0)
    assert "far above the white level 1" in notes_of(random_codes("float32") * 4095)
    assert "they count as clipped" in notes_of(random_codes("float32") * np.float32(1.5))
    assert notes_of(random_codes("float32") * 4095, white_level=4095.0) == ""
    assert "is white 1? Then leave out --white-level" in notes_of(random_codes("float32"), white_level=4095.0)
    assert "leave out" not in notes_of(0.004 * random_codes("float32"))
    assert "exceed" not in notes_of(np.full((4, 4), 0.1, np.float32), white_level=0.1)  # above it in float64 alone
    assert notes_of(random_codes("float32") * 30, white_level=4095.0) == ""


def test_shapes_that_are_made_to_fit() -> None:
    codes = random_codes("uint8", (13, 17))
    mosaic, notes = as_mosaic(codes)
    assert notes == ("size 17x13 cuts polarizer cells of the layout: cropped to 16x12, whole cells",)
    _, notes = as_mosaic(random_codes("uint8", (14, 17)), "90,45,135,0/GBRG@1,0")
    assert notes == ("size 17x14 cuts polarizer cells of the layout: cropped to 16x12, whole cells",)
    assert_samples(mosaic, codes[:12, :16])
    codes = random_codes("uint8")
    assert_samples(as_mosaic(codes[..., None])[0], codes)
    mosaic, notes = as_mosaic(np.repeat(codes[..., None], 3, axis=2))
    assert notes == ("gray stored as three equal channels: one is used",)
    assert_samples(mosaic, codes)
    assert_samples(as_mosaic(codes[:, ::-1])[0], codes[:, ::-1])
    assert as_mosaic(codes[:2, :2], Layout(bayer=None))[0].data.shape == (2, 2)


def test_measurements_of_colour_images() -> None:
    data, notes = as_measurements(random_codes("float32", (4, 3, 5, 3)))
    assert data.data.shape == (4, 3, 3, 5) and notes == ()


def test_nothing_leaks_to_the_terminal(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    tifffile.imwrite(tmp_path / "run.tiff", random_codes("uint8", (3, 12, 16)), photometric="minisblack")
    data = (tmp_path / "run.tiff").read_bytes()
    (tmp_path / "cut.tiff").write_bytes(data[:400])
    with pytest.raises(ValueError, match=r"cut\.tiff: expected"):
        list(read_frames(tmp_path / "cut.tiff"))
    assert any(isinstance(h, logging.NullHandler) for h in logging.getLogger("tifffile").handlers)
    assert capfd.readouterr() == ("", "")


def test_orientation_is_noted_not_applied(tmp_path: Path) -> None:
    codes = random_codes("uint8")
    tifffile.imwrite(tmp_path / "shot.tiff", codes, extratags=[(274, 3, 1, 6, True)])
    frame = only(tmp_path / "shot.tiff")
    assert_samples(mosaic_of(frame), codes)
    assert frame.notes == ("TIFF orientation 6 is not applied: pixels stay as stored",)


def test_a_raw_format_is_one_reader_and_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader of a new format in `READERS` is all that `read_frames` needs."""

    def read_text(path: Path, first: int) -> Iterator[Page]:
        yield Page(np.loadtxt(path, dtype=np.uint16), white_level=4095)

    monkeypatch.setitem(READERS, ".txt", Reader("text", read_text))
    codes = np.arange(64).reshape(8, 8)
    np.savetxt(tmp_path / "shot.txt", codes, fmt="%d")
    (frame,) = read_frames(tmp_path / "shot.txt", ReadOptions(black_level=8))
    assert (frame.stem, frame.data.white_level, frame.data.black_level) == ("shot", 4095, 8)
    np.testing.assert_array_equal(frame.data.data, codes)


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".tiff", ".raw"])
def test_stacks_are_read_from_any_frame_on(tmp_path: Path, suffix: str) -> None:
    """The frames from ``first`` on are those of a reading from the beginning."""
    codes = np.random.default_rng(0).integers(0, 255, (5, 8, 8)).astype(np.uint8)
    path = tmp_path / f"shots{suffix}"
    if suffix == ".npy":
        np.save(path, codes)
    elif suffix == ".npz":
        np.savez(path, raw=codes)
    elif suffix == ".tiff":
        tifffile.imwrite(path, codes, photometric="minisblack")
    else:
        path.write_bytes(codes.tobytes())
    options = ReadOptions(size=(8, 8), pixel_format="Mono8") if suffix == ".raw" else None
    for first in range(6):
        frames = list(read_frames(path, options, first))
        assert [(frame.index, frame.count) for frame in frames] == [(k, 5) for k in range(first, 5)]
        assert [frame.stem for frame in frames] == [f"shots_{k:04d}" for k in range(first, 5)]
        for frame in frames:
            np.testing.assert_array_equal(frame.data.data, codes[frame.index])
