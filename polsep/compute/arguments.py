"""The error of arguments of a wrong type. This imports nothing: commands read arguments before NumPy is loaded."""


class WrongType(TypeError, ValueError):
    """An argument of a wrong type; also a ValueError, as every wrong input is."""
