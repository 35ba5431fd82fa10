"""Edits: the paper's formulas, light accounted for, continuous, neutral bit for bit, and recipes that keep them."""

from __future__ import annotations

import colorsys
import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from polsep.edit import (
    EDITS,
    DiffuseGain,
    Edit,
    EditError,
    IsolateHighlights,
    Metallic,
    Parameter,
    Recipe,
    Recolor,
    RemoveHighlights,
    Rougher,
    SeparatedImages,
    Sharper,
    SpecularGain,
    Texture,
    Tint,
    apply,
    make_edit,
    recipe_as_data,
    recipe_as_text,
    recipe_from_data,
    recipe_from_text,
)
from polsep.edit.blur import REACH, blur, deblur, gaussian_weights
from polsep.edit.blur_kernel import filter_image
from polsep.edit.recipe import rename_images
from polsep.edit.texture import coordinates_on, flat_coordinates, sample, unfold

Floats = NDArray[np.float32]

HEIGHT, WIDTH = 21, 26
#: How closely the paper's formulas are met, relative to the largest value.
PAPER = 1e-6
#: What float32 leaves of a sum of light, relative.
SUMS = 1e-6


def random_images(seed: int = 0, colors: int = 3, size: tuple[int, int] = (HEIGHT, WIDTH)) -> SeparatedImages:
    """Diffuse light of all hues with a pixel of none, and a few bright highlights."""
    generator = np.random.default_rng(seed)
    diffuse = generator.random((*size, colors), np.float32)
    diffuse[3, 4] = 0
    specular = np.repeat(3 * generator.random((*size, 1), np.float32) ** 8, colors, axis=2)
    return SeparatedImages(diffuse, specular * np.float32(0.9) + np.float32(0.1) * specular[::-1])


def sphere(size: tuple[int, int] = (HEIGHT, WIDTH), radius: float = 9.0) -> Floats:
    """Normals of a ball before nothing."""
    y, x = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in size), indexing="ij")
    squared = 1 - (x**2 + y**2) / radius**2
    normals = np.stack([x / radius, -y / radius, np.sqrt(np.maximum(squared, 0))], axis=-1)
    return np.where(squared[..., None] > 0, normals, 0).astype(np.float32)


def random_maps(colors: int = 3) -> dict[str, Floats]:
    """An image of every kind, by the kind's name."""
    generator = np.random.default_rng(5)
    return {
        "texture": generator.random((7, 9, colors), np.float32),
        "mask": np.clip(generator.random((HEIGHT, WIDTH), np.float32) * 1.5 - 0.25, 0, 1),
        "normals": sphere(),
    }


def only(edit: Edit, images: SeparatedImages, maps: dict[str, Floats] | None = None) -> SeparatedImages:
    return apply(images, Recipe((edit,)), maps)


def total(image: Floats) -> float:
    return float(image.sum(dtype=np.float64))


def assert_near(actual: NDArray[Any], expected: NDArray[Any], tolerance: float) -> None:
    """Equal to ``tolerance`` of the largest expected value."""
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance * max(1.0, float(np.abs(expected).max())))


def values_of(parameter: Parameter) -> st.SearchStrategy[Any]:
    """Any value of a parameter; images by their kind, with and without where that is possible."""
    inside = st.floats(parameter.low, parameter.high)
    if parameter.kind == "number":
        return inside
    if parameter.kind == "color":
        return st.tuples(inside, inside, inside).filter(lambda color: sum(color) > 0.05 * parameter.high)
    named = st.just(parameter.kind)
    return named if parameter.required else st.none() | named


@st.composite
def edits(draw: st.DrawFn, name: str) -> Edit:
    """An edit of that name with any values."""
    kind = EDITS[name]
    return kind(**{p.name: draw(values_of(p)) for p in kind.parameters()})


any_edit = st.sampled_from(sorted(EDITS)).flatmap(edits)
every_edit = pytest.mark.parametrize("name", EDITS)


# The paper's two formulas, written anew: scalars and loops, no code shared.


