"""Every parameter of the three nodes: name, default, unit, range. What does not say read-only may
change while the node runs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from diffdrive_jacobian.control.saturation import VelocityLimits
from diffdrive_jacobian.messages.plausibility import MAX_POSITION, MAX_SPEED
from diffdrive_jacobian.parameters.declaration import NodeParameters, ParameterError, parameter
from diffdrive_jacobian.simulation.robot import RobotModel
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.time_units import nanoseconds

CONTROLLERS = ('go_to_goal', 'offset_point', 'pose')
MIN_OFFSET = 1e-3
"""The yaw rate of document B's law grows like the inverse of the offset (m)."""
_STAMPED = 'cmd_vel is a TwistStamped instead of a Twist. Read-only.'


@dataclass(frozen=True, kw_only=True, slots=True)
class LimitParameters(NodeParameters):
    """Limits of the body twist, named as diff_drive_controller names them."""

    linear_x_max_velocity: float = parameter(
        math.nan,
        'Fastest forward speed [m/s]; .nan: none.',
        name='linear.x.max_velocity',
        bounds=(0.0, MAX_SPEED),
        nan_is_none=True,
    )
    linear_x_min_velocity: float = parameter(
        math.nan,
        'Fastest reverse speed, zero or negative [m/s]; .nan: as fast as forward.',
        name='linear.x.min_velocity',
        bounds=(-MAX_SPEED, 0.0),
        nan_is_none=True,
    )
    angular_z_max_velocity: float = parameter(
        math.nan,
        'Fastest counter-clockwise yaw rate [rad/s]; .nan: none.',
        name='angular.z.max_velocity',
        bounds=(0.0, MAX_SPEED),
        nan_is_none=True,
    )
    angular_z_min_velocity: float = parameter(
        math.nan,
        'Fastest clockwise yaw rate, zero or negative [rad/s]; .nan: as fast as counter-clockwise.',
        name='angular.z.min_velocity',
        bounds=(-MAX_SPEED, 0.0),
        nan_is_none=True,
    )

    def limits(self, *, without: float = math.inf, max_wheel_speed: float = math.nan) -> VelocityLimits:
        """Gather the limits, as diff_drive_controller reads them.

        Args:
            without: In the place of a limit that is not set (m/s, rad/s).
            max_wheel_speed: Limit of the wheels; NaN: none (rad/s).
        """
        max_v = _or(self.linear_x_max_velocity, without)
        max_omega = _or(self.angular_z_max_velocity, without)
        return VelocityLimits(
            min_v=_or(self.linear_x_min_velocity, -max_v),
            max_v=max_v,
            min_omega=_or(self.angular_z_min_velocity, -max_omega),
            max_omega=max_omega,
            max_wheel_speed=_or(max_wheel_speed, math.inf),
        )


def _or(value: float, otherwise: float) -> float:
    return otherwise if math.isnan(value) else value


def _wheel_radius() -> Any:
    return parameter(0.033, 'Wheel radius [m].', bounds=(1e-3, 10.0))


def _wheel_separation() -> Any:
    return parameter(0.16, 'Wheel separation, also called track width [m].', bounds=(1e-3, 100.0))


def _max_wheel_velocity() -> Any:
    return parameter(
        math.nan,
        'Fastest speed of either wheel [rad/s]; both are slowed alike, so the path stays; .nan: none.',
        bounds=(1e-3, 1e6),
        nan_is_none=True,
    )


def _timeout(default: float, description: str) -> Any:
    return parameter(default, description, bounds=(0.0, 3600.0))


def _multiplier(what: str) -> Any:
    return parameter(1.0, f'Calibration factor on the {what} [-].', bounds=(0.1, 10.0))


