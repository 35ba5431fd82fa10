"""The joint networks of a method as one exportable module from raw samples to images, for engines other than torch.

A graph is what the method makes of a frame: levels, clip mask and colour of the light, demosaicking and closed form,
layers in float32, all networks of the method weighed by their expected errors, frames seen at several shifts by
networks that average these: the twin of `run.run_joint` and, in float32, of `engines.run_engine`; then the mosaic's
patterns are smoothed out where samples clip, and diffuse light under clipped highlights is filled. Around it,
`pipeline.separate` repairs defects, finds black level and light, and moves what metals, bodies and weak polarizers
leave in the diffuse image; graphs do none of that. `io.store.onnx` writes them.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import pixel_shuffle, pixel_unshuffle

from polsep.compute.resizing import repeat_pixels
from polsep.networks.channels import PERIOD
from polsep.networks.fill import fill_holes
from polsep.networks.joint import Joint
from polsep.networks.run import cells_near_clipping, combine, run_images
from polsep.physics.stokes import Stokes
from polsep.sensor.camera import CLIP_MARGIN, Layout
from polsep.separation.analytic import Separation
from polsep.separation.clipped_pattern import shares_of, smooth_planes, taps_of, weigh_clipped

#: Names of the outputs, in order.
OUTPUT_NAMES = ("diffuse", "specular", "error", "valid")
#: Samples above and left of the frame at each of its shifts (`orient.shifts_of`), by its colours; by a cell, red and
#: blue change places.
SHIFTS = {1: tuple((top, left) for top in (2, 4) for left in (2, 4)), 3: ((4, 4), (2, 2))}


def describe_graph(method: str, layout: Layout, full: bool, version: str) -> dict[str, str]:
    """Metadata of a graph of a method, by a ``version`` of polsep: name, version, layout, units, licence."""
    kind, size = "mono" if layout.bayer is None else "colour", "full" if full else "half"
    return {
        "name": f"polsep {method}, {kind} frames, {size} resolution",
        "version": version,
        "layout": layout.spec,
        "resolution": size,
        "precision": "float32",
        "units": (
            "raw, black_level, white_level: codes of the camera; light_color: camera RGB of the light, 1,1,1 is white; "
            "diffuse, specular: linear light in camera RGB, 1.0 = one measurement at the white level (an unclipped "
            "diffuse + specular reaches 2); error: expected standard deviation of the error of diffuse and of specular "
            "in that unit, at half resolution; valid: false where clipping leaves no measurement"
        ),
        "license": "MIT, code and weights",
    }


class ExportedNetwork(nn.Module):
    """``raw [N, H, W]`` integers or floats in Sony's order, H and W multiples of 4, to images, channels last.

    ``black_level [1]``, ``white_level [1]`` in the units of the samples; ``light_color [3]``, of colour networks alone:
    camera RGB of the light. ``diffuse``, ``specular [N, h, w, C]`` in that light, not negative; ``error [N, H/2, W/2,
    2]``: expected standard deviation of the error of both at half resolution; ``valid [N, h, w]``. h = H / 2, or H with
    ``full``. ``fill``: diffuse light under clipped highlights is filled, which takes two loops.
    """

    def __init__(self, networks: Sequence[Joint], full: bool, fill: bool = True) -> None:
        super().__init__()
        self.members, self.full, self.fill, self.colors = nn.ModuleList(networks), full, fill, networks[0].colors
        filters = [networks[0].layout.filter_at(k // PERIOD, k % PERIOD) for k in range(PERIOD**2)]
        #: The colour of each sample of a period.
        self.channels = [min(filter.channel, self.colors - 1) for filter in filters]

    def forward(
        self, raw: Tensor, black_level: Tensor, white_level: Tensor, light_color: Tensor | None = None
    ) -> tuple[Tensor, ...]:
        """See the class."""
        samples = ((raw.float() - black_level) / (white_level - black_level))[:, None]
        clipped = samples >= 1 - CLIP_MARGIN
        light = torch.ones(self.colors) if light_color is None else light_color
        gains = torch.cat([light[c : c + 1] for c in self.channels]).view(1, -1, 1, 1)
        samples = pixel_shuffle(pixel_unshuffle(samples, PERIOD) / gains, PERIOD)
        found, shares = [], []
        for network in self.members:
            assert isinstance(network, Joint)
            found.append(combine(self._run_shifted(network, samples, clipped)))
            shares.append(network.share)
        whole = combine(found, shares)
        assert whole.expected_error is not None
        weight = repeat_pixels(weigh_clipped(clipped.float(), taps_of(PERIOD), shares_of(self.colors)), self._scale)
        along = taps_of(PERIOD * self._scale // 2)
        images = [smooth_planes(image, weight, along) for image in (whole.diffuse, whole.specular)]
        diffuse, specular, error = (x.permute(0, 2, 3, 1) for x in (*images, whole.expected_error))
        if self.fill:
            cells = [self.channels[k] for k in (0, 2, 2 * PERIOD, 2 * PERIOD + 2)]
            diffuse, own = fill_holes((diffuse, error[..., 0]), samples, clipped, cells, self._scale)
            error = torch.stack([own, error[..., 1]], -1)
        error = error[:, :: self._scale, :: self._scale] * light.mean()
        return diffuse * light, specular * light, error, whole.valid

    @property
    def _scale(self) -> int:
        """Pixels along the side of a cell."""
        return 2 if self.full else 1

    def _run(self, network: Joint, samples: Tensor, clipped: Tensor) -> list[Separation]:
        """A network's images of whole frames ``[N, 1, H, W]``."""
        diffuse, specular, *_, error, _ = run_images(network, (samples, clipped), None, self.full)
        near = cells_near_clipping(clipped)[:, 1:]
        error, near = (repeat_pixels(x, self._scale) for x in (error, near))
        return [_separation(diffuse, specular.expand_as(diffuse), ~near[:, 0], error)]

    def _run_shifted(self, network: Joint, samples: Tensor, clipped: Tensor) -> list[Separation]:
        """The same at all shifts at which the network sees frames, as `run.run_joint` does, as one batch."""
        if not network.averages_shifts:
            return self._run(network, samples, clipped)
        frames, count, shifts = (samples, clipped), samples.shape[0], SHIFTS[self.colors]
        batch = [torch.cat([_shifted(_shifted(x, top, -2), left, -1) for top, left in shifts]) for x in frames]
        (whole,) = self._run(network, *batch)
        height, width = (n * self._scale // 2 for n in samples.shape[-2:])
        assert whole.expected_error is not None
        images, found = (whole.diffuse, whole.specular, whole.valid, whole.expected_error), []
        for k, (top, left) in enumerate(shifts):
            row, col = top * self._scale // 2, left * self._scale // 2
            own = [image[k * count : (k + 1) * count, ..., row : row + height, col : col + width] for image in images]
            swapped = self.colors > 1 and top % PERIOD > 0
            found.append(_separation(*(image.flip(1) if swapped else image for image in own[:2]), *own[2:]))
        return found


def _separation(diffuse: Tensor, specular: Tensor, valid: Tensor, error: Tensor) -> Separation:
    """Images for `run.combine` to weigh; of their Stokes images nothing is exported."""
    return Separation(diffuse, specular, valid, Stokes(diffuse, diffuse, diffuse), expected_error=error)


def _shifted(frames: Tensor, before: int, axis: int) -> Tensor:
    """Frames with 2 or 4 more samples before and a whole period in all, along -1 or -2, as `Orientation.turn` does."""
    length = frames.shape[axis]
    parts = [frames.narrow(axis, PERIOD - before, before), frames]
    if before < PERIOD:
        parts.append(frames.narrow(axis, length - PERIOD, PERIOD - before))
    return torch.cat(parts, dim=axis)