def test_metallic_is_the_papers() -> None:
    """45 tau_s + tau_d with the diffuse hue and saturation on tau_s, by the standard library's HSV.

    Highlights of a coloured lamp too: what is kept is their value V, not their mean.
    """
    images = random_images()
    images = SeparatedImages(images.diffuse, images.specular * np.array([1, 0.7, 0.4], np.float32))
    expected = np.empty((HEIGHT, WIDTH, 3))
    for y in range(HEIGHT):
        for x in range(WIDTH):
            diffuse, specular = (image[y, x].astype(np.float64) for image in (images.diffuse, images.specular))
            hue, saturation, _ = colorsys.rgb_to_hsv(*diffuse)
            colored = colorsys.hsv_to_rgb(hue, saturation, float(specular.max()))
            expected[y, x] = 45 * np.array(colored) + diffuse
    found = only(Metallic(), images)
    assert_near(found.combined, expected, PAPER)
    assert found.diffuse is images.diffuse


def mirrored_blur(image: NDArray[Any], sigma: float) -> NDArray[np.float64]:
    """The blur by its definition: a matrix of distances to every mirror image, in float64."""
    result = image.astype(np.float64)
    for axis in (0, 1):
        n = image.shape[axis]
        reach = math.ceil(8 * sigma) + 1
        weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
        weights /= weights.sum()
        matrix = np.zeros((n, n))
        for i in range(n):
            for step, weight in zip(range(-reach, reach + 1), weights, strict=True):
                place = (i + step) % (2 * n)
                matrix[i, place if place < n else 2 * n - 1 - place] += weight
        result = np.moveaxis(np.tensordot(matrix, result, axes=(1, axis)), 0, axis)
    return result


def test_matte_is_the_papers() -> None:
    """tau_d + a Gaussian blur of tau_s with sigma 10, on an image that is larger and on one smaller than the kernel."""
    for size in ((80, 150), (HEIGHT, WIDTH)):
        images = random_images(1, size=size)
        found = only(Rougher(), images)
        assert_near(found.combined, images.diffuse + mirrored_blur(images.specular, 10), PAPER)
        assert found.diffuse is images.diffuse


def test_blur_agrees_with_scipy() -> None:
    """Another program's Gaussian with the same border rule."""
    ndimage = pytest.importorskip("scipy.ndimage")
    image = random_images(2).specular
    for sigma in (0.4, 1.0, 3.3):
        expected = np.stack(
            [ndimage.gaussian_filter(image[..., k].astype(float), sigma, mode="reflect", truncate=8) for k in range(3)],
            axis=-1,
        )
        assert_near(blur(image, sigma), expected, PAPER)


def test_texture_leaves_highlights_alone() -> None:
    """The specular image is the very same array, whatever lies under it."""
    images, maps = random_images(), random_maps()
    for values in ({}, {"normals": "normals"}, {"mask": "mask", "amount": 0.3, "repeats": 3.7}):
        found = only(Texture(image="texture", **values), images, maps)
        assert found.specular is images.specular
        assert not np.array_equal(found.diffuse, images.diffuse)
    assert only(Recolor(color=(0.1, 0.8, 0.3)), images).specular is images.specular


# Laws of the registry, for every edit there is and will be.


@every_edit
def test_parameters_describe_the_edit(name: str) -> None:
    """Names, kinds, ranges and defaults are consistent, one parameter has the neutral value, and all is in words."""
    kind = EDITS[name]
    parameters = kind.parameters()
    assert kind.name == name and kind.title and kind.light and kind.__doc__
    assert parameters[-1].name == "mask"
    assert sum(p.neutral is not None for p in parameters) == 1
    for p in parameters:
        assert p.text and p.low < p.high
        assert p.required or p.default == p.check(p.default)
        assert p.neutral is None or p.neutral == p.check(p.neutral)


