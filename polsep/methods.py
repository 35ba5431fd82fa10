"""The methods that are installed: each maps a capture to a separation.

Formulas and the paper's networks work on demosaicked samples, so they come with a demosaicker; the joint network reads
the mosaic itself. Every method has a readable `reference` and a `run` for one frame, which uses compiled kernels and
OpenVINO where these accept the frame and the reference elsewhere. Both agree to rounding. References of formulas take
NumPy arrays and torch tensors; of networks, NumPy by OpenVINO and tensors by torch (`in_torch`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np

from polsep.compute import pages
from polsep.compute.arguments import WrongType
from polsep.compute.arrays import namespace, on_cpu, to_numpy
from polsep.compute.warm_up import make_ready
from polsep.demosaic.bilinear import demosaic_bilinear, demosaic_bilinear_half
from polsep.demosaic.guided import demosaic_guided, demosaic_guided_half, is_large_enough
from polsep.io.store.weights import is_shipped
from polsep.networks.engines import ENGINES, combine_images, run_engine
from polsep.physics.stokes import Measurements, behind_angles, bounded_below_white, fit_stokes, is_pair
from polsep.sensor.camera import Capture, Layout, Mosaic, sample_fine_mosaic
from polsep.separation import analytic_kernel, color_affine_kernel
from polsep.separation.analytic import Separation, clipped_pixels, separate_analytic
from polsep.separation.analytic_kernel import AnalyticOptions
from polsep.separation.clipped_pattern import smooth_clipped
from polsep.separation.color_affine import separate_color_affine
from polsep.separation.color_affine_kernel import ColorAffineOptions
from polsep.separation.images import FrameImages
from polsep.separation.report import images_of, in_light, tally_again, under_white_light
from polsep.shipped import accepts_mosaic, separate_paper, shipped_joint, weights_name

#: One gain per channel.
Gains = tuple[float, ...]


class Reference(Protocol):
    """A method for any capture, batches, all devices; a `Separation` in white light."""

    def __call__(self, capture: Capture, full: bool = False) -> Separation:
        """Separate a capture."""


@dataclass(frozen=True)
class Method:
    """A separation method.

    ``run(capture, light, full)``: the images of one frame in its light, by the fastest code that accepts it, at half or
    full resolution; co-sited measurements keep theirs. ``accepts``: whether it can separate a capture; others are a
    ValueError. ``expects_errors``: its images come with expected errors. ``reads_mosaic``: it does not demosaic first;
    co-sited samples become a mosaic. ``assumes_white``: other specular light is moved by `colored_specular` afterwards.
    """

    name: str
    summary: str
    needs: str
    source: str
    reference: Reference
    run: Callable[[Capture, Gains, bool], FrameImages]
    accepts: Callable[[Capture], bool]
    expects_errors: bool = False
    reads_mosaic: bool = False
    assumes_white: bool = False


def compose(
    demosaic: Callable[[Mosaic], Measurements], split: Callable[[Measurements], Separation]
) -> Callable[[Capture], Separation]:
    """A demosaicker and a function that separates its samples; co-sited measurements are separated as they are."""

    def separate_samples(capture: Capture) -> Separation:
        samples = capture if isinstance(capture, Measurements) else demosaic(capture)
        return replace(split(samples), clipped=clipped_pixels(samples))

    return separate_samples


def analytic_reference(capture: Capture, full: bool = False) -> Separation:
    """`separate_analytic` of bilinear samples."""
    return compose(demosaic_bilinear if full else demosaic_bilinear_half, separate_analytic)(capture)


def color_affine_reference(capture: Capture, full: bool = False) -> Separation:
    """`separate_color_affine` of guided samples."""
    return compose(demosaic_guided if full else demosaic_guided_half, separate_color_affine)(capture)


def paper_reference(capture: Capture, full: bool = False) -> Separation:
    """`separate_paper` of bilinear samples."""
    separate = separate_paper
    if not isinstance(capture.data, np.ndarray):
        from polsep import in_torch

        separate = in_torch.separate_paper
    return compose(demosaic_bilinear if full else demosaic_bilinear_half, separate)(capture)


def joint_reference(name: str, capture: Capture, full: bool = False) -> Separation:
    """`in_torch.separate_joint`; takes mosaics as torch tensors alone. Raises ValueError on others."""
    if isinstance(capture, Measurements) or isinstance(capture.data, np.ndarray):
        found = f"{type(capture).__name__} of {type(capture.data).__name__} {tuple(capture.data.shape)}"
        raise ValueError(f"expected a Mosaic of torch's Tensor for the reference of {name}, found {found}")
    from polsep.in_torch import separate_joint

    return separate_joint(name, capture, full)


def run_reference(reference: Reference, capture: Capture, light: Gains, full: bool) -> FrameImages:
    """One frame by a method's reference, in its light."""
    separation = reference(under_white_light(capture, light), full)
    return images_of(separation, in_light(separation, light))


