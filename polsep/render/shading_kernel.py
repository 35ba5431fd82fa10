"""`materials.look_up` and `sphere_tracing.shade` for the hits of many rays, summed per pixel, in one pass on the CPU.

Unlit hits are skipped. The others are processed in blocks of pixels, sorted by slot, so that a run of points has one
material and LLVM vectorises its loops.

The light of a pixel is twelve numbers: the diffuse lobe has one geometric Stokes vector for all colours, which albedo
scales per hit; the specular lobe is white. Formulas are those of `polsep.physics.optics`, without normalizations that
cancel.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import HALF, ONE, TWO, ZERO, entry, inlined
from polsep.physics.fresnel import ETA
from polsep.render.materials import Materials
from polsep.render.patterns_kernel import INTEGER_ROWS, NUMBER_ROWS, RUN, PatternTable, pattern_table, weigh_run
from polsep.render.sphere_tracing import PinholeCamera, PointLight

#: Largest number of hits in a block; a block holds all hits of its pixels.
BLOCK = 1024
#: Numbers per pixel: diffuse s0, s1, s2 of three colours each, specular s0, s1, s2.
CHANNELS = 12

# Offsets of the rows in the buffer of a run, after those that patterns use.
_NX, _NY, _NZ, _ROUGH, _D0, _D1, _D2, _S0, _S1, _S2, _PX, _PY, _PZ, _WEIGHT = (
    (NUMBER_ROWS + k) * RUN for k in range(14)
)
_ROWS = NUMBER_ROWS + 14
_ETA, _INVERSE_ETA2 = np.float32(ETA), np.float32(1 / ETA**2)
_INVERSE_PI, _QUARTER = np.float32(1 / math.pi), np.float32(0.25)
_TINY, _IN_LINE = np.float32(np.finfo(np.float32).tiny * 4), np.float32(float(np.finfo(np.float32).eps) ** 1.5)
_MIN_SMITH, _MIN_COSINE = np.float32(1e-6), np.float32(1e-4)  # as in `optics`


class Beams(NamedTuple):
    """Camera and light: positions, the light's intensity, and cos and sin of twice its polarizer's angle."""

    camera: tuple[np.float32, np.float32, np.float32]
    light: tuple[np.float32, np.float32, np.float32]
    intensity: np.float32
    cosine: np.float32
    sine: np.float32


class Points(NamedTuple):
    """Hits in the order of their pixels: ``position``, ``normal [3, M]``; ``slot``, ``pixel``, and ``lit [M]``."""

    position: NDArray[np.float32]
    normal: NDArray[np.float32]
    slot: NDArray[np.int64]
    pixel: NDArray[np.int64]
    lit: NDArray[np.bool_]


class Table(NamedTuple):
    """Arrays of `Materials`: ``plain [S, 5]`` (albedo, roughness, specular), ``second [S, 4]``, and ``patterns``."""

    plain: NDArray[np.float32]
    second: NDArray[np.float32]
    patterns: PatternTable


def material_table(materials: Materials) -> Table:
    """The arrays of materials that `shade_pixels` reads."""
    plain = [materials.albedo.numpy(), materials.roughness.numpy()[:, None], materials.specular.numpy()[:, None]]
    second = plain[:2]
    if materials.textures is not None:
        second = [materials.textures.albedo.numpy(), materials.textures.roughness.numpy()[:, None]]
    rows = [np.concatenate(columns, axis=1, dtype=np.float32) for columns in (plain, second)]
    return Table(rows[0], rows[1], pattern_table(materials))


def shade_pixels(hits: Points, table: Table, beams: Beams, image: NDArray[np.float32]) -> None:
    """Add the light of hits to their pixels of ``image [P, 12]``; see `CHANNELS`.

    The caller divides by the samples per pixel. No pixel may have more than `BLOCK` hits.
    """
    if hits.pixel.size:
        _shade_pixels(hits, table, beams, image)


def build_beams(camera: PinholeCamera, light: PointLight) -> Beams:
    """Return the numbers of a camera and a light that `shade_pixels` reads."""
    eye, lamp = ((np.float32(p[0]), np.float32(p[1]), np.float32(p[2])) for p in (camera.position, light.position))
    cosine, sine = math.cos(2 * light.polarizer), math.sin(2 * light.polarizer)
    return Beams(eye, lamp, np.float32(light.intensity), np.float32(cosine), np.float32(sine))


@inlined
def _fresnel(c: Any) -> Any:
    """`fresnel.fresnel`: R+, R- and Rx."""
    ct = math.sqrt(ONE - (ONE - c * c) * _INVERSE_ETA2)
    rs = (c - _ETA * ct) / (c + _ETA * ct)
    rp = (_ETA * c - ct) / (_ETA * c + ct)
    s, p = rs * rs, rp * rp
    return HALF * (s + p), HALF * (s - p), rs * rp


@inlined
def _double_angle(a: Any, b: Any) -> Any:
    """cos and sin of twice the azimuth of (a, b)."""
    scale = ONE / max(a * a + b * b, _TINY)
    return (a * a - b * b) * scale, TWO * a * b * scale


@inlined
def _smith(c: Any, alpha2: Any) -> Any:
    """`optics.smith_shadowing`."""
    c = max(c, _MIN_SMITH)
    return TWO / (ONE + math.sqrt(ONE + alpha2 * max(ONE - c * c, ZERO) / (c * c)))


@inlined
def _toward(target: Any, x: Any, y: Any, z: Any) -> Any:
    """Unit vector to a point, and the squared distance."""
    x, y, z = target[0] - x, target[1] - y, target[2] - z
    square = x * x + y * y + z * z
    inverse = ONE / math.sqrt(square)
    return x * inverse, y * inverse, z * inverse, square


@inlined
def _shade_run(f: Any, count: int, beams: Beams) -> None:
    """Write the Stokes vectors of both lobes, for albedo and specular strength 1, to rows D0 to S2.

    With up = +y and a beam along v, n has the components (nx vz - nz vx, ny - vy (n v)) in the beam's frame, over one
    length, which cancels; along -l the first one changes its sign.
    """
    for n in range(count):
        nx, ny, nz = f[_NX + n], f[_NY + n], f[_NZ + n]
        vx, vy, vz, _ = _toward(beams.camera, f[_PX + n], f[_PY + n], f[_PZ + n])
        lx, ly, lz, square = _toward(beams.light, f[_PX + n], f[_PY + n], f[_PZ + n])
        cos_i, cos_o = nx * lx + ny * ly + nz * lz, nx * vx + ny * vy + nz * vz
        front = cos_i > ZERO and cos_o > ZERO
        irradiance = beams.intensity / square if front else ZERO
        ci, si = _double_angle(nz * lx - nx * lz, ny - ly * cos_i)
        co, so = _double_angle(nx * vz - nz * vx, ny - vy * cos_o)
        cos_i, cos_o = min(max(cos_i, ZERO), ONE), min(max(cos_o, ZERO), ONE)
        into_plus, into_minus, _ = _fresnel(cos_i)
        out_plus, out_minus, _ = _fresnel(cos_o)
        entered = ONE - into_plus + into_minus * (ci * beams.cosine + si * beams.sine)
        shading = cos_i * irradiance * _INVERSE_PI * entered
        f[_D0 + n] = shading * (ONE - out_plus)
        f[_D1 + n] = shading * out_minus * co
        f[_D2 + n] = shading * out_minus * so

        hx, hy, hz = vx + lx, vy + ly, vz + lz
        inverse = ONE / math.sqrt(max(hx * hx + hy * hy + hz * hz, _TINY))
        hx, hy, hz = hx * inverse, hy * inverse, hz * inverse
        alpha2 = f[_ROUGH + n] * f[_ROUGH + n]
        alpha2 = alpha2 * alpha2
        cos_h = nx * hx + ny * hy + nz * hz
        x, y, z = ny * hz - nz * hy, nz * hx - nx * hz, nx * hy - ny * hx
        spread = cos_h * cos_h * alpha2 + (x * x + y * y + z * z)
        lobe = alpha2 * _INVERSE_PI / (spread * spread) * _smith(cos_i, alpha2) * _smith(cos_o, alpha2)
        shading = irradiance * lobe * _QUARTER / max(cos_o, _MIN_COSINE)
        plus, minus, mixed = _fresnel(min(max(hx * lx + hy * ly + hz * lz, ZERO), ONE))
        x, y, z = vy * lz - vz * ly, vz * lx - vx * lz, vx * ly - vy * lx
        in_line = x * x + y * y + z * z < _IN_LINE
        # Where camera and light are in line: the y axis of the camera beam's frame, up made perpendicular to v.
        x, y, z = (-vy * vx if in_line else x), (ONE - vy * vy if in_line else y), (-vy * vz if in_line else z)
        ci, si = _double_angle(z * lx - x * lz, y - ly * (x * lx + y * ly + z * lz))
        co, so = _double_angle(x * vz - z * vx, y - vy * (x * vx + y * vy + z * vz))
        c, s = -(ci * beams.cosine + si * beams.sine), ci * beams.sine - si * beams.cosine
        a, b = plus * c - minus, mixed * s
        f[_S0 + n] = shading * (plus - minus * c)
        f[_S1 + n] = -shading * (a * co + b * so)
        f[_S2 + n] = shading * (b * co - a * so)


@inlined
def _add_run(f: Any, table: Table, slot: Any, pixels: Any, image: Any) -> None:
    """Add a run's light to its pixels."""
    plain, second = table.plain[slot], table.second[slot]
    r, g, b, specular = plain[0], plain[1], plain[2], plain[4]
    to_r, to_g, to_b = second[0] - r, second[1] - g, second[2] - b
    for n in range(pixels.size):
        weight, light = f[_WEIGHT + n], image[pixels[n]]
        d0, d1, d2 = f[_D0 + n], f[_D1 + n], f[_D2 + n]
        red, green, blue = r + weight * to_r, g + weight * to_g, b + weight * to_b
        light[0] += red * d0
        light[1] += green * d0
        light[2] += blue * d0
        light[3] += red * d1
        light[4] += green * d1
        light[5] += blue * d1
        light[6] += red * d2
        light[7] += green * d2
        light[8] += blue * d2
        light[9] += specular * f[_S0 + n]
        light[10] += specular * f[_S1 + n]
        light[11] += specular * f[_S2 + n]


