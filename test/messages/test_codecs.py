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

"""The serialized messages that the nodes receive and publish, and the values that are refused."""

from __future__ import annotations

import dataclasses
import math
import re

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist, TwistStamped
from hypothesis import given, settings
from hypothesis import strategies as st
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import ParameterEvent
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from support.lockstep_nodes import make
from support.ros_messages import goal, goals, odometry, path, pose_of, twist_stamped, value_of

from diffdrive_jacobian.bags.message_definitions import (
    is_known,
    known_structure,
    message_class,
)
from diffdrive_jacobian.bags.run import Run
from diffdrive_jacobian.messages.codecs import (
    GOALS,
    JOINT_STATE,
    ODOMETRY,
    ODOMETRY_STATE,
    PARAMETER_EVENT,
    PATH,
    POSE,
    POSE_WITH_COVARIANCE,
    TWIST,
    TWIST_STAMPED,
    WHEEL_ARRAY,
    Command,
    GoalError,
    Motion,
    Place,
    WheelArray,
    Wheels,
)
from diffdrive_jacobian.messages.conversion import (
    MessageError,
    from_covariance,
    from_joints,
    from_pose,
    from_twist,
)
from diffdrive_jacobian.messages.topics import TABLES, TOPICS
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot


def test_bytes_that_are_no_message_are_dropped_and_named(lockstep, capfd):
    lockstep.add(make(VirtualRobot))
    publisher = lockstep.node.create_publisher(Twist, 'cmd_vel', 10)
    valid = serialize_message(Twist())
    for data in (b'', valid[:-12], b'\0\1\0\0' + b'\xff' * 40, b'\1\2' + valid[2:]):
        publisher.publish(data)
        lockstep.settle()
    # The log is throttled, and the node goes on.
    words = 'cmd_vel dropped: it is not a Twist message'
    assert capfd.readouterr().err.count(words) == 1
    lockstep.run_for(0.1)


# --- Written and read

times = st.integers(0, 2**31 * 10**9 - 1)
numbers = st.floats(-1e3, 1e3)
pairs = st.tuples(numbers, numbers)
# The heading is read from a quaternion.
poses = st.tuples(numbers, numbers, st.sampled_from([0.0, 0.5, -3.0, math.pi]))
spreads = st.tuples(*[numbers] * 9)
WRITTEN = [
    (TWIST, Twist(), st.builds(Command, pairs)),
    (TWIST_STAMPED, TwistStamped(), st.builds(Command, pairs, times)),
    (
        ODOMETRY,
        Odometry(),
        st.builds(Motion, times, poses, pairs, spreads, st.tuples(*[numbers] * 4)),
    ),
    (
        POSE_WITH_COVARIANCE,
        PoseWithCovarianceStamped(),
        st.builds(Place, times, poses, spreads),
    ),
    (
        JOINT_STATE,
        JointState(name=['l', 'r'], position=[0.0, 0.0], velocity=[0.0, 0.0]),
        st.builds(Wheels.of, times, st.just(('l', 'r')), pairs, pairs),
    ),
    (WHEEL_ARRAY, Float64MultiArray(data=[0.0, 0.0]), st.builds(WheelArray.of, pairs)),
]


@pytest.mark.parametrize(
    ('codec', 'template', 'values'), WRITTEN, ids=lambda one: getattr(one, 'type_name', '')
)
@settings(max_examples=8, deadline=None)
@given(data=st.data())
def test_what_is_written_is_read_again(codec, template, values, data):
    value = data.draw(values)
    serialized = codec.writer(template)(value)
    kind = type(template)
    found = codec.reader(kind)(serialized)
    # Without the class, as bags are read, and as rclpy reads it.
    assert codec.reader(known_structure(codec.type_name))(serialized) == found
    assert value_of(codec, deserialize_message(serialized, kind)) == found
    expected = codec.numbers(value)
    assert codec.numbers(found) == pytest.approx(expected, rel=1e-14, abs=1e-14)


def test_every_topic_is_of_a_type_that_bags_are_read_with_and_of_a_series_of_runs():
    for topic in TOPICS.values():
        for codec in topic.codecs:
            codec.reader(known_structure(codec.type_name))
            codec.reader(message_class(codec.type_name))
            assert is_known(codec.type_name)
    assert {table.series for table in TABLES} <= {field.name for field in dataclasses.fields(Run)}


