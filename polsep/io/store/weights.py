"""Weights of networks in safetensors files: no code in them, and damaged files are refused.

A file's metadata says which network it is of and how it came about; ``sha256`` there is that of the tensors' names,
shapes and bytes, so that a damaged file is told from a good one. Shipped weights lie in ``polsep/weights``.
"""

from __future__ import annotations

import hashlib
from importlib.resources import files
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from polsep.io.store.atomic import atomic_path

Tensors = dict[str, Tensor]


def digest_tensors(tensors: Tensors) -> str:
    """sha256 over names, dtypes, shapes and bytes."""
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.contiguous().view(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def write_weights(path: Path, tensors: Tensors, metadata: dict[str, str]) -> None:
    """Write tensors in half precision, atomically."""
    halves = {name: tensor.detach().cpu().half().contiguous() for name, tensor in tensors.items()}
    with atomic_path(path) as part:
        save_file(halves, part, metadata | {"sha256": digest_tensors(halves)})
        part.chmod(0o644)  # safetensors makes files that only their owner can read


def read_weights(path: Path) -> tuple[Tensors, dict[str, str]]:
    """Tensors in single precision, and the metadata. Raises ValueError on files that are damaged or not of polsep."""
    try:
        with safe_open(path, framework="pt") as file:
            metadata = dict(file.metadata() or {})
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dictionary
    except (OSError, SafetensorError) as error:
        raise ValueError(f"expected weights in {path}, found {str(error) or type(error).__name__}") from None
    if "method" not in metadata or "sha256" not in metadata:
        raise ValueError(f"expected weights of polsep in {path}, found a safetensors file of something else")
    if digest_tensors(tensors) != metadata["sha256"]:
        raise ValueError(f"expected weights with sha256 {metadata['sha256']} in {path}, found damaged ones")
    return {name: tensor.float() for name, tensor in tensors.items()}, metadata


def shipped_weights(name: str) -> Path:
    """The file of shipped weights of that name. Raises ValueError when they are not in the package."""
    path = Path(str(files("polsep") / "weights" / f"{name}.safetensors"))
    if not path.exists():
        raise ValueError(f"expected the weights {name!r} in {path.parent}, found none of that name")
    return path


def is_shipped(name: str) -> bool:
    """Return True when weights of that name are in the package."""
    try:
        shipped_weights(name)
    except ValueError:
        return False
    return True
