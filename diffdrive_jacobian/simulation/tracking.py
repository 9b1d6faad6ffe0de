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

"""Simulation of one robot that follows a line or a path, without ROS.

`track_line`: the tip of an arm or a mobile manipulator along a straight line, also with its heading.
`follow_path`: a `Robot` with all that its model has along a path, by the loop of go_to_goal and
virtual_robot, without the last two centimetres, which the node drives as to a goal.

Source: document D, 4.1; documents A and C on damping and redundancy; doc/mathematics.md, "Control laws".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_jacobian.control.controller import PathController
from diffdrive_jacobian.control.controllers import find_controller, find_path_controller
from diffdrive_jacobian.control.path import Path
from diffdrive_jacobian.control.path_following import PathFollower, PathSettings
from diffdrive_jacobian.control.resolved_rate import StraightLine, resolved_rate
from diffdrive_jacobian.kinematics.inverse_kinematics import pose_difference
from diffdrive_jacobian.kinematics.inverse_velocity import damping as damping_factor
from diffdrive_jacobian.kinematics.inverse_velocity import manipulability
from diffdrive_jacobian.numerics.checks import (
    array,
    between,
    instance,
    leading,
    not_negative,
    number,
    positive,
    short,
)
from diffdrive_jacobian.numerics.formula import Array
from diffdrive_jacobian.simulation.robot import STANDSTILL, Robot, RobotModel
from diffdrive_jacobian.time_units import NANOSECONDS

MAX_STEPS = 1e8


class Manipulator(Protocol):
    """The methods of a robot that are needed: `PlanarArm` and `MobileManipulator` have them.

    A robot whose inputs are not the rates of its coordinates needs `configuration_jacobian(q)` besides,
    shape (..., n, inputs), for secondary tasks that are gradients over its configuration.
    """

    def forward_kinematics(self, q: ArrayLike) -> Array:
        """Return the tip's `[x, y, heading]`, shape (..., 3), of configurations, shape (..., n)."""

    def jacobian(self, q: ArrayLike, heading: bool = False) -> Array:
        """Return the Jacobian of the tip's position, shape (..., 2, inputs), or (..., 3, inputs)."""

    def integrate(self, q: ArrayLike, q_dot: ArrayLike, dt: ArrayLike) -> Array:
        """Return the configuration after a time at constant input, shape (..., n)."""


class Tracking(NamedTuple):
    """The motion along a line, at k + 1 samples.

    Attributes:
        times: Shape (k + 1,) (s).
        q: Configurations, shape (k + 1, ..., n).
        q_dot: Inputs from each sample to the next, shape (k, ..., inputs) (rad/s).
        error: Distance of the tip from its desired position, shape (k + 1, ...) (m). For lines with a
            heading the norm of `[x, y, heading]`, in which 1 rad counts as 1 m.
    """

    times: Array
    q: Array
    q_dot: Array
    error: Array


