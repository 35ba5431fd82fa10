"""Calibration files: JSON for people and programs, and an NPZ file of the same name beside it where there are maps.

``dark``, ``flat``, ``analysers`` and ``light`` are sections of the JSON, each there once it was measured. Units are in
the names; tables ``[period][period]`` are in the order of pixels; codes are those of ``white_level_codes``. Maps are
kept as half floats, as offsets from the black level and from gain 1. An extinction of null is infinite.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import re
import zipfile
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.compute.arguments import WrongType
from polsep.io.store.atomic import OutputError, replace_bytes, replace_text
from polsep.io.store.errors import InputError, as_path, decoding, naming
from polsep.io.store.header_checks import SAMPLES, limit
from polsep.io.store.json_text import entry_of, number_of, numbers_of, read_record, section_of, table_of
from polsep.sensor.calibration import Analyser, Calibration, LampFacts
from polsep.sensor.camera import Layout

FORMAT, KIND = "polsep calibration 1", "a calibration of 'polsep calibrate'"
#: Least steps of the maps: of black as a part of the white level, at most in codes, and of gains.
BLACK_PART, BLACK_STEP, GAIN_STEP = 2.0**-22, 2.0**-10, 2.0**-17
#: Arrays of the NPZ file. "defective_pixels" are hot and dead ones of older files, which do not tell them apart.
ARRAYS = ("black_offset_codes", "gain_minus_1", "hot_pixels", "dead_pixels", "defective_pixels")


def maps_path(path: Path) -> Path:
    """The NPZ file beside a calibration's JSON file."""
    return path.with_suffix(".npz")


def write_calibration(path: Path, calibration: Calibration, version: str) -> list[Path]:
    """Write a calibration as ``path``, and its maps beside it; the files written. ``version``: of polsep.

    Whenever the program is killed, the calibration is the one before or the new one: maps wait under a hidden name,
    where they are read too, until the JSON file is replaced. Raises OutputError, and ValueError on a calibration that
    could not be read again, and leaves the one before.
    """
    refuse_foreign_maps(path)
    _require_parts(calibration)
    arrays, maps = _arrays(calibration), maps_path(path)
    record = _record(calibration) | {"polsep": version}
    try:
        if arrays:
            buffer = io.BytesIO()
            np.savez(buffer, **arrays)  # type: ignore[arg-type]
            replace_bytes(_waiting(maps), buffer.getvalue())
            record["maps"] = {"file": maps.name, "sha256": hashlib.sha256(buffer.getvalue()).hexdigest()}
        replace_text(path, _to_json(record) + "\n")
    except OSError as error:
        _waiting(maps).unlink(missing_ok=True)
        raise OutputError(f"expected to write {path.name!r} into {path.parent}, found {error.strerror}") from error
    if arrays:
        os.replace(_waiting(maps), maps)
    else:
        maps.unlink(missing_ok=True)
    return [path, maps] if arrays else [path]


def refuse_foreign_maps(path: Path) -> None:
    """Raise ValueError if ``path`` is no name of a calibration, OutputError on an NPZ file beside it of something else.

    Maps whose calibration is gone are none of something else.
    """
    if path.suffix.lower() != ".json":
        raise ValueError(f"expected a calibration file that ends in .json, found {path.name!r}")
    maps = maps_path(path)
    if maps.exists() and not holds_maps(maps):
        raise OutputError(f"expected no {maps}, where maps of {path.name} belong, found a file of something else")


def holds_maps(path: Path) -> bool:
    """Return True for an NPZ file of arrays that calibrations have."""
    try:
        with zipfile.ZipFile(path) as archive:
            return {Path(name).stem for name in archive.namelist()} <= set(ARRAYS)
    except (OSError, zipfile.BadZipFile):
        return False


def _waiting(maps: Path) -> Path:
    """The name of maps whose JSON file is not there yet."""
    return maps.with_name(f".{maps.name}.new")


def read_calibration(path: str | Path) -> Calibration:
    """The calibration of a JSON file and of the maps beside it. Raises InputError, in one line that names the file."""
    path = as_path(path)
    with naming(path):
        record = read_record(path, KIND, FORMAT)
        maps = maps_path(path)
        stamp = os.stat(maps).st_mtime_ns if record.get("maps") and maps.exists() else 0
        return _read(path.absolute(), path.stat().st_mtime_ns, stamp)  # another folder may be the current one


