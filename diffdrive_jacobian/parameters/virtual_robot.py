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

"""The parameters of the node virtual_robot."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from diffdrive_jacobian.messages.conversion import MAX_POSITION
from diffdrive_jacobian.numerics.checks import between
from diffdrive_jacobian.parameters.common import (
    WheelParameters,
    check_wheel_lag,
    command_delay_field,
    differ,
    timeout_field,
    wheel_lag_field,
)
from diffdrive_jacobian.parameters.declaration import parameter
from diffdrive_jacobian.simulation.actuators import Actuators
from diffdrive_jacobian.simulation.robot import RobotModel
from diffdrive_jacobian.simulation.slip import MAX_SEED, Drift
from diffdrive_jacobian.time_units import nanoseconds

MULTIPLIERS = tuple(
    f'{which}{what}_multiplier'
    for which in ('', 'true_')
    for what in ('left_wheel_radius', 'right_wheel_radius', 'wheel_separation')
)
"""The multipliers of the dimensions that the odometry assumes, and those of the true ones."""


def _true_multiplier(what: str) -> Any:
    return parameter(
        1.0,
        f'True {what}, relative to the nominal one [-]. Read-only.',
        between(0.1, 10.0),
        read_only=True,
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class VirtualRobotParameters(WheelParameters):
    """Parameters of the node virtual_robot."""

    publish_rate: float = parameter(
        50.0, 'Publishing rate of odom and joint_states [Hz].', between(0.1, 1000.0)
    )
    odom_frame_id: str = parameter('odom', 'Name of the frame of the odometry.')
    base_frame_id: str = parameter('base_link', 'Name of the frame of the robot, at the axle centre.')
    cmd_vel_timeout: float = timeout_field(
        'Time without a command after which the robot stops [s]; 0: never.'
    )
    wheel_lag: float = wheel_lag_field()
    command_delay: float = command_delay_field()
    x: float = parameter(
        0.0, 'Initial position x, also after a reset [m].', between(-MAX_POSITION, MAX_POSITION)
    )
    y: float = parameter(
        0.0, 'Initial position y, also after a reset [m].', between(-MAX_POSITION, MAX_POSITION)
    )
    theta: float = parameter(
        0.0, 'Initial heading, also after a reset [rad].', between(-math.tau, math.tau)
    )
    wheel_travel_variance: float = parameter(
        1e-5,
        'Variance of the distance travelled by a wheel, per distance [m^2/m].',
        between(0.0, 1.0),
    )
    command_interface: str = parameter(
        'twist',
        'Subscribe to cmd_vel (twist) or to joint_command (wheels). Read-only.',
        choices=('twist', 'wheels'),
        read_only=True,
    )
    enable_odom_tf: bool = parameter(
        True,
        'Publish the transform from odom_frame_id to base_frame_id, if tf2_ros is installed. Read-only.',
        read_only=True,
    )
    simulate_slip: bool = parameter(
        False,
        'Let the wheels slip as wheel_travel_variance says, and publish ground_truth. Read-only.',
        read_only=True,
    )
    slip_seed: int = parameter(
        0, 'Seed of the random slip. Read-only.', between(0, MAX_SEED), read_only=True
    )
    true_left_wheel_radius_multiplier: float = _true_multiplier('radius of the left wheel')
    true_right_wheel_radius_multiplier: float = _true_multiplier('radius of the right wheel')
    true_wheel_separation_multiplier: float = _true_multiplier('wheel separation')
    ground_truth_frame_id: str = parameter('map', 'Name of the frame of ground_truth.')

    def check(self) -> None:
        """Raise ParameterError if the names of the wheels or of the frames are equal."""
        WheelParameters.check(self)
        check_wheel_lag(self.wheel_lag)
        differ('odom_frame_id', self.odom_frame_id, 'base_frame_id', self.base_frame_id)
        if self.drift() is not None:
            truth = 'ground_truth_frame_id', self.ground_truth_frame_id
            differ(*truth, 'odom_frame_id', self.odom_frame_id)
            differ(*truth, 'base_frame_id', self.base_frame_id)

    def model(self) -> RobotModel:
        """Return the model of the robot with these parameters."""
        return replace(
            WheelParameters.model(self),
            command_timeout=nanoseconds(self.cmd_vel_timeout),
            wheel_travel_variance=self.wheel_travel_variance,
            drift=self.drift(),
            actuators=self.actuators(),
        )

    def actuators(self) -> Actuators:
        """Return how commands are followed."""
        return self.actuators_with(self.wheel_lag, self.command_delay)

    def drift(self) -> Drift | None:
        """Return in what the true motion differs from the odometry; None: in nothing."""
        if not self.simulate_slip and all(getattr(self, name) == 1.0 for name in MULTIPLIERS):
            return None
        return Drift(
            seed=self.slip_seed if self.simulate_slip else None,
            right_wheel_radius_multiplier=self.true_right_wheel_radius_multiplier
            / self.right_wheel_radius_multiplier,
            left_wheel_radius_multiplier=self.true_left_wheel_radius_multiplier
            / self.left_wheel_radius_multiplier,
            wheel_separation_multiplier=self.true_wheel_separation_multiplier
            / self.wheel_separation_multiplier,
        )
