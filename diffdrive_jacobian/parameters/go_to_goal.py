"""The parameters of the node go_to_goal."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, cast

from diffdrive_jacobian.control.arrival import Arrival
from diffdrive_jacobian.control.controller import KP, KV, OFFSET, Controller, Gain
from diffdrive_jacobian.control.controllers import BUILT_IN, ControllerError, Controllers
from diffdrive_jacobian.control.controllers import CONTROLLERS as CONTROLLERS
from diffdrive_jacobian.kinematics.saturation import VelocityLimits
from diffdrive_jacobian.messages.conversion import MAX_SPEED
from diffdrive_jacobian.parameters._fields import (
    STAMPED,
    command_delay_field,
    timeout_field,
    wheel_lag_field,
)
from diffdrive_jacobian.parameters.declaration import (
    ParameterError,
    default_of,
    parameter,
)
from diffdrive_jacobian.parameters.limits import TwistAccelerationParameters, number_or
from diffdrive_jacobian.simulation.actuators import Actuators
from diffdrive_jacobian.time_units import nanoseconds

OF_RCLPY = ('use_sim_time', 'start_type_description_service')
"""Parameters of every node."""
MIN_OFFSET = 1e-3
"""Smallest absolute offset (m). The yaw rate of the law is proportional to the inverse of the offset."""


def _controller(default: str, choices: Controllers) -> Any:
    laws = '; '.join(f'{name}, {one.summary}' for name, one in BUILT_IN.items())
    names = ', '.join(map(repr, BUILT_IN))
    return parameter(
        default,
        f'Control law: {laws}; or the name of an installed one.',
        choices=choices,
        constraint=f'one of {names}, or an installed or given one',
    )


def _gain(gain: Gain) -> Any:
    unit = f' [{gain.unit}]' if gain.unit else ''
    return parameter(gain.default, f'{gain.description}{unit}.', bounds=gain.bounds, above=gain.above)


def _stopped(what: str, unit: str) -> Any:
    return parameter(
        math.nan,
        f'Largest {what} with which the robot counts as arrived [{unit}]; .nan: any.',
        bounds=(1e-6, MAX_SPEED),
        nan_is_none=True,
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class GoToGoalParameters(TwistAccelerationParameters):
    """Parameters of the node go_to_goal. Limits of the acceleration, lag and delay are known, not kept:
    they say what the robot can do.
    """

    controllers: ClassVar[Controllers] = CONTROLLERS
    """The controllers that can be chosen."""

    declared_gains: ClassVar[Mapping[str, Gain]] = {gain.name: gain for gain in (KP, KV, OFFSET)}
    """The gains among the parameters."""

    kp: float = _gain(KP)
    kv: float = _gain(KV)
    controller: str = _controller('go_to_goal', CONTROLLERS)
    offset: float = _gain(OFFSET)
    xy_goal_tolerance: float = parameter(
        0.02, 'Tolerance on the distance to the goal [m].', bounds=(1e-6, 100.0)
    )
    yaw_goal_tolerance: float = parameter(
        0.02, 'Tolerance on the heading error [rad].', bounds=(1e-6, math.pi)
    )
    use_goal_heading: bool = parameter(
        False, 'Turn to the heading of the last goal after its position is reached.'
    )
    trans_stopped_velocity: float = _stopped('speed', 'm/s')
    rot_stopped_velocity: float = _stopped('yaw rate', 'rad/s')
    wheel_lag: float = wheel_lag_field()
    command_delay: float = command_delay_field()
    stop_in_time: bool = parameter(
        False,
        'Command no speed from which the robot cannot stop at the last goal within its limits of the '
        'acceleration, with its lag and delay.',
    )
    odom_timeout: float = timeout_field(
        0.5,
        'Time without odometry after which the robot stops, until it returns [s]; 0: never.',
    )
    enable_stamped_cmd_vel: bool = parameter(False, STAMPED, read_only=True)

    @classmethod
    def with_controller(cls, controller: Controller) -> type[GoToGoalParameters]:
        """Return the class of the parameters with a further controller, which is the default.

        Raises:
            ValueError: It is not a Controller, or has the name of a built-in one.
        """
        known = Controllers(controller)
        choice = ('controller', str, _controller(controller.name, known))
        return cls._subclass([choice], {'controllers': known})

    @classmethod
    def extended(cls, values: Mapping[str, Any]) -> type[GoToGoalParameters]:
        """Return the class that has the gains of the controller, too, with the defaults it declares.

        Raises:
            ParameterError: The controller cannot be loaded, or a gain has the name of something else, or
                another range than the gain of that name.
        """
        name = values.get('controller', default_of(cls, 'controller'))
        if name not in cls.controllers or name in BUILT_IN:
            return cls
        controller = _found(cls.controllers, name)
        new = [gain for gain in controller.gains if cls.declared_gains.get(gain.name) != gain]
        for gain in new:
            known = cls.declared_gains.get(gain.name)
            if known is None and (hasattr(cls, gain.name) or gain.name in OF_RCLPY):
                raise ParameterError(
                    f"parameter 'controller': {name!r} has a gain {gain.name!r}, a name that go_to_goal "
                    'uses otherwise: choose another one'
                )
            if known is not None and not gain.shares_range(known):
                raise ParameterError(
                    f"parameter 'controller': {name!r} has a gain {gain.name!r} with another unit or "
                    'other bounds than the parameter of that name: choose another name'
                )
        gains = {**cls.declared_gains, **{gain.name: gain for gain in new}}
        fields = [(gain.name, float, _gain(gain)) for gain in new]
        return cls._subclass(fields, {'declared_gains': gains}) if new else cls

    @classmethod
    def _subclass(
        cls, fields: Iterable[tuple[str, type, Any]], namespace: dict[str, Any]
    ) -> type[GoToGoalParameters]:
        options: Any = {'frozen': True, 'kw_only': True, 'slots': True}
        made = dataclasses.make_dataclass(
            cls.__name__, fields, bases=(cls,), namespace=namespace, **options
        )
        return cast('type[GoToGoalParameters]', made)

    def limits(self) -> VelocityLimits:
        """Return the limits of the commands, at most the largest plausible twist."""
        return self.twist_limits(MAX_SPEED)

    def actuators(self) -> Actuators:
        """Return how the robot follows commands, as far as it is known."""
        return Actuators(
            acceleration=self.acceleration_limits(),
            lag=self.wheel_lag,
            delay=nanoseconds(self.command_delay),
        )

    def arrival(self) -> Arrival:
        """Return the arrival criterion."""
        controller = self.chosen_controller()
        return Arrival(
            xy_tolerance=self.xy_goal_tolerance,
            yaw_tolerance=self.yaw_goal_tolerance,
            # A law that takes the heading must not stop before it has reached it.
            use_heading=self.use_goal_heading or controller.takes_heading,
            offset=controller.driven_offset(self),
            trans_stopped_velocity=number_or(self.trans_stopped_velocity, math.inf),
            rot_stopped_velocity=number_or(self.rot_stopped_velocity, math.inf),
        )

    def check(self) -> None:
        """Check that the driven point is not on the axle, and that the controller can be loaded."""
        if abs(self.offset) < MIN_OFFSET:
            raise ParameterError(
                f"parameter 'offset' must be at least {MIN_OFFSET:g} m or at most {-MIN_OFFSET:g} m, "
                f'got {self.offset:g}: the Jacobian of the axle centre itself has rank 1'
            )
        self.chosen_controller()

    def chosen_controller(self) -> Controller:
        """Return the controller; an installed one is imported.

        Raises:
            ParameterError: It cannot be loaded.
        """
        return _found(self.controllers, self.controller)


def _found(controllers: Controllers, name: str) -> Controller:
    try:
        return controllers.find(name)
    except ControllerError as error:
        raise ParameterError(f"parameter 'controller': {error}") from error
