"""Seconds of one 1024 x 1024 view by rasterization and by Embree's rays: python -m evaluation.rays

A tiny triangle behind the camera and the light makes `polsep.render.raycast` cast rays.
"""

from __future__ import annotations

import time
import timeit
from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from polsep.compute.threads import set_threads
from polsep.render.raycast import MeshScene, find_lit, find_view
from polsep.render.shapes import Mesh, join, random_mesh
from polsep.render.sphere_tracing import PinholeCamera, PointLight
from polsep.render.views import Shot, capture_shot

#: Raw pixels along a side, rays along a pixel's side, and how often everything is done; the best time counts.
SIZE, SAMPLES, ROUNDS = 1024, 2, 5


def main() -> None:
    """Print the seconds that one thread needs for hits and shadows, and for the whole frame."""
    set_threads(1)
    torch.set_num_threads(1)
    mesh = random_mesh(torch.Generator().manual_seed(1))
    reach = float(np.abs(mesh.vertices).max())
    corners = np.array([[0, 0, 40], [1e-3, 0, 40], [0, 1e-3, 40]]) * reach
    upright = np.broadcast_to([0.0, 0.0, 1.0], (3, 3))
    speck = Mesh(corners, upright, np.zeros((3, 2)), np.array([[0, 1, 2]]), np.zeros(1, np.int64))
    camera = PinholeCamera((0.0, 0.0, 3 * reach), (0.0, 0.0, 0.0), 40.0)
    light = PointLight((2 * reach, 2 * reach, 3 * reach), 10 * reach**2)
    for name, scene in (("rasterized", MeshScene(mesh)), ("rays", MeshScene(join(mesh, speck)))):
        geometry = best_time(partial(find_geometry, scene, camera, light))
        shot, draws = Shot(camera, light, 0.01, 0.5), torch.Generator().manual_seed(2)
        frame = best_time(partial(capture_shot, scene, shot, SIZE, SAMPLES, draws))
        print(f"{name}: hits and shadows {geometry:.2f} s, frame {frame:.2f} s")


def find_geometry(scene: MeshScene, camera: PinholeCamera, light: PointLight) -> None:
    """Find hits and shadows of a view."""
    find_lit(scene, find_view(scene, camera, (SIZE, SIZE), SAMPLES), light)


def best_time(work: Callable[[], object]) -> float:
    """The least processor time of several calls [s]."""
    return min(timeit.repeat(work, timer=time.process_time, number=1, repeat=ROUNDS))


if __name__ == "__main__":
    main()
