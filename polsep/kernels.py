"""The fused CPU twins of the hot path, compiled, and nothing else.

Every kernel computes what a readable function computes, which its docstring names and a test compares.
"""

from __future__ import annotations

from polsep.compute.threads import get_threads, set_threads
from polsep.light import color_kernel, tiles_kernel
from polsep.networks import details_kernel, images_kernel
from polsep.sensor import defects_kernel, periods_kernel
from polsep.sensor.unpack_kernel import PackedFrame
from polsep.separation import (
    analytic_kernel,
    clipped_pattern_kernel,
    color_affine_kernel,
    highlights_kernel,
    places_kernel,
)
from polsep.separation.analytic_kernel import AnalyticOptions, separate_analytic_full, separate_analytic_half
from polsep.separation.color_affine_kernel import (
    ColorAffineOptions,
    separate_color_affine_full,
    separate_color_affine_half,
)
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


def warm_up() -> None:
    """Load what `separate` and streams use; where the library has no code for the machine, compile it: two minutes."""
    kernels = (
        analytic_kernel,
        color_affine_kernel,
        images_kernel,
        details_kernel,
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
