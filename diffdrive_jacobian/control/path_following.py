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

"""Following a path: where the robot is along it, and what drives it at each place.

- Far from the path, the law of goals drives the robot to it.
- A robot that faces backwards turns in place.
- On the path the law of the path drives.
- At its end, the last pose is a goal like any other.

Each step takes the robot's pose and returns the next command. The time of a trajectory advances
while the law of the path drives, and waits for a robot that is late.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import cos, hypot, inf, pi, sin, sqrt
from typing import Any

from diffdrive_jacobian.control.controller import BoundLaw
from diffdrive_jacobian.control.goal_laws import turn_in_place
from diffdrive_jacobian.control.path import Path, Reference
from diffdrive_jacobian.control.waypoints import LawWithGains
from diffdrive_jacobian.numerics.checks import Checked, NotNegative, Positive
from diffdrive_jacobian.numerics.elementary import wrap

STEPS = 8
"""Number of steps in which the point at the look-ahead distance is searched."""
REACH = 4
"""Arc length that is searched for it, in look-ahead distances."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PathSettings(Checked):
    """How a path is followed. A field that is out of range raises ValueError."""

    speed: NotNegative = 0.2
    """Speed along a path without times (m/s)."""
    deceleration: Positive = 0.5
    """Deceleration towards its end (m/s^2)."""
    approach_distance: Positive = 0.3
    """Distance from the path beyond which the law of goals drives the robot to it (m)."""
    turning_gain: Positive = 3.0
    """Gain of the turn in place (1/s)."""
    catching_up: NotNegative = 0.5
    """Gain on the distance from the pose of a trajectory, for a law with a look-ahead distance (1/s)."""
    end_tolerance: NotNegative = 0.02
    """Rest of the path at which its end is driven to as a goal (m)."""
    waypoint_tolerance: Positive = 0.1
    """Largest distance at which a waypoint counts as passed (m)."""


@dataclass(frozen=True, slots=True)
class PathFollower:
    """A path and the progress along it. Immutable."""

    path: Path
    passing: bool = False
    """Whether each pose is a waypoint that the robot must pass within the tolerance."""
    s: float = 0.0
    """Arc length of the nearest point (m)."""
    elapsed: float = 0.0
    """Time of the trajectory (s)."""
    index: int = 0
    """The next pose to pass; at the end of the path the last one."""

    def follow(
        self,
        pose: tuple[float, float, float],
        dt: float,
        law: BoundLaw,
        law_of_goals: LawWithGains,
        how: PathSettings,
    ) -> tuple[PathFollower, tuple[Any, Any] | None]:
        """Compute the next command.

        The time since the step before, dt, is in s. The law of the path is reset where another one
        drives.

        Returns the follower with the new progress, and the command `(v, omega)` (m/s, rad/s). The
        command is None at the end, and where a waypoint was missed: then what follows `index` remains,
        to be driven to as goals.
        """
        x, y, theta = pose
        path = self.path
        s = path.nearest(x, y, self.s, forward=True)
        nearest = path.at(s, 0.0)
        far = hypot(nearest.x - x, nearest.y - y) > how.approach_distance
        if far:
            # On the way to the path there is no progress along it.
            s = self.s
        here = replace(self, s=s, index=self._next(x, y, s, how.waypoint_tolerance))
        if here.passing and s > path.arc_lengths[here.index] + how.waypoint_tolerance:
            return here, None
        elapsed = self.elapsed + dt
        if path.times is None:
            over = s >= path.length - how.end_tolerance
        else:
            over, elapsed = elapsed >= path.duration, min(elapsed, path.duration)
        if over:
            if self.passing:
                return here, None
            return replace(here, index=len(path.poses) - 1, elapsed=elapsed), None
        reference = here.reference(how)
        away = hypot(reference.x - x, reference.y - y)
        if far or (away > how.approach_distance and path.times is None):
            law.reset()
            return here, law_of_goals(pose, reference[:3])
        if away > how.approach_distance:
            # A robot that is late, but on the path, goes on along it while the trajectory waits.
            dt = 0.0
        if abs(wrap(reference.theta - theta)) > pi / 2.0:
            law.reset()
            return here, turn_in_place.formula(theta, reference.theta, how.turning_gain)
        here = replace(here, elapsed=self.elapsed + dt)
        if law.lookahead:
            return here, law(pose, here._target(x, y, law.lookahead, how))
        return here, law(pose, here.reference(how))

    def remaining(self) -> tuple[float, float]:
        """Return the rest of the path (m), and the turn that is left, which is unknown: infinite."""
        return max(self.path.length - self.s, 0.0), inf

    def _next(self, x: float, y: float, s: float, tolerance: float) -> int:
        """Return the index of the next pose to pass."""
        last = len(self.path.poses) - 1
        if not self.passing:
            return min(int(self.path.arc_lengths.searchsorted(s, 'right')), last)
        index = self.index
        while index < last and hypot(*(self.path.poses[index, :2] - (x, y))) <= tolerance:
            index += 1
        return index

    def reference(self, how: PathSettings) -> Reference:
        """Return where the robot should be."""
        if self.path.times is not None:
            return self.path.at_time(self.elapsed)
        slowing = sqrt(2.0 * how.deceleration * max(self.path.length - self.s, 0.0))
        if how.speed <= slowing:
            return self.path.at(self.s, how.speed)
        here = self.path.at(self.s, slowing)
        ax, ay = how.deceleration * cos(here.theta), how.deceleration * sin(here.theta)
        return here._replace(ax=here.ax - ax, ay=here.ay - ay)

    def _target(self, x: float, y: float, lookahead: float, how: PathSettings) -> Reference:
        """Return the first point of the path at the look-ahead distance. The path goes on straight.

        If the robot is farther from the path, return the nearest point.
        """
        reference = self.reference(how)
        v = reference.v
        if self.path.times is not None:
            v = max(0.0, v + how.catching_up * (reference.s - self.s))
        step = lookahead / STEPS
        before = distance = 0.0
        # The path may be a curl that is narrower.
        for number in range(REACH * STEPS):
            target = self._beyond(self.s + number * step, v)
            before, distance = distance, hypot(target.x - x, target.y - y)
            if distance >= lookahead:
                break
        if number and distance > lookahead:
            excess = (distance - lookahead) / (distance - before)
            target = self._beyond(self.s + (number - excess) * step, v)
        return target

    def _beyond(self, s: float, v: float) -> Reference:
        """Return the path at an arc length, which may be beyond its end."""
        place = self.path.at(s, v)
        rest = 0.0 if self.path.closed else max(s - self.path.length, 0.0)
        return place._replace(x=place.x + rest * cos(place.theta), y=place.y + rest * sin(place.theta))
