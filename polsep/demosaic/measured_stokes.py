"""Stokes images as a frame's samples show them, for files: the same whatever method separates the frame.

Colour mosaics are demosaicked with an intensity guide (`guided.guide_once`) to half resolution; to full resolution,
where the guide knows polarization as a mean over colours alone, and mono or tiny ones bilinearly. Co-sited samples are
taken as they are, and so are clipped ones: where samples clip, s0 is a lower bound, and s1, s2 are off. The light's
colour is divided out before demosaicking and multiplied back, as for images (docs/conventions.md).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from polsep.compute.arrays import namespace, to_numpy
from polsep.compute.threads import get_threads, run_over_rows
from polsep.demosaic.bilinear import interpolate_analysers, interpolate_analysers_half
from polsep.demosaic.bilinear_kernel import read_pattern
from polsep.demosaic.cells_kernel import Source, read_grid
from polsep.demosaic.guided import is_large_enough
from polsep.demosaic.guided_kernel import demosaic_rows, open_stream
from polsep.physics.stokes import Measurements, complete_pair, fit_stokes, is_pair, stokes_inverse
from polsep.sensor.camera import Capture, Mosaic
from polsep.sensor.unpack_kernel import as_samples

Floats = NDArray[np.float32]
#: Largest number of stretches of rows that threads share: each computes some rows above its own once more.
_STRETCHES = 4


def measured_stokes(capture: Capture, light: tuple[float, ...], full: bool = False) -> Floats:
    """s0, s1, s2 of one frame ``[3, h, w, C]``, in the light whose colour has so many gains; 1.0 as in `Stokes`.

    Half resolution is that of images: means over 2x2 cells. Of s1 and s2 the signs are those of docs/conventions.md.
    """
    if isinstance(capture, Mosaic):
        white = replace(capture, data=to_numpy(capture.data), light_color=light)
        if white.layout.channels == 3 and not full and is_large_enough(white):
            return _guided_half(white) * np.array(light, np.float32)
        interpolate = interpolate_analysers if full else interpolate_analysers_half
        gains = np.array(light, np.float32)[:, None, None]
        samples = Measurements(interpolate(white.linear(), white.layout) * gains, white.layout.angles)
    else:
        samples = complete_pair(capture) if is_pair(capture) else capture
    found = fit_stokes(samples)
    xp = namespace(found.s0)
    images = xp.moveaxis(xp.stack([found.s0, found.s1, found.s2]), -3, -1)
    return np.ascontiguousarray(to_numpy(images), np.float32)


def _guided_half(mosaic: Mosaic) -> Floats:
    """`guided.guide_once` of a colour mosaic ``[H, W]`` in white light, by its kernel: ``[3, h, w, 3]``."""
    data, layout = mosaic.data, mosaic.layout
    frame = data if data.dtype in (np.uint8, np.uint16, np.float32) else data.astype(np.float32)
    shape = (frame.shape[0], frame.shape[1])
    pattern = read_pattern(shape, layout, mosaic.black_level, mosaic.white_level, mosaic.light_color)
    grid = read_grid(pattern, layout.angles, stokes_inverse(layout.angles).astype(np.float32))
    source = Source(as_samples(np.ascontiguousarray(frame)), pattern, grid)
    rows = np.empty((pattern.h, 9, pattern.w), np.float32)

    def demosaic(row_range: tuple[int, int]) -> None:
        first, last = row_range
        demosaic_rows(source, open_stream(source, first, apart=True), row_range, rows[first:last])

    stretch = -(-pattern.h // min(_STRETCHES, get_threads()))
    run_over_rows(demosaic, pattern.h, stretch + stretch % 2)
    return np.ascontiguousarray(rows.reshape(pattern.h, 3, 3, pattern.w).transpose(1, 0, 3, 2))
