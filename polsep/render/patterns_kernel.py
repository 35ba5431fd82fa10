"""`polsep.render.textures.pattern_weight` for runs of points of one slot, bit by bit the same.

Loops run over the points of a run without branches, so that LLVM vectorises them. Unlike other kernels, nothing here
may be fused into multiply-adds: a point that rounds differently lies in another cell.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import HALF, ONE, TWO, ZERO, inlined_exactly
from polsep.render.materials import Materials
from polsep.render.textures import (
    CHECKER,
    CLOUDS,
    CRACKS,
    DOTS,
    GAIN,
    LACUNARITY,
    MIXERS,
    NOISE_GAIN,
    OCTAVE_STEP,
    PATCHES,
    PLAIN,
    PRIMES,
    RINGS,
)

#: Largest number of points in a run.
RUN = 256
# Offsets of the rows in the float and integer buffers of a run.
_X, _Y, _Z, _U, _V, _W, _FIRST, _SECOND, _NOISE = (k * RUN for k in range(9))
_I, _J, _K, _HASH, _NEXT = (k * RUN for k in range(5))
NUMBER_ROWS, INTEGER_ROWS = 9, 5

_P0, _P1, _P2 = (np.uint32(p) for p in PRIMES)
_M0, _M1 = (np.uint32(m) for m in MIXERS)
_STEP = np.uint32(OCTAVE_STEP)
_TEN_BITS, _SIXTEEN_BITS = np.uint32(1023), np.uint32(0xFFFF)
_S7, _S8, _S10, _S15, _S16, _S20 = (np.uint32(s) for s in (7, 8, 10, 15, 16, 20))
_FRACTION, _SHADE = np.float32(1 / 1024), np.float32(1 / 65536)
_THREE, _SIX, _TEN, _FIFTEEN = (np.float32(x) for x in (3, 6, 10, 15))
_NOISE_GAIN, _GAIN, _LACUNARITY = np.float32(NOISE_GAIN), np.float32(GAIN), np.float32(LACUNARITY)
_FAR = np.float32(np.inf)


class PatternTable(NamedTuple):
    """Arrays of `polsep.render.textures.Textures`: ``pattern``, ``octaves``, ``seed``, each ``[S]``.

    ``numbers [S, 15]``: the transform row by row, then warp, threshold and edge.
    """

    pattern: NDArray[np.int64]
    octaves: NDArray[np.int64]
    seed: NDArray[np.uint32]
    numbers: NDArray[np.float32]


def pattern_table(materials: Materials) -> PatternTable:
    """The table of the textures of materials; all slots are plain without textures."""
    textures, slots = materials.textures, materials.roughness.numel()
    if textures is None:
        plain = np.full(slots, PLAIN)
        return PatternTable(plain, plain, np.zeros(slots, np.uint32), np.ones((slots, 15), np.float32))
    numbers = [textures.transform.reshape(slots, 12).numpy()]
    numbers += [x.numpy()[:, None] for x in (textures.warp, textures.threshold, textures.edge)]
    return PatternTable(
        textures.pattern.numpy(),
        textures.octaves.numpy(),
        textures.seed.numpy().astype(np.uint32),
        np.concatenate(numbers, axis=1, dtype=np.float32),
    )


@inlined_exactly
def _ramp(x: Any) -> Any:
    """`textures.ramp`."""
    x = min(max(x, ZERO), ONE)
    return x * x * (_THREE - TWO * x)


@inlined_exactly
def _floor(x: Any) -> Any:
    """The largest whole number up to x, as int32; for lattice coordinates, which are small."""
    whole = np.int32(x)
    return np.int32(whole - np.int32(x < np.float32(whole)))


@inlined_exactly
def _wave(x: Any) -> Any:
    """`textures.wave`."""
    return abs(TWO * (x - np.float32(_floor(x))) - ONE)


@inlined_exactly
def _mix(h: Any) -> Any:
    """`textures.hash_cell` from the combined lattice coordinates on."""
    h = np.uint32(h ^ (h >> _S16))
    h = np.uint32(h * _M0)
    h = np.uint32(h ^ (h >> _S15))
    h = np.uint32(h * _M1)
    return np.uint32(h ^ (h >> _S16))


@inlined_exactly
def _fraction(h: Any, shift: Any) -> Any:
    """Ten bits as a fraction; via signed integers, which every CPU converts fast."""
    return np.float32(np.int32(np.uint32(h >> shift) & _TEN_BITS)) * _FRACTION


@inlined_exactly
def _shade(h: Any) -> Any:
    """The shade of a cell, as in `textures.cells`."""
    h = np.uint32((h ^ (h >> _S7)) * _M0)
    return np.float32(np.int32(np.uint32(h >> _S8) & _SIXTEEN_BITS)) * _SHADE


@inlined_exactly
def _gradient(h: Any, x: Any, y: Any, z: Any) -> Any:
    """Product of a lattice point's random gradient with (x, y, z)."""
    gx = TWO * _fraction(h, np.uint32(0)) - ONE
    gy = TWO * _fraction(h, _S10) - ONE
    gz = TWO * _fraction(h, _S20) - ONE
    return gx * x + gy * y + gz * z


