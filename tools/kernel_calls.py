"""Calls of all kernels that the library shall hold, with every combination of types that polsep calls them with.

Kernels for rendering are not among them: who renders needs other large libraries anyway, and the fastest code there is
for the machine at hand.
"""

from __future__ import annotations

import numpy as np
import torch

from polsep import kernels
from polsep.edit.blur_kernel import filter_image
from polsep.geometry.integration_kernel import Places, Wanted, fill_system, fill_weights
from polsep.io.results.exr import half_rows, zip_rows
from polsep.io.results.pixels_kernel import code_planes
from polsep.networks.guide import guide_batch
from polsep.networks.whole_frame_kernel import thumbnail_of
from polsep.sensor.calibration import neighbours
from polsep.sensor.calibration_kernel import mix_neighbours
from polsep.sensor.camera import Layout
from polsep.separation.color_affine_kernel import (
    ColorAffineOptions,
    separate_color_affine_full,
    separate_color_affine_half,
)
from polsep.video.panels_kernel import STEPS, make_panels


def call_kernels() -> None:
    """Call every kernel."""
    kernels.warm_up()
    _separate_clipped()
    _guide()
    _edit()
    _integrate()
    _write()


def _separate_clipped() -> None:
    """A frame with pixels of which some, and of which all samples clip."""
    raw = np.eye(64, dtype=np.float32)
    raw[16:32, 16:32] = 1
    for guided in (False, True):
        for separate in (separate_color_affine_half, separate_color_affine_full):
            separate(raw, Layout(), 0, 1, ColorAffineOptions(guided=guided, report=True))


def _guide() -> None:
    guide_batch(torch.zeros(1, 1, 32, 32), Layout())
    thumbnail_of(np.zeros((64, 64), np.uint16), Layout(), (0.0, 1.0), (1.0, 1.0, 1.0))
    near = neighbours(8, 0, 4)
    mix_neighbours(np.zeros((8, 8), np.float32), np.float32(0), near, near, np.zeros((4, 4, 4), np.float32))


def _edit() -> None:
    image = np.zeros((4, 4, 3), np.float32)
    filter_image(image, np.ones(3, np.float32))
    make_panels((image, image), 1.0, np.zeros(STEPS + 1, np.uint8), 4)


def _integrate() -> None:
    places = Places(np.full((1, 4), -1, np.int32), np.zeros(2, np.int32))
    wanted = Wanted(np.ones(1), np.zeros((2, 1)))
    fill_weights(np.zeros(1), places, wanted, 1.0, np.zeros((2, 1)))
    fill_system(places, wanted, np.zeros((2, 1)), np.zeros(1), np.zeros(1))


def _write() -> None:
    image = np.zeros((1, 8, 3), np.float32)
    zip_rows(half_rows([image]), 8)
    code_planes(image, 1.0)
