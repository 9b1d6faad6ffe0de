"""The arc of one unicycle in floats, for code that runs with every message."""

from __future__ import annotations

import math

from diffdrive_jacobian.numerics.elementary import all_finite, wrapped


def arc_end(
    x: float, y: float, theta: float, v: float, omega: float, dt: float
) -> tuple[float, float, float]:
    """Compute what `se2.integrate` returns for one pose, to the last bit, from floats that are finite.

    Returns:
        `(x, y, theta)` at the end.

    Raises:
        ValueError: The result overflows.
    """
    turn = omega * dt
    half = turn / 2.0
    heading = theta + half
    try:
        # The result of sinc is exactly 1 for a tiny angle, which replaces zero.
        chord = v * dt * (math.sin(half) / half if half else 1.0)
        end_x, end_y = x + chord * math.cos(heading), y + chord * math.sin(heading)
        end_theta = theta + turn
        if not -math.pi < end_theta <= math.pi:
            end_theta = wrapped(end_theta)
    except ValueError:
        # math.sin(inf)
        end_x = end_y = end_theta = math.inf
    # A finite sum has finite terms.
    if not math.isfinite(end_x + end_y + end_theta) and not all_finite((end_x, end_y, end_theta)):
        raise ValueError('pose, twist and dt must give a finite result, but it overflows')
    return end_x, end_y, end_theta
