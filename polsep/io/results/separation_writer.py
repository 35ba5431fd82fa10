"""Writer of one separated frame to files, atomically.

Whatever the format, a frame becomes DIR/STEM.<format> (or a set of DIR/STEM_<layer>.<format> images), the preview
DIR/STEM.png and the sidecar DIR/STEM.json, which holds the polsep version, the report, the units and a sha256 per file.
The layer `ERROR` exists only where a frame has one. Its image belongs to STEM all the same: an older one is refused or
replaced like the others, and never stays beside images of another frame.

Conventions: images are linear light with 1.0 = one measurement at the white level, so an unclipped s0 reaches 2;
aolp is in radians in [0, pi), from image-right toward image-up. Files hold the very float32 values of the frame,
except the PNG set, whose scales are in `PNG_UNITS` and whose limited samples the sidecar counts.

Every file is written by Python, encoded in memory or, large ones, piece by piece: OpenEXR's own writes report a full
disk, but a short file only as a warning on the terminal.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial, reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import imagecodecs
import numpy as np
import tifffile
from numpy.typing import NDArray

from polsep import __version__
from polsep.io.results.exr import LARGEST_HALF, as_planes, write_exr
from polsep.io.results.previews import contact_sheet
from polsep.io.results.sidecars import EncodedFile, exr_notes, require_finite, require_stem, write_with_sidecar
from polsep.io.store.atomic import OutputError, refuse_existing
from polsep.io.store.image_codecs import encode_png, encode_png_quickly

if TYPE_CHECKING:
    from polsep.separation.report import SeparatedFrame

FORMATS = ("exr", "npz", "tiff", "png")
#: Layers of every frame.
LAYERS = ("diffuse", "specular", "dolp", "aolp", "valid")
#: The layer of frames whose method expects an error: two channels, for diffuse and specular.
ERROR = "error"
#: Layers of EXR files alone: all light, for programs that know no layers; Stokes images of frames that have some.
TOTAL, STOKES = "", ("S0", "S1", "S2")

#: Rows of an image that become half floats at a time.
ROWS = 64
#: The unit of images.
LIGHT = "linear light, 1.0 = one measurement at the white level (an unclipped s0 = diffuse + specular reaches 2)"
#: Meaning of the numbers in EXR, NPZ and TIFF files.
UNITS = {
    "diffuse": LIGHT,
    "specular": f"{LIGHT}; may exceed 2 where highlights were clipped",
    "dolp": "degree of linear polarization, 0 to 1; above 1 by noise",
    "aolp": "angle of linear polarization in radians, in [0, pi), from image-right toward image-up",
    "valid": "1 (TIFF: 255) where the separation is trustworthy, else 0",
    ERROR: "expected standard deviation of the error of diffuse and of specular, over all colours, in their unit",
    "combined": f"{LIGHT}; the sum of diffuse and specular, as edited",
    "S0": f"{LIGHT}; measured s0 = m0 + m90, not changed by the method",
    "S1": f"{LIGHT}; measured s1 = m0 - m90, angles from image-right toward image-up",
    "S2": f"{LIGHT}; measured s2 = m45 - m135, angles from image-right toward image-up",
}
#: Meaning of the codes in the PNG set.
PNG_UNITS = {
    "diffuse": "16 bit, LINEAR (no gamma): 65535 = 2.0; 1.0 = one measurement at the white level",
    "specular": "16 bit, LINEAR (no gamma): 65535 = 2.0; 1.0 = one measurement at the white level",
    "dolp": "16 bit: 65535 = degree of linear polarization 1.0",
    "aolp": "16 bit: 65536 = pi radians (180 degrees), from image-right toward image-up",
    "valid": "8 bit: 255 where the separation is trustworthy, else 0",
    ERROR: "16 bit, LINEAR: 65535 = 2.0; expected standard deviation of the error, red: of diffuse, green: of specular",
}
#: The value of code 65535 in the PNG set.
PNG_WHITE = {"diffuse": 2.0, "specular": 2.0, "dolp": 1.0, ERROR: 2.0}


def planned_outputs(directory: Path, stem: str, format: str) -> list[Path]:
    """Every file that `write_separation` may write, images first, then preview and sidecar. Touches no file.

    All are written, but for the image of `ERROR` (TIFF and PNG) where a frame has none.
    Raises OutputError when ``format`` is not one of `FORMATS` or ``stem`` is not a plain file name.
    """
    if format not in FORMATS:
        raise OutputError(f"expected a format of {', '.join(FORMATS)}, found {format!r}")
    require_stem(stem)
    return [Path(directory) / name for name in _file_names(stem, format, (*LAYERS, ERROR))]


def _file_names(stem: str, format: str, layers: tuple[str, ...]) -> list[str]:
    """The files of one frame with these layers."""
    images = [f"{stem}_{layer}.{format}" for layer in layers] if format in ("tiff", "png") else [f"{stem}.{format}"]
    return [*images, f"{stem}.png", f"{stem}.json"]


def _layers(frame: SeparatedFrame) -> tuple[str, ...]:
    """The layers that a frame has."""
    return LAYERS if frame.error is None else (*LAYERS, ERROR)


def write_separation(
    frame: SeparatedFrame, directory: Path, stem: str, format: str = "exr", overwrite: bool = False
) -> list[Path]:
    """Write the images, preview and sidecar of ``frame`` into ``directory`` (made if missing); return their paths.

    Atomic, as `write_set` is; ``overwrite`` also removes an older error image where ``frame`` has none. Files of an
    earlier run in another format are left alone.
    Raises OutputError when one of `planned_outputs` exists and ``overwrite`` is False (before any work), when the frame
    breaks its contract (shapes, dtypes, values that are not finite, a report that is not JSON) or when writing fails.
    """
    targets = planned_outputs(directory, stem, format)
    directory = Path(directory)
    refuse_existing(directory, targets, overwrite)
    if frame.stokes is not None and format != "exr":
        raise OutputError(f"expected the format exr for Stokes images, found {format}")
    _check_frame(frame)
    facts = {
        "source": frame.report.get("source"),
        "format": format,
        "shape": list(frame.diffuse.shape),
        "units": _units(frame, format),
    }
    limited = {"limited_samples": _limited_samples(frame)} if format == "png" else {}
    write_with_sidecar(targets, _encoded_files(frame, stem, format), facts, {"report": frame.report, **limited})
    return [directory / name for name in _file_names(stem, format, _layers(frame))]


def _units(frame: SeparatedFrame, format: str) -> dict[str, str]:
    """Meaning of the layers of a frame's files."""
    layers = (*_layers(frame), *stokes_layers(frame.stokes))
    return {layer: (PNG_UNITS if format == "png" else UNITS)[layer] for layer in layers}