@every_edit
@pytest.mark.parametrize("dtype", ["float32", "float64", "int64"])
def test_numbers_and_colors_may_be_of_numpy(name: str, dtype: str) -> None:
    """Edits keep NumPy's numbers and arrays of three as they keep Python's, and so do recipes of them."""
    images = {p.name: p.kind for p in EDITS[name].parameters() if p.kind not in ("number", "color") and p.required}
    given = {p.name: p.high for p in EDITS[name].parameters() if p.kind == "number"}
    given |= {p.name: (p.high,) * 3 for p in EDITS[name].parameters() if p.kind == "color"}
    kind = np.dtype(dtype).type
    edit = EDITS[name](
        **images, **{n: np.array(v, dtype) if isinstance(v, tuple) else kind(v) for n, v in given.items()}
    )
    assert edit == EDITS[name](**images, **given)
    assert recipe_from_text(recipe_as_text(Recipe((edit,)))) == Recipe((edit,))


@every_edit
@given(data=st.data())
def test_neutral_is_the_identity(name: str, data: st.DataObject) -> None:
    """At the neutral value of an edit, whatever the others are, the same arrays come out; on mono images too."""
    edit = data.draw(edits(name))
    neutral = next(p for p in edit.parameters() if p.neutral is not None)
    values = {p.name: getattr(edit, p.name) for p in edit.parameters()} | {neutral.name: neutral.neutral}
    still = type(edit)(**values)
    assert still.is_neutral()
    for colors in (1, 3):
        images = random_images(colors=colors)
        found = only(still, images, random_maps(colors))
        assert found.diffuse is images.diffuse and found.specular is images.specular


@every_edit
@given(data=st.data())
def test_edits_are_continuous(name: str, data: st.DataObject) -> None:
    """A step of 1e-5 of a number's range, also from neutral, changes no sample by more than 1 % of the brightest."""
    edit = data.draw(edits(name))
    numbers = [p for p in edit.parameters() if p.kind in ("number", "color")]
    moved = data.draw(st.sampled_from(numbers))
    values = {p.name: getattr(edit, p.name) for p in edit.parameters()}
    if moved.neutral is not None and data.draw(st.booleans()):
        values[moved.name] = moved.neutral
    start = np.atleast_1d(values[moved.name])
    step = 1e-5 * (moved.high - moved.low)
    end = np.where(start + step <= moved.high, start + step, start - step)
    near = {**values, moved.name: float(end[0]) if moved.kind == "number" else tuple(map(float, end))}
    images, maps = random_images(), random_maps()
    before, after = (only(type(edit)(**chosen), images, maps) for chosen in (values, near))
    for image in ("diffuse", "specular"):
        one, two = getattr(before, image), getattr(after, image)
        brightest = max(float(one.max()), float(two.max()), float(getattr(images, image).max()))
        assert float(np.abs(one - two).max()) <= 0.01 * brightest


@given(edit=any_edit)
def test_edits_make_light(edit: Edit) -> None:
    """Non-negative, finite float32 of the same shape, the input left as it was, the same bytes again."""
    images, maps = random_images(), random_maps()
    copies = images.diffuse.copy(), images.specular.copy()
    found, again = only(edit, images, maps), only(edit, images, maps)
    for image in ("diffuse", "specular"):
        light = getattr(found, image)
        assert light.dtype == np.float32 and light.shape == (HEIGHT, WIDTH, 3)
        assert light.min() >= 0 and np.isfinite(light).all()
        assert light.tobytes() == getattr(again, image).tobytes()
    assert np.array_equal(images.diffuse, copies[0]) and np.array_equal(images.specular, copies[1])


@given(edit=any_edit)
def test_masks_hold_edits_back(edit: Edit) -> None:
    """Where the mask is 0 nothing changes, bit for bit; a mask of ones is no mask."""
    images = random_images()
    mask = np.zeros((HEIGHT, WIDTH), np.float32)
    mask[4:15, 6:20] = 1
    values = {p.name: getattr(edit, p.name) for p in edit.parameters()} | {"mask": "mask"}
    masked = type(edit)(**values)
    found = only(masked, images, {**random_maps(), "mask": mask})
    everywhere = only(masked, images, {**random_maps(), "mask": np.ones_like(mask)})
    free = only(type(edit)(**values | {"mask": None}), images, random_maps())
    for image in ("diffuse", "specular"):
        assert np.array_equal(getattr(found, image)[mask == 0], getattr(images, image)[mask == 0])
        assert_near(getattr(everywhere, image), getattr(free, image), 1e-5)


