"""The serialized messages that the nodes receive and publish."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist, TwistStamped
from hypothesis import given, settings
from hypothesis import strategies as st
from lockstep_nodes import change, make
from nav_msgs.msg import Odometry
from rclpy.serialization import deserialize_message, serialize_message
from ros_messages import joint_command, odometry, twist, twist_stamped
from sensor_msgs.msg import JointState

from diffdrive_jacobian.control.controller import Controller
from diffdrive_jacobian.messages import conversion, wire
from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.parameters.nodes import GoToGoalParameters
from diffdrive_jacobian.ros.serialization import reader

INPUTS = [
    (VirtualRobot, {}, Twist, 'cmd_vel'),
    (VirtualRobot, {'enable_stamped_cmd_vel': True}, TwistStamped, 'cmd_vel'),
    (VirtualRobot, {'command_interface': 'wheels'}, JointState, 'joint_command'),
    (VirtualRobot, {}, PoseWithCovarianceStamped, 'initialpose'),
    (GoToGoal, {}, Odometry, 'odom'),
    (GoToGoal, {}, PoseStamped, 'goal_pose'),
    (WheelBridge, {}, Twist, 'cmd_vel'),
    (WheelBridge, {'enable_stamped_cmd_vel': True}, TwistStamped, 'cmd_vel'),
]


@pytest.mark.parametrize(('node_class', 'parameters', 'message_class', 'topic'), INPUTS)
def test_bytes_that_are_no_message_are_dropped_and_named(
    lockstep, capfd, node_class, parameters, message_class, topic
):
    lockstep.add(make(node_class, **parameters))
    publisher = lockstep.node.create_publisher(message_class, topic, 10)
    valid = serialize_message(message_class())
    for data in (b'', valid[:3], valid[:-12], b'\0\1\0\0' + b'\xff' * 40, b'\1\2' + valid[2:]):
        publisher.publish(data)
        lockstep.settle()
    # The log is throttled, and the node goes on.
    words = f'{topic} dropped: it is not a {message_class.__name__} message'
    assert capfd.readouterr().err.count(words) == 1
    lockstep.run_for(0.1)


def big_endian(message):
    """Serialize a message of doubles only, in the other byte order."""
    data = serialize_message(message)
    count = (len(data) - 4) // 8
    return b'\0\0\0\0' + struct.pack(f'>{count}d', *struct.unpack_from(f'<{count}d', data, 4))


def test_a_command_of_a_big_endian_machine_is_followed(lockstep):
    applied = lockstep.listen(TwistStamped, 'cmd_vel_out')
    lockstep.add(make(VirtualRobot))
    lockstep.node.create_publisher(Twist, 'cmd_vel', 10).publish(big_endian(twist(0.5, -0.25)))
    lockstep.settle()
    assert (applied[-1].twist.linear.x, applied[-1].twist.angular.z) == (0.5, -0.25)


def test_names_change_with_the_parameters(lockstep):
    odom, states = lockstep.listen(Odometry, 'odom'), lockstep.listen(JointState, 'joint_states')
    applied = lockstep.listen(TwistStamped, 'cmd_vel_out')
    robot = lockstep.add(make(VirtualRobot))
    names = {'odom': 'odom', 'base': 'base_link', 'wheels': ['left_wheel_joint', 'right_wheel_joint']}
    for changes in (
        {},
        {'odom_frame_id': 'Ö', 'base_frame_id': 'ein längerer Name'},
        {'left_wheel_name': 'l', 'right_wheel_name': 'räder rechts'},
    ):
        assert not changes or change(robot, **changes).successful
        names['odom'] = changes.get('odom_frame_id', names['odom'])
        names['base'] = changes.get('base_frame_id', names['base'])
        if 'left_wheel_name' in changes:
            names['wheels'] = [changes['left_wheel_name'], changes['right_wheel_name']]
        lockstep.publish('cmd_vel', twist(0.5, 0.25))
        lockstep.run_for(0.05)
        assert (odom[-1].header.frame_id, odom[-1].child_frame_id) == (names['odom'], names['base'])
        assert applied[-1].header.frame_id == names['base']
        assert list(states[-1].name) == names['wheels']


@pytest.mark.parametrize('message', [Odometry(), odometry(1.0, -2.0, 0.5, frame='Karte ä')])
def test_the_fields_of_an_odometry_are_its_frame_and_pose(message):
    frame, *pose = reader(Odometry, wire.ODOMETRY)(serialize_message(message))
    assert frame == message.header.frame_id
    expected = conversion.from_pose(message.pose.pose)
    np.testing.assert_array_equal(conversion.from_pose_values(*pose), expected)


def test_the_fields_of_commands_are_their_stamp_and_content():
    sec, nanosec, *components = reader(TwistStamped, wire.TWIST_STAMPED)(
        serialize_message(twist_stamped(0.5, 0.25, 1_500_000_000))
    )
    assert conversion.from_time_values(sec, nanosec) == 1_500_000_000
    assert conversion.from_twist_values(*components) == (0.5, 0.25)
    message = joint_command(2.0, 3.0, 2_500_000_000)
    fields = reader(JointState, wire.JOINT_STATE)(serialize_message(message))
    assert fields == (2, 500_000_000, tuple(message.name), (2.0, 3.0))
    assert conversion.from_joint_values(*fields[2:], tuple(message.name)) == (3.0, 2.0)


@settings(max_examples=100, deadline=None)
@given(values=st.lists(st.floats(), min_size=6, max_size=6))
def test_twists_are_read_from_numbers_as_from_a_message(values):
    message = Twist()
    for (path, axis), value in zip(
        [(a, b) for a in ('linear', 'angular') for b in 'xyz'], values, strict=True
    ):
        setattr(getattr(message, path), axis, value)
    outcomes = []
    for function, arguments in (
        (conversion.from_twist, [message]),
        (conversion.from_twist_values, values),
    ):
        try:
            outcomes.append(function(*arguments))
        except MessageError as error:
            outcomes.append(str(error))
    assert outcomes[0] == outcomes[1]
    plausible = all(map(math.isfinite, values)) and max(abs(values[0]), abs(values[5])) <= 1e3
    assert isinstance(outcomes[0], tuple) == plausible


def test_components_whose_sum_overflows_are_finite():
    assert conversion.from_twist_values(0.5, 1e308, 1e308, 1e308, 1e308, -0.25) == (0.5, -0.25)
    with pytest.raises(MessageError, match='twist must be within'):
        conversion.from_twist_values(1e308, 1e308, 0.0, 0.0, 0.0, 0.0)


def test_twists_that_are_published_are_those_of_rclpy_byte_for_byte():
    message = twist(0.125, -3.5)
    assert wire.twist_writer(Twist())(0.125, -3.5) == serialize_message(message)
    data = wire.twist_stamped_writer(TwistStamped())((0.125, -3.5), 7_000_000_008)
    expected = TwistStamped(twist=message)
    expected.header.stamp.sec, expected.header.stamp.nanosec = 7, 8
    assert deserialize_message(data, TwistStamped) == expected


def test_laws_of_other_packages_receive_arrays():
    seen = []

    def law(pose, goal, kp, kv):
        seen.append((pose, goal))
        return 0.0, 0.0

    Controller(name='own', law=law).bind(GoToGoalParameters())((1.0, 2.0, 0.5), (3.0, 4.0, 0.0))
    ((pose, goal),) = seen
    assert isinstance(pose, np.ndarray)
    assert isinstance(goal, np.ndarray)
    assert (pose.tolist(), goal.tolist()) == ([1.0, 2.0, 0.5], [3.0, 4.0])