def _check_frame(frame: SeparatedFrame) -> None:
    """Raise OutputError unless the frame has the shapes, types and values of its contract."""
    size = frame.valid.shape
    if len(size) != 2 or 0 in size or frame.valid.dtype != np.bool_:
        raise OutputError(f"expected valid as bool [H, W], found {frame.valid.dtype} {list(size)}")
    channels = frame.diffuse.shape[-1]
    color = (*size, 3 if channels == 3 else 1)
    shapes: dict[str, tuple[int, ...]] = {"diffuse": color, "specular": color, "dolp": size, "aolp": size}
    if frame.error is not None:
        shapes[ERROR] = (*size, 2)
    if frame.stokes is not None:
        shapes["stokes"] = (3, *color)
    for name, shape in shapes.items():
        image = getattr(frame, name)
        if image.shape != shape or image.dtype != np.float32:
            raise OutputError(f"expected {name} as float32 {list(shape)}, found {image.dtype} {list(image.shape)}")
    require_finite({name: getattr(frame, name) for name in shapes})
    if frame.error is not None and float(frame.error.min()) < 0:
        raise OutputError(f"expected deviations of 0 or more in {ERROR}, found {float(frame.error.min()):.3g}")


def _encoded_files(frame: SeparatedFrame, stem: str, format: str) -> Iterator[EncodedFile]:
    """Name and contents of each image file, one in memory at a time; then of the preview, drawn in the meantime."""
    with ThreadPoolExecutor(1, "polsep-preview") as pool:
        preview = pool.submit(lambda: encode_png_quickly(contact_sheet(frame)))
        yield from _encoded_images(frame, stem, format)
        yield f"{stem}.png", preview.result()


def _encoded_images(frame: SeparatedFrame, stem: str, format: str) -> Iterator[EncodedFile]:
    """Name and contents of each image file."""
    if format == "exr":
        yield f"{stem}.exr", partial(_write_exr, frame)
    elif format == "npz":
        yield f"{stem}.npz", partial(_write_npz, frame)
    elif format == "tiff":
        for layer in _layers(frame):
            yield f"{stem}_{layer}.tiff", _encode_tiff(frame, layer)
    else:
        for layer in _layers(frame):
            yield f"{stem}_{layer}.png", encode_png(_png_codes(frame, layer))


