"""The node go_to_goal and what it must not trust: bad goals, bad odometry, odometry that ceases."""

from __future__ import annotations

import math

import pytest
from geometry_msgs.msg import Twist, TwistStamped
from support.lockstep_nodes import (
    ABORTED,
    ACCEPTED,
    CANCELED,
    EXECUTING,
    NANOSECOND,
    SECOND,
    SUCCEEDED,
    Controller,
    change,
    comes_after,
)
from support.ros_messages import goal, goals, instants, odometry, spoiled, twists

BAD_POSES = [
    ('position.x', math.nan, 'position must be finite'),
    ('position.y', -math.inf, 'y -inf'),
    ('position.y', 1e308, 'y 1e+308'),
    ('position.x', 1.000001e6, 'within 1e+06 m'),
    ('orientation.w', 0.0, 'got x 0, y 0, z 0, w 0'),
    ('orientation.w', 1.2, 'quaternion of length 1'),
    ('orientation.z', math.nan, 'quaternion of length 1'),
    ('orientation.x', math.inf, 'quaternion of length 1'),
]


@pytest.fixture
def controller(lockstep):
    return Controller(lockstep)


# --- Goals


@pytest.mark.parametrize(
    ('message', 'words'),
    [
        *[
            (spoiled(goal(0, 0, stamp=2), f'pose.{field}', value), words)
            for field, value, words in BAD_POSES
        ],
        (goals(goal(0, 0), goal(0, math.inf), stamp=2), 'y inf'),
        (goals(stamp=2), 'at least one pose, got none'),
        (goals(goal(0, 0, frame='a'), goal(0, 0, frame='b'), stamp=2), "one frame, got ['a', 'b']"),
        (goal(1, 0, frame='map', stamp=2), "the odometry, 'odom' or '' for it, got 'map'"),
        (goals(goal(1, 0), frame='map', stamp=2), "got 'map'"),
        (goals(goal(1, 0, frame='map'), goal(1, 0, frame='map'), stamp=2), "got 'map'"),
    ],
)
def test_bad_goal_is_refused_and_the_active_one_goes_on(controller, capfd, message, words):
    controller.send(goal(1, 0, frame='odom', stamp=1))
    controller.at(0, 0)
    controller.send(message)
    assert controller.at(0, 0) == (0.5, 0.0)
    assert controller.statuses == [(1, ACCEPTED), (1, EXECUTING), (2, ABORTED), (1, EXECUTING)]
    error = capfd.readouterr().err
    assert 'goal refused: ' in error
    assert words in error


@pytest.mark.parametrize(('field', 'value', 'words'), BAD_POSES[::3])
def test_bad_goal_without_an_active_one_leaves_it_silent(controller, capfd, field, value, words):
    controller.send(spoiled(goal(0, 0), f'pose.{field}', value))
    assert controller.sees(odometry(0, 0, 0)) == []
    assert controller.statuses == [(0, ABORTED)]
    assert words in capfd.readouterr().err


@pytest.mark.parametrize('frame', ['', 'odom'])
@pytest.mark.parametrize('of', ['pose', 'message', 'both'])
def test_frame_may_stand_with_the_pose_or_with_all(controller, frame, of):
    frames = {'pose': (frame, ''), 'message': ('', frame), 'both': (frame, frame)}
    pose_frame, message_frame = frames[of]
    controller.send(goals(goal(1, 0, frame=pose_frame), frame=message_frame))
    assert controller.at(0, 0) == (0.5, 0.0)


def test_frame_is_judged_when_odometry_comes_first_after_the_goal(controller, capfd):
    controller.send(goal(1, 0, frame='map', stamp=1))
    assert controller.sees(odometry(0, 0, 0)) == []
    assert controller.statuses == [(1, ACCEPTED), (1, ABORTED)]
    assert "got 'map'" in capfd.readouterr().err
    controller.send(goal(1, 0, frame='odom', stamp=2))
    assert controller.at(0, 0) == (0.5, 0.0)


def test_new_goal_is_not_judged_by_a_stray_frame(controller):
    controller.send(goal(1, 0, frame='odom', stamp=1))
    controller.at(0, 0)
    controller.send(goal(-1, 0, stamp=2))
    assert controller.sees(odometry(5, 5, 0, frame='other')) == []
    assert controller.at(0, 0, math.pi)[0] == pytest.approx(0.5)
    assert controller.statuses == [
        (1, ACCEPTED),
        (1, EXECUTING),
        (1, CANCELED),
        (2, ACCEPTED),
        (2, EXECUTING),
    ]


def test_frame_may_change_between_goals(controller):
    for frame in ('odom', 'map'):
        controller.send(goal(1, 0, frame=frame))
        assert controller.at(0, 0, frame=frame) == (0.5, 0.0)
        assert controller.at(1, 0, frame=frame) == (0.0, 0.0)
        controller.sees(odometry(0, 0, 0, frame='map'))


# --- Odometry


@pytest.mark.parametrize(
    ('message', 'words'),
    [
        *[
            (spoiled(odometry(0, 0, 0), f'pose.pose.{field}', value), words)
            for field, value, words in BAD_POSES
        ],
        (odometry(0, 0, 0, frame='map'), "it must stay in frame 'odom', got 'map'"),
        (odometry(0, 0, 0, frame=''), "it must stay in frame 'odom', got ''"),
    ],
)
def test_bad_odometry_is_dropped_and_stops_the_robot_in_time(lockstep, capfd, message, words):
    controller = Controller(lockstep, odom_timeout=0.2)
    controller.send(goal(1, 0))
    controller.at(0, 0)
    for _ in range(9):
        lockstep.run_for(0.02)
        assert controller.sees(message) == []
    assert comes_after(lockstep, controller.commands, 0.02) == Twist()
    for _ in range(5):
        lockstep.run_for(0.1)
        assert controller.sees(message) == []
    # The goal was kept.
    assert controller.at(0.5, 0.0) == (0.25, 0.0)
    assert len(controller.commands) == 3
    said = capfd.readouterr().err
    assert 'odometry dropped: ' in said
    assert words in said
    assert 'no valid odometry on /odom for 0.2 s: robot stopped, waiting' in said
    assert 'odometry is received again: driving on' in said


