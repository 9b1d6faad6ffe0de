"""The parameters of the node wheel_bridge."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from diffdrive_jacobian.parameters._fields import (
    STAMPED,
    differ,
    max_wheel_velocity_field,
    multiplier_field,
    timeout_field,
    wheel_radius_field,
    wheel_separation_field,
)
from diffdrive_jacobian.parameters.declaration import parameter
from diffdrive_jacobian.parameters.limits import AccelerationParameters, number_or
from diffdrive_jacobian.simulation.robot_model import RobotModel


@dataclass(frozen=True, kw_only=True, slots=True)
class WheelBridgeParameters(AccelerationParameters):
    """Parameters of the node wheel_bridge."""

    wheel_radius: float = wheel_radius_field()
    wheel_separation: float = wheel_separation_field()
    wheel_separation_multiplier: float = multiplier_field('wheel separation')
    left_wheel_radius_multiplier: float = multiplier_field('radius of the left wheel')
    right_wheel_radius_multiplier: float = multiplier_field('radius of the right wheel')
    max_wheel_velocity: float = max_wheel_velocity_field()
    cmd_vel_timeout: float = timeout_field(
        0.5, 'Time without a command after which the wheels are stopped [s]; 0: never.'
    )
    publish_rate: float = parameter(
        50.0,
        'Publishing rate of joint_command while the wheels accelerate within limits [Hz].',
        bounds=(0.1, 1000.0),
    )
    left_wheel_name: str = parameter('left_wheel_joint', 'Name of the joint of the left wheel.')
    right_wheel_name: str = parameter('right_wheel_joint', 'Name of the joint of the right wheel.')
    joint_command_type: str = parameter(
        'JointState',
        'Type of joint_command: JointState, or Float64MultiArray with [left, right]. Read-only.',
        choices=('JointState', 'Float64MultiArray'),
        read_only=True,
    )
    enable_stamped_cmd_vel: bool = parameter(False, STAMPED, read_only=True)

    def check(self) -> None:
        """Raise ParameterError if the names of the wheels are equal."""
        differ('left_wheel_name', self.left_wheel_name, 'right_wheel_name', self.right_wheel_name)

    @property
    def wheel_names(self) -> tuple[str, str]:
        """Names of the left and the right wheel joint, in the order of messages."""
        return self.left_wheel_name, self.right_wheel_name

    def model(self) -> RobotModel:
        """Return the robot whose wheels are driven."""
        max_wheel_speed = number_or(self.max_wheel_velocity, math.inf)
        return RobotModel(
            wheel_radius=self.wheel_radius,
            wheel_separation=self.wheel_separation * self.wheel_separation_multiplier,
            right_wheel_radius_multiplier=self.right_wheel_radius_multiplier,
            left_wheel_radius_multiplier=self.left_wheel_radius_multiplier,
            limits=replace(self.twist_limits(), max_wheel_speed=max_wheel_speed),
        )
