"""The methods that are installed: every one maps a capture to a `Separation`.

Formulas and the paper's networks work on demosaicked samples, so they come with a demosaicker (`compose`); the joint
network reads the mosaic itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from polsep.demosaic.bilinear import demosaic_bilinear, demosaic_bilinear_half
from polsep.demosaic.guided import demosaic_guided, demosaic_guided_half
from polsep.io.store.weights import is_shipped
from polsep.networks.engines import run_engine
from polsep.networks.run import NAMES, separate_mosaic, takes, weights_name
from polsep.networks.shipped_paper import separate_paper
from polsep.physics.stokes import Measurements
from polsep.sensor.camera import Layout, Mosaic
from polsep.separation.analytic import Separation, separate_analytic
from polsep.separation.color_affine import separate_color_affine
from polsep.separation.engine import run_analytic, run_color_affine, run_nothing
from polsep.separation.images import FrameImages

#: What a camera gives: a raw frame, or co-sited samples.
Capture = Mosaic | Measurements


@dataclass(frozen=True)
class Method:
    """A separation method: what it makes of a frame at ``half`` and at ``full`` resolution; the rest is to be read.

    Co-sited measurements keep their resolution. ``takes``: whether it can separate a capture; the others are a
    ValueError. ``engine``, ``full_engine``: their compiled twins, which give None for frames that they do not take.
    """

    name: str
    half: Callable[[Capture], Separation]
    full: Callable[[Capture], Separation]
    takes: Callable[[Capture], bool]
    engine: Callable[[Mosaic], FrameImages | None]
    summary: str
    needs: str
    source: str
    full_engine: Callable[[Mosaic], FrameImages | None] = run_nothing


def compose(
    demosaic: Callable[[Mosaic], Measurements], split: Callable[[Measurements], Separation]
) -> Callable[[Capture], Separation]:
    """A demosaicker and what separates its samples; co-sited measurements are separated as they are."""

    def separate_samples(capture: Capture) -> Separation:
        samples = capture if isinstance(capture, Measurements) else demosaic(capture)
        clipped = None if samples.clipped is None else samples.clipped.any(dim=-4).any(dim=-3)
        return replace(split(samples), clipped=clipped)

    return separate_samples


def takes_anything(capture: Capture) -> bool:
    """Every capture that can be made."""
    del capture
    return True


def _joint(name: str, summary: str) -> Method:
    colors = "colour or mono" if is_shipped(weights_name(name, Layout(bayer=None))) else "colour"
    return Method(
        name,
        separate_mosaic(name, "half"),
        separate_mosaic(name, "full"),
        takes(name),
        partial(run_engine, name, "half"),
        summary,
        f"a raw mosaic with Sony's filters in any orientation, {colors}; trained under white light",
        "this project; after Dave et al. 2022 and the colour-affine closed form",
        partial(run_engine, name, "full"),
    )


_ALL = (
    _joint("joint", "one network from the raw mosaic to full-resolution images, with the closed form inside"),
    _joint("joint-fast", "the same, smaller, for real time"),
    Method(
        "color-affine",
        compose(demosaic_guided_half, separate_color_affine),
        compose(demosaic_guided, separate_color_affine),
        takes_anything,
        run_color_affine,
        "closed form for polarized diffuse and white specular light, recovers clipped samples",
        "colour; on mono and grey it is the analytic split with clipped samples recovered",
        "this project; after Nayar et al. 1997, Kajiyama et al. 2023",
    ),
    Method(
        "analytic",
        compose(demosaic_bilinear_half, separate_analytic),
        compose(demosaic_bilinear, separate_analytic),
        takes_anything,
        run_analytic,
        "the paper's first estimate: specular = polarized part, diffuse = the rest",
        "colour or mono; takes the diffuse light for unpolarized and clipped samples at face value",
        "Dave et al. 2022, Eqs. 15-18",
    ),
    Method(
        "paper",
        compose(demosaic_bilinear_half, separate_paper),
        compose(demosaic_bilinear, separate_paper),
        takes_anything,
        run_nothing,
        "the paper's two U-Nets, which refine the analytic split",
        "colour; mono frames go through as grey ones; trained on noisy mosaics under white light",
        "Dave et al. 2022, Sec. 4; weights are this project's",
    ),
)

#: Every method that is installed; networks are where their weights are.
METHODS = {m.name: m for m in _ALL if not m.name.startswith("joint") or is_shipped(weights_name(m.name, Layout()))}

#: What `auto` means: the first of these that is installed and takes the capture.
BEST = tuple(METHODS[name] for name in ("joint", "color-affine") if name in METHODS)


#: The same of `auto-fast`, for streams.
FASTEST = tuple(METHODS[name] for name in ("joint-fast", "joint", "color-affine") if name in METHODS)

#: Names that choose a method by the capture.
_CHOICES = {"auto": BEST, "auto-fast": FASTEST}


def find_method(name: str, capture: Capture) -> Method:
    """The method of that name, or the best one for a capture.

    Raises ValueError, with the names there are, for any other, and where no weights for the capture's colours are.
    """
    check_method(name)
    if name in _CHOICES:
        return next(method for method in _CHOICES[name] if method.takes(capture))
    if name in NAMES and isinstance(capture, Mosaic) and not is_shipped(weights_name(name, capture.layout)):
        kind = "mono" if capture.layout.bayer is None else "colour"
        raise ValueError(f"expected a method with weights for {kind} frames, as auto finds, found {name}")
    return METHODS[name]


def check_method(name: str) -> None:
    """Raise ValueError, with the names there are, unless a method is called so."""
    if name not in _CHOICES and name not in METHODS:
        raise ValueError(f"expected a method of {', '.join([*_CHOICES, *METHODS])}, found {name!r}")
