"""Camera sources by their names on the command line, and the list of connected cameras."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from polsep.capture.aravis import AravisSource, list_aravis
from polsep.capture.folder import FolderSource
from polsep.capture.pylon import PylonSource, list_pylon
from polsep.capture.sources import CameraError, CameraSettings, CameraSource


class Backend(NamedTuple):
    """A library that finds cameras and connects to one by its id."""

    cameras: Callable[[], list[tuple[str, str]]]
    source: Callable[[str, CameraSettings], CameraSource]


#: Every library that polsep can use, installed or not.
BACKENDS = {"aravis": Backend(list_aravis, AravisSource), "pylon": Backend(list_pylon, PylonSource)}


class Listing(NamedTuple):
    """Cameras by name (``aravis:ID``) with a description, and unusable backends with the reason."""

    cameras: dict[str, str]
    missing: dict[str, str]


def list_cameras() -> Listing:
    """The cameras of every backend that is installed."""
    cameras: dict[str, str] = {}
    missing: dict[str, str] = {}
    for name, backend in BACKENDS.items():
        try:
            cameras |= {f"{name}:{camera}": text for camera, text in backend.cameras()}
        except CameraError as error:
            missing[name] = str(error)
    return Listing(cameras, missing)


def find_source(name: str | None, settings: CameraSettings) -> CameraSource:
    """The source of a name: ``aravis:ID``, ``pylon:ID``, ``folder:PATH``, ``loop:PATH``, a path, or an id alone.

    None is the only camera there is. Raises CameraError when that is not one camera, or a library is missing.
    """
    kind, colon, rest = (name or "").partition(":")
    if colon and kind in BACKENDS:
        return BACKENDS[kind].source(rest, settings)
    if colon and kind in ("folder", "loop"):
        return FolderSource(Path(rest), settings, loop=kind == "loop")
    if name and Path(name).exists():
        return FolderSource(Path(name), settings)
    found = list_cameras()
    chosen = [known for known in found.cameras if name is None or name == known.partition(":")[2]]
    if len(chosen) != 1:
        raise CameraError(_expected(name, found))
    kind, _, rest = chosen[0].partition(":")
    return BACKENDS[kind].source(rest, settings)


def _expected(name: str | None, found: Listing) -> str:
    """The message that no camera, or more than one, matches."""
    there = ", ".join(found.cameras) or "none"
    without = "".join(f"; {backend} is not usable: {reason}" for backend, reason in found.missing.items())
    if name is None:
        return f"expected one camera, or the name of one, found {there}{without}"
    names = "aravis:ID, pylon:ID, folder:PATH, loop:PATH"
    return f"expected a camera as {names}, a path or an id of {there}, found {name!r}{without}"
