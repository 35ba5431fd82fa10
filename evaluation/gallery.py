"""The pictures of the paper's figures, made anew: Figs. 3, 4 and 6 from scenes, Fig. 5 and the curves from numbers.

Columns are the available methods: a rung without weights is left out. "paper" means the rung of the
ladder, which has the size and the training of the networks beside it, and the shipped method only where that is absent.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Container, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from evaluation.calibration import (
    DEBEVEC,
    DING,
    SEED,
    capture_with_errors,
    make_turnable,
    separate_captures,
    snapshot_entries,
)
from evaluation.figures import (
    LARGEST_ERROR,
    Axes,
    Line,
    Panel,
    Pixels,
    draw_grid,
    draw_plots,
    error_map,
    error_scale,
    tone,
)
from evaluation.ladder import CO_SITED, MOSAIC, SHIPPED, ladder_entries, read_curves, rung_of
from evaluation.scoring import Entry, capture_noisy, find_missing
from evaluation.sets import load_sets
from polsep.bench.rows import Row
from polsep.demosaic.bilinear import demosaic_bilinear_half
from polsep.io.raw.frames import ReadOptions, read_frames
from polsep.io.results.previews import exposure_of
from polsep.io.store.image_codecs import write_jpeg
from polsep.metrics import psnr
from polsep.physics.stokes import Measurements, fit_stokes
from polsep.sensor.camera import Layout, Mosaic

if TYPE_CHECKING:
    from evaluation.testsets import Case, Recipe

#: Entries of the columns and what the paper calls them.
COLUMNS = {
    "analytic": "analytic",
    "polarized": "CNN on polarized images",
    "paper": "paper",
    SHIPPED: "paper, shipped",
    "color-affine": "color-affine",
}
#: Scenes of Fig. 3; where the data of one are absent, a random object stands in.
SCENES, STAND_IN = ("object-05", "scan-spot"), "object-03"
#: Of which view of the sweep Fig. 4 is, and its size.
VIEW, VIEW_SIZE = 7, (384, 384)
#: Frames of Fig. 6 below the data folder, what they hold, and their white level; all are mono. No lamp is
#: documented; in the last two most highlights have one AoLP, as under one polarized light.
REAL = (
    ("raw/fruits_IMX250MZR.png", "fruits, IMX250MZR", 255.0),
    ("polarized_light/lapray_potery/nir_{angle}.png", "pottery, near infrared", 65520.0),
    ("polarized_light/lapray_leaves/nir_{angle}.png", "leaves, near infrared", 65520.0),
)
#: Pixels around the object.
MARGIN = 8
#: Methods in the plots, in this order.
PLOTTED = (DEBEVEC, DING, "analytic", "color-affine", "paper", "paper, trained on mosaics", SHIPPED)


def draw_paper(rows: Sequence[Row], data: Path, folder: Path) -> Iterator[Path]:
    """Write every figure into ``folder`` and give its path; Fig. 5 shows the numbers of ``rows``.

    Figures whose data are absent are left out, which one line on stderr says.
    """
    pictures = {
        "fig3a": lambda: draw_fig3(find_scene(SCENES[0], data)),
        "fig3b": lambda: draw_fig3(find_scene(SCENES[1], data)),
        "fig4": draw_fig4,
        "fig5": lambda: draw_fig5(rows),
        "fig5-light": lambda: draw_fig5_light(rows),
        "fig6": lambda: draw_fig6(data),
        "curves": draw_curves,
    }
    for name, draw in pictures.items():
        pixels = draw()
        if pixels is None:
            print(f"polsep: the picture {name} is left out: nothing to show in it", file=sys.stderr)
            continue
        path = folder / f"{name}.jpg"
        write_jpeg(path, pixels)
        yield path


def find_scene(name: str, data: Path) -> Case:
    """The test scene of that name, or `STAND_IN` where its data are absent."""
    from evaluation.testsets import build_case

    recipes: dict[str, Recipe] = {recipe.name: recipe for recipes in load_sets().values() for recipe in recipes}
    there = find_missing([recipes[name]], data) is None
    return build_case(recipes[name if there else STAND_IN], data)


def columns_of(entries: Sequence[Entry]) -> list[tuple[str, Entry]]:
    """The entries that are shown, with their titles, in the order of `COLUMNS`."""
    there = {entry.name: entry for entry in entries}
    return [(COLUMNS[name], there[name]) for name in shown_of(COLUMNS, there)]


def shown_of(names: Iterable[str], there: Container[str]) -> list[str]:
    """The names that are there, without `SHIPPED` where a rung of the paper's method is."""
    shown = [name for name in names if name in there]
    rungs = [name for name in shown if rung_of(name) == "paper" and name != SHIPPED]
    return [name for name in shown if name != SHIPPED or not rungs]


