# Copyright 2026 The diffdrive_jacobian developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Limits of speed and acceleration, and where the robot is: on a path, near it, in a box."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, NamedTuple

import numpy as np
from rclpy.publisher import Publisher

from diffdrive_jacobian.control import Path
from diffdrive_jacobian.control.path import PathProgress
from diffdrive_jacobian.faults.fault import RosName
from diffdrive_jacobian.messages.codecs import PATH
from diffdrive_jacobian.messages.conversion import MAX_POSITION, MessageError
from diffdrive_jacobian.numerics.checks import (
    Names,
    NotNegative,
    NotNegativeOrInfinite,
    Positive,
    PositiveOrInfinite,
)
from diffdrive_jacobian.properties.base import ROUNDING, Property
from diffdrive_jacobian.robot_testing.fields import field_reader
from diffdrive_jacobian.robot_testing.odometry import MotionProperty
from diffdrive_jacobian.robot_testing.readings import Pose, Twist, read_twist
from diffdrive_jacobian.time_units import NANOSECONDS

MARGIN = 1e-9
"""Relative margin for rounding."""


@dataclass(repr=False)
class TwistProperty(Property):
    """A property of the twists on a topic, which are limited. Base class.

    Attributes:
        v: Limit of linear.x (m/s, or m/s^2 of its rate); infinite: none.
        omega: Limit of angular.z (rad/s, or rad/s^2 of its rate); infinite: none.
        topic: Topic of type Twist, TwistStamped or Odometry, of which the twist counts (default:
            'cmd_vel').
    """

    v: NotNegativeOrInfinite
    omega: NotNegativeOrInfinite
    topic: RosName = field(default='cmd_vel', kw_only=True)


@dataclass(repr=False)
class NeverFasterThan(TwistProperty):
    """No twist on a topic is faster than a limit: `|linear.x| <= v` and `|angular.z| <= omega`.

    Each published message counts, whoever publishes it, and whether or not it is delivered. NaN is a
    violation, and so are bytes that are not a message. The limits have a relative margin of 1e-9 for
    rounding.
    """

    def begin(self) -> None:
        """Begin to observe the twists."""
        self._limits = self.v * (1.0 + MARGIN), self.omega * (1.0 + MARGIN)
        self._topic = self.on_published(self.topic, self._on_message, raw=True)

    def _on_message(self, publisher: Publisher, message: Any) -> None:
        twist = read_twist(publisher.msg_type, message)
        if twist is None:
            self.found(f'{self._topic}: bytes that are no {publisher.msg_type.__name__}')
        elif not twist.is_within(*self._limits):
            self.found(
                f'{self._topic}: {twist}; allowed: |v| <= {self.v:g} m/s, '
                f'|omega| <= {self.omega:g} rad/s'
            )
        self.note(self._topic, ': ', twist)


@dataclass(repr=False)
class AccelerationWithin(TwistProperty):
    """The twists on a topic change at limited rates: by `v` m/s and `omega` rad/s per second.

    The changes (added without signs) within any time t must not exceed `v * (t + slack)` and
    `omega * (t + slack)`. So one message may change by `v * slack`, whatever time has passed since the
    one before: the motors got that one until then. `slack` must be at least the period of the messages,
    and more if they may leave late. Time is what the clock of the nodes or world time advances,
    whichever is more. Each publisher is checked on its own, its first message compared with standstill.
    Messages with values that are not finite are violations.

    Attributes:
        slack: Time for which changes may be early (s) (default: 0.1).
        stops: Whether a twist of exactly zero is allowed at any time, as when a robot is stopped because
            its odometry is lost (default: True).
    """

    slack: Positive = field(default=0.1, kw_only=True)
    stops: bool = field(default=True, kw_only=True)

    def begin(self) -> None:
        """Begin to observe the twists."""
        self._start_of_all = _Last(
            Twist(0.0, 0.0), self.world_seconds, self.world.now, self.slack, self.slack
        )
        self._last: dict[Publisher, _Last] = {}
        self._topic = self.on_published(self.topic, self._on_message, raw=True)

    def _on_message(self, publisher: Publisher, message: Any) -> None:
        last = self._last.get(publisher, self._start_of_all)
        twist = read_twist(publisher.msg_type, message)
        if twist is None or not math.isfinite(twist.v + twist.omega):
            self.found(f'{self._topic}: {twist or "invalid bytes"}; allowed: finite values')
            return
        passed = max(self.world_seconds - last.seconds, (self.world.now - last.now) / NANOSECONDS)
        left_v = min(last.left_v + passed, self.slack)
        left_omega = min(last.left_omega + passed, self.slack)
        if not (self.stops and twist.is_zero):
            left_v -= _duration(twist.v - last.twist.v, self.v)
            left_omega -= _duration(twist.omega - last.twist.omega, self.omega)
            if min(left_v, left_omega) < -MARGIN:
                self.found(
                    f'{self._topic}: {twist}, after {last.twist} {passed:g} s before; allowed: changes '
                    f'of {self.v:g} m/s and {self.omega:g} rad/s per second, early by '
                    f'{self.slack:g} s'
                )
        self._last[publisher] = _Last(twist, self.world_seconds, self.world.now, left_v, left_omega)
        self.note(self._topic, ': ', twist)


class _Last(NamedTuple):
    """The last message of a publisher."""

    twist: Twist
    seconds: float
    """World time (s)."""
    now: int
    """Time of the clock of the nodes (ns)."""
    left_v: float
    """What is left of the slack (s): the change that is allowed at once, in seconds of the limit."""
    left_omega: float


