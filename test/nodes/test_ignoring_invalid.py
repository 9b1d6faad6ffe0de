"""Clients of the nodes ignore what others send them that is no message, or is far too large."""

from __future__ import annotations

import struct

import pytest
from action_msgs.msg import GoalStatus
from nav_msgs.msg import Goals, Odometry
from rcl_interfaces.msg import ParameterEvent
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from support.ros_messages import goal, goals, odometry, value_of

from diffdrive_jacobian.messages.codecs import (
    GOAL_STATUS,
    GOALS,
    JOINT_STATE,
    MOTION,
    PARAMETER_EVENT,
)
from diffdrive_jacobian.messages.conversion import MAX_WAYPOINTS
from diffdrive_jacobian.ros import serialization
from diffdrive_jacobian.ros.serialization import ignoring_invalid


@pytest.mark.parametrize(
    ('codec', 'message'),
    [(GOAL_STATUS, GoalStatus()), (GOALS, Goals()), (MOTION, odometry(1.0, 2.0, 0.0))],
    ids=lambda one: getattr(one, 'type_name', ''),
)
def test_invalid_messages_are_ignored_without_a_word(codec, message, capfd):
    received, refused = [], []
    callback = ignoring_invalid(codec, type(message), received.append, refused.append)
    data = serialize_message(message)
    for invalid in (b'', b'\0\1', b'\0\1\0\0', data[:12], b'\xff' * len(data)):
        callback(invalid)
    assert received == []
    callback(data)
    assert received == [value_of(codec, message)]
    assert refused == []
    assert capfd.readouterr() == ('', '')


def test_an_invalid_value_is_reported():
    received, refused = [], []
    callback = ignoring_invalid(MOTION, Odometry, received.append, refused.append)
    callback(serialize_message(odometry(1e7, 0.0, 0.0)))
    assert received == []
    assert [str(one) for one in refused] == [
        'position must be finite and within 1e+06 m, got x 1e+07, y 0'
    ]


@pytest.mark.parametrize(
    ('codec', 'message'),
    [
        (JOINT_STATE, JointState(name=['a', 'b'], position=[1.0, 2.0], velocity=[1.0, 2.0])),
        (
            PARAMETER_EVENT,
            ParameterEvent(changed_parameters=[Parameter('a', value=[1, 2]).to_parameter_msg()] * 60),
        ),
        (GOALS, goals(goal(1, 0), goal(2, 0))),
    ],
    ids=lambda one: getattr(one, 'type_name', ''),
)
def test_sequences_that_are_cut_off_are_ignored_without_a_word(codec, message, capfd):
    """The code that rclpy generates for a type writes a line for each."""
    received = []
    callback = ignoring_invalid(codec, type(message), received.append)
    data = serialize_message(message)
    # rclpy adds bytes at the end.
    for end in range(0, len(data) // 2, 4):
        callback(data[:end])
    assert received == []
    callback(data)
    assert received == [value_of(codec, message)]
    assert capfd.readouterr() == ('', '')


def test_large_messages_are_ignored_without_a_word(capfd):
    received = []
    callback = ignoring_invalid(MOTION, Odometry, received.append)
    message = odometry(1.0, 2.0, 0.0)
    message.child_frame_id = 'a' * serialization.MAX_SIZE
    callback(serialize_message(message))
    assert received == []
    assert capfd.readouterr() == ('', '')


def test_a_number_of_goals_that_is_too_large_is_not_decoded(monkeypatch, capfd):
    decoded = []

    def deserialize(data, kind):
        decoded.append(data)
        return deserialize_message(data, kind)

    monkeypatch.setattr(serialization, 'deserialize_message', deserialize)
    callback = ignoring_invalid(GOALS, Goals, lambda route: None)
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
