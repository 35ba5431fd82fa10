"""Every damaged or wrong input is refused in one line that names the file and says what was expected or found."""

from __future__ import annotations

import io
import os
import pickle
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import pytest
import tifffile

import polsep
from polsep.io.raw.frames import ReadOptions, read_frames
from polsep.io.results.separation_reader import read_separated
from polsep.io.store.errors import InputError
from polsep.physics.stokes import Measurements, Stokes
from polsep.sensor.camera import Layout, Mosaic
from polsep.sensor.levels import as_measurements, as_mosaic, interleave_planes
from polsep.separation.images import FrameImages

CODES = np.random.default_rng(0).integers(0, 65536, (48, 64)).astype(np.uint16)


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int = 64, height: int = 48, depth: int = 16, color: int = 0, idat: bytes | None = None) -> bytes:
    """A PNG of chosen header whose checksums hold; ``idat`` None is the stream that belongs to `CODES`."""
    stream = zlib.compress(b"".join(b"\0" + row.astype(">u2").tobytes() for row in CODES)) if idat is None else idat
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + png_chunk(b"IDAT", stream) + png_chunk(b"IEND", b"")


def encode_png(array: Any) -> bytes:
    return bytes(imagecodecs.png_encode(array))


def flipped(data: bytes, at: int) -> bytes:
    """``data`` with one byte inverted."""
    return data[:at] + bytes([data[at] ^ 255]) + data[at + 1 :]


def tiff(array: Any = CODES, **options: Any) -> bytes:
    stream = io.BytesIO()
    tifffile.imwrite(stream, array, **options)
    return stream.getvalue()


def npy(array: Any, allow_pickle: bool = False) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=allow_pickle)
    return stream.getvalue()


def npy_header(text: str, version: int = 1) -> bytes:
    """An NPY header of any content, and 64 bytes of data."""
    body = text.encode() + b"\n"
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack("<H", len(body)) + body + bytes(64)