@every_edit
def test_mono_works_or_is_refused(name: str) -> None:
    """One channel: the edit works, or says in one line that it needs colour."""
    kind = EDITS[name]
    values = {p.name: p.kind for p in kind.parameters() if p.required}
    strong = {
        p.name: (0.5,) * 3 if p.kind == "color" else p.high / 2 for p in kind.parameters() if p.neutral is not None
    }
    edit, images = kind(**values, **strong), random_images(colors=1)
    if kind.needs_color:
        with pytest.raises(EditError, match=f"edit 1, {name}: expected images in colour for {name}, found one channel"):
            only(edit, images, random_maps(1))
    else:
        found = only(edit, images, random_maps(1))
        assert not np.array_equal(found.combined, images.combined)


# Light.


@pytest.mark.parametrize("sigma", [0.3, 2.0, 10.0, 50.0])
@pytest.mark.parametrize("edit", [blur, deblur])
def test_blur_and_its_inverse_keep_light(edit: Callable[..., Floats], sigma: float) -> None:
    """The sum of every colour stays, whatever lies at the border, and inside a soft mask as well."""
    images, mask = random_images(3), random_maps()["mask"]
    images.specular[0, 0], images.specular[-1, 5] = 50, 20
    for inside in (None, mask):
        found = edit(images.specular, sigma, inside)
        np.testing.assert_allclose(
            found.sum(axis=(0, 1), dtype=float), images.specular.sum(axis=(0, 1), dtype=float), rtol=20 * SUMS
        )
        assert found.min() >= 0


def test_light_stays_inside_a_mask() -> None:
    """A blur inside an outline sends nothing over it."""
    mask = (sphere()[..., 2] > 0).astype(np.float32)
    image = random_images(4).specular * mask[..., None]
    found = blur(image, 10.0, mask)
    assert not found[mask == 0].any()
    assert total(found) == pytest.approx(total(image), rel=SUMS)
    assert total(blur(image, 10.0) * mask[..., None]) < 0.6 * total(image)


def test_uniform_light_stays_uniform() -> None:
    """To the border, blurred and sharpened."""
    image = np.full((HEIGHT, WIDTH, 3), 0.7, np.float32)
    assert_near(blur(image, 7.0), image, PAPER)
    assert_near(deblur(image, 5.0), image, 1e-5)


def test_weights_are_a_gaussian() -> None:
    """They sum to 1 over both sides, reach 6 sigma, and blurs of sigmas a and b are one of the root of a² + b²."""
    for sigma in (0.0, 1e-300, 0.2, 1.0, 10.0):
        weights = gaussian_weights(sigma)
        assert 2 * total(weights) - weights[0] == pytest.approx(1, abs=PAPER)
        assert len(weights) == math.ceil(REACH * sigma) + 1
    image = random_images(5, size=(60, 70)).specular
    assert_near(blur(blur(image, 3.0), 4.0), blur(image, 5.0), 1e-5)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (2, 3), (40, 5)])
def test_filters_of_any_size(size: tuple[int, int]) -> None:
    """The kernel agrees with the definition where the filter is wider than the image, for 1 and 3 colours."""
    for colors in (1, 3):
        image = np.random.default_rng(6).random((*size, colors), np.float32)
        for sigma in (0.5, 2.0, 4.0):
            assert_near(filter_image(image, gaussian_weights(sigma)), mirrored_blur(image, sigma), PAPER)


def test_sharper_undoes_rougher() -> None:
    """A blurred picture comes back to half of the error, and another blur gives what was sharpened."""
    y, x = np.mgrid[:60, :80]
    sharp = np.exp(-0.5 * ((x - 30) ** 2 + (y - 25) ** 2) / 3.0**2)[..., None].astype(np.float32)
    sharp = np.repeat(sharp, 3, axis=2) + np.float32(0.05)
    soft = blur(sharp, 2.0)
    back = deblur(soft, 2.0)
    assert np.linalg.norm(back - sharp) < 0.5 * np.linalg.norm(soft - sharp)
    assert back.max() > soft.max()
    assert_near(blur(back, 2.0), soft, 0.02)


