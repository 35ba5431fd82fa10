"""PSNR of the separation methods on rendered scenes of known truth."""

from __future__ import annotations

import statistics
from collections.abc import Iterator

from polsep.bench.rows import Row, with_spread
from polsep.bench.truth import SCENE_SEEDS, captures, render_scene
from polsep.methods import METHODS
from polsep.metrics import psnr
from polsep.physics.stokes import Measurements


def bench_separation() -> Iterator[Row]:
    """PSNR of every method on co-sited, noisy and mosaicked captures of coloured and of grey scenes."""
    for case, saturation in (("colour", 1.0), ("desaturated", 0.3), ("grey", 0.0)):
        scores: dict[tuple[str, str, str], list[float]] = {}
        for seed in SCENE_SEEDS:
            scene = render_scene(seed, saturation)
            for capture, frame, mask, (diffuse, specular) in captures(scene, seed):
                for name, method in METHODS.items():
                    if not method.accepts(frame) or (method.reads_mosaic and isinstance(frame, Measurements)):
                        continue
                    found = method.reference(frame)
                    for output, image, truth in (
                        ("diffuse", found.diffuse, diffuse),
                        ("specular", found.specular, specular),
                    ):
                        scores.setdefault((capture, name, output), []).append(psnr(image, truth, mask))
        for (capture, name, output), values in scores.items():
            mean = Row("separation", f"{case}, {capture}", name, f"{output} PSNR", statistics.fmean(values), "dB")
            yield from with_spread(mean, values)
            if "unclipped" in capture:
                yield Row("separation", f"{case}, {capture}", name, f"{output} PSNR, worst scene", min(values), "dB")
