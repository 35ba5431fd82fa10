"""The readers of polsep with small whole files of each, and checksums made anew after damage.

A seed is a folder's files by name, of which the first is read. Where checksums guard a format, half of the damaged
files get right ones, so that what is behind them is reached: `Reader.mend`.
"""

from __future__ import annotations

import hashlib
import io
import json
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import av
import imagecodecs
import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image

from polsep.edit.files import read_recipe
from polsep.edit.recipe import recipe_as_data
from polsep.io.assets.maps import read_map
from polsep.io.raw.frames import ReadOptions, read_frames
from polsep.io.raw.genicam import pack_frame
from polsep.io.raw.recording import Header, RawImage, RecordingWriter
from polsep.io.raw.tiff import write_merged
from polsep.io.results.exr import encode_exr
from polsep.io.results.separation_reader import read_separated
from polsep.io.store.calibrations import read_calibration, write_calibration
from polsep.io.store.weights import digest_arrays, read_weights, write_weights
from polsep.pipeline import separate_capture
from polsep.sensor.calibration import Analyser, Calibration, LampFacts
from polsep.sensor.camera import Layout
from polsep.sensor.corrections import Corrections
from polsep.sensor.levels import as_mosaic

Files = dict[str, bytes]
Seeds = list[Files]
Array = NDArray[Any]

