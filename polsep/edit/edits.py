"""The edits: small values, each with the pure function that applies it.

Conventions: light is linear throughout, so the effect of an edit on light is a sum that can be checked (`Edit.light`).
Every edit is continuous in its parameters and returns the same arrays at its neutral value. A ``mask`` limits it: 0
nowhere, 1 fully. Edits of the diffuse image never change the specular one, and the reverse, except the colour of the
light, which is in both.

Source: Dave et al. 2022, doi 10.1364/OE.460984, "Appearance editing application" and Fig. 8.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from polsep.edit.blur import blur, deblur
from polsep.edit.images import Floats, Maps, SeparatedImages, find_map
from polsep.edit.parameters import EditError, Parameter, color_field, image_field, number_field, parameters_of
from polsep.edit.texture import texture_of


@dataclass(frozen=True, kw_only=True)
class Edit(ABC):
    """The base of all edits: a name, a mask, and descriptions. Raises EditError on values out of range.

    ``title``: for the page. ``light``: effect on the sum of light. ``caution``: its physical limits.
    ``needs_color``: images of one colour are refused.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    light: ClassVar[str]
    caution: ClassVar[str] = ""
    needs_color: ClassVar[bool] = False

    mask: str | None = image_field("mask", "Mask of the edit, from 0 to 1; without one it acts everywhere.")

    def __post_init__(self) -> None:
        for parameter in self.parameters():
            object.__setattr__(self, parameter.name, parameter.check(getattr(self, parameter.name)))

    @classmethod
    def parameters(cls) -> tuple[Parameter, ...]:
        """The parameters: first that of the option with the edit's own name, last the mask."""
        return tuple(sorted(parameters_of(cls), key=lambda parameter: parameter.kind == "mask"))

    def is_neutral(self) -> bool:
        """True if the edit is the identity."""
        return any(p.neutral is not None and getattr(self, p.name) == p.neutral for p in self.parameters())

    def images(self) -> list[tuple[str, str]]:
        """Kind and name of each image that the edit names."""
        return [(p.kind, name) for p in self.parameters() if isinstance(name := getattr(self, p.name), str)]

    def change(self, images: SeparatedImages, maps: Maps) -> SeparatedImages:
        """The images after the edit; unchanged ones are the same arrays. Raises EditError.

        ``maps``: the images that the edit names.
        """
        if self.is_neutral():
            return images
        if self.needs_color and images.colors == 1:
            raise EditError(f"expected images in colour for {self.name}, found one channel")
        mask = None if self.mask is None else find_map(maps, "mask", self.mask, images)
        return self._changed(images, mask, maps)

    @abstractmethod
    def _changed(self, images: SeparatedImages, mask: Floats | None, maps: Maps) -> SeparatedImages:
        """The images after an edit that is not neutral, within its ``mask``."""


def within(mask: Floats | None, before: Floats, after: Floats) -> Floats:
    """``after`` where the mask is 1 and ``before`` where it is 0, both bit for bit; a mixture between."""
    if mask is None:
        return after
    share = np.repeat(mask[..., None], before.shape[2], axis=2)  # sixfold faster than broadcasting
    return (1 - share) * before + share * after


def scaled(mask: Floats | None, light: Floats, factor: float) -> Floats:
    """Light times a factor, within the mask."""
    return within(mask, light, np.float32(factor) * light)


def mean_of_colors(light: Floats) -> Floats:
    """The mean over colours ``[h, w, 1]``: the light that edits keep."""
    colors = light.shape[2]
    return light if colors == 1 else (light[..., :1] + light[..., 1:2] + light[..., 2:]) / np.float32(colors)


def largest_color(light: Floats) -> Floats:
    """The value V of hue, saturation and value: the largest colour ``[h, w, 1]``."""
    colors = [light[..., k : k + 1] for k in range(light.shape[2])]
    return colors[0] if len(colors) == 1 else np.maximum(np.maximum(colors[0], colors[1]), colors[2])


def recolored(diffuse: Floats, target: tuple[float, ...]) -> Floats:
    """Light of the colour ``target``, with the same mean over colours in each pixel."""
    total = sum(target)
    if total <= 0:
        raise EditError(f"expected a colour that is not black, found {', '.join(f'{c:g}' for c in target)}")
    return mean_of_colors(diffuse) * np.array([3 * c / total for c in target], np.float32)


