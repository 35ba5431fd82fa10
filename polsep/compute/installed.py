"""Modules that are installed, found without importing them."""

from importlib.util import find_spec


def is_installed(module: str) -> bool:
    """True if a module could be imported, so far as finding it says."""
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # of the package that a module is in, or of a finder that hides it
        return False
