"""NumPy arrays and torch tensors by one code, after the array API standard: what separates frames runs without torch.

Equations are written once, for both: ``xp = namespace(x)`` gives the standard's functions (``xp.clip``, ``xp.sum(x,
axis=-3, keepdims=True)``, ``xp.stack``) for arrays of x's kind; torch keeps its gradients and devices. What the
standard lacks is here. ``x.clip(least, most)`` and ``x.mT`` are methods of both kinds.
"""

from __future__ import annotations

import sys
from typing import Any, TypeAlias

import numpy as np
from array_api_compat import array_namespace, device, is_array_api_obj, is_torch_array
from numpy.typing import NDArray

from polsep.compute.arguments import WrongType

#: A NumPy array or a torch tensor; docstrings give its shape. (Type checkers know no type for both.)
Array: TypeAlias = Any


def namespace(x: Array) -> Any:
    """The standard's functions for arrays of x's kind: NumPy's are NumPy itself, of which no copy is made."""
    return np if isinstance(x, np.ndarray | np.generic) else array_namespace(x)


def require_floats(name: str, x: Array, wanted: str = "floating point") -> None:
    """Raise WrongType unless ``x`` is an array of floats; ``name`` and ``wanted``: words of the message."""
    if not is_array_api_obj(x) or isinstance(x, np.ma.MaskedArray):  # masked samples have no value
        raise WrongType(f"expected {name} as a NumPy array or a torch tensor, found {type(x).__name__}")
    if not namespace(x).isdtype(x.dtype, "real floating"):
        raise WrongType(f"expected {name} in {wanted}, found {x.dtype}")


def to_numpy(x: Array) -> NDArray[Any]:
    """An array of either kind as one of NumPy in the computer's own memory, without gradients; shares what it can."""
    return x.detach().cpu().numpy() if is_torch_array(x) else np.asarray(x)


def to_numpy_together(*arrays: Array) -> list[NDArray[Any]]:
    """Arrays of one kind as those of NumPy. From a GPU they come side by side into pinned memory, with one wait."""
    if not arrays or not is_torch_array(arrays[0]) or arrays[0].device.type != "cuda":
        return [to_numpy(x) for x in arrays]
    import torch

    found = [torch.empty(x.shape, dtype=x.dtype, pin_memory=True).copy_(x.detach(), non_blocking=True) for x in arrays]
    torch.cuda.current_stream(arrays[0].device).synchronize()
    return [x.numpy() for x in found]


def contiguous(x: Array) -> Array:
    """``x`` in memory without gaps, the last axis innermost."""
    return x.contiguous() if is_torch_array(x) else np.ascontiguousarray(x)


def on_cpu(x: Array) -> bool:
    """True for arrays in the computer's own memory."""
    return not is_torch_array(x) or x.device.type == "cpu"


def of_kind(values: NDArray[Any], like: Array) -> Array:
    """A NumPy array as an array of the kind and on the device of ``like``; shares what it can."""
    return namespace(like).asarray(values, device=device(like))


def constant(values: Any, like: Array) -> Array:
    """Numbers (nested lists or a NumPy array) as an array of the kind, dtype and device of ``like``."""
    xp = namespace(like)
    return xp.asarray(values, dtype=like.dtype, device=device(like))


def as_floats(x: Array) -> Array:
    """``x`` in float32; float64 stays."""
    xp = namespace(x)
    return x if x.dtype == xp.float64 else xp.astype(x, xp.float32, copy=False)


def is_exporting() -> bool:
    """True while torch exports a graph, in which one node is worth more than fast arithmetic."""
    torch = sys.modules.get("torch")
    return torch is not None and torch.compiler.is_exporting()


def window(x: Array, first: int, count: int, axis: int) -> Array:
    """``count`` places of ``x [..., h, w]`` from ``first`` on, along axis -1 or -2."""
    return x[..., first : first + count] if axis == -1 else x[..., first : first + count, :]


def pad_mirror(x: Array, margin: int, axis: int) -> Array:
    """Continue ``x`` along axis -1 or -2 by mirroring about its outermost places, which are not repeated."""
    xp, n = namespace(x), x.shape[axis]
    if n == 1:
        return pad_repeat(x, margin, axis)
    reach = min(margin, n - 1)
    before, after = (xp.flip(window(x, first, reach, axis), axis=axis) for first in (1, n - 1 - reach))
    padded = xp.concat([before, x, after], axis=axis)
    return padded if reach == margin else pad_mirror(padded, margin - reach, axis)


def pad_repeat(x: Array, margin: int, axis: int) -> Array:
    """Continue ``x`` along axis -1 or -2 by repeating its outermost places."""
    first, last = window(x, 0, 1, axis), window(x, x.shape[axis] - 1, 1, axis)
    return namespace(x).concat([first] * margin + [x] + [last] * margin, axis=axis)


def to_device(x: Array, device: str) -> Array:
    """``x`` on a device: on the CPU an array stays of its kind, on others it is a torch tensor."""
    if device == "cpu":
        return x.cpu() if is_torch_array(x) else x
    import torch

    return torch.as_tensor(x, device=device)


def short_repr(thing: Any) -> str:
    """Text of a dataclass of arrays for its ``__repr__``: of arrays only type and shape."""
    texts = {name: _shape(value) if is_array_api_obj(value) else repr(value) for name, value in vars(thing).items()}
    fields = (f"{name}={text}" for name, text in texts.items())
    return f"{type(thing).__name__}({', '.join(fields)})"


def _shape(array: Any) -> str:
    return f"{str(array.dtype).removeprefix('torch.')} {list(array.shape)}"
