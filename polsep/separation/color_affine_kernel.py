"""Twins of ``separate_color_affine(demosaic_bilinear_half(mosaic))`` and full resolution, in one pass over the frame.

With ``guided`` they are twins of the same after guided demosaicking, which the pipeline uses.

Pixels with clipped samples are few: `separation.strips_kernel` leaves them out of the diffuse polarization as the twin
does, and `separation.clipped_kernel` solves them afterwards. Strips are computed independently of each other, so the
number of threads (`set_threads`) does not change a bit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from polsep.compute import pages
from polsep.compute.threads import RowRange, get_threads, run_over_rows
from polsep.demosaic.bilinear_kernel import read_pattern
from polsep.demosaic.cells_kernel import EDGE, Source, read_grid
from polsep.demosaic.guided_full_kernel import FULL_EDGE
from polsep.physics.stokes import Measurements, analyser_residual, stokes_inverse, unclipped_inverse
from polsep.sensor.camera import Layout
from polsep.sensor.unpack_kernel import RawFrame, as_samples
from polsep.separation.clipped_kernel import (
    ALL_CLIPPED,
    Pixels,
    fill_pixels,
    make_pixels,
    raise_cores,
    solve_pixels,
    tally_pixels,
)
from polsep.separation.fill_kernel import halve_separation, halve_specular, interpolate_holes
from polsep.separation.images import FrameImages, Tally
from polsep.separation.images_kernel import check_images
from polsep.separation.moments_kernel import Conversion
from polsep.separation.strips_full_kernel import (
    Frame,
    collect_pixels,
    separate_guided_pixel_strip,
    separate_pixel_strip,
)
from polsep.separation.strips_kernel import Targets, collect, rows_clip, separate_guided_strip, separate_strip
from polsep.separation.tally_kernel import NOISE, make_tally

#: Fewest cell rows of a strip that is worth a thread.
MIN_ROWS = 64
#: Pixels with clipped samples that one thread solves at a time.
PIXELS = 1024


@dataclass(frozen=True)
class ColorAffineOptions:
    """Options that all frames of a stream share, besides layout and levels.

    ``light_color``: one gain per channel, divided out of every sample, as in `Mosaic`. ``in_light``: multiply it back
    into diffuse and specular, as the pipeline does. ``out``: images to fill. ``guided``: demosaic as
    `guided.demosaic_guided_half`, a third as fast. ``report``: fill dolp, aolp and tally.
    """

    light_color: tuple[float, ...] = (1.0, 1.0, 1.0)
    in_light: bool = False
    out: FrameImages | None = None
    guided: bool = False
    report: bool = False


def separate_color_affine_half(
    raw: RawFrame,
    layout: Layout,
    black_level: float,
    white_level: float,
    options: ColorAffineOptions | None = None,
) -> FrameImages:
    """Diffuse and white specular of one raw colour mosaic, at half resolution, by the colour-affine closed form.

    ``raw``: ``[H, W]`` uint8, uint16, float32, or a `PackedFrame`; levels in its units. Images are ``[h, w, 3]`` with
    h and w the whole 2x2 cells from the layout's origin on, in white light unless ``options`` say otherwise. Pixels
    with clipped samples are solved, and where too few are left filled, as in `polsep.separation.color_affine`. Raises
    ValueError on a mono layout, another dtype or shape, levels out of order, or images in ``options.out`` that do not
    fit.
    """
    return _separate(raw, layout, (black_level, white_level), options or ColorAffineOptions(), False)


def separate_color_affine_full(
    raw: RawFrame,
    layout: Layout,
    black_level: float,
    white_level: float,
    options: ColorAffineOptions | None = None,
) -> FrameImages:
    """`separate_color_affine_half` at full resolution: images ``[H, W, 3]`` of all pixels of whole cells."""
    return _separate(raw, layout, (black_level, white_level), options or ColorAffineOptions(), True)


def _separate(
    raw: RawFrame, layout: Layout, levels: tuple[float, float], options: ColorAffineOptions, full: bool
) -> FrameImages:
    """One frame at half or ``full`` resolution; ``levels``: black and white."""
    if layout.channels != 3:
        raise ValueError(f"expected a colour layout, found {layout.spec!r}; mono frames have separate_analytic_half")
    samples, shape = as_samples(raw), (raw.shape[0], raw.shape[1])
    pattern = read_pattern(shape, layout, *levels, options.light_color)
    out = FrameImages.empty(shape, layout, options.report, full) if options.out is None else options.out
    h, w = (2 * pattern.h, 2 * pattern.w) if full else (pattern.h, pattern.w)
    dolp, aolp = check_images(out, (h, w, 3), options.report)
    height = strip_height(pattern.h)
    clips = any(run_over_rows(partial(rows_clip, samples, pattern), pattern.h, height))
    lines, clipped = (
        pages.empty((4, h, w) if clips else (4, 0, 0), np.float32),
        np.zeros((h, w) if clips else (0, 0), np.uint16),
    )
    diffuse, specular = (image.reshape(h, 3 * w) for image in (out.diffuse, out.specular))
    targets = Targets(diffuse, specular, lines, clipped, dolp, aolp, np.zeros((dolp.shape[0], NOISE + 1)))
    gains = np.array(options.light_color[:3] if options.in_light else (1, 1, 1), np.float32)
    # Filling compares colours with each other, so with clipped samples the light is multiplied back afterwards.
    conversion = Conversion(*_matrices(layout), np.ones(3, np.float32) if clips else gains)
    inverse = conversion.inverses[0]
    source = Source(samples, pattern, read_grid(pattern, layout.angles, inverse, FULL_EDGE if full else EDGE))
    run: Callable[[RowRange], None]
    gather: Callable[..., None]
    if full:
        frame = Frame(source, pattern._replace(h=h, w=w))
        strip = separate_guided_pixel_strip if options.guided else separate_pixel_strip
        run, gather = partial(strip, frame, conversion, targets), partial(collect_pixels, frame)
    else:
        strip_of_cells = separate_guided_strip if options.guided else separate_strip
        run, gather = partial(strip_of_cells, source, conversion, targets), partial(collect, source)
    run_over_rows(run, pattern.h, height)
    out.valid[:] = True
    places = np.flatnonzero(clipped)
    tally = make_tally(h * w - places.size, 0, h * w - places.size, targets.sums)
    if places.size:
        tally += _complete(gather, layout, conversion.inverses, targets, places, out)
    if clips and options.in_light:
        for image in (diffuse, specular):
            image *= np.tile(gains, w)  # long rows: NumPy multiplies three numbers at a time slowly
    return replace(out, tally=tally) if options.report else out


def warm_up() -> None:
    """Load the kernels, or compile them. One compilation serves all dtypes and layouts."""
    for guided in (False, True):
        separate_color_affine_half(np.eye(8, dtype=np.uint8), Layout(), 0, 1, ColorAffineOptions(guided=guided))


def warm_up_full() -> None:
    """`warm_up` of the kernels for full resolution."""
    for guided in (False, True):
        separate_color_affine_full(np.eye(8, dtype=np.uint8), Layout(), 0, 1, ColorAffineOptions(guided=guided))


def strip_height(rows: int) -> int:
    """Cell rows of a strip, an even number: a share of all for each thread, as every strip starts with rows twice."""
    return max(MIN_ROWS, (-(-rows // get_threads()) + 1) // 2 * 2)


@lru_cache(maxsize=8)
def _matrices(layout: Layout) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.float32]]:
    """The matrices of `fit_stokes_unclipped`, which of them are exact, and the vector of `analyser_residual`."""
    full = stokes_inverse(layout.angles).astype(np.float32)
    inverses, exact = np.stack([full] * 16), np.zeros(16, np.bool_)
    exact[0] = True
    for code in range(1, 16):
        matrix, exact[code] = unclipped_inverse(layout.angles, code)
        if matrix is not None:
            inverses[code] = matrix
    unit = np.eye(4).reshape(4, 1, 1, 4)
    null = analyser_residual(Measurements(unit, layout.angles)).reshape(4).astype(np.float32)
    return inverses, exact, null


def _complete(
    gather: Callable[..., None],
    layout: Layout,
    inverses: NDArray[np.float32],
    targets: Targets,
    places: NDArray[np.int64],
    out: FrameImages,
) -> Tally:
    """Solve and fill the N pixels ``places`` with clipped samples, into ``out``; their sums.

    ``gather``: `collect` of the frame.
    """
    doubled, lines = 2 * np.array(layout.angles), targets.lines.reshape(4, -1)
    cosines, sines = np.cos(doubled).astype(np.float32), np.sin(doubled).astype(np.float32)
    pixels = make_pixels(targets.clipped.reshape(-1)[places], np.ascontiguousarray(lines[:, places]))
    run_over_rows(partial(gather, places, pixels.samples), places.size, PIXELS)
    run_over_rows(partial(solve_pixels, pixels, cosines, sines, inverses), places.size, PIXELS)
    lines[2:, places] = pixels.lines[2:]
    out.valid.reshape(-1)[places] = pixels.valid
    _write(pixels, places, out)
    if not pixels.valid.all():
        h, w = out.valid.shape
        holes = np.flatnonzero(~pixels.valid)
        # No name holds the pyramid, a third of the frame, when the next one is made.
        around = interpolate_holes(
            halve_separation(out.diffuse, out.specular, targets.lines, out.valid), (h, w), places[holes]
        )
        fill_pixels(pixels, cosines, sines, holes, around)
        _write(pixels, places, out)
        core = pixels.clipped == ALL_CLIPPED
        if core.any():
            outside = np.ones((h, w), np.bool_)
            outside.reshape(-1)[places[core]] = False
            rim = interpolate_holes(halve_specular(out.specular, outside), (h, w), places[core])
            raise_cores(pixels, np.flatnonzero(core), rim[0])
            _write(pixels, places, out)
    if not targets.sums.size:
        return Tally()
    dolp, aolp, sums = np.empty(places.size, np.float32), np.empty(places.size, np.float32), np.zeros((1, NOISE))
    tally_pixels(pixels, dolp, aolp, sums)
    targets.dolp.reshape(-1)[places], targets.aolp.reshape(-1)[places] = dolp, aolp
    return make_tally(places.size, places.size, int(pixels.valid.sum()), sums)


def _write(pixels: Pixels, places: NDArray[np.int64], out: FrameImages) -> None:
    """Put the colours of N pixels into the frame."""
    out.diffuse.reshape(-1, 3)[places] = pixels.diffuse.T
    out.specular.reshape(-1, 3)[places] = pixels.specular[:, None]
