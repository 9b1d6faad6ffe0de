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

"""The node go_to_goal: goals in, one command per odometry message, a status for each goal, and what it
must not trust: bad goals, bad odometry, odometry that ceases."""

from __future__ import annotations

import math

import pytest
from geometry_msgs.msg import Twist
from std_srvs.srv import Trigger
from support.lockstep_nodes import (
    ABORTED,
    ACCEPTED,
    CANCELED,
    EXECUTING,
    NANOSECOND,
    SUCCEEDED,
    Controller,
    change,
    comes_after,
)
from support.ros_messages import goal, goals, odometry, path, spoiled, twists

from diffdrive_jacobian.control import offset_point
from diffdrive_jacobian.messages.conversion import set_time


@pytest.fixture
def controller(lockstep):
    return Controller(lockstep)


# --- Goals


def test_without_a_goal_it_is_silent(lockstep, controller):
    assert controller.sees(odometry(0, 0, 0)) == []
    controller.send(goal(1, 0))
    lockstep.run_for(10.0)
    assert controller.commands == []
    assert controller.at(0, 0) == (0.5, 0.0)
    assert controller.at(1, 0) == (0.0, 0.0)
    assert controller.sees(odometry(1, 0, 0)) == []
    lockstep.run_for(10.0)
    controller.send(goal(3, 0))
    assert controller.at(1, 0) == (1.0, 0.0)
    assert len(controller.commands) == 3


def test_new_goals_replace_the_active_one(controller):
    controller.send(goal(1, 0, stamp=1))
    assert controller.at(0, 0) == (0.5, 0.0)
    for stamp in (2, 3):
        controller.send(goal(-stamp, 0, stamp=stamp))
    assert controller.at(0, 0, math.pi) == pytest.approx((1.5, 0.0), abs=1e-12)
    assert controller.statuses == [
        *((1, ACCEPTED), (1, EXECUTING), (1, CANCELED)),
        *((2, ACCEPTED), (2, CANCELED), (3, ACCEPTED), (3, EXECUTING)),
    ]
    ids = [bytes(one.goal_info.goal_id.uuid) for one in controller.status]
    assert len(set(ids)) == 3


def test_cancel_sends_zero_and_there_must_be_a_goal(lockstep, controller):
    def cancel():
        response = lockstep.call(Trigger, 'cancel_goal')
        return response.success, response.message

    assert cancel() == (False, 'no goal is active')
    controller.send(goal(1, 0, stamp=1))
    controller.at(0, 0)
    assert cancel() == (True, 'goal canceled, zero sent')
    assert twists(controller.commands) == [(0.5, 0.0), (0.0, 0.0)]
    assert controller.statuses == [(1, ACCEPTED), (1, EXECUTING), (1, CANCELED)]
    assert cancel() == (False, 'no goal is active')
    # Also if nobody knows whether the robot stands.
    controller.send(goal(1, 0, stamp=2))
    assert cancel() == (True, 'goal canceled, zero sent')
    assert twists(controller.commands)[2:] == [(0.0, 0.0)]
    assert controller.sees(odometry(0, 0, 0)) == []


def test_stop_cancels_the_goal_once(lockstep, controller):
    controller.node.stop('too early')
    controller.send(goal(1, 0))
    controller.at(0, 0)
    controller.node.stop('the test says so')
    controller.node.stop('too late')
    lockstep.settle()
    assert twists(controller.commands) == [(0.5, 0.0), (0.0, 0.0)]
    assert controller.statuses == [(0, ACCEPTED), (0, EXECUTING), (0, CANCELED)]


# --- Parameters that change while it drives


def test_after_a_switch_command_and_arrival_are_those_of_the_new_law(controller):
    assert change(controller.node, controller='pose').successful
    controller.send(goal(1.0, 0.4))
    assert controller.at(0.0, 0.4) == (0.5, 0.0)
    gains = {'kv': 2.0, 'offset': -0.4}
    assert change(controller.node, controller='offset_point', **gains).successful
    pose = -1.0, -0.3, 1.5
    assert controller.at(*pose) == pytest.approx(offset_point(pose, (1.0, 0.4), 2.0, -0.4))
    assert controller.at(1.0, 0.4) != (0.0, 0.0)
    assert controller.at(1.4, 0.4) == (0.0, 0.0)
    assert controller.statuses == [(0, ACCEPTED), (0, EXECUTING), (0, SUCCEEDED)]


