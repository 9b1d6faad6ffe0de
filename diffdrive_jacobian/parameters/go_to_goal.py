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

"""The parameters of the node go_to_goal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

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
from diffdrive_jacobian.numerics.checks import between
from diffdrive_jacobian.parameters.common import (
    TwistParameters,
    check_wheel_lag,
    command_delay_field,
    number_or,
    timeout_field,
    wheel_lag_field,
)
from diffdrive_jacobian.parameters.declaration import (
    Parameter,
    ParameterError,
    parameter,
)
from diffdrive_jacobian.parameters.more_gains import MoreGains, description
from diffdrive_jacobian.simulation.actuators import Actuators

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
    return parameter(gain.default, description(gain), gain.range)


def _stopped(what: str, unit: str) -> Any:
    return parameter(
        math.nan,
        f'Largest {what} with which the robot counts as arrived [{unit}]; .nan: any.',
        between(1e-6, MAX_SPEED),
        nan_is_none=True,
    )


GAINS = {
    gain.name: gain
    for gain in (KP, KV, OFFSET, *(gain for one in PATH_CONTROLLERS for gain in one.gains))
}
"""The gains of the built-in controllers, which are among the fields."""


@dataclass(frozen=True, kw_only=True, slots=True)
class GoToGoalParameters(TwistParameters):
    """Parameters of the node go_to_goal. Limits of the acceleration, lag and delay are known, not kept:
    they say what the robot can do.
    """

    controllers: Controllers[Controller] = CONTROLLERS
    """The controllers that can be chosen."""
    path_controllers: Controllers[PathController] = ALL_PATH_CONTROLLERS
    """Those of paths."""
    more_gains: MoreGains = field(default_factory=MoreGains)
    """The gains of given or installed controllers that were chosen: parameters, too."""

    kp: float = _gain(KP)
    kv: float = _gain(KV)
    controller: str = _controller('go_to_goal', CONTROLLERS)
    offset: float = _gain(OFFSET)
    xy_goal_tolerance: float = parameter(
        0.02, 'Tolerance on the distance to the goal [m].', between(1e-6, 100.0)
    )
    yaw_goal_tolerance: float = parameter(
        0.02, 'Tolerance on the heading error [rad].', between(1e-6, math.pi)
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
    lookahead_distance: float = _gain(GAINS['lookahead_distance'])
    k_x: float = _gain(GAINS['k_x'])
    k_y: float = _gain(GAINS['k_y'])
    k_theta: float = _gain(GAINS['k_theta'])
    k_point: float = _gain(GAINS['k_point'])
    k_position: float = _gain(GAINS['k_position'])
    k_velocity: float = _gain(GAINS['k_velocity'])
    path_speed: float = parameter(
        0.2, 'Speed along a path without times [m/s].', between(1e-3, MAX_SPEED)
    )
    path_deceleration: float = parameter(
        0.5,
        'Deceleration towards the end of a path, at most linear.x.max_deceleration [m/s^2].',
        between(1e-3, MAX_SPEED),
    )
    path_approach_distance: float = parameter(
        0.3,
        'Distance from a path beyond which the robot first drives to it as to a goal [m].',
        between(1e-3, 1e6),
    )
    max_path_distance: float = parameter(
        math.nan,
        'Largest distance of the robot from the start of a path; others are refused [m].',
        between(1e-3, 1e6),
        nan_is_none=True,
    )
    pass_waypoints: bool = parameter(
        False,
        'Drive through the poses of goals without stopping, along a smooth path; stop at the last.',
    )
    waypoint_tolerance: float = parameter(
        0.1,
        'Largest distance at which a pose of goals counts as passed, with pass_waypoints [m].',
        between(1e-6, 100.0),
    )
    odom_timeout: float = timeout_field(
        'Time without odometry after which the robot stops, until it returns [s]; 0: never.',
    )

    def __getattr__(self, name: str) -> float:
        """Return a gain that is not among the fields: a law asks for each by its name."""
        # A copy is asked for more_gains itself before it has it.
        if name != 'more_gains' and name in self.more_gains.values:
            return self.more_gains.values[name]
        raise AttributeError(f'{type(self).__name__} has no attribute {name!r}')

    def with_controller(self, controller: Controller) -> GoToGoalParameters:
        """Return these with a further controller, which is chosen.

        Raises:
            ValueError: It is not a Controller, or has the name of a built-in one.
        """
        known = self.controllers.with_controller(controller)
        return replace(self, controllers=known, controller=controller.name)

    def with_path_controller(self, controller: PathController) -> GoToGoalParameters:
        """As `with_controller`, for a controller of paths."""
        known = self.path_controllers.with_controller(controller)
        return replace(self, path_controllers=known, path_controller=controller.name)

    def with_laws(
        self, controller: Controller | None = None, path_controller: PathController | None = None
    ) -> GoToGoalParameters:
        """Return these with further controllers, as `with_controller`. None: there is none."""
        found = self if controller is None else self.with_controller(controller)
        return found if path_controller is None else found.with_path_controller(path_controller)

    def declared(self) -> dict[str, Parameter]:
        """Return the parameters by their ROS names, with the gains of the controllers."""
        found = {**TwistParameters.declared(self), **self.more_gains.declared()}
        for registry in (self.controllers, self.path_controllers):
            found[registry.parameter] = replace(found[registry.parameter], choices=registry)
        return found

    def changed(self, values: Mapping[str, Any]) -> GoToGoalParameters:
        """Return the parameters with new values by their ROS names, as `NodeParameters.changed`.

        The gains of controllers that are chosen become parameters, and stay. Raises ParameterError, too,
        if one cannot be loaded, or its gains cannot be parameters.
        """
        # First add the gains, then split the values into those of them and of the fields.
        before = self._with_gains(values)
        known = before.declared()
        given = {name: known[name].converted(value) for name, value in values.items() if name in known}
        if before is self and not given:
            return self
        more = before.more_gains.changed(given)
        fields = {known[name].field: value for name, value in given.items() if name not in more.values}
        return replace(before, more_gains=more, **fields)

    def at_start(self, values: Mapping[str, Any]) -> GoToGoalParameters:
        """Return these defaults with those of the controllers, and the values that the user gave."""
        before = self._with_gains(values)
        own = {gain.name: gain.default for gain in before.more_gains.gains}
        return before.changed({**own, **values})

    def _with_gains(self, values: Mapping[str, Any]) -> GoToGoalParameters:
        """Return these with the gains of the controllers that are chosen with new values."""
        # A gain is read as an attribute, so that its name must not be that of another one.
        more, used = self.more_gains, {*dir(type(self)), *OF_RCLPY}
        registries: tuple[Controllers[Any], ...] = self.controllers, self.path_controllers
        for registry in registries:
            name = values.get(registry.parameter, getattr(self, registry.parameter))
            if name in registry and name not in registry.built_in:
                what = f"parameter '{registry.parameter}': {name!r}"
                more = more.with_gains_of(_found(registry, name), what, GAINS, used)
        return self if more == self.more_gains else replace(self, more_gains=more)

    def limits(self, default: float = MAX_SPEED) -> VelocityLimits:
        """Return the limits of the commands, at most the largest plausible twist."""
        return TwistParameters.limits(self, default)

    def actuators(self) -> Actuators:
        """Return how the robot follows commands, as far as it is known."""
        return self.actuators_with(self.wheel_lag, self.command_delay)

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
