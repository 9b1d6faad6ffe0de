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

"""Driving to goals and along paths: from the pose and the twist of a robot to its next command.

Imports no ROS. The node go_to_goal reads messages, calls this, and publishes.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.control import Path, Waypoints
from diffdrive_jacobian.control.goal_laws import LARGEST_TURN, by_shorter_turn
from diffdrive_jacobian.control.path_following import PathFollower
from diffdrive_jacobian.kinematics.saturation import scaled_to_limits
from diffdrive_jacobian.messages.codecs import Route, State
from diffdrive_jacobian.parameters.go_to_goal import GoToGoalParameters
from diffdrive_jacobian.simulation.braking import Braking
from diffdrive_jacobian.time_units import NANOSECONDS

Pose = tuple[float, float, float]
Twist = tuple[float, float]
STANDSTILL = (0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Goal:
    """What one message asks for: poses to reach in order, or a path."""

    frame: str
    """Frame of the poses; empty: that of the odometry."""
    poses: NDArray[np.float64]
    """`[x, y, theta]` each, shape (n, 3) (m, m, rad)."""
    path: Path | None = None
    """The path through them, with times a trajectory; None: they are driven to one by one."""

    @classmethod
    def through(cls, route: Route) -> Goal:
        """Return the poses to reach one by one."""
        return cls(route.frame, np.array(route.poses))

    @classmethod
    def along_path(cls, route: Route) -> Goal:
        """Return the path through all poses, or raise ValueError if fewer than two positions differ."""
        try:
            path = Path(np.array(route.poses), None if route.times is None else np.array(route.times))
        except ValueError as error:
            raise ValueError(f'path is invalid: {error}') from error
        return cls(route.frame, path.poses, path)

    def is_same_path(self, other: Goal) -> bool:
        """Return whether both are the same path."""
        if self.path is None or other.path is None or self.frame != other.frame:
            return False
        one, two = self.path.times, other.path.times
        same = one is two if one is None or two is None else np.array_equal(one, two)
        return same and np.array_equal(self.poses, other.poses)

    def __str__(self) -> str:
        """Describe it for the log."""
        x, y, _ = self.poses[-1]
        count, words = len(self.poses), ''
        if self.path is not None:
            time = '' if self.path.times is None else f' in {self.path.duration:.1f} s'
            words = f'path of {self.path.length:.2f} m{time} through {count} poses, the last at '
        elif count > 1:
            words = f'{count} waypoints, the last at '
        return f'{words}x {x:.3f}, y {y:.3f}'


@dataclass(frozen=True, slots=True, eq=False)
class Pursuit:
    """A goal, and how far the robot has got. Immutable."""

    goal: Goal
    waypoints: Waypoints
    follower: PathFollower | None = None
    """The path that is followed; None: the waypoints are driven to one by one, or the last pose."""
    first_step: int = 0
    """Time of the first step along the path (ns)."""
    last_step: int = 0
    """Time of the last step along the path (ns)."""
    missed: bool = False
    """Whether a waypoint was passed too far away: it and those after it are driven to one by one."""

    @classmethod
    def of(cls, goal: Goal) -> Pursuit:
        """Return a goal at its beginning."""
        return cls(goal, Waypoints(goal.poses), None if goal.path is None else PathFollower(goal.path))

    @property
    def index(self) -> int:
        """Index of the pose that is driven to."""
        if self.follower is None:
            return self.waypoints.index
        # A path through waypoints begins at the robot, which is no pose of the goal.
        return max(self.follower.index - 1, 0) if self.follower.passing else self.follower.index

    def lateness(self, now: int) -> str:
        """Describe how much later than by its times a trajectory ended at a time (ns)."""
        path = self.goal.path
        if path is None or path.times is None:
            return ''
        late = max((now - self.first_step) / NANOSECONDS - path.duration, 0.0)
        return f', {late:.1f} s later than by its times'

    def resumed(self) -> Pursuit:
        """Return it with the way to the waypoints begun again: the driven point is another one."""
        return replace(self, waypoints=self.waypoints.resumed())

    def without_path(self) -> Pursuit:
        """Return it off its path: the pose at the end, or the waypoints that remain, are driven to."""
        poses, index = self.goal.poses, self.index
        waypoints, missed = Waypoints(poses, index), index + 1 < len(poses)
        return replace(self, follower=None, waypoints=waypoints, missed=missed)


class Steering:
    """The laws and the limits that parameters choose, and the commands that follow from them."""

    def __init__(self, parameters: GoToGoalParameters, before: Steering | None = None) -> None:
        """Take the parameters. `before`: those until now, whose laws go on where they are the same."""
        self._parameters = parameters
        self.controller = parameters.chosen_controller()
        self.arrival = parameters.arrival()
        self.actuators = actuators = parameters.actuators()
        self._law = self.controller.bind(parameters)
        self._path_law = parameters.chosen_path_controller().bind(parameters)
        # Far from the goal a law may return more than what counts as a plausible command.
        self._limits = parameters.limits().all()
        self._path_settings = parameters.path_settings()
        self._braking: Braking | None = None
        if parameters.stop_in_time and not actuators.immediate:
            self._braking = Braking(actuators)
        if before is None:
            return
        self._law.continue_from(before._law)
        self._path_law.continue_from(before._path_law)
        if self._braking is not None and before._braking is not None and before.actuators == actuators:
            self._braking = before._braking

    def drives_otherwise(self, before: Steering) -> bool:
        """Return whether the law or the driven point is another one."""
        return (self.controller, self.arrival.offset) != (before.controller, before.arrival.offset)

    def reset(self) -> None:
        """Let the laws forget what they remember: a new goal begins, or the robot has stood."""
        self._law.reset()
        self._path_law.reset()

    def stopped(self, now: int) -> None:
        """Note that the robot was commanded to stop at a time (ns)."""
        if self._braking is not None:
            self._braking.sent(now, STANDSTILL)

    def begin(self, pursuit: Pursuit, pose: Pose) -> Pursuit:
        """Return a goal from where the robot is, or raise ValueError: a path begins too far away."""
        goal = pursuit.goal
        if pursuit.follower is not None:
            (x, y, _), path = pose, pursuit.follower.path
            start = path.at(path.nearest(x, y, pursuit.follower.s), 0.0)
            distance, most = math.hypot(start.x - x, start.y - y), self._parameters.max_path_distance
            if distance > most:
                raise ValueError(
                    f'the start of a path must be within max_path_distance, {most:g} m, of the robot, '
                    f'got {distance:.3g} m'
                )
        elif goal.path is None and self._parameters.pass_waypoints and len(goal.poses) > 1:
            # All of them may be in one place, where the robot is.
            with suppress(ValueError):
                through = PathFollower(Path(np.array([pose, *goal.poses])), passing=True)
                return replace(pursuit, follower=through)
        return pursuit

    def command(
        self, pursuit: Pursuit, state: State, now: int, rate: float
    ) -> tuple[Pursuit, Twist | None]:
        """Compute the next command, which is sent at that time.

        Args:
            pursuit: The goal.
            state: Pose and twist of the robot.
            now: The time (ns).
            rate: Rate of the commands (Hz).

        Returns:
            The goal with the new progress, and the command (m/s, rad/s); None: the robot has arrived.

        What a law raises, a ValueError, is passed on.
        """
        pose, twist = state.pose, state.twist
        # For laws that remember something.
        self._law.now = self._path_law.now = now
        command = None
        if pursuit.follower is not None:
            pursuit, command = self._along_path(pursuit, pursuit.follower, pose, now)
        if command is None:
            # Without a path, or no longer on it.
            waypoints, command = pursuit.waypoints.follow(
                pose, self._law, self.arrival, self._parameters.kp, twist
            )
            if waypoints is not pursuit.waypoints:
                pursuit = replace(pursuit, waypoints=waypoints)
            if command is None:
                return pursuit, None
        # Without wheels in the limits the geometry of the wheels does not matter.
        v, omega = scaled_to_limits.floats(*command, *self._limits, r=1.0, L=1.0)
        if abs(omega) > LARGEST_TURN * rate:
            # Not a whole turn between two messages. The other direction may be forbidden.
            omega = by_shorter_turn(omega, rate)
            v, omega = scaled_to_limits.floats(v, omega, *self._limits, r=1.0, L=1.0)
        if self._braking is not None:
            v, omega = self._braked(self._braking, pursuit, state, (v, omega), now, rate)
            self._braking.sent(now, (v, omega))
        return pursuit, (v, omega)

    def _along_path(
        self, pursuit: Pursuit, follower: PathFollower, pose: Pose, now: int
    ) -> tuple[Pursuit, Twist | None]:
        """Compute the next command along a path; None: its end is reached, or a waypoint was missed."""
        # While the robot stands because odometry is missing, a trajectory waits.
        longest = self._parameters.odom_timeout or math.inf
        dt = min(max(0, now - (pursuit.last_step or now)) / NANOSECONDS, longest)
        follower, command = follower.follow(pose, dt, self._path_law, self._law, self._path_settings)
        pursuit = replace(
            pursuit, follower=follower, first_step=pursuit.first_step or now, last_step=now
        )
        if command is None:
            return pursuit.without_path(), None
        return pursuit, command

    def _braked(
        self,
        braking: Braking,
        pursuit: Pursuit,
        state: State,
        command: Twist,
        now: int,
        rate: float,
    ) -> Twist:
        """Return a command from which the robot can stop at the last goal."""
        # Along a path the axle centre counts, and a turn in place moves the driven point in any case.
        of_axle = pursuit.follower is not None or pursuit.waypoints.turning
        offset = 0.0 if of_axle else float(self.arrival.offset)

        def room(turn: float) -> Twist:
            if pursuit.follower is not None:
                return pursuit.follower.remaining()
            return pursuit.waypoints.remaining(state.pose, self.arrival, turn)

        return braking.limited(now, state.twist, command, room, 1.0 / rate, offset=offset)