def test_the_controller_reads_frame_and_pose_of_an_odometry():
    for message in (Odometry(), odometry(1.0, -2.0, 0.5, frame='Karte ä')):
        stamp, frame, pose, twist = ODOMETRY_STATE.reader(Odometry)(serialize_message(message))
        assert stamp == (message.header.stamp.sec, message.header.stamp.nanosec)
        assert frame == message.header.frame_id
        assert twist == value_of(ODOMETRY, message).twist
        assert pose == value_of(ODOMETRY, message).pose == tuple(pose_of(message))


@pytest.mark.parametrize('angles', [None, (0.5, -0.5)])
def test_wheels_are_left_right_in_messages_and_right_left_in_the_library(angles):
    names, time, speeds = ('left', 'right'), 1_500_000_000, (3.0, 2.0)
    positions = [] if angles is None else [0.0, 0.0]
    template = JointState(name=[*names], velocity=[0.0, 0.0], position=positions)
    data = JOINT_STATE.writer(template)(Wheels.of(time, names, speeds, angles))
    state = deserialize_message(data, JointState)
    data = WHEEL_ARRAY.writer(Float64MultiArray(data=[0.0, 0.0]))(WheelArray.of(speeds))
    array = deserialize_message(data, Float64MultiArray)
    assert list(state.velocity) == list(array.data) == [2.0, 3.0]
    assert list(state.position) == ([] if angles is None else [-0.5, 0.5])
    assert (state.header.stamp.sec, state.header.stamp.nanosec) == (1, 500_000_000)
    assert value_of(JOINT_STATE, state).speeds(names) == speeds
    assert value_of(WHEEL_ARRAY, array).speeds(names) == speeds


def test_values_of_parameters_are_those_of_rclpy():
    values = [None, True, -3, 0.5, 'ä', [b'\0', b'\xff'], [True, False], [1, -2], [0.5], ['', 'x']]
    event, expected = ParameterEvent(node='/a'), {}
    for kind, value in enumerate(values):
        parameter = Parameter(str(kind), Parameter.Type(kind), value)
        event.changed_parameters.append(parameter.to_parameter_msg())
        expected[str(kind)] = value
    assert value_of(PARAMETER_EVENT, event) == ('/a', expected, 0)
    event.changed_parameters[0].value.type = 10
    with pytest.raises(MessageError, match='must be 0 to 9, got 10'):
        value_of(PARAMETER_EVENT, event)


# --- Values that are refused


@pytest.mark.parametrize('extreme', [math.nan, math.inf, 1000.5, 1e3, -1e3])
def test_a_twist_is_read_if_it_is_plausible(extreme):
    """Of the components that a differential drive cannot follow only that they are finite."""
    for place in range(6):
        values = [0.25] * 6
        values[place] = extreme
        if math.isfinite(extreme) and (abs(extreme) <= 1e3 or place not in (0, 5)):
            assert from_twist(*values) == (values[0], values[5])
        else:
            with pytest.raises(MessageError, match='twist must be'):
                from_twist(*values)
    # Their sum overflows.
    assert from_twist(0.5, 1e308, 1e308, 1e308, 1e308, -0.25) == (0.5, -0.25)


LEFT_RIGHT = ('l', 'r')


@pytest.mark.parametrize(
    ('read', 'values', 'words'),
    [
        (from_pose, (-math.inf, 0, 0, 0, 0, 1), 'x -inf'),
        (from_pose, (0, 1.000001e6, 0, 0, 0, 1), 'within 1e+06 m'),
        (from_pose, (0, 0, 0, 0, 0, 0), 'quaternion of length 1 (0.9 to 1.1), got x 0'),
        (from_pose, (0, 0, 0, 0, math.nan, 1), 'z nan'),
        (from_pose, (0, 0, 0, 0, 0, 1.2), 'w 1.2'),
        (from_joints, ('lr', (1,), LEFT_RIGHT), 'got 2 joints and 1 velocities'),
        (from_joints, ('lrl', (1, 2, 3), LEFT_RIGHT), "each of ['l', 'r'] once"),
        (from_joints, ('lx', (1, 2), LEFT_RIGHT), "got ['l', 'x']"),
        (from_joints, ('lr', (1, math.nan), LEFT_RIGHT), 'finite, got left 1, right nan'),
        (from_joints, ('lr', (-1.1e6, 1), LEFT_RIGHT), 'within 1e+06 rad/s, got left -1.1e+06'),
        (from_covariance, ((-1, 0, 0, 0, 1, 0, 0, 0, 1),), 'positive semidefinite'),
        (from_covariance, ((1, 0.5, 0, 0, 1, 0, 0, 0, 1),), 'symmetric'),
        (from_covariance, ((1e13, 0, 0, 0, 1, 0, 0, 0, 1),), 'at most 1e+12'),
        (from_covariance, ((1, 0, 0, 0, 1, 0, 0, 0, math.nan),), 'finite'),
    ],
)
def test_poses_wheel_speeds_and_covariances_that_are_refused(read, values, words):
    with pytest.raises(MessageError, match=re.escape(words)):
        read(*values)


