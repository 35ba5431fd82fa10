"""Exported networks as ONNX files, which run without polsep and without torch."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import nn

from polsep.io.store.atomic import atomic_path

#: Inputs of an exported network, in order.
INPUTS = ("raw", "black_level", "white_level")
#: The oldest set of operators that torch's exporter writes.
OPERATORS = 18
#: Frames that the exporter traces; the network accepts any batch and sides of any multiple of 4. Traced with a batch of
#: 1, it would accept no other.
EXAMPLE = (2, 64, 96)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence torch's remarks about its own parts, such as a library that is not needed here."""
    log = logging.getLogger("torch.onnx")
    before = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(before)


def write_onnx(path: Path, network: nn.Module, outputs: tuple[str, ...], metadata: dict[str, str]) -> None:
    """Write a network that maps uint16 frames, black and white level to ``outputs``, atomically.

    Raises ValueError where the extra ``export`` is missing.
    """
    try:
        import onnxscript  # noqa: F401  # what torch exports with
    except ImportError as error:
        raise ValueError(f"expected the extra 'export' (pip install 'polsep[export]'), found no {error.name}") from None
    frame = torch.zeros(EXAMPLE, dtype=torch.uint16)
    arguments = (frame, torch.tensor([0.0]), torch.tensor([4095.0]))
    free = torch.export.Dim.DYNAMIC
    with _quiet():
        program = torch.onnx.export(
            network,
            arguments,
            dynamo=True,
            verbose=False,
            input_names=list(INPUTS),
            output_names=list(outputs),
            dynamic_shapes={"raw": dict.fromkeys(range(3), free), "black_level": {}, "white_level": {}},
            opset_version=OPERATORS,
        )
    assert program is not None
    program.model.metadata_props.update(metadata)
    with atomic_path(path) as part:
        program.save(part)
