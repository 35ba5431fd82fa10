"""3 x 3 Mueller matrices and Stokes vectors (s0, s1, s2) whose elements are Mitsuba's numbers or colours."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

Row = tuple[Any, Any, Any]
Matrix = tuple[Row, Row, Row]
#: cos and sin of twice the angle by which a frame turns counter-clockwise.
Turn = tuple[Any, Any]


def identity_matrix() -> Matrix:
    """The matrix of colours that changes nothing."""
    zero, one = mi.Color3f(0.0), mi.Color3f(1.0)
    return ((one, zero, zero), (zero, one, zero), (zero, zero, one))


def apply(matrix: Matrix, stokes: Row) -> Row:
    """Matrix times vector."""
    first, second, third = (row[0] * stokes[0] + row[1] * stokes[1] + row[2] * stokes[2] for row in matrix)
    return first, second, third


def multiply(first: Matrix, second: Matrix) -> Matrix:
    """Matrix times matrix: what happens second along the light's way stands first."""
    a, b, c = (apply(first, column) for column in zip(*second, strict=True))
    return ((a[0], b[0], c[0]), (a[1], b[1], c[1]), (a[2], b[2], c[2]))


def add(first: Row, second: Row) -> Row:
    """Sum of two vectors."""
    return first[0] + second[0], first[1] + second[1], first[2] + second[2]


def scale(row: Row, factor: Any) -> Row:
    """A vector times a number or colour."""
    return row[0] * factor, row[1] * factor, row[2] * factor


def turn_frames(matrix: Matrix, entering: Turn, leaving: Turn) -> Matrix:
    """A matrix for light in other frames, which stand turned by these angles from those it was for."""
    c, s = entering
    first, q, u = ((a, c * b + s * d, c * d - s * b) for a, b, d in matrix)
    c, s = leaving
    return first, add(scale(q, c), scale(u, s)), add(scale(u, c), scale(q, -s))


def turn_to_up(forward: Any, x: Any) -> Turn:
    """The turn from a beam's frame whose x axis is given to the one that this project gives it.

    Its y is up = world +y, made perpendicular to ``forward``, so x = y cross z is along up cross z. Of a vertical beam,
    which has no such frame, the polarization is lost.
    """
    ours = mi.Vector3f(forward.z, 0, -forward.x)
    length = mi.Float(forward.z * forward.z + forward.x * forward.x)
    cosine = x.x * ours.x + x.z * ours.z
    # (x cross ours) . z
    sine = forward.x * x.y * ours.z + forward.y * (x.z * ours.x - x.x * ours.z) - forward.z * x.y * ours.x
    shrink = 1 / (length + 1e-20)
    return (cosine * cosine - sine * sine) * shrink, 2 * cosine * sine * shrink
