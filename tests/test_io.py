"""Raw formats of `polsep.io`: each is one reader and one line, and begins with any frame."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from polsep.io.raw.frames import READERS, Reader, ReadOptions, read_frames
from polsep.io.raw.page import Page


def test_a_raw_format_is_one_reader_and_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader of a new format in `READERS` is all that `read_frames` needs."""

    def read_text(path: Path, first: int) -> Iterator[Page]:
        yield Page(np.loadtxt(path, dtype=np.uint16), white_level=4095)

    monkeypatch.setitem(READERS, ".txt", Reader("text", read_text))
    codes = np.arange(64).reshape(8, 8)
    np.savetxt(tmp_path / "shot.txt", codes, fmt="%d")
    (frame,) = read_frames(tmp_path / "shot.txt", ReadOptions(black_level=8))
    assert (frame.stem, frame.data.white_level, frame.data.black_level) == ("shot", 4095, 8)
    np.testing.assert_array_equal(frame.data.data, codes)


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".tiff", ".raw"])
def test_stacks_are_read_from_any_frame_on(tmp_path: Path, suffix: str) -> None:
    """The frames from ``first`` on are those of a reading from the beginning."""
    import tifffile

    codes = np.random.default_rng(0).integers(0, 255, (5, 8, 8)).astype(np.uint8)
    path = tmp_path / f"shots{suffix}"
    if suffix == ".npy":
        np.save(path, codes)
    elif suffix == ".npz":
        np.savez(path, raw=codes)
    elif suffix == ".tiff":
        tifffile.imwrite(path, codes, photometric="minisblack")
    else:
        path.write_bytes(codes.tobytes())
    options = ReadOptions(size=(8, 8), pixel_format="Mono8") if suffix == ".raw" else None
    for first in range(6):
        frames = list(read_frames(path, options, first))
        assert [(frame.index, frame.count) for frame in frames] == [(k, 5) for k in range(first, 5)]
        assert [frame.stem for frame in frames] == [f"shots_{k:04d}" for k in range(first, 5)]
        for frame in frames:
            np.testing.assert_array_equal(frame.data.data, codes[frame.index])