def npz(**arrays: Any) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def zipped(**members: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return stream.getvalue()


def patched_tiff(tag: int, value: int) -> bytes:
    """The TIFF of `CODES` in uncompressed strips of 16 rows, with the value of one tag overwritten."""
    data = bytearray(tiff(rowsperstrip=16, metadata=None))
    with tifffile.TiffFile(io.BytesIO(bytes(data))) as tif:
        entry = tif.pages.first.tags[tag]
        offset = entry.valueoffset
        struct.pack_into({3: "<H", 4: "<I"}[int(entry.dtype)], data, offset, value)
    return bytes(data)


def sparse_tiff() -> bytes:
    """A TIFF file whose strips are said to lie at its beginning, as those of a hole do."""
    data = tiff(metadata=None)
    with tifffile.TiffFile(io.BytesIO(data)) as tif:
        entry = tif.pages.first.tags[273]
    return data[: entry.valueoffset] + bytes(4) + data[entry.valueoffset + 4 :]


def patched_tiff_count(tag: int, count: int) -> bytes:
    """The same TIFF with the number of values of one tag overwritten, so that strips lose offsets or sizes."""
    data = bytearray(tiff(rowsperstrip=16, metadata=None))
    with tifffile.TiffFile(io.BytesIO(bytes(data))) as tif:
        struct.pack_into("<I", data, tif.pages.first.tags[tag].offset + 4, count)
    return bytes(data)


RAW = {"size": (64, 48), "pixel_format": "Mono12p"}
ANGLES = {"pages": "angles"}
HUGE = 1 << 20
NAN = np.where(np.arange(16).reshape(4, 4) == 6, np.nan, 0.5)
TEXT = b"this is no image\n" * 9
STACK5 = np.zeros((5, 8, 8), np.uint8)

#: Name of the file, its bytes, options, and what the message must contain.
FILES: list[tuple[str, bytes, dict[str, Any], str]] = [
    ("empty.png", b"", {}, "found an empty file"),
    ("empty.tiff", b"", {}, "found an empty file"),
    ("empty.npy", b"", {}, "found an empty file"),
    ("empty.npz", b"", {}, "found an empty file"),
    ("empty.pgm", b"", {}, "found an empty file"),
    ("empty.raw", b"", RAW, "found 0 bytes"),
    ("text.png", TEXT, {}, "expected a PNG file, found text"),
    ("text.tiff", TEXT, {}, "expected a TIFF file, found text"),
    ("text.npy", TEXT, {}, "expected an NPY file, found text"),
    ("text.npz", TEXT, {}, "expected an NPZ file, found text"),
    ("text.pgm", TEXT, {}, "expected a binary PGM (P5) file, found text"),
    ("photo.tiff", b"\xff\xd8\xff\xe0" + TEXT, {}, "found a JPEG file"),
    ("swapped.png", tiff(), {}, "expected a PNG file, found a TIFF file"),
    ("pointer.tiff", b"version https://git-lfs.github.com/spec/v1\n", {}, "found a Git LFS pointer"),
    ("photo.jpg", b"\xff\xd8\xff\xe0" + TEXT, {}, "found JPEG: lossy"),
    ("photo.exr", b"\x76\x2f\x31\x01" + TEXT, {}, "found extension '.exr' and an OpenEXR file"),
    ("photo.bmp", b"BM" + TEXT, {}, "found extension '.bmp' and a BMP file"),
    ("photo.gif", b"GIF89a" + TEXT, {}, "and a GIF file"),
    ("noextension", b"\0\1\2\3", {}, "and unknown bytes 00 01 02 03"),
    # PNG
    ("header.png", png()[:20], {}, "expected a PNG header of 33 bytes, found 20"),
    ("half.png", png()[:3000], {}, "it is truncated"),
    ("noend.png", png()[:-12], {}, "ends with IEND"),
    ("bitrot.png", flipped(png(), 2000), {}, "checksum of PNG chunk b'IDAT'"),
    ("ihdr.png", flipped(png(), 20), {}, "expected an intact PNG header"),
    ("notihdr.png", flipped(png(), 12), {}, "expected an intact PNG header"),
    ("zlib.png", png(idat=b"\x78\x9c" + bytes(99)), {}, "found damage"),
    ("short.png", png(idat=zlib.compress(bytes(64))), {}, "found damage"),
    ("noidat.png", png(idat=b""), {}, "found damage"),
    ("filter.png", png(idat=zlib.compress(b"\x09" * 48 * 129)), {}, "found damage"),
    ("huge.png", png(HUGE, HUGE), {}, "found 1048576x1048576"),
    ("zero.png", png(0, 48), {}, "found 48x0"),
    ("bits.png", png(depth=1), {}, "expected 8 or 16 bits per sample, found 1"),
    ("depth9.png", png(depth=9), {}, "expected 8 or 16 bits per sample, found 9"),
    ("palette.png", png(depth=8, color=3), {}, "found palette"),
    ("rgba.png", encode_png(np.zeros((8, 8, 4), np.uint8)), {}, "found RGB with alpha"),
    ("graya.png", encode_png(np.zeros((8, 8, 2), np.uint8)), {}, "found gray with alpha"),
    ("rgb.png", encode_png(np.arange(192, dtype=np.uint8).reshape(8, 8, 3)), {}, "expected one channel"),
    ("tiny.png", encode_png(np.zeros((2, 2), np.uint8)), {}, "at least 4x4 pixels, found 2x2"),
    # TIFF
    ("magic.tiff", tiff()[:4], {}, "found damage"),
    ("ifd.tiff", tiff()[:40], {}, "expected"),
    ("half.tiff", tiff(metadata=None)[:3000], {}, "it is truncated"),
    ("halfzip.tiff", tiff(compression="zlib")[:3000], {}, "it is truncated"),
    ("chain.tiff", tiff(STACK5, photometric="minisblack")[:700], {}, "chain of TIFF directories"),
    ("oneifd.tiff", tiff(STACK5, photometric="minisblack", truncate=True), {}, "one TIFF directory per picture"),
    ("bitrot.tiff", flipped(tiff(compression="zlib"), 3000), {}, "found damage"),
    ("lzw.tiff", flipped(tiff(compression="lzw"), 3000)[:-1], {}, "expected"),
    ("hugewidth.tiff", patched_tiff(256, 65000), {}, "expected"),
    ("zero.tiff", patched_tiff(257, 0), {}, "found 0x64"),
    ("strips.tiff", patched_tiff(278, 8), {}, "expected 6 TIFF strips or tiles, found 3"),
    ("hole.tiff", sparse_tiff(), {}, "expected 1 TIFF strips or tiles, found 0"),
    ("counts.tiff", patched_tiff_count(279, 2), {}, "expected"),
    ("white0.tiff", tiff(photometric="miniswhite"), {}, "photometric MINISWHITE"),
    ("palette.tiff", tiff(STACK5[0], photometric="palette", colormap=np.zeros((3, 256), np.uint16)), {}, "PALETTE"),
    ("jpeg.tiff", tiff(STACK5[0], compression="jpeg"), {}, "expected lossless samples, found TIFF compression JPEG"),
    ("bilevel.tiff", tiff(STACK5[0] > 0, photometric="minisblack"), {}, "expected samples of 8 bits or more, found 1"),
    ("signed.tiff", tiff(CODES.astype(np.int16)), {}, "found int16"),
    ("uint32.tiff", tiff(CODES.astype(np.uint32)), {}, "found uint32"),
    ("half16.tiff", tiff(CODES[:4].astype(np.float16) / 2), {}, "found float16"),
    ("nan.tiff", tiff(NAN), {}, "found 1 that are not, the first (nan) at (1, 2)"),
    ("rgb.tiff", tiff(np.arange(192, dtype=np.uint8).reshape(8, 8, 3), photometric="rgb"), {}, "demosaicked"),
    (
        "planes.tiff",
        tiff(STACK5[:4], photometric="rgb", planarconfig="separate"),
        {},
        "found one of 4: frames and angles",
    ),
    # NPY and NPZ
    ("half.npy", npy(CODES)[:3000], {}, "bytes of samples"),
    ("longer.npy", npy(CODES) + b"more", {}, "bytes of samples"),
    ("header.npy", npy(CODES)[:30], {}, "found damage"),
    ("garbled.npy", npy_header("{'descr': '<u2', 'shape': (4,"), {}, "found damage"),
    ("version.npy", npy_header("{}", version=9), {}, "expected"),
    ("huge.npy", npy_header("{'descr': '<u2', 'fortran_order': False, 'shape': (1048576, 1048576)}"), {}, "at most"),
    (
        "negative.npy",
        npy_header("{'descr': '<u2', 'fortran_order': False, 'shape': (-8, 8)}"),
        {},
        "at least one pixel",
    ),
    ("pickle.npy", pickle.dumps([1, 2]), {}, "expected an NPY file, found unknown bytes"),
    ("objects.npy", npy(np.array([[None, 1]]), allow_pickle=True), {}, "found Python objects, which need a pickle"),
    ("fields.npy", npy(np.zeros((8, 8), [("a", "u1"), ("b", "u1")])), {}, "expected samples of uint8"),
    ("line.npy", npy(np.zeros(8, np.uint8)), {}, "expected an array [H, W], found shape (8,)"),
    ("none.npy", npy(np.zeros((0, 8), np.uint8)), {}, "at least one pixel, found 0x8"),
    ("noframes.npy", npy(np.zeros((0, 8, 8), np.uint8)), {}, "expected at least one frame"),
    ("five.npy", npy(np.zeros((2, 2, 2, 8, 8), np.uint8)), {}, "expected a mosaic [H, W]"),
    ("bool.npy", npy(CODES > 9), {}, "found bool"),
    ("int64.npy", npy(CODES.astype(np.int64)), {}, "found int64"),
    ("complex.npy", npy(CODES.astype(np.complex64)), {}, "found complex64"),
    ("inf.npy", npy(np.full((4, 4), np.inf)), {}, "found 16 that are not"),
    ("half.npz", npz(a=CODES)[:3000], {}, "found damage"),
    ("bitrot.npz", flipped(npz(a=CODES), 3000), {}, "found damage"),
    ("none.npz", npz(), {}, "found arrays: none"),
    ("two.npz", npz(a=CODES, b=CODES), {}, "found arrays: a, b"),
    ("three.npz", npz(i0=CODES, i45=CODES, i90=CODES), {}, "found arrays: i0, i45, i90"),
    ("sizes.npz", npz(i0=CODES, i45=CODES, i90=CODES, i135=CODES[2:]), {}, "expected angle images of one size"),
    ("objects.npz", npz(raw=np.array([[None, 1]])), {}, "found Python objects"),
    ("member.npz", zipped(raw=TEXT), {}, "expected an NPY array in raw.npy, found text"),
    ("short.npz", zipped(raw=npy(CODES)[:3000]), {}, "bytes of samples"),
    # PGM
    ("ascii.pgm", b"P2 4 4 255\n0 0 0 0\n", {}, "expected a binary PGM (P5) file, found text"),
    ("header.pgm", b"P5 4 four 255\n" + bytes(16), {}, "expected a PGM header"),
    ("half.pgm", b"P5 4 4 255\n" + bytes(9), {}, "expected 16 bytes for 4x4 of maxval 255, found 9"),
    ("huge.pgm", b"P5 999999999 999999999 255\n", {}, "expected at most"),
    ("maxval.pgm", b"P5 4 4 70000\n" + bytes(32), {}, "found 70000"),
    # headerless raw
    ("nothing.raw", bytes(4608), {}, "expected the size and pixel format of headerless raw"),
    ("nosize.raw", bytes(4608), {"pixel_format": "Mono12p"}, "found only the pixel format"),
    ("noformat.bin", bytes(4608), {"size": (64, 48)}, "found only the size"),
    ("half.raw", bytes(4607), RAW, "frames of 4608 bytes (64x48 Mono12p), found 4607 bytes"),
    (
        "lucid.raw",
        bytes(4608),
        {"size": (64, 48), "pixel_format": "PolarizedAngles_0d_45d_90d_135d_Mono8"},
        "ONE angle",
    ),
    ("format.raw", bytes(4608), {"size": (64, 48), "pixel_format": "Mono12pp"}, "Mono12p"),
    ("huge.raw", bytes(4608), {"size": (HUGE, HUGE), "pixel_format": "Mono8"}, "expected at most"),
    # angles and levels
    ("five.tiff", tiff(STACK5, photometric="minisblack"), ANGLES, "expected four pages for the angles"),
    ("one.png", png(), ANGLES, "found 1"),
    (
        "angles.npy",
        npy(STACK5[:4]),
        ANGLES | {"layout": Layout(((0, 30), (60, 90)))},
        "expected a layout of the angles",
    ),
    ("black.png", png(), {"black_level": 70000.0}, "expected a white level above the black level"),
    ("white.png", png(), {"white_level": float("nan")}, "expected finite black and white levels"),
]


def assert_refused(path: Path | str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as caught:
        list(read_frames(path, ReadOptions(**options)))
    text = str(caught.value)
    assert text.count("\n") == 0 and text.startswith(f"{path}: ") and text.count(f"{path}: ") == 1, text
    assert "expected" in text and "found" in text, text
    assert message in text, text


@pytest.mark.parametrize(("name", "data", "options", "message"), FILES, ids=[case[0] for case in FILES])
def test_bad_files(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str, data: bytes, options: dict[str, Any], message: str
) -> None:
    (tmp_path / name).write_bytes(data)
    assert_refused(tmp_path / name, options, message)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".npy", ".npz", ".pgm", ".raw", ".bmp"])
