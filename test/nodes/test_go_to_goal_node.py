"""The node go_to_goal: goals in, one command per odometry message, a status for each goal."""

from __future__ import annotations

import math

import numpy as np
import pytest
from geometry_msgs.msg import Twist, TwistStamped
from std_srvs.srv import Trigger
from support.lockstep_nodes import (
    ABORTED,
    ACCEPTED,
    CANCELED,
    EXECUTING,
    SUCCEEDED,
    Controller,
    change,
)
from support.ros_messages import goal, goals, instants, odometry, twists

from diffdrive_jacobian.control import VelocityLimits, go_to_goal, saturate, turn_in_place

POSES = [
    (0.0, 0.0, 0.0),
    (1.0, 1.0, 2.0),
    (2.0, -0.9, -3.0),
    (1.9, -1.0, 0.1),
    (5.0, -1.0, 0.0),
    (2.0, 3.0, math.pi),
    (-1e5, 1e5, -math.pi),
]


@pytest.fixture
def controller(lockstep):
    return Controller(lockstep)


def test_golden_command_of_document_a(controller):
    controller.send(goal(1.0, 1.0))
    v, omega = controller.at(0.0, 0.0)
    assert (round(v, 3), round(omega, 3)) == (0.5, 2.356)


@pytest.mark.parametrize('gains', [(3.0, 0.5), (12.0, 6.0), (0.1, 0.01), (100.0, 99.0)], ids=str)
def test_each_odometry_is_answered_by_the_law_and_arrival_by_zero(lockstep, gains):
    kp, kv = gains
    controller = Controller(lockstep, kp=kp, kv=kv)
    controller.send(goal(2.0, -1.0, stamp=7))
    limits = VelocityLimits(min_v=-1e3, max_v=1e3, min_omega=-1e3, max_omega=1e3)
    for pose in POSES:
        law = saturate(*go_to_goal(pose, [2.0, -1.0], kp, kv), limits, 1.0, 1.0)
        assert controller.at(*pose) == pytest.approx(law, rel=1e-12, abs=1e-12)
    assert controller.at(2.01, -1.01) == (0.0, 0.0)
    assert controller.statuses == [(7, ACCEPTED), (7, EXECUTING), (7, SUCCEEDED)]


def test_without_a_goal_it_is_silent(lockstep, controller):
    assert [controller.sees(odometry(0, 0, 0)) for _ in range(3)] == [[], [], []]
    lockstep.run_for(10.0)
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


@pytest.mark.parametrize('theta', [0.0, math.pi, -3.0])
@pytest.mark.parametrize('distance', [0.0, 0.0199])
def test_goal_on_the_own_spot_succeeds_at_once(controller, distance, theta):
    controller.send(goal(-distance, 0.0))
    assert controller.at(0.0, 0.0, theta) == (0.0, 0.0)
    assert controller.statuses == [(0, ACCEPTED), (0, EXECUTING), (0, SUCCEEDED)]
    assert controller.node.waypoint is None


@pytest.mark.parametrize('tolerance', [1e-6, 0.02, 0.5, 100.0])
def test_tolerance_tells_arrived_from_not_yet_and_changes_live(controller, tolerance):
    assert change(controller.node, xy_goal_tolerance=tolerance).successful
    controller.send(goal(0.0, 0.0))
    assert controller.at(-1.001 * tolerance, 0.0)[0] == pytest.approx(0.5 * 1.001 * tolerance)
    assert controller.at(0.0, 0.999 * tolerance) == (0.0, 0.0)
    assert controller.statuses[-1] == (0, SUCCEEDED)


def test_waypoints_are_driven_in_order(controller):
    controller.send(goals(goal(1, 0), goal(1, 1), goal(0, 1), stamp=3))
    # Near a later waypoint the one that is due is driven to nevertheless.
    assert controller.at(0, 1, -math.pi / 4)[0] == pytest.approx(0.5 * math.sqrt(2.0))
    assert controller.node.waypoint == 0
    assert controller.at(1.0, 0.0) == pytest.approx((0.0, 3.0 * math.pi / 2), abs=1e-12)
    assert controller.node.waypoint == 1
    assert controller.at(1.0, 0.0, math.pi / 2)[0] == pytest.approx(0.5)
    controller.at(1.0, 1.0, math.pi / 2)
    assert controller.node.waypoint == 2
    assert controller.at(0.0, 1.0) == (0.0, 0.0)
    assert controller.statuses == [(3, ACCEPTED), (3, EXECUTING), (3, SUCCEEDED)]


