"""The device that computes: the CPU, or another one by torch."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from polsep.compute.arguments import WrongType


def _use_one_thread() -> None:
    """Hold torch to one thread in a forked child, where its other threads are missing and would be waited for."""
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_use_one_thread)


def find_device(name: str) -> str:
    """Name of a device: ``auto`` is CUDA where torch and a GPU are, else the CPU, which needs no torch.

    Raises ValueError on a device that is not there.
    """
    if not isinstance(name, str):
        raise WrongType(f"expected a device like auto, cpu or cuda, found {name!r}")
    if name == "cpu" or (name == "auto" and not _may_have_gpu()):
        return "cpu"
    try:
        import torch

        if name == "auto":
            return "cuda" if torch.cuda.is_available() else "cpu"
        torch.zeros(1, device=name).cpu()
    except (ImportError, RuntimeError, TypeError, AssertionError, NotImplementedError) as error:
        if name == "auto":
            return "cpu"
        if isinstance(error, ImportError):
            raise ValueError(f"device {name!r} needs torch: install polsep[torch]") from None
        known = name.partition(":")[0] in ("cuda", "mps", "xpu")  # of other words torch lists all that it knows
        reason = f": {str(error).splitlines()[0].partition('. ')[0]}" if known else ""
        raise ValueError(f"expected a device like auto, cpu or cuda, found {name!r:.40}{reason}") from None
    return name


def _may_have_gpu() -> bool:
    """True if torch is loaded anyway, or may find a GPU: asking it takes a second and 200 MB of memory."""
    return "torch" in sys.modules or Path("/dev/nvidiactl").exists() or sys.platform == "win32"
