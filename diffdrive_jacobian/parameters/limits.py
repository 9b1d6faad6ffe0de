"""Limits of the body twist as parameters, common to several nodes."""

from __future__ import annotations

import math
from dataclasses import dataclass

from diffdrive_jacobian.kinematics.saturation import VelocityLimits
from diffdrive_jacobian.messages.conversion import MAX_SPEED
from diffdrive_jacobian.parameters.declaration import NodeParameters, parameter


@dataclass(frozen=True, kw_only=True, slots=True)
class LimitParameters(NodeParameters):
    """Limits of the body twist, with the names and the meaning of diff_drive_controller."""

    linear_x_max_velocity: float = parameter(
        math.nan,
        'Maximum forward velocity [m/s]; .nan: no limit.',
        name='linear.x.max_velocity',
        bounds=(0.0, MAX_SPEED),
        nan_is_none=True,
    )
    linear_x_min_velocity: float = parameter(
        math.nan,
        'Minimum velocity, zero or negative: the limit in reverse [m/s]; .nan: as forward.',
        name='linear.x.min_velocity',
        bounds=(-MAX_SPEED, 0.0),
        nan_is_none=True,
    )
    angular_z_max_velocity: float = parameter(
        math.nan,
        'Maximum yaw rate, counter-clockwise [rad/s]; .nan: no limit.',
        name='angular.z.max_velocity',
        bounds=(0.0, MAX_SPEED),
        nan_is_none=True,
    )
    angular_z_min_velocity: float = parameter(
        math.nan,
        'Minimum yaw rate, zero or negative: the limit clockwise [rad/s]; .nan: as counter-clockwise.',
        name='angular.z.min_velocity',
        bounds=(-MAX_SPEED, 0.0),
        nan_is_none=True,
    )

    def twist_limits(self, default: float = math.inf) -> VelocityLimits:
        """Return the limits of the twist, without a limit of the wheel speed.

        Args:
            default: The limit where none is set (m/s, rad/s).
        """
        max_v = number_or(self.linear_x_max_velocity, default)
        max_omega = number_or(self.angular_z_max_velocity, default)
        return VelocityLimits(
            min_v=number_or(self.linear_x_min_velocity, -max_v),
            max_v=max_v,
            min_omega=number_or(self.angular_z_min_velocity, -max_omega),
            max_omega=max_omega,
        )


def number_or(value: float, otherwise: float) -> float:
    """Return a value, or another one if it is NaN."""
    return otherwise if math.isnan(value) else value
