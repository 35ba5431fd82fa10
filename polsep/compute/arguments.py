"""The error of arguments of a wrong type. No NumPy here: commands read arguments before it is loaded."""

from numbers import Integral


class WrongType(TypeError, ValueError):
    """An argument of a wrong type; also a ValueError, as every wrong input is. The message is one line."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))  # arrays are quoted in several


def require_whole(name: str, *values: object) -> None:
    """Raise WrongType unless values are whole numbers."""
    for value in values:
        if not isinstance(value, Integral):
            raise WrongType(f"expected {name} as a whole number, found {value!r:.40}")


def require_flags(**flags: object) -> None:
    """Raise WrongType unless all are True or False, of Python or of NumPy."""
    for name, flag in flags.items():
        if type(flag).__name__ not in ("bool", "bool_"):
            raise WrongType(f"expected {name} as True or False, found {flag!r:.40}")
