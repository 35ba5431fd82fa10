"""Weights: what is written is read, half as precise; what is damaged or foreign is refused with one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from polsep.io.store.weights import digest_arrays, read_weights, round_array, shipped_weights, write_weights


def test_round_trip_in_half_precision(tmp_path: Path) -> None:
    tensors = {"a": torch.randn(3, 4), "b.c": torch.randn(5)}
    path = tmp_path / "w" / "x.safetensors"
    write_weights(path, tensors, {"method": "paper"})
    found, metadata = read_weights(path)
    assert metadata["method"] == "paper"
    assert all(np.array_equal(found[name], tensor.half().float()) for name, tensor in tensors.items())
    assert [p.name for p in path.parent.iterdir()] == ["x.safetensors"]


def test_rounded_arrays_are_within_half_a_step(tmp_path: Path) -> None:
    """Each output has its own step; rounding again changes nothing, and nor does an output of zeros."""
    array = (
        np.random.default_rng(0).normal(size=(4, 3, 3)).astype(np.float32) * np.array([1, 10, 0, 0.1])[:, None, None]
    )
    path = tmp_path / "x.safetensors"
    write_weights(path, {"a": array, "b": array}, {"method": "paper"}, {"a"})
    found = read_weights(path)[0]
    assert found.keys() == {"a", "b"}
    steps = np.abs(array).max(axis=(1, 2), keepdims=True) / 127
    assert (np.abs(found["a"] - array) <= 0.501 * steps).all()
    np.testing.assert_array_equal(round_array(found["a"])[0], round_array(array)[0])


def test_rounded_arrays_without_their_steps_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.safetensors"
    codes = {"a": np.ones((2, 2), np.int8)}
    save_file({"a": torch.ones(2, 2, dtype=torch.int8)}, path, {"method": "paper", "sha256": digest_arrays(codes)})
    with pytest.raises(ValueError, match="expected steps of all arrays in 8 bits"):
        read_weights(path)


def test_the_same_weights_are_the_same_bytes(tmp_path: Path) -> None:
    """Whatever the order in which their metadata are given."""
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
