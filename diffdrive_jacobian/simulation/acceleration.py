"""Limits of the acceleration, and the transition from one body twist to another within them.

The names, signs and rules are those of diff_drive_controller: which limit applies to a speed depends on
its sign and on whether it grows. Unlike there, v and omega share one time law `s(t)`, which rises from 0
to 1 as fast as all limits allow:

    u(t) = u_0 + (u_1 - u_0) s(t)

So from rest, to rest and between twists of equal curvature the path is one circle, as without limits.
`s(t)` is linear, with a knot where v or omega changes its sign. Source: doc/mathematics.md,
"Acceleration, lag and delay".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated

from diffdrive_jacobian.numerics.checks import (
    PositiveOrInfinite,
    number,
    positive_or_infinite,
)
from diffdrive_jacobian.numerics.fields import Checked, instance, short

Twist = tuple[float, float]
"""`(v, omega)` (m/s, rad/s)."""


SHORTEST = 1e-9
"""Shortest duration of a part of a transition, the resolution of times (s)."""


def _negative(name: str, value: object) -> float:
    """Require a negative number; minus infinity is allowed."""
    try:
        return -number(name, -value, positive_or_infinite)  # type: ignore[operator]
    except (TypeError, ValueError):
        raise ValueError(f'{name} must be negative or -inf, got {short(value, repr)}') from None


NegativeOrInfinite = Annotated[float, _negative]


@dataclass(frozen=True, kw_only=True, slots=True)
class AxisLimits(Checked):
    """Limits of the rate of change of one speed, v (m/s^2) or omega (rad/s^2); infinite: none.

    Raises:
        ValueError: A limit is zero, NaN or has the wrong sign.
    """

    max_acceleration: PositiveOrInfinite = math.inf
    """Of a speed that is zero or positive and grows."""
    max_deceleration: NegativeOrInfinite = -math.inf
    """Of a positive speed that falls, negative."""
    max_acceleration_reverse: NegativeOrInfinite = -math.inf
    """Of a speed that is zero or negative and falls, negative."""
    max_deceleration_reverse: PositiveOrInfinite = math.inf
    """Of a negative speed that rises, positive."""

    def rate(self, speed: float, change: float) -> float:
        """Return the largest rate, not negative, of a change in the direction of `change`."""
        if change > 0.0:
            return self.max_deceleration_reverse if speed < 0.0 else self.max_acceleration
        return -self.max_deceleration if speed > 0.0 else -self.max_acceleration_reverse

    def stopping_distance(self, speed: float) -> float:
        """Return the distance, not negative, that is travelled from a speed to rest."""
        return speed * speed / 2.0 / self.rate(speed, -speed)

    @property
    def unlimited(self) -> bool:
        """Whether no limit is set."""
        return self == _NO_AXIS_LIMITS


_NO_AXIS_LIMITS = AxisLimits()


@dataclass(frozen=True, kw_only=True, slots=True)
class AccelerationLimits(Checked):
    """Limits of the accelerations of a robot.

    Raises:
        ValueError: A field is of another class, or the limit of the wheels is not positive.
    """

    v: Annotated[AxisLimits, partial(instance, wanted=AxisLimits)] = field(default_factory=AxisLimits)
    omega: Annotated[AxisLimits, partial(instance, wanted=AxisLimits)] = field(
        default_factory=AxisLimits
    )
    max_wheel_acceleration: PositiveOrInfinite = math.inf
    """Largest angular acceleration of either wheel (rad/s^2)."""

    @property
    def unlimited(self) -> bool:
        """Whether no limit is set."""
        return self.v.unlimited and self.omega.unlimited and self.max_wheel_acceleration == math.inf

    def transition(
        self, start: Twist, target: Twist, wheel_speeds: Callable[[float, float], Twist]
    ) -> Iterator[tuple[float, Twist]]:
        """Return the fastest transition along the straight line from one twist to another.

        Args:
            start: The twist at the beginning.
            target: The twist at the end.
            wheel_speeds: Maps a twist to the wheel speeds (rad/s), linearly.

        Yields:
            The duration of each part (s), not zero, and the twist at its end. Within a part both speeds
            are linear in time. Nothing, if the target is reached at once. A jump, where there is no
            limit, is a part of no duration, and so is what takes less than `SHORTEST`.
        """
        (v, omega), dv, domega = start, target[0] - start[0], target[1] - start[1]
        wheels = max(map(abs, wheel_speeds(dv, domega)))
        # Where v or omega changes its sign, as a share of the transition.
        v_share, omega_share = _zero(v, dv), _zero(omega, domega)
        share, here = 0.0, start
        for end in sorted({v_share, omega_share, 1.0}):
            there = target
            if end < 1.0:
                there = (
                    0.0 if end == v_share else v + dv * end,
                    0.0 if end == omega_share else omega + domega * end,
                )
            middle = (here[0] + there[0]) / 2.0, (here[1] + there[1]) / 2.0
            # The time for the whole transition at the rates of this part; at no limit zero.
            seconds = max(
                abs(dv) / self.v.rate(middle[0], dv),
                abs(domega) / self.omega.rate(middle[1], domega),
                wheels / self.max_wheel_acceleration,
            )
            duration = seconds * (end - share)
            yield duration if duration >= SHORTEST else 0.0, there
            share, here = end, there


def _zero(speed: float, change: float) -> float:
    """Return the share of a change after which a speed is zero; 1.0 if it is not on the way."""
    return -speed / change if min(speed, speed + change) < 0.0 < max(speed, speed + change) else 1.0
