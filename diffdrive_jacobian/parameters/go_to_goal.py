"""The parameters of the node go_to_goal."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from diffdrive_jacobian.control.controller import Controller
from diffdrive_jacobian.control.controllers import BUILT_IN, ControllerError, Controllers
from diffdrive_jacobian.control.controllers import CONTROLLERS as CONTROLLERS
from diffdrive_jacobian.kinematics.saturation import VelocityLimits
from diffdrive_jacobian.messages.plausibility import MAX_SPEED
from diffdrive_jacobian.parameters._fields import STAMPED, timeout_field
from diffdrive_jacobian.parameters.declaration import ParameterError, parameter
from diffdrive_jacobian.parameters.limits import LimitParameters

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


@dataclass(frozen=True, kw_only=True, slots=True)
class GoToGoalParameters(LimitParameters):
    """Parameters of the node go_to_goal."""

    controllers: ClassVar[Controllers] = CONTROLLERS
    """The controllers that can be chosen."""

    kp: float = parameter(
        3.0, 'Gain on the heading error [1/s]; should be larger than kv.', bounds=(0.0, 100.0), above=0.0
    )
    kv: float = parameter(0.5, 'Gain on the distance [1/s].', bounds=(0.0, 100.0), above=0.0)
    controller: str = _controller('go_to_goal', CONTROLLERS)
    offset: float = parameter(
        0.1,
        'X coordinate in the body frame of the point that offset_point drives; not 0 [m].',
        bounds=(-100.0, 100.0),
    )
    xy_goal_tolerance: float = parameter(
        0.02, 'Tolerance on the distance to the goal [m].', bounds=(1e-6, 100.0)
    )
    yaw_goal_tolerance: float = parameter(
        0.02, 'Tolerance on the heading error [rad].', bounds=(1e-6, math.pi)
    )
    use_goal_heading: bool = parameter(
        False, 'Turn to the heading of the last goal after its position is reached.'
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
        choice = _controller(controller.name, known)

        @dataclass(frozen=True, kw_only=True, slots=True)
        class Parameters(cls):  # type: ignore[valid-type, misc]
            controllers: ClassVar[Controllers] = known
            controller: str = choice

        return Parameters

    def limits(self) -> VelocityLimits:
        """Return the limits of the commands, at most the largest plausible twist."""
        return self.twist_limits(MAX_SPEED)

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
        try:
            return self.controllers.find(self.controller)
        except ControllerError as error:
            raise ParameterError(f"parameter 'controller': {error}") from error
