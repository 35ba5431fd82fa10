"""A separated frame and its report: images, exposure, the light's polarizer, how well the model fits.

Statistics come from sums over pixels (`Tally`), so that a frame may be tallied in parts. All are of white light, that
is before the light's colour is multiplied back, and polarization is that of all colours together.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from array_api_compat import is_array_api_obj
from numpy.typing import NDArray

from polsep.compute.arrays import Array, constant, contiguous, namespace, on_cpu, to_numpy, to_numpy_together
from polsep.physics.stokes import MAX_DOLP, Stokes, aolp, aolp_of, dolp
from polsep.sensor.camera import Capture, Mosaic
from polsep.separation.analytic import Separation, light_polarizer_angle
from polsep.separation.images import FrameImages, Tally

#: Below this concentration of AoLP there is no single polarized light, by methods that expect errors. Chosen so that
#: 2 % of rendered frames under one lamp lie below; of others 3 % do (`python -m evaluation warned`).
MIN_CONCENTRATION = 0.34
#: The same of methods that take all polarized light for specular, or nearly all, since the diffuse light has many
#: angles.
MIN_CONCENTRATION_CLOSED = 0.29
#: Above this distance of the polarization from its model, relative to s0, highlights are coloured as metals' are. Test
#: sets down to 3 % of full exposure: up to 0.04; objects with golden highlights and no diffuse: 0.11 and more. Linear
#: demosaicking (`joint-fast`) hides a part of the distance.
MAX_RESIDUAL = 0.07
#: Pixels of which quantiles of expected errors are taken, at least.
QUANTILE_SAMPLES = 50_000

#: The layout of two photographs through a filter in a report, and where known angles of photographs count from.
PAIR_LAYOUT, PICTURE = "two crossed photographs", "picture"


@dataclass(frozen=True, eq=False, repr=False)
class SeparatedFrame:
    """A separated frame as NumPy arrays, channels last.

    ``diffuse``, ``specular``: float32 ``[h, w, C]``, C = 3 or 1, linear, 1.0 = one measurement at the white level, so
    their sum s0 reaches 2 (more where clipped highlights were recovered). ``valid``: bool ``[h, w]``, False where
    clipping left something to assumption, or where specular light is coloured as a metal's. ``dolp``: float32
    ``[h, w]``, of all channels together in white light, at most 2, the most that four analysers show, and ``aolp``:
    radians in [0, pi), image-right toward image-up.
    ``report``: JSON-able settings, statistics and warnings. ``error``: float32 ``[h, w, 2]``, the standard deviation
    that the method expects of the errors of diffuse and specular, over all colours, in the images' unit; None where a
    method expects none. ``stokes``: float32 ``[3, h, w, C]``, s0, s1, s2 as measured, on request (`measured_stokes`).
    """

    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    valid: NDArray[np.bool_]
    dolp: NDArray[np.float32]
    aolp: NDArray[np.float32]
    report: dict[str, Any]
    error: NDArray[np.float32] | None = None
    stokes: NDArray[np.float32] | None = None

    def __repr__(self) -> str:
        method, count = self.report.get("method", "no method"), len(self.report.get("warnings", ()))
        warned = f"{count} warning{'s' * (count != 1)}" if count else "no warnings"
        return f"{type(self).__name__}({method}: diffuse and specular {list(self.diffuse.shape)}, {warned})"


def reported_light(frame: SeparatedFrame) -> tuple[float, ...]:
    """The lamp's colour by the report of a frame, a gain for each of its C channels; white where it says none."""
    channels = frame.diffuse.shape[-1]
    return tuple(frame.report.get("light_color", (1.0,) * channels))[:channels]


def angle_origin(report: Mapping[str, Any]) -> str:
    """The place that angles of polarization count from by a report: `PICTURE`, its right, or another of photographs."""
    facts = report.get("photographs")
    return str(facts.get("frame", PICTURE)) if isinstance(facts, dict) else PICTURE


def require_known_angles(frame: SeparatedFrame) -> None:
    """Raise ValueError where AoLP says nothing of the picture's directions by the report: of two photographs through a
    filter, which show s1 alone, and of photographs at unknown angles, which count from the first one."""
    advice = "photograph at three or more known angles (--angles)"
    if frame.report.get("layout") == PAIR_LAYOUT:
        raise ValueError(f"expected polarization in all directions, found that of {PAIR_LAYOUT}: {advice}")
    if (origin := angle_origin(frame.report)) != PICTURE:
        raise ValueError(f"expected angles from the picture's right, found them counted from {origin}: {advice}")


