"""Parameters that several nodes have."""

from __future__ import annotations

import math
from typing import Any

from diffdrive_jacobian.parameters.declaration import ParameterError, parameter
from diffdrive_jacobian.text import printable

STAMPED = 'Use TwistStamped instead of Twist for cmd_vel. Read-only.'
"""Description of `enable_stamped_cmd_vel`."""


def wheel_radius_field() -> Any:
    """Declare the radius of the wheels."""
    return parameter(0.033, 'Radius of the wheels [m].', bounds=(1e-3, 10.0))


def wheel_separation_field() -> Any:
    """Declare the distance between the wheels."""
    return parameter(0.16, 'Distance between the left and the right wheel [m].', bounds=(1e-3, 100.0))


def multiplier_field(what: str) -> Any:
    """Declare the correction factor of a dimension, as diff_drive_controller has it."""
    return parameter(1.0, f'Correction factor for the {what} [-].', bounds=(0.1, 10.0))


def max_wheel_velocity_field() -> Any:
    """Declare the limit of the wheel speeds."""
    return parameter(
        math.nan,
        'Maximum wheel speed [rad/s]; both are scaled alike, which keeps the curvature; .nan: no limit.',
        bounds=(1e-3, 1e6),
        nan_is_none=True,
    )


def timeout_field(default: float, description: str) -> Any:
    """Declare the time without a message after which a node stops what it commands."""
    return parameter(default, description, bounds=(0.0, 3600.0))


def wheel_lag_field() -> Any:
    """Declare the time constant of the wheels."""
    return parameter(
        0.0,
        'Time constant with which the wheels follow commands, of first order [s].',
        bounds=(0.0, 100.0),
    )


def command_delay_field() -> Any:
    """Declare the delay of commands."""
    return parameter(0.0, 'Time from a command to its effect on the wheels [s].', bounds=(0.0, 100.0))


def differ(first: str, value: str, second: str, other: str) -> None:
    """Raise ParameterError if the values of two parameters are equal.

    Args:
        first: Name of the one parameter.
        value: Its value.
        second: Name of the other one.
        other: Its value.
    """
    if value == other:
        raise ParameterError(
            f"parameters '{first}' and '{second}' must differ, both are '{printable(value)}'"
        )
