"""Examples as the joint network sees them: raw samples, and the truth at both resolutions."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor
from torch.nn.functional import avg_pool2d

from polsep.sensor.camera import CLIP_MARGIN, Layout
from polsep.train.stream import MONO, Examples, expose_mono
from polsep.train.tasks import whole_cells


class JointSeen(NamedTuple):
    """Samples ``raw [B, 1, H, W]`` behind the filters of ``layout``, white = 1, and the truth.

    ``diffuse [B, C, H/2, W/2]``, ``specular [B, 1, H/2, W/2]`` and the ``mask`` are what is scored; ``full_diffuse``,
    ``full_specular`` and ``weight [B, 1, H, W]``, 1 on objects, the same at full resolution. ``polarized``: s1 and s2
    ``[B, 2 C, H, W]``.
    """

    raw: Tensor
    diffuse: Tensor
    specular: Tensor
    mask: Tensor
    layout: Layout
    full_diffuse: Tensor
    full_specular: Tensor
    weight: Tensor
    polarized: Tensor


def see_raw(examples: Examples) -> JointSeen:
    """Noisy colour mosaics as they are."""
    diffuse, specular, polarized = (x.float() for x in examples[1:4])
    return _as_seen(Examples(examples.raw, diffuse, specular, polarized, examples.mask), Layout())


def see_raw_mono(examples: Examples) -> JointSeen:
    """Noisy mosaics of a camera without colour filters."""
    return _as_seen(expose_mono(examples), MONO)


def _as_seen(view: Examples, layout: Layout) -> JointSeen:
    return JointSeen(
        view.raw[:, None],
        avg_pool2d(view.diffuse, 2),
        avg_pool2d(view.specular, 2),
        whole_cells(view.mask),
        layout,
        view.diffuse,
        view.specular,
        view.mask[:, None].float(),
        view.polarized,
    )


def find_clipped(raw: Tensor) -> Tensor:
    """Samples at the white level, 1."""
    return raw >= 1 - CLIP_MARGIN
