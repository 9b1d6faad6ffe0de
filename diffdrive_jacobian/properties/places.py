"""Where the robot is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

from rclpy.publisher import Publisher

from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.messages.conversion import MAX_POSITION
from diffdrive_jacobian.numerics.checks import NotNegativeOrInfinite
from diffdrive_jacobian.numerics.fields import Name
from diffdrive_jacobian.properties._messages import Pose, Twist, read_pose, read_twist
from diffdrive_jacobian.properties._node_time import ROUNDING
from diffdrive_jacobian.properties.base import Property, Watch


def _numbers(values: Any) -> tuple[float, ...]:
    """Return numbers as a tuple, an empty one if they are none."""
    try:
        return tuple(float(value) for value in values)
    except (TypeError, ValueError):
        return ()


def _interval(name: str, value: Any) -> tuple[float, ...]:
    """Require a least and a largest number."""
    limits = _numbers(value)
    if len(limits) != 2 or not limits[0] <= limits[1]:
        raise ValueError(f'{name} must be the least and the largest value, got {value!r}')
    return limits


def _corners(name: str, value: Any) -> tuple[tuple[float, ...], ...]:
    """Require a sequence of points."""
    corners = tuple(map(_numbers, value)) if isinstance(value, Sequence) else ()
    if not corners or any(len(corner) != 2 for corner in corners):
        raise ValueError(f'{name} must be a sequence of (x, y), got {value!r}')
    return corners


Interval = Annotated[tuple[float, float], _interval]


@dataclass(frozen=True, repr=False)
class PlaceProperty(Property):
    """A property of the poses in the odometry. Base class.

    Attributes:
        odom: Topic of type Odometry (default: 'odom'). 'ground_truth' for the true pose of a virtual
            robot that drifts.
    """

    odom: Name = field(default='odom', kw_only=True)

    def watch(self, world: Lockstep) -> Watch:
        """Begin to observe a run."""
        return _PlaceWatch(self, world)

    def violation(self, pose: Pose, twist: Twist) -> str | None:
        """Return what is allowed, if a pose and a twist of the odometry are not; None: they are."""
        raise NotImplementedError


class _PlaceWatch(Watch):
    def __init__(self, required: PlaceProperty, world: Lockstep) -> None:
        super().__init__(world)
        self._required = required
        world.expect(required.resolved(required.odom))
        self._odom = world.on_published(required.resolved(required.odom), self._on_odometry)

    def _on_odometry(self, publisher: Publisher, message: Any) -> None:
        pose = read_pose(publisher.msg_type, message)
        twist = read_twist(publisher.msg_type, message)
        if pose is None or twist is None:
            self.found(f'{self._odom}: bytes that are no Odometry')
        elif (allowed := self._required.violation(pose, twist)) is not None:
            self.found(f'{self._odom}: {pose}, {twist}; allowed: {allowed}')
        elif self._found is None:
            self.note(self._odom, ': ', pose, ', ', twist)


@dataclass(frozen=True, repr=False)
class PoseFinite(PlaceProperty):
    """Pose and twist in the odometry are finite, and the position is below 1e6 m.

    Each published message counts.
    """

    def violation(self, pose: Pose, twist: Twist) -> str | None:
        """Return what is allowed; None: the values are finite."""
        if math.isfinite(sum(pose) + sum(twist)) and max(abs(pose.x), abs(pose.y)) <= MAX_POSITION:
            return None
        return f'finite values, and a position of at most {MAX_POSITION:g} m'


@dataclass(frozen=True, repr=False)
class StaysWithin(PlaceProperty):
    """The robot stays within a box. Each published message of the odometry counts.

    Attributes:
        x: Least and largest x (m).
        y: Least and largest y (m).
    """

    x: Interval
    y: Interval

    def violation(self, pose: Pose, twist: Twist) -> str | None:
        """Return what is allowed; None: the robot is within the box."""
        (left, right), (low, high) = self.x, self.y
        if left - ROUNDING <= pose.x <= right + ROUNDING and low - ROUNDING <= pose.y <= high + ROUNDING:
            return None
        return f'x from {left:g} m to {right:g} m, y from {low:g} m to {high:g} m'


@dataclass(frozen=True, repr=False)
class StaysNear(PlaceProperty):
    """The robot stays near a path. Each published message of the odometry counts.

    Attributes:
        path: The corners of the path, `((x, y), ...)` (m).
        distance: Largest distance to the path (m).
    """

    path: Annotated[tuple[tuple[float, float], ...], _corners]
    distance: NotNegativeOrInfinite

    def violation(self, pose: Pose, twist: Twist) -> str | None:
        """Return what is allowed; None: the robot is near the path."""
        ends = zip(self.path, self.path[1:] or self.path, strict=False)
        nearest = min(_distance(pose.x, pose.y, start, end) for start, end in ends)
        if nearest <= self.distance + ROUNDING:
            return None
        return f'at most {self.distance:g} m from the path, not {nearest:.6g} m'


def _distance(x: float, y: float, start: tuple[float, float], end: tuple[float, float]) -> float:
    """Return the distance of a point to a line segment (m)."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    length = dx * dx + dy * dy
    part = ((x - start[0]) * dx + (y - start[1]) * dy) / length if length > 0.0 else 0.0
    part = min(max(part, 0.0), 1.0)
    return math.hypot(x - start[0] - part * dx, y - start[1] - part * dy)