def draw_fig3(case: Case) -> Pixels:
    """Diffuse and specular of a rendered scene by every method, from its noisy mosaic, and their absolute errors."""
    capture, (diffuse, specular, mask) = capture_noisy(case)
    found = [(title, entry.separate(capture)) for title, entry in columns_of(ladder_entries(MOSAIC))]
    gains = (_gain(diffuse), _gain(specular))
    unseparated = Panel("unseparated, truth", tone(crop(diffuse + specular, mask), gains[0]))
    rows = []
    for output, true, gain, beside in (
        ("diffuse", diffuse, gains[0], unseparated),
        ("specular", specular, gains[1], _scale(unseparated)),
    ):
        images = [("truth", true), *((title, getattr(separation, output)) for title, separation in found)]
        rows.append([Panel(f"{output}, {title}", tone(crop(image, mask), gain)) for title, image in images])
        rows.append([beside, *(_error(image, true, mask) for _, image in images[1:])])
    return draw_grid(
        rows, f"{case.name}: noisy 12-bit mosaic, half resolution, exposure x {gains[0]:.2g}, x {gains[1]:.2g}"
    )


def draw_fig4() -> Pixels:
    """The specular image by methods that need several captures and by those that need one, and absolute errors."""
    from polsep.render.views import scene_seed, seeded_shape

    generator = torch.Generator().manual_seed(scene_seed("test", SEED, VIEW, 0))
    scene = make_turnable(seeded_shape("test", SEED, VIEW), VIEW_SIZE, generator)
    captured = capture_with_errors(scene, math.radians(22.5), (0.0, 0.0))
    entries = snapshot_entries(ladder_entries(CO_SITED))
    found = {name: (separation, truth) for name, separation, truth in separate_captures(captured, entries)}
    truth, mask = captured.scenes[0].specular.s0, captured.scenes[0].mask
    gain = _gain(truth)
    images, errors = [], []
    for name in shown_of(PLOTTED, found):
        separation, (_, specular) = found[name]
        images.append(Panel(name, tone(crop(separation.specular, mask), gain)))
        errors.append(_error(separation.specular, specular, mask))
    first = Panel("specular, truth", tone(crop(truth, mask), gain))
    caption = f"Specular of co-sited samples, lights at their nominal angles, exposure x {gain:.2g}"
    return draw_grid([[first, *images], [_scale(first), *errors]], caption)


def draw_fig5(rows: Sequence[Row]) -> Pixels | None:
    """PSNR over the error of the light's polarizer; None without such rows."""
    return _draw_sweep(
        rows, r"light polarizer off by (\d+) degrees rms", "error of the light's polarizer [degrees rms]"
    )


def draw_fig5_light(rows: Sequence[Row]) -> Pixels | None:
    """PSNR over the light's own angle, without error; None without such rows."""
    return _draw_sweep(rows, r"light polarizer at ([\d.]+) degrees", "light's polarizer [degrees]")


