"""JSON of files: strict, so that whatever was read can be written again.

Python's own reader accepts NaN and Infinity, makes infinity of 1e999, and has no limit of digits or levels but its own.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

#: Digits of a whole number at most: 64 bits have 20.
MOST_DIGITS = 20
#: Largest file that is read as one JSON text [bytes].
MOST_BYTES = 2**26
#: Characters of a wrong value that messages quote.
MOST_QUOTED = 40


def read_text(path: Path) -> str:
    """The UTF-8 text of a file of at most `MOST_BYTES`, without a byte order mark. Raises ValueError, and OSError."""
    with path.open("rb") as stream:
        data = stream.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise ValueError(f"expected a text of at most {MOST_BYTES} bytes, found more")
    try:
        return data.decode("utf-8-sig")  # as editors on Windows save it
    except UnicodeDecodeError as error:
        raise ValueError(f"expected text in UTF-8, found byte {data[error.start]:#04x} at {error.start}") from None


def parse_json(text: str) -> Any:
    """The values of a JSON text. Raises ValueError in one line."""
    try:
        return json.loads(text, parse_constant=_refuse, parse_float=_as_float, parse_int=_as_int)
    except RecursionError:
        raise ValueError("expected JSON of a few levels, found hundreds") from None


def read_record(path: Path, kind: str, form: str) -> dict[str, Any]:
    """The record in a JSON file of a ``kind``, whose entry "format" is ``form``. Raises ValueError, and OSError."""
    try:
        record = parse_json(read_text(path))
    except ValueError as error:
        raise ValueError(f"expected {kind}, found a file that is not JSON: {error}") from None
    if not isinstance(record, dict) or record.get("format") != form:
        raise ValueError(f"expected {kind} with format {form!r}, found another JSON file")
    return record


def entry_of(section: Mapping[str, Any], name: str) -> Any:
    """An entry that must be there. Raises ValueError."""
    if name not in section:
        raise ValueError(f"expected an entry {name}, found none")
    return section[name]


def section_of(record: Mapping[str, Any], name: str) -> dict[str, Any] | None:
    """A section of a record, None where it is missing or null. Raises ValueError on anything else."""
    found = record.get(name)
    if not isinstance(found, dict | None):
        raise ValueError(f"expected {name} as a section of entries, found {_quote(found)}")
    return found


def number_of(name: str, value: Any) -> float:
    """A number, neither true nor digits as text. Raises ValueError."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"expected {name} as a number, found {_quote(value)}")
    return float(value)


def numbers_of(name: str, value: Any, count: int | None = None) -> tuple[float, ...]:
    """A list of numbers, of ``count`` where that is stated. Raises ValueError."""
    if not isinstance(value, list) or (count is not None and len(value) != count):
        raise ValueError(f"expected {name} as {'a list of' if count is None else count} numbers, found {_quote(value)}")
    return tuple(number_of(name, number) for number in value)


def table_of(name: str, value: Any) -> tuple[tuple[float, ...], ...]:
    """Rows of numbers. Raises ValueError."""
    if not isinstance(value, list):
        raise ValueError(f"expected {name} as rows of numbers, found {_quote(value)}")
    return tuple(numbers_of(name, row) for row in value)


def _quote(value: Any) -> str:
    """The beginning of a value as the file has it."""
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= MOST_QUOTED else f"{text[:MOST_QUOTED]} ..."


def _refuse(name: str) -> None:
    raise ValueError(f"expected finite numbers, found {name}")


def _as_float(digits: str) -> float:
    number = float(digits)
    if not math.isfinite(number):
        raise ValueError(f"expected finite numbers, found {digits:.40}")
    return number


def _as_int(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise ValueError(f"expected whole numbers of at most {MOST_DIGITS} digits, found {len(digits)}")
    return int(digits)