@lru_cache(maxsize=4)  # viewers read it with every frame
def _read(path: Path, stamp: int, maps_stamp: int) -> Calibration:
    record = read_record(path, KIND, FORMAT)
    return _from_record(record, _read_maps(path, section_of(record, "maps")))


def _read_maps(path: Path, entry: Mapping[str, Any] | None) -> dict[str, NDArray[Any]]:
    """The arrays of the NPZ file, once its hash is the recorded one."""
    if entry is None:
        return {}
    maps = maps_path(path)
    found = [file.read_bytes() for file in (maps, _waiting(maps)) if file.exists()]
    if not found:
        raise ValueError(f"expected its maps in {maps.name} beside it, found none")
    wanted = entry_of(entry, "sha256")
    data = next((data for data in found if hashlib.sha256(data).hexdigest() == wanted), None)
    if data is None:
        raise ValueError(f"expected the maps that it was written with in {maps.name}, found others")
    most = 4 * limit(SAMPLES)
    with decoding("NPZ"), np.load(io.BytesIO(data), allow_pickle=False) as archive:
        if (size := sum(member.file_size for member in archive.zip.infolist())) > most:
            raise InputError(f"expected at most {most} bytes in {maps.name}, found {size}")
        return {name: archive[name] for name in ARRAYS if name in archive.files}


def _arrays(c: Calibration) -> dict[str, NDArray[Any]]:
    arrays: dict[str, NDArray[Any]] = {}
    if c.black_map is not None:
        arrays["black_offset_codes"] = _halves(c.black_map - np.float32(c.black_level or 0), _black_step(c))
    if c.gain_map is not None:
        arrays["gain_minus_1"] = _halves(c.gain_map - np.float32(1), GAIN_STEP)
    for name, pixels in (("hot_pixels", c.hot), ("dead_pixels", c.dead)):
        if pixels is not None and pixels.size:
            arrays[name] = pixels
    return arrays


def _black_step(c: Calibration) -> float:
    """The step of black: a power of two, 2^-10 from 12 bits on."""
    return float(min(BLACK_STEP, BLACK_PART * 2.0 ** math.ceil(math.log2(c.white_level))))


def _halves(values: NDArray[np.float32], step: float) -> NDArray[np.float16]:
    """Half floats of multiples of a step, so that a map that is read and written again keeps its bits."""
    steps = np.rint(values / np.float32(step)) + np.float32(0)  # no negative zeros
    halves: NDArray[np.float16] = (steps * np.float32(step)).astype(np.float16)
    return halves


def _record(c: Calibration) -> dict[str, Any]:
    """The calibration without maps, by section."""
    details = {name: dict(value) for name, value in c.details.items()}
    record: dict[str, Any] = {"format": FORMAT, "layout": c.layout.spec, "white_level_codes": c.white_level}
    if c.size is not None:
        record |= {"height": c.size[0], "width": c.size[1]}
    if c.black_level is not None:
        record["dark"] = {
            "black_level_codes": c.black_level,
            "black_pattern_codes": c.black_pattern,
            "read_noise_codes": c.read_noise,
        } | details.pop("dark", {})
    if c.gains is not None:
        record["flat"] = {"gains": c.gains, "falloff_legendre": c.falloff} | details.pop("flat", {})
    if c.analysers is not None:
        record["analysers"] = {
            "angle_deg": [[a.angle_deg for a in row] for row in c.analysers],
            "extinction": [[None if math.isinf(a.extinction) else a.extinction for a in row] for row in c.analysers],
            "gain": [[a.gain for a in row] for row in c.analysers],
        } | details.pop("analysers", {})
    if c.lamp is not None:
        lamp = {"color_rgb": c.lamp.color, "dolp": c.lamp.dolp, "aolp_deg": c.lamp.aolp_deg}
        record["light"] = lamp | details.pop("light", {})
    return record


