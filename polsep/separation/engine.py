"""The compiled kernels of methods: what takes the place of torch for one frame on the CPU at half resolution.

An engine maps a `Mosaic` to separated images with a tally, or to None where its kernel does not take such a frame. Its
results are those of the method's functions in torch to rounding. Kernels, and numba with them, are loaded when the
first frame comes; code that was never compiled on this machine is compiled then, which the logger ``polsep`` says.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from functools import lru_cache

import torch

from polsep.demosaic.guided import MIN_CELLS
from polsep.sensor.camera import Layout, Mosaic
from polsep.separation.images import FrameImages

#: Loading compiled code takes less than this many seconds, also on a busy machine; compiling it takes more.
PATIENCE = 6.0

#: Samples that kernels read.
_DTYPES = (torch.uint8, torch.uint16, torch.float32)


def run_analytic(mosaic: Mosaic) -> FrameImages | None:
    """`kernels.separate_analytic_half` of one frame, in its light, for a report; None for batches and other devices."""
    if not _is_plain(mosaic):
        return None
    make_ready(_try_analytic)
    return _run_analytic(mosaic)


def run_color_affine(mosaic: Mosaic) -> FrameImages | None:
    """`kernels.separate_color_affine_half`, guided, as `run_analytic`; None also for mono and very small frames."""
    if not _is_plain(mosaic) or mosaic.layout.channels != 3 or min(_cells(mosaic)) < MIN_CELLS:
        return None
    make_ready(_try_color_affine)
    return _run_color_affine(mosaic)


def _run_analytic(mosaic: Mosaic) -> FrameImages:
    from polsep.kernels import AnalyticOptions, separate_analytic_half

    options = AnalyticOptions(mosaic.light_color, in_light=True, report=True)
    return separate_analytic_half(mosaic.data.numpy(), mosaic.layout, mosaic.black_level, mosaic.white_level, options)


def _run_color_affine(mosaic: Mosaic) -> FrameImages:
    from polsep.kernels import ColorAffineOptions, separate_color_affine_half

    options = ColorAffineOptions(mosaic.light_color, in_light=True, guided=True, report=True)
    return separate_color_affine_half(
        mosaic.data.numpy(), mosaic.layout, mosaic.black_level, mosaic.white_level, options
    )


def _is_plain(mosaic: Mosaic) -> bool:
    """One frame in the computer's own memory, in samples that kernels read."""
    data = mosaic.data
    return data.ndim == 2 and data.device.type == "cpu" and data.dtype in _DTYPES and not data.requires_grad


def _cells(mosaic: Mosaic) -> tuple[int, ...]:
    """Rows and columns of whole polarizer cells."""
    return tuple((n - start) // 2 for n, start in zip(mosaic.data.shape, mosaic.layout.origin, strict=True))


def _try_analytic() -> None:
    _run_analytic(_tiny_frame())


def _try_color_affine() -> None:
    _run_color_affine(_tiny_frame())


def _tiny_frame() -> Mosaic:
    """With clipped samples."""
    return Mosaic(torch.eye(2 * MIN_CELLS, dtype=torch.float32), Layout(), 0.0, 1.0)


@lru_cache
def make_ready(warm_up: Callable[[], object]) -> None:
    """Load or compile what a method needs by ``warm_up``, the first time only; says so once it takes long."""
    import polsep.kernels  # noqa: F401  # its import is not what takes long

    notice = threading.Timer(
        PATIENCE,
        logging.getLogger("polsep").warning,
        ("compiling this method for this machine, once: up to a minute or two",),
    )
    notice.daemon = True
    notice.start()
    try:
        warm_up()
    finally:
        notice.cancel()


def run_nothing(mosaic: Mosaic) -> None:
    """The engine of methods that have none: torch does the work."""
    del mosaic