def _draw_sweep(rows: Sequence[Row], case: str, x_label: str) -> Pixels | None:
    plots = []
    for output in ("diffuse", "specular"):
        points: dict[str, list[tuple[float, float]]] = {}
        for row in rows:
            match = re.fullmatch(case, row.case)
            if match and row.metric == f"{output} PSNR" and row.method in PLOTTED:
                points.setdefault(row.method, []).append((float(match[1]), row.value))
        lines = [Line(name, *zip(*sorted(points[name]), strict=True)) for name in shown_of(PLOTTED, points)]
        plots.append(Axes(output, x_label, lines))
    return draw_plots(plots) if all(plot.lines for plot in plots) else None


def draw_fig6(data: Path) -> Pixels | None:
    """Real frames by every method; mono frames go through as grey ones. None without any of them in ``data``."""
    rows = []
    for name, title, white in REAL:
        if not (data / name.format(angle=0)).is_file():
            continue
        capture = read_grey(data / name, white)
        total = fit_stokes(capture).s0
        gain = _gain(total)
        found = [(t, entry.separate(capture)) for t, entry in columns_of(ladder_entries(MOSAIC))]
        diffuse = [Panel(f"diffuse, {t}", _halved(tone(f.diffuse, gain))) for t, f in found]
        specular = [Panel(f"specular, {t}", _halved(tone(2 * f.specular, gain))) for t, f in found]
        rows += [
            [Panel(title, _halved(tone(total, gain))), *diffuse],
            [Panel("(specular: twice as bright)", None), *specular],
        ]
    return draw_grid(rows, "Real frames: unseparated, diffuse and specular") if rows else None


def read_grey(path: Path, white_level: float) -> Measurements:
    """The analysers of a mono frame at half resolution, or of four images at theirs, in three equal colours."""
    frame = next(read_frames(path, ReadOptions(Layout(bayer=None), white_level=white_level))).data
    seen = demosaic_bilinear_half(frame) if isinstance(frame, Mosaic) else frame
    shape = (*seen.data.shape[:-3], 3, *seen.data.shape[-2:])
    clipped = None if seen.clipped is None else torch.as_tensor(seen.clipped).expand(shape)
    return Measurements(torch.as_tensor(seen.data).expand(shape), seen.angles, clipped)


def draw_curves() -> Pixels | None:
    """PSNR on the validation views over the steps of training, of every rung whose weights tell; None of none."""
    curves = read_curves()
    plots = [
        Axes(
            output,
            "steps",
            [Line(rung, [p[0] for p in points], [p[k] for p in points]) for rung, points in curves.items()],
        )
        for k, output in ((1, "diffuse"), (2, "specular"))
    ]
    return draw_plots(plots) if curves else None


def _gain(image: Tensor) -> float:
    """The exposure that shows an image ``[C, h, w]`` well."""
    return exposure_of(image.permute(1, 2, 0).numpy())


def crop(image: Tensor, mask: Tensor) -> Tensor:
    """An image ``[C, h, w]`` around its mask ``[h, w]``, with `MARGIN` pixels to spare, not higher than wide."""
    rows, cols = (torch.nonzero(mask.any(dim=dim)).flatten() for dim in (1, 0))
    top, bottom = int(rows[0]) - MARGIN, int(rows[-1]) + 1 + MARGIN
    left, right = int(cols[0]) - MARGIN, int(cols[-1]) + 1 + MARGIN
    beside = max(0, (bottom - top) - (right - left) + 1) // 2
    return image[..., max(0, top) : bottom, max(0, left - beside) : right + beside]


def _error(image: Tensor, truth: Tensor, mask: Tensor) -> Panel:
    """An error map under the PSNR inside the mask."""
    pixels = error_map(crop(image, mask), crop(truth, mask))
    return Panel(f"error, {psnr(image, truth, mask):.1f} dB", pixels)


def _scale(like: Panel) -> Panel:
    """The scale of the error colours, of the size of a panel that has pixels."""
    assert like.pixels is not None
    return Panel(f"absolute error, 0 to {LARGEST_ERROR:g}", error_scale(*like.pixels.shape[:2]))


def _halved(pixels: Pixels) -> Pixels:
    """Every other pixel: the large frames of Fig. 6 are shown small."""
    return pixels[::2, ::2]
