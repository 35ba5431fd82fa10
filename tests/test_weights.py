"""Weights: what is written is read, half as precise; what is damaged or foreign is refused with one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from polsep.io.store.weights import read_weights, shipped_weights, write_weights


def test_round_trip_in_half_precision(tmp_path: Path) -> None:
    tensors = {"a": torch.randn(3, 4), "b.c": torch.randn(5)}
    path = tmp_path / "w" / "x.safetensors"
    write_weights(path, tensors, {"method": "paper"})
    found, metadata = read_weights(path)
    assert metadata["method"] == "paper"
    assert all(np.array_equal(found[name], tensor.half().float()) for name, tensor in tensors.items())
    assert [p.name for p in path.parent.iterdir()] == ["x.safetensors"]


def test_the_same_weights_are_the_same_bytes(tmp_path: Path) -> None:
    """Whatever the order in which their metadata are told."""
    paths, metadata = [tmp_path / f"{k}.safetensors" for k in range(8)], {str(k): "é" * k for k in range(20)}
    for path in paths:
        write_weights(path, {"a": torch.ones(3), "b": torch.zeros(2, 2)}, metadata | {"method": "paper"})
        metadata = dict(reversed(metadata.items()))
    assert len({path.read_bytes() for path in paths}) == 1
    assert read_weights(paths[0])[1].keys() == metadata.keys() | {"method", "sha256"}


def test_damage_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "x.safetensors"
    write_weights(path, {"a": torch.ones(100)}, {"method": "paper"})
    data = bytearray(path.read_bytes())
    data[-3] ^= 1
    path.write_bytes(bytes(data))
    with pytest.raises(ValueError, match="damaged"):
        read_weights(path)


@pytest.mark.parametrize("content", [b"", b"not weights at all", b"\x80\x04pickle"])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.safetensors"
    path.write_bytes(content)
    with pytest.raises(ValueError, match="expected weights in"):
        read_weights(path)


def test_foreign_and_missing_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.safetensors"
    save_file({"a": torch.ones(1)}, path)
    with pytest.raises(ValueError, match="of something else"):
        read_weights(path)
    with pytest.raises(ValueError, match="expected weights in"):
        read_weights(tmp_path / "none.safetensors")
    with pytest.raises(ValueError, match="found none of that name"):
        shipped_weights("no-such-network")
