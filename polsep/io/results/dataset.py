"""Files of a rendered set: a raw frame, its ground truth and a record per view, and a manifest of all.

    DIR/options.json             the options of the set, and the versions of the libraries that made it
    DIR/STEM.png                 the raw mosaic, 16-bit words that hold 12-bit codes (white level 4095)
    DIR/STEM.exr or .npz         the truth at raw resolution in half floats: `LAYERS` and the mask
    DIR/STEM.json                camera, light, exposure, seeds, and size and sha256 of the two files before
    DIR/manifest.jsonl           options, then name, size and sha256 of every file above, in order of views
    DIR/contact.png              pictures of some of the views

Units are those of `separation_writer`: linear light, 1.0 is one measurement at the white level. A view's files are
written in a hidden directory and renamed into place, its record last: a view with a record is complete, whenever the
program was killed. No file depends on the time, the machine's name or the user.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from polsep.io.results.exr import as_planes, encode_exr, read_exr_layers
from polsep.io.results.sidecars import require_same_settings
from polsep.io.store.atomic import OutputError, replace_bytes, write_checked
from polsep.io.store.image_codecs import encode_png
from polsep.physics.srgb import srgb_bytes

FORMATS = ("exr", "npz")
#: RGB images of the truth; s1 and s2 are of the light on the sensor, whose s0 is diffuse + specular.
LAYERS = ("diffuse", "specular", "s1", "s2")
OPTIONS, MANIFEST, SHEET, UNFINISHED = "options.json", "manifest.jsonl", "contact.png", ".unfinished"
#: zlib level of the mosaic: noise does not shrink, and level 6 takes twice as long for 4 % less.
PNG_LEVEL = 2
#: Rows and columns of views on the contact sheet, and the side of each of their pictures in pixels.
SHEET_ROWS, SHEET_COLS, THUMBNAIL = 5, 8, 160
#: Width and grey level of the gaps between them.
GAP, GAP_LEVEL = 6, 40

Images = Mapping[str, NDArray[Any]]


def view_stem(shape: int, view: int) -> str:
    """``shape00012_view03``."""
    return f"shape{shape:05d}_view{view:02d}"


def begin_dataset(directory: Path, options: Mapping[str, Any]) -> None:
    """Make the directory of a set, or resume one that was begun with the same options and versions.

    Raises OutputError when it was begun with others, or holds other files.
    """
    path = directory / OPTIONS
    if os.path.lexists(directory) and not directory.is_dir():
        raise OutputError(f"expected a directory to write into, found a file: {directory}")
    if path.is_file():
        require_same_settings(path, options, f"the set in {directory}")
        return
    others = sorted(path.name for path in directory.glob("[!.]*"))
    if others:
        raise OutputError(f"expected {directory} empty, new, or a set begun before, found {others[0]!r} in it")
    replace_bytes(path, _as_json(options))


def find_finished(directory: Path, stems: Sequence[str]) -> set[str]:
    """The views that are complete: their record exists, and all files have the sizes in it."""
    sizes = {entry.name: entry.stat().st_size for entry in os.scandir(directory) if entry.is_file()}
    return {stem for stem in stems if f"{stem}.json" in sizes and _is_complete(directory / f"{stem}.json", sizes)}


def _is_complete(record: Path, sizes: Mapping[str, int]) -> bool:
    """True unless a file is missing or cut short, or the record itself, as after a crash of the machine."""
    try:
        files = json.loads(record.read_bytes())["files"]
        return all(sizes.get(file["name"]) == file["bytes"] for file in files)
    except (ValueError, KeyError, TypeError):
        return False


def write_view(directory: Path, stem: str, images: Images, record: Mapping[str, Any], format: str) -> None:
    """Write one view: ``mosaic`` uint16 ``[H, W]``, `LAYERS` float16 ``[H, W, 3]``, ``mask`` bool ``[H, W]``."""
    encode = {"exr": _encode_exr, "npz": _encode_npz}[format]
    contents = {f"{stem}.png": encode_png(images["mosaic"], PNG_LEVEL), f"{stem}.{format}": encode(images)}
    contents[f"{stem}.json"] = _as_json({**record, "files": [_entry(*item) for item in contents.items()]})
    hidden = directory / UNFINISHED
    hidden.mkdir(exist_ok=True)
    staging = Path(tempfile.mkdtemp(dir=hidden))
    try:
        for name, data in contents.items():
            write_checked(staging / name, data)
        for name in contents:  # the record is the last
            os.replace(staging / name, directory / name)
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def read_view(directory: Path, stem: str) -> dict[str, NDArray[Any]]:
    """The images of `write_view`, exactly."""
    images: dict[str, NDArray[Any]] = {"mosaic": imagecodecs.png_decode((directory / f"{stem}.png").read_bytes())}
    packed = directory / f"{stem}.npz"
    if packed.is_file():
        with np.load(packed) as arrays:
            return images | {name: arrays[name] for name in (*LAYERS, "mask")}
    planes = read_exr_layers(directory / f"{stem}.exr")
    for layer in LAYERS:
        images[layer] = np.stack([planes[f"{layer}.{color}"] for color in "RGB"], axis=-1)
    return images | {"mask": planes["mask.Y"] == 1}


def finish_dataset(directory: Path, stems: Sequence[str], options: Mapping[str, Any]) -> None:
    """Write contact sheet and manifest of a complete set, and remove unfinished views."""
    count = min(len(stems), SHEET_ROWS * SHEET_COLS)
    shown = [stems[k * len(stems) // count] for k in range(count)]
    sheet = contact_sheet(read_view(directory, stem) for stem in shown)
    replace_bytes(directory / SHEET, encode_png(sheet))
    lines = [json.dumps({"options": options, "views": len(stems)})]
    for stem in stems:
        data = (directory / f"{stem}.json").read_bytes()
        files = [*json.loads(data)["files"], _entry(f"{stem}.json", data)]
        lines.append(json.dumps({"view": stem, "files": files}))
    replace_bytes(directory / MANIFEST, "".join(f"{line}\n" for line in lines).encode())
    remove_unfinished(directory)


def read_fingerprint(directory: Path) -> str:
    """The sha256 of a set's manifest, which lists the sha256 of every file."""
    return hashlib.sha256((directory / MANIFEST).read_bytes()).hexdigest()


