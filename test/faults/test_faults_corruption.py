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

"""Corrupt: one wrong field in messages of any type."""

from __future__ import annotations

import math
import operator
import random
import re

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry, Path
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, ParameterValue
from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import BatteryState, Image, JointState, LaserScan
from std_msgs.msg import Bool, Byte, Empty, Int8, Int64, String, UInt8
from support.ros_messages import odometry, time_of

from diffdrive_jacobian.faults.corrupt import Corrupt
from diffdrive_jacobian.testing import LockstepError

SECOND = 1_000_000_000


def through(message, *args):
    """Return what a receiver reads of a message, and whether its bytes are those of the sender."""
    data = bytes(serialize_message(message))
    corrupt = Corrupt('topic', *args).begin(random.Random(0), type(message))
    ((delay, received),) = corrupt(0, data)
    assert delay == 0
    return deserialize_message(received, type(message)), received is data


def corrupted(message, *args):
    return through(message, *args)[0]


def drive(x=1.5):
    """Return odometry with a stamp and without a zero."""
    message = odometry(x, -2.0, 0.5)
    message.header.stamp.sec, message.header.stamp.nanosec = 12, 250_000_000
    message.pose.covariance = np.arange(1.0, 37.0)
    return message


# --- Values

Y = 'pose.pose.position.y'


@pytest.mark.parametrize(
    ('path', 'change', 'expected'),
    [
        (Y, ['nan'], math.nan),
        (Y, ['inf'], math.inf),
        (Y, ['-inf'], -math.inf),
        (Y, ['negate'], 2.0),
        (Y, ['offset', 0.25], -1.75),
        (Y, ['scale', -10.0], 20.0),
        (Y, ['scale', 1.7e308], -math.inf),
        (Y, ['set', 7], 7.0),
        (Y, ['subnormal'], -5e-324),
        ('header.frame_id', ['set', 'a frame that is longer'], 'a frame that is longer'),
        # A stamp is shifted in seconds, within what it can represent.
        ('header.stamp', ['offset', -2.5], Time(sec=9, nanosec=750_000_000)),
        ('header.stamp', ['offset', -20.0], Time(sec=-8, nanosec=250_000_000)),
        ('header.stamp', ['offset', 1e300], Time(sec=2**31 - 1, nanosec=SECOND - 1)),
        ('header.stamp', ['offset', -1e300], Time(sec=-(2**31))),
        ('header.stamp', ['set', -0.5], Time(sec=-1, nanosec=500_000_000)),
        # One that makes no sense is possible, too.
        ('header.stamp.nanosec', ['set', 2**32 - 1], 2**32 - 1),
    ],
)
def test_one_field_is_changed_and_nothing_else(path, change, expected):
    sent = drive()
    received = corrupted(sent, path, *change)
    np.testing.assert_equal(operator.attrgetter(path)(received), expected)
    place, _, name = path.rpartition('.')
    setattr(operator.attrgetter(place)(received), name, operator.attrgetter(path)(sent))
    assert received == sent


def test_a_float_of_single_precision_has_limits_of_its_own():
    sent = BatteryState(voltage=12.0, temperature=-1.0)
    assert corrupted(sent, 'temperature', 'subnormal').temperature == -(2.0**-149)
    assert corrupted(sent, 'voltage', 'scale', 1e300).voltage == math.inf
    assert corrupted(sent, 'voltage', 'set', 0.1).voltage == float(np.float32(0.1))


@pytest.mark.parametrize(
    ('message', 'change', 'amount', 'expected'),
    [
        (Int8(data=100), 'offset', 50, 127),
        (Int8(data=-128), 'negate', 0.0, 127),
        (Int8(data=5), 'scale', 0.5, 2),
        (Int64(data=2), 'scale', 1e300, 2**63 - 1),
        (UInt8(data=5), 'offset', -9.0, 0),
        (Bool(data=True), 'negate', 0.0, False),
        (Bool(data=False), 'set', True, True),
    ],
)
def test_other_types_stay_within_their_range(message, change, amount, expected):
    received = corrupted(message, 'data', change, amount)
    assert received.data == expected
    assert type(received.data) is type(expected)


