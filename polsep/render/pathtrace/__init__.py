"""Path tracing by Mitsuba 3: `raycast`'s images with inter-reflections and area lights, their first lobes apart.

All light that leaves the first surface by its diffuse lobe is diffuse, all that leaves it by its specular lobe is
specular, whether it came from the light directly or from other surfaces; that is what a separation is to find.

Mitsuba intersects rays and evaluates its polarized plastic (``pplastic``); light, camera, colour and textures are ours:

* Every beam's frame has up = world +y, as in `render`, so a light's polarizer angle counts in each of its beams, and
  no Stokes vector needs turning at the camera. s3 stays 0: linear light stays linear off a dielectric.
* Mitsuba's reflectances are 1. A lobe is linear in them, so albedo and specular strength multiply its Mueller matrix
  here, three colours in one pass, and no colour becomes a spectrum.
* Normals face the viewer and shadow rays start above their triangles, as in `raycast`.
* Random numbers are a function of seed, pixel and sample: threads, bands and variants do not change the image.

Needs the extras ``mitsuba`` and ``render``; LLVM makes it fast (`find_variant`). Source: Jakob et al. 2022, Mitsuba 3.
"""

from __future__ import annotations

from polsep.render.pathtrace.lights import AreaLight
from polsep.render.pathtrace.paths import PathOptions, path_trace, trace_paths
from polsep.render.pathtrace.surfaces import PathModel, build_path_model
from polsep.render.pathtrace.variants import FAST_VARIANT, SLOW_VARIANT, find_variant

__all__ = [
    "FAST_VARIANT",
    "SLOW_VARIANT",
    "AreaLight",
    "PathModel",
    "PathOptions",
    "build_path_model",
    "find_variant",
    "path_trace",
    "trace_paths",
]
