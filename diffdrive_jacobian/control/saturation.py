"""Velocity limits that keep the curvature: a saturated robot is slower, but on the same path.

Limits on the body twist and on the wheel speeds are met by one common factor on `v` and `omega`.
Source: MATH.md, "Control laws"; asked for by the users of diff_drive_controller, which clips each
component by itself and so bends the path.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from diffdrive_jacobian.kinematics._checks import floats
from diffdrive_jacobian.kinematics._elementary import agree, alike, maximum, minimum, operand, where
from diffdrive_jacobian.kinematics.diff_drive import body_to_wheel


@dataclass(frozen=True, kw_only=True, slots=True)
class VelocityLimits:
    """Limits of a differential drive; infinity means none. Each is a number, or an array, for as many
    robots, that broadcasts with the commands.

    Raises:
        ValueError: A limit is NaN or lies on the wrong side of zero: standing still must be allowed.
    """

    min_v: Any = -np.inf
    """Fastest reverse speed, zero or negative (m/s)."""
    max_v: Any = np.inf
    """Fastest forward speed (m/s)."""
    min_omega: Any = -np.inf
    """Fastest clockwise yaw rate, zero or negative (rad/s)."""
    max_omega: Any = np.inf
    """Fastest counter-clockwise yaw rate (rad/s)."""
    max_wheel_speed: Any = np.inf
    """Fastest speed of either wheel, either way (rad/s)."""
    unlimited: bool = field(init=False, repr=False, compare=False)
    """Whether no limit is set."""
    alike: bool = field(init=False, repr=False, compare=False)
    """Whether every limit is a number, the same for all robots."""
    _bounds: tuple[Any, ...] = field(init=False, repr=False, compare=False)
    """Of v, then of omega: what is forbidden below and above, and what scales below and above."""

    def __post_init__(self) -> None:
        """Check every limit."""
        for name, limit in zip(self.names(), self.all(), strict=True):
            value = limit if type(limit) is float else np.array(floats(name, limit))
            if name == 'max_wheel_speed':
                inside, allowed = value > 0.0, 'positive'
            elif name.startswith('min'):
                inside, allowed = value <= 0.0, 'zero or negative'
            else:
                inside, allowed = value >= 0.0, 'zero or positive'
            if not np.all(inside):
                raise ValueError(f'{name} must be {allowed}, got {limit}')
            object.__setattr__(self, name, float(value) if np.ndim(value) == 0 else value)
        unlimited = all(type(limit) is float and abs(limit) == np.inf for limit in self.all())
        object.__setattr__(self, 'unlimited', unlimited)
        object.__setattr__(self, 'alike', all(type(limit) is float for limit in self.all()))
        # Made once, for it is asked for with every message.
        bounds = (
            (
                where(low == 0.0, 0.0, -np.inf),
                where(high == 0.0, 0.0, np.inf),
                where(low == 0.0, -np.inf, low),
                where(high == 0.0, np.inf, high),
            )
            for low, high in ((self.min_v, self.max_v), (self.min_omega, self.max_omega))
        )
        object.__setattr__(self, '_bounds', tuple(bounds))

    def all(self) -> tuple[Any, ...]:
        """Give the limits in their order."""
        return self.min_v, self.max_v, self.min_omega, self.max_omega, self.max_wheel_speed

    @staticmethod
    def names() -> tuple[str, ...]:
        """Give the names of the limits in their order."""
        return 'min_v', 'max_v', 'min_omega', 'max_omega', 'max_wheel_speed'


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
        ValueError: v or omega is not finite; shapes do not broadcast; the wheels have a limit, and r or
            L is not positive and finite.
    """
    v, omega = operand('v', v), operand('omega', omega)
    if limits.unlimited:
        agree(v=v, omega=omega)
        v, omega = alike(v, omega)
        return (v, omega) if type(v) is float else (np.array(v), np.array(omega))
    if type(v) is type(omega) is float and limits.alike:
        return _saturated(v, omega, limits, r, L)
    agree(v=v, omega=omega, **dict(zip(limits.names(), limits.all(), strict=True)))
    # What is infinitely too fast is slowed down to nothing.
    with np.errstate(over='ignore'):
        return _saturated(v, omega, limits, r, L)


def _saturated(v: Any, omega: Any, limits: VelocityLimits, r: Any, L: Any) -> tuple[Any, Any]:
    v, v_excess = _allowed(v, *limits._bounds[0])
    omega, omega_excess = _allowed(omega, *limits._bounds[1])
    excess = maximum(1.0, maximum(v_excess, omega_excess))
    if type(limits.max_wheel_speed) is not float or limits.max_wheel_speed < np.inf:
        omega_R, omega_L = body_to_wheel(v, omega, r, L)
        agree(wheel_speeds=omega_R, max_wheel_speed=limits.max_wheel_speed)
        excess = maximum(excess, maximum(abs(omega_R), abs(omega_L)) / limits.max_wheel_speed)
    # The quotient may round to one unit in the last place beyond the limit.
    return (
        minimum(maximum(v / excess, limits.min_v), limits.max_v),
        minimum(maximum(omega / excess, limits.min_omega), limits.max_omega),
    )


def _allowed(speed: Any, floor: Any, ceiling: Any, low: Any, high: Any) -> tuple[Any, Any]:
    """Drop forbidden directions, and tell how many times too fast the rest is."""
    speed = minimum(maximum(speed, floor), ceiling)
    return speed, maximum(speed / low, speed / high)
