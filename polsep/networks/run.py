"""The joint network in torch on frames of any size and orientation, in bounded memory.

Frames are turned into the order of filters that the network was trained on (`orient`), cut into overlapping strips of
rows where they are large (`strips`), and turned back. Twin on CPUs: `engines`.

On GPUs, layers run in float16, whose 11 bits lose nothing: the noise that they add is 60 dB below white and more, and
bfloat16 adds ten times as much (tests/test_gpu.py measures both). The closed form and all that makes images of
features stay in float32, or in TF32 where torch's own settings allow it. Where the environment variable
POLSEP_COMPILE is 1, torch compiles networks and replays them as CUDA graphs: minutes at first, for streams of frames
of one size.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import cache

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from polsep.compute.resizing import repeat_pixels
from polsep.demosaic.bilinear import mean_cells
from polsep.networks.joint import Joint, limit
from polsep.networks.strips import LEAST_ERROR, cut_rows, margin_of
from polsep.physics.stokes import Stokes, stokes_inverse
from polsep.sensor.camera import Layout, Mosaic
from polsep.sensor.orient import Orientation, orient, shifts_of
from polsep.separation.analytic import Separation

#: The type in which layers compute, by kind of device; elsewhere that of their weights.
LAYERS = {"cuda": torch.float16}


class State:
    """State of the module: whether networks are ``compiled``; no longer where that has failed."""

    compiled = os.environ.get("POLSEP_COMPILE") == "1"


def run_joint(network: Joint, mosaic: Mosaic, full: bool = False) -> Separation:
    """A mosaic ``[..., H, W]`` through a network; negative light is cut to 0.

    The polarization is that of the network's linear filter, at half resolution. ``valid`` is False near cells of
    which all samples clip. ``expected_error``: see `Separation`. Raises ValueError on layouts that are not
    Sony's in any orientation. At all of `shifts_of`, where the network averages them.
    """
    wanted = Layout.sony(mosaic.layout.channels)
    orientation = orient(mosaic, wanted)
    if not full and not orientation.keeps_cells:  # then the network's cells are not the frame's
        return _halve(run_joint(network, mosaic, full=True))
    shifts = shifts_of(mosaic, wanted) if network.averages_shifts else (orientation,)
    return combine([_run_turned(network, mosaic, shift, full) for shift in shifts])


def combine(separations: list[Separation], shares: Sequence[float] = ()) -> Separation:
    """Several separations of one frame, each pixel weighed by the inverse of its expected variance, times ``shares``.

    Diffuse and specular have weights of their own, so their sum may differ from s0. A pixel is valid if it is in all of
    them; the expected error is the weighted mean, since their errors are alike. Stokes images are the plain mean, what
    is not an image is the first one's.
    """
    first = separations[0]
    if len(separations) == 1:
        return first
    errors = torch.stack([s.expected_error for s in separations if s.expected_error is not None])
    factors = torch.tensor(shares or [1.0] * len(separations), device=errors.device)
    weights = factors.view(-1, *[1] * (errors.ndim - 1)) * errors.clamp(min=LEAST_ERROR) ** -2
    weights = weights / weights.sum(dim=0)
    diffuse, specular = weights[..., :1, :, :], weights[..., 1:, :, :]
    images = (torch.stack([getattr(s, name) for s in separations]) for name in ("diffuse", "specular"))
    body, reflected = ((w * x).sum(dim=0) for w, x in zip((diffuse, specular), images, strict=True))
    stokes = (torch.stack([getattr(s.stokes, name) for s in separations]).mean(dim=0) for name in ("s0", "s1", "s2"))
    valid = torch.stack([s.valid for s in separations]).all(dim=0)
    error = (weights * errors).sum(dim=0)
    return replace(first, diffuse=body, specular=reflected, valid=valid, stokes=Stokes(*stokes), expected_error=error)


def _run_turned(network: Joint, mosaic: Mosaic, orientation: Orientation, full: bool) -> Separation:
    """A mosaic through a network in one orientation."""
    raw, clipped = (orientation.turn(x) for x in (mosaic.linear().float(), mosaic.clipped()))
    batch, (height, width) = raw.shape[:-2], raw.shape[-2:]
    raw, clipped = (x.reshape(-1, 1, height, width) for x in (raw, clipped))
    parts, thumbnail = [], network.thumbnail(raw, clipped)
    margin = margin_of(network.size)
    for first, last in cut_rows((height, width), network.size, full):
        top, bottom = max(first - margin, 0), min(last + margin, height)
        strip = (raw[..., top:bottom, :], clipped[..., top:bottom, :])
        images = _run_layers(network, strip, thumbnail, full)
        parts.append([_rows(x, (first - top, last - top), bottom - top) for x in images])
    joined = (torch.cat(strips, dim=-2) for strips in zip(*parts, strict=True))
    images = [image.reshape(*batch, *image.shape[1:]) for image in joined]
    return _as_separation(images, cells_near_clipping(clipped).reshape(*batch, 2, height // 2, width // 2), orientation)


def _halve(separation: Separation) -> Separation:
    """Means over 2x2 cells of a separation at full resolution; a cell is valid if all of its pixels are."""
    return replace(
        separation,
        diffuse=mean_cells(separation.diffuse),
        specular=mean_cells(separation.specular),
        valid=mean_cells(separation.valid.float()) == 1,
        stokes=separation.stokes.map(mean_cells),
        residual=None if separation.residual is None else mean_cells(separation.residual),
        clipped=None if separation.clipped is None else mean_cells(separation.clipped.float()) > 0,
        expected_error=None if separation.expected_error is None else mean_cells(separation.expected_error),
    )


def _run_layers(network: Joint, strip: tuple[Tensor, Tensor], thumbnail: Tensor | None, full: bool) -> list[Tensor]:
    """`run_images` in the device's type of layers, compiled if that is asked for and works."""
    kind = strip[0].device.type
    # Graphs do not keep what autocast would: weights in its type, from one call to the next.
    precision = (
        torch.autocast(kind, LAYERS[kind], cache_enabled=not State.compiled) if kind in LAYERS else nullcontext()
    )
    with torch.no_grad(), precision:
        if State.compiled:
            try:
                if kind == "cuda":
                    torch.compiler.cudagraph_mark_step_begin()  # type: ignore[no-untyped-call]
                found = _compiled()(network, strip, thumbnail, full)
                return [image.clone() for image in found]  # whose memory is the next call's
            except Exception as error:  # whatever a compiler meets, the network itself still runs
                State.compiled = False
                reason = (str(error).splitlines() or [""])[0][:120]
                logging.getLogger("polsep").warning("networks run uncompiled: %s: %s", type(error).__name__, reason)
        return run_images(network, strip, thumbnail, full)


