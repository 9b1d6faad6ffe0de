"""Limits of the body twist as parameters, common to several nodes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from diffdrive_jacobian.kinematics.saturation import VelocityLimits
from diffdrive_jacobian.messages.conversion import MAX_SPEED
from diffdrive_jacobian.parameters.declaration import NodeParameters, parameter
from diffdrive_jacobian.simulation.actuators import AccelerationLimits, AxisLimits

_GREATEST = 1e6
_RATES = {
    'max_acceleration': (1.0, 'Maximum acceleration forward', 'no limits of the acceleration'),
    'max_deceleration': (-1.0, 'Maximum deceleration of forward motion, negative', 'as in reverse'),
    'max_acceleration_reverse': (
        -1.0,
        'Maximum acceleration in reverse, negative',
        'minus max_acceleration',
    ),
    'max_deceleration_reverse': (
        1.0,
        'Maximum deceleration of motion in reverse, positive',
        'max_acceleration',
    ),
}
"""Sign, description and meaning of NaN of each limit of the acceleration."""


def _acceleration(axis: str, name: str, unit: str) -> Any:
    sign, what, otherwise = _RATES[name]
    if axis == 'angular.z':
        what = what.replace('forward motion', 'counter-clockwise turns')
        what = what.replace('motion in reverse', 'clockwise turns')
        what = what.replace('forward', 'counter-clockwise').replace('in reverse', 'clockwise')
        otherwise = otherwise.replace('in reverse', 'clockwise')
    return parameter(
        math.nan,
        f'{what} [{unit}]; .nan: {otherwise}.',
        name=f'{axis}.{name}',
        bounds=(1e-6, _GREATEST) if sign > 0.0 else (-_GREATEST, -1e-6),
        nan_is_none=True,
    )


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


@dataclass(frozen=True, kw_only=True, slots=True)
class TwistAccelerationParameters(LimitParameters):
    """Limits of twist and acceleration, with the names, signs and defaults of diff_drive_controller."""

    linear_x_max_acceleration: float = _acceleration('linear.x', 'max_acceleration', 'm/s^2')
    linear_x_max_deceleration: float = _acceleration('linear.x', 'max_deceleration', 'm/s^2')
    linear_x_max_acceleration_reverse: float = _acceleration(
        'linear.x', 'max_acceleration_reverse', 'm/s^2'
    )
    linear_x_max_deceleration_reverse: float = _acceleration(
        'linear.x', 'max_deceleration_reverse', 'm/s^2'
    )
    angular_z_max_acceleration: float = _acceleration('angular.z', 'max_acceleration', 'rad/s^2')
    angular_z_max_deceleration: float = _acceleration('angular.z', 'max_deceleration', 'rad/s^2')
    angular_z_max_acceleration_reverse: float = _acceleration(
        'angular.z', 'max_acceleration_reverse', 'rad/s^2'
    )
    angular_z_max_deceleration_reverse: float = _acceleration(
        'angular.z', 'max_deceleration_reverse', 'rad/s^2'
    )

    def acceleration_limits(self) -> AccelerationLimits:
        """Return the limits of the acceleration.

        As in diff_drive_controller an axis without `max_acceleration` has none at all.
        """
        return AccelerationLimits(
            v=self._axis('linear_x'),
            omega=self._axis('angular_z'),
        )

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


@dataclass(frozen=True, kw_only=True, slots=True)
class AccelerationParameters(TwistAccelerationParameters):
    """Limits of twist and acceleration, those of the wheels included."""

    max_wheel_acceleration: float = parameter(
        math.nan,
        'Maximum angular acceleration of a wheel [rad/s^2]; .nan: no limit.',
        bounds=(1e-6, 1e9),
        nan_is_none=True,
    )

    def acceleration_limits(self) -> AccelerationLimits:
        """Return the limits of the acceleration."""
        return replace(
            TwistAccelerationParameters.acceleration_limits(self),
            max_wheel_acceleration=number_or(self.max_wheel_acceleration, math.inf),
        )


def number_or(value: float, otherwise: float) -> float:
    """Return a value, or another one if it is NaN."""
    return otherwise if math.isnan(value) else value
