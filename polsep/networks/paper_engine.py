"""The paper's networks on CPUs, by OpenVINO. Twin: `paper.Refinement`."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.networks.graphs import core, refinement_model, require_own_threads
from polsep.networks.rungs import Rung
from polsep.networks.sizes import Size

Floats = NDArray[np.float32]


class Refiner:
    """Networks that refine an analytic split, from the arrays of a file of weights.

    State: the layers compiled for the last size of images, for one image at a time.
    """

    def __init__(self, rung: Rung, arrays: Mapping[str, Floats], size: Size) -> None:
        if rung.basis is not None:
            raise ValueError(f"expected a rung whose inputs are seen as they are, found {rung.name}")
        self.rung, self._arrays, self._size, self._lock = rung, arrays, size, threading.Lock()
        self.colors = len(arrays["linear.bias"]) // 2

    def __call__(self, inputs: Floats) -> tuple[Floats, Floats]:
        """tau_d and log(1 + tau_s), ``[N, C, h, w]`` each, of inputs ``[N, K, h, w]``."""
        require_own_threads()
        height, width = inputs.shape[-2:]
        rows, cols = ((-n) % self._size.multiple for n in (height, width))
        mode: Any = "reflect" if rows < height and cols < width else "edge"
        seen = np.pad(inputs, ((0, 0), (0, 0), (0, rows), (0, cols)), mode).astype(np.float32, copy=False)
        with self._lock:
            request = self._compiled(seen.shape[1:]).create_infer_request()
            images = np.concatenate([request.infer([image[None]])[0] for image in seen])[..., :height, :width]
        return images[:, : self.colors], images[:, self.colors :]

    @lru_cache(maxsize=1)  # noqa: B019 - one object per file of weights, which stays
    def _compiled(self, shape: tuple[int, int, int]) -> Any:
        options = {"INFERENCE_PRECISION_HINT": "f32"}
        return core().compile_model(refinement_model(self._arrays, self._size, shape), "CPU", options)
