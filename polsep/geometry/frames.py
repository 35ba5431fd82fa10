"""One raw frame of a file, separated: the input of `polsep shape` and `polsep geometry` besides separated files."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

from polsep.io.raw.frames import ReadOptions, read_frames, refuse_forgotten
from polsep.io.store.errors import input_error
from polsep.pipeline import LightColor, separate_capture
from polsep.separation.report import SeparatedFrame


def separate_file(
    path: Path, read: ReadOptions, method: str, light_color: LightColor | str = "auto"
) -> tuple[SeparatedFrame, list[str]]:
    """The only frame of a raw file, separated, and notes for the user, a line each: on the file and on the frame.

    Of a file of several frames two are read. Raises InputError on it, and on what cannot be read or separated.
    """
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
