"""Scores of shapes: normals from six lights by input, and depth from true normals. Needs the extra ``bench``.

Rows of "geometry/normals": mean angular error of statues and scans under the lights of `six_lights`, which are known
roughly; "least squares" and "robust" see light alone, the others the polarization of their diffuse image too.
Rows of "geometry/depth": rms error against the depth of the DiLiGenT objects after scaling, a jump, and CPU time.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch.nn.functional import avg_pool2d

from evaluation.six_lights import SEED, Shoot, load_subjects, photograph
from evaluation.testsets.statues import DILIGENT
from polsep.bench.rows import Row
from polsep.geometry.files import Views, views_of
from polsep.geometry.integration import Equations, find_slopes, integrate_bilateral, integrate_smooth
from polsep.geometry.lights import NAMED
from polsep.geometry.multigrid import Multigrid, solve
from polsep.geometry.photometric import Appearance, fit_lambertian, fit_robust
from polsep.geometry.polarization import Polarized, find_diffuse_polarization, normals_from_polarization
from polsep.io.assets.objects import read_depth, read_intrinsics, read_mask, read_normal_map
from polsep.pipeline import separate_capture

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Methods whose diffuse images are compared.
METHODS = ("analytic", "color-affine", "joint-fast", "joint")
#: Size of the timed surface, and of the one with a jump.
TIMED, JUMPING = (512, 612), (128, 160)


def measure_normals(data: Path, names: Sequence[str] | None) -> Iterator[Row]:
    """Mean angular errors per object, and their mean."""
    errors: dict[str, list[float]] = {}
    for number, subject in enumerate(load_subjects(data, names)):
        shoot = photograph(subject, SEED + 1000 + number)
        for method, found in appearances_of(shoot):
            error = float(angular_error(found.normals, shoot.normals)[shoot.mask].mean())
            errors.setdefault(method, []).append(error)
            yield Row("geometry/objects", subject.name, method, "mean angular error", error, "deg")
    base = {name: statistics.fmean(errors[name]) for name in errors}
    for method, mean in base.items():
        case = f"{len(errors[method])} objects"
        yield Row("geometry/normals", case, method, "mean angular error", mean, "deg")
        yield Row("geometry/worst", case, method, "mean angular error of an object", max(errors[method]), "deg")
        for plain in ("s0, least squares", "s0, robust"):
            yield Row("geometry/normals", case, method, f"change against {plain}", 100 * (mean / base[plain] - 1), "%")


def appearances_of(shoot: Shoot) -> Iterator[tuple[str, Appearance]]:
    """Name and appearance from every input."""
    directions, mask = np.array(list(NAMED.values())), shoot.mask
    for method in METHODS:
        views = views_of([separate_capture(mosaic, method, "white") for mosaic in shoot.mosaics])
        states = views.polarized
        assert states is not None
        if method == METHODS[0]:
            both = views.images + states.specular[..., None]
            yield "s0, least squares", fit_lambertian(both, directions, mask)
            yield "s0, robust", fit_robust(both, directions, mask)
        if method == METHODS[-1]:
            yield f"{method}, least squares", fit_lambertian(views.images, directions, mask)
            yield f"{method}, robust", fit_robust(views.images, directions, mask)
        yield f"{method}, polarization", _with_cue(views, directions, mask)
    yield "truth, robust", fit_robust(truth_of(shoot).images, directions, mask)
    yield "truth, polarization", _with_cue(truth_of(shoot), directions, mask)


def _with_cue(views: Views, directions: Floats, mask: Mask) -> Appearance:
    assert views.polarized is not None
    cue = normals_from_polarization(find_diffuse_polarization(views.polarized, mask))
    return fit_robust(views.images, directions, mask, cue)


def truth_of(shoot: Shoot) -> Views:
    """The exact diffuse images with their polarization."""
    lobes = [scene.diffuse.map(lambda s: avg_pool2d(s, 2)) for scene in shoot.scenes]
    images = np.stack([lobe.s0.permute(1, 2, 0).double().numpy() for lobe in lobes])
    s1 = np.stack([lobe.s1.mean(dim=0).double().numpy() for lobe in lobes])
    s2 = np.stack([lobe.s2.mean(dim=0).double().numpy() for lobe in lobes])
    grey = images.mean(axis=-1)
    return Views(images, Polarized(grey, np.zeros_like(grey), s1, s2, np.ones_like(grey)))


def angular_error(normals: Floats, truth: Floats) -> Floats:
    """Angles between unit vectors ``[..., 3]`` [degrees]."""
    error: Floats = np.degrees(np.arccos(np.clip((normals * truth).sum(axis=-1), -1, 1)))
    return error


def measure_depth(data: Path) -> Iterator[Row]:
    """Integration of the DiLiGenT normals against their depth, of a surface with a jump, and time."""
    ways = (("bilateral", integrate_bilateral), ("least squares", integrate_smooth))
    for name in DILIGENT:
        folder = data / "diligent_normals" / name
        normals, mask = read_normal_map(folder / "normal_map.png"), read_mask(folder / "mask.png")
        truth, matrix = read_depth(folder / "depth_gt.npz"), read_intrinsics(folder / "K.txt")
        for method, integrate in ways:
            began = time.process_time()
            depth = integrate(normals, mask, matrix)
            seconds = time.process_time() - began
            yield Row("geometry/depth", name, method, "rms error", rms_depth(depth, truth, mask), "mm")
            yield Row("geometry/depth", name, method, "CPU time", seconds, "s")
    normals, height = ridge(JUMPING)
    rows, cols = JUMPING[0] // 2, JUMPING[1] // 2
    whole = np.ones(JUMPING, np.bool_)
    for method, integrate in ways:
        depth = integrate(normals, whole)
        kept = (depth[rows, cols - 1] - depth[rows, cols]) / (height[rows, cols - 1] - height[rows, cols])
        off = depth - height
        yield Row("geometry/depth", "cut ridge", method, "jump that is kept", 100 * kept, "%")
        yield Row("geometry/depth", "cut ridge", method, "rms error", float((off - np.median(off)).std()), "px")
    yield from _time_solvers()


def _time_solvers() -> Iterator[Row]:
    """One linear system of a whole frame to a millionth by both solvers, and all of bilateral integration."""
    normals, _ = ridge(TIMED)
    case, whole = "{1}x{0}".format(*TIMED), np.ones(TIMED, np.bool_)
    equations = Equations(find_slopes(normals, whole))
    matrix, right = equations.assemble(equations.even_weights())
    inverse = 1 / matrix.diagonal()
    times = {}
    for method in ("multigrid", "Jacobi"):
        began = time.process_time()
        step = Multigrid(matrix, *equations.pixels) if method == "multigrid" else lambda residual: inverse * residual
        _, steps = solve(matrix, right, np.zeros_like(right), step, (1e-6, 20_000))
        times[method] = time.process_time() - began
        yield Row("geometry/time", case, method, "steps of conjugate gradients", steps, "1")
        yield Row("geometry/time", case, method, "CPU time of one system", times[method], "s")
    yield Row("geometry/time", case, "multigrid", "times as fast", times["Jacobi"] / times["multigrid"], "x")
    began = time.process_time()
    integrate_bilateral(normals, whole)
    yield Row("geometry/time", case, "multigrid", "CPU time of bilateral integration", time.process_time() - began, "s")


def rms_depth(depth: Floats, truth: Floats, mask: Mask) -> float:
    """The rms error after the best scale, in the truth's unit."""
    known = mask & np.isfinite(truth)
    found, true = depth[known], truth[known]
    return float(np.sqrt(np.mean((found * (found @ true) / (found @ found) - true) ** 2)))


def ridge(size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Normals and depth [pixels] of a ridge that rises out of a plane and is cut off across its middle."""
    rows, cols = np.mgrid[: size[0], : size[1]].astype(np.float64)
    down, across = rows - size[0] // 2, cols - size[1] // 2
    width, length, height = 0.2 * size[0], 0.3 * size[1], 0.45 * size[0]
    bell = np.where(across >= 0, height * np.exp(-((down / width) ** 2) - (across / length) ** 2), 0)
    along_u, along_v = bell * 2 * across / length**2, bell * 2 * down / width**2
    normals = np.stack([along_u, -along_v, np.ones(size)], axis=-1)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True), -bell
