"""Arrival criterion.

Document A's law needs a tolerance, because the heading to the goal is undefined at distance zero. For
document B's law the distance is measured from the offset point (doc/mathematics.md, "Control laws").
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from math import isfinite
from typing import Any

from diffdrive_jacobian.numerics.checks import (
    boolean,
    equal,
    hashable,
    not_negative,
    number,
    read_only,
)
from diffdrive_jacobian.numerics.elementary import (
    agree,
    cos,
    evaluated,
    hypot,
    operand,
    sin,
    wrapped,
)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Arrival:
    """Arrival criterion. Immutable, comparable and hashable.

    Raises:
        ValueError: A tolerance is negative or not finite, the offset is not finite, or `use_heading` is
            not a Boolean.
    """

    xy_tolerance: float = 0.02
    """Largest distance to a goal that counts as arrived (m)."""
    yaw_tolerance: float = 0.02
    """Largest heading error at the goal, if the heading counts (rad)."""
    use_heading: bool = False
    """Whether the heading of the last goal counts."""
    offset: Any = 0.0
    """X coordinate in the body frame of the point that is to arrive (m), a number or an array."""
    _centre: bool = field(init=False, repr=False)
    """Whether that is the axle centre."""

    def __post_init__(self) -> None:
        """Check every value."""
        for name in ('xy_tolerance', 'yaw_tolerance'):
            object.__setattr__(self, name, number(name, getattr(self, name), not_negative))
        object.__setattr__(self, 'use_heading', boolean('use_heading', self.use_heading))
        offset = operand('offset', self.offset)
        object.__setattr__(self, 'offset', offset if type(offset) is float else read_only(offset))
        object.__setattr__(self, '_centre', type(offset) is float and offset == 0.0)

    def __eq__(self, other: object) -> bool:
        """Compare every field, arrays by shape and entries."""
        if not isinstance(other, Arrival):
            return NotImplemented
        return self._scalars() == other._scalars() and equal(self.offset, other.offset)

    def __hash__(self) -> int:
        """Return a hash that equal values share."""
        return hash((*self._scalars(), hashable(self.offset)))

    def _scalars(self) -> tuple[float, float, bool]:
        return self.xy_tolerance, self.yaw_tolerance, self.use_heading

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
        if type(x) is type(y) is type(theta) is type(x_goal) is type(y_goal) is float and isfinite(
            theta
        ):
            # It is not finite if one of the positions or the offset is not.
            if self._centre:
                distance = math.hypot(x_goal - x, y_goal - y)
            else:
                distance = self._distance(x, y, theta, x_goal, y_goal)
            if type(distance) is float and isfinite(distance):
                return distance
        x, y, theta = operand('x', x), operand('y', y), operand('theta', theta)
        x_goal, y_goal = operand('x_goal', x_goal), operand('y_goal', y_goal)
        single = agree(x=x, y=y, theta=theta, x_goal=x_goal, y_goal=y_goal, offset=self.offset)
        (distance,) = evaluated(
            single,
            'x, y, x_goal, y_goal and offset',
            lambda *arguments: (self._distance(*arguments),),
            *(x, y, theta, x_goal, y_goal),
        )
        return distance

    def _distance(self, x: Any, y: Any, theta: Any, x_goal: Any, y_goal: Any) -> Any:
        if not self._centre:
            x, y = x + self.offset * cos(theta), y + self.offset * sin(theta)
        return hypot(x_goal - x, y_goal - y)

    def reached(self, x: float, y: float, theta: float, x_goal: float, y_goal: float) -> bool:
        """Return whether the distance to a goal is within the tolerance, without checks."""
        if self._centre:
            return math.hypot(x_goal - x, y_goal - y) <= self.xy_tolerance
        return bool(self._distance(x, y, theta, x_goal, y_goal) <= self.xy_tolerance)

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
        if type(theta) is type(heading) is float and isfinite(theta + heading):
            error = wrapped(heading - theta)
            if isfinite(error):
                return abs(error) <= self.yaw_tolerance
        theta, heading = operand('theta', theta), operand('heading', heading)
        single = agree(theta=theta, heading=heading)
        (error,) = evaluated(single, 'theta and heading', _heading_error, theta, heading)
        return abs(error) <= self.yaw_tolerance


def _heading_error(theta: Any, heading: Any) -> tuple[Any]:
    return (wrapped(heading - theta),)