def grey(stokes: Stokes) -> Stokes:
    """Stokes images ``[..., 1, h, w]`` of all colours together."""
    return stokes.map(lambda image: namespace(image).mean(image, axis=-3, keepdims=True))


def tally(separation: Separation) -> Tally:
    """Sums over all pixels of a separation."""
    xp, mean = namespace(separation.diffuse), grey(separation.stokes)
    p1, p2 = (_doubles(image[..., 0, :, :]) for image in (mean.s1, mean.s2))
    diffuse, specular = (_doubles(xp.mean(image, axis=-3)) for image in (separation.diffuse, separation.specular))
    slope, errors = separation.diffuse_polarization, separation.expected_error
    if slope is not None:
        p1, p2 = (p - slope[..., i, :, :] * diffuse for i, p in enumerate((p1, p2)))
    strength = xp.hypot(p1, p2)
    # Networks find specular light where |p| is mostly the diffuse's; in closed forms both are the same.
    weight = strength if errors is None else specular
    found: dict[str, Array] = {
        "valid": xp.sum(separation.valid),
        "above_one": xp.sum(dolp(mean) > 1),
        "s0": _total(diffuse + specular),
        "specular": _total(specular),
        "power": _total(weight * strength),
        "along": _total(weight * p1),
        "across": _total(weight * p2),
    }
    if separation.clipped is not None:
        found["clipped"] = xp.sum(separation.clipped)
    for name, image in (("residual", separation.residual), ("noise", separation.noise)):
        if image is not None:
            found[name] = _total(image)
    if errors is not None:
        for i, name in enumerate(("diffuse_variance", "specular_variance")):
            found[name] = _total(_doubles(errors[..., i, :, :]) ** 2)
    # One copy from the device for all, which is waited for once.
    sums = to_numpy(xp.stack([_doubles(value) for value in found.values()])).tolist()
    counts = ("valid", "above_one", "clipped")
    values = {name: int(x) if name in counts else x for name, x in zip(found, sums, strict=True)}
    return Tally(math.prod(separation.valid.shape), **values)


def tally_again(images: FrameImages, light: tuple[float, ...]) -> FrameImages:
    """Images in a ``light`` that were changed, with their valid pixels and sums of light and expected errors anew."""
    assert images.tally is not None
    xp, gains = namespace(images.diffuse), np.array(light[: images.diffuse.shape[-1]])

    def total(image: Array) -> NDArray[Any]:
        """Sums by channel; NumPy takes ten times as long over both axes at once."""
        return to_numpy(xp.sum(xp.sum(image, axis=0, dtype=xp.float64), axis=0))

    diffuse, specular = (float((total(image) / gains).mean()) for image in (images.diffuse, images.specular))
    sums: dict[str, Any] = {"valid": int(xp.sum(images.valid)), "s0": diffuse + specular, "specular": specular}
    if images.error is not None:
        variances = total(images.error * images.error) / gains.mean() ** 2
        sums |= {"diffuse_variance": float(variances[0]), "specular_variance": float(variances[1])}
    return replace(images, tally=replace(images.tally, **sums))


def _doubles(image: Array) -> Array:
    xp = namespace(image)
    return xp.astype(image, xp.float64)


def _total(image: Array) -> Array:
    """The sum over all pixels, in float64."""
    xp = namespace(image)
    return xp.sum(image, dtype=xp.float64)


def under_white_light(capture: Capture, light: tuple[float, ...]) -> Capture:
    """The capture as it would be in white light: the light's colour divided out of every sample."""
    if isinstance(capture, Mosaic):
        return replace(capture, light_color=light)
    gain = constant([[[gain]] for gain in light], capture.data)
    return replace(capture, data=capture.data / gain)


def in_light(separation: Separation, light: tuple[float, ...]) -> Separation:
    """The twin of `under_white_light`: the light's colour multiplied back into diffuse and specular, not Stokes.

    Expected errors are over all colours, so the mean of the colour multiplies them.
    """
    gain = constant([[[gain]] for gain in light], separation.diffuse)
    error = None if separation.expected_error is None else separation.expected_error * (math.fsum(light) / len(light))
    return replace(
        separation, diffuse=separation.diffuse * gain, specular=separation.specular * gain, expected_error=error
    )