@cache
def _compiled() -> Callable[..., list[Tensor]]:
    # Of angles alone, in NumPy, which would cut the graph in pieces.
    torch.compiler.assume_constant_result(stokes_inverse)  # type: ignore[no-untyped-call]
    return torch.compile(run_images, mode="reduce-overhead", dynamic=False)


def run_images(network: Joint, strip: tuple[Tensor, Tensor], thumbnail: Tensor | None, full: bool) -> list[Tensor]:
    """Diffuse, specular, s1, s2, the standard deviations of the errors of both, and the fit residual, of a strip."""
    output = network(*strip, thumbnail)[0] if full else network.half_resolution(*strip, thumbnail)
    diffuse, specular, error = limit(output)
    return [diffuse, specular, output.s1, output.s2, error, repeat_pixels(output.fit_residual, 2)]


def _rows(image: Tensor, rows: tuple[int, int], height: int) -> Tensor:
    """Raw ``rows`` of an image of a strip of ``height`` raw rows, at any resolution."""
    first, last = (row * image.shape[-2] // height for row in rows)
    return image[..., first:last, :]


def cells_near_clipping(clipped: Tensor) -> Tensor:
    """Cells ``[N, 2, H/2, W/2]`` near which a sample clips, and near which all of a cell do.

    A cell is of one colour, so where it clips, the cells around, which are of the others, lack that colour too.
    """
    mask = clipped.float()
    some, all_of_it = max_pool2d(mask, 2), -max_pool2d(-mask, 2)
    return max_pool2d(torch.cat([some, all_of_it], dim=1), 3, 1, 1) > 0


def _as_separation(images: list[Tensor], cells: Tensor, orientation: Orientation) -> Separation:
    """Turn everything back to the frame's own orientation, and the masks and Stokes images to the images' size."""
    diffuse, specular = images[0], images[1].expand_as(images[0])
    scale = 2 if diffuse.shape[-1] > cells.shape[-1] else 1
    s1, s2, error, residual, cells = (repeat_pixels(x, scale) for x in (*images[2:], cells))
    stokes = Stokes(diffuse + specular, s1, s2)
    if orientation.swapped:
        diffuse, specular, stokes = diffuse.flip(-3), specular.flip(-3), stokes.map(lambda s: s.flip(-3))
    turned = [orientation.turn_back(x, scale) for x in (diffuse, specular, cells, error, math.sqrt(2) * residual)]
    diffuse, specular, cells, error, residual = turned
    valid, clipped = ~cells[..., 1, :, :], cells[..., 0, :, :]
    stokes = orientation.turn_back_stokes(stokes, scale)
    model = {"residual": residual} if diffuse.shape[-3] > 1 else {}  # one colour fits any line
    return Separation(diffuse, specular, valid, stokes, clipped=clipped, expected_error=error, **model)
