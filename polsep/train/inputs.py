"""Inputs of the networks, and the truth, from a batch of training examples.

Conventions: linear light, 1 = the white level of one measurement; true diffuse and specular are s0; a half-resolution
truth is the mean over each cell of 2 x 2 pixels, and a cell is in the mask if all of its pixels are.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple, TypeVar

from torch import Tensor
from torch.nn.functional import avg_pool2d

from polsep.demosaic.bilinear import demosaic_bilinear_half, interpolate_analysers_half
from polsep.physics.stokes import Measurements, Stokes, measure
from polsep.render.simulate import whole_cells
from polsep.sensor.camera import Layout, Mosaic
from polsep.train.stream import ANGLES, MONO, Examples, expose_mono


class LadderInputs(NamedTuple):
    """Co-registered analysers for the paper's networks, true images ``[B, C, h, w]`` and the ``mask [B, h, w]``."""

    measurements: Measurements
    diffuse: Tensor
    specular: Tensor
    mask: Tensor


class JointInputs(NamedTuple):
    """Samples ``raw``, ``clipped [B, 1, H, W]`` behind the filters of ``layout``, white = 1, and the truth.

    ``diffuse [B, C, H/2, W/2]``, ``specular [B, 1, H/2, W/2]`` and the ``mask`` are what is scored; ``full_diffuse``,
    ``full_specular`` and ``weight [B, 1, H, W]``, 1 on objects, are the same at full resolution. ``polarized``: s1 and
    s2 ``[B, 2 C, H, W]``. ``thumbnail``, ``light``: as in `Examples`.
    """

    raw: Tensor
    clipped: Tensor
    diffuse: Tensor
    specular: Tensor
    mask: Tensor
    layout: Layout
    full_diffuse: Tensor
    full_specular: Tensor
    weight: Tensor
    polarized: Tensor
    thumbnail: Tensor
    light: Tensor


Inputs = TypeVar("Inputs", bound=LadderInputs | JointInputs)


def mosaic_inputs(examples: Examples) -> LadderInputs:
    """Return noisy mosaics, demosaicked bilinearly to half resolution, and the mean truth of every cell."""
    diffuse, specular = (avg_pool2d(x.float(), 2).expand(-1, 3, -1, -1) for x in (examples.diffuse, examples.specular))
    measurements = demosaic_lit(examples.raw, examples.clipped, Layout())
    return LadderInputs(measurements, diffuse, specular, whole_cells(examples.mask))


def demosaic_lit(raw: Tensor, clipped: Tensor, layout: Layout) -> Measurements:
    """Samples ``[N, H, W]`` whose lamp was divided out, demosaicked to half resolution; ``clipped``: before that."""
    found = demosaic_bilinear_half(Mosaic(raw, layout, 0.0, 1.0))
    return replace(found, clipped=interpolate_analysers_half(clipped.float(), layout) > 0)


def mono_inputs(examples: Examples) -> LadderInputs:
    """Return `mosaic_inputs` of a camera without colour filters."""
    mono = expose_mono(examples)
    diffuse, specular = (avg_pool2d(x, 2) for x in (mono.diffuse, mono.specular))
    measurements = demosaic_bilinear_half(Mosaic(mono.raw, MONO, 0.0, 1.0))
    return LadderInputs(measurements, diffuse, specular, whole_cells(mono.mask))


def co_sited_inputs(examples: Examples) -> LadderInputs:
    """Return the paper's protocol: every analyser and colour at every pixel, clipped at 1, no noise (Eqs. 12, 13)."""
    diffuse, specular, polarized = (x.float() for x in (examples.diffuse, examples.specular, examples.polarized))
    specular = specular.expand(-1, 3, -1, -1)
    light = Stokes(diffuse + specular, polarized[:, :3], polarized[:, 3:])
    exact = measure(light, ANGLES).data
    return LadderInputs(Measurements(exact.clamp(max=1), ANGLES, exact >= 1), diffuse, specular, examples.mask)


def joint_inputs(examples: Examples) -> JointInputs:
    """Return noisy colour mosaics as they are, for the joint network."""
    diffuse, specular, polarized = (x.float() for x in (examples.diffuse, examples.specular, examples.polarized))
    return _joint_inputs(examples._replace(diffuse=diffuse, specular=specular, polarized=polarized), Layout())


def joint_mono_inputs(examples: Examples) -> JointInputs:
    """Return noisy mosaics of a camera without colour filters, for the joint network."""
    return _joint_inputs(expose_mono(examples), MONO)


def _joint_inputs(examples: Examples, layout: Layout) -> JointInputs:
    return JointInputs(
        examples.raw[:, None],
        examples.clipped[:, None],
        avg_pool2d(examples.diffuse, 2),
        avg_pool2d(examples.specular, 2),
        whole_cells(examples.mask),
        layout,
        examples.diffuse,
        examples.specular,
        examples.mask[:, None].float(),
        examples.polarized,
        examples.thumbnail,
        examples.light,
    )
