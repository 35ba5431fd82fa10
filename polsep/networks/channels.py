"""The channels of the joint network, in one place for training, torch, kernels, OpenVINO and ONNX.

Inputs and outputs are at packed resolution: a packed pixel covers one period of the mosaic, 4x4 samples or 2x2 cells.
A change of the network's interface is a change of this file, of `Joint.closed_form`, and of the kernel that fills the
same maps (`maps_kernel`).
"""

from __future__ import annotations

from typing import NamedTuple

#: Raw pixels along the side of a packed pixel.
PERIOD = 4
#: Brightness that counts as black: below it inputs and corrections fade.
MIN_BRIGHTNESS = 0.01
#: Windows of the diffuse polarization in packed pixels, and the squared contrast of colours, relative to the local
#: brightness, below which it falls back to the wider window and to zero. Chosen on validation views
#: (docs/experiments.md).
WINDOWS, MIN_CONTRAST = (9, 3), (3e-3, 3e-3)
#: Maps that the network sees beside `log_brightness`, in order, by the groups that ablations leave out.
GROUPS = {
    "samples": ("samples",),
    "clipping": ("clipped", "unclipped_around"),
    "cosine": ("cosine",),
    "sine": ("sine",),
    "split": ("diffuse", "specular", "wide", "narrow", "contrast", "fit_residual"),
}
#: The groups in order, as the weights' metadata name them.
INPUTS = tuple(GROUPS)
#: Maps of how large details are around: three details of four cells.
DETAIL_MAPS = 12
#: Signs of the pixels of a cell, in reading order: their mean, and the three details.
HAAR = ((1.0, 1.0, 1.0, 1.0), (1.0, -1.0, 1.0, -1.0), (1.0, 1.0, -1.0, -1.0), (1.0, -1.0, -1.0, 1.0))
#: Squared details, relative to the local brightness, that count as none.
MIN_DETAIL = 1e-7
#: Largest log variances of diffuse and specular: errors of 2 and 26 times the local brightness, the hundredth largest
#: of the validation views (docs/experiments.md).
MAX_LOG_VARIANCE = (1.5, 6.5)


class InputChannels(NamedTuple):
    """The first channel of every map, -1 for those that a network does not see, and the ``total`` of channels.

    ``samples``: 16 samples over the local brightness; ``clipped``: which of them clip; ``unclipped_around``: 1 where no
    neighbour clips. ``cosine``, ``sine``: s1 and s2 of 4 cells, means over colours, over the local brightness.
    ``diffuse`` (4 C), ``specular`` (4): the closed form over the local brightness; ``wide``, ``narrow``: diffuse
    polarization in two windows (2 each); ``contrast`` of the colours; ``fit_residual`` over the local brightness;
    ``log_brightness``: the logarithm of the local brightness.
    """

    samples: int
    clipped: int
    unclipped_around: int
    cosine: int
    sine: int
    diffuse: int
    specular: int
    wide: int
    narrow: int
    contrast: int
    fit_residual: int
    log_brightness: int
    total: int


def map_sizes(colors: int) -> dict[str, int]:
    """Channels of every map, for networks of so many ``colors``."""
    sizes = {"samples": 16, "clipped": 16, "unclipped_around": 1, "cosine": 4, "sine": 4}
    sizes |= {"diffuse": 4 * colors, "specular": 4, "wide": 2, "narrow": 2, "contrast": 1, "fit_residual": 1}
    return sizes | {"log_brightness": 1}


def seen_maps(inputs: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the maps that a network with these groups of ``inputs`` sees, in order."""
    return (*(name for group in inputs for name in GROUPS[group]), "log_brightness")


def input_channels(colors: int, inputs: tuple[str, ...]) -> InputChannels:
    """The first channel of every map among the channels of a network's input."""
    sizes, first, total = map_sizes(colors), dict.fromkeys(map_sizes(colors), -1), 0
    for name in seen_maps(inputs):
        first[name] = total
        total += sizes[name]
    return InputChannels(**first, total=total)