@pytest.mark.parametrize('count', [1, 2, 5, 50])
def test_waypoints_on_one_spot_are_all_reached_at_once(controller, count):
    controller.send(goals(*[goal(1, 1)] * count))
    assert controller.at(1.0, 1.0) == (0.0, 0.0)
    assert controller.statuses[-1] == (0, SUCCEEDED)


@pytest.mark.parametrize('count', [1, 3])
def test_new_goal_replaces_the_active_one(controller, count):
    controller.send(goal(1, 0, stamp=1))
    assert controller.at(0, 0) == (0.5, 0.0)
    for stamp in range(2, 2 + count):
        controller.send(goal(-stamp, 0, stamp=stamp))
    assert controller.at(0, 0, math.pi) == pytest.approx((0.5 * (1 + count), 0.0), abs=1e-12)
    replaced = [(n, status) for n in range(2, 1 + count) for status in (ACCEPTED, CANCELED)]
    assert controller.statuses == [
        (1, ACCEPTED),
        (1, EXECUTING),
        (1, CANCELED),
        *replaced,
        (1 + count, ACCEPTED),
        (1 + count, EXECUTING),
    ]
    ids = [bytes(one.goal_info.goal_id.uuid) for one in controller.status]
    assert len(set(ids)) == 1 + count


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
    assert controller.sees(odometry(0, 0, 0)) == []
    # Also before any odometry came.
    controller.send(goal(1, 0, stamp=2))
    assert cancel() == (True, 'goal canceled, zero sent')
    assert controller.statuses[3:] == [(2, ACCEPTED), (2, CANCELED)]


@pytest.mark.parametrize(
    ('heading', 'theta'), [(-2.0, 2.0), (0.0, math.pi), (math.pi, -3.0), (1.0, 1.2), (-1.0, -1.2)]
)
@pytest.mark.parametrize('kp', [3.0, 12.0])
def test_final_heading_is_reached_by_the_smaller_angle_when_it_counts(lockstep, heading, theta, kp):
    controller = Controller(lockstep, kp=kp, use_goal_heading=True, yaw_goal_tolerance=0.1)
    controller.send(goals(goal(1, 0, 2.0), goal(1, 1, heading)))
    controller.at(0, 0)
    # The heading of a waypoint on the way does not count.
    assert controller.at(1.0, 0.0, math.pi / 2) == pytest.approx((0.5, 0.0), abs=1e-12)
    assert controller.at(1.0, 1.0, theta) == pytest.approx(turn_in_place(theta, heading, kp))
    # The position is not looked at any more.
    assert controller.at(1.0, 1.1, heading - 0.11) == pytest.approx((0.0, kp * 0.11))
    assert controller.at(1.0, 1.0, heading + 0.09) == (0.0, 0.0)
    assert controller.statuses[-1] == (0, SUCCEEDED)


def test_use_of_the_heading_changes_live(controller):
    controller.send(goal(1, 1, 2.0))
    controller.at(0, 0)
    assert change(controller.node, use_goal_heading=True).successful
    assert controller.at(1, 1, 0.0) == pytest.approx((0.0, 6.0))
    assert change(controller.node, yaw_goal_tolerance=2.1).successful
    assert controller.at(1, 1, 0.0) == (0.0, 0.0)


