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

#: Inputs of an exported network, in order; those of mono networks end before the last.
INPUTS = ("raw", "black_level", "white_level", "light_color")
#: The oldest set of operators that torch's exporter writes.
OPERATORS = 18
#: Frames that the exporter traces; the network accepts any batch and sides of any multiple of 4. Traced with a batch of
#: 1, it would accept no other.
EXAMPLE = (2, 64, 96)
#: What `write_onnx` does, in order.
STEPS = ("tracing", "translating", "simplifying", "writing")


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence exporters' remarks about their own parts, such as a library that is not needed here."""
    before = {log: log.level for log in (logging.getLogger("torch.onnx"), logging.getLogger("onnx_ir"))}
    for log in before:
        log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for log, level in before.items():
            log.setLevel(level)


def write_onnx(path: Path, network: nn.Module, outputs: tuple[str, ...], metadata: dict[str, str]) -> Iterator[str]:
    """Write an `ExportedNetwork` to ``path``, atomically; yield each of `STEPS` before it begins.

    ``metadata``: with name and version. Raises ValueError where the extra ``export`` is missing.
    """
    try:
        import onnxscript  # noqa: F401  # what torch exports with
    except ImportError as error:
        raise ValueError(f"expected the extra 'export' (pip install 'polsep[export]'), found no {error.name}") from None
    arguments = [torch.zeros(EXAMPLE, dtype=torch.uint16), torch.tensor([0.0]), torch.tensor([4095.0]), torch.ones(3)]
    names = INPUTS if network.colors == 3 else INPUTS[:-1]
    free = torch.export.Dim.DYNAMIC
    shapes = {name: dict.fromkeys(range(3), free) if name == "raw" else {} for name in names}
    steps = iter(STEPS)
    yield next(steps)
    with _quiet(), torch.no_grad():
        traced = torch.export.export(
            network.eval(), tuple(arguments[: len(names)]), dynamic_shapes=shapes, strict=False
        )
    yield next(steps)
    with _quiet():
        program = torch.onnx.export(
            traced,
            dynamo=True,
            verbose=False,
            optimize=False,
            input_names=list(names),
            output_names=list(outputs),
            opset_version=OPERATORS,
        )
    assert program is not None
    yield next(steps)
    with _quiet():
        program.optimize()
    yield next(steps)
    program.model.metadata_props.update(metadata)
    program.model.producer_name, program.model.producer_version = "polsep", metadata["version"]
    program.model.doc_string = metadata["name"]
    with atomic_path(path) as part:
        program.save(part)
