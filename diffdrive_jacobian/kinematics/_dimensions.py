"""Checks of headings and of the dimensions of a robot, of which floats need one condition only."""

from __future__ import annotations

from math import isfinite
from typing import Any

from diffdrive_jacobian.numerics.checks import positive
from diffdrive_jacobian.numerics.elementary import agree, operand


def angle_and_radius(name: str, angle: Any, r: Any) -> tuple[Any, Any]:
    """Check an angle of this name, and the radius `r`.

    Raises:
        ValueError: The angle is not finite, r is not positive and finite, or they do not broadcast.
    """
    if not (type(angle) is type(r) is float and r > 0.0 and isfinite(angle + r)):
        angle, r = operand(name, angle), operand('r', r, positive)
        agree(**{name: angle, 'r': r})
    return angle, r


def dimensions(r: Any, L: Any) -> tuple[Any, Any, bool]:
    """Check wheel radius and separation. Return whether both are floats, too.

    Raises:
        ValueError: One is not positive and finite, or they do not broadcast.
    """
    single = type(r) is type(L) is float and r > 0.0 < L and isfinite(r + L)
    if not single:
        r, L = operand('r', r, positive), operand('L', L, positive)
        single = agree(r=r, L=L)
    return r, L, single


def heading_and_dimensions(theta: Any, r: Any, L: Any) -> tuple[Any, Any, Any, bool]:
    """Check heading, wheel radius and separation. Return whether all are floats, too.

    Raises:
        ValueError: The heading is not finite, a dimension is not positive and finite, or they do not
            broadcast.
    """
    single = type(theta) is type(r) is type(L) is float and r > 0.0 < L and isfinite(theta + r + L)
    if not single:
        theta, r, L = operand('theta', theta), operand('r', r, positive), operand('L', L, positive)
        single = agree(theta=theta, r=r, L=L)
    return theta, r, L, single
