"""The serialized messages of the nodes: which fields they read, and how their messages are written.

A writer is made from a message whose strings and lengths are those of all messages that it writes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    # The classes come from the nodes.
    from geometry_msgs.msg import PoseWithCovarianceStamped, Twist, TwistStamped
    from nav_msgs.msg import Odometry
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Float64MultiArray

from diffdrive_jacobian.messages.cdr import Writer
from diffdrive_jacobian.simulation.robot import Robot
from diffdrive_jacobian.time_units import NANOSECONDS

STAMP = ('header.stamp.sec', 'header.stamp.nanosec')
TWIST = ('linear.x', 'linear.y', 'linear.z', 'angular.x', 'angular.y', 'angular.z')
"""Fields of a Twist for `from_twist_values`."""
TWIST_STAMPED = (*STAMP, *(f'twist.{one}' for one in TWIST))
"""Fields of a TwistStamped: stamp, twist."""
JOINT_STATE = (*STAMP, 'name', 'velocity')
"""Fields of a JointState: stamp, names and velocities of the joints."""
_POSE = ('position.x', 'position.y', *(f'orientation.{one}' for one in 'xyzw'))
ODOMETRY = ('header.frame_id', *(f'pose.pose.{one}' for one in _POSE))
"""Fields of an Odometry: frame, and the pose for `from_pose_values`."""
GOALS = (*STAMP, 'len(goals)')
"""Fields of a Goals message: stamp and number of poses."""

# (x, y, yaw) and (v, omega) in the row-major 6x6 covariances of ROS.
_PLANAR = [6 * row + column for row in (0, 1, 5) for column in (0, 1, 5)]
_FORWARD_AND_YAW = [6 * row + column for row in (0, 5) for column in (0, 5)]
_POSE_WITH_COVARIANCE = (
    *(f'pose.pose.{one}' for one in ('position.x', 'position.y', 'orientation.z', 'orientation.w')),
    *(f'pose.covariance[{index}]' for index in _PLANAR),
)

WheelWriter: TypeAlias = Callable[[int, tuple[float, float]], bytes]
"""Serializes wheel speeds `(omega_R, omega_L)` (rad/s) at a time (ns)."""


def odometry_writer(message: Odometry) -> Callable[[Robot, float], bytes]:
    """Return a function that serializes pose, twist and covariances of a robot.

    Its second argument is the time over which the wheels measured the twist (s).
    """
    write = Writer(
        message,
        [
            *STAMP,
            *_POSE_WITH_COVARIANCE,
            *('twist.twist.linear.x', 'twist.twist.angular.z'),
            *(f'twist.covariance[{index}]' for index in _FORWARD_AND_YAW),
        ],
    )

    def written(robot: Robot, interval: float) -> bytes:
        x, y, theta = robot.pose_tuple
        return write(
            *divmod(robot.stamp, NANOSECONDS),
            x,
            y,
            math.sin(theta / 2.0),
            math.cos(theta / 2.0),
            *robot.covariance_tuple,
            *robot.twist,
            *robot.twist_covariance_tuple(interval),
        )

    return written


def ground_truth_writer(message: Odometry) -> Callable[[Robot], bytes]:
    """Return a function that serializes the true pose and twist of a robot, without covariances."""
    twist = 'twist.twist.linear.x', 'twist.twist.angular.z'
    write = Writer(message, [*STAMP, *_POSE_WITH_COVARIANCE[:4], *twist])

    def written(robot: Robot) -> bytes:
        x, y, theta = robot.true_pose_tuple
        return write(
            *divmod(robot.stamp, NANOSECONDS),
            x,
            y,
            math.sin(theta / 2.0),
            math.cos(theta / 2.0),
            *robot.true_twist,
        )

    return written


def start_pose_writer(message: PoseWithCovarianceStamped) -> Callable[[Robot], bytes]:
    """Return a function that serializes the pose of a robot and its covariance."""
    write = Writer(message, [*STAMP, *_POSE_WITH_COVARIANCE])

    def written(robot: Robot) -> bytes:
        x, y, theta = robot.pose_tuple
        return write(
            *divmod(robot.stamp, NANOSECONDS),
            x,
            y,
            math.sin(theta / 2.0),
            math.cos(theta / 2.0),
            *robot.covariance_tuple,
        )

    return written


def twist_writer(message: Twist) -> Callable[[float, float], bytes]:
    """Return a function that serializes a twist `v, omega` (m/s, rad/s)."""
    return Writer(message, ['linear.x', 'angular.z'])


def twist_stamped_writer(message: TwistStamped) -> Callable[[tuple[float, float], int], bytes]:
    """Return a function that serializes a twist `(v, omega)` (m/s, rad/s) and its time (ns)."""
    write = Writer(message, [*STAMP, 'twist.linear.x', 'twist.angular.z'])

    def written(twist: tuple[float, float], stamp: int) -> bytes:
        return write(*divmod(stamp, NANOSECONDS), *twist)

    return written


def joint_state_writer(
    message: JointState,
) -> Callable[[int, tuple[float, float], tuple[float, float]], bytes]:
    """Return a function that serializes the motion of the wheels.

    Its arguments are the time (ns), the speeds `(omega_R, omega_L)` (rad/s) and the angles of the right
    and the left wheel (rad). The message names the joints left, right.
    """
    message.position, message.velocity = [0.0, 0.0], [0.0, 0.0]
    write = Writer(message, [*STAMP, 'position', 'velocity'])

    def written(stamp: int, speeds: tuple[float, float], angles: tuple[float, float]) -> bytes:
        return write(*divmod(stamp, NANOSECONDS), angles[1], angles[0], speeds[1], speeds[0])

    return written


def joint_command_writer(message: JointState) -> WheelWriter:
    """Return a function that serializes wheel speeds. The message names the joints left, right."""
    message.velocity = [0.0, 0.0]
    write = Writer(message, [*STAMP, 'velocity'])

    def written(stamp: int, speeds: tuple[float, float]) -> bytes:
        return write(*divmod(stamp, NANOSECONDS), speeds[1], speeds[0])

    return written


def wheel_array_writer(message: Float64MultiArray) -> WheelWriter:
    """Return a function that serializes wheel speeds as `[left, right]`, without the time."""
    message.data = [0.0, 0.0]
    write = Writer(message, ['data'])

    def written(_: int, speeds: tuple[float, float]) -> bytes:
        return write(speeds[1], speeds[0])

    return written
