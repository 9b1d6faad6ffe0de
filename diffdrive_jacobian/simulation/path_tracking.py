"""One robot that follows a path in simulation: the loop of go_to_goal and virtual_robot, without ROS.

The robot is a `Robot` with all that its model has. The last two centimetres, which the robot drives as
to a goal, are left out.

Source: doc/mathematics.md, "Control laws".
"""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.control.controller import PathController
from diffdrive_jacobian.control.controllers import find_controller
from diffdrive_jacobian.control.path import Path
from diffdrive_jacobian.control.path_following import PathFollower, PathSettings
from diffdrive_jacobian.numerics.checks import number, positive
from diffdrive_jacobian.numerics.fields import instance, short
from diffdrive_jacobian.simulation.robot import Robot, RobotModel
from diffdrive_jacobian.time_units import NANOSECONDS

Floats = NDArray[np.float64]


class PathTracking(NamedTuple):
    """All k samples of a robot that follows a path.

    Attributes:
        times: Shape (k,) (s).
        poses: True poses, shape (k, 3).
        references: Where the robot should have been, `path.Reference`s, shape (k, 8).
        twists: Commands, shape (k, 2) (m/s, rad/s).
        errors: Along, across and of the heading, shape (k, 3), as `Path.errors` has them.
        finished: Whether the end of the path was reached in time.
    """

    times: Floats
    poses: Floats
    references: Floats
    twists: Floats
    errors: Floats
    finished: bool


def follow_path(
    controller: PathController,
    path: Path,
    *,
    gains: Mapping[str, float] | None = None,
    start: ArrayLike | None = None,
    model: RobotModel | None = None,
    settings: PathSettings | None = None,
    localised: bool = False,
    rate: float = 50.0,
    timeout: float = 600.0,
) -> PathTracking:
    """Let a robot follow a path by a control law.

    Args:
        controller: The law of the path.
        path: The path or trajectory.
        gains: Values of gains of the law, by name; None: their defaults.
        start: Pose of the robot, shape (3,); None: on the start of the path, along it.
        model: The robot; None: an ideal one.
        settings: Speeds and distances; None: their defaults, with the look-ahead distance of the law.
        localised: Whether the law is given the true pose, as of a localisation, rather than that of the
            odometry.
        rate: Control rate (Hz).
        timeout: Longest time that is simulated (s).

    Raises:
        ValueError: An argument is invalid, or the law fails.
    """
    instance('controller', controller, PathController)
    instance('path', path, Path)
    values = _values(controller, gains or {})
    if settings is None:
        settings = PathSettings(lookahead=controller.lookahead_distance(values))
    period = round(NANOSECONDS / number('rate', rate, positive))
    law, goals = controller.bind(values), find_controller('go_to_goal')
    law_of_goals = goals.bind(goals.defaults)
    robot = Robot(
        model=RobotModel() if model is None else model,
        stamp=0,
        pose=path.poses_at(0.0) if start is None else start,
    )
    follower = PathFollower(path)
    samples = []
    for now in range(0, round(number('timeout', timeout, positive) * NANOSECONDS), period):
        law.now = now
        pose = robot.true_pose_tuple if localised else robot.pose_tuple
        follower, command = follower.follow(
            pose, (period if now else 0) / NANOSECONDS, law, law_of_goals, settings
        )
        if command is None:
            break
        samples.append((now / NANOSECONDS, robot.true_pose_tuple, follower.reference(settings), command))
        robot = robot.commanded(command, now).at(now + period)
    times, poses, references, twists = (np.array(one) for one in zip(*samples, strict=True))
    errors = np.stack(path.errors(poses, references), axis=-1)
    return PathTracking(times, poses, references, twists, errors, command is None)


def _values(controller: PathController, given: Mapping[str, float]) -> SimpleNamespace:
    """Return the gains of a law, with those that are given."""
    if unknown := sorted(set(given) - set(controller.gain_names)):
        names = ', '.join(controller.gain_names)
        raise ValueError(f'gains must be among {names}, got {short(unknown[0])}')
    for gain in controller.gains:
        gain.check(given.get(gain.name, gain.default))
    return SimpleNamespace(**{**vars(controller.defaults), **given})
