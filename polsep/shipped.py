"""The networks that come with polsep: read from their weights once, applied to any frame.

Weights lie in `polsep/weights`; their metadata say which network they belong to. On CPUs they run without torch
(`networks.engines`, `networks.paper_engine`); `in_torch` has the same networks as torch modules.
"""

from __future__ import annotations

import json
import threading
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from polsep.compute.arrays import namespace
from polsep.io.store.errors import one_line
from polsep.io.store.weights import is_shipped, read_weights, shipped_weights
from polsep.networks.joint_weights import JointWeights, joint_weights
from polsep.networks.paper_engine import Refiner
from polsep.networks.rungs import RUNGS, Refine, Rung, separate_refined
from polsep.networks.sizes import Size
from polsep.physics.stokes import Measurements
from polsep.sensor.camera import Layout, Mosaic
from polsep.sensor.orient import orient
from polsep.separation.analytic import Separation

#: Methods of the joint network.
NAMES = ("joint-large", "joint", "joint-fast")


class Member(NamedTuple):
    """One network of a method: the name of its weights, its share, and whether it averages frames at several shifts."""

    weights: str
    share: float = 1.0
    averages_shifts: bool = False


#: Networks of methods that weigh the images of several by their expected errors, or average shifts, by method and
#: variant; others have one. Shares: `joint` was not trained on all that `joint-large` was, and expects too small errors
#: where frames differ from its own; `joint-fast` has less accurate images (docs/experiments.md).
MEMBERS = {
    "joint-large-mosaic": (Member("joint-large-mosaic", 1.0, True), Member("joint-mosaic", 0.4, True)),
    "joint-large-mono": (Member("joint-mono", 1.0, True), Member("joint-fast-mono", 0.5, True)),
    "joint-mono": (Member("joint-mono", 1.0, True),),
}
#: The paper's networks, trained on noisy mosaics of colour cameras, and of those without colour filters.
PAPER, PAPER_MONO = "paper-mosaic", "paper-mono"

_LOADING = threading.Lock()


def read_joint(path: Path, averages_shifts: bool = False) -> JointWeights:
    """The network in a file of weights. Raises ValueError when the file is damaged or of another network."""
    arrays, metadata = read_weights(path)
    try:
        return joint_weights(arrays, metadata, averages_shifts)
    except (KeyError, TypeError, ValueError) as error:
        found = type(error).__name__ if metadata["method"] in NAMES else f"those of {one_line(metadata['method'], 40)}"
        raise ValueError(f"expected weights of a joint network in {path}, found {found}") from None


def shipped_joint(method: str, layout: Layout) -> list[JointWeights]:
    """All networks of a method for frames of a layout; always the same objects, since engines are kept by them."""
    with _LOADING:
        return [_read_shipped(member) for member in _members(method, layout)]


def _members(method: str, layout: Layout) -> tuple[Member, ...]:
    name = f"{method}-{'mono' if layout.bayer is None else 'mosaic'}"
    return MEMBERS.get(name, (Member(name),))


@lru_cache(maxsize=16)
def _read_shipped(member: Member) -> JointWeights:
    network = _read_weights(member.weights)
    return replace(network, averages_shifts=member.averages_shifts, share=member.share)


@lru_cache(maxsize=8)
def _read_weights(name: str) -> JointWeights:
    return read_joint(shipped_weights(name))


def find_joint(method: str, layout: Layout, path: Path | None) -> tuple[list[JointWeights], dict[str, str]]:
    """A method's networks for frames of a layout, and the metadata of the first one's weights.

    They are those that are shipped, all that the method weighs together; or the one in a file of weights. Raises
    ValueError on methods without such a network, and on weights of another method or for other frames.
    """
    if method not in NAMES:
        raise ValueError(f"expected a method of {', '.join(NAMES)}, found {method!r}")
    if path is None:
        return shipped_joint(method, layout), read_weights(shipped_weights(weights_name(method, layout)))[1]
    network, metadata = read_joint(path, _members(method, layout)[0].averages_shifts), read_weights(path)[1]
    if metadata["method"] != method:
        raise ValueError(f"expected weights of {method} in {path}, found those of {metadata['method']}")
    if network.colors != layout.channels:
        raise ValueError(f"expected weights for {layout.channels} colours in {path}, found {network.colors}")
    return [network], metadata


def weights_name(method: str, layout: Layout) -> str:
    """The name of the weights of a method's first network for frames of a layout."""
    return _members(method, layout)[0].weights


def accepts_mosaic(method: str, mosaic: Mosaic) -> bool:
    """True for a mosaic in an order that the method knows, with weights shipped for its colours."""
    if not is_shipped(weights_name(method, mosaic.layout)):
        return False
    try:
        orient(mosaic, Layout.sony(mosaic.layout.channels))
    except ValueError:
        return False
    return True


def read_refiner(path: Path) -> Refiner:
    """The paper's networks in a file of weights. Raises ValueError when the file is damaged or of another network."""
    arrays, metadata = read_weights(path)
    try:
        return Refiner(RUNGS[metadata["rung"]], arrays, Size(**json.loads(metadata["size"])))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"expected weights of a refinement in {path}, found {type(error).__name__}") from None


@lru_cache(maxsize=2)
def _shipped_refiner(name: str) -> Refiner:
    return read_refiner(shipped_weights(name))


def paper_name(measurements: Measurements) -> str:
    """The name of the paper's weights for these measurements: those of mono frames where they are shipped."""
    return PAPER_MONO if measurements.data.shape[-3] == 1 and is_shipped(PAPER_MONO) else PAPER


def separate_paper(measurements: Measurements) -> Separation:
    """The paper's method: an analytic split refined by two U-Nets. NumPy ``[..., 4, C, h, w]``, C = 3 or 1.

    Mono frames have networks of their own where those are shipped, else they go through as grey ones.
    Twin in torch: `in_torch.separate_paper`. Source: Dave et al. 2022, Sec. 4.
    """
    refiner = _shipped_refiner(paper_name(measurements))
    return separate_colors(measurements, refiner.rung, refiner, refiner.colors)


def separate_colors(measurements: Measurements, rung: Rung, refine: Refine, colors: int) -> Separation:
    """`rungs.separate_refined` by networks of so many ``colors``, to which mono measurements go as grey ones."""
    data, clipped = measurements.data, measurements.clipped
    if data.shape[-3] == colors:
        return separate_refined(measurements, rung, refine)
    xp, shape = namespace(data), (*data.shape[:-3], colors, *data.shape[-2:])
    masks = None if clipped is None else xp.broadcast_to(clipped, shape)
    found = separate_refined(Measurements(xp.broadcast_to(data, shape), measurements.angles, masks), rung, refine)
    stokes = found.stokes.map(lambda s: xp.mean(s, axis=-3, keepdims=True))
    diffuse, specular = (xp.mean(x, axis=-3, keepdims=True) for x in (found.diffuse, found.specular))
    return Separation(diffuse, specular, found.valid, stokes)