def _write_exr(frame: SeparatedFrame, stream: BinaryIO) -> None:
    """One part, ZIP compressed, with units and settings as header attributes: float32 channels.

    Layers that others show or measure in, `TOTAL` and `STOKES`, are half floats: half the size, 11 bits.
    """
    lobes = {"diffuse": frame.diffuse, "specular": frame.specular}
    planes: dict[str, NDArray[Any]] = {**lobes} if frame.diffuse.shape[2] == 3 else as_planes(lobes)
    planes |= {"dolp.Y": frame.dolp, "aolp.Y": frame.aolp, "valid.Y": frame.valid.astype(np.float32)}
    if frame.error is not None:
        planes |= {f"{ERROR}.{image}": frame.error[..., k] for k, image in enumerate(("diffuse", "specular"))}
    mirrored = as_planes({TOTAL: frame.specular})
    planes |= {name: as_halves(plane, mirrored[name]) for name, plane in as_planes({TOTAL: frame.diffuse}).items()}
    planes |= {name: as_halves(plane) for name, plane in as_planes(stokes_layers(frame.stokes)).items()}
    write_exr(stream, planes, exr_notes(_units(frame, "exr"), frame.report))


def as_halves(*planes: NDArray[np.float32]) -> NDArray[np.float16]:
    """The sum of planes ``[H, W]`` in half floats, some rows at a time; values beyond the largest become that."""
    halves = np.empty(planes[0].shape, np.float16)
    for top in range(0, len(halves), ROWS):
        total = reduce(np.add, (plane[top : top + ROWS] for plane in planes))
        halves[top : top + ROWS] = np.clip(total, -LARGEST_HALF, LARGEST_HALF)
    return halves


def stokes_layers(stokes: NDArray[np.float32] | None) -> dict[str, NDArray[np.float32]]:
    """Layers ``[h, w, C]`` of Stokes images ``[3, h, w, C]``, by name; none of None."""
    return {} if stokes is None else dict(zip(STOKES, stokes, strict=True))


def _write_npz(frame: SeparatedFrame, stream: BinaryIO) -> None:
    """The layers as they are, deflated."""
    np.savez_compressed(stream, **{layer: getattr(frame, layer) for layer in _layers(frame)})


def _encode_tiff(frame: SeparatedFrame, layer: str) -> bytes:
    """One layer: float32 deflated after the floating-point predictor where there is one; valid as uint8 0 or 255.

    The error is one page of two samples per pixel.
    """
    image = np.where(frame.valid, 255, 0).astype(np.uint8) if layer == "valid" else _flat(getattr(frame, layer))
    predictor = 3 if image.dtype == np.float32 and imagecodecs.FLOATPRED.available else 1  # TIFF: 1 none, 3 float
    stream = io.BytesIO()
    tifffile.imwrite(
        stream,
        image,
        photometric="rgb" if image.shape[2:] == (3,) else "minisblack",
        planarconfig="contig" if image.ndim == 3 else None,
        extrasamples=("unspecified",) if layer == ERROR else None,
        compression="zlib",
        predictor=predictor,
        description=f"{layer}: {UNITS[layer]}",
        software=f"polsep {__version__}",
        metadata=None,
    )
    return stream.getvalue()


def _png_codes(frame: SeparatedFrame, layer: str) -> NDArray[np.uint16] | NDArray[np.uint8]:
    """One layer in the integer codes of `PNG_UNITS`, values outside the scale limited to its ends.

    The error gets a third colour of zeros, because the second of two channels is opacity in PNG.
    """
    if layer == "valid":
        return np.where(frame.valid, 255, 0).astype(np.uint8)
    if layer == "aolp":
        steps = np.rint(frame.aolp.astype(np.float64) * (65536 / np.pi)).astype(np.int64)
        return np.mod(steps, 65536).astype(np.uint16)
    image: NDArray[np.float64] = _flat(getattr(frame, layer)).astype(np.float64)
    if layer == ERROR:
        image = np.concatenate([image, np.zeros_like(image[..., :1])], axis=-1)
    return np.rint(np.clip(image / PNG_WHITE[layer], 0, 1) * 65535).astype(np.uint16)


def _limited_samples(frame: SeparatedFrame) -> dict[str, dict[str, int]]:
    """Counts of samples that `_png_codes` limits, per layer: below 0 and above the value of code 65535."""
    return {
        layer: {
            "below": int(np.count_nonzero(getattr(frame, layer) < 0)),
            "above": int(np.count_nonzero(getattr(frame, layer) > white)),
        }
        for layer, white in PNG_WHITE.items()
        if layer in _layers(frame)
    }


def _flat(image: NDArray[Any]) -> NDArray[Any]:
    """``[H, W, 1]`` as ``[H, W]``; other shapes unchanged."""
    return image[..., 0] if image.ndim == 3 and image.shape[-1] == 1 else image
