"""Which rule the covariances of a recorded run follow.

A virtual robot publishes the exact second moment of its error. Earlier versions published the covariance
of first order, and their bags are still verified. No bag says which of them it has: the recorded numbers
decide. The first rule that they follow from the start of the run to its end is the rule of the bag.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.bags.ground_truth import NODE, recorded_drift
from diffdrive_jacobian.bags.run import Run
from diffdrive_jacobian.kinematics.saturation import VelocityLimits
from diffdrive_jacobian.parameters.declaration import ParameterError, from_ros
from diffdrive_jacobian.parameters.virtual_robot import MULTIPLIERS, VirtualRobotParameters
from diffdrive_jacobian.simulation.odometry_noise import covariance_of_pose, propagate_covariance
from diffdrive_jacobian.simulation.robot import Robot, RobotModel
from diffdrive_jacobian.time_units import NANOSECONDS

EXACT_MOMENTS, FIRST_ORDER, NEITHER = 'exact moments', 'first order', 'neither'
"""Names of the rules."""
TOLERANCE = 1e-9
"""Largest difference of a covariance, relative to the standard deviations."""
_PARAMETERS = ('wheel_separation', 'wheel_travel_variance')


def recorded_model(run: Run) -> RobotModel | None:
    """Return the model of the robot; None: it was not recorded, or it changed."""
    recorded = run.of_node(NODE)
    # A robot that starts later than the recorder reports its first values as changes.
    changed = {
        name
        for _, node, values in run.parameter_events
        if node.split('/')[-1] == NODE
        for name, value in values.items()
        if value != recorded.get(name)
    }
    separation, variance = (run.number_of_node(NODE, name, math.nan) for name in _PARAMETERS)
    # Earlier versions had no multipliers.
    separation *= run.number_of_node(NODE, 'wheel_separation_multiplier', 1.0)
    if changed & {*_PARAMETERS, *MULTIPLIERS} or not (separation > 0.0 and variance >= 0.0):
        return None
    drift = recorded_drift(run)
    return RobotModel(wheel_separation=separation, wheel_travel_variance=variance, drift=drift)


def recorded_dynamics(run: Run) -> RobotModel:
    """Return a model that follows commands as the recorded robot did, without limits of the velocity.

    At once, if its parameters were not recorded.
    """
    try:
        recorded = from_ros(VirtualRobotParameters, run.of_node(NODE)).model()
    except ParameterError:
        return RobotModel()
    if not recorded.takes_time:
        return RobotModel()
    return replace(recorded, limits=VelocityLimits(), command_timeout=0)


def rule(
    events: Sequence[tuple[Robot, bool]],
    messages: Iterable[tuple[int, Robot]],
    recorded: NDArray[np.float64],
) -> tuple[str, float]:
    """Return which rule recorded covariances follow.

    Args:
        events: The robot after each event, and whether the event was a placement.
        messages: For each message the index of the last event, and the robot at the message.
        recorded: Entries xx, xy, xt, yy, yt, tt of each message, shape (n, 6).

    Returns:
        The name of the rule, and the largest difference from it, relative to the standard deviations.
        Of neither rule it is the difference from the exact moments.
    """
    messages = list(messages)
    exact = np.array([robot.moments[:6] for _, robot in messages]).reshape(-1, 6)
    difference = _difference(recorded, exact)
    if difference <= TOLERANCE:
        return EXACT_MOMENTS, difference
    covariances: list[NDArray[np.float64]] = []
    for index, (robot, is_placed) in enumerate(events):
        if is_placed or not index:
            covariances.append(robot.covariance)
        else:
            covariances.append(_first_order(events[index - 1][0], covariances[-1], robot.stamp))
    first = np.array(
        [
            _first_order(events[index][0], covariances[index], robot.stamp)[np.triu_indices(3)]
            for index, robot in messages
        ]
    )
    of_first_order = _difference(recorded, first)
    return (FIRST_ORDER, of_first_order) if of_first_order <= TOLERANCE else (NEITHER, difference)


def start_covariances(run: Run) -> NDArray[np.float64]:
    """Return the covariance in each `start_pose`, by rows, shape (n, 9); zero where it is invalid."""
    entries = run.start_covariances
    if len(entries) != len(run.start_pose):
        return np.zeros((len(run.start_pose), 9))
    matrices: NDArray[np.float64] = entries[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].copy()
    for row in matrices:
        try:
            covariance_of_pose('covariance', row.reshape(3, 3))
        except ValueError:
            row[:] = 0.0
    return matrices


def _first_order(robot: Robot, covariance: NDArray[np.float64], stamp: int) -> NDArray[np.float64]:
    model, duration = robot.model, (stamp - robot.stamp) / NANOSECONDS
    separation, variance = model.wheel_separation, model.wheel_travel_variance
    return propagate_covariance(
        covariance, robot.pose_tuple, robot.twist, duration, separation, variance
    )


def _difference(recorded: NDArray[np.float64], computed: NDArray[np.float64]) -> float:
    """Return the largest difference, relative to the standard deviations of position and heading."""
    position = np.sqrt(computed[:, 0] + computed[:, 3])
    heading = np.sqrt(computed[:, 5])
    scales = np.stack([position, position, position, position, position, heading], axis=-1)
    scales *= np.stack([position, position, heading, position, heading, heading], axis=-1)
    difference = np.abs(recorded - computed)
    with np.errstate(all='ignore'):
        relative = np.where(difference == 0.0, 0.0, difference / scales)
    return float(np.max(relative, initial=0.0)) if not np.isnan(relative).any() else math.inf
