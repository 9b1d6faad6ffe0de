"""What is known of one robot, its path included, and the JSON object that the page receives of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.bags.run import number
from diffdrive_jacobian.bags.timeline import heading_counts
from diffdrive_jacobian.control import Arrival, LawError, Path
from diffdrive_jacobian.control.controllers import BUILT_IN
from diffdrive_jacobian.kinematics.se2 import wrap_angle
from diffdrive_jacobian.live import quantities
from diffdrive_jacobian.live.goal_progress import GoalEnd, GoalProgress, Goals, poses_of
from diffdrive_jacobian.live.quantities import rounded
from diffdrive_jacobian.messages.goal_status import FollowedGoal, GoalState
from diffdrive_jacobian.messages.topics import SENSORS
from diffdrive_jacobian.parameters.go_to_goal import GoToGoalParameters
from diffdrive_jacobian.parameters.virtual_robot import VirtualRobotParameters

MAX_POINTS = 6000
"""Largest number of points of a path."""
SPACING = 0.01
"""Distance between two points of a path (m). It doubles when the path is full, unless jumps fill it."""
JUMP = 0.3
"""A longer step is not a motion: the path is interrupted (m)."""


class Trail:
    """A path. Points are only appended; when they are too many, `thinned` returns a new path."""

    def __init__(self, spacing: float = SPACING) -> None:
        """Start without points, with a distance between them (m)."""
        self.points: list[tuple[float, float] | None] = []
        """`(x, y)` of each point (m). None: the path is interrupted there."""
        self._spacing = spacing

    def extended(self, x: float, y: float, jump: float = JUMP) -> Trail:
        """Add a position, and return the path: this one, or a new one if this one was full.

        Args:
            x: Position (m).
            y: Likewise.
            jump: Step from which the path is interrupted (m).
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
        trail.points = [
            point for index, point in enumerate(self.points) if point is None or index % 2 == 0
        ]
        return trail


ROBOT_DEFAULTS = VirtualRobotParameters()
CONTROLLER_DEFAULTS = GoToGoalParameters()
Values = Mapping[str, Any]
PLACED_JUMP = 0.03
"""Step from which the path of a robot is interrupted that is being placed (m)."""
PLACED_LIFE = 15
"""Number of odometry messages within which that counts."""
TRUTH_LIFE = 1.0
"""Difference of the stamps of odometry and ground truth up to which both are shown (s)."""
MIN_LENGTH = 1e-4
"""Smallest wheel radius and separation that count (m). Parameters of any node may be anything."""


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
        self.readings: dict[str, float] = {}
        """Latest values of sensors, by their names."""
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

    @property
    def geometry(self) -> tuple[float, float]:
        """Wheel radius and separation (m), of the virtual robot by default. The separation is that which
        the odometry assumes; the radius of each wheel has a multiplier in addition.
        """
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
        left, right = (
            self.robot_values.get(f'{side}_wheel_name', default)
            for side, default in zip(('left', 'right'), ROBOT_DEFAULTS.wheel_names, strict=True)
        )
        return (
            (left, right)
            if isinstance(left, str) and isinstance(right, str)
            else ROBOT_DEFAULTS.wheel_names
        )

    @property
    def arrival(self) -> Arrival:
        """Arrival criterion of the controller."""
        values = self.controller_values
        tolerance = _number(values, 'xy_goal_tolerance', CONTROLLER_DEFAULTS.xy_goal_tolerance)
        controller = BUILT_IN.get(str(values.get('controller')))
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
        goal = goals[-1 if ended.state is GoalState.SUCCEEDED else index]
        distance, true_distance = (
            math.nan if pose is None else quantities.errors(pose, goal, self.arrival.offset)[0]
            for pose in (self.pose, self.truth)
        )
        return GoalEnd(self.name, ended.state, goal, self.pose, distance, true_distance)

    def moved(
        self,
        time: float,
        pose: NDArray[np.float64],
        twist: tuple[float, float],
        covariance: NDArray[np.float64] | None,
    ) -> None:
        """Take an odometry."""
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
        self.goal.moved(pose, self.arrival)

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

    def shown(self, *, age: float, by_hand: bool, **more: Any) -> dict[str, Any] | None:
        """Return the JSON object for the page. None: there was no odometry.

        Args:
            age: Time since the last odometry was received (s).
            by_hand: Whether a page drives it.
            more: Further entries.
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
        return {
            'name': self.name,
            'time': round(self.time, 4),
            'age': round(age, 2),
            'pose': rounded(self.pose),
            'twist': rounded(self.twist),
            'region': quantities.region(self.covariance),
            'geometry': geometry,
            'goal': self.goal.shown(),
            'tolerance': arrival.xy_tolerance,
            'use_heading': arrival.use_heading,
            'offset': arrival.offset,
            'distance': rounded(distance),
            'true_distance': rounded(true_distance),
            'bearing_error': rounded(bearing),
            'goal_heading_error': rounded(heading),
            'across': rounded(None if path is None else path.across),
            'path_heading_error': rounded(None if path is None else path.heading),
            'truth': rounded(self.truth),
            'law': self._law(target if self.goal.active else None),
            'readings': [
                [name, rounded(self.readings.get(name)), unit]
                for topic in SENSORS
                for name, unit in topic.readings.items()
            ],
            'by_hand': by_hand,
            'commanded': self.command is not None,
            'chain': quantities.chain(
                float(self.pose[2]), command, self.wheels, geometry, self.radius_multipliers
            ),
            **more,
        }

    def _law(self, target: NDArray[np.float64] | None) -> dict[str, Any]:
        """Return the name of the law, its gains, and what it computes here without limits."""
        values = self.controller_values
        if self.goal.path is not None:
            name = str(values.get('path_controller', ''))[:64]
            # The twist is that of the look-ahead or the time of the node, which are not known here.
            return {'name': name, 'gains': {}, 'twist': None}
        name = str(values.get('controller', ''))[:64]
        # Only built-in ones: another one may be slow, and runs in the controller.
        controller = BUILT_IN.get(name)
        if controller is None:
            return {'name': name, 'gains': {}, 'twist': None}
        gains = {gain.name: _number(values, gain.name, math.nan) for gain in controller.gains}
        twist = None
        if target is not None and self.pose is not None:
            with suppress(LawError):
                twist = controller.bind(SimpleNamespace(**gains))(self.pose, target)
        labels = {gain.label or gain.name: rounded(gains[gain.name]) for gain in controller.gains}
        return {'name': name, 'gains': labels, 'twist': rounded(twist)}