@given(amount=st.floats(0.01, 1), color=st.tuples(*[st.floats(0.01, 1)] * 3))
def test_recolouring_keeps_each_pixels_light(amount: float, color: tuple[float, float, float]) -> None:
    """The mean over colours stays; with amount 1 all pixels have the new colour."""
    images = random_images()
    found = only(Recolor(color=color, amount=amount), images).diffuse
    assert_near(found.mean(axis=2), images.diffuse.mean(axis=2), PAPER)
    full = only(Recolor(color=color), images).diffuse
    assert_near(
        full / full.sum(axis=2, keepdims=True).clip(1e-9) * (full.sum(axis=2, keepdims=True) > 0),
        np.array(color) / sum(color) * (images.diffuse.sum(axis=2, keepdims=True) > 0),
        1e-5,
    )


def test_gains_and_tint_multiply() -> None:
    """Sums of light are what the edits say."""
    images = random_images()
    diffuse, specular = total(images.diffuse), total(images.specular)
    cases: list[tuple[Edit, float, float]] = [
        (SpecularGain(gain=2.5), 1, 2.5),
        (DiffuseGain(gain=0.25), 0.25, 1),
        (RemoveHighlights(amount=0.75), 1, 0.25),
        (RemoveHighlights(), 1, 0),
        (IsolateHighlights(amount=0.5), 0.5, 1),
        (IsolateHighlights(), 0, 1),
        (Tint(color=(0.5, 0.5, 0.5)), 0.5, 0.5),
        (Rougher(sigma=4), 1, 1),
        (Sharper(sigma=1.5), 1, 1),
    ]
    for edit, of_diffuse, of_specular in cases:
        found = only(edit, images)
        assert total(found.diffuse) == pytest.approx(of_diffuse * diffuse, rel=5 * SUMS)
        assert total(found.specular) == pytest.approx(of_specular * specular, rel=5 * SUMS)
    tinted = only(Tint(color=(1.0, 0.5, 2.0)), images)
    assert np.array_equal(tinted.diffuse, images.diffuse * np.array([1, 0.5, 2], np.float32))
    assert np.array_equal(tinted.specular, images.specular * np.array([1, 0.5, 2], np.float32))


def test_textures_of_reflectance_absorb() -> None:
    """A texture of at most 1 adds no light anywhere, and one of 1 changes nothing."""
    images, maps = random_images(), random_maps()
    assert (only(Texture(image="texture"), images, maps).diffuse <= images.diffuse).all()
    white = {"texture": np.ones((4, 4, 1), np.float32)}
    assert np.array_equal(only(Texture(image="texture", repeats=3.3), images, white).diffuse, images.diffuse)
    fine = {"texture": np.ones((50, 50, 1), np.float32)}  # six texels on a pixel
    assert_near(only(Texture(image="texture", repeats=3.3), images, fine).diffuse, images.diffuse, PAPER)


# Textures.


def test_flat_texture_is_the_texture() -> None:
    """One repeat over an image as wide as the texture is the texture itself, texel for texel, and repeats downwards."""
    texture = np.random.default_rng(7).random((10, WIDTH, 3), np.float32)
    images = SeparatedImages(np.ones((HEIGHT, WIDTH, 3), np.float32), np.zeros((HEIGHT, WIDTH, 3), np.float32))
    found = only(Texture(image="texture"), images, {"texture": texture}).diffuse
    assert_near(found, np.concatenate([texture, texture, texture])[:HEIGHT], PAPER)


def test_small_texels_are_averaged() -> None:
    """A checkerboard far finer than pixels is grey, not a pattern of its own."""
    checks = (np.indices((64, 64)).sum(axis=0) % 2).astype(np.float32)[..., None]
    x, y = flat_coordinates((9, 9))
    assert_near(sample(checks, (8 * x, 8 * y), 8.0), np.full((9, 9, 1), 0.5), PAPER)


@pytest.mark.parametrize("texels", [1.0, 2.5, 4.0, 7.3])
def test_small_textures_keep_their_period(texels: float) -> None:
    """Also of odd sizes, which lose a row or column when they are halved: many repeats away all is the same."""
    texture = np.random.default_rng(3).random((45, 61, 3), np.float32)
    x, y = (np.float32(texels) * places for places in flat_coordinates((9, 12)))
    moved = x + np.float32(61 * 16), y + np.float32(45 * 16)
    assert_near(sample(texture, moved, texels), sample(texture, (x, y), texels), 1e-3)


