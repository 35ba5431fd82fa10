"""What every test shares: one hypothesis profile, seeded draws, and the folder of external references."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from hypothesis import settings

from polsep import in_torch, kernels, shipped
from polsep.io.store import weights
from polsep.methods import METHODS
from polsep.sensor.camera import Layout, Mosaic

settings.register_profile("polsep", derandomize=True, deadline=None, max_examples=40)
settings.load_profile("polsep")

# Where a script runs the suite in the background, Ctrl-C is ignored, as it would be in programs that tests start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Thousands of tiny operations: a second thread only waits, and on a busy machine it waits long.
torch.set_num_threads(1)


@pytest.fixture
def generator() -> torch.Generator:
    """A generator of random numbers that starts from the same seed in every test."""
    return torch.Generator().manual_seed(20220930)


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of external reference material beside the repository; tests that need it skip without it."""
    folder = Path(__file__).resolve().parents[1].parent / "shared"
    if not folder.is_dir():
        pytest.skip(f"no reference material at {folder}")
    return folder


@pytest.fixture(scope="session")
def compiled() -> None:
    """Every engine's kernels are compiled on disk: programs that tests start then never stop to compile, nor say so."""
    kernels.warm_up()
    for method in METHODS.values():
        method.run(Mosaic(torch.eye(32), Layout(), 0.0, 1.0), (1.0, 1.0, 1.0), False)


@pytest.fixture
def ship(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder whose files are the shipped weights."""

    def find(name: str) -> Path:
        path = tmp_path / f"{name}.safetensors"
        if not path.exists():
            raise ValueError("not shipped")
        return path

    for room in (weights, shipped, in_torch):
        monkeypatch.setattr(room, "shipped_weights", find)
    caches = [shipped._shipped_refiner, shipped._read_shipped, shipped._read_weights]
    caches += [in_torch._shipped, in_torch._shipped_refinement]
    for cache in caches:
        cache.cache_clear()
    yield tmp_path
    for cache in caches:
        cache.cache_clear()
