"""The parameters of the three nodes: names, defaults, units, ranges.

A parameter may change while the node runs, unless its description says read-only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from diffdrive_jacobian.control.controller import Controller
from diffdrive_jacobian.control.controllers import BUILT_IN, ControllerError, Controllers
from diffdrive_jacobian.control.controllers import CONTROLLERS as CONTROLLERS
from diffdrive_jacobian.control.saturation import VelocityLimits
from diffdrive_jacobian.messages.plausibility import MAX_POSITION, MAX_SPEED
from diffdrive_jacobian.parameters.declaration import NodeParameters, ParameterError, parameter
from diffdrive_jacobian.parameters.limits import LimitParameters, number_or
from diffdrive_jacobian.simulation.robot import RobotModel
from diffdrive_jacobian.simulation.slip import MAX_SEED, Drift
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.time_units import nanoseconds

MIN_OFFSET = 1e-3
"""Smallest absolute offset (m). The yaw rate of the law is proportional to the inverse of the offset."""
_STAMPED = 'Use TwistStamped instead of Twist for cmd_vel. Read-only.'


def _wheel_radius() -> Any:
    return parameter(0.033, 'Radius of the wheels [m].', bounds=(1e-3, 10.0))


def _wheel_separation() -> Any:
    return parameter(0.16, 'Distance between the left and the right wheel [m].', bounds=(1e-3, 100.0))


def _max_wheel_velocity() -> Any:
    return parameter(
        math.nan,
        'Maximum wheel speed [rad/s]; both are scaled alike, which keeps the curvature; .nan: no limit.',
        bounds=(1e-3, 1e6),
        nan_is_none=True,
    )


def _timeout(default: float, description: str) -> Any:
    return parameter(default, description, bounds=(0.0, 3600.0))


def _multiplier(what: str) -> Any:
    return parameter(1.0, f'Correction factor for the {what} [-].', bounds=(0.1, 10.0))


def _true_multiplier(what: str) -> Any:
    return parameter(
        1.0,
        f'True {what}, relative to the nominal one [-]. Read-only.',
        bounds=(0.1, 10.0),
        read_only=True,
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class VirtualRobotParameters(LimitParameters):
    """Parameters of the node virtual_robot."""

    publish_rate: float = parameter(
        50.0, 'Publishing rate of odom and joint_states [Hz].', bounds=(0.1, 1000.0)
    )
    odom_frame_id: str = parameter('odom', 'Name of the frame of the odometry.')
    base_frame_id: str = parameter('base_link', 'Name of the frame of the robot, at the axle centre.')
    wheel_radius: float = _wheel_radius()
    wheel_separation: float = _wheel_separation()
    max_wheel_velocity: float = _max_wheel_velocity()
    cmd_vel_timeout: float = _timeout(
        0.5, 'Time without a command after which the robot stops [s]; 0: never.'
    )
    x: float = parameter(
        0.0, 'Initial position x, also after a reset [m].', bounds=(-MAX_POSITION, MAX_POSITION)
    )
    y: float = parameter(
        0.0, 'Initial position y, also after a reset [m].', bounds=(-MAX_POSITION, MAX_POSITION)
    )
    theta: float = parameter(
        0.0, 'Initial heading, also after a reset [rad].', bounds=(-math.tau, math.tau)
    )
    wheel_travel_variance: float = parameter(
        1e-5,
        'Variance of the distance travelled by a wheel, per distance [m^2/m].',
        bounds=(0.0, 1.0),
    )
    command_interface: str = parameter(
        'twist',
        'Subscribe to cmd_vel (twist) or to joint_command (wheels). Read-only.',
        choices=('twist', 'wheels'),
        read_only=True,
    )
    enable_stamped_cmd_vel: bool = parameter(False, _STAMPED, read_only=True)
    left_wheel_name: str = parameter('left_wheel_joint', 'Name of the joint of the left wheel.')
    right_wheel_name: str = parameter('right_wheel_joint', 'Name of the joint of the right wheel.')
    enable_odom_tf: bool = parameter(
        True,
        'Publish the transform from odom_frame_id to base_frame_id, if tf2_ros is installed. Read-only.',
        read_only=True,
    )
    simulate_slip: bool = parameter(
        False,
        'Let the wheels slip as wheel_travel_variance says, and publish ground_truth. Read-only.',
        read_only=True,
    )
    slip_seed: int = parameter(
        0, 'Seed of the random slip. Read-only.', bounds=(0, MAX_SEED), read_only=True
    )
    true_left_wheel_radius_multiplier: float = _true_multiplier('radius of the left wheel')
    true_right_wheel_radius_multiplier: float = _true_multiplier('radius of the right wheel')
    true_wheel_separation_multiplier: float = _true_multiplier('wheel separation')
    ground_truth_frame_id: str = parameter('map', 'Name of the frame of ground_truth.')

    def check(self) -> None:
        """Raise ParameterError if the names of the wheels or of the frames are equal."""
        _differ('left_wheel_name', self.left_wheel_name, 'right_wheel_name', self.right_wheel_name)
        _differ('odom_frame_id', self.odom_frame_id, 'base_frame_id', self.base_frame_id)
        if self.drift() is not None:
            truth = 'ground_truth_frame_id', self.ground_truth_frame_id
            _differ(*truth, 'odom_frame_id', self.odom_frame_id)
            _differ(*truth, 'base_frame_id', self.base_frame_id)

    @property
    def wheel_names(self) -> tuple[str, str]:
        """Names of the left and the right wheel joint, in the order of messages."""
        return self.left_wheel_name, self.right_wheel_name

    def limits(self) -> VelocityLimits:
        """Return the limits of the twist and of the wheel speed."""
        max_wheel_speed = number_or(self.max_wheel_velocity, math.inf)
        return replace(self.twist_limits(), max_wheel_speed=max_wheel_speed)

    def model(self) -> RobotModel:
        """Return the model of the robot with these parameters."""
        return RobotModel(
            wheel_radius=self.wheel_radius,
            wheel_separation=self.wheel_separation,
            limits=self.limits(),
            command_timeout=nanoseconds(self.cmd_vel_timeout),
            wheel_travel_variance=self.wheel_travel_variance,
            drift=self.drift(),
        )

    def drift(self) -> Drift | None:
        """Return in what the true motion differs from the odometry; None: in nothing."""
        drift = Drift(
            seed=self.slip_seed if self.simulate_slip else None,
            right_wheel_radius_multiplier=self.true_right_wheel_radius_multiplier,
            left_wheel_radius_multiplier=self.true_left_wheel_radius_multiplier,
            wheel_separation_multiplier=self.true_wheel_separation_multiplier,
        )
        return None if drift == Drift() else drift


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
    odom_timeout: float = _timeout(
        0.5,
        'Time without odometry after which the robot stops, until it returns [s]; 0: never.',
    )
    enable_stamped_cmd_vel: bool = parameter(False, _STAMPED, read_only=True)

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


@dataclass(frozen=True, kw_only=True, slots=True)
class WheelBridgeParameters(NodeParameters):
    """Parameters of the node wheel_bridge."""

    wheel_radius: float = _wheel_radius()
    wheel_separation: float = _wheel_separation()
    wheel_separation_multiplier: float = _multiplier('wheel separation')
    left_wheel_radius_multiplier: float = _multiplier('radius of the left wheel')
    right_wheel_radius_multiplier: float = _multiplier('radius of the right wheel')
    max_wheel_velocity: float = _max_wheel_velocity()
    cmd_vel_timeout: float = _timeout(
        0.5, 'Time without a command after which the wheels are stopped [s]; 0: never.'
    )
    left_wheel_name: str = parameter('left_wheel_joint', 'Name of the joint of the left wheel.')
    right_wheel_name: str = parameter('right_wheel_joint', 'Name of the joint of the right wheel.')
    joint_command_type: str = parameter(
        'JointState',
        'Type of joint_command: JointState, or Float64MultiArray with [left, right]. Read-only.',
        choices=('JointState', 'Float64MultiArray'),
        read_only=True,
    )
    enable_stamped_cmd_vel: bool = parameter(False, _STAMPED, read_only=True)

    def check(self) -> None:
        """Raise ParameterError if the names of the wheels are equal."""
        _differ('left_wheel_name', self.left_wheel_name, 'right_wheel_name', self.right_wheel_name)

    @property
    def wheel_names(self) -> tuple[str, str]:
        """Names of the left and the right wheel joint, in the order of messages."""
        return self.left_wheel_name, self.right_wheel_name

    @property
    def wheel_speed_limit(self) -> float:
        """The limit of the wheel speeds (rad/s); infinite: none."""
        return number_or(self.max_wheel_velocity, math.inf)


NODE_PARAMETERS = (VirtualRobotParameters, GoToGoalParameters, WheelBridgeParameters)
"""The parameters of all nodes of this package."""


def _differ(first: str, value: str, second: str, other: str) -> None:
    if value == other:
        raise ParameterError(
            f"parameters '{first}' and '{second}' must differ, both are '{printable(value)}'"
        )
