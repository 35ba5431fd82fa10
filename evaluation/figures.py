"""Drawing for the paper's figures: grids of pictures and line plots, as pixels; nothing here reads or writes a file.

Pictures are tensors ``[C, h, w]`` of linear light, shown as the paper shows them, x^(1/2.2). matplotlib draws without a
screen, its global state or its user's settings, so the same input makes the same pixels with the same version of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.figure import Figure

Pixels = NDArray[np.uint8]

#: The paper's tone curve (captions of Figs. 3 and 4).
GAMMA = 2.2
#: Absolute error, mean over colours, that has the lightest colour of an error map.
LARGEST_ERROR = 0.1
#: Width of a picture, height of its title and of the caption, gaps, in pixels; pixels per inch; size of text in points.
CELL, TITLE, GAP, DPI, TEXT = 232, 20, 4, 100, 8
#: Colours that also colour-blind people tell apart (Okabe and Ito 2008).
COLORS = ("#000000", "#e69f00", "#56b4e9", "#009e73", "#d55e00", "#0072b2", "#cc79a7", "#999999")
MARKERS = "osv^D<>P"


class Panel(NamedTuple):
    """One place of a grid: a title and a picture ``uint8 [h, w, 3]`` below it; None leaves the place empty."""

    title: str
    pixels: Pixels | None


class Line(NamedTuple):
    """One line of a plot: its name and its points."""

    name: str
    x: Sequence[float]
    y: Sequence[float]


class Axes(NamedTuple):
    """One plot of a row: its title, what its x axis counts, and its lines; the y axis is PSNR."""

    title: str
    x_label: str
    lines: Sequence[Line]


def require_matplotlib() -> None:
    """Raise ValueError where the figures' library is not installed."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise ValueError("expected the extra bench (pip install 'polsep[bench]'), found no matplotlib") from None


def tone(image: Tensor, gain: float) -> Pixels:
    """Linear light ``[C, h, w]``, C = 3 or 1, as a picture: (gain x)^(1 / `GAMMA`), limited to [0, 1]."""
    shown = (gain * image).clamp(0, 1) ** (1 / GAMMA)
    return _to_pixels(shown.expand(3, -1, -1).permute(1, 2, 0).double().numpy())


def error_map(found: Tensor, truth: Tensor) -> Pixels:
    """The absolute error of images limited to [0, 1], mean over colours: black at 0 to yellow at `LARGEST_ERROR`."""
    from matplotlib import colormaps

    error = (found.clamp(0, 1) - truth.clamp(0, 1)).abs().mean(dim=0).double().numpy()
    return _to_pixels(colormaps["inferno"](np.clip(error / LARGEST_ERROR, 0, 1))[..., :3])


def error_scale(height: int, width: int) -> Pixels:
    """The colours of `error_map` from 0 at the left to `LARGEST_ERROR` at the right, on white."""
    from matplotlib import colormaps

    pixels = np.full((height, width, 3), 255, dtype=np.uint8)
    pixels[: max(1, height // 8)] = _to_pixels(colormaps["inferno"](np.linspace(0, 1, width))[:, :3])
    return pixels


def _to_pixels(display: NDArray[np.floating[Any]]) -> Pixels:
    pixels: Pixels = np.rint(255 * display).astype(np.uint8)
    return pixels


def draw_grid(rows: Sequence[Sequence[Panel]], caption: str, cell_width: int = CELL) -> Pixels:
    """Rows of titled pictures under a caption; all of a row have the height of its first picture."""
    heights = [_cell_height(row, cell_width) for row in rows]
    columns = max(len(row) for row in rows)
    height, width = sum(heights) + (TITLE + GAP) * len(rows) + TITLE + GAP, columns * (cell_width + GAP) + GAP
    with _plain_style():
        figure = _new_figure(height, width)
        figure.text(GAP / width, 1 - (TITLE - 5) / height, caption, fontsize=TEXT + 1, weight="bold")
        top = TITLE + GAP
        for row, cell in zip(rows, heights, strict=True):
            for column, (title, pixels) in enumerate(row):
                left = GAP + column * (cell_width + GAP)
                figure.text(left / width, 1 - (top + TITLE - 6) / height, title, fontsize=TEXT)
                if pixels is not None:
                    box = (left / width, 1 - (top + TITLE + cell) / height, cell_width / width, cell / height)
                    axes = figure.add_axes(box)
                    axes.imshow(pixels, aspect="auto")
                    axes.set_axis_off()
            top += TITLE + cell + GAP
        return _render(figure)


def _cell_height(row: Sequence[Panel], cell_width: int) -> int:
    first = next(panel.pixels for panel in row if panel.pixels is not None)
    height, width = first.shape[:2]
    return int(cell_width * height / width + 0.5)


def draw_plots(plots: Sequence[Axes]) -> Pixels:
    """Plots of PSNR side by side, with one legend below all of them."""
    names = list(dict.fromkeys(line.name for plot in plots for line in plot.lines))
    with _plain_style():
        figure = _new_figure(430, 440 * len(plots))
        shown: dict[str, Artist] = {}
        for k, plot in enumerate(plots):
            axes = figure.add_axes(((k + 0.13) / len(plots), 0.3, 0.83 / len(plots), 0.63))
            for line in plot.lines:
                place = names.index(line.name)
                color, marker = COLORS[place % len(COLORS)], MARKERS[place % len(MARKERS)]
                shown[line.name] = axes.plot(line.x, line.y, color=color, marker=marker, markersize=4, linewidth=1.3)[0]
            axes.set_title(plot.title, fontsize=TEXT + 2)
            axes.set_xlabel(plot.x_label, fontsize=TEXT + 1)
            axes.set_ylabel("PSNR [dB]", fontsize=TEXT + 1)
            axes.tick_params(labelsize=TEXT)
            axes.grid(visible=True, linewidth=0.4)
        handles = [shown[name] for name in names]
        figure.legend(handles, names, loc="lower center", ncols=min(4, len(names)), fontsize=TEXT, frameon=False)
        return _render(figure)


def _plain_style() -> AbstractContextManager[None]:
    """matplotlib's own settings, whatever the user's are."""
    from matplotlib import style

    return style.context("default")


def _new_figure(height: int, width: int) -> Figure:
    """An empty white figure of so many pixels, apart from pyplot and its windows."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor="white")


def _render(figure: Figure) -> Pixels:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    return np.array(canvas.buffer_rgba(), dtype=np.uint8)[..., :3].copy()  # type: ignore[no-untyped-call]