HEIGHT, WIDTH = 24, 32
#: Options of headerless files.
RAW = {".12p": ReadOptions(size=(WIDTH, HEIGHT), pixel_format="Mono12p")}
RAW |= {".packed": ReadOptions(size=(WIDTH, HEIGHT), pixel_format="BayerRG12Packed")}
RAW |= {".angles": ReadOptions(size=(WIDTH // 2, HEIGHT // 2), pixel_format="PolarizedAngles_0d_45d_90d_135d_Mono12p")}


@dataclass(frozen=True)
class Reader:
    """A reader of files: ``seeds`` makes whole ones, ``read`` yields all numbers that it takes from one.

    ``mend``: a damaged file with right checksums.
    """

    seeds: Callable[[], Seeds]
    read: Callable[[Path], Iterator[Array]]
    mend: Callable[[Files], Files] = lambda files: files


def codes(dtype: str = "uint16", top: int = 4095) -> Array:
    """Smooth codes with noise ``[HEIGHT, WIDTH]``."""
    draw = np.random.default_rng(1)
    ramp = np.linspace(0.1, 0.8, WIDTH) + 0.1 * draw.random((HEIGHT, WIDTH))
    return (top * ramp).astype(dtype)


# What is read.


def read_raw(path: Path) -> Iterator[Array]:
    """Every frame of a file, and what the formula makes of the first, whose report must be strict JSON."""
    options = RAW.get(path.suffixes[0] if len(path.suffixes) > 1 else "")
    for number, frame in enumerate(read_frames(path, options)):
        data = frame.data
        yield np.asarray(data.data)
        if number == 0 and data.data.shape[-1] <= 4 * WIDTH and data.data.shape[-2] <= 4 * HEIGHT:
            made = separate_capture(data, "analytic")
            json.dumps(made.report, allow_nan=False)
            yield from (made.diffuse, made.specular, made.dolp, made.aolp)


def read_frame_files(path: Path) -> Iterator[Array]:
    """A separated frame."""
    frame = read_separated(path)
    yield from (frame.diffuse, frame.specular, frame.dolp, frame.aolp)


def read_images(path: Path) -> Iterator[Array]:
    """An image that an edit names."""
    yield read_map(path, "normals" if path.stem == "normals" else "mask" if path.stem == "mask" else "texture")


def read_networks(path: Path) -> Iterator[Array]:
    """Weights, in which any number may stand."""
    arrays, _ = read_weights(path)
    yield from (np.zeros(array.shape[:1]) for array in arrays.values())


def read_calibrations(path: Path) -> Iterator[Array]:
    """A calibration, and a frame corrected and separated with it."""
    found = read_calibration(path)
    mosaic = as_mosaic(codes(), found.layout, 0.0, found.white_level_of(codes()))[0]
    if found.size in (None, (HEIGHT, WIDTH)):
        corrected = Corrections(found).apply(mosaic)
        made = separate_capture(corrected, "analytic")
        json.dumps(made.report, allow_nan=False)
        yield from (np.asarray(corrected.data), made.diffuse, made.specular)


def read_recipes(path: Path) -> Iterator[Array]:
    """A recipe of edits, which can be written again."""
    json.dumps(recipe_as_data(read_recipe(path)), allow_nan=False)
    yield np.zeros(1)


# Whole files.


def _written(name: str, write: Callable[[Path], object]) -> Files:
    """All files that ``write`` makes in a folder, the named one first."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / name)
        found = {path.name: path.read_bytes() for path in sorted(Path(folder).iterdir())}
    return {name: found.pop(name), **found}


def _tiff(array: Array, **options: Any) -> bytes:
    stream = io.BytesIO()
    tifffile.imwrite(stream, array, **options)
    return stream.getvalue()


def _npy(array: Array) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def _npz(compress: bool = False, **arrays: Array) -> bytes:
    stream = io.BytesIO()
    save: Any = np.savez_compressed if compress else np.savez
    save(stream, **arrays)
    return stream.getvalue()


def _stack(count: int = 3) -> Array:
    return np.stack([codes() + k for k in range(count)]).astype(np.uint16)


def _floats(channels: int = 0) -> Array:
    image = codes("float32", 1)
    return image if not channels else np.repeat(image[..., None], channels, 2)


def png_seeds() -> Seeds:
    """Eight and sixteen bits, gray and RGB."""
    rgb = np.repeat(codes("uint8", 255)[..., None], 3, 2)
    arrays = (codes(), codes("uint8", 255), rgb)
    return [{"shot.png": bytes(imagecodecs.png_encode(array))} for array in arrays]


def tiff_seeds() -> Seeds:
    """Compressions, packed bits, tiles, several pages, BigTIFF, both byte orders, floats, merged frames."""
    made = [_tiff(codes()), _tiff(codes(), byteorder=">", bigtiff=True, rowsperstrip=4, metadata=None)]
    made += [_tiff(codes(), compression=name) for name in ("zlib", "lzw", "packbits", "lzma", "zstd", "png")]
    made += [_tiff(codes(), compression="zlib", predictor=True, tile=(16, 16)), _tiff(codes("float32", 1))]
    made += [_tiff(codes(), compression=name) for name in ("jpeg2000", "lerc")]
    made += [_tiff(_stack(), photometric="minisblack"), _tiff(codes("uint8", 255), rowsperstrip=5)]
    made += [_tiff(np.stack([codes()] * 3), photometric="rgb", planarconfig="separate")]
    made += [_packed_tiff()]
    mosaic = as_mosaic(_floats())[0]
    return [{"shot.tiff": data} for data in made] + [_written("m.tiff", lambda path: write_merged(path, mosaic, {}))]


def _packed_tiff() -> bytes:
    """Twelve bits per sample, two samples in three bytes, which tifffile reads but does not write."""
    pairs = codes().reshape(-1, 2).astype(np.uint32)
    words = pairs[:, 0] << 12 | pairs[:, 1]
    packed = np.stack([words >> 16, words >> 8 & 255, words & 255], 1).astype(np.uint8).tobytes()
    tags = [(256, 3, WIDTH), (257, 3, HEIGHT), (258, 3, 12), (259, 3, 1), (262, 3, 1), (273, 4, 8 + 2 + 9 * 12 + 4)]
    tags += [(277, 3, 1), (278, 3, HEIGHT), (279, 4, len(packed))]
    entries = b"".join(struct.pack("<HHII", code, kind, 1, value) for code, kind, value in tags)
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4) + packed


def npy_seeds() -> Seeds:
    """One and several frames, floats, other byte order."""
    return [{"shot.npy": _npy(array)} for array in (codes(), _stack(), _floats(), codes(">f8", 1), _floats(1))]


def npz_seeds() -> Seeds:
    """One array, several frames, four angles; stored and deflated."""
    angles = {f"i{angle}": codes() for angle in (0, 45, 90, 135)}
    made = [_npz(raw=codes()), _npz(True, raw=_stack()), _npz(True, **angles), _npz(mosaic=_floats())]
    return [{"shot.npz": data} for data in made]


def pgm_seeds() -> Seeds:
    """Eight and sixteen bits, with a comment."""
    wide = f"P5\n# a camera\n{WIDTH} {HEIGHT}\n4095\n".encode() + codes(">u2").tobytes()
    return [{"shot.pgm": wide}, {"shot.pgm": f"P5 {WIDTH} {HEIGHT} 255\n".encode() + codes("uint8", 255).tobytes()}]


def raw_seeds() -> Seeds:
    """Packed formats without a header."""
    made = []
    for suffix, options in RAW.items():
        assert options.size is not None and options.pixel_format is not None
        width, height = options.size
        planes = np.stack([codes()[:height, :width]] * 4) if suffix == ".angles" else codes()
        made.append({f"shot{suffix}.raw": pack_frame(planes, options.pixel_format)})
    return made


def video_seeds() -> Seeds:
    """Lossless grey films of every container."""
    made = []
    for suffix, codec, pixels in (
        (".mkv", "ffv1", "gray12le"),
        (".mkv", "ffv1", "gray"),
        (".avi", "ffv1", "gray16le"),
        (".avi", "rawvideo", "gray"),
        (".mov", "png", "gray16be"),
        (".mov", "png", "gray"),
        (".nut", "rawvideo", "gray16le"),
        (".nut", "ffv1", "gray"),
    ):
        made.append(_written(f"shot{suffix}", partial(_write_film, codec=codec, pixels=pixels)))
    return made


def _write_film(path: Path, codec: str, pixels: str) -> None:
    wide = pixels != "gray"
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(codec, rate=25)
        stream.height, stream.width, stream.pix_fmt = HEIGHT, WIDTH, pixels
        stream.options = {"level": "3", "slicecrc": "1", "g": "2"} if codec == "ffv1" else {}
        for k in range(4):
            image = (codes() + k).astype(np.uint16) if wide else codes("uint8", 255)
            given = pixels if pixels != "gray16be" else "gray16le"
            frame = av.VideoFrame.from_ndarray(image, format=given)
            container.mux(stream.encode(frame if given == pixels else frame.reformat(format=pixels)))
        container.mux(stream.encode())


def recording_seeds() -> Seeds:
    """A recording of three frames that ended, and one that was stopped, whose three files are damaged by turns."""

    def write(path: Path) -> None:
        settings = {"exposure_us": 1000.0, "gain_db": 0.0}
        header = Header(WIDTH, HEIGHT, "BayerRG12p", "camera 7", settings, Layout().spec)
        writer = RecordingWriter(path.parent, header)
        for k, frame in enumerate(_stack()):
            writer.append(RawImage(pack_frame(frame, "BayerRG12p"), k + 5, 40_000_000 * k))
        writer.note({"counters": {"received": 3, "lost": 0}, "interruptions": []}, finished=True)
        writer.close()

    files = _written("recording.json", write)
    stopped = files["recording.json"].replace(b'"finished": true', b'"finished": false')
    return [files, {**files, "recording.json": stopped}]


def exr_seeds() -> Seeds:
    """Separated frames in every compression that polsep writes."""
    names = [f"{layer}.{color}" for layer in ("diffuse", "specular") for color in "RGB"]
    made = []
    for compression, dtype in (("none", np.float16), ("zip", np.float32), ("piz", np.float16)):
        planes = {name: _floats().astype(dtype) for name in (*names, "dolp.Y", "aolp.Y", "valid.Y")}
        made.append({"shot.exr": bytes(encode_exr(planes, {"polsepVersion": "0.1"}, compression))})
    return made


def result_seeds() -> Seeds:
    """Separated frames as NPZ."""
    maps = {name: _floats() for name in ("dolp", "aolp", "valid")}
    return [{"shot.npz": _npz(True, diffuse=_floats(3), specular=_floats(3), **maps)}]


def map_seeds() -> Seeds:
    """Textures, masks and normals that edits name."""
    stream = io.BytesIO()
    Image.fromarray(np.repeat(codes("uint8", 255)[..., None], 3, 2)).save(stream, "JPEG")
    planes = {name: _floats() for name in "RGB"}
    made = [{"texture.jpg": stream.getvalue()}, {"texture.exr": bytes(encode_exr(planes, {}, "zip"))}]
    made += [{"normals.npy": _npy(_floats(3))}, {"mask.png": bytes(imagecodecs.png_encode(codes("uint8", 255)))}]
    return [*made, {"mask.tiff": _tiff(codes(), compression="zlib")}]


def weight_seeds() -> Seeds:
    """Weights of a network of two layers."""
    arrays = {"in.weight": _floats(), "in.bias": _floats()[0], "out.weight": _floats(3)}
    return [_written("net.safetensors", lambda path: write_weights(path, arrays, {"method": "joint", "width": "8"}))]


def calibration_seeds() -> Seeds:
    """A whole calibration with maps, and one of few sections."""
    ones = tuple((1.0,) * 4 for _ in range(4))
    table = tuple(tuple(Analyser(Layout().filter_at(r, c).angle_deg, 300.0, 1.0) for c in range(4)) for r in range(4))
    lamp = LampFacts((0.8, 1.0, 1.2), 0.98, 30.0)
    black = np.full((HEIGHT, WIDTH), 60, np.float32)
    whole = Calibration(
        Layout(),
        4095.0,
        (HEIGHT, WIDTH),
        black_level=60.0,
        black_pattern=ones,
        black_map=black,
        read_noise=2.5,
        gains=ones,
        gain_map=np.ones_like(black),
        falloff=((0.9, 0.01), (0.01, -0.05)),
        hot=np.array([5, 70], np.int32),
        analysers=table,
        lamp=lamp,
        details={"dark": {"frames": 16}},
    )
    few = Calibration(Layout(), 4095.0, black_level=60.0, black_pattern=ones, read_noise=2.5)
    return [_written("cal.json", partial(write_calibration, calibration=c, version="0.1")) for c in (whole, few)]


def recipe_seeds() -> Seeds:
    """A recipe of several edits."""
    edits = [
        {"edit": "rougher", "sigma": 10.0},
        {"edit": "metallic", "gain": 45.0},
        {"edit": "texture", "image": "a.png"},
    ]
    edits += [{"edit": "specular-gain", "gain": 2.0}]
    return [{"recipe.json": json.dumps({"polsep_recipe": 1, "edits": edits[:n]}, indent=1).encode()} for n in (2, 4)]


# Checksums.


def mend_png(files: Files) -> Files:
    """Right checksums of all chunks, and of the samples."""
    ((name, data),) = files.items()
    made, place = [data[:8]], 8
    while place + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, place)
        if place + 12 + length > len(data):
            break
        body = data[place + 4 : place + 8 + length]
        if body[:4] == b"IDAT":
            with suppress(zlib.error):
                body = b"IDAT" + zlib.compress(zlib.decompressobj(-15).decompress(body[6:], 1 << 20))
        made += [struct.pack(">I", len(body) - 4), body, struct.pack(">I", zlib.crc32(body))]
        place += 12 + length
    return {name: b"".join(made) + data[place:]}


def mend_zip(files: Files) -> Files:
    """The members of an archive under new checksums, their bytes as they are after damage."""
    ((name, data),) = files.items()
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
        for start in _all(data, b"PK\x03\x04"):
            if start + 30 > len(data):
                continue
            method, length, extra = (
                struct.unpack_from("<H", data, start + 8)[0],
                *struct.unpack_from("<HH", data, start + 26),
            )
            body = data[start + 30 + length + extra :]
            with suppress(zlib.error):
                body = zlib.decompressobj(-15).decompress(body, 1 << 20) if method == 8 else body.partition(b"PK")[0]
            title = data[start + 30 : start + 30 + length].decode("latin-1").partition("\0")[0]
            if title and title not in archive.namelist():
                archive.writestr(title, body[: 1 << 20])
    return {name: made.getvalue()}


def _all(data: bytes, mark: bytes) -> Iterator[int]:
    place = data.find(mark)
    while place >= 0:
        yield place
        place = data.find(mark, place + 1)


def mend_weights(files: Files) -> Files:
    """The length of the header, and the sha256 where the arrays can be read."""
    ((name, data),) = files.items()
    with suppress(Exception):
        header, end = json.JSONDecoder().raw_decode(data[8:].decode("latin-1"))
        arrays, body = {}, data[8 + end :].lstrip(b" ")
        for key, entry in header.items():
            if key != "__metadata__":
                start, stop = entry["data_offsets"]
                arrays[key] = np.frombuffer(body[start:stop], np.float16).reshape(entry["shape"])
        header["__metadata__"]["sha256"] = digest_arrays(arrays)
        text = json.dumps(header).encode()
        data = struct.pack("<Q", len(text)) + text + body
    return {name: data}


def mend_calibration(files: Files) -> Files:
    """The sha256 of the maps."""
    record, maps = files["cal.json"], files.get("cal.npz")
    if maps is None:
        return files
    if (at := record.find(b'"sha256": "')) >= 0:
        at += len(b'"sha256": "')
        record = record[:at] + hashlib.sha256(maps).hexdigest().encode() + record[at + 64 :]
    return {"cal.json": record, "cal.npz": maps}


READERS: dict[str, Reader] = {
    "PNG": Reader(png_seeds, read_raw, mend_png),
    "TIFF": Reader(tiff_seeds, read_raw),
    "NPY": Reader(npy_seeds, read_raw),
    "NPZ": Reader(npz_seeds, read_raw, mend_zip),
    "PGM": Reader(pgm_seeds, read_raw),
    "headerless": Reader(raw_seeds, read_raw),
    "video": Reader(video_seeds, read_raw),
    "recording": Reader(recording_seeds, read_raw),
    "EXR": Reader(exr_seeds, read_frame_files),
    "separated NPZ": Reader(result_seeds, read_frame_files, mend_zip),
    "images of edits": Reader(map_seeds, read_images),
    "weights": Reader(weight_seeds, read_networks, mend_weights),
    "calibration": Reader(calibration_seeds, read_calibrations, mend_calibration),
    "recipe": Reader(recipe_seeds, read_recipes),
}


@cache
def seeds_of(name: str) -> Seeds:
    """The whole files of a reader."""
    return READERS[name].seeds()