@pytest.mark.parametrize(
    'limits',
    [
        {'max_v': 0.2, 'max_omega': 1.0},
        {'max_v': 0.2},
        {'max_omega': 0.5},
        {'max_v': 0.1, 'min_v': 0.0, 'max_omega': 2.0, 'min_omega': -0.3},
    ],
    ids=str,
)
@pytest.mark.parametrize('target', [(5.0, 2.0), (-5.0, 0.1), (0.3, -2.0)], ids=str)
def test_limits_keep_the_curvature_and_change_live(controller, target, limits):
    names = {
        'max_v': 'linear__x__max_velocity',
        'min_v': 'linear__x__min_velocity',
        'max_omega': 'angular__z__max_velocity',
        'min_omega': 'angular__z__min_velocity',
    }
    controller.send(goal(*target))
    free = controller.at(0, 0)
    assert change(controller.node, **{names[key]: value for key, value in limits.items()}).successful
    v, omega = controller.at(0, 0)
    symmetric = {'max_v': math.inf, 'max_omega': math.inf, **limits}
    for part in ('v', 'omega'):
        symmetric.setdefault(f'min_{part}', -symmetric[f'max_{part}'])
    assert (v, omega) == pytest.approx(saturate(*free, VelocityLimits(**symmetric), 1.0, 1.0))
    assert symmetric['min_v'] <= v <= symmetric['max_v']
    assert symmetric['min_omega'] <= omega <= symmetric['max_omega']
    assert v == 0.0 or omega / v == pytest.approx(free[1] / free[0], rel=1e-12)


@pytest.mark.parametrize('distance', [3e3, 9e5])
def test_far_goals_ask_for_nothing_that_a_robot_would_drop(controller, distance):
    controller.send(goal(distance, distance))
    v, omega = controller.at(0, 0)
    wanted_v, wanted_omega = go_to_goal([0, 0, 0], [distance, distance], 3.0, 0.5)
    assert v == 1000.0
    assert omega / v == pytest.approx(wanted_omega / wanted_v, rel=1e-12)


def test_stamped_commands_carry_the_time(lockstep):
    controller = Controller(lockstep, TwistStamped, enable_stamped_cmd_vel=True)
    controller.send(goal(1, 0))
    sent = []
    for x in np.linspace(0.0, 1.0, 5):
        controller.at(x, 0)
        sent.append(lockstep.now)
        lockstep.run_for(0.123)
    assert instants(controller.commands) == sent
    assert {one.header.frame_id for one in controller.commands} == {''}


@pytest.mark.parametrize(('kp', 'warned'), [(0.5, True), (0.4, True), (0.6, False)])
def test_gains_that_spiral_are_warned_about(controller, capfd, kp, warned):
    controller.send(goal(1, 0))
    assert change(controller.node, kp=kp).successful
    assert controller.at(0, 0, 1.0) == pytest.approx((0.5 * math.cos(1.0), -kp))
    assert (f'kp {kp} is not larger than kv 0.5' in capfd.readouterr().err) == warned


@pytest.mark.parametrize('name', ['kp', 'kv'])
@pytest.mark.parametrize('bad', [0.0, -1.0, math.nan, math.inf, 101.0])
def test_invalid_gains_are_refused(controller, name, bad):
    controller.send(goal(1, 0))
    before = controller.at(0, 0, 1.0)
    result = change(controller.node, **{name: bad})
    assert not result.successful
    assert name in result.reason
    assert controller.at(0, 0, 1.0) == before


def test_robot_that_may_not_drive_is_warned_about(controller, capfd):
    assert change(controller.node, linear__x__max_velocity=0.0).successful
    controller.send(goal(1, 1))
    assert controller.at(0, 0) == pytest.approx((0.0, 3.0 * math.pi / 4))
    assert 'linear.x.max_velocity is 0: the robot may not drive forward' in capfd.readouterr().err


def test_stop_gives_the_goal_up_once(lockstep, controller):
    controller.node.stop('too early')
    controller.send(goal(1, 0))
    controller.at(0, 0)
    controller.node.stop('the test says so')
    controller.node.stop('too late')
    lockstep.settle()
    assert twists(controller.commands) == [(0.5, 0.0), (0.0, 0.0)]
    assert controller.commands[-1] == Twist()
    assert controller.statuses == [(0, ACCEPTED), (0, EXECUTING), (0, CANCELED)]


@pytest.mark.parametrize(
    'message', [goal(1, 0, frame='map', stamp=5), goals(stamp=5)], ids=['frame', 'none']
)
def test_latecomer_sees_the_status_of_what_goes_on(lockstep, controller, message):
    controller.send(goal(1, 0, frame='odom', stamp=1))
    controller.at(0, 0)
    controller.send(message)
    latched = lockstep.listen(type(controller.status[0]), 'goal_status', latched=True)
    assert latched == controller.status
    assert controller.statuses[2:] == [(5, ABORTED), (1, EXECUTING)]
