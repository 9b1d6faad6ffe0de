"""Velocity limits that keep the curvature: a saturated robot is slower, but on the same path.

Limits on the body twist and on the wheel speeds are met by one common factor on `v` and `omega`.
Source: MATH.md, "Control laws"; asked for by the users of diff_drive_controller, which clips each
component by itself and so bends the path.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from diffdrive_jacobian.kinematics._elementary import maximum, minimum, operand
from diffdrive_jacobian.kinematics.diff_drive import body_to_wheel


@dataclass(frozen=True, kw_only=True, slots=True)
class VelocityLimits:
    """Limits of a differential drive; infinity means none.

    Raises:
        ValueError: A limit is NaN or lies on the wrong side of zero: standing still must be allowed.
    """

    min_v: float = -np.inf
    """Fastest reverse speed, zero or negative (m/s)."""
    max_v: float = np.inf
    """Fastest forward speed (m/s)."""
    min_omega: float = -np.inf
    """Fastest clockwise yaw rate, zero or negative (rad/s)."""
    max_omega: float = np.inf
    """Fastest counter-clockwise yaw rate (rad/s)."""
    max_wheel_speed: float = np.inf
    """Fastest speed of either wheel, either way (rad/s)."""

    def __post_init__(self) -> None:
        """Check every limit."""
        for name in ('min_v', 'min_omega'):
            if not (value := getattr(self, name)) <= 0.0:
                raise ValueError(f'{name} must be zero or negative, got {value}')
        for name in ('max_v', 'max_omega'):
            if not (value := getattr(self, name)) >= 0.0:
                raise ValueError(f'{name} must be zero or positive, got {value}')
        if not self.max_wheel_speed > 0.0:
            raise ValueError(f'max_wheel_speed must be positive, got {self.max_wheel_speed}')

    @property
    def unlimited(self) -> bool:
        """Whether no limit is set."""
        return self == _NONE


def saturate(v: Any, omega: Any, limits: VelocityLimits, r: Any, L: Any) -> tuple[Any, Any]:
    """Scale a twist by the largest factor, at most 1, that meets every limit; `v : omega` is kept.

    A direction whose limit is zero is forbidden rather than slow: its component is dropped first,
    for no factor but 0 would do. So a robot that may not reverse still turns on the spot.

    Args:
        v: Forward speed, shape (...) (m/s).
        omega: Yaw rate, shape (...) (rad/s).
        limits: The limits.
        r: Wheel radius, shape (...) (m); counts only if the wheels have a limit.
        L: Wheel separation, shape (...) (m); likewise.

    Returns:
        The limited `(v, omega)`, each of shape (...).

    Raises:
        ValueError: The wheels have a limit, and r or L is not positive and finite.
    """
    if limits.unlimited:
        return v, omega
    v, omega = operand(v), operand(omega)
    v, v_excess = _allowed(v, limits.min_v, limits.max_v)
    omega, omega_excess = _allowed(omega, limits.min_omega, limits.max_omega)
    excess = maximum(1.0, maximum(v_excess, omega_excess))
    if limits.max_wheel_speed < np.inf:
        omega_R, omega_L = body_to_wheel(v, omega, r, L)
        fastest = maximum(abs(omega_R), abs(omega_L))
        excess = maximum(excess, fastest / limits.max_wheel_speed)
    # The quotient may round to one unit in the last place beyond the limit.
    return (
        minimum(maximum(v / excess, limits.min_v), limits.max_v),
        minimum(maximum(omega / excess, limits.min_omega), limits.max_omega),
    )


def _allowed(speed: Any, low: float, high: float) -> tuple[Any, Any]:
    """Drop forbidden directions, and tell how many times too fast the rest is."""
    if low == 0.0:
        speed = maximum(speed, 0.0)
    if high == 0.0:
        speed = minimum(speed, 0.0)
    excess: Any = 0.0
    if low < 0.0:
        excess = maximum(excess, speed / low)
    if high > 0.0:
        excess = maximum(excess, speed / high)
    return speed, excess


_NONE = VelocityLimits()
