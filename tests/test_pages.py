"""Memory of images that nobody holds any more is used again, and no other."""

from __future__ import annotations

import gc
import subprocess
import sys

import numpy as np
import pytest

from polsep.compute import pages

SHAPE = (600, 700, 3)


@pytest.fixture(autouse=True)
def _none_waits() -> None:
    gc.collect()
    pages._WAITING.clear()


def place(array: np.ndarray) -> int:
    return int(array.__array_interface__["data"][0])


def test_memory_is_used_again_once_nobody_holds_a_view_of_it() -> None:
    first = pages.empty(SHAPE, np.float32)
    first[:] = 1
    here, view = place(first), first[5:, ::2].T[1:]
    del first
    other = pages.empty(SHAPE, np.float32)
    other[:] = 2
    assert place(other) != here and bool((view == 1).all())
    del view
    assert place(pages.empty(SHAPE, np.float32)) == here


def test_images_are_arrays_like_others() -> None:
    for dtype in (np.float32, np.bool_, np.uint8):
        image = pages.empty(SHAPE, dtype)
        assert image.shape == SHAPE and image.dtype == dtype
        assert image.flags.c_contiguous and image.flags.writeable and image.flags.aligned
    assert pages.empty((0, 4), np.float32).shape == (0, 4)


def test_no_more_waits_than_it_may(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pages, "MOST", 3 * pages.LEAST)
    images = [pages.empty((pages.LEAST,), np.uint8) for _ in range(5)]
    images.clear()
    assert sum(memory.nbytes for waiting in pages._WAITING.values() for memory in waiting) <= pages.MOST


def test_a_program_that_ends_with_images_ends_silently() -> None:
    code = "import numpy, polsep; out = polsep.separate(numpy.eye(1024, dtype=numpy.float32), 'analytic')"
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=True)
    assert not done.stderr


def test_memory_beyond_all_that_may_wait_is_given_back() -> None:
    """A huge array's memory waits for no other one."""
    size = pages.MOST + 1
    array = pages.empty((size,), np.uint8)
    del array
    assert not pages._WAITING.get(size)
