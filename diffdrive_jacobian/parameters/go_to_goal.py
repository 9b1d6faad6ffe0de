"""The parameters of the node go_to_goal."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar, cast

from diffdrive_jacobian.control.controller import (
    KP,
    KV,
    OFFSET,
    ControlLaw,
    Controller,
    Gain,
    PathController,
)
from diffdrive_jacobian.control.controllers import (
    ALL_PATH_CONTROLLERS,
    ControllerError,
    Controllers,
)
from diffdrive_jacobian.control.controllers import CONTROLLERS as CONTROLLERS
from diffdrive_jacobian.control.path_following import PathSettings
from diffdrive_jacobian.control.path_laws import PATH_CONTROLLERS
from diffdrive_jacobian.control.waypoints import Arrival
from diffdrive_jacobian.kinematics.saturation import VelocityLimits
from diffdrive_jacobian.messages.conversion import MAX_SPEED
from diffdrive_jacobian.parameters.common import (
    TwistParameters,
    check_wheel_lag,
    command_delay_field,
    number_or,
    timeout_field,
    wheel_lag_field,
)
from diffdrive_jacobian.parameters.declaration import (
    ParameterError,
    default_of,
    parameter,
)
from diffdrive_jacobian.simulation.actuators import Actuators
from diffdrive_jacobian.time_units import nanoseconds

C = TypeVar('C', bound=ControlLaw)

OF_RCLPY = ('use_sim_time', 'start_type_description_service')
"""Parameters of every node."""
MIN_OFFSET = 1e-3
"""Smallest absolute offset (m). The yaw rate of the law is proportional to the inverse of the offset."""


def _controller(default: str, choices: Controllers[Any]) -> Any:
    laws = '; '.join(f'{name}, {one.summary}' for name, one in choices.built_in.items())
    names = ', '.join(map(repr, choices.built_in))
    return parameter(
        default,
        f'{choices.title}: {laws}; or the name of an installed one.',
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
class GoToGoalParameters(TwistParameters):
    """Parameters of the node go_to_goal. Limits of the acceleration, lag and delay are known, not kept:
    they say what the robot can do.
    """

    controllers: ClassVar[Controllers[Controller]] = CONTROLLERS
    """The controllers that can be chosen."""
    path_controllers: ClassVar[Controllers[PathController]] = ALL_PATH_CONTROLLERS
    """Those of paths."""

    declared_gains: ClassVar[Mapping[str, Gain]] = {
        gain.name: gain
        for gain in (KP, KV, OFFSET, *(gain for one in PATH_CONTROLLERS for gain in one.gains))
    }
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
    path_controller: str = _controller('pure_pursuit', ALL_PATH_CONTROLLERS)
    lookahead_distance: float = _gain(declared_gains['lookahead_distance'])
    k_x: float = _gain(declared_gains['k_x'])
    k_y: float = _gain(declared_gains['k_y'])
    k_theta: float = _gain(declared_gains['k_theta'])
    k_point: float = _gain(declared_gains['k_point'])
    k_position: float = _gain(declared_gains['k_position'])
    k_velocity: float = _gain(declared_gains['k_velocity'])
    path_speed: float = parameter(
        0.2, 'Speed along a path without times [m/s].', bounds=(1e-3, MAX_SPEED)
    )
    path_deceleration: float = parameter(
        0.5,
        'Deceleration towards the end of a path, at most linear.x.max_deceleration [m/s^2].',
        bounds=(1e-3, MAX_SPEED),
    )
    path_approach_distance: float = parameter(
        0.3,
        'Distance from a path beyond which the robot first drives to it as to a goal [m].',
        bounds=(1e-3, 1e6),
    )
    max_path_distance: float = parameter(
        math.nan,
        'Largest distance of the robot from the start of a path; others are refused [m].',
        bounds=(1e-3, 1e6),
        nan_is_none=True,
    )
    pass_waypoints: bool = parameter(
        False,
        'Drive through the poses of goals without stopping, along a smooth path; stop at the last.',
    )
    waypoint_tolerance: float = parameter(
        0.1,
        'Largest distance at which a pose of goals counts as passed, with pass_waypoints [m].',
        bounds=(1e-6, 100.0),
    )
    odom_timeout: float = timeout_field(
        'Time without odometry after which the robot stops, until it returns [s]; 0: never.',
    )

    @classmethod
    def with_controller(cls, controller: Controller) -> type[GoToGoalParameters]:
        """Return the class of the parameters with a further controller, which is the default.

        Raises:
            ValueError: It is not a Controller, or has the name of a built-in one.
        """
        return cls._with_default(controller, CONTROLLERS.with_controller(controller))

    @classmethod
    def with_path_controller(cls, controller: PathController) -> type[GoToGoalParameters]:
        """As `with_controller`, for a controller of paths."""
        return cls._with_default(controller, ALL_PATH_CONTROLLERS.with_controller(controller))

    @classmethod
    def _with_default(cls, controller: C, known: Controllers[C]) -> type[GoToGoalParameters]:
        choice = (known.parameter, str, _controller(controller.name, known))
        return cls._subclass([choice], {f'{known.parameter}s': known})

    @classmethod
    def extended(cls, values: Mapping[str, Any]) -> type[GoToGoalParameters]:
        """Return the class that has the gains of the controllers, too, with the defaults they declare.

        Raises:
            ParameterError: A controller cannot be loaded, or a gain has the name of something else, or
                another range than the gain of that name.
        """
        return cls._with_gains(cls.controllers, values)._with_gains(cls.path_controllers, values)

    @classmethod
    def _with_gains(
        cls, controllers: Controllers[Any], values: Mapping[str, Any]
    ) -> type[GoToGoalParameters]:
        parameter = controllers.parameter
        name = values.get(parameter, default_of(cls, parameter))
        if name not in controllers or name in controllers.built_in:
            return cls
        controller = _found(controllers, name)
        new = [gain for gain in controller.gains if cls.declared_gains.get(gain.name) != gain]
        for gain in new:
            known = cls.declared_gains.get(gain.name)
            if known is None and (hasattr(cls, gain.name) or gain.name in OF_RCLPY):
                raise ParameterError(
                    f"parameter '{parameter}': {name!r} has a gain {gain.name!r}, a name that "
                    'go_to_goal uses otherwise: choose another one'
                )
            if known is not None and not gain.shares_range(known):
                raise ParameterError(
                    f"parameter '{parameter}': {name!r} has a gain {gain.name!r} with another unit or "
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

    def limits(self, default: float = MAX_SPEED) -> VelocityLimits:
        """Return the limits of the commands, at most the largest plausible twist."""
        return TwistParameters.limits(self, default)

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
        """Check that the driven point is not on the axle, and that the controllers can be loaded."""
        if abs(self.offset) < MIN_OFFSET:
            raise ParameterError(
                f"parameter 'offset' must be at least {MIN_OFFSET:g} m or at most {-MIN_OFFSET:g} m, "
                f'got {self.offset:g}: the Jacobian of the axle centre itself has rank 1'
            )
        check_wheel_lag(self.wheel_lag)
        self.chosen_controller()
        self.chosen_path_controller()

    def chosen_controller(self) -> Controller:
        """Return the controller; an installed one is imported.

        Raises:
            ParameterError: It cannot be loaded.
        """
        return _found(self.controllers, self.controller)

    def chosen_path_controller(self) -> PathController:
        """Return the controller of paths; an installed one is imported.

        Raises:
            ParameterError: It cannot be loaded.
        """
        return _found(self.path_controllers, self.path_controller)

    def path_settings(self) -> PathSettings:
        """Return how a path is followed, not faster than the limits allow."""
        return PathSettings(
            speed=min(self.path_speed, self.limits().max_v),
            deceleration=min(self.path_deceleration, -self.acceleration_limits().v.max_deceleration),
            approach_distance=self.path_approach_distance,
            turning_gain=self.kp,
            catching_up=self.kv,
            end_tolerance=self.xy_goal_tolerance,
            waypoint_tolerance=self.waypoint_tolerance,
        )


def _found(controllers: Controllers[C], name: str) -> C:
    try:
        return controllers.find(name)
    except ControllerError as error:
        raise ParameterError(f"parameter '{controllers.parameter}': {error}") from error
