"""The benchmarks of the laboratory, by name; ``python -m evaluation NAME`` runs one."""

from __future__ import annotations

from evaluation.ablations import bench_ablations
from evaluation.appearance import bench_gallery, bench_gallery_real, draw_gallery, draw_gallery_real
from evaluation.calibration import bench_calibration
from evaluation.dynamic import bench_dynamic, bench_dynamic_quick
from evaluation.gallery import draw_paper
from evaluation.geometry import bench_geometry, bench_geometry_quick, draw_geometry
from evaluation.joint import bench_joint
from evaluation.material import bench_material, bench_material_quick
from evaluation.material_gallery import draw_material
from evaluation.paper import bench_paper, bench_paper_quick
from evaluation.rendering import bench_rendering
from evaluation.sets import bench_sets
from evaluation.video import bench_video, bench_video_quick
from evaluation.viewing import bench_view
from polsep.bench.run import Bench

BENCHES: dict[str, Bench] = {
    "rendering": Bench(bench_rendering),
    "sets": Bench(bench_sets),
    "joint": Bench(bench_joint),
    "ablations": Bench(bench_ablations),
    "dynamic": Bench(bench_dynamic, bench_dynamic_quick),
    "calibration": Bench(bench_calibration),
    "material": Bench(bench_material, bench_material_quick, draw_material),
    "video": Bench(bench_video, bench_video_quick),
    "geometry": Bench(bench_geometry, bench_geometry_quick, draw_geometry),
    "view": Bench(bench_view),
    "gallery": Bench(bench_gallery, draw=draw_gallery),
    "gallery_real": Bench(bench_gallery_real, draw=draw_gallery_real),
    "paper": Bench(bench_paper, bench_paper_quick, draw_paper),
}