@inlined_exactly
def _fade(t: Any) -> Any:
    """Perlin's quintic interpolant."""
    return t * t * t * (t * (t * _SIX - _FIFTEEN) + _TEN)


@inlined_exactly
def gradient_noise(x: Any, y: Any, z: Any, seed: Any) -> Any:
    """`textures.gradient_noise` at one point."""
    i, j, k = _floor(x), _floor(y), _floor(z)
    x, y, z = x - np.float32(i), y - np.float32(j), z - np.float32(k)
    i0, j0, k0 = np.uint32(np.uint32(i) * _P0), np.uint32(np.uint32(j) * _P1), np.uint32(np.uint32(k) * _P2)
    i1, j1, k1 = np.uint32(i0 + _P0), np.uint32(j0 + _P1), np.uint32(k0 + _P2)
    x1, y1, z1 = x - ONE, y - ONE, z - ONE
    u, v, w = _fade(x), _fade(y), _fade(z)
    a = _gradient(_mix(i0 ^ j0 ^ k0 ^ seed), x, y, z)
    b = _gradient(_mix(i0 ^ j0 ^ k1 ^ seed), x, y, z1)
    near = a + w * (b - a)
    a = _gradient(_mix(i0 ^ j1 ^ k0 ^ seed), x, y1, z)
    b = _gradient(_mix(i0 ^ j1 ^ k1 ^ seed), x, y1, z1)
    far = a + w * (b - a)
    left = near + v * (far - near)
    a = _gradient(_mix(i1 ^ j0 ^ k0 ^ seed), x1, y, z)
    b = _gradient(_mix(i1 ^ j0 ^ k1 ^ seed), x1, y, z1)
    near = a + w * (b - a)
    a = _gradient(_mix(i1 ^ j1 ^ k0 ^ seed), x1, y1, z)
    b = _gradient(_mix(i1 ^ j1 ^ k1 ^ seed), x1, y1, z1)
    far = a + w * (b - a)
    right = near + v * (far - near)
    return left + u * (right - left)


@inlined_exactly
def _octave_noise(f: Any, count: int, seed: Any, octaves: int) -> None:
    """`textures.octave_noise` of a run, to row NOISE."""
    for n in range(count):
        f[_NOISE + n] = ZERO
    scale, gain = ONE, _NOISE_GAIN
    for _ in range(octaves):
        for n in range(count):
            noise = gradient_noise(f[_X + n] * scale, f[_Y + n] * scale, f[_Z + n] * scale, seed)
            f[_NOISE + n] = f[_NOISE + n] + gain * noise
        scale, gain, seed = scale * _LACUNARITY, gain * _GAIN, np.uint32(seed + _STEP)


@inlined_exactly
def _visit_cell(f: Any, k: Any, count: int, step: tuple[Any, Any, Any], seed: Any) -> None:
    """Update the two nearest centres of every point by the centre in the cell at this ``step`` from its own."""
    di, dj, dk = np.uint32(step[0]) * _P0, np.uint32(step[1]) * _P1, np.uint32(step[2]) * _P2
    di, dj, dk = np.uint32(di), np.uint32(dj), np.uint32(dk)
    sx, sy, sz = np.float32(step[0]), np.float32(step[1]), np.float32(step[2])
    for n in range(count):
        h = _mix(np.uint32(k[_I + n] + di) ^ np.uint32(k[_J + n] + dj) ^ np.uint32(k[_K + n] + dk) ^ seed)
        x = (sx + _fraction(h, np.uint32(0))) - f[_U + n]
        y = (sy + _fraction(h, _S10)) - f[_V + n]
        z = (sz + _fraction(h, _S20)) - f[_W + n]
        distance = x * x + y * y + z * z
        first, second, first_hash = f[_FIRST + n], f[_SECOND + n], k[_HASH + n]
        closer, between = distance < first, distance < second
        f[_SECOND + n] = first if closer else (distance if between else second)
        k[_NEXT + n] = first_hash if closer else (h if between else k[_NEXT + n])
        f[_FIRST + n] = distance if closer else first
        k[_HASH + n] = h if closer else first_hash


