"""The plot of `bench.reality`: what each disturbance costs each method, as dots on lines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from io import BytesIO
from pathlib import Path

from polsep.bench.rows import Row
from polsep.io.store.atomic import replace_bytes

#: Colours that also colour-blind people tell apart (Okabe and Ito 2008), and markers, by method.
STYLES = {
    "analytic": ("#999999", "o"),
    "color-affine": ("#e69f00", "s"),
    "paper": ("#56b4e9", "v"),
    "joint-large": ("#cc79a7", "P"),
    "joint": ("#d55e00", "D"),
    "joint-fast": ("#009e73", "^"),
}
#: Range of the axis [dB]: larger losses stand at its end.
SHOWN = (-3.0, 15.0)


def draw_reality(rows: Sequence[Row], data: Path | None, folder: Path) -> Iterator[Path]:
    """Write the plot of the losses with nothing stated into ``folder``. Raises ValueError without the extra bench."""
    del data
    try:
        from matplotlib import style
        from matplotlib.figure import Figure
    except ImportError:
        raise ValueError("expected the extra bench (pip install 'polsep[bench]'), found no matplotlib") from None
    losses = [row for row in rows if row.bench == "reality/loss"]
    cases, methods = (list(dict.fromkeys(values)) for values in ([r.case for r in losses], [r.method for r in losses]))
    with style.context("default"):
        figure = Figure(figsize=(9.2, 1.3 + 0.22 * len(cases)), dpi=100, facecolor="white", layout="constrained")
        for k, output in enumerate(("diffuse", "specular")):
            axes = figure.add_subplot(1, 2, k + 1)
            for method in methods:
                found = {r.case: r.value for r in losses if r.method == method and r.metric == f"{output} loss"}
                color, marker = STYLES.get(method, ("#000000", "x"))
                x = [min(max(found[case], SHOWN[0]), SHOWN[1]) for case in cases]
                axes.plot(x, range(len(cases)), marker, color=color, markersize=4, label=method if k == 0 else None)
            axes.set_ylim(len(cases) - 0.5, -0.5)
            axes.set_xlim(SHOWN[0] - 0.4, SHOWN[1] + 0.4)
            axes.axvline(0, color="black", linewidth=0.6)
            axes.set_yticks(range(len(cases)), cases if k == 0 else [""] * len(cases), fontsize=8)
            axes.grid(visible=True, linewidth=0.3)
            axes.set_xlabel(f"loss of the {output} image [dB]", fontsize=8)
            axes.tick_params(axis="x", labelsize=8)
        figure.legend(loc="outside lower center", ncols=len(methods), fontsize=8, frameon=False)
        stream = BytesIO()
        figure.savefig(stream, format="png", metadata={"Software": None})
    path = folder / "losses.png"
    replace_bytes(path, stream.getvalue())
    yield path