def test_missing_files_and_directories(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"shot{suffix}"
    assert_refused(path, RAW if suffix == ".raw" else {}, "found nothing at this path")
    path.mkdir()
    assert_refused(path, {}, "expected a file, found a directory")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
@pytest.mark.parametrize("suffix", [".png", ".tiff", ".npy", ".npz", ".raw", ".exr"])
def test_pipes_are_refused_at_once(tmp_path: Path, suffix: str) -> None:
    """No reader waits for whoever might write into a named pipe."""
    pipe = tmp_path / f"pipe{suffix}"
    os.mkfifo(pipe)
    with pytest.raises(InputError, match="expected a file, found a pipe"):
        list(read_frames(pipe)) if suffix != ".exr" else read_separated(pipe)


def test_unreadable_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise PermissionError(13, os.strerror(13))

    (tmp_path / "shot.png").write_bytes(png())
    monkeypatch.setattr(Path, "open", refuse)
    assert_refused(tmp_path / "shot.png", {}, "found: Permission denied")


def write_angles(folder: Path, images: list[Any]) -> str:
    for angle, image in zip((0, 45, 90, 135), images, strict=False):
        (folder / f"nir_{angle}.png").write_bytes(encode_png(image))
    return str(folder / "nir_{angle}.png")


@pytest.mark.parametrize(
    ("images", "named", "message"),
    [
        ([CODES] * 3, "nir_135.png", "found nothing at this path"),
        ([CODES, CODES, CODES, CODES[1:]], "nir_{angle}.png", "135 deg 47x64 uint16"),
        ([CODES, CODES, CODES, CODES.astype(np.uint8)], "nir_{angle}.png", "135 deg 48x64 uint8"),
        ([CODES, np.zeros((8, 8, 4), np.uint8)], "nir_45.png", "found RGB with alpha"),
    ],
)
def test_bad_templates(tmp_path: Path, images: list[Any], named: str, message: str) -> None:
    template = write_angles(tmp_path, images)
    with pytest.raises(InputError) as caught:
        list(read_frames(template))
    text = str(caught.value)
    assert text.startswith(f"{tmp_path / named}: expected ") and "\n" not in text, text
    assert message in text and "found" in text, text


def test_templates_refuse_files_of_several_pages(tmp_path: Path) -> None:
    for angle in (0, 45, 90, 135):
        (tmp_path / f"run_{angle}.npy").write_bytes(npy(STACK5))
    with pytest.raises(InputError, match=r"run_0\.npy: expected one image of one angle, found 5$"):
        list(read_frames(tmp_path / "run_{angle}.npy"))


@pytest.mark.parametrize("cut", range(1, 12))
@pytest.mark.parametrize("kind", ["png", "tiff", "npy", "npz", "pgm"])
def test_no_truncation_passes(tmp_path: Path, kind: str, cut: int) -> None:
    data = {
        "png": png(),
        "tiff": tiff(compression="zlib", rowsperstrip=8),
        "npy": npy(CODES),
        "npz": npz(a=CODES),
        "pgm": b"P5 64 48 65535\n" + CODES.tobytes(),
    }[kind]
    path = tmp_path / f"cut.{kind}"
    path.write_bytes(data[: len(data) * cut // 12])
    assert_refused(path, {}, "expected")
    path.write_bytes(data[:-cut])
    assert_refused(path, {}, "expected")


ARRAYS: list[tuple[str, Callable[[], object], str]] = [
    ("list", lambda: as_mosaic([[1.0] * 4] * 4), "expected a NumPy array, found list"),  # type: ignore[arg-type]
    ("bool", lambda: as_mosaic(np.ones((8, 8), bool)), "found bool"),
    ("int16", lambda: as_mosaic(np.ones((8, 8), np.int16)), "found int16"),
    ("complex", lambda: as_mosaic(np.ones((8, 8), complex)), "found complex128"),
    ("object", lambda: as_mosaic(np.ones((8, 8), object)), "found object"),
    ("text", lambda: as_mosaic(np.array([["a", "b"]])), "found <U1"),
    ("number", lambda: as_mosaic(np.array(3.0)), "found shape a single number"),
    ("line", lambda: as_mosaic(np.ones(8)), "found shape 8"),
    ("empty", lambda: as_mosaic(np.ones((0, 8))), "found shape 0x8"),
    ("frames", lambda: as_mosaic(np.ones((5, 8, 8))), "found shape 5x8x8"),
    ("rgb", lambda: as_mosaic(np.arange(192.0).reshape(8, 8, 3)), "demosaicked picture is not a raw mosaic"),
    ("rgba", lambda: as_mosaic(np.ones((8, 8, 4))), "expected one channel, found 4"),
    ("nan", lambda: as_mosaic(NAN), "found 1 that are not, the first (nan) at (1, 2)"),
    ("beyond float32", lambda: as_mosaic(np.full((4, 4), 1e39)), "found 16 that are not"),
    ("small colour", lambda: as_mosaic(np.ones((4, 3))), "at least 4x4 pixels, found 3x4"),
    ("small mono", lambda: as_mosaic(np.ones((1, 8)), Layout(bayer=None)), "at least 2x2 pixels"),
    ("levels", lambda: as_mosaic(np.ones((4, 4)), None, 1.0), "expected a white level above"),
    ("levels reversed", lambda: as_mosaic(np.ones((4, 4)), None, 9.0, 3.0), "found white 3, black 9"),
    ("below codes", lambda: as_mosaic(CODES, None, -5), "a black level from 0 on in samples of uint16, found -5"),
    ("text", lambda: as_mosaic(np.ones((4, 4)), None, 0.0, "4095"), "expected a white level that is a number"),  # type: ignore[arg-type]
    ("truth", lambda: as_mosaic(CODES, None, 0.0, True), "expected a white level that is a number, found True"),
    ("nothing", lambda: as_mosaic(np.ones((4, 4)), None, None), "expected a black level that is a number"),  # type: ignore[arg-type]
    ("infinite", lambda: as_mosaic(np.ones((4, 4)), None, 0.0, np.inf), "expected finite black and white levels"),
    ("three angles", lambda: as_measurements(np.ones((3, 4, 4))), "expected four gray or RGB images"),
    ("four channels", lambda: as_measurements(np.ones((4, 4, 4, 4))), "expected four gray or RGB images"),
    ("five planes", lambda: interleave_planes(np.ones((5, 4, 4)), Layout()), "expected four planes"),
    ("pages", lambda: ReadOptions(pages="both"), 'expected pages "auto", "frames" or "angles", found'),
    ("options", lambda: next(read_frames("shot.png", 4095)), "expected ReadOptions, found int"),  # type: ignore[arg-type]
    ("no results", lambda: read_separated("missing"), "missing: expected a file, found nothing at this path"),
    ("folder", lambda: read_separated("."), "expected a separated frame (.exr, .npz), found a directory"),
    ("size", lambda: ReadOptions(size=(0, 4)), "expected a size of positive width and height, found (0, 4)"),
    ("white", lambda: calibration(white_level=np.nan), "a white level well above the black level, found white nan"),
    ("white 0", lambda: calibration(white_level=0), "a white level well above the black level, found white 0"),
    ("black", lambda: calibration(black_level=4095), "well above the black level, found white 4095, black 4095"),
    ("below", lambda: calibration(black_level=-5000), "expected black level within 4095, found -5000"),
    ("noise", lambda: calibration(read_noise=-1), "expected read noise from 0 to 4095, found -1"),
    ("no size", lambda: calibration(size=(0, 8)), "expected a size of positive height and width, found (0, 8)"),
    ("map", lambda: calibration(size=(8, 9), black_map=SOME), "a black_map of the size (8, 9), found (8, 8)"),
    ("dark map", lambda: calibration(size=(8, 8), gain_map=0 * SOME), "gains of pixels from 0.001 to 1000, found 0"),
    ("nan map", lambda: calibration(size=(8, 8), black_map=np.nan * SOME), "black map within 4095, found nan"),
    ("gains", lambda: calibration(gains=-np.ones((4, 4))), "expected gains from 0.001 to 1000, found -1"),
    ("places", lambda: calibration(gains=((1.0,) * 2,) * 2), "expected gains of 4x4 places, found [2, 2]"),
    ("falloff", lambda: calibration(falloff=((0.4, 0.6),)), "expected a falloff from 0.001 to 1000, found"),
    ("pixels", lambda: calibration(size=(8, 8), dead=np.array([64])), "pixels as indices below 64"),
    ("one angle", lambda: calibration(analysers=[[(45, 99, 1)] * 4] * 4), "20 degrees of the layout's 90, found 45"),
    ("no angle", lambda: calibration(analysers=[[(np.nan, 99, 1)] * 4] * 4), "of the layout's 90, found nan"),
    ("extinction", lambda: calibration(analysers=[[(90, 0.5, 1)] * 4] * 4), "ratios above 1, found 0.5"),
    ("lamp", lambda: calibration(lamp=((0, 1, 1), None, None)), "a lamp's colour from 0.001 to 1000, found 0"),
]


def calibration(**fields: Any) -> polsep.Calibration:
    return polsep.Calibration(**{"layout": Layout(), "white_level": 4095, **fields})


SOME = np.ones((8, 8), np.float32)
TYPES: list[tuple[str, Callable[[], object], str]] = [
    ("a size of one", lambda: ReadOptions(size=64), "a size of width and height in whole pixels, found 64"),  # type: ignore[arg-type]
    ("a size as text", lambda: ReadOptions(size="64x48"), "whole pixels, found '64x48'"),  # type: ignore[arg-type]
    ("a layout", lambda: ReadOptions(layout=3), "expected layout as a Layout, text or None, found 3"),  # type: ignore[arg-type]
    ("a level", lambda: ReadOptions(white_level="4095"), "expected white_level as a number or None, found '4095'"),  # type: ignore[arg-type]
    ("a file", lambda: ReadOptions(corrections="rig.json"), "expected corrections as Corrections or None"),  # type: ignore[arg-type]
    (
        "images",
        lambda: FrameImages.empty((8, 8), "color"),
        "expected a Layout (Layout.parse reads text), found 'color'",
    ),  # type: ignore[arg-type]
    ("a shape", lambda: FrameImages.empty(8, Layout()), "expected the shape (H, W) of mosaics, found 8"),  # type: ignore[arg-type]
    ("bool", lambda: Mosaic(SOME > 0, Layout(), 0, 1), "expected samples of whole numbers or floats, found bool"),
    ("complex", lambda: Mosaic(SOME + 1j, Layout(), 0, 1), "found complex"),
    ("list", lambda: Mosaic([[1.0]], Layout(), 0, 1), "a NumPy array or a torch tensor, found list"),
    ("a light", lambda: Mosaic(SOME, Layout(), 0, 1, light_color="red"), "expected a light_color of positive numbers"),  # type: ignore[arg-type]
    ("frames", lambda: next(polsep.read_frames(3)), "expected the path of a file, found 3"),  # type: ignore[arg-type]
    ("results", lambda: polsep.read_separated(None), "expected the path of a file, found None"),  # type: ignore[arg-type]
    ("rig", lambda: polsep.read_calibration(3), "expected the path of a file, found 3"),  # type: ignore[arg-type]
    ("output", lambda: polsep.Result.save(None, None), "expected the path of a file, found None"),  # type: ignore[arg-type]
    ("lists", lambda: Measurements([[1.0]], (0.0,)), "expected measurements as a NumPy array or a torch tensor"),
    (
        "codes",
        lambda: Measurements(np.ones((4, 1, 8, 8), int), Layout().angles),
        "measurements in floating point, white at 1, found int",
    ),
    ("angles", lambda: Measurements(SOME[None, None], "0"), "expected analyser angles in radians, found '0'"),  # type: ignore[arg-type]
    ("stokes", lambda: Stokes(SOME, SOME, [[1.0]]), "expected Stokes images as a NumPy array or a torch tensor"),
    ("bits", lambda: Stokes(SOME > 0, SOME, SOME), "expected Stokes images in floating point, found bool"),
    ("planes", lambda: polsep.separate(np.ones((4, 8, 8)), layout=3), 'expected a Layout, "color", "mono", a'),  # type: ignore[arg-type]
    ("angle", lambda: Measurements(SOME[None, None], 0.5), "expected analyser angles in radians, found 0.5"),  # type: ignore[arg-type]
    ("a 2D colour", lambda: polsep.separate(SOME, light_color=np.ones((3, 3))), "colour of three positive numbers"),
    ("one sample", lambda: polsep.separate(SOME, ambient=np.array(3)), "expected a NumPy array, found int64"),
    ("a format", lambda: polsep.Result.save(None, "a.exr", "npz"), "expected overwrite as True or False, found 'npz'"),  # type: ignore[arg-type]
    ("half a row", lambda: Layout().rolled(1.5, 0), "expected rows or columns as a whole number, found 1.5"),  # type: ignore[arg-type]
    ("a width", lambda: Layout().flipped_horizontal("9"), "expected a width as a whole number, found '9'"),  # type: ignore[arg-type]
    ("a height", lambda: Layout().flipped_vertical(None), "expected a height as a whole number, found None"),  # type: ignore[arg-type]
    ("a pixel", lambda: Layout().filter_at(0, 0.5), "expected a row or column as a whole number, found 0.5"),  # type: ignore[arg-type]
    ("a rig", lambda: calibration(layout="color"), "expected a Layout (Layout.parse reads text), found 'color'"),
    ("no white", lambda: calibration(white_level=None), "expected white_level as a number, found None"),
    ("a text", lambda: calibration(black_level="64"), "expected black_level as a number, found '64'"),
    ("a side", lambda: calibration(size=8), "expected size as rows and columns, found 8"),
    ("a gain", lambda: calibration(gains=1.0), "expected gains as rows of numbers, found 1.0"),
    ("a map", lambda: calibration(gain_map=[[1.0]]), "expected gain_map as an array of numbers, found [[1.0]]"),
    ("complex map", lambda: calibration(black_map=1j * SOME), "expected black_map as an array of numbers, found"),
    ("a pixel", lambda: calibration(dead=np.array([1.5])), "expected dead as an array of indices, found"),
    ("analysers", lambda: calibration(analysers=SOME[:4, :4]), "rows of an angle, an extinction ratio and a gain"),
    ("a lamp", lambda: calibration(lamp=(1, 1, 1)), "a colour of three numbers, a degree and an angle of polariz"),
]


@pytest.mark.parametrize(("name", "call", "message"), TYPES, ids=[case[0] for case in TYPES])
def test_wrong_types(name: str, call: Callable[[], object], message: str) -> None:
    with pytest.raises(TypeError, match="expected") as caught:
        call()
    text = str(caught.value)
    assert isinstance(caught.value, ValueError) and "\n" not in text and "found" in text and message in text, text


def test_gains_and_levels_of_a_mosaic() -> None:
    for gains in ((1.0, 1.0), (0.0, 1.0, 1.0), (1.0, np.nan, 1.0)):
        with pytest.raises(ValueError, match="expected a light_color of three positive numbers"):
            Mosaic(SOME, Layout(), 0, 1, light_color=gains)
    with pytest.raises(ValueError, match="expected a white level above the black level, found inf and 0"):
        Mosaic(SOME, Layout(), 0, np.inf)


def test_layout_of_read_options_as_text() -> None:
    assert ReadOptions(layout="mono").settings()["layout"] == "90,45,135,0/mono"  # type: ignore[arg-type]


@pytest.mark.parametrize(("name", "call", "message"), ARRAYS, ids=[case[0] for case in ARRAYS])
def test_bad_arrays(name: str, call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match="expected") as caught:
        call()
    text = str(caught.value)
    assert "\n" not in text and "found" in text and message in text, text
