"""Scenes of signed distances and procedural albedo: the demo's still life, and random scenes for tests.

Conventions: local coordinates ``[3, N, 1]`` in scene units; albedo is linear RGB in [0, 1]. Random draws take a
generator and are the same on every machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from polsep.render.sphere_tracing import Part, PinholeCamera, PointLight, Vector

Field = Callable[[Tensor], Tensor]


def ball(radius: float) -> Field:
    """Return the signed distance to a sphere."""
    return lambda p: torch.sqrt((p * p).sum(0, keepdim=True)) - radius


def rounded_box(half: Vector, rounding: float) -> Field:
    """Return the signed distance to a box of half sizes ``half`` whose edges have radius ``rounding``."""

    def distance(p: Tensor) -> Tensor:
        q = p.abs() - torch.tensor(half).to(p).view(3, 1, 1) + rounding
        outside = torch.sqrt((q.clamp(min=0) ** 2).sum(0, keepdim=True))
        return outside + q.amax(0, keepdim=True).clamp(max=0) - rounding

    return distance


def torus(major: float, minor: float) -> Field:
    """Return the signed distance to a torus about the local z axis."""

    def distance(p: Tensor) -> Tensor:
        ring = torch.sqrt(p[:1] ** 2 + p[1:2] ** 2) - major
        return torch.sqrt(ring**2 + p[2:] ** 2) - minor

    return distance


def floor(height: float) -> Field:
    """Return the signed distance to the half space below y = height."""
    return lambda p: p[1:2] - height


def bumpy(base: Field, amplitude: float, frequency: float) -> Field:
    """``base`` displaced by a product of sines; keep amplitude * frequency below about 0.4."""

    def distance(p: Tensor) -> Tensor:
        waves = torch.sin(frequency * p[:1]) * torch.sin(frequency * p[1:2]) * torch.sin(frequency * p[2:])
        return base(p) - amplitude * waves

    return distance


def _rgb(color: Vector, like: Tensor) -> Tensor:
    return torch.tensor(color).to(like).view(3, 1, 1)


def plain(color: Vector) -> Field:
    """Return a field of one colour."""
    return lambda p: _rgb(color, p).expand_as(p)


def checker(first: Vector, second: Vector, size: float) -> Field:
    """A three-dimensional checkerboard of edge ``size``."""

    def albedo(p: Tensor) -> Tensor:
        odd = torch.floor(p / size).sum(0, keepdim=True) % 2
        return torch.where(odd > 0.5, _rgb(first, p), _rgb(second, p))

    return albedo


def stripes(first: Vector, second: Vector, size: float) -> Field:
    """Smooth sine stripes along local y with a wobble along x."""

    def albedo(p: Tensor) -> Tensor:
        phase = (p[1:2] + 0.25 * size * torch.sin(3 * p[:1] / size)) / size
        mix = torch.sigmoid(8 * torch.sin(2 * math.pi * phase))
        return mix * _rgb(first, p) + (1 - mix) * _rgb(second, p)

    return albedo


def marble(first: Vector, second: Vector, size: float) -> Field:
    """Veins: a sine distorted by octaves of sines."""

    def albedo(p: Tensor) -> Tensor:
        q = p / size
        x = q[:1] + 0.5 * q[1:2]
        for octave in (1.0, 2.1, 4.3, 8.7):
            x = x + torch.sin(octave * (q[1:2] * 1.3 + x)) / octave * 0.7 + torch.sin(octave * 1.7 * q[2:]) / octave
        mix = 0.5 + 0.5 * torch.sin(3 * x)
        return mix**2 * _rgb(first, p) + (1 - mix**2) * _rgb(second, p)

    return albedo


def cells(colors: tuple[Vector, ...], size: float, generator: torch.Generator) -> Field:
    """Voronoi patches of the given colours with about ``size`` between their centres."""
    count = 48
    centers = (torch.rand(count, 3, generator=generator) * 2 - 1) * 3.6 * size
    palette = torch.tensor(colors)[torch.randint(len(colors), (count,), generator=generator)]

    def albedo(p: Tensor) -> Tensor:
        nearest = torch.cdist(p[:, :, 0].T.contiguous(), centers.to(p)).argmin(dim=1)
        return palette.to(p)[nearest].T[..., None]

    return albedo


def still_life() -> tuple[tuple[Part, ...], PinholeCamera, PointLight]:
    """The demo's scene: a bumpy fruit, a marbled ball, a glazed ring, a chequered cube, two small balls, a table."""
    generator = torch.Generator().manual_seed(7)
    parts = (
        Part(floor(-1.0), marble((0.05, 0.05, 0.055), (0.03, 0.028, 0.026), 2.0), roughness=0.6, specular=0.6),
        Part(
            bumpy(ball(0.95), 0.012, 22.0),
            stripes((0.72, 0.05, 0.035), (0.62, 0.03, 0.03), 0.5),
            (-1.5, -0.05, 0.2),
            roughness=0.3,
        ),
        Part(ball(0.72), marble((0.75, 0.72, 0.66), (0.08, 0.2, 0.45), 0.55), (0.35, -0.28, 1.0), roughness=0.22),
        Part(
            torus(0.62, 0.26),
            stripes((0.05, 0.35, 0.3), (0.5, 0.6, 0.12), 0.35),
            (1.95, -0.1, 0.35),
            (0.35, -0.5, 0.2),
            roughness=0.25,
        ),
        Part(
            rounded_box((0.75, 0.75, 0.75), 0.1),
            checker((0.8, 0.55, 0.1), (0.15, 0.3, 0.65), 0.27),
            (0.3, -0.25, -1.6),
            (0.0, 0.6, 0.0),
            roughness=0.4,
        ),
        Part(ball(0.4), plain((0.4, 0.4, 0.4)), (-0.55, -0.6, 1.6), roughness=0.35),
        Part(
            bumpy(ball(0.33), 0.008, 30.0),
            cells(((0.7, 0.3, 0.05), (0.1, 0.4, 0.15), (0.6, 0.55, 0.4)), 0.25, generator),
            (1.25, -0.67, 1.75),
            roughness=0.28,
        ),
    )
    camera = PinholeCamera((0.0, 2.1, 9.0), (0.22, -0.12, 0.3), 26.0)
    return parts, camera, PointLight((-1.6, 3.2, 8.5), 520.0, math.radians(25))


