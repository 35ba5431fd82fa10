"""The fused CPU twins of the hot path, compiled, and nothing else.

Every kernel computes what a readable function computes, which its docstring names and a test compares.
"""

from __future__ import annotations

from collections.abc import Iterable
from numbers import Real

from polsep.compute.arguments import WrongType
from polsep.compute.threads import get_threads, set_threads
from polsep.light import color_kernel, tiles_kernel
from polsep.networks import combine_kernel, details_kernel, images_kernel
from polsep.sensor import defects_kernel, periods_kernel
from polsep.sensor.camera import Layout
from polsep.sensor.unpack_kernel import PackedFrame, RawFrame
from polsep.separation import (
    analytic_kernel,
    clipped_pattern_kernel,
    color_affine_kernel,
    highlights_kernel,
    places_kernel,
)
from polsep.separation.analytic_kernel import AnalyticOptions
from polsep.separation.color_affine_kernel import ColorAffineOptions
from polsep.separation.images import FrameImages
from polsep.video import temporal_kernel

#: The images of a frame, as streams of either method name them.
AnalyticImages = ColorAffineImages = FrameImages

__all__ = [
    "AnalyticImages",
    "AnalyticOptions",
    "ColorAffineImages",
    "ColorAffineOptions",
    "PackedFrame",
    "get_threads",
    "separate_analytic_full",
    "separate_analytic_half",
    "separate_color_affine_full",
    "separate_color_affine_half",
    "set_threads",
    "warm_up",
]


def separate_analytic_half(
    raw: RawFrame, layout: Layout, black_level: float, white_level: float, options: AnalyticOptions | None = None
) -> FrameImages:
    """Diffuse and specular of one raw mosaic, at half resolution, by the paper's first estimate.

    ``raw``: ``[H, W]`` uint8, uint16, float32, or a `PackedFrame`; levels in its units. Images are ``[h, w, C]`` with
    h and w the whole 2x2 cells from the layout's origin on, in white light unless ``options`` say otherwise. A frame
    whose rows are not contiguous is copied first. Nothing is looked for or repaired, unlike by `polsep.separate`.
    Raises ValueError on another dtype or shape, levels out of order, or images in ``options.out`` that do not fit; of
    wrong types it is also a TypeError.
    Source: Dave et al. 2022, Eqs. 15-18.
    """
    _require_types(layout, (black_level, white_level), options)
    return analytic_kernel.separate_analytic_half(raw, layout, black_level, white_level, options)


def separate_analytic_full(
    raw: RawFrame, layout: Layout, black_level: float, white_level: float, options: AnalyticOptions | None = None
) -> FrameImages:
    """`separate_analytic_half` at full resolution: images ``[H, W, C]`` of all pixels of whole cells."""
    _require_types(layout, (black_level, white_level), options)
    return analytic_kernel.separate_analytic_full(raw, layout, black_level, white_level, options)


def separate_color_affine_half(
    raw: RawFrame, layout: Layout, black_level: float, white_level: float, options: ColorAffineOptions | None = None
) -> FrameImages:
    """Diffuse and white specular of one raw colour mosaic, at half resolution, by the colour-affine closed form.

    As `separate_analytic_half`, of colour layouts alone: images are ``[h, w, 3]``. Pixels with clipped samples are
    solved, and where too few are left filled, as in `polsep.separation.color_affine`.
    """
    _require_types(layout, (black_level, white_level), options, ColorAffineOptions)
    return color_affine_kernel.separate_color_affine_half(raw, layout, black_level, white_level, options)


def separate_color_affine_full(
    raw: RawFrame, layout: Layout, black_level: float, white_level: float, options: ColorAffineOptions | None = None
) -> FrameImages:
    """`separate_color_affine_half` at full resolution: images ``[H, W, 3]`` of all pixels of whole cells."""
    _require_types(layout, (black_level, white_level), options, ColorAffineOptions)
    return color_affine_kernel.separate_color_affine_full(raw, layout, black_level, white_level, options)


def _require_types(
    layout: object,
    levels: tuple[object, object],
    options: AnalyticOptions | ColorAffineOptions | None,
    kind: type = object,
) -> None:
    """Raise WrongType unless a frame's layout, its black and white levels and options are what they are said to be."""
    if not isinstance(layout, Layout):
        raise WrongType(f'expected a polsep.Layout, such as Layout.parse("color"), found {layout!r:.40}')
    for name, level in zip(("black_level", "white_level"), levels, strict=True):
        if not isinstance(level, Real):
            raise WrongType(f"expected a number as {name}, found {level!r:.40}")
    if options is None:
        return
    if not isinstance(options, AnalyticOptions | ColorAffineOptions) or not isinstance(options, kind):
        wanted = (AnalyticOptions if kind is object else kind).__name__
        raise WrongType(f"expected {wanted}, found {type(options).__name__}")
    light, out = options.light_color, options.out
    if not isinstance(light, Iterable) or not all(isinstance(gain, Real) for gain in light):
        raise WrongType(f"expected light_color as one number per colour, found {light!r:.40}")
    if not isinstance(out, FrameImages | None):
        raise WrongType(
            f"expected out as images, such as AnalyticImages.empty(shape, layout), found {type(out).__name__}"
        )


def warm_up() -> None:
    """Load what `separate` and streams use; where the library has no code for the machine, compile it: two minutes."""
    kernels = (
        analytic_kernel,
        color_affine_kernel,
        images_kernel,
        details_kernel,
        combine_kernel,
        temporal_kernel,
        periods_kernel,
        defects_kernel,
        tiles_kernel,
        color_kernel,
        places_kernel,
        highlights_kernel,
        clipped_pattern_kernel,
    )
    for kernel in kernels:
        kernel.warm_up()
    analytic_kernel.warm_up_full()
    color_affine_kernel.warm_up_full()