@pytest.mark.parametrize('timeout', [1e-9, 0.001, 0.3333, 0.5, 60.0])
def test_zero_comes_exactly_the_timeout_after_the_last_odometry(lockstep, timeout):
    controller = Controller(lockstep, TwistStamped, odom_timeout=timeout, enable_stamped_cmd_vel=True)
    controller.send(goal(1, 0))
    for _ in range(3):
        controller.at(0, 0)
        seen = lockstep.now
        lockstep.run_for(max(timeout / 3.0, NANOSECOND))
    lockstep.run_for(10.0 * timeout)
    zeros = [
        at
        for at, command in zip(instants(controller.commands), twists(controller.commands), strict=True)
        if command == (0.0, 0.0)
    ]
    held = round(timeout * SECOND)
    assert zeros[-1] == seen + held
    # Nor any other, but for odometry that comes as seldom as the timeout allows.
    assert len(zeros) == (1 if held > 1 else 3)
    # The goal is kept until odometry comes again, however late.
    lockstep.run_for(1000.0)
    controller.at(1, 0)
    assert controller.statuses == [(0, ACCEPTED), (0, EXECUTING), (0, SUCCEEDED)]


def test_without_a_timeout_the_last_command_stands(lockstep):
    controller = Controller(lockstep, odom_timeout=0.0)
    controller.send(goal(1, 0))
    controller.at(0, 0)
    lockstep.run_for(1e5)
    assert twists(controller.commands) == [(0.5, 0.0)]


@pytest.mark.parametrize('timeout', [0.4, 2.0])
def test_a_new_timeout_counts_from_the_last_odometry_on(lockstep, controller, timeout):
    controller.send(goal(1, 0))
    controller.at(0, 0)
    lockstep.run_for(0.3)
    assert change(controller.node, odom_timeout=timeout).successful
    assert comes_after(lockstep, controller.commands, timeout - 0.3) == Twist()


def test_changes_of_the_timeout_do_not_keep_the_robot_driving(lockstep, controller):
    """Requests of another process must not replace odometry."""
    controller.send(goal(1, 0))
    controller.at(0, 0)
    for timeout in (0.6, 0.5) * 3:
        lockstep.run_for(0.3)
        assert change(controller.node, odom_timeout=timeout).successful
    assert controller.commands[-1] == Twist()


@pytest.mark.parametrize('pause', [0.05, 0.1, 0.19])
def test_new_goals_are_no_sign_of_life_of_the_odometry(lockstep, capfd, pause):
    controller = Controller(lockstep, odom_timeout=0.2)
    controller.send(goal(1, 0, stamp=1))
    controller.at(0, 0)
    left = 0.2
    for stamp in range(2, 2 + math.floor(0.2 / pause - 1e-9)):
        lockstep.run_for(pause)
        left -= pause
        controller.send(goal(-1, 0, stamp=stamp))
    assert comes_after(lockstep, controller.commands, left) == Twist()
    lockstep.run_for(5.0)
    assert len(controller.commands) == 2
    assert 'no valid odometry on /odom for 0.2 s' in capfd.readouterr().err


@pytest.mark.parametrize('timeout', [0.1, 3.0])
def test_goal_that_waits_for_odometry_says_so_and_commands_nothing(lockstep, capfd, timeout):
    controller = Controller(lockstep, odom_timeout=timeout)
    controller.send(goal(1, 0))
    lockstep.run_for(timeout - NANOSECOND)
    words = 'the goal waits for odometry on /odom: is the robot running?'
    assert words not in capfd.readouterr().err
    lockstep.run_for(NANOSECOND)
    assert words in capfd.readouterr().err
    lockstep.run_for(10.0)
    assert words not in capfd.readouterr().err
    assert controller.commands == []
    assert controller.statuses == [(0, ACCEPTED)]


def test_robot_that_turns_in_place_is_stopped_too(lockstep):
    controller = Controller(lockstep, use_goal_heading=True)
    controller.send(goal(0, 0, 2.0))
    assert controller.at(0, 0) == pytest.approx((0.0, 6.0))
    assert comes_after(lockstep, controller.commands, 0.5) == Twist()
    assert controller.at(0, 0, 1.0) == pytest.approx((0.0, 3.0))


@pytest.mark.lockstep(start=100.0)
@pytest.mark.parametrize('seconds', [-50.0, -0.5, -0.1, 0.3, 0.5, 1000.0])
def test_jumps_of_time_stop_the_robot_that_is_not_seen(lockstep, controller, seconds):
    controller.send(goal(1, 0))
    controller.at(0, 0)
    lockstep.jump(seconds)
    # After a jump back the timeout begins anew.
    left = 0.5 - max(seconds, 0.0)
    if left > 0.0:
        comes_after(lockstep, controller.commands, left)
    assert twists(controller.commands) == [(0.5, 0.0), (0.0, 0.0)]
    assert controller.at(0.5, 0.0) == (0.25, 0.0)
    comes_after(lockstep, controller.commands, 0.5)
