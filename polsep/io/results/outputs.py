"""Writing one separated frame to files, all of them or none.

Whatever the format, a frame becomes DIR/STEM.<format> (or a set of DIR/STEM_<layer>.<format> images), the preview
DIR/STEM.png and the sidecar DIR/STEM.json, which holds the polsep version, the report, the units and a sha256 per file.
The layer `ERROR` exists only where a frame has one. Its image belongs to STEM all the same: an older one is refused or
replaced like the others, and does not stay beside images that it says nothing of.

Conventions: images are linear light with 1.0 = one measurement at the white level, so an unclipped s0 reaches 2;
aolp is in radians in [0, pi), from image-right toward image-up. Files hold the very float32 values of the frame,
except the PNG set, whose scales are in `PNG_UNITS` and whose limited samples the sidecar counts.

Every file is encoded in memory, written into a hidden directory inside DIR and then renamed into place. OpenEXR reports
a full disk, but a short file it reads back only as a warning on the terminal; Python's own writes leave no such doubt.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import io
import json
import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import imagecodecs
import numpy as np
import tifffile
from numpy.typing import NDArray

from polsep.io.results.exr import encode_exr
from polsep.io.results.previews import contact_sheet
from polsep.io.store.whole import write_checked

if TYPE_CHECKING:
    from polsep.separation.report import SeparatedFrame

FORMATS = ("exr", "npz", "tiff", "png")
#: Layers of every frame.
LAYERS = ("diffuse", "specular", "dolp", "aolp", "valid")
#: The layer of frames whose method expects an error: two channels, for diffuse and specular.
ERROR = "error"

#: The unit of images.
LIGHT = "linear light, 1.0 = one measurement at the white level (an unclipped s0 = diffuse + specular reaches 2)"
#: What the numbers in EXR, NPZ and TIFF files mean.
UNITS = {
    "diffuse": LIGHT,
    "specular": f"{LIGHT}; may exceed 2 where highlights were clipped",
    "dolp": "degree of linear polarization, 0 to 1; above 1 by noise",
    "aolp": "angle of linear polarization in radians, in [0, pi), from image-right toward image-up",
    "valid": "1 (TIFF: 255) where the separation is trustworthy, else 0",
    ERROR: "expected standard deviation of the error of diffuse and of specular, over all colours, in their unit",
    "combined": f"{LIGHT}; the sum of diffuse and specular, as edited",
}
#: What the codes in the PNG set mean.
PNG_UNITS = {
    "diffuse": "16 bit, LINEAR (no gamma): 65535 = 2.0; 1.0 = one measurement at the white level",
    "specular": "16 bit, LINEAR (no gamma): 65535 = 2.0; 1.0 = one measurement at the white level",
    "dolp": "16 bit: 65535 = degree of linear polarization 1.0",
    "aolp": "16 bit: 65536 = pi radians (180 degrees), from image-right toward image-up",
    "valid": "8 bit: 255 where the separation is trustworthy, else 0",
    ERROR: "16 bit, LINEAR: 65535 = 2.0; expected standard deviation of the error, red: of diffuse, green: of specular",
}
#: The value that code 65535 stands for in the PNG set.
PNG_WHITE = {"diffuse": 2.0, "specular": 2.0, "dolp": 1.0, ERROR: 2.0}


class OutputError(ValueError):
    """The outputs could not be written, and nothing was: one line of what was expected and what was found."""


def planned_outputs(directory: Path, stem: str, format: str) -> list[Path]:
    """Every file that `write_separation` may write, images first, then preview and sidecar. Touches no file.

    All are written, but for the image of `ERROR` (TIFF and PNG) where a frame has none.
    Raises OutputError when ``format`` is not one of `FORMATS` or ``stem`` is not a plain file name.
    """
    if format not in FORMATS:
        raise OutputError(f"expected a format of {', '.join(FORMATS)}, found {format!r}")
    if stem in ("", ".", "..") or any(c in stem for c in "/\\\0"):
        raise OutputError(f"expected a file name without path separators as stem, found {stem!r}")
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
    """Write the images, preview and sidecar of ``frame`` into ``directory`` (made if missing); the paths written.

    All or nothing: after a failure no new file is left and files that were there before are back in place, also with
    ``overwrite``, which also removes an older error image where ``frame`` has none. Files of an earlier run in another
    format are left alone. Two writers of one stem at the same time are not guarded against.
    Raises OutputError when one of `planned_outputs` exists and ``overwrite`` is False (before any work), when the frame
    breaks its contract (shapes, dtypes, values that are not finite, a report that is not JSON) or when writing fails.
    """
    targets = planned_outputs(directory, stem, format)
    directory = Path(directory)
    refuse_targets(directory, targets, overwrite)
    _check_frame(frame)
    write_all(targets, stem, lambda folder: _stage(frame, folder, stem, format))
    return [directory / name for name in _file_names(stem, format, _layers(frame))]


def write_all(targets: list[Path], stem: str, stage: Callable[[Path], None]) -> None:
    """Let ``stage`` write files into a folder, and move them to the ``targets`` of the same names, in one directory.

    All or nothing, as in `write_separation`; a target that was not staged is removed. Makes the directory. Raises
    OutputError, naming ``stem``, when anything fails.
    """
    directory = targets[0].parent
    made = [d for d in (directory, *directory.parents) if not os.path.exists(d)]
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with _unbroken():
            _write_and_move(targets, stage)
    except BaseException as error:
        for path in made:
            with suppress(OSError):
                path.rmdir()
        if isinstance(error, OutputError) or not isinstance(error, Exception):
            raise
        reason = " ".join(str(error).split()) or "no reason given"
        raise OutputError(
            f"expected to write {stem!r} into {directory}, found {type(error).__name__}: {reason}"
        ) from error


def refuse_targets(directory: Path, targets: list[Path], overwrite: bool) -> None:
    """Raise OutputError rather than replace files unasked, or ever replace a directory; to call before any work."""
    nearest = next((d for d in (directory, *directory.parents) if os.path.lexists(d)), None)
    if nearest is not None and not os.path.isdir(nearest):
        raise OutputError(f"expected a directory to write into, found a file: {nearest}")
    for target in targets:
        if os.path.isdir(target) and not os.path.islink(target):
            raise OutputError(f"expected a file or nothing at {target}, found a directory")
        if not overwrite and os.path.lexists(target):
            raise OutputError(f"expected no {target}, found one from before; --overwrite replaces it")


def _check_frame(frame: SeparatedFrame) -> None:
    """Hold the frame to its contract, so that no file carries a surprise."""
    size = frame.valid.shape
    if len(size) != 2 or 0 in size or frame.valid.dtype != np.bool_:
        raise OutputError(f"expected valid as bool [H, W], found {frame.valid.dtype} {list(size)}")
    channels = frame.diffuse.shape[-1]
    color = (*size, 3 if channels == 3 else 1)
    shapes = {"diffuse": color, "specular": color, "dolp": size, "aolp": size}
    if frame.error is not None:
        shapes[ERROR] = (*size, 2)
    for name, shape in shapes.items():
        image = getattr(frame, name)
        if image.shape != shape or image.dtype != np.float32:
            raise OutputError(f"expected {name} as float32 {list(shape)}, found {image.dtype} {list(image.shape)}")
    require_finite({name: getattr(frame, name) for name in shapes})
    if frame.error is not None and float(frame.error.min()) < 0:
        raise OutputError(f"expected deviations of 0 or more in {ERROR}, found {float(frame.error.min()):.3g}")


@contextmanager
def _unbroken() -> Iterator[None]:
    """Ctrl-C, or the system's request to end, waits until the block is done.

    Otherwise it may come while the block cleans up, and leave a part of it.
    """
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    if threading.current_thread() is not threading.main_thread() or None in before.values():  # no signal comes here
        yield
        return
    caught: list[int] = []
    for number in before:
        signal.signal(number, lambda number, place: caught.append(number))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if caught:  # also where the block has failed, or the system's own handler ends the program
            signal.raise_signal(caught[0])


def require_same(path: Path, settings: Mapping[str, Any], begun: str, advice: str = "") -> None:
    """Raise OutputError, naming what differs, unless ``path`` holds these settings; ``begun``: what they belong to."""
    try:
        before, now = (_flat_names(json.loads(text)) for text in (path.read_text("utf-8"), json.dumps(settings)))
    except (ValueError, AttributeError) as error:
        raise OutputError(f"expected the settings of {begun} in {path}, found {error}") from error
    different = [name for name in before | now if before.get(name) != now.get(name)]
    if different:
        was, found = (", ".join(f"{name} {kept.get(name)}" for name in different) for kept in (before, now))
        raise OutputError(f"expected {was}, with which {begun} was begun, found {found}{advice}")


def _flat_names(settings: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Settings within settings as those with both names."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        flat |= _flat_names(value, f"{before}{name} ") if isinstance(value, Mapping) else {f"{before}{name}": value}
    return flat


def _write_and_move(targets: list[Path], stage: Callable[[Path], None]) -> None:
    """Write into a hidden directory beside the targets, then rename; that directory is gone afterwards."""
    staging = Path(tempfile.mkdtemp(prefix=".polsep-", dir=targets[0].parent))
    try:
        (staging / "new").mkdir()
        (staging / "old").mkdir()
        stage(staging / "new")
        _move_into_place(staging, targets)
        shutil.rmtree(staging / "old", ignore_errors=True)
    finally:
        shutil.rmtree(staging / "new", ignore_errors=True)
        for path in (staging / "old", staging):  # not emptied by force: only a failed restore leaves files in old/
            with suppress(OSError):
                path.rmdir()


def _stage(frame: SeparatedFrame, folder: Path, stem: str, format: str) -> None:
    """Write every output of ``frame`` into ``folder``, the sidecar last."""
    files = write_hashed(folder, _encoded_files(frame, stem, format))
    sidecar: dict[str, Any] = {
        "polsep": version_text(),
        "source": frame.report.get("source"),
        "format": format,
        "shape": list(frame.diffuse.shape),
        "units": {layer: (PNG_UNITS if format == "png" else UNITS)[layer] for layer in _layers(frame)},
        "preview": f"{stem}.png is sRGB, 8 bit, for people: do not measure in it",
        "files": files,
        "report": frame.report,
    }
    if format == "png":
        sidecar["limited_samples"] = _limited_samples(frame)
    write_checked(folder / f"{stem}.json", (json.dumps(sidecar, indent=2, allow_nan=False) + "\n").encode())


def write_hashed(folder: Path, encoded: Iterable[tuple[str, bytes | memoryview]]) -> list[dict[str, Any]]:
    """Write files by name into ``folder``; name, size and sha256 of each, for a sidecar."""
    files = []
    for name, data in encoded:
        write_checked(folder / name, data)
        files.append({"name": name, "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()})
    return files


def require_finite(images: Mapping[str, NDArray[Any]]) -> None:
    """Raise OutputError, with a name and a count, where an image holds NaN or infinite samples."""
    for name, image in images.items():
        if wrong := int(np.count_nonzero(~np.isfinite(image))):
            raise OutputError(f"expected finite values in {name}, found {wrong} NaN or infinite samples")


def write_with_sidecar(
    folder: Path, stem: str, encoded: Iterable[tuple[str, bytes | memoryview]], said: Mapping[str, Any]
) -> None:
    """Write files by name into ``folder``, and last the sidecar STEM.json: what is ``said``, and `write_hashed`'s."""
    sidecar = {
        "polsep": version_text(),
        **said,
        "preview": f"{stem}.png is sRGB, 8 bit, for people: do not measure in it",
        "files": write_hashed(folder, encoded),
    }
    write_checked(folder / f"{stem}.json", (json.dumps(sidecar, indent=2, allow_nan=False) + "\n").encode())


