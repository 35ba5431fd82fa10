"""First hits of rays with triangles by Embree: pictures of a mesh in NumPy, without torch. Needs the extra mesh."""

from __future__ import annotations

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


class Tracer:
    """Embree's hierarchy of triangles ``faces [F, 3]`` of ``vertices [V, 3]``; for one thread at a time."""

    def __init__(self, vertices: Floats, faces: Integers) -> None:
        self._scene, self._faces = EmbreeScene(), faces
        TriangleMesh(self._scene, vertices.astype(np.float32), faces.astype(np.int32))

    def look(self, eye: ArrayLike, directions: Floats) -> tuple[Integers, Integers, Floats]:
        """First hits from a point along ``directions [N, 3]``.

        Of the M rays that hit: their numbers ``[M]``, the triangles ``[M]``, and the weights ``[M, 3]`` of its corners.
        """
        origins = np.broadcast_to(np.asarray(eye, np.float32), directions.shape)
        found = self._scene.run(origins, directions.astype(np.float32), output=1)
        ray = np.flatnonzero(found["primID"] >= 0)
        u, v = (found[name][ray].astype(np.float64) for name in ("u", "v"))
        return ray, found["primID"][ray].astype(np.int64), np.stack([1 - u - v, u, v], axis=-1)
