"""Variations of training examples beyond `render.views`: close-ups, relief, colours, gloss, polarization, cameras.

Users photograph more than objects that fill the frame, and with more than one camera. All draws take a generator.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

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

#: Share of close-ups among the views, and their magnification, log-uniform.
CLOSE_SHARE, MAGNIFICATIONS = 0.5, (1.0, 5.0)
#: Shares of frames that are near-grey, that have a near-white ground, as painted and printed things have, and that have
#: no textures.
GREY_SHARE, WHITE_SHARE, PLAIN_SHARE = 0.25, 0.35, 0.2
#: Share of matte frames, and the factor on their specular strength, log-uniform for every material. Photographs of
#: painted, dusty or paper things have half a percent of the usual strength, which random materials rarely have.
MATTE_SHARE, MATTE_STRENGTH = 0.5, (0.005, 1.0)
#: Share of frames whose highlights clip all analysers over an area, as mirror images of lamps do and those of point
#: lights do not. Brightness of their middle over the diffuse light, log-uniform; roughness above which it is less.
GLARE_SHARE, GLARES, GLARE_ROUGHNESS = 0.25, (30.0, 3000.0), 0.4
#: Share of frames whose diffuse light is less polarized than by Fresnel transmission, as behind rough surfaces, and the
#: share of these whose diffuse light is unpolarized; the others keep a uniform share of the polarization.
DEPOLARIZED_SHARE, UNPOLARIZED_SHARE = 0.4, 0.3
#: Share of frames in which a part of the diffuse light keeps the polarization of the lamp, as single scattering does
#: (Ma et al. 2007), and that part, log-uniform. Crossed polarizers count it as specular; on matte photographs it is
#: most of what they measure.
RETAINING_SHARE, RETAINED = 0.6, (0.002, 0.03)
#: Share of these in which that part follows a rough specular lobe instead of being constant, as on painted and paper
#: things; the lobe's roughness, and its maximum over its median.
SHEEN_SHARE, SHEEN_ROUGHNESS, MAX_SHEEN = 0.6, (0.5, 1.0), 4.0
#: Largest factor on the saturation of near-grey and near-white frames; smallest albedo maximum of white ground.
GREY_SATURATION, WHITE = 0.15, 0.6
#: Standard deviation of the lens's point spread in raw pixels: from that of `views.BLURS` to slight defocus.
BLURS = (0.3, 1.2)
#: Electrons at the white level, log-uniform: cameras like the IMX250 with a gain of 12 to 0 dB, and larger pixels.
FULL_WELLS = (2_600.0, 21_000.0)
#: Bits of the converter, and their shares.
BITS, BITS_SHARES = (8, 10, 12), (0.15, 0.15, 0.7)
#: Share of views with fine relief. Size of its largest cells in pixels and tangent of its tilt, log-uniform; most
#: octaves, as long as the finest cells reach the least size in pixels.
RELIEF_SHARE, RELIEF_PIXELS, RELIEF_TILTS = 0.5, (3.0, 60.0), (0.05, 0.6)
MAX_OCTAVES, MIN_CELL = 3, 2.5
#: Most draws of a light that leaves most of a view dark.
MAX_DRAWS = 10


def log_between(interval: tuple[float, float], share: Tensor | float) -> Any:
    """Return the value at a ``share`` in [0, 1] of the interval on a logarithmic scale."""
    low, high = interval
    return low * (high / low) ** share


class LitView(NamedTuple):
    """Arguments of `render.raycast.shade_view`: a view, its materials, a light, and the hits that it reaches."""

    view: View
    materials: Materials
    light: PointLight
    lit: tuple[Tensor, ...]


def vary_shot(shape: MeshScene, shot: Shot, generator: torch.Generator) -> Shot:
    """Return a shot of the whole object, or a close-up around a lit point, through another lens."""
    close, magnification, softness = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
    shot = replace(shot, blur=log_between(BLURS, softness))
    if close >= CLOSE_SHARE:
        return shot
    view = find_view(shape, shot.camera, PREVIEW_SIZE)
    lit = find_lit(shape, view, shot.light)
    points = torch.cat([band.hits.position[:, x[0, :, 0], 0] for band, x in zip(view.bands, lit, strict=True)], dim=1)
    target = points[:, int(torch.randint(points.shape[1], (1,), generator=generator))]
    larger = log_between(MAGNIFICATIONS, magnification)
    fov = 2 * math.degrees(math.atan(math.tan(math.radians(shot.camera.fov_deg) / 2) / larger))
    x, y, z = (round(c, 6) for c in target.tolist())
    return replace(shot, camera=replace(shot.camera, target=(x, y, z), fov_deg=round(fov, 6)))


def relight(shape: MeshScene, shot: Shot, generator: torch.Generator) -> PointLight:
    """Return another light for a shot, one that reaches much of the visible surface."""
    for _ in range(MAX_DRAWS):
        light = random_light(shot.camera, shape.size / 2, generator)
        if lit_share(shape, replace(shot, light=light)) >= MIN_LIT:
            break
    return light


def vary_normals(view: View, generator: torch.Generator) -> View:
    """Return the view, or the same with normals tilted by fine relief."""
    wanted, width, tilt, octaves = torch.rand(4, generator=generator, dtype=torch.float64).tolist()
    seed = int(torch.randint(2**31, (1,), generator=generator))
    positions = [band.hits.position[..., 0] for band in view.bands]
    if wanted >= RELIEF_SHARE or not any(p.shape[1] for p in positions):
        return view
    eye = torch.tensor(view.camera.position, dtype=torch.float32)
    distance = float((torch.cat(positions, dim=1) - eye[:, None]).norm(dim=0).median())
    pixels = log_between(RELIEF_PIXELS, width)
    most = 1 + int(math.log2(pixels / MIN_CELL))
    relief = Relief(
        frequency=1 / (pixels * distance * pixel_side(view.camera, view.size[0])),
        strength=log_between(RELIEF_TILTS, tilt),
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
    """Return the materials, or matte ones, or ones with glaring highlights."""
    matte, glare = torch.rand(2, generator=generator).tolist()
    places = torch.rand(materials.specular.shape, generator=generator)
    if matte < MATTE_SHARE:
        return replace(materials, specular=materials.specular * log_between(MATTE_STRENGTH, places))
    if matte < MATTE_SHARE + GLARE_SHARE:
        # The lobe's peak over an albedo of a half: F / (4 pi r^4) over 0.5 / pi, for F = 0.04.
        narrow = materials.roughness.clamp(max=GLARE_ROUGHNESS) ** 4
        stronger = log_between(GLARES, glare) * narrow / 0.02
        return replace(materials, specular=materials.specular * stronger.clamp(min=1))
    return materials


def vary_colors(materials: Materials, generator: torch.Generator) -> Materials:
    """Return the materials, at random near-grey, on near-white ground or without textures."""
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
    """Return the scene, or the same with less polarized diffuse light."""
    wanted, none, kept = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
    if wanted >= DEPOLARIZED_SHARE:
        return scene
    kept = 0.0 if none < UNPOLARIZED_SHARE else kept
    s0, s1, s2 = scene.diffuse.s0, scene.diffuse.s1, scene.diffuse.s2
    return replace(scene, diffuse=Stokes(s0, kept * s1, kept * s2))


def vary_retention(scene: Scene, sheen: Callable[[float], Stokes], generator: torch.Generator) -> Scene:
    """Return the scene, or the same with a share of the diffuse light added as white specular light.

    That is polarized at the AoLP of all highlights together, or as ``sheen`` of a roughness (`render_sheen`).
    """
    wanted, place, shaped, rough = torch.rand(4, generator=generator, dtype=torch.float64).tolist()
    if wanted >= RETAINING_SHARE:
        return scene
    share = log_between(RETAINED, place)
    specular = scene.specular
    kept = share * scene.diffuse.s0.mean(dim=0, keepdim=True)
    if shaped < SHEEN_SHARE:
        lobe = sheen(SHEEN_ROUGHNESS[0] + (SHEEN_ROUGHNESS[1] - SHEEN_ROUGHNESS[0]) * rough)
        return replace(scene, specular=specular + lobe.map(lambda s: kept * s))
    angle = math.atan2(float(specular.s2.double().sum()), float(specular.s1.double().sum()))
    more = Stokes(specular.s0 + kept, specular.s1 + kept * math.cos(angle), specular.s2 + kept * math.sin(angle))
    return replace(scene, specular=more)


def render_sheen(view: LitView, roughness: float) -> Stokes:
    """Return the specular light ``[1, H, W]`` of a constant ``roughness`` over the diffuse light of white.

    Scaled to a median of 1, limited to `MAX_SHEEN`, 0 where no light falls.
    """
    slots = view.materials.roughness.numel()
    white = Materials(torch.ones(slots, 3), torch.full((slots,), roughness), torch.ones(slots))
    scene = shade_view(view.view, white, view.light, view.lit)
    lobe, diffuse = scene.specular.map(lambda s: s[:1]), scene.diffuse.s0.mean(dim=0, keepdim=True)
    lit = diffuse > 0
    ratio = torch.where(lit, lobe.s0 / diffuse.clamp(min=torch.finfo(diffuse.dtype).tiny), 0.0)
    middle = float(ratio[lit].median()) if bool(lit.any()) else 1.0
    wanted = (ratio / max(middle, 1e-12)).clamp(max=MAX_SHEEN)
    scale = torch.where(lobe.s0 > 0, wanted / lobe.s0.clamp(min=torch.finfo(diffuse.dtype).tiny), 0.0)
    return lobe.map(lambda s: scale * s)


def _desaturate(albedo: Tensor, saturation: float) -> Tensor:
    """Albedos ``[S, 3]`` with their saturation times a factor and their largest channel unchanged."""
    value = albedo.amax(dim=1, keepdim=True)
    return value + saturation * (albedo - value)


def random_sensor(generator: torch.Generator) -> Sensor:
    """Return a camera with the filters and read noise of the IMX250 and a random full well and bit depth."""
    place = float(torch.rand(1, generator=generator, dtype=torch.float64))
    bits = BITS[int(torch.multinomial(torch.tensor(BITS_SHARES), 1, generator=generator))]
    return replace(IMX250, full_well=log_between(FULL_WELLS, place), bits=bits)
