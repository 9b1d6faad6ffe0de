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

"""What is known of one robot, its path and goals included, and what the page receives of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.bags.run import number
from diffdrive_jacobian.bags.timeline import heading_counts
from diffdrive_jacobian.control import Arrival, Controller, LawError, Path
from diffdrive_jacobian.control.controllers import CONTROLLERS
from diffdrive_jacobian.control.path import PathProgress
from diffdrive_jacobian.kinematics.se2 import wrap_angle
from diffdrive_jacobian.live import quantities, settings
from diffdrive_jacobian.live.quantities import rounded
from diffdrive_jacobian.messages.goal_status import (
    UNSTAMPED,
    Fate,
    FollowedGoal,
    GoalFollower,
    GoalState,
    Stamp,
)
from diffdrive_jacobian.parameters.chosen_law import chosen_law
from diffdrive_jacobian.parameters.go_to_goal import GoToGoalParameters
from diffdrive_jacobian.parameters.virtual_robot import VirtualRobotParameters

ROBOT_DEFAULTS = VirtualRobotParameters()
CONTROLLER_DEFAULTS = GoToGoalParameters()
Values = Mapping[str, Any]
Goals = NDArray[np.float64]
"""`[x, y, theta]` of each, shape (n, 3) (m, m, rad)."""
MAX_PLANNED = 300
"""Number of points of a planned path that the page draws."""
MAX_POINTS = 6000
"""Largest number of points of a path that was driven."""
SPACING = 0.01
"""Distance between two points of a path (m). It doubles when the path is full, unless jumps fill it."""
JUMP = 0.3
"""A longer step is not a motion: the path is interrupted (m)."""
PLACED_JUMP = 0.03
"""Step from which the path of a robot is interrupted that is being placed (m)."""
PLACED_LIFE = 15
"""Number of odometry messages within which that counts."""
TRUTH_LIFE = 1.0
"""Difference of the stamps of odometry and ground truth up to which both are shown (s)."""
MIN_LENGTH = 1e-4
"""Smallest wheel radius and separation that count (m). Parameters of any node may be anything."""


class Trail:
    """A path. Points are only appended; when they are too many, `thinned` returns a new path."""

    def __init__(self, spacing: float = SPACING) -> None:
        """Start without points, with a distance between them (m)."""
        self.points: list[tuple[float, float] | None] = []
        """`(x, y)` of each point (m). None: the path is interrupted there."""
        self._spacing = spacing

    def extended(self, x: float, y: float, jump: float = JUMP) -> Trail:
        """Add a position (m), and return the path: this one, or a new one if this one was full.

        A step of more than `jump` (m) interrupts it.
        """
        last = self.points[-1] if self.points else None
        step = math.inf if last is None else math.hypot(x - last[0], y - last[1])
        if step < self._spacing:
            return self
        if last is not None and step > jump:
            self.points.append(None)
        self.points.append((round(x, 4), round(y, 4)))
        return self if len(self.points) < MAX_POINTS else self._thinned()

    def _thinned(self) -> Trail:
        if self.points.count(None) > MAX_POINTS // 4:
            # Pieces would not become fewer: the oldest are forgotten.
            trail = Trail(self._spacing)
            trail.points = self.points[MAX_POINTS // 2 :]
            return trail
        trail = Trail(2.0 * self._spacing)
        trail.points = [one for index, one in enumerate(self.points) if one is None or index % 2 == 0]
        return trail


def poses_of(goals: Goals | Path) -> Goals:
    """Return goals, of a path its poses."""
    return goals.poses if isinstance(goals, Path) else goals


class GoalEnd(NamedTuple):
    """The end of a goal or path. Poses are `[x, y, theta]`, shape (3,) (m, m, rad)."""

    robot: str
    """Namespace of the robot, `/` or `/NAME`."""
    state: GoalState
    """SUCCEEDED, CANCELED or ABORTED."""
    goal: NDArray[np.float64]
    """The goal that was driven to last."""
    pose: NDArray[np.float64] | None
    """Pose of the robot. None: there is no odometry."""
    distance: float
    """Distance from the driven point to the goal by the odometry (m). NaN without odometry."""
    true_distance: float
    """The same by the ground truth (m). NaN: it is not known."""
    path: bool
    """Whether it was a path, of which `goal` is the end."""


class GoalProgress:
    """The goals of a robot, and how far it is."""

    def __init__(self) -> None:
        """Start without goals."""
        self.index = 0
        """Index of the goal that is driven to."""
        self._points: Any = None
        self._drawn: Path | None = None
        self.path: PathProgress | None = None
        """The path that is driven along, and the progress. None: goals are driven to."""
        self._follower: GoalFollower[Goals | Path] = GoalFollower()
        self._shown: FollowedGoal[Goals | Path] | None = None
        self._kept: tuple[FollowedGoal[Goals | Path] | None, int, PathProgress | None] | None = None
        """What was shown before, with its progress."""

    @property
    def goals(self) -> Goals | None:
        """The goals that were sent last, or that the controller has reported since. None: unknown."""
        goal = None if self._shown is None else self._shown.goal
        return None if goal is None else poses_of(goal)

    @property
    def state(self) -> GoalState:
        """Their state. While they wait for an answer, that of the goals before, if they are active."""
        shown, driving = self._shown, self._follower.driving
        if shown is None:
            return GoalState.UNKNOWN
        return driving.state if driving is not None and shown.fate is Fate.WAITING else shown.state

    @property
    def active(self) -> bool:
        """Whether a controller drives the robot to a goal."""
        return self.state.active

    @property
    def current(self) -> NDArray[np.float64] | None:
        """The goal that is driven to, shape (3,). None: none or unknown."""
        return None if self.goals is None or not self.active else self.goals[self.index]

    @property
    def reached(self) -> NDArray[np.float64] | None:
        """The goal at which the robot arrived, shape (3,). None: none or unknown."""
        return None if self.goals is None or self.state is not GoalState.SUCCEEDED else self.goals[-1]

    @property
    def last(self) -> bool:
        """Whether the goal that is driven to is the last one."""
        return self.goals is not None and self.index == len(self.goals) - 1

    def remaining(self, *, fresh: bool = False) -> Goals:
        """Return the goals that are not reached yet; of fresh ones no status needs to be known."""
        waiting = fresh and self._shown is not None and self._shown.fate is Fate.WAITING
        if self.goals is None or not (self.active or waiting):
            return np.empty((0, 3))
        return self.goals[self.index :]

    def sent(self, goals: Goals | Path, stamp: Stamp) -> None:
        """Take goals or a path that somebody has sent, with their stamp."""
        shown = self._shown
        if shown is not None and shown.goal is not None and shown.stamp == stamp != UNSTAMPED:
            # Those that this program has sent come back by their topic.
            return
        if not len(poses_of(goals)):
            return
        followed = self._follower.sent(goals, stamp)
        if followed is shown:
            # Its status came first.
            self._use(goals)
        self._show(followed)

    def reported(self, status: int, stamp: Stamp) -> FollowedGoal[Goals | Path] | None:
        """Take a status of a controller. Return the goals of which something else became, or None."""
        changed = self._follower.reported(status, stamp)
        driving = self._follower.driving
        if driving is not None and (driving.stamp == stamp or changed is self._shown):
            # The goals after them were refused, or they were sent before this program listened.
            self._show(driving)
        elif self._shown is None:
            self._shown = changed
        return changed

    def replay(
        self, goals: Goals | Path | None, index: int, state: GoalState = GoalState.EXECUTING
    ) -> None:
        """Show recorded goals or a recorded path, and their state."""
        self._shown, self.index = FollowedGoal(goals, UNSTAMPED, state), index
        self._use(goals)

    def moved(self, pose: NDArray[np.float64], arrival: Arrival, *following: float) -> None:
        """Take a pose of the robot, `[x, y, theta]`: a waypoint may be reached.

        `following` are further arguments of `PathProgress.moved`.
        """
        if self.goals is None or not self.active:
            return
        if self.path is not None:
            if self._shown is not None and self._shown.fate is Fate.WAITING:
                # The controller drives to something else yet.
                return
            self.path.moved(pose, *following)
            passed = self.path.path.arc_lengths.searchsorted(self.path.s, 'right')
            self.index = min(int(passed), len(self.goals) - 1)
            return
        x, y, theta = pose.tolist()
        while self.index + 1 < len(self.goals):
            if not arrival.reached(x, y, theta, *self.goals[self.index, :2].tolist()):
                return
            self.index += 1

    def shown(self) -> dict[str, Any]:
        """Return what the page shows."""
        common = {'state': self.state.name.lower(), 'active': self.active}
        if self.path is not None:
            # All poses would be too many, many times a second.
            path, reference = self.path.path, None
            if self.active and not math.isnan(self.path.elapsed):
                reference = rounded(path.at_time(self.path.elapsed)[:3])
            shown = {'goals': rounded(path.poses[-1:]), 'index': 0, 'path': self._points}
            return {**common, **shown, 'reference': reference}
        return {**common, 'goals': rounded(self.goals), 'index': self.index}

    def _show(self, followed: FollowedGoal[Goals | Path]) -> None:
        before, goals = self._shown, followed.goal
        if followed is before:
            return
        was_driven = self.active
        kept, self._kept = self._kept, (before, self.index, self.path)
        self._shown = followed
        if kept is not None and kept[0] is followed:
            # What came after it was refused.
            _, self.index, path = kept
            self._use(goals, path)
        elif was_driven and isinstance(goals, Path) and self._is_same(goals):
            # A planner repeats its path. On the same one the controller goes on where it is.
            self._use(goals, self.path)
        else:
            self.index = 0
            self._use(goals)

    def _is_same(self, path: Path) -> bool:
        """Return whether a path is the one that is driven along."""
        if self.path is None or not np.array_equal(path.poses, self.path.path.poses):
            return False
        one, two = path.times, self.path.path.times
        return one is two if one is None or two is None else np.array_equal(one, two)

    def _use(self, goals: Goals | Path | None, progress: PathProgress | None = None) -> None:
        """Take what is driven to, and the progress along a path; None: it begins."""
        if not isinstance(goals, Path):
            self.path = None
        elif progress is not None:
            self.path = progress
        elif self.path is None or self.path.path is not goals:
            self.path = PathProgress(goals)
        if self.path is not None and self.path.path is not self._drawn:
            self._drawn = self.path.path
            s = np.linspace(0.0, self._drawn.length, MAX_PLANNED)
            self._points = rounded(self._drawn.poses_at(s)[:, :2])


def _number(values: Values, name: str, default: float) -> float:
    value = number(values.get(name))
    return value if math.isfinite(value) else default


def _longest(elapsed: float, *twists: tuple[float, float]) -> float:
    """Return how long a motion is at most (m): three times what speed and time (s) say."""
    return 3.0 * max(abs(v) for v, _ in twists) * abs(elapsed)


class RobotState:
    """State of one robot. Times are seconds, as the messages are stamped."""

    def __init__(self, name: str) -> None:
        """Start without odometry."""
        self.name = name
        self.pose: NDArray[np.float64] | None = None
        """`[x, y, theta]`, shape (3,) (m, m, rad). None: no odometry was received."""
        self.time = 0.0
        """Stamp of the odometry (s)."""
        self.twist = (0.0, 0.0)
        """`(v, omega)` of the odometry (m/s, rad/s)."""
        self.covariance: NDArray[np.float64] = np.zeros((3, 3))
        """Covariance of the pose."""
        self.wheels: tuple[float, float] | None = None
        """Speeds of the right and the left wheel (rad/s). None: unknown."""
        self.command: tuple[float, float] | None = None
        """Latest cmd_vel. None: none was received lately."""
        self.goal = GoalProgress()
        self.trail = Trail()
        self.truth: NDArray[np.float64] | None = None
        """Pose by ground_truth. None: none was received lately."""
        self.true_trail = Trail()
        self._true_time = 0.0
        self._placed = 0
        self.robot_values: Values = {}
        """Parameters of the node that publishes odom."""
        self.controller_values: Values = {}
        """Parameters of the node that publishes goal_status."""
        self.controlled = True
        """Whether a node publishes goal_status."""

    @property
    def geometry(self) -> tuple[float, float]:
        """Wheel radius, and the separation that the odometry assumes (m)."""
        values = self.robot_values
        r = _number(values, 'wheel_radius', ROBOT_DEFAULTS.wheel_radius)
        L = _number(values, 'wheel_separation', ROBOT_DEFAULTS.wheel_separation)
        L *= _number(values, 'wheel_separation_multiplier', 1.0)
        if min(r, L) < MIN_LENGTH:
            return ROBOT_DEFAULTS.wheel_radius, ROBOT_DEFAULTS.wheel_separation
        return r, L

    @property
    def radius_multipliers(self) -> tuple[float, float]:
        """Radii of the right and the left wheel, relative to that of `geometry`."""
        right, left = (
            _number(self.robot_values, f'{side}_wheel_radius_multiplier', 1.0)
            for side in ('right', 'left')
        )
        return (right, left) if min(right, left) > MIN_LENGTH else (1.0, 1.0)

    @property
    def wheel_names(self) -> tuple[str, str]:
        """Names of the left and the right joint."""
        usual = ROBOT_DEFAULTS.wheel_names
        left = self.robot_values.get('left_wheel_name', usual[0])
        right = self.robot_values.get('right_wheel_name', usual[1])
        return (left, right) if isinstance(left, str) and isinstance(right, str) else usual

    @property
    def along_path(self) -> bool:
        """Whether the law of paths drives: along a path, or through waypoints without a stop."""
        goals = self.goal.goals
        passing = self.controller_values.get('pass_waypoints') is True
        return self.goal.path is not None or (passing and goals is not None and len(goals) > 1)

    @property
    def arrival(self) -> Arrival:
        """Arrival criterion of the controller."""
        values = self.controller_values
        tolerance = _number(values, 'xy_goal_tolerance', CONTROLLER_DEFAULTS.xy_goal_tolerance)
        controller = CONTROLLERS.built_in.get(str(values.get('controller')))
        offset = 0.0
        if controller is not None and controller.offset:
            offset = _number(values, controller.offset, CONTROLLER_DEFAULTS.offset)
        heading = heading_counts(values)
        return Arrival(xy_tolerance=max(tolerance, 0.0), use_heading=heading, offset=offset)

    def goal_end(self, ended: FollowedGoal[Goals | Path]) -> GoalEnd:
        """Return the end of known goals that have just ended, and where the robot is."""
        assert ended.goal is not None
        goals = poses_of(ended.goal)
        index = self.goal.index if goals is self.goal.goals else 0
        path = isinstance(ended.goal, Path)
        goal = goals[-1 if path or ended.state is GoalState.SUCCEEDED else index]
        distance, true_distance = (
            math.nan if pose is None else quantities.errors(pose, goal, self.arrival.offset)[0]
            for pose in (self.pose, self.truth)
        )
        return GoalEnd(self.name, ended.state, goal, self.pose, distance, true_distance, path)

    def moved(
        self,
        time: float,
        pose: NDArray[np.float64],
        twist: tuple[float, float],
        covariance: NDArray[np.float64] | None,
        messages: int = 1,
    ) -> None:
        """Take an odometry, the last one of so many messages."""
        jump = JUMP
        if self._placed:
            self._placed, jump = self._placed - 1, PLACED_JUMP
        far = _longest(time - self.time, twist, self.twist)
        self.trail = self.trail.extended(float(pose[0]), float(pose[1]), max(jump, far))
        self.time, self.pose, self.twist = time, pose, twist
        if abs(time - self._true_time) > TRUTH_LIFE:
            self.truth = None
        if covariance is not None:
            self.covariance = covariance
        approach, longest = (
            _number(self.controller_values, name, getattr(CONTROLLER_DEFAULTS, name))
            for name in ('path_approach_distance', 'odom_timeout')
        )
        arrival = self.arrival
        if self.along_path:
            passed = _number(self.controller_values, 'waypoint_tolerance', arrival.xy_tolerance)
            arrival = replace(arrival, xy_tolerance=max(passed, 0.0))
        longest = messages * longest or math.inf
        self.goal.moved(pose, arrival, time, approach, longest)

    def truly_moved(self, time: float, pose: NDArray[np.float64], twist: tuple[float, float]) -> None:
        """Take a ground truth."""
        far = _longest(time - self._true_time, twist, self.twist)
        self.true_trail = self.true_trail.extended(float(pose[0]), float(pose[1]), max(JUMP, far))
        self._true_time, self.truth = time, pose

    def clear_path(self) -> None:
        """Forget the paths."""
        self.trail, self.true_trail = Trail(), Trail()

    def interrupt(self) -> None:
        """Expect a jump of the path: the robot is placed elsewhere."""
        self._placed = PLACED_LIFE

    def shown(self, *, age: float, by_hand: bool) -> dict[str, Any] | None:
        """Return the JSON object for the page. None: there was no odometry.

        Args:
            age: Time since the last odometry was received (s).
            by_hand: Whether a page drives it.
        """
        if self.pose is None:
            return None
        arrival, geometry = self.arrival, self.geometry
        path = self.goal.path if self.goal.active else None
        target = self.goal.current if path is None else None
        distance = bearing = heading = true_distance = None
        if target is not None:
            _, bearing = quantities.errors(self.pose, target, arrival.offset)
            if arrival.use_heading and self.goal.last:
                heading = wrap_angle(target[2] - self.pose[2])
        if path is not None:
            distance = path.remaining
        # A reached goal has a distance, but no direction.
        target = self.goal.reached if target is None else target
        if target is not None:
            distance, _ = quantities.errors(self.pose, target, arrival.offset)
            if self.truth is not None:
                true_distance, _ = quantities.errors(self.truth, target, arrival.offset)
        command = self.command or (0.0, 0.0)
        chain = quantities.chain(
            float(self.pose[2]), command, self.wheels, geometry, self.radius_multipliers
        )
        now = {
            'v': self.twist[0],
            'omega': self.twist[1],
            'command_v': None if self.command is None else command[0],
            'command_omega': None if self.command is None else command[1],
            'right': chain['wheels'][0],
            'left': chain['wheels'][1],
            'distance': distance,
            'bearing_error': bearing,
            'goal_heading_error': heading,
            'across': None if path is None else path.across,
            'along': None if path is None else path.along,
            'path_heading_error': None if path is None else path.heading,
            'late': None if path is None else path.late,
        }
        return {
            'name': self.name,
            'time': round(self.time, 4),
            'age': round(age, 2),
            'pose': rounded(self.pose),
            'region': quantities.region(self.covariance),
            'geometry': geometry,
            'goal': self.goal.shown(),
            'tolerance': arrival.xy_tolerance,
            'use_heading': arrival.use_heading,
            'offset': arrival.offset,
            'now': {name: rounded(value) for name, value in now.items()},
            'true_distance': rounded(true_distance),
            'truth': rounded(self.truth),
            'law': self._law(target if self.goal.active else None),
            'along_path': self.along_path,
            'controlled': self.controlled,
            'by_hand': by_hand,
            'commanded': self.command is not None,
            'chain': chain,
        }

    def _law(self, target: NDArray[np.float64] | None) -> dict[str, Any]:
        """Return the name of the law, its gains, and what it computes here without limits.

        That is not known of a path, for the look-ahead is the controller's, nor of a law of another
        package, which may be slow.
        """
        if self.goal.active and self.goal.goals is None:
            # They were sent before this program listened: goals or a path.
            return {'name': '', 'gains': {}, 'twist': None}
        name, law, gains, values = chosen_law(self.controller_values, path=self.along_path)
        twist = None
        if target is not None and self.pose is not None and isinstance(law, Controller):
            with suppress(LawError):
                twist = law.bind(SimpleNamespace(**values))(self.pose, target)
        labels = {gain.label or gain.name: rounded(values[gain.name]) for gain in gains}
        return {'name': name, 'gains': labels, 'twist': rounded(twist)}

    def settings(
        self, ranges: Mapping[str, Mapping[str, settings.Range]] | None = None, *, imported: bool
    ) -> list[dict[str, Any]]:
        """Return the settings for the page; the arguments are those of `settings.shown`."""
        values = {'controller': self.controller_values, 'robot': self.robot_values}
        return settings.shown(values, ranges or {}, path=self.along_path, imported=imported)