@pytest.mark.parametrize(
    ('changes', 'goes_on'),
    [
        ({'controller': 'go_to_goal'}, False),
        ({'offset': 0.1}, False),
        ({'odom_timeout': 0.4, 'xy_goal_tolerance': 0.03}, True),
    ],
)
def test_only_another_driven_point_interrupts_the_turn_at_the_end(lockstep, changes, goes_on):
    law = {'controller': 'offset_point', 'offset': 0.3}
    controller = Controller(lockstep, **law, use_goal_heading=True)
    controller.send(goal(1.0, 0.0, 2.0))
    turn = pytest.approx((0.0, 6.0))
    assert controller.at(0.7, 0.0) == turn
    assert change(controller.node, **changes).successful
    assert (controller.at(0.7, 0.1) == turn) == goes_on


# --- Goals that are refused

BAD_GOALS = [
    (spoiled(goal(0, 0, stamp=2), 'pose.orientation.w', 0.0), 'quaternion of length 1'),
    (goals(stamp=2), '1 to 2000 poses, got 0 (to stop, call cancel_goal'),
    (goals(goal(1, 0, frame='map'), stamp=2), "the odometry, 'odom' or '' for it, got 'map'"),
    (path((1, 0), stamp=2), '2 to 10000 poses, got 1'),
    (path((1, 0), (1, 0), stamp=2), 'two different positions, got 2 in one place'),
]


def test_bad_goals_are_refused_and_the_active_one_goes_on(lockstep, controller, capfd):
    controller.send(goal(1, 0, frame='odom', stamp=1))
    controller.at(0, 0)
    for message, words in BAD_GOALS:
        controller.send(message)
        assert controller.at(0, 0) == (0.5, 0.0)
        assert controller.statuses[-3:] == [(1, EXECUTING), (2, ABORTED), (1, EXECUTING)]
        error = capfd.readouterr().err
        assert 'goal refused: ' in error
        assert words in error
    # Who comes late sees the status of what goes on, too.
    latched = lockstep.listen(type(controller.status[0]), 'goal_status', latched=True)
    assert latched[-1] == controller.status[-1]
    # Without an active one the node stays silent.
    controller.at(1, 0)
    before = len(controller.status)
    controller.send(BAD_GOALS[0][0])
    assert controller.sees(odometry(0, 0, 0)) == []
    assert controller.statuses[before:] == [(2, ABORTED)]


def test_a_frame_is_checked_with_the_odometry_that_comes_first_after_the_goal(controller, capfd):
    controller.send(goal(1, 0, frame='map', stamp=1))
    assert controller.sees(odometry(0, 0, 0)) == []
    assert controller.statuses == [(1, ACCEPTED), (1, ABORTED)]
    assert "got 'map'" in capfd.readouterr().err
    controller.send(goal(1, 0, frame='odom', stamp=2))
    assert controller.at(0, 0) == (0.5, 0.0)
    # Not by one in another frame.
    controller.send(goal(-1, 0, stamp=3))
    assert controller.sees(odometry(5, 5, 0, frame='other')) == []
    assert controller.at(0, 0, math.pi)[0] == pytest.approx(0.5)
    assert controller.statuses[-1] == (3, EXECUTING)
    # Without a goal that is driven to it may change.
    assert controller.at(-1, 0) == (0.0, 0.0)
    assert controller.sees(odometry(0, 0, 0, frame='map')) == []
    controller.send(goal(1, 0, frame='map'))
    assert controller.at(0, 0, frame='map') == (0.5, 0.0)


# --- Odometry that is bad or missing