@inlined
def _sort_block(hits: Points, first: int, stop: int, counts: Any, order: Any) -> None:
    """Sort the lit hits of ``range(first, stop)`` by slot into ``order``; ``counts [S + 1]``: start of each slot."""
    slots = counts.size - 1
    for s in range(slots + 1):
        counts[s] = 0
    for m in range(first, stop):
        counts[hits.slot[m]] += hits.lit[m]
    total = 0
    for s in range(slots + 1):
        count = counts[s]
        counts[s] = total
        total += count
    for m in range(first, stop):
        if hits.lit[m]:
            order[counts[hits.slot[m]]] = m
            counts[hits.slot[m]] += 1
    for s in range(slots, 0, -1):
        counts[s] = counts[s - 1]
    counts[0] = 0


@inlined
def _block_end(pixel: Any, first: int) -> int:
    """End of the block that starts at hit ``first``: at most `BLOCK` hits, without those of an incomplete pixel."""
    stop: int = min(first + BLOCK, pixel.size)
    if stop < pixel.size:
        while stop > first and pixel[stop - 1] == pixel[stop]:
            stop -= 1
    return stop


@inlined
def _gather(hits: Points, order: Any, f: Any, pixels: Any) -> None:
    """Copy position, normal and pixel of the hits ``order`` to the rows of a run."""
    for n in range(order.size):
        m = order[n]
        f[n] = f[_PX + n] = hits.position[0, m]
        f[RUN + n] = f[_PY + n] = hits.position[1, m]
        f[2 * RUN + n] = f[_PZ + n] = hits.position[2, m]
        f[_NX + n], f[_NY + n], f[_NZ + n] = hits.normal[0, m], hits.normal[1, m], hits.normal[2, m]
        pixels[n] = hits.pixel[m]