def run_analytic(capture: Capture, light: Gains, full: bool) -> FrameImages:
    """`separate_analytic` of bilinear samples: compiled kernels for one frame, else the reference."""
    if not isinstance(capture, Mosaic) or not _is_plain(capture):
        return run_reference(analytic_reference, capture, light, full)
    make_ready(analytic_kernel.warm_up_full if full else analytic_kernel.warm_up)
    separate = analytic_kernel.separate_analytic_full if full else analytic_kernel.separate_analytic_half
    options = AnalyticOptions(light, in_light=True, report=True)
    levels = (capture.black_level, capture.white_level)
    return separate(to_numpy(capture.data), capture.layout, *levels, options)


def run_color_affine(capture: Capture, light: Gains, full: bool) -> FrameImages:
    """`separate_color_affine` of guided samples: compiled kernels for one colour frame, else the reference."""
    if (
        not isinstance(capture, Mosaic)
        or not _is_plain(capture)
        or capture.layout.channels != 3
        or not is_large_enough(capture)
    ):
        return run_reference(color_affine_reference, capture, light, full)
    kernel = color_affine_kernel
    make_ready(kernel.warm_up_full if full else kernel.warm_up)
    separate = kernel.separate_color_affine_full if full else kernel.separate_color_affine_half
    options = ColorAffineOptions(light, in_light=True, guided=True, report=True)
    levels = (capture.black_level, capture.white_level)
    return separate(to_numpy(capture.data), capture.layout, *levels, options)


def run_joint(name: str, capture: Capture, light: Gains, full: bool) -> FrameImages:
    """The joint networks of that name: kernels and OpenVINO, on other devices torch."""
    if isinstance(capture, Measurements):
        return run_joint_co_sited(name, capture, light)
    if capture.data.ndim == 2 and on_cpu(capture.data):
        networks, lit = shipped_joint(name, capture.layout), replace(capture, light_color=light)
        shares = [network.share for network in networks]
        images = combine_images((run_engine(network, lit, full) for network in networks), light, shares)
        return smooth_clipped(images, capture, light)
    return run_reference(partial(joint_reference, name), capture, light, full)


def run_joint_co_sited(name: str, samples: Measurements, light: Gains) -> FrameImages:
    """The joint networks on the mosaic that a sensor twice as fine would see of co-sited samples, at their resolution.

    Better than a mosaic of the samples themselves, which lacks three analysers and two colours in every pixel
    (docs/experiments.md). s0 is that of the samples: the networks say how it splits.
    """
    layout = Layout.sony(samples.data.shape[-3])
    mosaic = sample_fine_mosaic(behind_angles(samples, layout.angles), layout)
    images = run_joint(name, mosaic, light, False)
    light_of_samples, clipped, xp = fit_stokes(samples).s0.clip(0, None), samples.clipped, namespace(samples.data)
    unknown = xp.zeros_like(light_of_samples, dtype=xp.bool) if clipped is None else xp.any(clipped, axis=-4)
    s0, unknown = (xp.moveaxis(image, -3, -1) for image in (light_of_samples, unknown))
    if isinstance(images.specular, np.ndarray):  # tensors on the CPU go through the same kernels
        s0, unknown, xp = to_numpy(s0), to_numpy(unknown), np
    specular = xp.minimum(images.specular, s0)
    diffuse = xp.where(unknown, images.diffuse, s0 - specular)
    return tally_again(replace(images, diffuse=diffuse, specular=xp.where(unknown, images.specular, specular)), light)


def _is_plain(mosaic: Mosaic) -> bool:
    """One frame in the computer's own memory, in samples that kernels read."""
    data = mosaic.data
    if data.ndim != 2 or not on_cpu(data) or getattr(data, "requires_grad", False):
        return False
    return to_numpy(data).dtype in (np.uint8, np.uint16, np.float32)


