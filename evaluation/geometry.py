"""Shape from six lights and from one frame: normals with and without separation, and integration of true normals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from evaluation.figures import require_matplotlib
from polsep.bench.rows import Row
from polsep.io.store.atomic import replace_bytes
from polsep.io.store.image_codecs import write_jpeg

#: Objects of the quick version.
QUICK = ("bear", "reading", "cow", "spot", "fish", "PowerDrill")
#: Objects of the pictures, both in the public domain.
SHOWN = ("spot", "fish")


def bench_geometry(data: Path, names: Sequence[str] | None = None) -> Iterator[Row]:
    """Normals from six lights by input, and depth from true normals, on statues and scans. Raises ValueError."""
    try:
        from evaluation.shape_scores import measure_depth, measure_normals
    except ImportError as error:
        raise ValueError(f"expected the extra bench, found no {error.name}") from None
    require_matplotlib()
    yield from measure_depth(data)
    yield from measure_normals(data, names)


def draw_geometry(rows: Sequence[Row], data: Path, folder: Path) -> Iterator[Path]:
    """Write the pictures of docs/geometry.md, of meshes in the public domain, and give their paths."""
    del rows
    from evaluation.shape_pictures import draw_subject
    from evaluation.six_lights import load_subjects

    for number, subject in enumerate(load_subjects(data, SHOWN)):
        path = folder / f"{subject.name}.jpg"
        write_jpeg(path, draw_subject(subject, number))
        yield path


def bench_shape(data: Path, names: Sequence[str] | None = None) -> Iterator[Row]:
    """Shape from one frame by what a network sees, on statues and scans, glossy and matte. Raises ValueError."""
    try:
        from evaluation.one_frame import measure
    except ImportError as error:
        raise ValueError(f"expected the extra bench, found no {error.name}") from None
    require_matplotlib()
    yield from measure(data, names)


def draw_shape(rows: Sequence[Row], data: Path, folder: Path) -> Iterator[Path]:
    """Write pictures and pages of docs/shape.md, of meshes in the public domain, and give their paths."""
    del rows
    from evaluation.one_frame_pictures import draw_object, relight_object
    from evaluation.six_lights import load_subjects

    for number, subject in enumerate(load_subjects(data, SHOWN)):
        path = folder / f"{subject.name}.jpg"
        write_jpeg(path, draw_object(subject, number))
        yield path
        if subject.name == SHOWN[0]:
            replace_bytes(page := folder / f"{subject.name}.html", relight_object(subject, number))
            yield page