def _random_vector(low: float, high: float, generator: torch.Generator) -> Vector:
    x, y, z = (low + (high - low) * torch.rand(3, generator=generator)).tolist()
    return (x, y, z)


def random_albedo(generator: torch.Generator, saturation: float = 1.0) -> Field:
    """Voronoi patches of random colours; ``saturation`` 0 makes them grey, 1 leaves them as drawn."""
    colors = []
    for _ in range(6):
        color = _random_vector(0.05, 0.9, generator)
        grey = sum(color) / 3
        colors.append(tuple(grey + saturation * (c - grey) for c in color))
    return cells(tuple(colors), 0.2 + 0.5 * torch.rand(1, generator=generator).item(), generator)  # type: ignore[arg-type]


def random_parts(generator: torch.Generator, count: int = 3, saturation: float = 1.0) -> tuple[Part, ...]:
    """``count`` bumpy balls, boxes and rings in random poses near the origin, with patches of random albedo."""
    parts = []
    for _ in range(count):
        size = _random_vector(0.45, 1.0, generator)
        shapes = (ball(size[0]), rounded_box(size, 0.15), torus(size[0], 0.4 * size[1]))
        shape = shapes[int(torch.randint(3, (1,), generator=generator))]
        bumps = 0.03 * torch.rand(1, generator=generator).item()
        parts.append(
            Part(
                bumpy(shape, bumps, 9.0),
                random_albedo(generator, saturation),
                _random_vector(-0.9, 0.9, generator),
                _random_vector(0, math.pi, generator),
                roughness=0.2 + 0.3 * torch.rand(1, generator=generator).item(),
            )
        )
    return tuple(parts)


def random_light(generator: torch.Generator) -> PointLight:
    """A point light in the upper hemisphere of the camera's side with a random polarizer angle."""
    x, y, z = _random_vector(-1.0, 1.0, generator)
    polarizer = math.pi * torch.rand(1, generator=generator).item()
    return PointLight((4 * x, 2 + 2 * y, 7 + 2 * z), 110.0, polarizer)
