"""The frame of a file, separated here or before: the input of `polsep shape` and `polsep geometry`."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

from polsep.io.raw.frames import ReadOptions, read_frames, refuse_forgotten
from polsep.io.results.separation_reader import is_separated, open_separated
from polsep.io.store.errors import input_error
from polsep.light.light_color import LightColor
from polsep.pipeline import separate_capture
from polsep.separation.report import SeparatedFrame


def open_frame(
    path: Path, read: ReadOptions, method: str, light_color: LightColor | str = "auto"
) -> tuple[SeparatedFrame, list[str]]:
    """The only frame of a file, separated, and notes for the user, a line each: on the file and on the frame.

    ``read`` and ``method`` are for raw frames. Of a raw file of several frames two are read. Raises InputError on it,
    and on what cannot be read or separated.
    """
    if is_separated(path):
        return open_separated(path, light_color)
    frames = list(islice(read_frames(path, read), 2))
    if len(frames) != 1:
        number = max((frame.count for frame in frames), default=0)
        raise input_error(path, f"expected one frame, found {max(number, len(frames))}")
    refuse_forgotten(path, frames[0])
    try:
        separated = separate_capture(frames[0].data, method, light_color)
    except (ValueError, RuntimeError) as error:
        raise input_error(path, error) from error
    return separated, [*frames[0].notes, *separated.report["warnings"]]
