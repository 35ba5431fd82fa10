"""The benchmarks of the laboratory, by name; ``python -m evaluation NAME`` runs one."""

from __future__ import annotations

from functools import partial

import polsep.bench
from evaluation import dynamic, geometry, material, paper, video
from evaluation.ablations import bench_ablations
from evaluation.agreement import GRAPHS, bench_agreement
from evaluation.appearance import bench_gallery, bench_gallery_real, draw_gallery, draw_gallery_real
from evaluation.calibration import bench_calibration
from evaluation.dynamic import bench_dynamic
from evaluation.gallery import REAL, draw_paper
from evaluation.geometry import bench_geometry, bench_shape, draw_geometry, draw_shape
from evaluation.install import bench_install
from evaluation.joint import bench_joint
from evaluation.material import PUBLISHED, bench_material
from evaluation.material_gallery import draw_material
from evaluation.paper import bench_paper, measure_paper
from evaluation.rendering import bench_rendering
from evaluation.repeats import bench_repeats
from evaluation.sensors import bench_sensors
from evaluation.sets import bench_sets
from evaluation.video import bench_video
from evaluation.viewing import bench_view
from evaluation.warned import bench_warned, bench_warned_quick
from evaluation.web import bench_web
from polsep.bench import FORMULAS, SCENES, SEPARATION
from polsep.bench.run import Bench

#: Data of the selection sets, below the data folder.
SET_DATA = ("crossed_polarizers", "diligent_normals", "meshes")

BENCHES: dict[str, Bench] = {
    "rendering": Bench(bench_rendering, measures=("polsep/render", "polsep/datasets", "polsep/train/stream.py")),
    "sets": Bench(bench_sets, data=SET_DATA, measures=SCENES),
    "joint": Bench(bench_joint, data=SET_DATA, measures=SCENES),
    "ablations": Bench(bench_ablations, data=SET_DATA, measures=(*SCENES, "evaluation/weights/ablations")),
    "repeats": Bench(bench_repeats, data=SET_DATA, measures=(*SCENES, "polsep/train")),
    "dynamic": Bench(bench_dynamic, partial(bench_dynamic, dynamic.QUICK), measures=(*SCENES, "polsep/video")),
    "calibration": Bench(bench_calibration, measures=SCENES),
    "sensors": Bench(
        bench_sensors, partial(bench_sensors, 2), measures=(*SCENES, "polsep/datasets/reality.py", "polsep/calibrate")
    ),
    "material": Bench(
        bench_material,
        partial(bench_material, count=material.QUICK),
        draw_material,
        (PUBLISHED,),
        (*SEPARATION, "polsep/render", "polsep/material", "evaluation/weights/material"),
    ),
    "video": Bench(
        bench_video,
        partial(bench_video, video.SHORT, video.DISTINCT),
        measures=(*SEPARATION, "polsep/compute", "polsep/video"),
    ),
    "geometry": Bench(
        bench_geometry,
        partial(bench_geometry, names=geometry.QUICK),
        draw_geometry,
        ("diligent_normals", "meshes"),
        (*SEPARATION, "polsep/render", "polsep/geometry"),
    ),
    "shape": Bench(
        bench_shape,
        partial(bench_shape, names=geometry.QUICK),
        draw_shape,
        ("diligent_normals", "meshes"),
        (*SCENES, "polsep/datasets/reality.py", "polsep/geometry", "evaluation/weights/shape"),
    ),
    "install": Bench(bench_install, measures=("polsep", "pyproject.toml", "constraints.txt")),
    "view": Bench(bench_view, measures=("polsep/view", "polsep/edit")),
    "web": Bench(bench_web, partial(bench_web, (1,), 1), measures=("web", "tools/web_models.py")),
    "agreement": Bench(
        bench_agreement, partial(bench_agreement, GRAPHS[:1]), measures=(*SEPARATION, "polsep/io/store/onnx.py", "web")
    ),
    "warned": Bench(
        bench_warned,
        bench_warned_quick,
        data=("raw", "four_angle", "polarized_light", "crossed_polarizers"),
        measures=(*SEPARATION, "polsep/render", "polsep/datasets"),
    ),
    "gallery": Bench(bench_gallery, None, draw_gallery, ("meshes/spot.obj", "meshes/fish.obj"), SCENES),
    "gallery_real": Bench(
        bench_gallery_real, draw=draw_gallery_real, data=tuple(name.format(angle=0) for name, _, _ in REAL)
    ),
    "paper": Bench(
        bench_paper,
        partial(measure_paper, extent=paper.QUICK),
        draw_paper,
        SET_DATA,
        (*SCENES, "evaluation/weights/ladder"),
    ),
}

#: Paths that the numbers of every results file speak of; evaluation/peers writes what is not of a benchmark.
MEASURES = {name: bench.measures for name, bench in (polsep.bench.BENCHES | BENCHES).items()} | {
    "polanalyser": FORMULAS,
    "blender": ("polsep/geometry", "polsep/material", "polsep/io/assets"),
    "materialx": ("polsep/material", "polsep/io/assets"),
    "reliability": ("polsep/io", "polsep/sensor/levels.py", "polsep/edit/recipe.py", "evaluation/damage.py"),
    "house": (),  # of the commit that it names, and of no other
}
