"""Conversion of the messages of a run to rows of numbers, as the nodes read them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any

from diffdrive_jacobian.messages.conversion import (
    MAX_WAYPOINTS,
    MessageError,
    from_joint_state,
    from_pose,
    from_time,
    from_twist,
)

Rows = Iterator[tuple[int, list[float]]]
"""Stamp (ns; 0: none) and values."""


def _twist(message: Any, _: tuple[str, str]) -> Rows:
    yield 0, list(from_twist(message))


def _twist_stamped(message: Any, _: tuple[str, str]) -> Rows:
    yield from_time(message.header.stamp), list(from_twist(message.twist))


def _odometry(message: Any, _: tuple[str, str]) -> Rows:
    pose, twist = from_pose(message.pose.pose), from_twist(message.twist.twist)
    of_twist = message.twist.covariance
    covariances = [*_planar(message.pose.covariance), of_twist[0], of_twist[5], of_twist[35]]
    yield from_time(message.header.stamp), [*pose.tolist(), *twist, *covariances]


def _ground_truth(message: Any, names: tuple[str, str]) -> Rows:
    for stamp, values in _odometry(message, names):
        yield stamp, values[:5]


def _pose(message: Any, _: tuple[str, str]) -> Rows:
    yield from_time(message.header.stamp), from_pose(message.pose).tolist()


def _pose_with_covariance(message: Any, _: tuple[str, str]) -> Rows:
    pose = from_pose(message.pose.pose).tolist()
    yield from_time(message.header.stamp), [*pose, *_planar(message.pose.covariance)]


def _planar(covariance: Any) -> list[float]:
    """Return the entries xx, xy, xt, yy, yt, tt of the covariance of a pose."""
    return [covariance[index] for index in (0, 1, 5, 7, 11, 35)]


def _goals(message: Any, _: tuple[str, str]) -> Rows:
    if len(message.goals) > MAX_WAYPOINTS:
        raise MessageError(f'goals must contain at most {MAX_WAYPOINTS} poses, got {len(message.goals)}')
    stamp = from_time(message.header.stamp)
    for goal in message.goals:
        yield stamp, from_pose(goal.pose).tolist()


def _status(message: Any, _: tuple[str, str]) -> Rows:
    yield from_time(message.goal_info.stamp), [float(message.status)]


def _joints(message: Any, names: tuple[str, str]) -> Rows:
    yield from_time(message.header.stamp), list(from_joint_state(message, names))


def fault_event(message: Any) -> tuple[str, str]:
    """Return the fault, as Python source, and what it did, of a message of `Lockstep.inject`.

    Raises:
        MessageError: It is another message.
    """
    try:
        fields = json.loads(message.data)
        fault, what = fields['fault'], fields['what']
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise MessageError('it must be a JSON object with fault and what') from error
    if not isinstance(fault, str) or not isinstance(what, str):
        raise MessageError('fault and what must be strings')
    return fault, what


ROW_READERS: dict[tuple[str, str], Callable[[Any, tuple[str, str]], Rows]] = {
    ('cmd_vel', 'geometry_msgs/msg/Twist'): _twist,
    ('cmd_vel', 'geometry_msgs/msg/TwistStamped'): _twist_stamped,
    ('cmd_vel_out', 'geometry_msgs/msg/TwistStamped'): _twist_stamped,
    ('odom', 'nav_msgs/msg/Odometry'): _odometry,
    ('ground_truth', 'nav_msgs/msg/Odometry'): _ground_truth,
    ('start_pose', 'geometry_msgs/msg/PoseWithCovarianceStamped'): _pose_with_covariance,
    ('goal_pose', 'geometry_msgs/msg/PoseStamped'): _pose,
    ('goals', 'nav_msgs/msg/Goals'): _goals,
    ('goal_status', 'action_msgs/msg/GoalStatus'): _status,
    ('joint_command', 'sensor_msgs/msg/JointState'): _joints,
    ('joint_states', 'sensor_msgs/msg/JointState'): _joints,
}
"""Topic's base name and type to the function that reads a message, given the names of the left and the
right wheel joint. The functions raise MessageError for messages that the nodes drop."""
PARAMETER_EVENTS = ('parameter_events', 'rcl_interfaces/msg/ParameterEvent')
FAULT_EVENTS = ('fault_events', 'std_msgs/msg/String')
OF_ALL_ROBOTS = (PARAMETER_EVENTS[0], FAULT_EVENTS[0])
"""Topics that all robots of a bag share."""
SERIES_TOPICS = {
    'odometry': ('odom',),
    'ground_truth': ('ground_truth',),
    'cmd_vel': ('cmd_vel',),
    'cmd_vel_out': ('cmd_vel_out',),
    'start_pose': ('start_pose',),
    'wheel_commands': ('joint_command',),
    'wheels': ('joint_states',),
    'goals': ('goal_pose', 'goals'),
    'goal_status': ('goal_status',),
}
"""Field of `Run` to its topics."""
