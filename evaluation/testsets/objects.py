"""Set (a): held-out random objects, drawn as the training data are, from the split that training never sees.

Source: Dave et al. 2022, Sec. 5.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import torch

from evaluation.testsets.cases import Recipe
from evaluation.testsets.casting import LENS_BLUR, SAMPLES
from polsep.render.materials import random_materials
from polsep.render.raycast import render_scene
from polsep.render.simulate import blur
from polsep.render.sphere_tracing import Scene
from polsep.render.views import random_shot, scene_seed, seeded_shape

#: Which of the shapes of the split, and how many raw pixels per side.
SHAPES, OBJECT_SIDE = range(16), 768
#: The user's seed of `views.scene_seed`.
SEED = 0


def make_object(shape: int, _paths: list[Path], generator: torch.Generator) -> Scene:
    """A random shape of the test split with random materials, camera and light."""
    model = seeded_shape("test", SEED, shape)
    shot = random_shot(model, generator)
    materials = random_materials(model.mesh.slot_count, generator)
    scene = render_scene((model, materials), shot.camera, shot.light, (OBJECT_SIDE, OBJECT_SIDE), SAMPLES)
    return blur(scene, LENS_BLUR)


OBJECTS = tuple(
    Recipe(f"object-{shape:02d}", scene_seed("test", SEED, shape, 0), (), partial(make_object, shape))
    for shape in SHAPES
)
