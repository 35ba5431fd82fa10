"""Thumbnails of whole frames, which modulate the joint network (`whole_frame`), for both kinds of arrays."""

from __future__ import annotations

from polsep.compute.arrays import Array, namespace
from polsep.networks.channels import MIN_BRIGHTNESS

#: Cells of a thumbnail along each side.
SIDE = 64
#: Channels of the convolutions, each of half the resolution of the one before; of what is common.
WIDTHS, COMMON = (32, 48, 64, 96), 96
#: What is predicted of the light: ln(red / green), ln(blue / green) of the lamp's colour relative to the one divided
#: out; degree of polarization of its specular reflections; ln of room light's share of the diffuse light.
LIGHT = ("red", "blue", "dolp", "room")


def thumbnail_channels(colors: int) -> int:
    """Channels of a thumbnail: means of s0, s1, s2, maxima of s0 and of the polarized light, clipping, brightness."""
    return 5 * colors + 2


def scale_thumbnail(means: Array, largest: Array, clipped: Array) -> Array:
    """The thumbnail of means of s0, s1, s2 and maxima of s0 and of the polarized light, in white levels.

    ``[N, 3 C, SIDE, SIDE]``, ``[N, 2 C, ...]``, clipped shares ``[N, 1, ...]`` to ``[N, 5 C + 2, ...]``.
    """
    xp = namespace(means)
    s0 = means[:, : means.shape[1] // 3]
    brightness = xp.clip(xp.mean(s0, axis=(1, 2, 3), keepdims=True), min=0) + MIN_BRIGHTNESS
    light = xp.asinh(xp.concat([means, largest], axis=1) / brightness)
    return xp.concat([light, clipped, xp.broadcast_to(xp.log(brightness), clipped.shape)], axis=1)


def keep_color(thumbnail: Array, color: int) -> Array:
    """A thumbnail ``[N, 17, SIDE, SIDE]`` of a colour frame to that of a frame of one of its colours ``[N, 7, ...]``.

    Nearly what a sensor without colour filters sees of that light: maxima are over half of its samples, and the clipped
    share is that of all colours.
    """
    xp = namespace(thumbnail)
    light = xp.sinh(thumbnail[:, :15]) * xp.exp(thumbnail[:, 16:])
    means, largest = light[:, color:9:3], light[:, 9 + color :: 3]
    return scale_thumbnail(means, largest, thumbnail[:, 15:16])
