"""Sets of files with a sidecar: STEM.json holds the polsep version, what its images mean, and a sha256 per file."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Container, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep import __version__
from polsep.io.store.atomic import Contents, OutputError, write_checked, write_set
from polsep.io.store.json_text import parse_json, read_text
from polsep.io.store.result_names import is_gray, listed_names

#: Attributes of EXR files by the keys of a report.
_REPORTED = {
    "method": "polsepMethod",
    "layout": "polsepLayout",
    "black_level": "polsepBlackLevel",
    "white_level": "polsepWhiteLevel",
    "exposure_s": "expTime",
}
#: A file name and the file's contents.
EncodedFile = tuple[str, Contents]


def require_stem(stem: str) -> None:
    """Raise OutputError unless ``stem`` is a plain file name."""
    if stem in ("", ".", "..") or any(c in stem for c in "/\\\0"):
        raise OutputError(f"expected a file name without path separators as stem, found {stem!r}")


def require_finite(images: Mapping[str, NDArray[Any]]) -> None:
    """Raise OutputError, with a name and a count, where an image holds NaN or infinite samples."""
    for name, image in images.items():
        if wrong := int(np.count_nonzero(~np.isfinite(image))):
            raise OutputError(f"expected finite values in {name}, found {wrong} NaN or infinite samples")


def write_with_sidecar(
    targets: Sequence[Path],
    files: Iterable[EncodedFile],
    facts: Mapping[str, Any],
    report: Mapping[str, Any] | None = None,
) -> None:
    """Write ``files`` and then their sidecar STEM.json, the last of ``targets``; atomically, as `write_set` does.

    ``files`` may be lazy: each is in memory alone. The sidecar holds ``facts`` before the list of files and ``report``
    after it. Raises OutputError, also on a sidecar that is not JSON, and where the preview would replace a raw frame.
    """
    stem = targets[-1].stem
    if is_gray(preview := targets[-1].with_suffix(".png")):
        raise OutputError(f"expected a preview of before to replace, found a grey PNG, as raw frames are: {preview}")

    def write(folder: Path) -> None:
        listed = []
        for name, data in files:
            write_checked(folder / name, data)
            with (folder / name).open("rb") as stream:
                digest = hashlib.file_digest(stream, "sha256").hexdigest()
            listed.append({"name": name, "bytes": (folder / name).stat().st_size, "sha256": digest})
        sidecar = {
            "polsep": __version__,
            **facts,
            "preview": f"{stem}.png is sRGB, 8 bit, for people: do not measure in it",
            "files": listed,
            **(report or {}),
        }
        text = json.dumps(sidecar, indent=2, allow_nan=False, default=_plain)
        write_checked(folder / f"{stem}.json", (text + "\n").encode())

    write_set(targets, stem, write)


def _plain(value: Any) -> Any:
    """Numbers and arrays of NumPy, which people add to reports, as JSON has them. Raises OutputError on all else."""
    if isinstance(value, np.generic | np.ndarray) and value.dtype.kind in "biufSU":
        return value.tolist()
    raise OutputError(f"expected numbers, text, lists and mappings in a report, found {type(value).__name__}")


def read_report(path: Path) -> dict[str, Any]:
    """The report on a file of `polsep separate`, in the sidecar beside it; empty where there is none.

    A sidecar that lists files of other formats alone is of another run.
    """
    try:
        sidecar = parse_json(read_text(path.with_suffix(".json")))
    except (OSError, ValueError):
        return {}
    if not isinstance(sidecar, dict) or path.suffix.lower() not in _formats(sidecar.get("files"), path.suffix.lower()):
        return {}
    report = sidecar.get("report")
    return report if isinstance(report, dict) else {}


def _formats(files: object, unless: str) -> list[str]:
    """The endings of names in a sidecar's list of files; ``unless`` where it has no such list."""
    return [Path(name).suffix.lower() for name in listed_names(files)] or [unless]


def require_same_settings(
    path: Path, settings: Mapping[str, Any], owner: str, advice: str = "", found: Container[str] = ()
) -> None:
    """Raise OutputError, naming what differs, unless ``path`` holds these settings; ``owner``: what they belong to.

    Those ``found`` in frames are named only where nothing else differs, which they follow from.
    """
    try:
        before, now = (_flat_names(json.loads(text)) for text in (path.read_text("utf-8"), json.dumps(settings)))
    except (ValueError, AttributeError) as error:
        raise OutputError(f"expected the settings of {owner} in {path}, found {error}") from error
    different = [name for name in before | now if before.get(name) != now.get(name)]
    different = [name for name in different if name.split()[0] not in found] or different
    if different:
        expected, other = (", ".join(_said(name, all.get(name)) for name in different) for all in (before, now))
        raise OutputError(f"expected {expected}, with which {owner} was begun, found {other}{advice}")


def _said(name: str, value: Any) -> str:
    """A setting and its value in words."""
    return f"{name} not said" if value is None else f"{name} {value}"


def _flat_names(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Settings within settings under both names, separated by a space."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        flat |= _flat_names(value, f"{prefix}{name} ") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return flat


def exr_notes(units: Mapping[str, str], report: Mapping[str, Any] | None = None) -> dict[str, str | float]:
    """Attributes of an EXR file: the polsep version, the unit of each layer, and what a frame's ``report`` says.

    Method, layout, levels and light colour are polsep's own; exposure time [s] and time of the capture (UTC) are
    OpenEXR's standard attributes ``expTime``, ``capDate`` and ``utcOffset``. What is not known is left out.
    """
    notes: dict[str, str | float] = {"polsepVersion": __version__}
    notes |= {f"{layer}Units": unit for layer, unit in units.items()}
    found = report or {}
    for key, name in _REPORTED.items():
        if found.get(key) is not None:
            notes[name] = found[key] if isinstance(found[key], str) else float(found[key])
    if found.get("light_color") is not None:
        notes["polsepLightColor"] = ",".join(f"{gain:.6g}" for gain in found["light_color"])
    if found.get("captured") is not None:
        when = datetime.fromisoformat(found["captured"]).astimezone(UTC)
        notes |= {"capDate": when.strftime("%Y:%m:%d %H:%M:%S"), "utcOffset": 0.0}
    return notes