def test_coordinates_follow_a_slope() -> None:
    """On a plane that leans by 60 degrees, neighbouring pixels are two pixels apart along it, one across."""
    lean = math.radians(60)
    normals = np.tile(np.float32([math.sin(lean), 0, math.cos(lean)]), (12, 17, 1))
    u, v = unfold(normals)
    assert_near(np.diff(u, axis=1), np.full((12, 16), 2.0), 1e-4)
    assert_near(np.diff(v, axis=0), np.ones((11, 17)), 1e-4)
    assert_near(np.diff(u, axis=0), np.zeros((11, 17)), 1e-4)
    down = np.tile(np.float32([0, -math.sin(lean), math.cos(lean)]), (12, 17, 1))  # faces image-down
    assert_near(np.diff(unfold(down)[1], axis=0), np.full((11, 17), 2.0), 1e-4)


def test_coordinates_are_flat_where_nothing_is_known() -> None:
    """No normals, or such that face the camera, leave the pixels' own coordinates; mirrored normals mirror them."""
    for normals in (np.zeros((9, 11, 3), np.float32), np.tile(np.float32([0, 0, 1]), (9, 11, 1))):
        for found, flat in zip(unfold(normals), flat_coordinates((9, 11)), strict=True):
            assert_near(found, flat, PAPER)
    ball = sphere()
    ball[2:5, 3:9] = 0
    turned = ball[:, ::-1] * np.float32([-1, 1, 1])
    assert_near(WIDTH - unfold(turned)[0][:, ::-1], unfold(ball)[0], 1e-5)
    assert_near(unfold(turned)[1][:, ::-1], unfold(ball)[1], 1e-5)


def test_coordinates_stretch_towards_a_balls_rim() -> None:
    """A texture on a ball gets denser from the middle outwards, the same way in all four directions."""
    u, v = unfold(sphere((41, 41), 18.0))
    steps = np.diff(u[20])
    assert (np.diff(steps[20:36]) > 0).all() and steps[35] > 1.3 * steps[20]
    assert_near(np.diff(v[:, 20]), steps, 1e-4)
    assert_near(steps[::-1], steps, 1e-4)


def test_normals_are_unfolded_once() -> None:
    """Read-only normals give the coordinates that were found before; others may have changed."""
    ball = sphere()
    assert coordinates_on(ball) is not coordinates_on(ball)
    ball.flags.writeable = False
    assert coordinates_on(ball) is coordinates_on(ball)
    other = sphere(radius=7.0)
    other.flags.writeable = False
    assert not np.array_equal(coordinates_on(ball)[0], coordinates_on(other)[0])


# Recipes.


@given(listed=st.lists(any_edit, max_size=4))
def test_recipes_come_back_from_json(listed: list[Edit]) -> None:
    """Written and read, as text and as data: the same recipe, complete, and the same text again."""
    recipe = Recipe(tuple(listed))
    text = recipe_as_text(recipe)
    assert recipe_from_text(text) == recipe == recipe_from_data(recipe_as_data(recipe))
    assert recipe_as_text(recipe_from_text(text)) == text
    assert json.loads(text) == recipe_as_data(recipe)


@given(first=any_edit, second=any_edit)
def test_recipes_compose(first: Edit, second: Edit) -> None:
    """Two edits in one recipe are one after the other."""
    images, maps = random_images(), random_maps()
    both = apply(images, Recipe((first, second)), maps)
    apart = only(second, only(first, images, maps), maps)
    assert np.array_equal(both.diffuse, apart.diffuse) and np.array_equal(both.specular, apart.specular)


