"""Clients of the nodes ignore what others send them that is no message, or is far too large."""

from __future__ import annotations

import struct

import pytest
from action_msgs.msg import GoalStatus
from nav_msgs.msg import Goals, Odometry
from rcl_interfaces.msg import ParameterEvent
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from ros_messages import goal, goals, odometry
from sensor_msgs.msg import JointState

from diffdrive_jacobian.messages.conversion import MAX_WAYPOINTS
from diffdrive_jacobian.ros import serialization
from diffdrive_jacobian.ros.goal_client import ODOMETRY
from diffdrive_jacobian.ros.serialization import ignoring_invalid


@pytest.mark.parametrize('kind', [GoalStatus, Goals, Odometry])
def test_invalid_messages_are_ignored_without_a_word(kind, capfd):
    received = []
    callback = ignoring_invalid(kind, received.append)
    data = serialize_message(kind())
    for invalid in (b'', b'\0\1', b'\0\1\0\0', data[:12], b'\xff' * len(data)):
        callback(invalid)
    assert received == []
    callback(data)
    assert received == [kind()]
    assert capfd.readouterr() == ('', '')


@pytest.mark.parametrize(
    'message',
    [
        JointState(name=['a', 'b'], position=[1.0, 2.0], velocity=[1.0, 2.0]),
        ParameterEvent(changed_parameters=[Parameter('a', value=[1, 2]).to_parameter_msg()] * 100),
        goals(goal(1, 0), goal(2, 0)),
    ],
    ids=lambda message: type(message).__name__,
)
def test_sequences_that_are_cut_off_are_ignored_without_a_word(message, capfd):
    """The code that rclpy generates for a type writes a line for each."""
    received = []
    callback = ignoring_invalid(type(message), received.append)
    data = serialize_message(message)
    # rclpy adds bytes at the end.
    for end in range(0, len(data) // 2, 4):
        callback(data[:end])
    assert received == []
    callback(data)
    assert received == [message]
    assert capfd.readouterr() == ('', '')


def test_fields_of_invalid_messages_are_not_read(capfd):
    received = []
    callback = ignoring_invalid(Odometry, lambda *values: received.append(values), ODOMETRY)
    message = odometry(1.0, 2.0, 0.0)
    data = serialize_message(message)
    for invalid in (b'', b'\0\1', b'\0\1\0\0', data[:60], b'\xff' * len(data)):
        callback(invalid)
    message.child_frame_id = 'a' * serialization.MAX_SIZE
    callback(serialize_message(message))
    assert received == []
    callback(data)
    assert received == [(0, 0, 0.0, 0.0, 1.0, 2.0, 0.0, 0.0, 0.0, 1.0)]
    assert capfd.readouterr() == ('', '')


def test_a_number_of_goals_that_is_too_large_is_not_decoded(monkeypatch, capfd):
    decoded = []
    monkeypatch.setattr(serialization, 'deserialize_message', lambda data, kind: decoded.append(data))
    callback = ignoring_invalid(Goals, lambda message: None)
    data = bytearray(serialize_message(goals(goal(1, 0))))
    at = data.index(struct.pack('<I', 1), 12)
    for number in (MAX_WAYPOINTS + 1, 2**31, 2**32 - 1):
        struct.pack_into('<I', data, at, number)
        callback(bytes(data))
    callback(serialize_message(Odometry(child_frame_id='a' * serialization.MAX_SIZE)))
    assert decoded == []
    callback(serialize_message(goals(*[goal(1, 0)] * MAX_WAYPOINTS)))
    assert len(decoded) == 1
    assert capfd.readouterr() == ('', '')