def test_bad_odometry_is_dropped_and_stops_the_robot_in_time(lockstep, capfd):
    controller = Controller(lockstep, odom_timeout=0.2)
    controller.send(goal(1, 0))
    controller.at(0, 0)
    for message in (odometry(math.nan, 0, 0), odometry(0, 0, 0, frame='')):
        lockstep.run_for(0.05)
        assert controller.sees(message) == []
    assert comes_after(lockstep, controller.commands, 0.1) == Twist()
    lockstep.run_for(0.3)
    # The goal was kept.
    assert controller.at(0.5, 0.0) == (0.25, 0.0)
    assert len(controller.commands) == 3
    said = capfd.readouterr().err
    assert 'odometry dropped: position must be finite' in said
    assert 'no valid odometry on /odom for 0.2 s: robot stopped, waiting' in said
    assert 'odometry is received again: driving on' in said


def test_a_goal_that_waits_for_odometry_is_reported_and_commands_nothing(lockstep, capfd):
    controller = Controller(lockstep, odom_timeout=3.0)
    controller.send(goal(1, 0))
    lockstep.run_for(3.0 - NANOSECOND)
    words = 'the goal waits for odometry on /odom: is the robot running?'
    assert words not in capfd.readouterr().err
    lockstep.run_for(NANOSECOND)
    assert words in capfd.readouterr().err
    lockstep.run_for(10.0)
    assert words not in capfd.readouterr().err
    assert controller.commands == []
    assert controller.statuses == [(0, ACCEPTED)]


def test_a_new_goal_does_not_put_the_timeout_off_and_turns_in_place_are_stopped_too(
    lockstep, controller
):
    assert change(controller.node, use_goal_heading=True).successful
    controller.send(goal(0, 0, 2.0))
    assert controller.at(0, 0) == pytest.approx((0.0, 6.0))
    lockstep.run_for(0.3)
    controller.send(goal(-1, 0))
    assert comes_after(lockstep, controller.commands, 0.2) == Twist()
    # The goal is kept until odometry comes again, however late.
    lockstep.run_for(1000.0)
    assert controller.at(-1, 0) == (0.0, 0.0)
    assert controller.statuses[-2:] == [(0, EXECUTING), (0, SUCCEEDED)]


# --- Odometry that comes again, or out of order


def stamped(seconds, x):
    message = odometry(x, 0, 0)
    set_time(message.header.stamp, round(seconds * 1e9))
    return message


@pytest.mark.parametrize(
    ('stamps', 'answered'),
    [
        ([5.0, 5.02, 5.02, 5.04], [1, 1, 0, 1]),
        # Of another pose with an equal stamp: the stamps are coarse.
        ([(5.0, 0.0), (5.0, 0.1), (5.0, 0.2)], [1, 1, 1]),
        ([5.0, 5.1, 5.02, 5.12, 5.04, 5.14], [1, 1, 0, 1, 0, 1]),
        # The source has started again, or counts down.
        ([5.0, 1.0, 1.02, 1.04], [1, 0, 1, 1]),
        ([5.0, 4.9, 4.8, 4.7], [1, 0, 1, 0]),
        ([(0.0, 0.1), (0.0, 0.1)], [1, 1]),
        ([(5.0, 0.1), (0.0, 0.1), (5.0, 0.2)], [1, 1, 1]),
    ],
)
def test_odometry_that_comes_again_or_out_of_order_is_ignored(controller, stamps, answered):
    controller.send(goal(1, 0))
    pairs = [one if isinstance(one, tuple) else (one, one / 100.0) for one in stamps]
    assert [len(controller.sees(stamped(*pair))) for pair in pairs] == answered


def test_the_robot_is_stopped_if_its_odometry_only_comes_again(lockstep, controller, capfd):
    controller.send(goal(1, 0))
    assert controller.sees(stamped(5.0, 0.1)) != []
    for _ in range(8):
        lockstep.run_for(0.1)
        controller.sees(stamped(5.0, 0.1))
    assert twists(controller.commands)[-1] == (0.0, 0.0)
    assert 'odometry is received again' not in capfd.readouterr().err
    # It goes on when there is other odometry, whatever its stamp.
    assert controller.sees(stamped(4.0, 0.2)) != [(0.0, 0.0)]
    assert 'is ignored' not in capfd.readouterr().err
    controller.sees(stamped(3.0, 0.2))
    assert 'is ignored: older than the previous one' in capfd.readouterr().err
