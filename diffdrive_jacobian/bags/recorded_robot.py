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

"""The robot of a recorded run: its model, how that changed, and where its odometry started."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.bags.run import Run
from diffdrive_jacobian.kinematics.saturation import VelocityLimits
from diffdrive_jacobian.messages.codecs import FaultEvent
from diffdrive_jacobian.messages.names import base_name
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.parameters.virtual_robot import MULTIPLIERS, VirtualRobotParameters
from diffdrive_jacobian.simulation.actuators import Actuators
from diffdrive_jacobian.simulation.odometry_noise import covariance_of_pose
from diffdrive_jacobian.simulation.robot import RobotModel
from diffdrive_jacobian.time_units import NANOSECONDS

ROBOT = 'virtual_robot'
"""Base name of the node."""
MARGIN = 1 * NANOSECONDS
"""Messages that belong together are recorded within this time of one another (ns)."""
_NOISE_PARAMETERS = ('wheel_separation', 'wheel_travel_variance')
_MOTOR_FAULTS: dict[str, Callable[[Actuators, Mapping[str, Any]], Actuators]] = {
    'ActuatorLag': lambda actuators, fault: actuators.lagging(fault['seconds']),
    'DeadWheel': lambda actuators, fault: actuators.weakened(fault['wheel'], 0.0),
    'SaturatedWheel': lambda actuators, fault: actuators.weakened(fault['wheel'], fault['max_velocity']),
}
"""What the faults that change how a robot follows commands do to its actuators."""


def recorded_model(run: Run) -> RobotModel | None:
    """Return the model of the robot; None: it was not recorded, or it changed."""
    recorded = run.of_node(ROBOT)
    # A robot that starts later than the recorder reports its first values as changes.
    changed = {
        name
        for _, change in run.parameter_events
        if base_name(change.node) == ROBOT
        for name, value in change.values.items()
        if value != recorded.get(name)
    }
    separation, variance = (run.number_of_node(ROBOT, name, math.nan) for name in _NOISE_PARAMETERS)
    separation *= run.number_of_node(ROBOT, 'wheel_separation_multiplier', 1.0)
    if changed & {*_NOISE_PARAMETERS, *MULTIPLIERS} or not (separation > 0.0 and variance >= 0.0):
        return None
    try:
        drift = VirtualRobotParameters().changed(recorded).drift()
    except ParameterError:
        drift = None
    return RobotModel(wheel_separation=separation, wheel_travel_variance=variance, drift=drift)


def recorded_dynamics(run: Run) -> list[RobotModel]:
    """Return models that follow commands as the recorded robot did, without limits of the velocity.

    Returns:
        The model at the start, and that from each message of `cmd_vel_out` on. []: the robot follows
        commands at once, or its parameters were not recorded.
    """
    changes = _changes_by_command(run)
    parameters, faults = dict(run.of_node(ROBOT)), list[FaultEvent]()
    model = _dynamics(parameters, faults)
    found = [model]
    for number in range(len(run.cmd_vel_out)):
        for change in changes.get(number, ()):
            if isinstance(change, dict):
                parameters.update(change)
            elif change.what == 'begins':
                faults.append(change)
            elif change.what.startswith('ends'):
                faults = [fault for fault in faults if fault.fault != change.fault]
        if number in changes:
            model = _dynamics(parameters, faults)
        found.append(model)
    return found if any(model.takes_time for model in found) else []


def _changes_by_command(run: Run) -> dict[int, list[dict[str, Any] | FaultEvent]]:
    """Return parameters and faults that changed, by the message of `cmd_vel_out` from which they count.

    The robot publishes its command again when they change, each time in a message of its own: for
    parameters after it has announced them, for a fault after the world has announced that.
    """
    received, stamps = run.cmd_vel_out.received, run.cmd_vel_out.stamps
    changes: dict[int, list[dict[str, Any] | FaultEvent]] = defaultdict(list)

    def is_free(index: int) -> bool:
        return index not in changes

    def repeats(index: int) -> bool:
        twists = run.cmd_vel_out.values[max(index - 1, 0) : index + 1]
        return bool((twists == twists[0]).all())

    for recorded, change in run.parameter_events:
        if base_name(change.node) == ROBOT:
            first, last = np.searchsorted(received, [recorded - MARGIN, recorded + MARGIN + 1])
            later = [one for one in range(first, last) if stamps[one] >= change.stamp]
            # Of those at the earliest time, one that repeats the command before, or the last one: a
            # controller may have sent another command at that time. Each for one change.
            together = [one for one in later if stamps[one] == min(stamps[later])] or [int(last)]
            likely = [one for one in together if repeats(one)] or together[::-1]
            changes[next(filter(is_free, likely), together[-1])].append(change.values)
    for recorded, event in run.fault_events:
        if event.kind in _MOTOR_FAULTS and base_name(event.arguments.get('robot') or ROBOT) == ROBOT:
            index = int(np.searchsorted(received, recorded))
            # Where one fault ends and another begins, the robot is without both in between.
            while not is_free(index) and received[index + 1 : index + 2].tolist() == [recorded]:
                index += 1
            changes[index].append(event)
    return changes


def _dynamics(parameters: Mapping[str, Any], faults: Iterable[FaultEvent]) -> RobotModel:
    """Return a model from the parameters of a robot and the faults of its motors."""
    try:
        model = VirtualRobotParameters().changed(parameters).model()
        actuators = model.actuators
        for fault in faults:
            actuators = _MOTOR_FAULTS[fault.kind](actuators, fault.arguments)
    except (ParameterError, ValueError, LookupError):
        return RobotModel()
    return replace(model, limits=VelocityLimits(), command_timeout=0, actuators=actuators)


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