def track_line(
    robot: Manipulator,
    q0: ArrayLike,
    line: StraightLine,
    *,
    rate: float = 100.0,
    gain: float = 20.0,
    threshold: float | None = None,
    maximum_damping: float = 0.1,
    secondary: Callable[[Array], ArrayLike] | None = None,
    settling: float = 0.0,
    weights: ArrayLike | None = None,
    max_velocity: ArrayLike | None = None,
) -> Tracking:
    """Follow a straight line by resolved rate, damped where the Jacobian is nearly singular.

    The feedback adds no more than the speed of the line, so that `|q_dot| <= speed / lambda` with the
    damping lambda at that time, as long as there is no secondary task.

    Args:
        robot: The arm or the mobile manipulator.
        q0: Configurations at the start, shape (..., n).
        line: Desired path of the tip, a `control.StraightLine` of `[x, y]` or of `[x, y, heading]`;
            leading axes as those of q0. Headings are not wrapped: from 0 to 2 pi is a full turn. With
            them the speed of the line is the norm of `[x_dot, y_dot, heading_dot]` (m/s, rad/s).
        rate: Control rate (Hz). Inputs are constant between samples.
        gain: K of the feedback (1/s); below the rate.
        threshold: Manipulability below which there is damping; None: no damping, and near a singularity
            the joint velocities are not bounded.
        maximum_damping: lambda of a singular Jacobian.
        secondary: Secondary task (null-space velocity), a function of the configurations. Returns either
            inputs, shape (..., inputs), or where the robot has a different number of coordinates the
            gradient over the configuration of a function to increase, shape (..., n). The gradient is
            mapped to inputs by the robot's `configuration_jacobian` G: `W^-1 G^T gradient`. With damping
            it moves the tip by at most `lambda / 40 |q_dot_0|`, see `inverse_velocity.redundant`.
        settling: Time after the end of the line (s).
        weights: Weights of the inputs, positive, shape (..., inputs); None: all 1. An input with a
            larger weight is used less. The manipulability, its threshold and lambda are then those of
            `J W^-1/2`, and bounds hold for `W^1/2 q_dot`.
        max_velocity: Largest inputs, positive, shape (..., inputs), or one for all: all inputs are
            slowed down alike, and the tip falls behind; None: no limits.

    Returns:
        The motion. An error can remain because of damping, limits, or a line that leaves the workspace
        of the robot.

    Raises:
        ValueError: Rate, threshold or speed is not positive, another number negative, the gain not below
            the rate, a shape is wrong, or the robot lacks a method.

    On a mobile base a tip that is far from the axle needs a higher rate, because the wheels swing it.
    """
    for method in ('forward_kinematics', 'jacobian', 'integrate'):
        if not callable(getattr(robot, method, None)):
            raise ValueError(f'robot must have the method {method}, got {short(robot, repr)}')
    if secondary is not None and not callable(secondary):
        raise ValueError(
            f'secondary must be a function of the configuration, got {short(secondary, repr)}'
        )
    if not isinstance(line, StraightLine):
        raise ValueError(f'line must be a control.StraightLine, got {short(line, repr)}')
    rate = number('rate', rate, positive)
    settling = number('settling', settling, not_negative)
    gain = number('gain', gain, not_negative)
    if gain >= rate:
        raise ValueError(f'gain must be at least 0 and below the rate {rate:g}, got {gain:g}')
    samples = rate * (float(np.max(line.duration, initial=0.0)) + settling)
    if not samples < MAX_STEPS:
        raise ValueError(f'rate must give fewer than {MAX_STEPS:g} samples of the line, got {rate:g}')
    steps = math.ceil(samples - 1e-9)
    most = number('maximum_damping', maximum_damping, not_negative)
    if threshold is not None:
        threshold = number('threshold', threshold, positive)
    q = array('q0', q0, 'n')
    size = line.start.shape[-1]
    if size not in (2, 3):
        raise ValueError(f'line must have 2 or 3 coordinates, got {size}')
    leading(q0=q.shape[:-1], line=line.duration.shape)
    J_of = robot.jacobian if size == 2 else partial(robot.jacobian, heading=True)
    inputs = J_of(q).shape[-1]
    if weights is not None:
        weights = array('weights', weights, inputs)
        positive('weights', weights)
        leading(q0=q.shape[:-1], weights=weights.shape[:-1])
    W_half = np.ones(inputs) if weights is None else np.sqrt(weights)
    track, velocities, errors = [q], [], []
    for step in range(steps):
        x, x_desired = robot.forward_kinematics(q)[..., :size], line.position(step / rate)
        # The velocity that moves the target to its next sample, also when the line ends before it.
        x_dot_desired = (line.position((step + 1) / rate) - x_desired) * rate
        J, error = J_of(q), _error(x_desired, x)
        factor: ArrayLike = 0.0
        if threshold is not None:
            factor = damping_factor(manipulability(J / W_half[..., np.newaxis, :]), threshold, most)
        q_dot = resolved_rate(
            # The error as if x were 0: headings are not simply subtracted.
            *(J, np.zeros_like(error), error, x_dot_desired, gain, factor),
            None if secondary is None else _inputs(robot, secondary, q, inputs, W_half),
            max_correction=line.speed,
            weights=weights,
            max_velocity=max_velocity,
        )
        q = robot.integrate(q, q_dot, 1.0 / rate)
        errors.append(np.linalg.norm(error, axis=-1))
        velocities.append(q_dot)
        track.append(q)
    x, x_desired = robot.forward_kinematics(q)[..., :size], line.position(steps / rate)
    errors.append(np.linalg.norm(_error(x_desired, x), axis=-1))
    shape = np.broadcast_shapes(track[0].shape, track[-1].shape)
    track[0] = np.broadcast_to(track[0], shape)
    return Tracking(
        np.arange(steps + 1) / rate,
        np.array(track),
        np.array(velocities) if steps else np.empty((0, *shape[:-1], inputs)),
        np.array([np.broadcast_to(error, shape[:-1]) for error in errors]),
    )


def _error(x_desired: Array, x: Array) -> Array:
    """Return what is missing, the heading wrapped if there is one."""
    return x_desired - x if x.shape[-1] == 2 else pose_difference(x_desired, x)