def remove_unfinished(directory: Path) -> None:
    """Remove the unfinished files of programs that were killed."""
    shutil.rmtree(directory / UNFINISHED, ignore_errors=True)


def contact_sheet(views: Iterator[Images]) -> NDArray[np.uint8]:
    """Views in reading order, each the raw frame, the diffuse and the specular below one another, sRGB.

    The raw frame is the mean of each 4x4 period of the mosaic per colour, so clipping and noise show. White is an s0 of
    2, the largest that can be measured.
    """
    cells = [np.concatenate([_thumbnail(image) for image in _pictures(view)]) for view in views]
    cells += [np.full_like(cells[0], GAP_LEVEL)] * (-len(cells) % SHEET_COLS)
    margins = ((0, GAP), (0, GAP), (0, 0))
    padded = [np.pad(cell, margins, constant_values=GAP_LEVEL) for cell in cells]
    return np.concatenate(
        [np.concatenate(padded[k : k + SHEET_COLS], axis=1) for k in range(0, len(padded), SHEET_COLS)]
    )


def _pictures(view: Images) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """s0 of the mosaic, diffuse and specular, linear ``[H, W, 3]``; the first at a quarter of the size."""
    codes = view["mosaic"][: view["mosaic"].shape[0] // 4 * 4, : view["mosaic"].shape[1] // 4 * 4] * (2 / 4095)
    blocks = codes.reshape(codes.shape[0] // 4, 2, 2, codes.shape[1] // 4, 2, 2).mean(axis=(2, 5))
    red, blue, green = blocks[:, 0, :, 0], blocks[:, 1, :, 1], (blocks[:, 0, :, 1] + blocks[:, 1, :, 0]) / 2
    return np.stack([red, green, blue], axis=-1), view["diffuse"], view["specular"]


def _thumbnail(image: NDArray[Any]) -> NDArray[np.uint8]:
    """A square image as sRGB with a side of `THUMBNAIL` pixels: means over blocks, or pixels repeated."""
    side = image.shape[0]
    edges = np.arange(THUMBNAIL) * side // THUMBNAIL
    small = np.asarray(image, np.float64)
    if side <= THUMBNAIL:
        small = small[edges][:, edges]
    else:
        counts = np.diff(edges, append=side)
        small = np.add.reduceat(np.add.reduceat(small, edges, axis=0), edges, axis=1)
        small /= counts[:, None, None] * counts[:, None]
    return srgb_bytes(small / 2)


def _encode_exr(images: Images) -> bytes:
    """One part of half floats, ZIP compressed, as every reader of EXR knows it."""
    planes = {**as_planes({layer: images[layer] for layer in LAYERS}), "mask.Y": images["mask"]}
    notes = {"units": "linear light, 1.0 = one measurement at the white level: s0 = diffuse + specular = 2"}
    return bytes(encode_exr({name: plane.astype(np.float16) for name, plane in planes.items()}, notes))


def _encode_npz(images: Images) -> bytes:
    """The arrays as they are, deflated."""
    stream = io.BytesIO()
    arrays: dict[str, Any] = {name: images[name] for name in (*LAYERS, "mask")}
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def _entry(name: str, data: bytes) -> dict[str, Any]:
    return {"name": name, "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def _as_json(record: Mapping[str, Any]) -> bytes:
    return (json.dumps(record, indent=1, allow_nan=False) + "\n").encode()
