"""Constants of training examples by name, as ``variety.MATTE_SHARE``: listed, set for one training, kept with weights.

They are the numbers, and tuples of numbers, in capitals in the modules of `PLACES`, where their comments say what they
mean.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType

#: Modules of this subpackage that hold constants of examples.
PLACES = ("variety", "reality", "stream")

#: The name of a constant, and its number or numbers.
Constant = tuple[str, tuple[float, ...]]


def list_constants(changed: Iterable[Constant] = ()) -> dict[str, list[float]]:
    """All constants by name, with those that are ``changed``."""
    found = {
        f"{place}.{name}": list(_numbers(value))
        for place in PLACES
        for name, value in vars(_module(place)).items()
        if name.isupper() and not name.startswith("_") and _numbers(value)
    }
    return found | {name: list(values) for name, values in changed}


def read_constant(text: str) -> Constant:
    """A constant of a text like ``variety.MATTE_STRENGTH=0.02,1``. Raises ValueError on another one."""
    name, _, values = text.partition("=")
    try:
        return check_constant((name, tuple(float(value) for value in values.split(","))))
    except ValueError as error:
        said = str(error) if str(error).startswith("expected") else f"expected NAME=NUMBER,..., found {text!r}"
        raise ValueError(said) from None


def check_constant(constant: Constant) -> Constant:
    """The constant. Raises ValueError where none has that name, and where it has another number of numbers."""
    name, values = constant
    known = list_constants()
    if name not in known:
        raise ValueError(f"expected a constant such as variety.MATTE_SHARE (see polsep/train), found {name!r}")
    if len(values) != len(known[name]):
        raise ValueError(f"expected {name} of {len(known[name])} numbers, found {len(values)}")
    return constant


@contextmanager
def constants_set(constants: Iterable[Constant]) -> Iterator[None]:
    """Examples that are drawn inside have these ``constants``, of this process alone; afterwards they are as before."""
    places = [(_module(place), name, values) for (place, _, name), values in _split(constants)]
    before = [(module, name, getattr(module, name)) for module, name, _ in places]
    try:
        for module, name, values in places:
            old = getattr(module, name)
            kind = type(_first(old))
            setattr(module, name, tuple(kind(v) for v in values) if isinstance(old, tuple) else kind(values[0]))
        yield
    finally:
        for module, name, value in before:
            setattr(module, name, value)


def _split(constants: Iterable[Constant]) -> Iterator[tuple[tuple[str, str, str], tuple[float, ...]]]:
    return ((name.partition("."), values) for name, values in constants)


def _module(place: str) -> ModuleType:
    return import_module(f"polsep.train.{place}")


def _first(value: object) -> int | float:
    first = value[0] if isinstance(value, tuple) else value
    assert isinstance(first, int | float)
    return first


def _numbers(value: object) -> tuple[float, ...]:
    """A number or a tuple of numbers as numbers; nothing of anything else."""
    values = value if type(value) is tuple else (value,)
    numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    return tuple(float(v) for v in values) if numbers else ()
