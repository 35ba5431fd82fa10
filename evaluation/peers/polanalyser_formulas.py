"""polanalyser 3.0.0 beside polsep: equal Stokes vectors, and its formulas in our scale.

    pip install polanalyser==3.0.0 opencv-python-headless matplotlib
    python evaluation/peers/polanalyser_formulas.py           # writes results/polanalyser.jsonl

polanalyser's diffuse is Imin, half of the paper's tau_d; its specular, Imax - Imin, equals tau_s, so its two images add
up to Imax instead of s0. polsep's rows are the same formulas on the same four images.
"""

from __future__ import annotations

import numpy as np
import polanalyser as pa
import torch
from recorded import record

import polsep
from polsep.bench.rows import Row
from polsep.bench.truth import read_demo_capture, read_demo_codes
from polsep.compute.arrays import to_numpy
from polsep.demosaic.bilinear import demosaic_bilinear
from polsep.physics.stokes import Measurements, fit_stokes
from polsep.sensor.camera import Layout
from polsep.separation.analytic import separate_analytic


def main() -> None:
    """Measure parity and record the rows."""
    mosaic = read_demo_capture()
    images = pa.demosaicing(read_demo_codes(), pa.COLOR_PolarRGB)
    data = torch.from_numpy(np.stack(images).astype(np.float64) / 4095).permute(0, 3, 1, 2)
    ours = Measurements(data, Layout().angles)
    theirs = pa.calcStokes([image / 4095 for image in images], np.deg2rad([0, 45, 90, 135]))
    stokes, split = fit_stokes(ours), separate_analytic(ours)
    own = np.stack([s.permute(1, 2, 0).numpy() for s in (stokes.s0, stokes.s1, stokes.s2)], -1)
    diffuse = np.abs(2 * pa.cvtStokesToDiffuse(theirs) - split.diffuse.permute(1, 2, 0).numpy())
    specular = np.abs(pa.cvtStokesToSpecular(theirs) - split.specular.permute(1, 2, 0).numpy())
    physical = stokes.s0.permute(1, 2, 0).numpy() >= polarized(stokes)
    bilinear = np.moveaxis(to_numpy(demosaic_bilinear(mosaic).data), 1, -1)
    inner = (slice(None), slice(8, -8), slice(8, -8))
    apart = np.sqrt(np.mean((bilinear[inner] - np.stack(images)[..., ::-1][inner] / 4095) ** 2))
    case = "demo capture, 2448x2048"
    rows = [
        Row("polanalyser", case, "difference", "Stokes vectors", float(np.abs(theirs - own).max()), "white"),
        Row("polanalyser", case, "difference", "2 x diffuse where DoLP <= 1", float(diffuse[physical].max()), "white"),
        Row("polanalyser", case, "difference", "specular where DoLP <= 1", float(specular[physical].max()), "white"),
        Row("polanalyser", case, "difference", "bilinear demosaicking, rms", float(apart), "white"),
    ]
    record("polanalyser", rows, "python evaluation/peers/polanalyser_formulas.py")


def polarized(stokes: polsep.Stokes) -> np.ndarray:
    """Polarized intensity, channels last."""
    return torch.hypot(stokes.s1, stokes.s2).permute(1, 2, 0).numpy()


if __name__ == "__main__":
    main()