def images_of(white: Separation, lit: Separation) -> FrameImages:
    """One frame's images, channels last: images of ``lit``, polarization and tally of ``white``, its twin.

    NumPy arrays, but on a GPU they stay there, until `on_host`.
    """

    def image(x: Array) -> Array:
        xp = namespace(x)
        here = contiguous(xp.astype(xp.moveaxis(x, -3, -1), xp.float32, copy=False))
        return to_numpy(here) if on_cpu(here) else here

    mean = grey(white.stokes)
    return FrameImages(
        image(lit.diffuse),
        image(lit.specular),
        to_numpy(white.valid) if on_cpu(white.valid) else white.valid,
        image(dolp(mean).clip(None, MAX_DOLP))[..., 0],
        image(aolp(mean))[..., 0],
        tally(white),
        None if lit.expected_error is None else image(lit.expected_error),
    )


def error_quantiles(error: NDArray[np.float32], gain: float) -> dict[str, float]:
    """Median and 95 % quantile of the expected errors ``[h, w, 2]`` for a report, in white light: divided by ``gain``.

    Of a large frame every few rows and columns are taken, some `QUANTILE_SAMPLES`. A few clipped pixels may decide
    the root mean square; the median is the error of an ordinary pixel.
    """
    step = max(1, math.isqrt(error.shape[0] * error.shape[1] // QUANTILE_SAMPLES))
    found = np.quantile(error[::step, ::step].reshape(-1, 2), (0.5, 0.95), axis=0) / gain
    return {
        f"expected_{image}_error_{name}": float(found[row, column])
        for column, image in enumerate(("diffuse", "specular"))
        for row, name in enumerate(("median", "95"))
    }


def on_host(images: FrameImages) -> FrameImages:
    """The images of a frame as NumPy arrays, copied together from a device where they are on one."""
    if on_cpu(images.diffuse):
        return images
    found = {name: image for name, image in vars(images).items() if is_array_api_obj(image)}
    arrays: dict[str, Any] = dict(zip(found, to_numpy_together(*found.values()), strict=True))
    return replace(images, **arrays)


def dominant_angle(sums: Tally) -> tuple[float, float]:
    """Dominant angle [rad, in [0, pi)] of the specular light's polarization, and its concentration in [0, 1].

    Concentration 1: one AoLP everywhere, as under one polarized light; near 0: no common direction.
    """
    angle = aolp_of(sums.along, sums.across)
    return angle, math.hypot(sums.along, sums.across) / sums.power if sums.power > 0 else 0.0


def describe(sums: Tally, expects_errors: bool) -> dict[str, Any]:
    """Statistics and warnings of a frame for its report, without what its method does not measure.

    ``expects_errors``: as of the `Method`. docs/conventions.md lists all statistics.
    """
    pixels = max(sums.pixels, 1)
    angle, concentration = dominant_angle(sums)
    brightness = sums.s0 / pixels
    remarks = []
    least = MIN_CONCENTRATION if expects_errors else MIN_CONCENTRATION_CLOSED
    if brightness > 1e-3 and concentration < least:
        remarks.append(
            f"polarized light of one angle was expected, found many (concentration {concentration:.2f}): "
            "is the light polarized, and the only one?"
        )
    statistics: dict[str, Any] = {
        "clipped_fraction": sums.clipped / pixels,
        "valid_fraction": sums.valid / pixels,
        **light_statistics(sums),
        "dolp_above_1_fraction": sums.above_one / pixels,
        "specular_aolp_deg": math.degrees(angle),
        "specular_aolp_concentration": concentration,
        "light_polarizer_deg": math.degrees(light_polarizer_angle(angle)),
    }
    if sums.residual is not None:
        misfit = sums.residual / sums.s0 if sums.s0 > 0 else 0.0
        statistics["fit_residual"] = misfit
        if brightness > 1e-3 and misfit > MAX_RESIDUAL:
            remarks.append(
                f"white highlights on coloured objects were expected, found polarization of other colours (misfit "
                f"{misfit:.2f} of the light): are there metals, or several lights?"
            )
    if sums.noise is not None:
        statistics["sample_noise"] = sums.noise / pixels
    return {"statistics": statistics, "warnings": remarks}


def light_statistics(sums: Tally) -> dict[str, float]:
    """The statistics of a frame that are of its light, and of errors in it."""
    pixels = max(sums.pixels, 1)
    found = {"mean_s0": sums.s0 / pixels, "specular_fraction": sums.specular / sums.s0 if sums.s0 > 0 else 0.0}
    if sums.diffuse_variance is not None and sums.specular_variance is not None:
        found["expected_diffuse_error"] = math.sqrt(sums.diffuse_variance / pixels)
        found["expected_specular_error"] = math.sqrt(sums.specular_variance / pixels)
    return found
