"""The arc of one robot in floats, for what runs with every message."""

from __future__ import annotations

from math import isfinite

from diffdrive_jacobian.kinematics.se2 import integrate


def arc_end(
    x: float, y: float, theta: float, v: float, omega: float, dt: float
) -> tuple[float, float, float]:
    """Compute `se2.integrate` for one pose, from floats that are finite.

    Returns:
        `(x, y, theta)` at the end.

    Raises:
        ValueError: The result overflows.
    """
    try:
        end_x, end_y, end_theta = integrate.formula((x, y, theta), (v, omega), dt)
        if isfinite(end_x) and isfinite(end_y) and isfinite(end_theta):
            return end_x, end_y, end_theta
    except ValueError:
        # math.sin(inf)
        pass
    raise ValueError('pose, twist and dt must give a finite result, but it overflows')
