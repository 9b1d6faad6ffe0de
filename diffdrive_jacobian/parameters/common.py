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

"""Parameters that several nodes have, with the names, signs and defaults of diff_drive_controller."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from diffdrive_jacobian.kinematics.saturation import VelocityLimits
from diffdrive_jacobian.messages.conversion import MAX_SPEED
from diffdrive_jacobian.numerics.checks import Range, between
from diffdrive_jacobian.parameters.declaration import NodeParameters, ParameterError, parameter
from diffdrive_jacobian.parameters.wheels import WHEELS, Dimensions
from diffdrive_jacobian.simulation.actuators import SHORTEST, AccelerationLimits, Actuators, AxisLimits
from diffdrive_jacobian.simulation.robot_model import RobotModel
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.time_units import nanoseconds

_SMALLEST = 1e-200
SPEED = between(0.0, MAX_SPEED)
REVERSE = between(-MAX_SPEED, 0.0)
GAINING = between(1e-6, 1e6)
LOSING = between(-1e6, -1e-6)


def _limited(name: str, within: Range, description: str) -> Any:
    return parameter(math.nan, description, within, name=name, nan_is_none=True)


def timeout_field(description: str) -> Any:
    """Declare the time without a message after which a node stops what it commands."""
    return parameter(0.5, description, between(0.0, 3600.0))


def wheel_lag_field() -> Any:
    """Declare the time constant of the wheels."""
    return parameter(
        0.0,
        'Time constant with which the wheels follow commands, of first order; 0 or at least 1e-9 [s].',
        between(0.0, 100.0),
    )


def check_wheel_lag(wheel_lag: float) -> None:
    """Raise ParameterError if the time constant is below the resolution of times, but not zero."""
    if 0.0 < wheel_lag < SHORTEST:
        raise ParameterError(
            f"parameter 'wheel_lag' must be 0.0 or at least {SHORTEST:g}, got {wheel_lag!r}"
        )


def command_delay_field() -> Any:
    """Declare the delay of commands."""
    return parameter(0.0, 'Time from a command to its effect on the wheels [s].', between(0.0, 100.0))


_RATES = (
    'max_acceleration',
    'max_deceleration',
    'max_acceleration_reverse',
    'max_deceleration_reverse',
)
"""Limits of the acceleration of an axis."""


def number_or(value: float, otherwise: float) -> float:
    """Return a value, or another one if it is NaN."""
    return otherwise if math.isnan(value) else value


def _limit(value: float, otherwise: float) -> float:
    """Return a limit: zero if it is so small that the quotient of a speed and it overflows."""
    return number_or(0.0 if abs(value) < _SMALLEST else value, otherwise)


def differ(first: str, value: str, second: str, other: str) -> None:
    """Raise ParameterError if the values of two parameters are equal."""
    if value == other:
        raise ParameterError(
            f"parameters '{first}' and '{second}' must differ, both are '{printable(value)}'"
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class TwistParameters(NodeParameters):
    """Type of cmd_vel, and limits of twist and acceleration."""

    linear_x_max_velocity: float = _limited(
        'linear.x.max_velocity', SPEED, 'Maximum forward velocity [m/s]; .nan: no limit.'
    )
    linear_x_min_velocity: float = _limited(
        'linear.x.min_velocity',
        REVERSE,
        'Minimum velocity, zero or negative: the limit in reverse [m/s]; .nan: as forward.',
    )
    angular_z_max_velocity: float = _limited(
        'angular.z.max_velocity',
        SPEED,
        'Maximum yaw rate, counter-clockwise [rad/s]; .nan: no limit.',
    )
    angular_z_min_velocity: float = _limited(
        'angular.z.min_velocity',
        REVERSE,
        'Minimum yaw rate, zero or negative: the limit clockwise [rad/s]; .nan: as counter-clockwise.',
    )
    linear_x_max_acceleration: float = _limited(
        'linear.x.max_acceleration',
        GAINING,
        'Maximum acceleration forward [m/s^2]; .nan: no limits of the acceleration.',
    )
    linear_x_max_deceleration: float = _limited(
        'linear.x.max_deceleration',
        LOSING,
        'Maximum deceleration of forward motion, negative [m/s^2]; .nan: as in reverse.',
    )
    linear_x_max_acceleration_reverse: float = _limited(
        'linear.x.max_acceleration_reverse',
        LOSING,
        'Maximum acceleration in reverse, negative [m/s^2]; .nan: minus max_acceleration.',
    )
    linear_x_max_deceleration_reverse: float = _limited(
        'linear.x.max_deceleration_reverse',
        GAINING,
        'Maximum deceleration of motion in reverse, positive [m/s^2]; .nan: max_acceleration.',
    )
    angular_z_max_acceleration: float = _limited(
        'angular.z.max_acceleration',
        GAINING,
        'Maximum acceleration counter-clockwise [rad/s^2]; .nan: no limits of the acceleration.',
    )
    angular_z_max_deceleration: float = _limited(
        'angular.z.max_deceleration',
        LOSING,
        'Maximum deceleration of counter-clockwise turns, negative [rad/s^2]; .nan: as clockwise.',
    )
    angular_z_max_acceleration_reverse: float = _limited(
        'angular.z.max_acceleration_reverse',
        LOSING,
        'Maximum acceleration clockwise, negative [rad/s^2]; .nan: minus max_acceleration.',
    )
    angular_z_max_deceleration_reverse: float = _limited(
        'angular.z.max_deceleration_reverse',
        GAINING,
        'Maximum deceleration of clockwise turns, positive [rad/s^2]; .nan: max_acceleration.',
    )
    enable_stamped_cmd_vel: bool = parameter(
        False, 'Use TwistStamped instead of Twist for cmd_vel. Read-only.', read_only=True
    )

    def limits(self, default: float = math.inf) -> VelocityLimits:
        """Return the limits of the twist, `default` where none is set (m/s, rad/s)."""
        max_v = _limit(self.linear_x_max_velocity, default)
        max_omega = _limit(self.angular_z_max_velocity, default)
        return VelocityLimits(
            min_v=_limit(self.linear_x_min_velocity, -max_v),
            max_v=max_v,
            min_omega=_limit(self.angular_z_min_velocity, -max_omega),
            max_omega=max_omega,
        )

    def acceleration_limits(self) -> AccelerationLimits:
        """Return the limits of the acceleration.

        As in diff_drive_controller an axis without `max_acceleration` has none at all.
        """
        return AccelerationLimits(v=self._axis('linear_x'), omega=self._axis('angular_z'))

    def actuators_with(self, lag: float, delay: float) -> Actuators:
        """Return how commands are followed, with a lag and a delay (s)."""
        limits = self.acceleration_limits()
        return Actuators(acceleration=limits, lag=lag, delay=nanoseconds(delay))

    def _axis(self, axis: str) -> AxisLimits:
        forward, slowing, reverse, slowing_reverse = (getattr(self, f'{axis}_{name}') for name in _RATES)
        if math.isnan(forward):
            return AxisLimits()
        reverse = number_or(reverse, -forward)
        return AxisLimits(
            max_acceleration=forward,
            max_deceleration=number_or(slowing, reverse),
            max_acceleration_reverse=reverse,
            max_deceleration_reverse=number_or(slowing_reverse, forward),
        )


def _multiplier(what: str) -> Any:
    return parameter(1.0, f'Correction factor for the {what} [-].', between(0.1, 10.0))


@dataclass(frozen=True, kw_only=True, slots=True)
class WheelParameters(TwistParameters):
    """Wheels and their joints, with the limits of their motion besides those of the twist."""

    wheel_radius: float = parameter(0.033, 'Radius of the wheels [m].', between(1e-3, 10.0))
    wheel_separation: float = parameter(
        0.16, 'Distance between the left and the right wheel [m].', between(1e-3, 100.0)
    )
    wheel_separation_multiplier: float = _multiplier('wheel separation')
    left_wheel_radius_multiplier: float = _multiplier('radius of the left wheel')
    right_wheel_radius_multiplier: float = _multiplier('radius of the right wheel')
    max_wheel_velocity: float = parameter(
        math.nan,
        'Maximum wheel speed [rad/s]; both are scaled alike, which keeps the curvature; .nan: no limit.',
        between(1e-3, 1e6),
        nan_is_none=True,
    )
    max_wheel_acceleration: float = parameter(
        math.nan,
        'Maximum angular acceleration of a wheel [rad/s^2]; .nan: no limit.',
        between(1e-6, 1e9),
        nan_is_none=True,
    )
    left_wheel_name: str = parameter('left_wheel_joint', 'Name of the joint of the left wheel.')
    right_wheel_name: str = parameter('right_wheel_joint', 'Name of the joint of the right wheel.')

    def check(self) -> None:
        """Raise ParameterError if the names of the wheels are equal."""
        differ('left_wheel_name', self.left_wheel_name, 'right_wheel_name', self.right_wheel_name)

    @property
    def dimensions(self) -> Dimensions:
        """Dimensions of the wheels."""
        return Dimensions.of(getattr(self, name) for name in WHEELS)

    @property
    def wheel_names(self) -> tuple[str, str]:
        """Names of the left and the right wheel joint, in the order of messages."""
        return self.left_wheel_name, self.right_wheel_name

    def limits(self, default: float = math.inf) -> VelocityLimits:
        """Return the limits of the twist and of the wheel speed."""
        max_wheel_speed = number_or(self.max_wheel_velocity, math.inf)
        return replace(TwistParameters.limits(self, default), max_wheel_speed=max_wheel_speed)

    def acceleration_limits(self) -> AccelerationLimits:
        """Return the limits of the acceleration, also of the wheels."""
        return replace(
            TwistParameters.acceleration_limits(self),
            max_wheel_acceleration=number_or(self.max_wheel_acceleration, math.inf),
        )

    def model(self) -> RobotModel:
        """Return the robot with these wheels and limits of the velocity."""
        return RobotModel(
            wheel_radius=self.wheel_radius,
            wheel_separation=self.wheel_separation * self.wheel_separation_multiplier,
            right_wheel_radius_multiplier=self.right_wheel_radius_multiplier,
            left_wheel_radius_multiplier=self.left_wheel_radius_multiplier,
            limits=self.limits(),
        )