def metallic(diffuse: Floats, specular: Floats) -> Floats:
    """The specular image with hue and saturation of the diffuse one; its value V, the largest colour, is kept.

    In HSV the colour with the hue and saturation of d and the value v is v d / max(d); d = 0 gives grey.
    Note: the paper names no colour space; in HSV, hue and saturation are separate from intensity.
    """
    largest = largest_color(diffuse)
    hue = np.divide(diffuse, largest, out=np.ones_like(diffuse), where=largest > 0)
    return largest_color(specular) * hue


@dataclass(frozen=True, kw_only=True)
class Recolor(Edit):
    """Diffuse light of one colour; shading, and the light of each pixel, are kept."""

    name: ClassVar[str] = "recolor"
    title: ClassVar[str] = "Recolour the material"
    light: ClassVar[str] = "keeps each pixel's diffuse light (mean over colours) and the specular light"
    needs_color: ClassVar[bool] = True

    color: tuple[float, float, float] = color_field((0.8, 0.1, 0.05), 1.0, "New linear colour of the material.")
    amount: float = number_field(1.0, (0.0, 1.0), "From the old colour to the new one.", neutral=0.0)

    def _changed(self, images: SeparatedImages, mask: Floats | None, maps: Maps) -> SeparatedImages:
        mixed = mix(images.diffuse, recolored(images.diffuse, self.color), self.amount)
        return SeparatedImages(within(mask, images.diffuse, mixed), images.specular)


@dataclass(frozen=True, kw_only=True)
class Texture(Edit):
    """A texture on the material: the diffuse light times the texture; highlights are unchanged (Fig. 8f)."""

    name: ClassVar[str] = "texture"
    title: ClassVar[str] = "Texture under the highlights"
    light: ClassVar[str] = "multiplies the diffuse light by the texture, and keeps the specular light"

    image: str = image_field("texture", "The texture: reflectance, 1 changes nothing.", required=True)
    amount: float = number_field(1.0, (0.0, 1.0), "From no texture to the full texture.", neutral=0.0)
    repeats: float = number_field(1.0, (0.1, 50.0), "Repeats of the texture across the image.")
    normals: str | None = image_field("normals", "Surface normals along which the texture follows the shape.")

    def _changed(self, images: SeparatedImages, mask: Floats | None, maps: Maps) -> SeparatedImages:
        texture = find_map(maps, "texture", self.image, images)
        normals = None if self.normals is None else find_map(maps, "normals", self.normals, images)
        height, width = images.diffuse.shape[:2]
        factor = 1 + self.amount * (texture_of(texture, (height, width), self.repeats, normals) - 1)
        return SeparatedImages(within(mask, images.diffuse, images.diffuse * factor), images.specular)


@dataclass(frozen=True, kw_only=True)
class Rougher(Edit):
    """A matte surface: the specular image, blurred by a Gaussian (Fig. 8e: sigma 10)."""

    name: ClassVar[str] = "rougher"
    title: ClassVar[str] = "Rougher"
    light: ClassVar[str] = "keeps the sum of the specular light, inside the mask too"

    sigma: float = number_field(10.0, (0.0, 50.0), "Standard deviation of the blur.", unit="px", neutral=0.0)

    def _changed(self, images: SeparatedImages, mask: Floats | None, maps: Maps) -> SeparatedImages:
        return SeparatedImages(images.diffuse, blur(images.specular, self.sigma, mask))


@dataclass(frozen=True, kw_only=True)
class Sharper(Edit):
    """A glossier surface: the specular image with a blur of ``sigma`` undone, as far as possible."""

    name: ClassVar[str] = "sharper"
    title: ClassVar[str] = "Glossier"
    light: ClassVar[str] = "keeps the sum of the specular light: highlights get smaller and brighter"
    caution: ClassVar[str] = (
        "sharper undoes blur only as far as the camera resolved it: noise grows, highlights that clipped stay broad, "
        "and reflections that the rough surface averaged are not restored"
    )

    sigma: float = number_field(
        2.0, (0.0, 5.0), "Standard deviation of the blur that is undone.", unit="px", neutral=0.0
    )

    def _changed(self, images: SeparatedImages, mask: Floats | None, maps: Maps) -> SeparatedImages:
        return SeparatedImages(images.diffuse, deblur(images.specular, self.sigma, mask))


