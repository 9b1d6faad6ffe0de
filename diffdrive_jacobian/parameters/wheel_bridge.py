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
