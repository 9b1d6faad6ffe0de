"""Velocity limits that keep the curvature: a saturated robot is slower, but on the same path.

Limits of the body twist and of the wheel speeds are met by scaling `v` and `omega` by one factor.
Clipping each component separately, as diff_drive_controller does, changes the path.
Source: doc/mathematics.md, "Control laws".
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf, isfinite
from typing import Any

import numpy as np

from diffdrive_jacobian.numerics.checks import (
    equal,
    floats,
    hashable,
    instance,
    leading,
    positive,
    read_only,
)
from diffdrive_jacobian.numerics.elementary import agree, alike, operand, where

Select = Callable[..., Any]
"""`max` or `min` of floats, or of arrays element by element."""
SMALLEST = 5e-324
"""Smallest positive float."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class VelocityLimits:
    """Velocity limits of a differential drive; infinity means no limit. Each is a number, or an array
    for several robots that broadcasts with the commands. Immutable, comparable and hashable.

    Raises:
        ValueError: A limit is NaN or has the wrong sign (standing still must be allowed), or arrays do
            not broadcast.
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
    """Largest absolute speed of either wheel (rad/s)."""
    unlimited: bool = field(init=False, repr=False, compare=False)
    """Whether no limit is set."""
    alike: bool = field(init=False, repr=False, compare=False)
    """Whether every limit is a number, equal for all robots."""
    _bounds: tuple[Any, ...] = field(init=False, repr=False, compare=False)
    """Bounds that scale: lower and upper for v, then for omega."""
    _clips: tuple[Any, ...] | None = field(init=False, repr=False, compare=False)
    """Bounds that clip, likewise: those that are zero. None if no limit is zero."""
    _wheels: bool = field(init=False, repr=False, compare=False)
    """Whether the wheel speeds have a limit."""

    def __post_init__(self) -> None:
        """Check every limit."""
        for name, limit in zip(self.names(), self.all(), strict=True):
            value = limit if type(limit) is float else read_only(floats(name, limit))
            if name == 'max_wheel_speed':
                inside, allowed = value > 0.0, 'positive'
            elif name.startswith('min'):
                inside, allowed = value <= 0.0, 'zero or negative'
            else:
                inside, allowed = value >= 0.0, 'zero or positive'
            if not np.all(inside):
                raise ValueError(f'{name} must be {allowed}, got {limit}')
            object.__setattr__(self, name, float(value) if np.ndim(value) == 0 else value)
        leading(**{name: np.shape(limit) for name, limit in zip(self.names(), self.all(), strict=True)})
        unlimited = all(type(limit) is float and abs(limit) == np.inf for limit in self.all())
        object.__setattr__(self, 'unlimited', unlimited)
        object.__setattr__(self, 'alike', all(type(limit) is float for limit in self.all()))
        # Computed once, because every message needs it.
        signed = ((self.min_v, -1.0), (self.max_v, 1.0), (self.min_omega, -1.0), (self.max_omega, 1.0))
        bounds = tuple(where(limit == 0.0, sign * np.inf, limit) for limit, sign in signed)
        object.__setattr__(self, '_bounds', bounds)
        clips = tuple(where(limit == 0.0, 0.0, sign * np.inf) for limit, sign in signed)
        zero = any(bool(np.any(limit == 0.0)) for limit, _ in signed)
        object.__setattr__(self, '_clips', clips if zero else None)
        wheels = type(self.max_wheel_speed) is not float or self.max_wheel_speed < np.inf
        object.__setattr__(self, '_wheels', wheels)

    def __eq__(self, other: object) -> bool:
        """Compare every limit, arrays by shape and entries."""
        if not isinstance(other, VelocityLimits):
            return NotImplemented
        if self.alike and other.alike:
            return self.all() == other.all()
        return all(map(equal, self.all(), other.all()))

    def __hash__(self) -> int:
        """Return a hash that equal limits share."""
        return hash(tuple(map(hashable, self.all())))

    def all(self) -> tuple[Any, ...]:
        """Return the limits, in the order of `names`."""
        return self.min_v, self.max_v, self.min_omega, self.max_omega, self.max_wheel_speed

    @staticmethod
    def names() -> tuple[str, ...]:
        """Return the names of the limits."""
        return 'min_v', 'max_v', 'min_omega', 'max_omega', 'max_wheel_speed'


def saturate(
    v: Any, omega: Any, limits: VelocityLimits, r: Any = None, L: Any = None
) -> tuple[Any, Any]:
    """Scale a twist by the largest factor, at most 1, that meets every limit; `v : omega` is kept.

    A direction whose limit is zero is forbidden: its component is set to zero first, because no other
    factor than 0 would meet the limit. So a robot that may not reverse still turns on the spot.

    The result meets every limit exactly, including that of the wheel speeds that `body_to_wheel`
    returns for it. Twists whose wheel speeds would overflow are scaled too.

    Args:
        v: Forward speed, shape (...) (m/s).
        omega: Yaw rate, shape (...) (rad/s).
        limits: The limits.
        r: Wheel radius, shape (...) (m). Required if the limits have a `max_wheel_speed`.
        L: Wheel separation, shape (...) (m). Required if the limits have a `max_wheel_speed`.

    Returns:
        The limited `(v, omega)`, each of shape (...).

    Raises:
        ValueError: v or omega is not finite; limits are of another class; shapes do not broadcast; the
            wheels have a limit, and r or L is not positive and finite.
    """
    if (
        type(v) is type(omega) is float
        and isfinite(v + omega)
        and type(limits) is VelocityLimits
        and limits.alike
    ):
        if limits.unlimited:
            return v, omega
        if not limits._wheels:
            return _saturated(v, omega, limits, 1.0, 1.0, max, min)
        if type(r) is type(L) is float and r > 0.0 < L and isfinite(r + L):
            return _saturated(v, omega, limits, r, L, max, min)
    v, omega = operand('v', v), operand('omega', omega)
    instance('limits', limits, VelocityLimits)
    single = type(v) is type(omega) is float
    if limits.unlimited:
        if single:
            return v, omega
        agree(v=v, omega=omega)
        v, omega = alike(v, omega)
        return np.array(v), np.array(omega)
    if limits._wheels:
        if r is None or L is None:
            raise ValueError('limits have a max_wheel_speed, so r and L must be given')
        r, L = operand('r', r, positive), operand('L', L, positive)
        single = single and type(r) is type(L) is float
    else:
        r = L = 1.0
    if single and limits.alike:
        return _saturated(v, omega, limits, r, L, max, min)
    agree(v=v, omega=omega, r=r, L=L, **dict(zip(limits.names(), limits.all(), strict=True)))
    with np.errstate(all='ignore'):
        limited = _saturated(v, omega, limits, r, L, _maximum, np.minimum)
        limited_v, limited_omega = alike(*limited)
    return limited_v, limited_omega


def _saturated(
    v: Any, omega: Any, limits: VelocityLimits, r: Any, L: Any, maximum: Select, minimum: Select
) -> tuple[Any, Any]:
    if limits._clips is not None:
        v_floor, v_ceiling, omega_floor, omega_ceiling = limits._clips
        v = minimum(maximum(v, v_floor), v_ceiling)
        omega = minimum(maximum(omega, omega_floor), omega_ceiling)
    divisor = _excess(v, omega, limits, r, L, 1.0, maximum)
    if type(divisor) is float and divisor == 1.0:
        return v, omega
    infinite = divisor == inf
    if infinite is not False and _any(infinite):
        v, omega, divisor = _scaled_down(v, omega, limits, r, L, divisor, maximum)
    # The quotient may round to one unit in the last place beyond the limit.
    v_low, v_high, omega_low, omega_high = limits._bounds
    v, omega = v / divisor, omega / divisor
    if type(v) is not float or not (v_low <= v <= v_high and omega_low <= omega <= omega_high):
        v = minimum(maximum(v, v_low), v_high)
        omega = minimum(maximum(omega, omega_low), omega_high)
    if limits._wheels:
        # So may the wheel speeds. Shrink by one unit in the last place, then by two, four, and so on.
        step = 2.0**-53
        most = limits.max_wheel_speed
        above = _fastest(v, omega, r, L) > most
        while above is not False and _any(above):
            v, omega = where(above, v - step * v, v), where(above, omega - step * omega, omega)
            above = _fastest(v, omega, r, L) > most
            step *= 2.0
    return v, omega


def _excess(
    v: Any, omega: Any, limits: VelocityLimits, r: Any, L: Any, least: Any, maximum: Select
) -> Any:
    """Compute the factor by which a twist exceeds the limits; at least `least`."""
    v_low, v_high, omega_low, omega_high = limits._bounds
    of_wheels: Any = 0.0
    if limits._wheels:
        limit = limits.max_wheel_speed
        of_wheels = _fastest(v, omega, r, L) / limit
        if type(limit) is not float:
            # Infinity divided by infinity would be NaN.
            of_wheels = np.where(limit < np.inf, of_wheels, 0.0)
    return maximum(v / v_low, v / v_high, omega / omega_low, omega / omega_high, of_wheels, least)


def _scaled_down(
    v: Any, omega: Any, limits: VelocityLimits, r: Any, L: Any, divisor: Any, maximum: Select
) -> tuple[Any, Any, Any]:
    """Scale twists whose excess is infinite until it can be computed."""
    least: Any = 1.0
    while _any(infinite := divisor == np.inf):
        factor = where(infinite, 2.0**-600, 1.0)
        v, omega, least = v * factor, omega * factor, maximum(least * factor, SMALLEST)
        divisor = _excess(v, omega, limits, r, L, least, maximum)
    return v, omega, divisor


def _fastest(v: Any, omega: Any, r: Any, L: Any) -> Any:
    """Compute the speed of the faster wheel, bit-identical to `body_to_wheel`."""
    return (abs(v) + abs(omega * L / 2.0)) / r


def _maximum(*values: Any) -> Any:
    """Return the largest of arrays that broadcast, element by element."""
    return functools.reduce(np.maximum, values)


def _any(condition: Any) -> bool:
    return condition if type(condition) is bool else bool(np.any(condition))