def _from_record(record: dict[str, Any], maps: dict[str, NDArray[Any]]) -> Calibration:
    dark, flat, analysers, light = (section_of(record, name) for name in ("dark", "flat", "analysers", "light"))
    black_map, gain_map, older = (maps.get(name) for name in ("black_offset_codes", "gain_minus_1", "defective_pixels"))
    level = None if dark is None else number_of("black_level_codes", entry_of(dark, "black_level_codes"))
    found = Calibration(
        layout=_layout(entry_of(record, "layout")),
        white_level=number_of("white_level_codes", entry_of(record, "white_level_codes")),
        size=(_side(record, "height"), _side(record, "width")) if "height" in record or "width" in record else None,
        black_level=level,
        black_pattern=_unless_null(table_of, dark, "black_pattern_codes"),
        black_map=None if black_map is None else black_map.astype(np.float32) + np.float32(level or 0),
        read_noise=_unless_null(number_of, dark, "read_noise_codes"),
        gains=None if flat is None else table_of("gains", entry_of(flat, "gains")),
        gain_map=None if gain_map is None else gain_map.astype(np.float32) + np.float32(1),
        falloff=_unless_null(table_of, flat, "falloff_legendre"),
        hot=maps.get("hot_pixels", older),
        dead=maps.get("dead_pixels", older),
        analysers=None if analysers is None else _analysers(analysers),
        lamp=None if light is None else _lamp(light),
        details={n: _details(part) for n, part in record.items() if isinstance(part, dict) and n != "maps"},
    )
    _require_parts(found)
    return found


#: What is nothing without another field.
_PARTS = (("black_map", "black_level"), ("black_pattern", "black_level"), ("gain_map", "gains"), ("falloff", "gains"))


def _require_parts(c: Calibration) -> None:
    """Raise ValueError on what cannot be written without another field, as its section is missing."""
    for part, whole in _PARTS:
        if getattr(c, part) is not None and getattr(c, whole) is None:
            raise ValueError(f"expected {whole} with its {part}, found none: is a section missing?")


#: Entries of sections that are fields of `Calibration`; the others are its details.
_FIELDS = {"black_level_codes", "black_pattern_codes", "read_noise_codes", "gains", "falloff_legendre", "angle_deg"}
_FIELDS |= {"extinction", "gain", "color_rgb", "dolp", "aolp_deg"}


def _details(section: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in section.items() if name not in _FIELDS}


def _layout(spec: Any) -> Layout:
    """The layout of its text. Raises ValueError."""
    try:
        return Layout.parse(spec)
    except WrongType:
        raise ValueError(f"expected layout as text, found {json.dumps(spec):.40}") from None


def _side(record: Mapping[str, Any], name: str) -> int:
    """Rows or columns of a frame. Raises ValueError."""
    side = number_of(name, entry_of(record, name))
    if not (1 <= side <= limit(SAMPLES) and side.is_integer()):
        raise ValueError(f"expected {name} in whole pixels, found {side:g}")
    return int(side)


def _unless_null(parse: Callable[[str, Any], Any], section: Mapping[str, Any] | None, name: str) -> Any:
    """An entry that must be there, but may be null: unknown, as in a section that was not measured."""
    value = None if section is None else entry_of(section, name)
    return None if value is None else parse(name, value)


def _lamp(section: Mapping[str, Any]) -> LampFacts:
    r, g, b = numbers_of("color_rgb", entry_of(section, "color_rgb"), 3)
    return LampFacts((r, g, b), *(_unless_null(number_of, section, name) for name in ("dolp", "aolp_deg")))


def _analysers(section: Mapping[str, Any]) -> tuple[tuple[Analyser, ...], ...]:
    """One analyser per place; an extinction of null is infinite. Raises ValueError on tables of different places."""
    angles, gains = (table_of(name, entry_of(section, name)) for name in ("angle_deg", "gain"))
    ratios = table_of("extinction", _null_as_infinite(entry_of(section, "extinction")))
    sizes = [[len(row) for row in table] for table in (angles, ratios, gains)]
    if sizes != [sizes[0]] * 3:
        raise ValueError(f"expected angle_deg, extinction and gain of the same places, found rows of {sizes}")
    return tuple(
        tuple(Analyser(*places) for places in zip(*rows, strict=True))
        for rows in zip(angles, ratios, gains, strict=True)
    )


def _null_as_infinite(table: Any) -> Any:
    """A table with the nulls of its rows replaced; anything else as it is."""
    if not isinstance(table, list):
        return table
    return [[math.inf if x is None else x for x in row] if isinstance(row, list) else row for row in table]


def _to_json(record: dict[str, Any]) -> str:
    """JSON with one entry per line, one row of a table per line, and numbers of tables to six decimals."""
    text = json.dumps(_rounded(record), indent=1, allow_nan=False)
    return re.sub(r"\[\s+([^\[\]{}]*?)\s+\]", lambda row: f"[{' '.join(row[1].split())}]", text)


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _rounded(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(entry) for entry in value]
    return round(value, 6) if isinstance(value, float) else value
