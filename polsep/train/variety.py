"""What training examples have beyond `render.views`: close-ups, relief, grey, plain, matte and rough objects, cameras.

Whoever uses a trained network photographs more than objects that fill the frame, by one camera. Draws take a generator.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from polsep.physics.stokes import Stokes
from polsep.render.materials import Materials
from polsep.render.raycast import MeshScene, View, find_lit, find_view, shade_view
from polsep.render.relief_kernel import Relief, roughen_normals
from polsep.render.sphere_tracing import PointLight, Scene, pixel_side
from polsep.render.views import MIN_LIT, PREVIEW_SIZE, Shot, lit_share, random_light
from polsep.sensor.camera import IMX250, Sensor

#: Share of the views that show a part of the object, and how many times larger than the whole, log-uniform.
CLOSE_SHARE, MAGNIFICATIONS = 0.5, (1.0, 5.0)
#: Shares of the looks of which all is near-grey, of those on near-white ground, as painted and printed things have, and
#: of those without textures.
GREY_SHARE, WHITE_SHARE, PLAIN_SHARE = 0.3, 0.25, 0.2
#: Share of the looks that are matte: what is left of their specular light, log-uniform for every material. Photographs
#: of painted, dusty or paper things have half a percent of it, which random materials rarely have.
MATTE_SHARE, MATTE_STRENGTH = 0.4, (0.005, 1.0)
#: Share of the looks whose highlights clip all analysers over an area, as mirror images of lamps do, which points of
#: light do not make. How bright their middle is against the diffuse light, log-uniform; roughness from which on it is
#: less.
GLARE_SHARE, GLARES, GLARE_ROUGHNESS = 0.25, (30.0, 3000.0), 0.4
#: Share of the looks whose diffuse light is less polarized than Fresnel's transmission says, as behind rough surfaces,
#: and the share of those whose diffuse light is not polarized at all; the others keep a uniform share of it.
DEPOLARIZED_SHARE, UNPOLARIZED_SHARE = 0.4, 0.3
#: Share of the looks in which a part of the diffuse light keeps the polarization of the lamp, as light that was
#: scattered once does (Ma et al. 2007), and how much of it, log-uniform. Crossed polarizers count it as specular; on
#: matte photographs it is most of what they measure.
RETAINING_SHARE, RETAINED = 0.6, (0.002, 0.03)
#: Share of these in which how much is kept follows a rough lobe over the surface instead of being the same everywhere,
#: as on painted and paper things. The lobe's roughness, and its most over its median.
SHEEN_SHARE, SHEEN_ROUGHNESS, MAX_SHEEN = 0.6, (0.5, 1.0), 4.0
#: Saturation that near-grey and near-white looks keep, at most; the largest albedo of white ground at least.
GREY_SATURATION, WHITE = 0.15, 0.6
#: Standard deviation of the lens's point spread in raw pixels: that of `views.BLURS` and, slightly defocused, more.
BLURS = (0.3, 1.2)
#: Electrons at the white level, log-uniform: a gain of 12 to 0 dB on cameras like the IMX250, and larger pixels.
FULL_WELLS = (2_600.0, 21_000.0)
#: Bits of the converter, and their shares.
BITS, BITS_SHARES = (8, 10, 12), (0.15, 0.15, 0.7)
#: Share of the views with fine relief. Pixels along its largest cells and tangent of its tilt, log-uniform; octaves at
#: most, while the finest cells are no smaller than the limit.
RELIEF_SHARE, RELIEF_PIXELS, RELIEF_TILTS = 0.5, (3.0, 60.0), (0.05, 0.6)
MAX_OCTAVES, MIN_CELL = 3, 2.5
#: Lights are drawn anew, at most so many times, while they leave most of a view dark.
MAX_DRAWS = 10


class Look(NamedTuple):
    """What `render.raycast.shade_view` takes: a view, its materials, a light, and what that reaches."""

    view: View
    materials: Materials
    light: PointLight
    lit: tuple[Tensor, ...]


def vary_shot(shape: MeshScene, shot: Shot, generator: torch.Generator) -> Shot:
    """A shot of the whole object, or of the surroundings of a lit point of it, through another lens."""
    close, magnification, softness = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
    shot = replace(shot, blur=BLURS[0] * (BLURS[1] / BLURS[0]) ** softness)
    if close >= CLOSE_SHARE:
        return shot
    view = find_view(shape, shot.camera, PREVIEW_SIZE)
    lit = find_lit(shape, view, shot.light)
    points = [band.hits.position[:, seen[0, :, 0], 0] for band, seen in zip(view.bands, lit, strict=True)]
    places = torch.cat(points, dim=1)
    target = places[:, int(torch.randint(places.shape[1], (1,), generator=generator))]
    larger = MAGNIFICATIONS[0] * (MAGNIFICATIONS[1] / MAGNIFICATIONS[0]) ** magnification
    fov = 2 * math.degrees(math.atan(math.tan(math.radians(shot.camera.fov_deg) / 2) / larger))
    x, y, z = (round(c, 6) for c in target.tolist())
    return replace(shot, camera=replace(shot.camera, target=(x, y, z), fov_deg=round(fov, 6)))


def relight(shape: MeshScene, shot: Shot, generator: torch.Generator) -> PointLight:
    """Another light for a shot, one that reaches much of what is seen."""
    for _ in range(MAX_DRAWS):
        light = random_light(shot.camera, shape.size / 2, generator)
        if lit_share(shape, replace(shot, light=light)) >= MIN_LIT:
            break
    return light


def vary_normals(view: View, generator: torch.Generator) -> View:
    """The same view, or one of a surface with fine relief: its normals are tilted, nothing else differs."""
    wanted, width, tilt, octaves = torch.rand(4, generator=generator, dtype=torch.float64).tolist()
    seed = int(torch.randint(2**31, (1,), generator=generator))
    positions = [band.hits.position[..., 0] for band in view.bands]
    if wanted >= RELIEF_SHARE or not any(p.shape[1] for p in positions):
        return view
    eye = torch.tensor(view.camera.position, dtype=torch.float32)
    distance = float((torch.cat(positions, dim=1) - eye[:, None]).norm(dim=0).median())
    pixels = RELIEF_PIXELS[0] * (RELIEF_PIXELS[1] / RELIEF_PIXELS[0]) ** width
    most = 1 + int(math.log2(pixels / MIN_CELL))
    relief = Relief(
        frequency=1 / (pixels * distance * pixel_side(view.camera, view.size[0])),
        strength=RELIEF_TILTS[0] * (RELIEF_TILTS[1] / RELIEF_TILTS[0]) ** tilt,
        octaves=min(most, 1 + int(MAX_OCTAVES * octaves)),
        seed=seed,
    )
    bands = []
    for band in view.bands:
        normals = np.array(band.hits.normal[..., 0].numpy(), order="C")
        roughen_normals(band.hits.position[..., 0].numpy(), normals, eye.numpy(), relief)
        hits = replace(band.hits, normal=torch.from_numpy(normals)[..., None])
        bands.append(replace(band, hits=hits))
    return replace(view, bands=tuple(bands))


def vary_gloss(materials: Materials, generator: torch.Generator) -> Materials:
    """The same, or matte, or glaring."""
    matte, glare = torch.rand(2, generator=generator).tolist()
    places = torch.rand(materials.specular.shape, generator=generator)
    if matte < MATTE_SHARE:
        left = MATTE_STRENGTH[0] * (MATTE_STRENGTH[1] / MATTE_STRENGTH[0]) ** places
        return replace(materials, specular=materials.specular * left)
    if matte < MATTE_SHARE + GLARE_SHARE:
        # The lobe's peak over an albedo of a half: F / (4 pi r^4) over 0.5 / pi, for F = 0.04.
        narrow = materials.roughness.clamp(max=GLARE_ROUGHNESS) ** 4
        stronger = GLARES[0] * (GLARES[1] / GLARES[0]) ** glare * narrow / 0.02
        return replace(materials, specular=materials.specular * stronger.clamp(min=1))
    return materials


def vary_colors(materials: Materials, generator: torch.Generator) -> Materials:
    """The same, near-grey, on near-white ground or without textures at random."""
    grey, plain, saturation = torch.rand(3, generator=generator).tolist()
    if plain < PLAIN_SHARE:
        materials = replace(materials, textures=None)
    if grey >= GREY_SHARE + WHITE_SHARE:
        return materials
    saturation *= GREY_SATURATION
    albedo, textures = _desaturate(materials.albedo, saturation), materials.textures
    if grey >= GREY_SHARE:
        value = albedo.amax(dim=1, keepdim=True)
        return replace(materials, albedo=albedo * (WHITE + (1 - WHITE) * value) / value)
    if textures is not None:
        textures = replace(textures, albedo=_desaturate(textures.albedo, saturation))
    return replace(materials, albedo=albedo, textures=textures)


def vary_polarization(scene: Scene, generator: torch.Generator) -> Scene:
    """The same, or with less polarized diffuse light."""
    wanted, none, kept = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
    if wanted >= DEPOLARIZED_SHARE:
        return scene
    kept = 0.0 if none < UNPOLARIZED_SHARE else kept
    s0, s1, s2 = scene.diffuse.s0, scene.diffuse.s1, scene.diffuse.s2
    return replace(scene, diffuse=Stokes(s0, kept * s1, kept * s2))


def vary_retention(scene: Scene, sheen: Callable[[float], Stokes], generator: torch.Generator) -> Scene:
    """The same, or with a share of the diffuse light added as white light.

    It is polarized at the AoLP of all highlights together, or as ``sheen`` of a roughness says (`find_sheen`).
    """
    wanted, place, shaped, rough = torch.rand(4, generator=generator, dtype=torch.float64).tolist()
    if wanted >= RETAINING_SHARE:
        return scene
    share = RETAINED[0] * (RETAINED[1] / RETAINED[0]) ** place
    specular = scene.specular
    kept = share * scene.diffuse.s0.mean(dim=0, keepdim=True)
    if shaped < SHEEN_SHARE:
        lobe = sheen(SHEEN_ROUGHNESS[0] + (SHEEN_ROUGHNESS[1] - SHEEN_ROUGHNESS[0]) * rough)
        return replace(scene, specular=specular + lobe.map(lambda s: kept * s))
    angle = math.atan2(float(specular.s2.double().sum()), float(specular.s1.double().sum()))
    more = Stokes(specular.s0 + kept, specular.s1 + kept * math.cos(angle), specular.s2 + kept * math.sin(angle))
    return replace(scene, specular=more)


def find_sheen(look: Look, roughness: float) -> Stokes:
    """Specular light ``[1, H, W]`` of an even ``roughness``, relative to the diffuse light of white, 1 in the median.

    At most `MAX_SHEEN`, and 0 where no light falls.
    """
    slots = look.materials.roughness.numel()
    white = Materials(torch.ones(slots, 3), torch.full((slots,), roughness), torch.ones(slots))
    scene = shade_view(look.view, white, look.light, look.lit)
    lobe, diffuse = scene.specular.map(lambda s: s[:1]), scene.diffuse.s0.mean(dim=0, keepdim=True)
    lit = diffuse > 0
    ratio = torch.where(lit, lobe.s0 / diffuse.clamp(min=torch.finfo(diffuse.dtype).tiny), 0.0)
    middle = float(ratio[lit].median()) if bool(lit.any()) else 1.0
    wanted = (ratio / max(middle, 1e-12)).clamp(max=MAX_SHEEN)
    scale = torch.where(lobe.s0 > 0, wanted / lobe.s0.clamp(min=torch.finfo(diffuse.dtype).tiny), 0.0)
    return lobe.map(lambda s: scale * s)


def _desaturate(albedo: Tensor, saturation: float) -> Tensor:
    """Albedos ``[S, 3]`` with this share of their own saturation, as bright as before."""
    value = albedo.amax(dim=1, keepdim=True)
    return value + saturation * (albedo - value)


def random_sensor(generator: torch.Generator) -> Sensor:
    """The IMX250's filters and read noise with another full well and converter."""
    place = float(torch.rand(1, generator=generator, dtype=torch.float64))
    bits = BITS[int(torch.multinomial(torch.tensor(BITS_SHARES), 1, generator=generator))]
    return replace(IMX250, full_well=FULL_WELLS[0] * (FULL_WELLS[1] / FULL_WELLS[0]) ** place, bits=bits)
