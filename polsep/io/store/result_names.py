"""Names of results in a folder, by their sidecars: they are no frames, and their previews replace none."""

from __future__ import annotations

import os
from pathlib import Path

from polsep.io.store.json_text import parse_json, read_text


def is_gray(path: Path) -> bool:
    """True for a PNG of one channel, as raw frames are and no preview of polsep is."""
    if not (os.path.isfile(path) and os.access(path, os.R_OK)):
        return False
    with path.open("rb") as stream:
        head = stream.read(26)
    return head.startswith(b"\x89PNG") and head[25:] in (b"\0", b"\4")


def result_names(path: Path) -> list[str]:
    """Names of the results that a sidecar lists, and of its preview where that is no raw frame; none of other JSON."""
    try:
        sidecar = parse_json(read_text(path))
    except (OSError, ValueError):
        return []
    files = listed_names(sidecar.get("files")) if isinstance(sidecar, dict) and "polsep" in sidecar else []
    preview = path.with_suffix(".png")
    return [name for name in files if name != preview.name] + [preview.name] * (bool(files) and not is_gray(preview))


def listed_names(files: object) -> list[str]:
    """The names in a sidecar's list of files."""
    entries = files if isinstance(files, list) else []
    return [str(entry.get("name") if isinstance(entry, dict) else entry) for entry in entries]
