"""The node virtual_robot when time does what it likes: timeouts at their own instants, jumps."""

from __future__ import annotations

import math

import pytest
from geometry_msgs.msg import Twist
from support.lockstep_nodes import NANOSECOND, SECOND, Topics
from support.ros_messages import at_rest, instants, pose_message, pose_of, twist, twists

from diffdrive_jacobian.kinematics import se2

pytestmark = pytest.mark.lockstep(start=100.0)
"""Late enough that time may go back."""


@pytest.fixture
def driving(lockstep, robot_at):
    """The topics of a robot that is told at t = 100 s to drive at 1 m/s."""
    topics = Topics(lockstep)
    robot_at()
    lockstep.publish('cmd_vel', twist(1.0, 0.0))
    return topics


@pytest.mark.parametrize('rate', [3.0, 50.0])
@pytest.mark.parametrize('timeout', [1e-9, 0.001, 0.0333, 0.5, 2.0])
def test_timeout_strikes_at_its_own_instant_whatever_the_rate(lockstep, robot_at, timeout, rate):
    topics = Topics(lockstep)
    robot_at(cmd_vel_timeout=timeout, publish_rate=rate)
    begun = lockstep.now
    lockstep.publish('cmd_vel', twist(1.0, -3.0))
    lockstep.run_for(timeout + 1.1 / rate)
    assert instants(topics.applied) == [begun, begun + round(timeout * SECOND)]
    assert twists(topics.applied) == [(1.0, -3.0), (0.0, 0.0)]
    assert topics.odom[-1].pose.pose == pose_message(se2.integrate(3 * [0.0], [1.0, -3.0], timeout))
    assert at_rest(topics.odom[-1])


def test_the_shortest_timeout_is_not_for_ever(lockstep, robot_at):
    topics = Topics(lockstep)
    robot_at(cmd_vel_timeout=1e-10)
    lockstep.publish('cmd_vel', twist(1.0, 0.0))
    lockstep.run_for(0.02)
    assert instants(topics.applied) == [100 * SECOND, 100 * SECOND + 1]


def test_without_a_timeout_a_command_holds_for_ever(lockstep, robot_at):
    topics = Topics(lockstep)
    robot_at(cmd_vel_timeout=0.0, publish_rate=0.1)
    lockstep.publish('cmd_vel', twist(1.0, 0.0))
    lockstep.run_for(3600.0)
    assert len(topics.applied) == 1
    assert pose_of(topics.odom[-1]).tolist() == [3600.0, 0.0, 0.0]


@pytest.mark.parametrize('period', [0.1, 0.4, 0.5 - NANOSECOND])
def test_commands_in_time_keep_it_going(lockstep, robot_at, period):
    topics = Topics(lockstep)
    robot_at()
    for _ in range(10):
        lockstep.publish('cmd_vel', twist(1.0, 0.0))
        lockstep.run_for(period)
    assert twists(topics.applied) == [(1.0, 0.0)] * 10
    lockstep.run_for(1.0)
    assert twists(topics.applied) == [(1.0, 0.0)] * 10 + [(0.0, 0.0)]
    assert pose_of(topics.odom[-1])[0] == pytest.approx(9.0 * period + 0.5, abs=1e-14)


def test_a_command_in_the_instant_of_the_timeout_costs_no_way(lockstep, driving):
    lockstep.run_for(0.5)
    lockstep.publish('cmd_vel', twist(1.0, 0.0))
    lockstep.run_for(1.0)
    now = 100 * SECOND
    half = now + SECOND // 2
    assert instants(driving.applied) == [now, half, half, now + SECOND]
    assert pose_of(driving.odom[-1]).tolist() == [1.0, 0.0, 0.0]


def test_zero_stops_at_once_and_no_timeout_follows(lockstep, driving):
    lockstep.run_for(0.123)
    lockstep.publish('cmd_vel', Twist())
    lockstep.run_for(2.0)
    assert instants(driving.applied) == [100 * SECOND, 100 * SECOND + 123_000_000]
    assert pose_of(driving.odom[-1]).tolist() == [0.123, 0.0, 0.0]


@pytest.mark.parametrize('seconds', [0.5, 0.51, 3.0, 3600.0, 1e9])
def test_jump_forward_drives_on_to_the_timeout_only(lockstep, driving, seconds):
    lockstep.jump(seconds)
    odometry = driving.odom[-1]
    assert instants([odometry]) == [lockstep.now]
    assert pose_of(odometry).tolist() == [0.5, 0.0, 0.0]
    assert at_rest(odometry)
    assert instants(driving.applied) == [100 * SECOND, 100 * SECOND + SECOND // 2]


def test_jump_forward_within_the_timeout_is_no_more_than_time_that_passes(lockstep, driving):
    lockstep.jump(0.25)
    assert pose_of(driving.odom[-1]).tolist() == [0.25, 0.0, 0.0]
    lockstep.run_for(1.0)
    assert pose_of(driving.odom[-1]).tolist() == [0.5, 0.0, 0.0]


@pytest.mark.parametrize('seconds', [1e-9, 0.01, 0.25, 50.25, 99.0])
def test_time_that_goes_back_leaves_the_robot_where_it_is(lockstep, driving, capfd, seconds):
    lockstep.run_for(0.24)
    lockstep.jump(-seconds)
    back = lockstep.now
    assert instants(driving.starts) == [100 * SECOND, back]
    assert driving.starts[1].pose.pose.position.x == 0.24
    # The stop is told at once, on the new time line.
    assert instants(driving.applied) == [100 * SECOND, back]
    assert twists(driving.applied)[1] == (0.0, 0.0)
    driving.odom.clear()
    lockstep.run_for(1.0)
    assert {tuple(pose_of(one)) for one in driving.odom} == {(0.24, 0.0, 0.0)}
    assert len(driving.odom) in (49, 50)
    lockstep.publish('cmd_vel', twist(-1.0, 0.0))
    lockstep.run_for(1.0)
    assert pose_of(driving.odom[-1]).tolist() == [-0.26, 0.0, 0.0]
    assert instants(driving.applied)[2:] == [back + SECOND, back + SECOND + SECOND // 2]
    assert f'time went back by {seconds:.3f} s' in capfd.readouterr().err


def test_time_that_goes_back_again_and_again_adds_no_way(lockstep, driving):
    for count in range(1, 6):
        lockstep.publish('cmd_vel', twist(1.0, 0.0))
        lockstep.run_for(0.24)
        lockstep.jump(-2.0)
        assert len(driving.starts) == count + 1
        assert driving.starts[-1].pose.pose.position.x == pytest.approx(0.24 * count, abs=1e-15)
    lockstep.run_for(3.0)
    assert pose_of(driving.odom[-1]).tolist() == pytest.approx([1.2, 0.0, 0.0], abs=1e-15)


def test_time_that_goes_back_keeps_the_wheel_angles_and_the_heading(lockstep, robot_at):
    topics = Topics(lockstep)
    robot_at(0.0, 0.0, 3.0)
    lockstep.publish('cmd_vel', twist(0.0, 1.0))
    lockstep.run_for(0.4)
    before = topics.states[-1]
    lockstep.jump(-10.0)
    lockstep.run_for(0.1)
    assert topics.states[-1].position == before.position
    assert list(before.position) == pytest.approx([-0.4 * 0.08 / 0.033, 0.4 * 0.08 / 0.033], rel=1e-15)
    assert pose_of(topics.odom[-1])[2] == pytest.approx(3.4 - math.tau, abs=1e-15)