def test_defaults_fill_recipes() -> None:
    """What a file leaves out is the default."""
    text = '{"polsep_recipe": 1, "edits": [{"edit": "rougher"}, {"edit": "metallic", "amount": 0.5}]}'
    assert recipe_from_text(text) == Recipe((Rougher(sigma=10.0), Metallic(amount=0.5, gain=45.0)))
    assert recipe_from_text('{"polsep_recipe": 1, "edits": []}') == Recipe()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "expected a recipe as JSON, found Expecting value: line 1 column 1 (char 0)"),
        ("[1]", 'expected a recipe {"polsep_recipe": 1, "edits": [...]}, found [1]'),
        ("[" * 100_000, "expected a recipe as JSON, found "),
        ("{}", 'expected "polsep_recipe": 1, found no such key among nothing'),
        ('{"polsep_recipe": 2, "edits": []}', "expected a recipe of version 1, found 2"),
        ('{"polsep_recipe": true, "edits": []}', "expected a recipe of version 1, found True"),
        ('{"polsep_recipe": 1}', 'expected a list as "edits", found None'),
        ('{"polsep_recipe": 1, "edits": [], "a": 1}', "expected only polsep_recipe, edits in a recipe, found 'a'"),
        ('{"polsep_recipe": 1, "polsep_recipe": 1}', "expected each key once, found 'polsep_recipe' again"),
        ('{"polsep_recipe": 1, "edits": [3]}', 'edit 1: expected {"edit": NAME, ...}, found 3'),
        ('{"polsep_recipe": 1, "edits": [{"edit": "shiny"}]}', "edit 1: expected an edit of recolor, texture, "),
        (
            '{"polsep_recipe": 1, "edits": [{"edit": "tint"}, {"edit": "rougher", "blur": 3}]}',
            "edit 2, rougher: expected only sigma, mask in rougher, found 'blur'",
        ),
        (
            '{"polsep_recipe": 1, "edits": [{"edit": "rougher", "sigma": -1}]}',
            "edit 1, rougher: expected sigma from 0 to 50, found -1",
        ),
        (
            '{"polsep_recipe": 1, "edits": [{"edit": "rougher", "sigma": NaN}]}',
            "edit 1, rougher: expected sigma from 0 to 50, found nan",
        ),
        (
            f'{{"polsep_recipe": 1, "edits": [{{"edit": "rougher", "sigma": 1{"0" * 400}}}]}}',
            "edit 1, rougher: expected sigma from 0 to 50, found 1000",
        ),
        (
            '{"polsep_recipe": 1, "edits": [{"edit": "rougher", "sigma": true}]}',
            "edit 1, rougher: expected a number as sigma, found True",
        ),
        (
            '{"polsep_recipe": 1, "edits": [{"edit": "tint", "color": [1, 2]}]}',
            "edit 1, tint: expected three numbers R, G, B as color, found [1, 2]",
        ),
        ('{"polsep_recipe": 1, "edits": [{"edit": "texture"}]}', "edit 1, texture: expected image, found nothing"),
        (
            '{"polsep_recipe": 1, "edits": [{"edit": "texture", "image": ""}]}',
            "edit 1, texture: expected the name of an image as image, found ''",
        ),
        (
            '{"polsep_recipe": 1, "edits": [{"edit": "texture", "image": "a", "mask": "a"}]}',
            "expected an image for each use, found 'a' as texture and as mask",
        ),
    ],
)
def test_bad_recipes_are_refused_in_one_line(text: str, said: str) -> None:
    """What was expected and what was found, with the place of the edit."""
    with pytest.raises(EditError) as caught:
        recipe_from_text(text)
    assert str(caught.value).startswith(said)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


