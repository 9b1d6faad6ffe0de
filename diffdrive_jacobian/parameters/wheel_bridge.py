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

"""The parameters of the node wheel_bridge."""

from __future__ import annotations

from dataclasses import dataclass

from diffdrive_jacobian.numerics.checks import between
from diffdrive_jacobian.parameters.common import WheelParameters, timeout_field
from diffdrive_jacobian.parameters.declaration import parameter


@dataclass(frozen=True, kw_only=True, slots=True)
class WheelBridgeParameters(WheelParameters):
    """Parameters of the node wheel_bridge."""

    cmd_vel_timeout: float = timeout_field(
        'Time without a command after which the wheels are stopped [s]; 0: never.'
    )
    publish_rate: float = parameter(
        50.0,
        'Publishing rate of joint_command while the wheels accelerate within limits [Hz].',
        between(0.1, 1000.0),
    )
    joint_command_type: str = parameter(
        'JointState',
        'Type of joint_command: JointState, or Float64MultiArray with [left, right]. Read-only.',
        choices=('JointState', 'Float64MultiArray'),
        read_only=True,
    )