@entry
def _shade_pixels(hits: Points, table: Table, beams: Beams, image: Any) -> None:
    """Shade all hits, block by block and slot by slot."""
    slots = table.plain.shape[0]
    f, k = np.empty(_ROWS * RUN, np.float32), np.empty(INTEGER_ROWS * RUN, np.uint32)
    counts, order, pixels = np.empty(slots + 1, np.int64), np.empty(BLOCK, np.int64), np.empty(RUN, np.int64)
    stop = 0
    while stop < hits.pixel.size:
        first, stop = stop, _block_end(hits.pixel, stop)
        _sort_block(hits, first, stop, counts, order)
        for slot in range(slots):
            for start in range(counts[slot], counts[slot + 1], RUN):
                count = min(RUN, counts[slot + 1] - start)
                _gather(hits, order[start : start + count], f, pixels)
                weigh_run(table.patterns, slot, count, f, k)
                rough, change = table.plain[slot, 3], table.second[slot, 3] - table.plain[slot, 3]
                for n in range(count):
                    f[_WEIGHT + n] = f[n]
                    f[_ROUGH + n] = rough + f[n] * change
                _shade_run(f, count, beams)
                _add_run(f, table, slot, pixels[:count], image)


@entry
def spread_pixels(image: Any, scale: Any, planes: Any) -> None:
    """Fill ``planes [12, P]`` with ``image [P, 12]`` times ``scale``."""
    for first in range(0, image.shape[0], RUN):
        stop = min(first + RUN, image.shape[0])
        for channel in range(CHANNELS):
            plane = planes[channel]
            for pixel in range(first, stop):
                plane[pixel] = scale * image[pixel, channel]
