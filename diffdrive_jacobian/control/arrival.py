"""Arrival criterion.

Document A's law needs a tolerance, because the heading to the goal is undefined at distance zero. For
document B's law the distance is measured from the offset point (doc/mathematics.md, "Control laws").
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

from diffdrive_jacobian.kinematics.diff_drive import offset_point
from diffdrive_jacobian.numerics.checks import (
    NotNegative,
    NotNegativeOrInfinite,
    boolean,
    constant,
    equal,
    finite,
    hashable,
)
from diffdrive_jacobian.numerics.elementary import hypot, wrap
from diffdrive_jacobian.numerics.fields import Checked
from diffdrive_jacobian.numerics.formula import Number, formula


@formula('(),(),(),(),(),() -> ()')
def distance_to_goal(
    x: Number, y: Number, theta: Number, x_goal: Number, y_goal: Number, offset: Number
) -> Number:
    """Compute the distance of the point at x = offset in the body frame from a goal, shape (...) (m)."""
    x_d, y_d = offset_point.formula((x, y, theta), offset)
    return hypot(x_goal - x_d, y_goal - y_d)


@formula('(),() -> ()')
def heading_error(theta: Number, heading: Number) -> Number:
    """Compute the smaller angle from a heading to the desired one, shape (...) (rad)."""
    return wrap(heading - theta)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Arrival(Checked):
    """Arrival criterion. Immutable, comparable and hashable.

    Raises:
        ValueError: A tolerance is negative or not finite, a velocity is negative or NaN, the offset is
            not finite, or `use_heading` is not a Boolean.
    """

    xy_tolerance: NotNegative = 0.02
    """Largest distance to a goal that counts as arrived (m)."""
    yaw_tolerance: NotNegative = 0.02
    """Largest heading error at the goal, if the heading counts (rad)."""
    use_heading: Annotated[bool, boolean] = False
    """Whether the heading of the last goal counts."""
    offset: Annotated[Any, partial(constant, check=finite)] = 0.0
    """X coordinate in the body frame of the point that is to arrive (m), a number or an array."""
    trans_stopped_velocity: NotNegativeOrInfinite = math.inf
    """Largest speed with which the last goal counts as reached, as in Nav2's goal checker (m/s)."""
    rot_stopped_velocity: NotNegativeOrInfinite = math.inf
    """Largest yaw rate with which it does (rad/s)."""

    def __eq__(self, other: object) -> bool:
        """Compare every field, arrays by shape and entries."""
        if not isinstance(other, Arrival):
            return NotImplemented
        return self._scalars() == other._scalars() and equal(self.offset, other.offset)

    def __hash__(self) -> int:
        """Return a hash that equal values share."""
        return hash((*self._scalars(), hashable(self.offset)))

    def _scalars(self) -> tuple[float, ...]:
        stopped = self.trans_stopped_velocity, self.rot_stopped_velocity
        return self.xy_tolerance, self.yaw_tolerance, self.use_heading, *stopped

    def distance(self, x: Any, y: Any, theta: Any, x_goal: Any, y_goal: Any) -> Any:
        """Compute the distance of the driven point from a goal.

        Args:
            x: Position of the axle centre, shape (...) (m).
            y: Likewise.
            theta: Heading, shape (...) (rad).
            x_goal: Position of the goal, shape (...) (m).
            y_goal: Likewise.

        Returns:
            The distance, shape (...) (m).

        Raises:
            ValueError: An argument is not finite, shapes do not broadcast, or the distance overflows.
        """
        return distance_to_goal(x, y, theta, x_goal, y_goal, self.offset)

    def reached(self, x: float, y: float, theta: float, x_goal: float, y_goal: float) -> bool:
        """Return whether the distance to a goal is within the tolerance, without checks."""
        distance = distance_to_goal.formula(x, y, theta, x_goal, y_goal, self.offset)
        return bool(distance <= self.xy_tolerance)

    def faces(self, theta: Any, heading: Any) -> Any:
        """Return whether the robot has the heading of a goal.

        Args:
            theta: Heading of the robot, shape (...) (rad).
            heading: Heading of the goal, shape (...) (rad).

        Returns:
            Booleans, shape (...).

        Raises:
            ValueError: An argument is not finite, shapes do not broadcast, or the difference overflows.
        """
        return abs(heading_error(theta, heading)) <= self.yaw_tolerance

    @property
    def must_stop(self) -> bool:
        """Whether a robot must be slow enough to count as arrived."""
        return min(self.trans_stopped_velocity, self.rot_stopped_velocity) < math.inf

    def stopped(self, v: Any, omega: Any) -> Any:
        """Return whether a robot with a twist is slow enough, numbers or arrays; NaN is not."""
        return (abs(v) <= self.trans_stopped_velocity) & (abs(omega) <= self.rot_stopped_velocity)