def _move_into_place(staging: Path, targets: list[Path]) -> None:
    """Rename staging/new/* to the targets, keeping what was there in staging/old; undo everything on failure.

    A target that was not staged, an error image that the frame lacks, is only taken away.
    """
    begun: list[Path] = []
    staged = {path.name for path in (staging / "new").iterdir()}
    try:
        for target in targets:
            begun.append(target)
            if os.path.lexists(target):
                os.replace(target, staging / "old" / target.name)
            if target.name in staged:
                os.replace(staging / "new" / target.name, target)
    except BaseException:
        for target in reversed(begun):
            if target.name in staged and not (staging / "new" / target.name).exists():
                target.unlink(missing_ok=True)
            if os.path.lexists(staging / "old" / target.name):
                os.replace(staging / "old" / target.name, target)
        raise


def _encoded_files(frame: SeparatedFrame, stem: str, format: str) -> Iterator[tuple[str, bytes | memoryview]]:
    """Name and contents of each image file, then of the preview; one in memory at a time."""
    if format == "exr":
        yield f"{stem}.exr", _encode_exr(frame)
    elif format == "npz":
        yield f"{stem}.npz", _encode_npz(frame)
    elif format == "tiff":
        for layer in _layers(frame):
            yield f"{stem}_{layer}.tiff", _encode_tiff(frame, layer)
    else:
        for layer in _layers(frame):
            yield f"{stem}_{layer}.png", encode_png(_png_codes(frame, layer))
    yield f"{stem}.png", encode_png(contact_sheet(frame))


