"""Separated frames that polsep wrote, read back whole: the twin of `outputs` for EXR."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import OpenEXR  # a bare extension module without stubs
from numpy.typing import NDArray

from polsep.io.errors import InputError, decoding, naming
from polsep.io.exr import read_exr_layers
from polsep.io.pages import require_signature, require_size
from polsep.report import SeparatedFrame

_SIGNATURE = b"\x76\x2f\x31\x01"
Planes = dict[str, NDArray[np.float32]]


def read_separation(path: Path) -> SeparatedFrame:
    """The frame of ``STEM.exr`` as `outputs.write_separation` wrote it, bit for bit, but for its report.

    Files with diffuse and specular layers alone, as of `polsep video`, are valid everywhere and of DoLP and AoLP 0.
    Raises InputError for anything else, before pixels are read where the header says too many.
    """
    with naming(path):
        with path.open("rb") as stream:
            require_signature(stream, (_SIGNATURE,), "an OpenEXR")
        _require_believable(path)
        planes = read_exr_layers(path)
        diffuse, specular = (_image(planes, layer) for layer in ("diffuse", "specular"))
        if diffuse.shape != specular.shape:
            raise InputError(f"expected layers of one size, found {diffuse.shape} and {specular.shape}")
        size = diffuse.shape[:2]
        zero, one = np.zeros(size, np.float32), np.ones(size, np.float32)
        dolp, aolp = (planes.get(f"{name}.Y", zero).astype(np.float32) for name in ("dolp", "aolp"))
        valid = planes.get("valid.Y", one) > 0.5
        error = None
        if all(f"error.{name}" in planes for name in ("diffuse", "specular")):
            error = np.stack([planes[f"error.{name}"].astype(np.float32) for name in ("diffuse", "specular")], axis=-1)
        _require_finite({"diffuse": diffuse, "specular": specular, "dolp": dolp, "aolp": aolp})
    report = {"statistics": {}, "warnings": [], "source": path.name, "method": "opened as a result"}
    return SeparatedFrame(diffuse, specular, valid, dolp, aolp, report, error)


def _require_believable(path: Path) -> None:
    """Raise InputError for a header whose size is not believed; no pixel is read."""
    with decoding("EXR"):
        header = OpenEXR.File(io.BytesIO(path.read_bytes()), separate_channels=True, header_only=True).header()
        (left, top), (right, bottom) = header["dataWindow"]
        shape = (int(bottom) - int(top) + 1, int(right) - int(left) + 1, max(len(header["channels"]), 1))
    require_size(shape)


def _image(planes: Planes, layer: str) -> NDArray[np.float32]:
    """A layer ``[h, w, 3]`` or ``[h, w, 1]``."""
    for colors in ("RGB", "Y"):
        names = [f"{layer}.{color}" for color in colors]
        if all(name in planes for name in names):
            return np.stack([planes[name].astype(np.float32) for name in names], axis=-1)
    found = ", ".join(sorted(planes)[:8]) or "none"
    raise InputError(f"expected layers diffuse and specular as polsep writes them, found channels {found}")


def _require_finite(images: Planes) -> None:
    for name, image in images.items():
        if wrong := int(np.count_nonzero(~np.isfinite(image))):
            raise InputError(f"expected finite values in {name}, found {wrong} that are not")