@inlined_exactly
def _find_cells(f: Any, k: Any, count: int, seed: Any) -> None:
    """`textures.cells` of a run: distances to rows FIRST and SECOND, hashes to HASH and NEXT."""
    for n in range(count):
        i, j, m = _floor(f[_X + n]), _floor(f[_Y + n]), _floor(f[_Z + n])
        f[_U + n] = f[_X + n] - np.float32(i)
        f[_V + n] = f[_Y + n] - np.float32(j)
        f[_W + n] = f[_Z + n] - np.float32(m)
        k[_I + n] = np.uint32(np.uint32(i) * _P0)
        k[_J + n] = np.uint32(np.uint32(j) * _P1)
        k[_K + n] = np.uint32(np.uint32(m) * _P2)
        f[_FIRST + n] = f[_SECOND + n] = _FAR
        k[_HASH + n] = k[_NEXT + n] = np.uint32(0)
    for cell in range(27):
        step = (np.int32(cell // 9 - 1), np.int32(cell // 3 % 3 - 1), np.int32(cell % 3 - 1))
        _visit_cell(f, k, count, step, seed)
    for n in range(count):
        f[_FIRST + n] = math.sqrt(f[_FIRST + n])
        f[_SECOND + n] = math.sqrt(f[_SECOND + n])


@inlined_exactly
def _weigh_cells(f: Any, k: Any, count: int, which: int, threshold: Any, edge: Any) -> None:
    """Weights of PATCHES, CRACKS and DOTS from the rows of `_find_cells`, to row X."""
    if which == PATCHES:
        for n in range(count):
            first, second = _shade(k[_HASH + n]), _shade(k[_NEXT + n])
            share = HALF - HALF * _ramp((f[_SECOND + n] - f[_FIRST + n]) / edge)
            f[_X + n] = first + share * (second - first)
    elif which == CRACKS:
        for n in range(count):
            f[_X + n] = _ramp(((f[_SECOND + n] - f[_FIRST + n]) - threshold) / edge)
    else:
        for n in range(count):
            f[_X + n] = _ramp((threshold - f[_FIRST + n]) / edge)


@inlined_exactly
def _weigh_noise(f: Any, count: int, which: int, threshold: Any, edge: Any, warp: Any) -> None:
    """Weights of CLOUDS, RINGS and STRIPES from row NOISE, to row X."""
    if which == CLOUDS:
        for n in range(count):
            f[_X + n] = _ramp((f[_NOISE + n] - threshold) / edge + HALF)
        return
    if which == RINGS:
        for n in range(count):
            f[_X + n] = math.sqrt(f[_X + n] * f[_X + n] + f[_Y + n] * f[_Y + n])
    for n in range(count):
        f[_X + n] = _ramp((_wave(f[_X + n] + warp * f[_NOISE + n]) - threshold) / edge + HALF)


@inlined_exactly
def _side(x: Any, edge: Any) -> Any:
    """Side of a checker's borders along one axis, from -1 to 1, smooth across an ``edge``."""
    return min(max((_wave(HALF * x) - HALF) / edge, -ONE), ONE)


@inlined_exactly
def weigh_run(table: PatternTable, slot: int, count: int, f: Any, k: Any) -> None:
    """Replace row x of ``f`` by the weights of ``count`` points of one slot.

    ``f [NUMBER_ROWS RUN]`` starts with the rows x, y and z of `RUN` numbers each; ``k [INTEGER_ROWS RUN]``: work space.
    """
    p, which, seed = table.numbers[slot], table.pattern[slot], table.seed[slot]
    if which == PLAIN:
        for n in range(count):
            f[_X + n] = ZERO
        return
    for n in range(count):
        x, y, z = f[_X + n], f[_Y + n], f[_Z + n]
        f[_X + n] = p[0] * x + p[1] * y + p[2] * z + p[3]
        f[_Y + n] = p[4] * x + p[5] * y + p[6] * z + p[7]
        f[_Z + n] = p[8] * x + p[9] * y + p[10] * z + p[11]
    warp, threshold, edge = p[12], p[13], p[14]
    if which in (PATCHES, CRACKS, DOTS):
        _find_cells(f, k, count, seed)
        _weigh_cells(f, k, count, which, threshold, edge)
    elif which == CHECKER:
        for n in range(count):
            x, y, z = _side(f[_X + n], edge), _side(f[_Y + n], edge), _side(f[_Z + n], edge)
            f[_X + n] = HALF + HALF * (x * y * z)
    else:
        _octave_noise(f, count, seed, table.octaves[slot])
        _weigh_noise(f, count, which, threshold, edge, warp)
