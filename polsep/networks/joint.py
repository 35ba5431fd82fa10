"""The joint network: a raw mosaic in, diffuse and specular out, with demosaicking and the closed form inside.

A mosaic is packed to quarter resolution: the 16 samples of a period become channels, so every pixel of the network
sees the same filters. Stokes images come from the intensity guide (`guided.guide_once`) or, in less time, from a linear
filter fitted to examples. The colour-affine closed form (`color_affine`) with windows of two sizes makes a first
separation of these, and restores clipped highlights as far as unclipped samples determine them. A U-Net of residual
blocks sees samples, clip masks and the closed form, scales the closed form's specular light and adds corrections. The
specular light is white by construction. Diffuse and specular sum to the network's own s0. Full resolution is half
resolution with `details`.

Inputs and corrections are relative to the local brightness, so that a darker exposure of a scene gives a darker image
of the same separation, as far as noise and clipping allow. What is common to a whole frame comes from its thumbnail
(`whole_frame`) alone: with the same thumbnail, crop and frame agree away from the border.

Conventions: quarter resolution [h, w] is [H/4, W/4] of the mosaic. "Packed" images ``[N, C k^2, h, w]`` hold k x k
pixels per period, in the order of `torch.nn.functional.pixel_unshuffle`; k = 4 at full, 2 at half resolution.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, conv2d, max_pool2d, pad, pixel_shuffle, pixel_unshuffle

from polsep.compute.resizing import repeat_pixels
from polsep.demosaic.bilinear import demosaic_bilinear, demosaic_bilinear_half
from polsep.demosaic.guided import MARGIN, guide_once
from polsep.networks.channels import (
    INPUTS,
    MAX_LOG_VARIANCE,
    MIN_BRIGHTNESS,
    MIN_CONTRAST,
    PERIOD,
    WINDOWS,
    input_channels,
    seen_maps,
)
from polsep.networks.details import Details
from polsep.networks.joint_weights import NAMES_IN_FILES, VARIANCE_HIDDEN, JointWeights
from polsep.networks.sizes import ResidualSize
from polsep.networks.taps import pool_outputs
from polsep.networks.thumbnails import LIGHT
from polsep.networks.unet import Block, ResidualUNet, limit_above
from polsep.networks.whole_frame import WholeFrame, make_thumbnail, split_modulation
from polsep.physics.stokes import fit_stokes
from polsep.sensor.camera import Layout, Mosaic
from polsep.separation.closed_form import fit_unclipped, limit_dolp, white_specular

#: Algorithms that make the Stokes images.
Demosaicker = Literal["linear", "guided"]


class ClosedForm(NamedTuple):
    """The closed form at half resolution: ``diffuse [N, 4 C, h, w]``, ``specular [N, 4, h, w]``, packed.

    ``polarized [N, 8 C, h, w]``: s1 and s2. ``local_brightness``, ``fit_residual [N, 1, h, w]``: mean s0 around, and
    the rms distance of s1 and s2 from the model; ``polarization [N, 4, h, w]``: the two of `Polarization`;
    ``clipped_s0 [N, C, h, w]``: light that clipping took from s0; ``inputs``: the network's, see `channels`.
    """

    diffuse: Tensor
    specular: Tensor
    polarized: Tensor
    local_brightness: Tensor
    fit_residual: Tensor
    polarization: Tensor
    clipped_s0: Tensor
    inputs: Tensor


class Polarization(NamedTuple):
    """Polarization of the ``diffuse`` light, and the direction of the ``specular`` one's, ``[N, 2, H/4, W/4]`` each.

    Both as (cos 2 phi, sin 2 phi) times their degree, which is 1 for the specular one unless a whole frame shows it.
    """

    diffuse: Tensor
    specular: Tensor


class JointOutput(NamedTuple):
    """``diffuse [N, C, ...]`` and ``specular [N, 1, ...]``, not limited to be positive, and images at half resolution.

    ``s1``, ``s2 [N, C, H/2, W/2]`` as linearly demosaicked; ``log_variance [N, 2, H/2, W/2]`` of the errors of diffuse
    and specular, relative to the squared ``local_brightness [N, 1, H/4, W/4]``; ``fit_residual [N, 1, H/4, W/4]``;
    ``light [N, 8]``: means and log variances of `thumbnails.LIGHT`, ``[N, 0]`` of networks that see no whole frame.
    """

    diffuse: Tensor
    specular: Tensor
    s1: Tensor
    s2: Tensor
    log_variance: Tensor
    local_brightness: Tensor
    fit_residual: Tensor
    light: Tensor


class Joint(nn.Module):
    """Samples ``[N, 1, H, W]`` (black 0, white 1, Sony's order) to diffuse and specular images.

    ``inputs``: the groups of `channels.GROUPS` that it sees. ``demosaicker``: "guided" with frames continued by
    ``margin`` cells, or "linear" by the filter ``demosaic``, which gradients do not change; see `bilinear_filter`.
    ``corrections`` are added to the closed form, ``closed_form_gain`` scales its specular light, ``log_variance`` says
    how large errors are, ``details`` makes full from half resolution. ``whole_frame``: what a network that
    ``sees_frame`` takes from a thumbnail of it.
    """

    demosaic: Tensor | None
    max_log_variance: Tensor

    def __init__(
        self,
        colors: int,
        size: ResidualSize,
        inputs: tuple[str, ...] = INPUTS,
        demosaicker: Demosaicker = "linear",
        sees_frame: bool = False,
    ) -> None:
        super().__init__()
        self.colors, self.size, self.inputs, self.margin = colors, size, inputs, MARGIN
        #: Frames are separated at all of `orient.shifts_of` and combined; share among networks that are combined.
        self.averages_shifts, self.share = False, 1.0
        #: Faster twin of `_guide_once`, which training on CPUs sets (`networks.guide`).
        self.guide: Callable[[Tensor, Layout], tuple[Tensor, Tensor]] | None = None
        self.layout = Layout.sony(colors)
        self.register_buffer("demosaic", bilinear_filter(self.layout) if demosaicker == "linear" else None)
        width = size.widths[0]
        self.net = ResidualUNet(input_channels(colors, inputs).total, size)
        self.corrections = _zero_convolution(width, 4 * (colors + 1))
        # Without the closed form among its inputs the network cannot know how far to trust it.
        self.closed_form_gain = _zero_convolution(width, 4) if "split" in inputs else None
        self.polarization = _zero_convolution(width, 4)
        # Without sides of 1, whose strides `channels_last` changes: several processes copy such a buffer onto itself.
        largest = torch.tensor(MAX_LOG_VARIANCE).repeat_interleave(4)
        self.register_buffer("max_log_variance", largest, persistent=False)
        self.log_variance = nn.Sequential(
            nn.Conv2d(width, VARIANCE_HIDDEN, 3, padding=1), nn.ReLU(), nn.Conv2d(VARIANCE_HIDDEN, 8, 1)
        )
        self.details = Details(colors, width)
        self.whole_frame = WholeFrame(colors, size.widths) if sees_frame else None
        self.register_state_dict_post_hook(_to_names_in_files)  # type: ignore[no-untyped-call]
        self.register_load_state_dict_pre_hook(_from_names_in_files)  # type: ignore[no-untyped-call]

    @classmethod
    def of(cls, weights: JointWeights, device: torch.device) -> Joint:
        """The network of these weights, to run, not to train."""
        demosaicker: Demosaicker = "guided" if weights.demosaic is None else "linear"
        network = cls(weights.colors, weights.size, weights.inputs, demosaicker, weights.sees_frame)
        network.load_state_dict({name: torch.tensor(array) for name, array in weights.arrays.items()})
        network.averages_shifts, network.share = weights.averages_shifts, weights.share
        for block in (part for part in network.modules() if isinstance(part, Block)):
            block.inactive = not bool(block.second.weight.any())
        return network.to(device, torch.float32).eval()

    def weights(self) -> JointWeights:
        """The twin of `of`: copies of what files of weights hold."""
        arrays = {name: tensor.float().cpu().numpy().copy() for name, tensor in self.state_dict().items()}
        return JointWeights(self.colors, self.size, arrays, self.inputs, self.averages_shifts, share=self.share)

    def forward(
        self, raw: Tensor, clipped: Tensor, thumbnail: Tensor | None = None
    ) -> tuple[JointOutput, Polarization]:
        """Images at full resolution, ``[N, C, H, W]``.

        ``raw``, ``clipped [N, 1, H, W]``: samples and which of them clipped, H and W multiples of 4. ``thumbnail``: of
        the frames that they are crops of, see `thumbnail`; None where they are whole frames.
        """
        total, closed, features, log_variance, light = self._encode((raw, clipped), thumbnail, full=True)
        half, change = self._correct(closed, features), self.polarization(features)
        with torch.autocast(raw.device.type, enabled=False):
            diffuse, specular = (closed.polarization + change.float()).chunk(2, dim=1)
            length = torch.sqrt((specular**2).sum(dim=1, keepdim=True) + 1e-6)
            if light.shape[1]:
                length = length / light[:, LIGHT.index("dolp")].float().clamp(0.3, 1)[:, None, None, None]
        full = self.details(half, total, features, closed.local_brightness)
        return self._as_output(full, closed, log_variance, light), Polarization(diffuse, specular / length)

    def half_resolution(self, raw: Tensor, clipped: Tensor, thumbnail: Tensor | None = None) -> JointOutput:
        """The means over 2x2 cells of what `forward` gives, ``[N, C, H/2, W/2]``, in less time."""
        _, closed, features, log_variance, light = self._encode((raw, clipped), thumbnail, full=False)
        return self._as_output(self._correct(closed, features), closed, log_variance, light)

    def thumbnail(self, raw: Tensor, clipped: Tensor) -> Tensor | None:
        """`make_thumbnail` of whole frames ``[N, 1, H, W]``; None for a network that sees none."""
        if self.whole_frame is None:
            return None
        planes, masks = (pixel_unshuffle(x.to(raw), PERIOD) for x in (raw, clipped))
        return make_thumbnail(planes, masks, self.layout)

    def _encode(
        self, frames: tuple[Tensor, Tensor], thumbnail: Tensor | None, full: bool
    ) -> tuple[Tensor, ClosedForm, Tensor, Tensor, Tensor]:
        """Packed s0 at full resolution, the closed form, the network's features, log variances and the light."""
        raw, clipped = frames
        planes, masks = pixel_unshuffle(raw, PERIOD), pixel_unshuffle(clipped.to(raw), PERIOD)
        with torch.autocast(raw.device.type, enabled=False), torch.no_grad():
            half, total = self.demosaicked(planes, full)
            closed = self.closed_form(half, planes, masks)
            total = total + closed.clipped_s0.repeat_interleave(total.shape[1] // self.colors, dim=1)
        changes, light = [], raw.new_zeros(raw.shape[0], 0)
        if self.whole_frame is not None:
            if thumbnail is None:
                thumbnail = make_thumbnail(planes, masks, self.layout)
            modulation, light = self.whole_frame(thumbnail)
            changes = split_modulation(modulation, self.size.widths)
        features = self.net(closed.inputs, changes)
        log_variance = self.log_variance(features.detach()).float()
        limited = limit_above(log_variance, self.max_log_variance.view(1, 8, 1, 1))
        return total, closed, features, pixel_shuffle(limited, 2), light

    def _correct(self, closed: ClosedForm, features: Tensor) -> Tensor:
        """Diffuse colours and specular at half resolution ``[N, C + 1, H/2, W/2]``."""
        change = self.corrections(features)
        gain = torch.zeros_like(features[:, :1]) if self.closed_form_gain is None else self.closed_form_gain(features)
        with torch.autocast(features.device.type, enabled=False):
            moved = closed.specular * gain.float()
            diffuse, specular = closed.diffuse - torch.cat([moved] * self.colors, dim=1), closed.specular + moved
            images = torch.cat([diffuse, specular], dim=1) + change.float() * closed.local_brightness
            return pixel_shuffle(images, 2)

    def _as_output(self, images: Tensor, closed: ClosedForm, log_variance: Tensor, light: Tensor) -> JointOutput:
        s1, s2 = (pixel_shuffle(s, 2) for s in closed.polarized.chunk(2, dim=1))
        diffuse, specular = images[:, : self.colors], images[:, self.colors :]
        brightness, residual = closed.local_brightness, closed.fit_residual
        return JointOutput(diffuse, specular, s1, s2, log_variance, brightness, residual, light)

    def demosaicked(self, planes: Tensor, full: bool) -> tuple[Tensor, Tensor]:
        """Packed s0, s1, s2 at half resolution ``[N, 12 C, h, w]``, and s0 at full resolution or nothing."""
        if self.demosaic is None:
            stokes, s0 = (self.guide or self._guide_once)(pixel_shuffle(planes, PERIOD), self.layout)
            half = pixel_unshuffle(stokes, 2)
            return half, pixel_unshuffle(s0, PERIOD) if full else half[:, :0]
        s0_full = 16 * self.colors
        half = torch.cat([pool_outputs(self.demosaic[:s0_full]), self.demosaic[s0_full:]])
        return _filter(planes, half), _filter(planes, self.demosaic[:s0_full]) if full else planes[:, :0]

    def _guide_once(self, raw: Tensor, layout: Layout) -> tuple[Tensor, Tensor]:
        """`guided.guide_once`: s0, s1, s2 of the colours ``[N, 3 C, H/2, W/2]``, and s0 at full resolution."""
        stokes, s0 = guide_once(Mosaic(raw[:, 0], layout, 0.0, 1.0), self.margin)
        return torch.cat([stokes.s0, stokes.s1, stokes.s2], dim=1), s0

    def closed_form(self, stokes: Tensor, planes: Tensor, masks: Tensor) -> ClosedForm:
        """The closed form of packed Stokes images at half resolution; ``planes``, ``masks [N, 16, h, w]``."""
        colors = self.colors
        s0, s1, s2 = (x.chunk(colors, dim=1) for x in torch.split(stokes, 4 * colors, dim=1))
        mean = _mean(s0)
        brightness = avg_pool2d(_mean(mean.chunk(4, dim=1)), 3, 1, 1, count_include_pad=False).clamp(min=0)
        brightness = brightness + MIN_BRIGHTNESS
        moments = find_moments((s0, s1, s2), self._whole_colors(masks))
        polarizations, contrast = fit_diffuse_polarization(moments[:, :3], brightness)
        a1, a2 = polarizations[-1].chunk(2, dim=1)
        b1, b2 = (_mean(values) - a * mean for values, a in ((s1, a1), (s2, a2)))
        m1, m2, m0, both = moments.chunk(4, dim=1)
        residual = 0.5 * (both - 2 * (a1 * m1 + a2 * m2) + (a1 * a1 + a2 * a2) * m0)
        residual = torch.sqrt(residual.clamp(min=0) + 1e-12)
        clipped_offset, clipped_s0 = self.unclip(planes, masks, polarizations[-1])
        b1, b2 = b1 + clipped_offset[:, :1], b2 + clipped_offset[:, 1:]
        s0 = tuple(x + clipped_s0[:, c : c + 1] for c, x in enumerate(s0))
        specular = white_specular((b1, b2), (a1, a2), 1e-12).clamp(min=0)
        specular = torch.minimum(specular, reduce(torch.minimum, s0).clamp(min=0))
        diffuse = torch.cat([color - specular for color in s0], dim=1)
        # p - a d = b + a s is the specular polarization.
        direction = [_mean((b + a * specular).chunk(4, dim=1)) for b, a in ((b1, a1), (b2, a2))]
        length = torch.sqrt(direction[0] ** 2 + direction[1] ** 2 + 1e-12)
        maps = {
            "samples": planes / brightness,
            "clipped": masks,
            "unclipped_around": 1 - max_pool2d(masks, 3, 1, 1).amax(dim=1, keepdim=True),
            "cosine": _mean(s1) / brightness,
            "sine": _mean(s2) / brightness,
            "diffuse": diffuse / brightness,
            "specular": specular / brightness,
            "wide": polarizations[0],
            "narrow": polarizations[1],
            "contrast": contrast,
            "fit_residual": residual / brightness,
            "log_brightness": torch.log(brightness),
        }
        inputs = torch.cat([maps[name] for name in seen_maps(self.inputs)], dim=1)
        polarization = torch.cat([a1, a2, direction[0] / length, direction[1] / length], dim=1)
        polarized = stokes[:, 4 * colors :]
        return ClosedForm(diffuse, specular, polarized, brightness, residual, polarization, clipped_s0, inputs)

    def _cells_of_colors(self) -> list[list[int]]:
        """The cells of each colour among the four of a packed pixel, in reading order."""
        found = [min(self.layout.filter_at(2 * (k // 2), 2 * (k % 2))[1], self.colors - 1) for k in range(4)]
        return [[k for k in range(4) if found[k] == c] for c in range(self.colors)]

    def _whole_colors(self, masks: Tensor) -> list[Tensor]:
        """1 where no sample of a colour clips in a packed pixel, of every colour ``[N, 1, h, w]``."""
        cells = _by_analyser(masks).amax(dim=0).view(4, masks.shape[0], 1, *masks.shape[2:])
        return [1 - cells[own].amax(dim=0) for own in self._cells_of_colors()]

    def unclip(self, planes: Tensor, masks: Tensor, diffuse_polarization: Tensor) -> tuple[Tensor, Tensor]:
        """Light that clipping hid: of the offset b ``[N, 2, h, w]``, and of every colour's s0 ``[N, C, h, w]``.

        In a packed pixel of four cells the samples that did not clip determine b and the cells' s0 for a given
        diffuse polarization (`closed_form.fit_unclipped`). What that differs from a fit to all samples as they
        are is missing from images that took them so. Zero where nothing clips, or where too few samples are
        left; and for one colour, whose cells clip behind the same analysers: it gained nothing there
        (docs/experiments.md).
        """
        if self.colors == 1:
            return torch.zeros_like(diffuse_polarization), torch.zeros_like(diffuse_polarization[:, :1])
        n, h, w = planes.shape[0], *planes.shape[2:]
        samples, kept = _by_analyser(planes), 1 - _by_analyser(masks)
        a = diffuse_polarization.movedim(1, 0).reshape(2, -1)
        angles = tuple(math.radians(angle) for row in self.layout.polarizer for angle in row)
        seen, s0_seen, _ = fit_unclipped(2 * samples, torch.ones_like(kept), a, angles)
        b, s0, determined = fit_unclipped(2 * samples, kept, a, angles)
        determined = determined & (kept.amin(dim=(0, 1)) == 0)
        lacking = torch.where(determined & (kept.amax(dim=0) > 0), s0 - s0_seen, 0.0).clamp(min=0)
        lift = [_mean([lacking[k] for k in cells]) for cells in self._cells_of_colors()]
        moved = torch.cat([torch.where(determined, b - seen, 0.0), torch.stack(lift)])
        found = moved.view(2 + self.colors, n, h, w).movedim(0, 1)
        return found[:, :2], found[:, 2:]


def _by_analyser(packed: Tensor) -> Tensor:
    """Packed samples ``[N, 16, h, w]`` as ``[4, 4, N h w]``, of every analyser, in reading order, and cell."""
    n, _, h, w = packed.shape
    return packed.view(n, 2, 2, 2, 2, h, w).permute(2, 4, 1, 3, 0, 5, 6).reshape(4, 4, n * h * w)


def find_moments(stokes: tuple[tuple[Tensor, ...], ...], whole: list[Tensor]) -> Tensor:
    """Covariances of the colours' s0 with their s1, s2, s0, and variance of s1, s2; means over cells ``[N, 4, h, w]``.

    ``stokes``: s0, s1, s2, of every colour ``[N, 4, h, w]``; ``whole``: 1 for colours that count, of every colour
    ``[N, 1, h, w]``. Deviations are from the mean over the colours, so one colour alone has none.
    """
    s0, s1, s2 = (_deviations(values, whole) for values in stokes)
    products = [[x * y for x, y in zip(s0, values, strict=True)] for values in (s1, s2, s0)]
    products.append([x * x + y * y for x, y in zip(s1, s2, strict=True)])
    return torch.cat([_mean(_mean(product).chunk(4, dim=1)) for product in products], dim=1)


def _deviations(values: tuple[Tensor, ...], whole: list[Tensor]) -> list[Tensor]:
    """Deviations of whole colours from their mean; 0 for the others."""
    count = (_mean(whole) * len(whole)).clamp(min=1)
    mean = _mean([x * one for x, one in zip(values, whole, strict=True)]) * (len(whole) / count)
    return [(x - mean) * one for x, one in zip(values, whole, strict=True)]


def fit_diffuse_polarization(moments: Tensor, brightness: Tensor) -> tuple[list[Tensor], Tensor]:
    """The diffuse polarization ``[N, 2, h, w]`` in `WINDOWS`, widest first, and the contrast ``[N, 1, h, w]``.

    ``moments [N, 3, h, w]``: the first three of `find_moments`; ``brightness [N, 1, h, w]``: the local one.
    """
    sums = moments / brightness**2
    polarization, all_windows, pooled = torch.zeros_like(sums[:, :2]), [], sums
    for window, least in zip(WINDOWS, MIN_CONTRAST, strict=True):
        pooled = avg_pool2d(sums, window, 1, window // 2, count_include_pad=False)
        polarization = (pooled[:, :2] + least * polarization) / (pooled[:, 2:] + least)
        polarization = limit_dolp(polarization)
        all_windows.append(polarization)
    return all_windows, torch.sqrt(pooled[:, 2:] + 1e-12)


def _mean(images: Sequence[Tensor]) -> Tensor:
    """The mean of images; sums of slices, because engines reduce over channels slowly."""
    total = images[0]
    for image in images[1:]:
        total = total + image
    return total / len(images)


def _filter(planes: Tensor, weight: Tensor) -> Tensor:
    """Correlate packed samples, repeated beyond the border."""
    reach = weight.shape[-1] // 2
    return conv2d(pad(planes, (reach, reach, reach, reach), mode="replicate"), weight)


def limit(output: JointOutput) -> tuple[Tensor, Tensor, Tensor]:
    """Diffuse and specular without negative light, and the standard deviation of their errors ``[N, 2, H/2, W/2]``."""
    error = repeat_pixels(output.local_brightness, 2) * torch.exp(0.5 * output.log_variance)
    return output.diffuse.clamp(min=0), output.specular.clamp(min=0), error


def _zero_convolution(channels: int, outputs: int) -> nn.Conv2d:
    """A 1x1 convolution that gives 0 until it is trained."""
    layer = nn.Conv2d(channels, outputs, 1)
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
    return layer


def _to_names_in_files(module: nn.Module, state: dict[str, Any], prefix: str, *unused: Any) -> None:
    """Rename parameters of a state as files of weights have them; tensors keep their order."""
    del module, unused
    items = list(state.items())
    state.clear()
    for name, value in items:
        part, _, rest = name.removeprefix(prefix).partition(".")
        renamed = name.startswith(prefix) and part in NAMES_IN_FILES
        state[f"{prefix}{NAMES_IN_FILES[part]}.{rest}" if renamed else name] = value


def _from_names_in_files(module: nn.Module, state: dict[str, Any], prefix: str, *unused: Any) -> None:
    """The twin of `_to_names_in_files`."""
    del module, unused
    for ours, theirs in NAMES_IN_FILES.items():
        for name in [name for name in state if name.startswith(f"{prefix}{theirs}.")]:
            state[f"{prefix}{ours}.{name.removeprefix(f'{prefix}{theirs}.')}"] = state.pop(name)


def bilinear_filter(layout: Layout) -> Tensor:
    """Packed filter ``[24 C, 16, 3, 3]``: full-resolution s0 and half-resolution s1, s2, bilinearly.

    Found by showing `demosaic` one bright sample after the other.
    """
    middle, size = PERIOD * 4, 9 * PERIOD
    frames = torch.zeros(16, size, size)
    for k in range(16):
        frames[k, middle + k // 4, middle + k % 4] = 1
    mosaic = Mosaic(frames, layout, 0.0, 2.0)
    full, half = (fit_stokes(demosaic(mosaic)) for demosaic in (demosaic_bilinear, demosaic_bilinear_half))
    images = torch.cat([pixel_unshuffle(2 * full.s0, 4)] + [pixel_unshuffle(2 * s, 2) for s in (half.s1, half.s2)], 1)
    # The response at packed place 4 + i to a sample at packed place 4 is the weight of a neighbour at -i.
    return images[:, :, 3:6, 3:6].flip(-1, -2).transpose(0, 1).contiguous()


def predict_samples(output: JointOutput, polarization: Polarization, layout: Layout) -> Tensor:
    """The samples ``[N, 1, H, W]`` that full-resolution images explain, behind each pixel's own filter.

    m = (d_c + s + Re((a d_c + s e) exp(-2 i t))) / 2 for the analyser t and colour c of the pixel, with diffuse
    polarization a and specular direction e. Not limited at the white level.
    """
    colors = output.diffuse.shape[1]
    diffuse, specular = (pixel_unshuffle(x, PERIOD) for x in (output.diffuse, output.specular))
    samples = []
    for place in range(16):
        angle_deg, channel = layout.filter_at(place // 4, place % 4)
        turn = torch.tensor([math.cos(2 * math.radians(angle_deg)), math.sin(2 * math.radians(angle_deg))])
        a, e = ((x * turn.to(x).view(1, 2, 1, 1)).sum(dim=1) for x in polarization)
        own = diffuse[:, 16 * min(channel, colors - 1) + place]
        samples.append((own * (1 + a) + specular[:, place] * (1 + e)) / 2)
    return pixel_shuffle(torch.stack(samples, dim=1), PERIOD)