def test_variances_that_rounding_made_negative_are_set_to_zero():
    """They would grow with the distance, and end the robot later."""
    direction = np.array([0.6, 0.0, 0.8])
    exact = np.outer(direction, direction)
    found = from_covariance(exact - 1e-12 * np.eye(3))
    np.testing.assert_allclose(found, exact, atol=1e-11)
    assert np.linalg.eigvalsh(found)[0] > -1e-15


def test_a_negative_stamp_is_not_taken_for_none():
    message = twist_stamped(1.0, 0.0, 0)
    # Together they are zero, which would mean that the command has no stamp.
    message.header.stamp.sec, message.header.stamp.nanosec = -1, 1_000_000_000
    with pytest.raises(MessageError, match='its stamp must have sec of at least 0'):
        value_of(TWIST_STAMPED, message)


@pytest.mark.parametrize('bad', [math.nan, -math.inf, 1000.5])
def test_odometry_with_a_twist_that_is_not_plausible_is_refused(bad):
    """A robot with such a twist would never be slow enough to have arrived."""
    for part, component in (('linear', 'x'), ('angular', 'z')):
        message = odometry(1.0, 0.0, 0.0)
        setattr(getattr(message.twist.twist, part), component, bad)
        with pytest.raises(MessageError, match='twist must be within'):
            value_of(ODOMETRY_STATE, message)


# --- Goals and paths


def test_a_path_is_read_with_its_frames_and_stamps():
    poses = (0, 1), goal(2, 3, 0.5, 'odom')
    route = value_of(PATH, path(*poses, frame='odom', stamp=4, times=[5.0, 6.5]))
    assert (route.stamp, route.frame) == ((4, 0), 'odom')
    assert route.poses == ((0.0, 1.0, 0.0), (2.0, 3.0, pytest.approx(0.5)))
    assert route.times == (0.0, 1.5)
    assert value_of(PATH, path((0, 1), (2, 3), times=[5.0, 5.0])).times is None
    assert value_of(GOALS, goals(goal(2, 3, 0.5, 'map'), frame='odom')).frame == 'map'
    assert value_of(POSE, goal(2, 3, 0.5, 'map')).frame == 'map'


@pytest.mark.parametrize(
    ('codec', 'message', 'words'),
    [
        (POSE, goal(1e7, 0), 'position must be finite and within 1e+06 m'),
        (GOALS, goals(), 'goals must contain 1 to 2000 poses, got 0'),
        (GOALS, goals(*[goal(1, 0)] * 2001), 'got 2001'),
        (GOALS, goals(goal(1, 0), goal(math.nan, 0)), 'position must be finite'),
        (GOALS, goals(goal(1, 0, frame='a'), goal(1, 0), frame='b'), "got ['a', 'b']"),
        (PATH, path((1, 0)), 'path must contain 2 to 10000 poses, got 1'),
        (PATH, path(*[(1, 0)] * 10_001), 'got 10001'),
        (PATH, path(*(goal(0, 0, frame=one) for one in 'edcba')), "'c', 'd', ... (5 in all)]"),
        (PATH, path((0, 1), (2, 3), times=[2, 1]), 'got 1.000000000 s after 2.0'),
        (PATH, path((0, 1), (2, 3), (4, 5), times=[0, 1, 1]), 'must increase'),
    ],
)
def test_invalid_goals_are_known_by_their_stamp(codec, message, words):
    message.header.stamp.sec, message.header.stamp.nanosec = -1, 7
    with pytest.raises(GoalError, match=re.escape(words)) as caught:
        value_of(codec, message)
    assert caught.value.stamp == (-1, 7)


def test_the_stamp_of_goals_is_checked_where_a_bag_is_read():
    message = goals(goal(1, 0))
    message.header.stamp.sec = -1
    with pytest.raises(MessageError, match='its stamp must have sec of at least 0'):
        TOPICS['goals'].table.rows(value_of(GOALS, message), ('left', 'right'))