# --- Paths


def test_elements_and_whole_arrays_of_both_kinds():
    sent = JointState(name=['left', 'right'], velocity=[1.0, 2.0])
    assert list(corrupted(sent, 'velocity[1]', 'negate').velocity) == [1.0, -2.0]
    assert list(corrupted(sent, 'velocity', 'scale', 3.0).velocity) == [3.0, 6.0]
    assert corrupted(sent, 'name[0]', 'set', 'wheel').name == ['wheel', 'right']
    covariance = corrupted(drive(), 'pose.covariance[35]', 'nan').pose.covariance
    assert math.isnan(covariance[35])
    assert list(covariance[:35]) == list(range(1, 36))
    assert np.isnan(corrupted(drive(), 'pose.covariance', 'nan').pose.covariance).all()
    scan = LaserScan(ranges=[1.0, 2.0])
    assert list(corrupted(scan, 'ranges', 'inf').ranges) == [math.inf, math.inf]
    assert list(corrupted(Image(data=b'\1\2'), 'data', 'offset', 254).data) == [255, 255]


def test_elements_that_are_messages_also_in_bounded_sequences():
    received = corrupted(Path(poses=[PoseStamped(), PoseStamped()]), 'poses[1].header.stamp', 'set', 4.0)
    assert [one.header.stamp.sec for one in received.poses] == [0, 4]
    bounded = ParameterDescriptor(floating_point_range=[FloatingPointRange(to_value=1.0)])
    received = corrupted(bounded, 'floating_point_range[0].to_value', 'nan')
    assert math.isnan(received.floating_point_range[0].to_value)
    flags = ParameterValue(bool_array_value=[True, False])
    assert corrupted(flags, 'bool_array_value', 'negate').bool_array_value == [False, True]


def test_a_message_that_is_not_changed_keeps_its_bytes():
    """A receiver that compares bytes does not see another message."""
    for message, *change in (
        (JointState(velocity=[1.0]), 'velocity[1]', 'nan'),
        (JointState(), 'velocity', 'nan'),
        (Path(), 'poses[0].pose.position.x', 'nan'),
        (drive(), 'pose.pose.position.x', 'scale', 1.0),
        (drive(), 'header.stamp', 'offset', 0.0),
    ):
        received, same = through(message, *change)
        assert same
        assert received == message
    assert not through(drive(0.0), 'pose.pose.position.x', 'negate')[1]
    # Bytes that are no message are left to the receiver.
    corrupt = Corrupt('odom', 'pose.pose.position.x', 'nan').begin(random.Random(0), Odometry)
    assert list(corrupt(0, b'\0\1\0\0abc')) == [(0, b'\0\1\0\0abc')]


def test_the_share_of_changed_messages_and_which_ones_follow_from_the_seed():
    data = bytes(serialize_message(Twist()))

    def changed(seed):
        fault = Corrupt('cmd_vel', 'linear.x', 'nan', probability=0.3)
        corrupt = fault.begin(random.Random(seed), Twist)
        return [next(iter(corrupt(0, data)))[1] is not data for _ in range(1000)]

    first = changed(1)
    # 5 standard deviations of a binomial distribution.
    assert abs(sum(first) - 300) < 5 * math.sqrt(1000 * 0.3 * 0.7)
    assert changed(1) == first != changed(2)


# --- What is refused

OF_BYTE = "'offset', 'scale' or 'set', with integers from 0 to 255"
NO_NUMBER = 'name one of its fields that is a number'