def _inputs(
    robot: Manipulator, secondary: Callable[[Array], ArrayLike], q: Array, inputs: int, W_half: Array
) -> Array:
    """Compute the secondary task's inputs, shape (..., inputs)."""
    task = array('result of secondary', secondary(q), 'n')
    n = q.shape[-1]
    if task.shape[-1] == inputs:
        return task
    to_configuration = getattr(robot, 'configuration_jacobian', None)
    allowed = f'(..., {inputs})' if to_configuration is None else f'(..., {inputs}) or (..., {n})'
    if to_configuration is None or task.shape[-1] != n:
        raise ValueError(f'result of secondary must have shape {allowed}, got {task.shape}')
    uphill = task[..., np.newaxis, :] @ array('configuration_jacobian', to_configuration(q), n, inputs)
    # The smallest inputs in the weighted norm for this increase; also after the projection it increases.
    return np.asarray(uphill[..., 0, :] / W_half**2)


class PathTracking(NamedTuple):
    """All k samples of a robot that follows a path.

    Attributes:
        times: Shape (k,) (s).
        poses: True poses, shape (k, 3).
        references: Where the robot should have been, `path.Reference`s, shape (k, 8).
        twists: Commands, shape (k, 2) (m/s, rad/s).
        errors: Along, across and of the heading, shape (k, 3), as `Path.errors` has them, from the
            reference, which waits for a robot that is too far from it or turned away.
        late: How late the reference is, shape (k,) (s): the time less that of the trajectory there; NaN
            for a path without times.
        finished: Whether the robot came within `end_tolerance` of the end before the timeout.
    """

    times: Array
    poses: Array
    references: Array
    twists: Array
    errors: Array
    late: Array
    finished: bool


def follow_path(
    controller: PathController | str,
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
        controller: The law of the path, or its name, one of `control.path_controller_names()`.
        path: The path or trajectory.
        gains: Values of gains of the law, by name; None: their defaults.
        start: Pose of the robot, shape (3,); None: on the start of the path, along it.
        model: The robot; None: an ideal one.
        settings: Speeds and distances; None: their defaults.
        localised: Whether the law is given the true pose, as of a localisation, rather than that of the
            odometry.
        rate: Control rate (Hz).
        timeout: Longest time that is simulated (s).

    Raises:
        ValueError: An argument is invalid, or the law fails.
    """
    if isinstance(controller, str):
        controller = find_path_controller(controller)
    instance('controller', controller, PathController)
    instance('path', path, Path)
    gains = gains or {}
    if unknown := sorted(set(gains) - set(controller.gain_names)):
        names = ', '.join(controller.gain_names)
        raise ValueError(f'gains must be among {names}, got {short(unknown[0])}')
    values = SimpleNamespace(**{**vars(controller.defaults), **gains})
    for gain in controller.gains:
        gain.check(getattr(values, gain.name))
    settings = instance('settings', PathSettings() if settings is None else settings, PathSettings)
    period = round(NANOSECONDS / between(0.0, NANOSECONDS, above=0.0, unit='Hz')('rate', rate))
    law, goals = controller.bind(values), find_controller('go_to_goal')
    law_of_goals = goals.bind(goals.defaults)
    robot = Robot(
        model=RobotModel() if model is None else model,
        stamp=0,
        pose=path.poses_at(0.0) if start is None else start,
    )
    follower = PathFollower(path)
    end = path.poses_at(path.length)
    samples: list[tuple[Any, ...]] = []
    finished = False
    duration = max(1, round(number('timeout', timeout, positive) * NANOSECONDS))
    for now in range(0, duration, period):
        law.now = now
        pose = robot.true_pose_tuple if localised else robot.pose_tuple
        follower, command = follower.follow(
            pose, (period if now else 0) / NANOSECONDS, law, law_of_goals, settings
        )
        if command is None:
            # The time of a trajectory is over. Then the end is driven to as a goal.
            finished = math.hypot(*(end[:2] - pose[:2])) <= settings.end_tolerance
            if finished and samples:
                break
            command = STANDSTILL if finished else law_of_goals(pose, end)
        time = now / NANOSECONDS
        planned = math.nan if path.times is None else min(follower.elapsed, path.duration)
        reference = follower.reference(settings)
        samples.append((time, robot.true_pose_tuple, reference, command, time - planned))
        robot = robot.commanded(command, now).at(now + period)
    times, poses, references, twists, late = (np.array(one) for one in zip(*samples, strict=True))
    errors = np.stack(path.errors(poses, references), axis=-1)
    return PathTracking(times, poses, references, twists, errors, late, finished)
