"""`guided.guide_once` of batches on CPUs, by the kernels of `guided_kernel`: what training waits for most."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from polsep.compute.threads import get_threads, run_over_rows
from polsep.demosaic.bilinear_kernel import read_pattern
from polsep.demosaic.cells_kernel import Source, read_grid
from polsep.demosaic.guided_kernel import demosaic_rows, open_stream
from polsep.networks.details import join_cells
from polsep.physics.stokes import stokes_inverse
from polsep.sensor.camera import Layout
from polsep.sensor.unpack_kernel import as_samples


def guide_batch(raw: Tensor, layout: Layout) -> tuple[Tensor, Tensor]:
    """Stokes images ``[N, 9, H/2, W/2]`` and s0 ``[N, 3, H, W]`` of linear samples ``[N, 1, H, W]``, float32, CPU.

    Twin: `guided.guide_once`, which continues frames by another margin, so borders differ a little.
    """
    frames = np.ascontiguousarray(raw[:, 0].detach().numpy())
    count, height, width = frames.shape
    pattern = read_pattern((height, width), layout, 0.0, 1.0, (1.0, 1.0, 1.0))
    grid = read_grid(pattern, layout.angles, stokes_inverse(layout.angles).astype(np.float32))
    out = np.empty((count, height // 2, 18, width // 2), np.float32)

    def guide(frame_range: tuple[int, int]) -> None:
        for k in range(*frame_range):
            source = Source(as_samples(frames[k]), pattern, grid)
            demosaic_rows(source, open_stream(source, 0, apart=True, details=True), (0, height // 2), out[k])

    run_over_rows(guide, count, max(1, count // get_threads()))
    planes = torch.from_numpy(out).transpose(1, 2)
    details = planes[:, 9:].reshape(count * 3, 3, height // 2, width // 2)
    s0 = join_cells(planes[:, :3].reshape(count * 3, 1, height // 2, width // 2), details)
    return planes[:, :9].contiguous(), s0.view(count, 3, height, width)