def _encode_exr(frame: SeparatedFrame) -> memoryview:
    """One part of float32 channels, ZIP compressed, with the units as header attributes."""
    planes = {"dolp.Y": frame.dolp, "aolp.Y": frame.aolp, "valid.Y": frame.valid}
    for layer, image in (("diffuse", frame.diffuse), ("specular", frame.specular)):
        for k, color in enumerate("RGB" if image.shape[-1] == 3 else "Y"):
            planes[f"{layer}.{color}"] = image[..., k]
    if frame.error is not None:
        planes |= {f"{ERROR}.{image}": frame.error[..., k] for k, image in enumerate(("diffuse", "specular"))}
    notes = {"polsepVersion": version_text(), **{f"{layer}Units": UNITS[layer] for layer in _layers(frame)}}
    return encode_exr({name: plane.astype(np.float32) for name, plane in planes.items()}, notes)


def _encode_npz(frame: SeparatedFrame) -> bytes:
    """The layers as they are, deflated."""
    stream = io.BytesIO()
    np.savez_compressed(stream, **{layer: getattr(frame, layer) for layer in _layers(frame)})
    return stream.getvalue()


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
        software=f"polsep {version_text()}",
        metadata=None,
    )
    return stream.getvalue()


def encode_png(pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    """``[H, W]`` or ``[H, W, 3]`` codes as they are; no colour space is claimed."""
    return bytes(imagecodecs.png_encode(np.ascontiguousarray(pixels)))


def _png_codes(frame: SeparatedFrame, layer: str) -> NDArray[np.uint16] | NDArray[np.uint8]:
    """One layer in the integer codes of `PNG_UNITS`, values outside the scale limited to its ends.

    The error gets a third colour of zeros: PNG would take the second of two channels for opacity.
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
    """How many samples of each layer `_png_codes` limits: below 0 and above the value of code 65535."""
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


def version_text() -> str:
    """The version of the installed polsep."""
    try:
        return importlib.metadata.version("polsep")
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