@pytest.mark.parametrize(
    ('message_type', 'path', 'change', 'told'),
    [
        # Fields that do not exist.
        (Odometry, 'pose.x', ['nan'], "PoseWithCovariance has no 'x'; its fields: pose, covariance"),
        (Odometry, 'header.stamp.sec.x', ['nan'], "int32 has no 'x'; its fields: none"),
        (Odometry, 'pose.covariance[36]', ['nan'], "'covariance' has 36 elements"),
        (Odometry, 'pose[0].pose', ['nan'], "'pose' has a single value"),
        (Odometry, 'pose.covariance.x', ['nan'], "double[36] has no 'x'; its fields: elements [0]"),
        (Odometry, 'pose.covariance[-1]', ['nan'], "has no 'covariance[-1]'"),
        (Odometry, 'pose.__class__', ['nan'], "has no '__class__'"),
        (Empty, 'data', ['nan'], "has no 'data'"),
        # Changes that the type does not allow, with those that it does.
        (Int8, 'data', ['nan'], "'negate', 'offset', 'scale' or 'set', with integers from -128"),
        (Int8, 'data', ['offset', 0.5], 'with integers'),
        (Int8, 'data', ['set', True], 'with integers'),
        (UInt8, 'data', ['negate'], OF_BYTE),
        (UInt8, 'data', ['set', 256], OF_BYTE),
        (String, 'data', ['set', 1.0], "it must be 'set' with a str"),
        (Bool, 'data', ['offset', 1.0], "it must be 'negate', or 'set' with a bool"),
        (Odometry, 'header.stamp', ['scale', 2.0], "'offset' or 'set', with a number of seconds"),
        (Odometry, 'pose.pose.position.x', ['set', 'map'], 'with a number as amount'),
        (Odometry, 'pose.pose', ['nan'], NO_NUMBER),
        (Path, 'poses', ['nan'], NO_NUMBER),
        (Byte, 'data', ['set', 1], NO_NUMBER),
    ],
)
def test_an_impossible_field_or_change_is_refused(message_type, path, change, told):
    with pytest.raises(ValueError, match=r'^Corrupt: ') as caught:
        Corrupt('topic', path, *change).begin(random.Random(0), message_type)
    assert f"field '{path}'" in str(caught.value)
    assert told in str(caught.value)


# --- In a world


def test_only_the_named_receiver_gets_the_wrong_value(lockstep, robot_at):
    robot_at()
    fine = lockstep.listen(Odometry, 'odom')
    wrong = []
    node = lockstep.add(Node('receiver'))
    node.create_subscription(Odometry, 'odom', wrong.append, 10)
    lockstep.inject(
        Corrupt('odom', 'pose.pose.position.x', 'set', 7.0, start=0.1, duration=0.1, node='receiver'),
        Corrupt('odom', 'header.frame_id', 'set', 'map', start=0.15),
    )
    lockstep.run_for(0.3)
    assert {one.pose.pose.position.x for one in fine} == {0.0}
    received = {(one.pose.pose.position.x, one.header.frame_id) for one in wrong}
    assert received == {(0.0, 'odom'), (7.0, 'odom'), (7.0, 'map'), (0.0, 'map')}
    times = [time_of(one) - SECOND for one in wrong if one.pose.pose.position.x]
    assert (min(times), max(times)) == (100_000_000, 180_000_000)
    events = [event.what for event in lockstep.fault_events]
    assert any('changed' in event and '/odom to /receiver' in event for event in events)


def test_a_field_that_does_not_exist_is_an_error_in_a_world(lockstep, robot_at):
    lockstep.inject(Corrupt('cmd_vel', 'twist.linear.x', 'nan'))
    with pytest.raises(ValueError, match="geometry_msgs/Twist has no 'twist'"):
        robot_at()
    lockstep.close()


@pytest.mark.parametrize('path', ['position[2]', 'velocity'])
def test_a_fault_of_a_field_that_no_message_had_has_met_nothing(lockstep, path):
    lockstep.node.create_subscription(JointState, 'joint_states', lambda _: None, 10)
    publisher = lockstep.node.create_publisher(JointState, 'joint_states', 10)
    lockstep.inject(Corrupt('joint_states', path, 'negate', node='lockstep'))
    # Before there is a message, nothing is wrong.
    lockstep.check_faults()
    publisher.publish(JointState(position=[1.0, 2.0]))
    lockstep.settle()
    with pytest.raises(LockstepError, match=rf'Corrupt.*: no message had {re.escape(path)}'):
        lockstep.check_faults()
    # One is enough.
    publisher.publish(JointState(position=[1.0, 2.0, 3.0], velocity=[1.0]))
    publisher.publish(JointState(position=[1.0, 2.0]))
    lockstep.settle()
    lockstep.check_faults()
