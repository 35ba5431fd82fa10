"""The fused CPU twins of the hot path, compiled by numba, and nothing else.

Every kernel computes what a readable torch function computes, which its docstring names and a test compares. Importing
this room imports numba; ``import polsep`` does not.
"""

from __future__ import annotations

from polsep.compute.threads import get_threads, set_threads
from polsep.networks import details_kernel as joint_details
from polsep.networks import images_kernel as joint_images
from polsep.sensor.unpack_kernel import PackedFrame
from polsep.separation import analytic_kernel as analytic
from polsep.separation import color_affine_kernel as color_affine
from polsep.separation.analytic_kernel import AnalyticOptions, separate_analytic_half
from polsep.separation.color_affine_kernel import ColorAffineOptions, separate_color_affine_half
from polsep.separation.images import FrameImages
from polsep.video import temporal_kernel as temporal

#: The images of a frame, as streams of either method name them.
AnalyticImages = ColorAffineImages = FrameImages

__all__ = [
    "AnalyticImages",
    "AnalyticOptions",
    "ColorAffineImages",
    "ColorAffineOptions",
    "PackedFrame",
    "get_threads",
    "separate_analytic_half",
    "separate_color_affine_half",
    "set_threads",
    "warm_up",
]


def warm_up() -> None:
    """Compile every kernel, or load it from numba's cache: half a minute the first time on a machine, then a second."""
    analytic.warm_up()
    color_affine.warm_up()
    joint_images.warm_up()
    joint_details.warm_up()
    temporal.warm_up()
