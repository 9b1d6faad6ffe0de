"""Wheel motors that are not ideal: they saturate one by one, and follow their commands with a lag.

State of a lagging motor: its speed (rad/s). Input: the commanded speed, held from one command to the
next, and limited to what the motor can reach. The speed follows it with first order,

    tau d omega / dt = omega_commanded - omega

The motion of a robot consists of arcs of constant wheel speeds. So the lag is a series of steps of
`STEP`, each with the mean speed of the wheel in it. At the end of each step the wheel angles are exact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

from diffdrive_jacobian.numerics.checks import NotNegative, NotNegativeOrInfinite
from diffdrive_jacobian.numerics.fields import Checked
from diffdrive_jacobian.time_units import NANOSECONDS

STEP = 20_000_000
"""Duration of the arcs of which a lagging motion consists (ns)."""
SETTLED = 1e-4
"""Difference from the commanded speed below which a wheel has reached it (rad/s)."""

Speeds: TypeAlias = tuple[float, float]
"""`(omega_R, omega_L)` (rad/s)."""


class Settling(NamedTuple):
    """One step of wheels that approach their commanded speeds."""

    since: int
    """Time from which on the present command is followed (ns)."""
    start: int
    """Time at which the step began (ns)."""
    speeds: Speeds
    """Wheel speeds at that time."""
    commanded: Speeds
    """Wheel speeds that they approach."""

    @property
    def end(self) -> int:
        """Time at which the step ends (ns)."""
        return self.start + STEP


@dataclass(frozen=True, kw_only=True, slots=True)
class Actuators(Checked):
    """What the wheel motors can do.

    The robot does not know it: unlike its velocity limits it does not keep the curvature of the path.

    Raises:
        ValueError: A value is negative or NaN, or the lag is infinite.
    """

    max_right_speed: NotNegativeOrInfinite = math.inf
    """Largest speed of the right wheel (rad/s); 0: its motor is dead, and the wheel stands still."""
    max_left_speed: NotNegativeOrInfinite = math.inf
    """Largest speed of the left wheel (rad/s)."""
    lag: NotNegative = 0.0
    """Time constant tau (s)."""

    def limited(self, speeds: Speeds) -> Speeds:
        """Return the speeds that the motors can reach."""
        (right, left), most_right, most_left = speeds, self.max_right_speed, self.max_left_speed
        # Of a dead motor not -0.0.
        return (
            max(-most_right, min(most_right, right)) + 0.0,
            max(-most_left, min(most_left, left)) + 0.0,
        )

    def after(self, settling: Settling, stamp: int) -> Speeds:
        """Return the wheel speeds at a time not before the start of the step (ns)."""
        rest = self._rest((stamp - settling.start) / NANOSECONDS)
        right, left = (
            goal + (speed - goal) * rest
            for speed, goal in zip(settling.speeds, settling.commanded, strict=True)
        )
        return right, left

    def mean(self, settling: Settling) -> Speeds:
        """Return the mean wheel speeds of the step."""
        share = self.lag * NANOSECONDS / STEP * -math.expm1(-STEP / NANOSECONDS / self.lag)
        right, left = (
            goal + (speed - goal) * share
            for speed, goal in zip(settling.speeds, settling.commanded, strict=True)
        )
        return right, left

    def settled(self, speeds: Speeds, commanded: Speeds) -> bool:
        """Return whether the wheels have reached the commanded speeds."""
        if not self.lag:
            return True
        return abs(speeds[0] - commanded[0]) <= SETTLED and abs(speeds[1] - commanded[1]) <= SETTLED

    def _rest(self, seconds: float) -> float:
        """Return the share of a difference that is left after a time (s)."""
        return math.exp(-seconds / self.lag) if self.lag else 0.0
