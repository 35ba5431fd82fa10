"""The rungs of the ladder: what the paper's networks see of a frame, and how their images become a separation.

A rung says what its networks see of a frame's co-registered analysers; all rungs have the same two networks, DiffUNet
for tau_d and SpecUNet for log(1 + tau_s), but for one with both in a single net. Conventions: linear white light;
analysers ``[N, 4, C, h, w]``, inputs ``[N, K, h, w]``. Source: Dave et al. 2022, Sec. 4.3 and Table 2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from polsep.compute.arrays import Array, namespace
from polsep.physics.stokes import Measurements, Stokes, fit_stokes, polarized_intensity
from polsep.separation.analytic import Separation, separate_analytic

Inputs = Callable[[Measurements], Array]
#: Networks: inputs ``[N, K, h, w]`` to tau_d and log(1 + tau_s), ``[N, C, h, w]`` each.
Refine = Callable[[Array], tuple[Array, Array]]

#: Polarized light below this share of the white level has no angle: its cosine tends to 0.
MIN_POLARIZED = 1e-6


def analytic_inputs(measurements: Measurements) -> Array:
    """tau_d and log(1 + tau_s) of the analytic split and cos(2 phi), of every colour (Sec. 4.3, inputs 1 to 3)."""
    return _join(split_inputs(measurements), _cosine(fit_stokes(measurements)))


def split_inputs(measurements: Measurements) -> Array:
    """`analytic_inputs` without the angle (Table 2, ablation 2)."""
    found = separate_analytic(measurements)
    return _join(found.diffuse, namespace(found.specular).log1p(found.specular))


def signed_inputs(measurements: Measurements) -> Array:
    """`analytic_inputs` and sin(2 phi), which tells phi from -phi; not in the paper."""
    stokes = fit_stokes(measurements)
    return _join(split_inputs(measurements), _cosine(stokes), _over_polarized(stokes.s2, stokes))


def stokes_inputs(measurements: Measurements) -> Array:
    """s0, s1, s2 of every colour (Table 2, ablation 3)."""
    stokes = fit_stokes(measurements)
    return _join(stokes.s0, stokes.s1, stokes.s2)


def polarized_inputs(measurements: Measurements) -> Array:
    """The four polarized images (baseline 3)."""
    data = measurements.data
    return namespace(data).reshape(data, (*data.shape[:-4], -1, *data.shape[-2:]))


def unpolarized_inputs(measurements: Measurements) -> Array:
    """s0 of every colour, what a camera without polarizers sees (baseline 2)."""
    return fit_stokes(measurements).s0


def _cosine(stokes: Stokes) -> Array:
    return _over_polarized(stokes.s1, stokes)


def _over_polarized(component: Array, stokes: Stokes) -> Array:
    return component / namespace(component).clip(polarized_intensity(stokes), min=MIN_POLARIZED)


def _join(*images: Array) -> Array:
    """Images beside each other along the channels."""
    return namespace(images[0]).concat(images, axis=-3)


@dataclass(frozen=True)
class Rung:
    """One rung: its ``inputs``, and whether diffuse and specular ``share`` one network.

    ``start``: weights of the inputs of a colour, of which there are so many, that make the first guess of its tau_d and
    of its log(1 + tau_s): the analytic split where a rung sees it, else all light as diffuse. ``basis``: an invertible
    matrix that its networks see the inputs of a colour through, so that small differences are not lost beside what all
    inputs share; None for the inputs as they are.
    """

    name: str
    inputs: Inputs
    start: tuple[tuple[float, ...], tuple[float, ...]]
    share: bool
    summary: str
    basis: tuple[tuple[float, ...], ...] | None = None

    @property
    def per_color(self) -> int:
        """Inputs per colour."""
        return len(self.start[0])


RUNGS = {
    rung.name: rung
    for rung in (
        Rung("paper", analytic_inputs, ((1, 0, 0), (0, 1, 0)), False, "analytic split and angle, two networks"),
        Rung("unpolarized", unpolarized_inputs, ((1,), (0,)), False, "CNN on the unpolarized image"),
        Rung(
            "polarized",
            polarized_inputs,
            ((0.5,) * 4, (0,) * 4),
            False,
            "CNN on the four polarized images",
            ((0.25, 0.25, 0.25, 0.25), (2, 0, -2, 0), (0, 2, 0, -2), (2, -2, 2, -2)),
        ),
        Rung("shared", analytic_inputs, ((1, 0, 0), (0, 1, 0)), True, "one network for both outputs"),
        Rung("signed", signed_inputs, ((1, 0, 0, 0), (0, 1, 0, 0)), False, "as paper, with the angle's sine too"),
        Rung("no-angle", split_inputs, ((1, 0), (0, 1)), False, "analytic split without the angle"),
        Rung(
            "stokes",
            stokes_inputs,
            ((1, 0, 0), (0, 0, 0)),
            False,
            "Stokes maps instead of the analytic split",
            ((0.5, 0, 0), (0, 2, 0), (0, 0, 2)),
        ),
    )
}


def separate_refined(measurements: Measurements, rung: Rung, refine: Refine) -> Separation:
    """Diffuse and specular of ``[..., 4, C, h, w]`` as the networks ``refine`` see them; negative values are cut to 0.

    ``stokes`` and ``valid`` are those of the analytic split: the networks say nothing of polarization, and nothing
    makes their outputs sum to s0.
    """
    batch = measurements.data.shape[:-4]
    inputs = rung.inputs(measurements)
    xp = namespace(inputs)
    diffuse, logarithm = refine(xp.reshape(inputs, (-1, *inputs.shape[-3:])))
    with np.errstate(over="ignore"):  # of frames far above the white level; the pipeline refuses infinite images
        images = [xp.reshape(x, (*batch, *x.shape[-3:])) for x in (diffuse, xp.expm1(logarithm))]
    diffuse, specular = (xp.clip(x, min=0) for x in images)
    seen = separate_analytic(measurements)
    return Separation(diffuse, specular, seen.valid, seen.stokes)