@dataclass(frozen=True, kw_only=True, slots=True)
class VirtualRobotParameters(LimitParameters):
    """Parameters of the node virtual_robot."""

    publish_rate: float = parameter(50.0, 'Rate of odom and joint_states [Hz].', bounds=(0.1, 1000.0))
    odom_frame_id: str = parameter('odom', 'Frame in which the pose is given.')
    base_frame_id: str = parameter('base_link', 'Frame of the robot, on the axle centre.')
    wheel_radius: float = _wheel_radius()
    wheel_separation: float = _wheel_separation()
    max_wheel_velocity: float = _max_wheel_velocity()
    cmd_vel_timeout: float = _timeout(
        0.5, 'A command is held this long, then the robot stops [s]; 0: for ever.'
    )
    x: float = parameter(
        0.0, 'Position at the start and after a reset [m].', bounds=(-MAX_POSITION, MAX_POSITION)
    )
    y: float = parameter(
        0.0, 'Position at the start and after a reset [m].', bounds=(-MAX_POSITION, MAX_POSITION)
    )
    theta: float = parameter(
        0.0, 'Heading at the start and after a reset [rad].', bounds=(-math.tau, math.tau)
    )
    wheel_travel_variance: float = parameter(
        1e-5, 'Variance of each wheel, per way: m^2 for each m [m].', bounds=(0.0, 1.0)
    )
    command_interface: str = parameter(
        'twist',
        'Drive from cmd_vel (twist) or from joint_command (wheels). Read-only.',
        choices=('twist', 'wheels'),
        read_only=True,
    )
    enable_stamped_cmd_vel: bool = parameter(False, _STAMPED, read_only=True)
    left_wheel_name: str = parameter('left_wheel_joint', 'Joint of the left wheel.')
    right_wheel_name: str = parameter('right_wheel_joint', 'Joint of the right wheel.')
    enable_odom_tf: bool = parameter(
        True,
        'Broadcast odom -> base on /tf, where tf2_ros is installed. Read-only.',
        read_only=True,
    )

    def check(self) -> None:
        """Wheels and frames must be told apart."""
        _differ('left_wheel_name', self.left_wheel_name, 'right_wheel_name', self.right_wheel_name)
        _differ('odom_frame_id', self.odom_frame_id, 'base_frame_id', self.base_frame_id)

    def model(self) -> RobotModel:
        """Give the robot that they describe."""
        return RobotModel(
            wheel_radius=self.wheel_radius,
            wheel_separation=self.wheel_separation,
            limits=self.limits(max_wheel_speed=self.max_wheel_velocity),
            command_timeout=nanoseconds(self.cmd_vel_timeout),
            wheel_travel_variance=self.wheel_travel_variance,
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class GoToGoalParameters(LimitParameters):
    """Parameters of the node go_to_goal."""

    kp: float = parameter(
        3.0, 'Gain on the heading error [1/s]; larger than kv.', bounds=(0.0, 100.0), above=0.0
    )
    kv: float = parameter(0.5, 'Gain on the distance [1/s].', bounds=(0.0, 100.0), above=0.0)
    controller: str = parameter(
        'go_to_goal',
        "Control law: go_to_goal (document A's), offset_point (document B's), or pose, with heading.",
        choices=CONTROLLERS,
    )
    offset: float = parameter(
        0.1,
        'Of controller offset_point: how far ahead of the axle the point is that is driven; not 0 [m].',
        bounds=(-100.0, 100.0),
    )
    xy_goal_tolerance: float = parameter(
        0.02, 'Distance to the goal that counts as arrived [m].', bounds=(1e-6, 100.0)
    )
    yaw_goal_tolerance: float = parameter(
        0.02, 'Heading error that counts as arrived [rad].', bounds=(1e-6, math.pi)
    )
    use_goal_heading: bool = parameter(False, 'Turn to the heading of the last waypoint at the end.')
    odom_timeout: float = _timeout(
        0.5, 'Odometry older than this stops the robot until it comes again [s]; 0: never.'
    )
    enable_stamped_cmd_vel: bool = parameter(False, _STAMPED, read_only=True)

    def check(self) -> None:
        """The point that is driven must stand off the axle."""
        if abs(self.offset) < MIN_OFFSET:
            raise ParameterError(
                f"parameter 'offset' must be at least {MIN_OFFSET:g} m ahead of the axle or behind it, "
                f'got {self.offset:g}: the Jacobian of the axle centre itself has rank 1'
            )


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
        0.5, 'Without a command for this long the wheels are stopped [s]; 0: never.'
    )
    left_wheel_name: str = parameter('left_wheel_joint', 'Joint of the left wheel.')
    right_wheel_name: str = parameter('right_wheel_joint', 'Joint of the right wheel.')
    joint_command_type: str = parameter(
        'JointState',
        'Type of joint_command: JointState, or Float64MultiArray with [left, right]. Read-only.',
        choices=('JointState', 'Float64MultiArray'),
        read_only=True,
    )
    enable_stamped_cmd_vel: bool = parameter(False, _STAMPED, read_only=True)

    def check(self) -> None:
        """Wheels must be told apart."""
        _differ('left_wheel_name', self.left_wheel_name, 'right_wheel_name', self.right_wheel_name)

    @property
    def fastest_wheel(self) -> float:
        """The limit of the wheel speeds (rad/s), infinite if there is none."""
        return _or(self.max_wheel_velocity, math.inf)


def _differ(first: str, value: str, second: str, other: str) -> None:
    if value == other:
        raise ParameterError(
            f"parameters '{first}' and '{second}' must differ, both are '{printable(value)}'"
        )