def _accepts_anything(capture: Capture) -> bool:
    del capture
    return True


def _sees_all(capture: Capture) -> bool:
    """True unless it is a crossed pair, which shows one component of the polarization alone."""
    return isinstance(capture, Mosaic) or not is_pair(capture)


def _accepts_joint(name: str, capture: Capture) -> bool:
    """True for mosaics that the networks of that name know, and for co-sited samples whose colours have weights."""
    if isinstance(capture, Mosaic):
        return accepts_mosaic(name, capture)
    layout = Layout.sony(capture.data.shape[-3])
    known = _sees_all(capture) and capture.data.ndim == 4 and is_shipped(weights_name(name, layout))
    return known and not bounded_below_white(capture)  # networks take what clipped for white at least


def _joint(name: str, summary: str) -> Method:
    return Method(
        name,
        summary,
        "a raw mosaic in Sony's order, however turned, or co-sited images; colour or mono; trained under white light",
        "this project; after Dave et al. 2022 and the colour-affine closed form",
        partial(joint_reference, name),
        partial(run_joint, name),
        partial(_accepts_joint, name),
        expects_errors=True,
        reads_mosaic=True,
        assumes_white=True,
    )


_ALL = (
    _joint("joint-large", "networks from the raw mosaic, weighed by their expected errors: best quality, for stills"),
    _joint("joint", "one network from the raw mosaic to full-resolution images, with the closed form inside"),
    _joint("joint-fast", "the same, smaller, for real time"),
    Method(
        "color-affine",
        "closed form for polarized diffuse and white specular light, recovers clipped samples",
        "colour; on mono and grey it is the analytic split with clipped samples recovered",
        "this project; after Nayar et al. 1997, Kajiyama et al. 2023",
        color_affine_reference,
        run_color_affine,
        _accepts_anything,
    ),
    Method(
        "analytic",
        "the paper's first estimate: specular = polarized part, diffuse = the rest",
        "colour or mono; takes the diffuse light for unpolarized and clipped samples at face value",
        "Dave et al. 2022, Eqs. 15-18",
        analytic_reference,
        run_analytic,
        _accepts_anything,
    ),
    Method(
        "paper",
        "the paper's two U-Nets, which refine the analytic split",
        "colour; mono frames go through as grey ones; trained on noisy mosaics under white light",
        "Dave et al. 2022, Sec. 4; weights are this project's",
        paper_reference,
        partial(run_reference, paper_reference),
        _sees_all,
    ),
)

#: Every method that is installed; the joint networks only with their weights.
METHODS = {m.name: m for m in _ALL if not m.reads_mosaic or is_shipped(weights_name(m.name, Layout()))}

#: The meaning of `auto`: the first of these that is installed and accepts the capture.
BEST = tuple(METHODS[name] for name in ("joint-large", "color-affine") if name in METHODS)

#: The meaning of `auto-fast`, for streams.
FASTEST = tuple(METHODS[name] for name in ("joint-fast", "color-affine") if name in METHODS)

#: Names that choose a method by the capture.
_CHOICES = {"auto": BEST, "auto-fast": FASTEST}


def find_method(name: str, capture: Capture) -> Method:
    """The method of that name, or the best one for a capture.

    Raises ValueError, with the names there are, for any other.
    """
    check_method(name)
    if name in _CHOICES:
        return next(method for method in _CHOICES[name] if method.accepts(capture))
    if isinstance(capture, Measurements) and not METHODS[name].accepts(capture):
        able = ", ".join(method.name for method in METHODS.values() if method.accepts(capture))
        kind = "two crossed photographs" if is_pair(capture) else "these images"
        kind = "images that clip below white, of several exposures" if bounded_below_white(capture) else kind
        raise ValueError(f"expected a method for {kind} ({able}), found {name}")
    return METHODS[name]


def check_method(name: str) -> None:
    """Raise ValueError, with the names there are, unless a method is called so."""
    if not isinstance(name, str):
        raise WrongType(f"expected the name of a method, found {type(name).__name__}")
    if name not in _CHOICES and name not in METHODS:
        raise ValueError(f"expected a method of {', '.join([*_CHOICES, *METHODS])}, found {name!r}")


def release_memory() -> None:
    """Give back the memory that methods on the CPU keep for the next frame: call it after the last one."""
    ENGINES.clear()
    pages.release()