def _duration(change: float, rate: float) -> float:
    """Return how long a change takes at a rate of change (s)."""
    if change == 0.0:
        return 0.0
    return abs(change) / rate if rate > 0.0 else math.inf


# --- Places


@dataclass(repr=False)
class PlaceProperty(MotionProperty):
    """A property of each message of the odometry. Base class."""

    @abstractmethod
    def violation(self, pose: Pose, twist: Twist) -> str | None:
        """Return what is allowed, if a pose and a twist of the odometry are not; None: they are."""

    def on_motion(self, pose: Pose, twist: Twist) -> None:
        """Check a message of the odometry."""
        if (allowed := self.violation(pose, twist)) is not None:
            self.found(f'{self._odom}: {pose}, {twist}; allowed: {allowed}')
        self.note(self._odom, ': ', pose, ', ', twist)

    def on_invalid(self) -> None:
        """Note bytes that are no odometry."""
        self.found(f'{self._odom}: bytes that are no Odometry')


@dataclass(repr=False)
class PoseFinite(PlaceProperty):
    """Pose and twist in the odometry are finite, and the position is below 1e6 m.

    Each published message counts.
    """

    def violation(self, pose: Pose, twist: Twist) -> str | None:
        """Return what is allowed; None: the values are finite."""
        if math.isfinite(sum(pose) + sum(twist)) and max(abs(pose.x), abs(pose.y)) <= MAX_POSITION:
            return None
        return f'finite values, and a position of at most {MAX_POSITION:g} m'


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


@dataclass(repr=False)
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


@dataclass(repr=False)
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


# --- Published paths


_read_path = field_reader(lambda _: PATH.fields)


@dataclass(repr=False)
class StaysOnPath(MotionProperty):
    """The robot stays on each path that is published, and reaches its end in time.

    Each message of the odometry counts, from when a path was published until another path or a goal was
    published, or the cancel service has responded. The distance is that from the nearest point of the
    path near the last one, so that crossings of the path do not matter. A message that is no path counts
    as none. With `within`, a run that ends before the end of the path is reached violates the property:
    let it run longer. Time is world time.

    Attributes:
        tolerance: Largest distance from the path, and at last from its end (m).
        within: Time in which the end must be reached (s) (default: infinite, it need not be).
        after: Arc length from which on the distance counts (m) (default: 0.0).
        path: Topic of type nav_msgs/Path (default: 'path').
        goals: Topics of goals, which replace a path (default: ('goal_pose', 'goals')).
        cancel: Service that cancels the path (default: 'cancel_goal').
    """

    tolerance: NotNegative
    within: PositiveOrInfinite = field(default=math.inf, kw_only=True)
    after: NotNegative = field(default=0.0, kw_only=True)
    path: RosName = field(default='path', kw_only=True)
    goals: Names = field(default=('goal_pose', 'goals'), kw_only=True)
    cancel: RosName = field(default='cancel_goal', kw_only=True)

    def begin(self) -> None:
        """Begin to observe the path and the robot."""
        super().begin()
        self._progress: PathProgress | None = None
        self._since = 0.0
        self._reached = False
        self._path = self.on_published(self.path, self._on_path, raw=True)
        for topic in self.goals:
            self.on_published(topic, self._on_other, optional=True, raw=True)
        self.on_response(self.cancel, self._on_other, optional=True)

    def _on_path(self, publisher: Publisher, message: Any) -> None:
        self._progress, self._since, self._reached = None, self.world_seconds, False
        fields = _read_path(publisher.msg_type, message)
        try:
            if fields is not None:
                self._progress = PathProgress(Path(np.array(PATH.value(*fields).poses)))
        except (MessageError, ValueError):
            self.note(f'{self._path}: no path')
        else:
            self.note(f'{self._path}: a path')

    def _on_other(self, _: Any, __: Any) -> None:
        self._progress = None
        self.note('the path is replaced or canceled')

    def on_motion(self, pose: Pose, _: Twist) -> None:
        """Receive a message of the odometry."""
        progress = self._progress
        if progress is None:
            return
        if not math.isfinite(sum(pose)):
            self.found(f'{self._odom}: {pose}; allowed: finite values')
            return
        progress.moved(pose)
        if progress.s >= self.after and not abs(progress.across) <= self.tolerance + ROUNDING:
            self.found(f'{self._where(progress)}; allowed: {self.tolerance:g} m from the path')
        self._reached |= progress.remaining <= self.tolerance + ROUNDING
        self.check()
        self.note(self._odom, ': ', pose)

    def _where(self, progress: PathProgress) -> str:
        if self.pose is None:
            return f'there was no odometry on {self._odom}'
        return (
            f'the robot is {abs(progress.across):.6g} m from the path and {progress.s:.6g} m along its '
            f'{progress.path.length:.6g} m: {self.pose}'
        )

    def check(self) -> str | None:
        """Return what is violated; None: nothing."""
        late = self.world_seconds - self._since > self.within + ROUNDING
        if self._progress is not None and late and not self._reached:
            self.found(
                f'{self.within:g} s after the path was published {self._where(self._progress)}; '
                f'allowed: within {self.tolerance:g} m of its end'
            )
        return None

    def finish(self) -> str | None:
        """Return what is violated at the end; None: nothing."""
        if self._progress is None or self._reached or math.isinf(self.within):
            return None
        return self.described(
            f'the run ended {self.world_seconds - self._since:g} s after the path was published, and '
            f'{self._where(self._progress)}; allowed: within {self.tolerance:g} m of its end. '
            f'Let it run for {self.within:g} s after the path'
        )
