"""Scenes of training as the world has them: lamps that are not white, rooms that are not dark, errors of sensors.

Draws of the arguments of `render.disturbances` and `render.sensor_errors`, each with a probability and a range. A
network sees frames whose lamp's colour was divided out as `light` finds it, so with an error. All draws take a
generator.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from polsep.render.disturbances import (
    METALS,
    IndirectLight,
    add_indirect_light,
    add_scenes,
    add_veiling_glare,
    as_color,
    depolarize_lamp,
    make_metal,
    random_field,
    retain_polarization,
    scale_light,
    shift_colors,
)
from polsep.render.room import as_room
from polsep.render.sensor_errors import SensorErrors
from polsep.render.sphere_tracing import Scene

#: Share of scenes that stay as they are: networks must not lose on clean frames what they gain on others.
IDEAL_SHARE = 0.4
#: Share of scenes under a lamp that is not white to the sensor; red and blue, green = 1, log-uniform.
TINTED_SHARE, TINTS = 0.7, (0.3, 1.7)
#: Standard deviations of ln(red / green), ln(blue / green) of the colour that is divided out, and their shares. A
#: colour told exactly; one found on scenes with highlights; one found with little to see; one that is not known.
COLOR_ERRORS, COLOR_ERROR_SHARES = (0.0, 0.015, 0.05, 0.2), (0.25, 0.45, 0.22, 0.08)
#: Share of scenes whose lamp is not polarized completely, and its degree of polarization.
IMPERFECT_SHARE, DEGREES = 0.4, (0.75, 1.0)
#: Share of scenes with room light, its diffuse light over the lamp's, log-uniform, number of its lights, range of their
#: strengths, and least roughness of surfaces to them, log-uniform: windows and ceilings are large.
ROOM_SHARE, ROOMS, ROOM_LIGHTS, STRENGTHS, ROOM_ROUGHNESS = 0.45, (0.01, 0.6), (2, 6), (0.2, 1.8), (0.15, 0.7)
#: Share of scenes with a second lamp, and its strength over the first one's.
SECOND_SHARE, SECOND = 0.12, (0.1, 1.0)
#: Share of scenes in which a part of the diffuse light keeps the lamp's polarization, beside `variety.RETAINED`; that
#: part, log-uniform; in half of these it has the colour of the diffuse light.
RETAINING_SHARE, RETAINED = 0.15, (0.01, 0.15)
#: Share of scenes with light between coloured things; mean of its diffuse part, and of its mirrored part, log-uniform,
#: over the direct diffuse light; share of the mirrored part that keeps the lamp's polarization.
INDIRECT_SHARE, INDIRECT, MIRRORED, KEEPS = 0.35, (0.0, 0.4), (0.005, 0.2), (0.0, 0.3)
#: Share of scenes with patches of metal, and the share of the frame that is metal.
METAL_SHARE, METAL_AREA = 0.12, (0.05, 0.4)
#: Shares of scenes behind lenses with veiling glare and with lateral chromatic aberration, and their ranges.
GLARE_SHARE, GLARE, ABERRATION_SHARE, ABERRATION = 0.2, (0.002, 0.04), 0.1, 0.002
#: Share of frames exposed darker than the others, and the factor, log-uniform.
DARK_SHARE, DARK = 0.15, (0.05, 0.7)
#: Share of frames by sensors with errors, largest errors of a uniform draw, and share of these with a wrong black.
ERRORS_SHARE, ERRORS = 0.5, SensorErrors(angles_deg=1.5, gains=0.015, period_gains=0.01, cross_talk=0.025, black=0.006)
BLACK_SHARE = 0.3


class Relit(NamedTuple):
    """Renderers of a scene's surfaces: under a ``second`` lamp alone, and in unpolarized light from ``around``.

    The latter takes the lights' directions ``[N, 3]`` with strengths ``[N]``, and the least roughness.
    """

    second: Callable[[], Scene]
    around: Callable[[tuple[Tensor, Tensor], float], Scene]


class RealScene(NamedTuple):
    """A ``scene`` in the sensor's light, the lamp's colour ``told [3]`` to be divided out, and what is common to it.

    ``light [4]``: truth of `networks.whole_frame.LIGHT`. ``errors``: its sensor may have errors.
    """

    scene: Scene
    told: Tensor
    light: Tensor
    errors: bool = True


def as_ideal(scene: Scene) -> RealScene:
    """Return a scene under one perfect white lamp in a dark room, before a perfect sensor.

    A sensor's gain errors of a percent look like a percent of specular light: networks that see them in all scenes
    doubt what matte things mirror.
    """
    return RealScene(scene, torch.ones(3), describe_light(torch.zeros(2), 1.0, 0.0), errors=False)


def describe_light(color_error: Tensor, dolp: float, room: float) -> Tensor:
    """Return the truth of `networks.whole_frame.LIGHT`."""
    return torch.cat([color_error, torch.tensor([dolp, math.log(room + MIN_ROOM)])])


#: Share of room light that counts as none.
MIN_ROOM = 0.01


def disturb(scene: Scene, relit: Relit, generator: torch.Generator) -> RealScene:
    """Return a scene with random disturbances, in the order in which light meets them, or as it is."""
    draw = _Draw(generator)
    if draw.happens(IDEAL_SHARE):
        return as_ideal(scene)
    if draw.happens(RETAINING_SHARE):
        scene = retain_polarization(scene, draw.log_between(RETAINED), float(draw.happens(0.5)))
    if draw.happens(METAL_SHARE):
        scene = make_metal(scene, draw.patches(scene, draw.between(METAL_AREA)), draw.metal())
    if draw.happens(SECOND_SHARE):
        scene = add_scenes(scene, scale_light(relit.second(), draw.between(SECOND)))
    if draw.happens(INDIRECT_SHARE):
        scene = add_indirect_light(scene, draw.indirect_light(scene))
    dolp = draw.between(DEGREES) if draw.happens(IMPERFECT_SHARE) else 1.0
    scene = depolarize_lamp(scene, dolp)
    room = draw.log_between(ROOMS) if draw.happens(ROOM_SHARE) else 0.0
    if room:
        around = relit.around(draw.lights(), draw.log_between(ROOM_ROUGHNESS))
        scene = add_scenes(scene, as_room(around, scene, room, draw.tint(0.25)))
    lamp = draw.lamp_color()
    scene = scale_light(scene, lamp[:, None, None])
    if draw.happens(GLARE_SHARE):
        scene = add_veiling_glare(scene, draw.between(GLARE))
    if draw.happens(ABERRATION_SHARE):
        scene = shift_colors(scene, *(draw.between((-ABERRATION, ABERRATION)) for _ in range(2)))
    told = lamp * draw.color_error()
    told = told / told[1]
    error = torch.log(lamp / told)
    return RealScene(scene, told, describe_light((error - error[1])[[0, 2]], dolp, room))


def random_errors(generator: torch.Generator) -> SensorErrors:
    """Return the errors of a random sensor, or none."""
    draw = _Draw(generator)
    if not draw.happens(ERRORS_SHARE):
        return SensorErrors()
    angles, gains, shared, talk, black = (draw.uniform() for _ in range(5))
    black = (2 * black - 1) * ERRORS.black if draw.happens(BLACK_SHARE) else 0.0
    return replace(
        ERRORS,
        angles_deg=angles * ERRORS.angles_deg,
        gains=gains * ERRORS.gains,
        period_gains=shared * ERRORS.period_gains,
        cross_talk=talk * ERRORS.cross_talk,
        black=black,
    )


def random_darkness(generator: torch.Generator) -> float:
    """Return the factor on an exposure: 1, or less."""
    draw = _Draw(generator)
    return draw.log_between(DARK) if draw.happens(DARK_SHARE) else 1.0


class _Draw:
    """Random draws from one ``generator``, which is their state."""

    def __init__(self, generator: torch.Generator) -> None:
        self.generator = generator

    def uniform(self) -> float:
        return float(torch.rand(1, generator=self.generator, dtype=torch.float64))

    def happens(self, share: float) -> bool:
        return self.uniform() < share

    def between(self, interval: tuple[float, float]) -> float:
        low, high = interval
        return low + (high - low) * self.uniform()

    def log_between(self, interval: tuple[float, float]) -> float:
        low, high = interval
        return low * float((high / low) ** self.uniform())

    def tint(self, deviation: float) -> Tensor:
        """A colour ``[3, 1, 1]``, log-normal, green = 1."""
        tint = torch.exp(deviation * torch.randn(3, generator=self.generator))
        return as_color(tint / tint[1])

    def lights(self) -> tuple[Tensor, Tensor]:
        """Directions ``[N, 3]`` and strengths ``[N]`` of a room's lights."""
        low, high = ROOM_LIGHTS
        count = low + int((high + 1 - low) * self.uniform())
        directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=self.generator), dim=1)
        return directions, STRENGTHS[0] + (STRENGTHS[1] - STRENGTHS[0]) * torch.rand(count, generator=self.generator)

    def lamp_color(self) -> Tensor:
        """Raw colour ``[3]`` of a lamp, its largest channel 1."""
        if not self.happens(TINTED_SHARE):
            return torch.ones(3)
        color = torch.tensor([self.log_between(TINTS), 1.0, self.log_between(TINTS)])
        return color / color.max()

    def color_error(self) -> Tensor:
        """Factors ``[3]`` by which the colour that is divided out is wrong."""
        shares = torch.tensor(COLOR_ERROR_SHARES)
        deviation = COLOR_ERRORS[int(torch.multinomial(shares, 1, generator=self.generator))]
        red, blue = (deviation * torch.randn(2, generator=self.generator)).tolist()
        return torch.tensor([math.exp(red), 1.0, math.exp(blue)])

    def field(self, scene: Scene, contrast: float) -> Tensor:
        """A smooth field ``[1, H, W]`` of mean 1."""
        cells = 2 + int(7 * self.uniform())
        return random_field((1, *scene.mask.shape), cells, contrast * self.uniform(), self.generator)

    def patches(self, scene: Scene, share: float) -> Tensor:
        """1 in a share of the frame, 0 elsewhere ``[1, H, W]``."""
        field = random_field((1, *scene.mask.shape), 2 + int(5 * self.uniform()), 1.0, self.generator)
        return (field >= field.flatten().kthvalue(max(1, round((1 - share) * field.numel()))).values).float()

    def metal(self) -> Tensor:
        names = sorted(METALS)
        return as_color(METALS[names[int(len(names) * self.uniform())]])

    def indirect_light(self, scene: Scene) -> IndirectLight:
        """Coloured light from neighbours, at some places."""
        color = as_color(torch.rand(3, generator=self.generator) ** 2)
        color = color / color.mean().clamp(min=1e-3)
        places = self.field(scene, 1.0).clamp(min=0) ** self.between((1.0, 4.0))
        turn = self.between((-math.pi / 2, math.pi / 2))
        mirrored = self.log_between(MIRRORED)
        return IndirectLight(self.between(INDIRECT), mirrored, color, places, self.between(KEEPS), turn)
