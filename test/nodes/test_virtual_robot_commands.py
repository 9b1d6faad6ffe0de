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

"""The node virtual_robot: invalid commands and placements, stamps, and time that jumps."""

from __future__ import annotations

import math

import numpy as np
import pytest
from sensor_msgs.msg import JointState
from support.lockstep_nodes import SECOND, Topics
from support.ros_messages import (
    WHEELS,
    covariance_of,
    instants,
    joint_command,
    placement,
    pose_message,
    pose_of,
    spoiled,
    twist,
    twists,
    value_of,
)

from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.messages.codecs import POSE_WITH_COVARIANCE
from diffdrive_jacobian.messages.conversion import MessageError, command_time
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot

BEGIN = 100 * SECOND
late = pytest.mark.lockstep(start=100.0)
"""Late enough that time may go back."""


@pytest.fixture
def driving(lockstep, add):
    """The topics of a robot that is told to drive at 1 m/s."""
    topics = Topics(lockstep)
    add(VirtualRobot)
    lockstep.publish('cmd_vel', twist(1.0, 0.0))
    return topics


# --- Commands


@pytest.mark.parametrize(
    ('interface', 'topic', 'invalid', 'valid', 'words'),
    [
        ('twist', 'cmd_vel', twist(math.nan), twist(0.5, 0.25), 'twist must be finite'),
        (
            *('wheels', 'joint_command', JointState(name=['other'], velocity=[1.0])),
            JointState(name=['arm', *WHEELS], velocity=[5.0, 1.0, 3.0]),
            "must name each of ['left_wheel_joint', 'right_wheel_joint'] once, got ['other']",
        ),
        (
            'wheels',
            'joint_command',
            joint_command(1e6, 1e6),
            joint_command(1, 3),
            'twist must be within',
        ),
    ],
)
def test_an_invalid_command_is_dropped_and_named(
    lockstep, add, capfd, interface, topic, invalid, valid, words
):
    topics = Topics(lockstep)
    add(VirtualRobot, command_interface=interface)
    lockstep.publish(topic, invalid)
    assert topics.applied == []
    said = capfd.readouterr().err
    assert 'command dropped: ' in said
    assert words in said
    lockstep.publish(topic, valid)
    driven = (0.5, 0.25) if interface == 'twist' else (0.033 * 2.0, 0.033 * 2.0 / 0.16)
    assert twists(topics.applied) == [pytest.approx(driven)]


def test_a_stamp_counts_unless_it_is_in_the_future_too_old_or_older_than_the_last_command():
    now, timeout, last = 9 * SECOND, SECOND // 2, 9 * SECOND - 100
    assert command_time(0, now, last, timeout) == now
    for stamp in (now, last):
        assert command_time(stamp, now, last, timeout) == stamp
    assert command_time(now - timeout, now, 0, timeout) == now - timeout
    # Without a timeout none is too old.
    assert command_time(1, now, 0, 0) == 1
    for stamp, before, words in (
        (now + 1, last, 'in the future'),
        (now - timeout - 1, 0, 'more than the timeout of 0.5 s'),
        (last - 1, last, 'older than the last command'),
    ):
        with pytest.raises(MessageError, match=words):
            command_time(stamp, now, before, timeout)


def test_late_wheel_speeds_act_from_their_stamp_on(lockstep, robot_at):
    topics = Topics(lockstep)
    robot_at(1.0, 1.0, 1.0, command_interface='wheels')
    stamp = lockstep.now
    lockstep.run_for(0.31)
    for at in (stamp, lockstep.now + 1, stamp - 1):
        lockstep.publish('joint_command', joint_command(5.0, 4.0, at))
    lockstep.run_for(0.4)
    # As if it had come in time: the timeout counts from the stamp, too.
    assert instants(topics.applied) == [stamp, stamp + SECOND // 2]
    (driven, _) = twists(topics.applied)
    assert topics.odom[-1].pose.pose == pose_message(se2.integrate([1, 1, 1], driven, 0.5))


# --- Time


@late
@pytest.mark.parametrize('seconds', [1e-9, 99.0])
def test_time_that_goes_back_leaves_the_robot_where_it_is(lockstep, driving, capfd, seconds):
    lockstep.run_for(0.24)
    before = driving.states[-1].position
    lockstep.jump(-seconds)
    back = lockstep.now
    assert instants(driving.starts) == [BEGIN, back]
    assert driving.starts[1].pose.pose.position.x == 0.24
    # The stop is reported at once, on the new time line.
    assert instants(driving.applied) == [BEGIN, back]
    assert twists(driving.applied)[1] == (0.0, 0.0)
    driving.odom.clear()
    lockstep.run_for(0.4)
    assert {tuple(pose_of(one)) for one in driving.odom} == {(0.24, 0.0, 0.0)}
    assert len(driving.odom) in (19, 20)
    assert list(driving.states[-1].position) == pytest.approx(before, abs=1e-12)
    assert f'time went back by {seconds:.3f} s' in capfd.readouterr().err
    lockstep.publish('cmd_vel', twist(-1.0, 0.0))
    again = lockstep.now
    lockstep.run_for(0.6)
    assert pose_of(driving.odom[-1]).tolist() == [-0.26, 0.0, 0.0]
    assert instants(driving.applied)[2:] == [again, again + SECOND // 2]


# --- Placements


def test_initialpose_while_driving_carries_its_covariance(lockstep, add):
    topics, target = Topics(lockstep), [2.0, 3.0, math.pi / 2]
    add(VirtualRobot, odom_frame_id='elsewhere', wheel_travel_variance=0.0)
    lockstep.publish('cmd_vel', twist(0.5, 0.0))
    lockstep.run_for(0.25)
    # The index of the diagonal is that of z, roll or pitch, which the plane fixes.
    for index, frame in ((14, 'elsewhere'), (21, ''), (28, '')):
        message = placement(*target, variances=(0.25, 0.5, 0.07), frame=frame)
        lockstep.publish('initialpose', spoiled(message, f'pose.covariance.{index}', math.nan))
    assert len(topics.starts) == 4
    assert value_of(POSE_WITH_COVARIANCE, topics.starts[-1]).pose == pytest.approx(target)
    lockstep.run_for(0.4)
    assert pose_of(topics.odom[-1]) == pytest.approx([2.0, 3.125, math.pi / 2], abs=1e-15)
    # The uncertain heading makes the position more uncertain.
    variances = np.diag(covariance_of(topics.odom[-1]))
    assert variances == pytest.approx([0.25 + 0.07 * 0.125**2, 0.5, 0.07], rel=1e-3)


@pytest.mark.parametrize(
    ('field', 'value', 'words'),
    [
        ('header.frame_id', 'map', "frame must be 'odom', got 'map'"),
        ('pose.pose.position.x', math.nan, 'position must be finite'),
        ('pose.covariance.0', -1.0, 'positive semidefinite'),
    ],
)
def test_bad_initialpose_is_dropped_and_named(lockstep, driving, capfd, field, value, words):
    lockstep.publish('initialpose', spoiled(placement(7.0), field, value))
    lockstep.run_for(0.02)
    # Neither the pose nor the command took note of it.
    assert len(driving.starts) == 1
    assert pose_of(driving.odom[-1]).tolist() == [0.02, 0.0, 0.0]
    said = capfd.readouterr().err
    assert 'initialpose dropped: ' in said
    assert words in said