def test_images_that_do_not_fit_are_refused() -> None:
    """Shapes, ranges and names of the images that edits name, and of the frame."""
    images, maps = random_images(), random_maps()
    texture = Texture(image="texture", mask="mask", normals="normals")
    wrong: list[tuple[str, Floats, str]] = [
        (
            "texture",
            np.ones((4, 4, 2), np.float32),
            "expected texture 'texture' as float32 [h, w, 3 or 1], found float32 [4",
        ),
        ("texture", -np.ones((4, 4, 3), np.float32), "expected texture 'texture' of 0 or more, found -1 to -1"),
        ("mask", np.ones((4, 4), np.float32), "expected mask 'mask' as float32 [21, 26] like the images, found"),
        ("mask", np.full((HEIGHT, WIDTH), 2, np.float32), "expected mask 'mask' in [0, 1], found 2 to 2"),
        ("normals", np.ones((HEIGHT, WIDTH, 1), np.float32), "expected normals 'normals' as float32 [21, 26, 3]"),
    ]
    for name, image, said in wrong:
        with pytest.raises(EditError) as caught:
            only(texture, images, {**maps, name: image})
        assert str(caught.value).startswith(f"edit 1, texture: {said}")
    with pytest.raises(EditError, match="edit 1, texture: expected an image 'mask' as mask, found none"):
        only(texture, images, {})
    with pytest.raises(EditError, match="expected a colour that is not black, found 0, 0, 0"):
        only(Recolor(color=(0, 0, 0)), images)
    with pytest.raises(EditError, match=r"expected diffuse and specular of one shape"):
        SeparatedImages(images.diffuse, images.specular[1:])
    with pytest.raises(EditError, match=r"expected diffuse as float32 \[h, w, 3 or 1\], found float64"):
        SeparatedImages(images.diffuse.astype(np.float64), images.specular)  # type: ignore[arg-type]


def test_what_is_no_recipe_or_frame_is_refused_in_one_line() -> None:
    """An edit alone is no recipe, and an array no frame."""
    with pytest.raises(EditError, match=r"expected a Recipe of edits, found Rougher"):
        apply(random_images(), Rougher())  # type: ignore[arg-type]
    with pytest.raises(EditError, match=r"expected a recipe of edits, .*, found Rougher\("):
        Recipe(Rougher())  # type: ignore[arg-type]
    with pytest.raises(EditError, match=r"expected a frame with diffuse and specular images, found ndarray"):
        apply(np.ones((4, 4, 3), np.float32), Recipe())  # type: ignore[arg-type]
    with pytest.raises(EditError, match=r"expected a kind of edit, .*, found 'rougher'"):
        make_edit("rougher", {})  # type: ignore[arg-type]
    with pytest.raises(EditError, match=r"expected texture 'wood' as a NumPy array, found 'wood.png'"):
        apply(random_images(), Recipe((Texture(image="wood"),)), {"wood": "wood.png"})  # type: ignore[dict-item]
    with pytest.raises(EditError, match=r"expected a recipe as text, found NoneType"):
        recipe_from_text(None)  # type: ignore[arg-type]


def test_names_of_images() -> None:
    """A recipe knows its images by kind, and can rename them."""
    recipe = Recipe((Texture(image="wood.png", mask="m.png"), Rougher(mask="m.png"), Metallic()))
    assert recipe.images() == {"wood.png": "texture", "m.png": "mask"}
    moved = rename_images(recipe, lambda name: f"../{name}")
    assert moved.images() == {"../wood.png": "texture", "../m.png": "mask"}
    assert rename_images(moved, lambda name: name.removeprefix("../")) == recipe


def test_cautions() -> None:
    """Sharpening is never silent about its limits, unless it does nothing."""
    assert Recipe((Sharper(), Sharper(sigma=1))).cautions() == [Sharper.caution]
    assert Recipe((Sharper(sigma=0), Rougher())).cautions() == []


def test_edits_are_made_by_name() -> None:
    """As the viewer and the command line make them."""
    assert make_edit(EDITS["metallic"], {"gain": 3}) == Metallic(gain=3.0)
    with pytest.raises(EditError, match="expected only amount, gain, mask in metallic, found 'size'"):
        make_edit(EDITS["metallic"], {"size": 3})


@pytest.mark.parametrize("change", [blur, deblur])
def test_read_only_images_and_masks_are_filtered(change: Callable[..., Any]) -> None:
    """Images read from files are often read-only; the result is that of writable ones."""
    image = np.random.default_rng(0).random((16, 20, 3)).astype(np.float32)
    mask = np.zeros((16, 20), np.float32)
    mask[4:9, 3:12] = 1
    expected = [change(image, 2.0), change(image, 2.0, mask)]
    image.flags.writeable = mask.flags.writeable = False
    for found, wanted in zip((change(image, 2.0), change(image, 2.0, mask)), expected, strict=True):
        assert np.array_equal(found, wanted)