@dataclass(frozen=True, kw_only=True)
class Metallic(Edit):
    """Metal of the object's colour: ``gain`` times the specular image in the diffuse hue and saturation (Fig. 8d).

    With amount 1 and gain 45, `combined` is the paper's 45 tau_s + tau_d.
    """

    name: ClassVar[str] = "metallic"
    title: ClassVar[str] = "Metallic"
    light: ClassVar[str] = "multiplies the specular light by gain x (colour / its largest component); light is not kept"
    needs_color: ClassVar[bool] = True

    amount: float = number_field(1.0, (0.0, 1.0), "From the specular image to its metallic one.", neutral=0.0)
    gain: float = number_field(45.0, (0.0, 200.0), "Factor of the specular light of metal; 45 in the paper.")

    def _changed(self, images: SeparatedImages, mask: Floats | None, maps: Maps) -> SeparatedImages:
        metal = np.float32(self.gain) * metallic(images.diffuse, images.specular)
        mixed = mix(images.specular, metal, self.amount)
        return SeparatedImages(images.diffuse, within(mask, images.specular, mixed))


@dataclass(frozen=True, kw_only=True)
class SpecularGain(Edit):
    """Stronger or weaker highlights."""

    name: ClassVar[str] = "specular-gain"
    title: ClassVar[str] = "Strength of highlights"
    light: ClassVar[str] = "multiplies the specular light"

    gain: float = number_field(1.0, (0.0, 10.0), "Factor of the specular light.", neutral=1.0)

    def _changed(self, images: SeparatedImages, mask: Floats | None, maps: Maps) -> SeparatedImages:
        return SeparatedImages(images.diffuse, scaled(mask, images.specular, self.gain))


@dataclass(frozen=True, kw_only=True)
class DiffuseGain(Edit):
    """A lighter or darker material."""

    name: ClassVar[str] = "diffuse-gain"
    title: ClassVar[str] = "Lightness of the material"
    light: ClassVar[str] = "multiplies the diffuse light"

    gain: float = number_field(1.0, (0.0, 10.0), "Factor of the diffuse light.", neutral=1.0)

    def _changed(self, images: SeparatedImages, mask: Floats | None, maps: Maps) -> SeparatedImages:
        return SeparatedImages(scaled(mask, images.diffuse, self.gain), images.specular)


@dataclass(frozen=True, kw_only=True)
class RemoveHighlights(Edit):
    """The scene with less specular light, or without it."""

    name: ClassVar[str] = "remove-highlights"
    title: ClassVar[str] = "Remove highlights"
    light: ClassVar[str] = "removes the share amount of the specular light"

    amount: float = number_field(1.0, (0.0, 1.0), "Share of the specular light that is removed.", neutral=0.0)

    def _changed(self, images: SeparatedImages, mask: Floats | None, maps: Maps) -> SeparatedImages:
        return SeparatedImages(images.diffuse, scaled(mask, images.specular, 1 - self.amount))


@dataclass(frozen=True, kw_only=True)
class IsolateHighlights(Edit):
    """The scene with less diffuse light, or without it."""

    name: ClassVar[str] = "isolate-highlights"
    title: ClassVar[str] = "Highlights alone"
    light: ClassVar[str] = "removes the share amount of the diffuse light"

    amount: float = number_field(1.0, (0.0, 1.0), "Share of the diffuse light that is removed.", neutral=0.0)

    def _changed(self, images: SeparatedImages, mask: Floats | None, maps: Maps) -> SeparatedImages:
        return SeparatedImages(scaled(mask, images.diffuse, 1 - self.amount), images.specular)


@dataclass(frozen=True, kw_only=True)
class Tint(Edit):
    """Light of another colour: both images times ``color``."""

    name: ClassVar[str] = "tint"
    title: ClassVar[str] = "Colour of the light"
    light: ClassVar[str] = "multiplies each colour of both images by its factor in color"
    needs_color: ClassVar[bool] = True

    color: tuple[float, float, float] = color_field(
        (1.0, 1.0, 1.0), 4.0, "Factor of each colour of the light.", neutral=(1.0, 1.0, 1.0)
    )

    def _changed(self, images: SeparatedImages, mask: Floats | None, maps: Maps) -> SeparatedImages:
        factor = np.array(self.color, np.float32)
        diffuse, specular = (within(mask, light, light * factor) for light in (images.diffuse, images.specular))
        return SeparatedImages(diffuse, specular)


def mix(before: Floats, after: Floats, amount: float) -> Floats:
    """A mixture of both; ``after``, bit for bit, at amount 1."""
    return np.float32(1 - amount) * before + np.float32(amount) * after


#: Every edit by its name, in the order in which options of the command line are applied: the material, then its
#: reflection, then the light. Metal follows roughness, because a rough metal blurs its reflections, not its colour.
EDITS: dict[str, type[Edit]] = {
    kind.name: kind
    for kind in (
        Recolor,
        Texture,
        DiffuseGain,
        Rougher,
        Sharper,
        Metallic,
        SpecularGain,
        RemoveHighlights,
        IsolateHighlights,
        Tint,
    )
}
