"""What counts as having arrived.

Source: document A's law needs a tolerance, for at distance zero the heading to the goal is undefined;
document B's is judged at the point that it drives (MATH.md, "Control laws", "Differential drive").
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from diffdrive_jacobian.kinematics._checks import not_negative, number
from diffdrive_jacobian.kinematics._elementary import cos, hypot, operand, sin, wrapped


@dataclass(frozen=True, kw_only=True, slots=True)
class Arrival:
    """What counts as having arrived.

    Raises:
        ValueError: A tolerance is negative or not finite, or the offset is not finite.
    """

    xy_tolerance: float = 0.02
    """Largest distance to a goal that counts as there (m)."""
    yaw_tolerance: float = 0.02
    """Largest heading error at the goal, if its heading counts (rad)."""
    use_heading: bool = False
    """Whether the heading of the last goal counts."""
    offset: Any = 0.0
    """How far ahead of the axle centre the point is that is to arrive (m); or an array of it."""

    def __post_init__(self) -> None:
        """Check every value."""
        for name in ('xy_tolerance', 'yaw_tolerance'):
            object.__setattr__(self, name, number(name, getattr(self, name), not_negative))
        offset = operand('offset', self.offset)
        object.__setattr__(self, 'offset', offset if type(offset) is float else np.array(offset))

    def distance(self, x: Any, y: Any, theta: Any, x_goal: Any, y_goal: Any) -> Any:
        """Give the distance to a goal (m) of the point that is to arrive; arguments broadcast."""
        if type(self.offset) is not float or self.offset != 0.0:
            x, y = x + self.offset * cos(theta), y + self.offset * sin(theta)
        return hypot(x_goal - x, y_goal - y)

    def faces(self, theta: Any, heading: Any) -> Any:
        """Tell whether the heading of a goal is taken; arguments broadcast."""
        return abs(wrapped(heading - theta)) <= self.yaw_tolerance
