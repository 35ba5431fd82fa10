"""The paper's networks: U-Nets that refine an analytic split, and the rungs of the ladder they are compared with.

A rung says what its networks see of a frame's co-registered analysers; all rungs have the same two networks, DiffUNet
for tau_d and SpecUNet for log(1 + tau_s), but for one with both in a single net. Conventions: linear white light;
analysers ``[N, 4, C, h, w]``, inputs ``[N, K, h, w]``. Source: Dave et al. 2022, Sec. 4.3 and Table 2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d

from polsep.networks.unet import UNET64, Size, UNet
from polsep.physics.stokes import Measurements, Stokes, fit_stokes, polarized_intensity
from polsep.separation.analytic import Separation, separate_analytic

Inputs = Callable[[Measurements], Tensor]

#: Polarized light below this share of the white level has no angle: its cosine tends to 0.
MIN_POLARIZED = 1e-6


def analytic_inputs(measurements: Measurements) -> Tensor:
    """tau_d and log(1 + tau_s) of the analytic split and cos(2 phi), of every colour (Sec. 4.3, inputs 1 to 3)."""
    return torch.cat([split_inputs(measurements), _cosine(fit_stokes(measurements))], dim=-3)


def split_inputs(measurements: Measurements) -> Tensor:
    """`analytic_inputs` without the angle (Table 2, ablation 2)."""
    found = separate_analytic(measurements)
    return torch.cat([found.diffuse, torch.log1p(found.specular)], dim=-3)


def signed_inputs(measurements: Measurements) -> Tensor:
    """`analytic_inputs` and sin(2 phi), which tells phi from -phi; not in the paper."""
    stokes = fit_stokes(measurements)
    sine = stokes.s2 / polarized_intensity(stokes).clamp(min=MIN_POLARIZED)
    return torch.cat([split_inputs(measurements), _cosine(stokes), sine], dim=-3)


def stokes_inputs(measurements: Measurements) -> Tensor:
    """s0, s1, s2 of every colour (Table 2, ablation 3)."""
    stokes = fit_stokes(measurements)
    return torch.cat([stokes.s0, stokes.s1, stokes.s2], dim=-3)


def polarized_inputs(measurements: Measurements) -> Tensor:
    """The four polarized images (baseline 3)."""
    return measurements.data.flatten(-4, -3)


def unpolarized_inputs(measurements: Measurements) -> Tensor:
    """s0 of every colour, what a camera without polarizers sees (baseline 2)."""
    return fit_stokes(measurements).s0


def _cosine(stokes: Stokes) -> Tensor:
    return stokes.s1 / polarized_intensity(stokes).clamp(min=MIN_POLARIZED)


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


class Refinement(nn.Module):
    """The networks of a rung: inputs ``[N, K, h, w]`` to tau_d and log(1 + tau_s), ``[N, C, h, w]`` each.

    ``colors``: C, 3 or 1; ``size``: of each network. Note: the paper's networks write their images alone; here they add
    to a learned linear map of each pixel's inputs that starts at the rung's first guess. Without it a training of an
    hour on two cores stays behind the analytic split (docs/experiments.md).
    """

    basis: Tensor | None

    def __init__(self, rung: Rung, colors: int = 3, size: Size = UNET64) -> None:
        super().__init__()
        self.colors = colors
        inputs = rung.per_color * colors
        self.nets = nn.ModuleList(UNet(inputs, n, size) for n in ([2 * colors] if rung.share else [colors, colors]))
        self.linear = nn.Conv2d(inputs, 2 * colors, 1)
        weight = torch.zeros(2, colors, rung.per_color, colors)
        for color in range(colors):
            weight[:, color, :, color] = torch.tensor(rung.start)
        with torch.no_grad():
            self.linear.weight.copy_(weight.view(2 * colors, inputs, 1, 1))
        nn.init.zeros_(self.linear.bias)  # type: ignore[arg-type]
        basis = torch.eye(rung.per_color) if rung.basis is None else torch.tensor(rung.basis)
        basis = torch.kron(basis, torch.eye(colors))[..., None, None]
        self.register_buffer("basis", basis if rung.basis else None, persistent=False)

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """DiffUNet's and SpecUNet's images."""
        with torch.autocast(inputs.device.type, enabled=False):  # half precision would round small differences away
            seen = inputs if self.basis is None else conv2d(inputs.float(), self.basis)
        images = torch.cat([net(seen) for net in self.nets], dim=1)
        with torch.autocast(inputs.device.type, enabled=False):
            images = images.float() + self.linear(inputs.float())
        return images[:, : self.colors], images[:, self.colors :]


def separate_refined(measurements: Measurements, rung: Rung, networks: Refinement) -> Separation:
    """Diffuse and specular of ``[..., 4, C, h, w]`` as the networks see them; negative values are cut to 0.

    ``stokes`` and ``valid`` are those of the analytic split: the networks say nothing of polarization, and nothing
    makes their outputs sum to s0.
    """
    batch = measurements.data.shape[:-4]
    inputs = rung.inputs(measurements)
    inputs = inputs.reshape(-1, *inputs.shape[-3:])
    with torch.no_grad():
        diffuse, logarithm = networks(inputs)
    images = [x.reshape(*batch, *x.shape[-3:]) for x in (diffuse, torch.expm1(logarithm))]
    diffuse, specular = (x.clamp(min=0) for x in images)
    seen = separate_analytic(measurements)
    return Separation(diffuse, specular, seen.valid, seen.stokes)
