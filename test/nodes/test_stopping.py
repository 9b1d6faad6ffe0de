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

"""Robots that take time to stop: predicted distances, braking in time, and arrival at rest."""

from __future__ import annotations

import dataclasses
import math
import random

import numpy as np
import pytest
from std_srvs.srv import Trigger
from support.lockstep_nodes import CANCELED, Controller, Topics, make
from support.ros_messages import goal, odometry

from diffdrive_jacobian.drives import drive
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.simulation import Robot, RobotModel
from diffdrive_jacobian.simulation.actuators import AccelerationLimits, Actuators, AxisLimits
from diffdrive_jacobian.simulation.braking import Braking

pytestmark = pytest.mark.slow
SLOW = {'linear.x.max_acceleration': 0.4, 'linear.x.max_deceleration': -0.1}
ACTUATORS = Actuators(
    acceleration=AccelerationLimits(
        v=AxisLimits(max_acceleration=0.4, max_deceleration=-0.1),
        omega=AxisLimits(max_acceleration=2.0, max_deceleration=-1.0),
    ),
    lag=0.1,
    delay=200_000_000,
)
SECOND = 1_000_000_000
PERIOD = SECOND // 50


def travelled(robot):
    """Return the distance and the turn by the wheels since the start."""
    right, left = robot.wheel_angles
    return 0.033 * (right + left) / 2.0, 0.033 * (right - left) / 0.16


def stopped(robot):
    """Return a robot that was commanded to stop, at rest."""
    return robot.commanded((0.0, 0.0), robot.stamp).at(robot.stamp + 20 * SECOND)


def test_a_robot_rolls_as_far_as_predicted():
    start = Robot(model=RobotModel(actuators=ACTUATORS), stamp=0, pose=(0.0, 0.0, 0.0))
    for command in [(0.3, 0.0), (0.3, 1.0), (0.05, 0.9), (0.0, -0.2)]:
        # It has followed the command for long.
        robot = start.commanded(command, 0).at(20 * SECOND)
        rolled = np.subtract(travelled(stopped(robot)), travelled(robot))
        expected = ACTUATORS.stopping_distance(command, robot.model)
        assert rolled == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize('lag', [0.0, 0.1])
@pytest.mark.parametrize('delay', [0, SECOND // 5])
def test_a_braked_robot_comes_to_rest_within_the_room_wherever_it_is_stopped(lag, delay):
    """Whatever it is commanded: after each command a stop one period later ends in time."""
    chance = random.Random(f'{lag} {delay}')
    actuators = dataclasses.replace(ACTUATORS, lag=lag, delay=delay)
    model = RobotModel(actuators=actuators)
    used = []
    for _ in range(4):
        room, turn = chance.uniform(0.0, 0.5), chance.choice((math.inf, chance.uniform(0.5, 3.0)))
        braking, stamp = Braking(actuators), 0
        robot = Robot(model=model, stamp=0, pose=(0.0, 0.0, 0.0))
        for number in range(150):
            if number % 25 == 0:
                command = chance.uniform(0.0, 0.5), chance.uniform(-1.0, 1.0)
            left = room - travelled(robot)[0], turn - abs(travelled(robot)[1])
            v, omega = braking.limited(stamp, robot.twist, command, lambda _, left=left: left, 0.02)
            assert v * command[1] == pytest.approx(omega * command[0])
            braking.sent(stamp, (v, omega))
            stamp += PERIOD
            robot = robot.commanded((v, omega), robot.stamp).at(stamp)
            if number % 3:
                continue
            distance, turned = travelled(stopped(robot))
            assert distance <= room + 1e-9
            assert abs(turned) <= turn + 1e-9
        used.append(max(distance / room, abs(turned) / turn))
    # It uses the room, and does not simply creep.
    assert np.median(used) > 0.95


def test_braking_uses_the_twist_by_the_odometry_and_the_point_that_is_driven():
    """Straight on, without delay and lag: v <= sqrt(2 a D)."""
    limits = AccelerationLimits(v=AxisLimits(max_deceleration=-0.1))
    braking = Braking(Actuators(acceleration=limits))
    v, omega = braking.limited(0, (0.0, 0.0), (1.0, 0.0), lambda _: (0.2, math.inf), 0.0)
    assert (v, omega) == (pytest.approx(math.sqrt(2.0 * 0.1 * 0.2), abs=1e-3), 0.0)
    # It is faster than what was commanded, and decelerates.
    assert braking.limited(SECOND, (0.3, 0.0), (0.1, 0.0), lambda _: (0.2, math.inf), 0.0) == (0.0, 0.0)
    # The yaw rate decelerates at once, but a point off the axle moves with it.
    turning = Actuators(acceleration=AccelerationLimits(omega=AxisLimits(max_deceleration=-0.5)))
    v, omega = Braking(turning).limited(
        0, (0.0, 0.0), (0.0, 2.0), lambda _: (0.1, math.inf), 0.0, offset=0.1
    )
    assert (v, omega) == (0.0, pytest.approx(1.0, abs=1e-3))


def test_braking_is_reset_when_the_clock_is_set_back():
    braking = Braking(dataclasses.replace(ACTUATORS, lag=0.0))
    for stamp in (100 * SECOND, SECOND):
        found = braking.limited(stamp, (0.3, 0.0), (0.3, 0.0), lambda _: (2.0, math.inf), 0.02)
        assert found == (0.3, 0.0)
        braking.sent(stamp, found)


@pytest.mark.parametrize(
    ('goal', 'limits', 'law'),
    [
        # Just outside of the tolerance, and aside: the room must not vanish at its rim.
        ((-0.01616, -0.01212, 0.0), (0.3, 1.0, 1.0), {}),
        ((-0.5, 0.0, 0.0), (1.0, 0.3, 0.2), {'controller': 'offset_point', 'offset': 0.3}),
    ],
)
def test_a_robot_that_stops_in_time_arrives_and_rests_within_the_tolerance(goal, limits, law):
    v, omega, fastest = limits
    known = {
        'linear.x.max_acceleration': v,
        'angular.z.max_acceleration': omega,
        'linear.x.max_velocity': fastest,
    }
    parameters = {**known, **law, 'stop_in_time': True}
    outcome = drive([goal], lockstep=True, timeout=60.0, parameters=parameters, robot_parameters=known)
    assert outcome.arrived
    assert outcome.distance <= 0.02 + fastest * 0.02


def test_a_goal_is_reached_when_the_odometry_says_that_the_robot_rests(lockstep):
    controller = Controller(lockstep, trans_stopped_velocity=0.1)

    def sees(x, v):
        message = odometry(x, 0.0, 0.0)
        message.twist.twist.linear.x = v
        return controller.sees(message)

    controller.send(goal(1.0, 0.0))
    assert sees(0.0, 0.5) == [(0.5, 0.0)]
    assert sees(1.0, 0.5) == [(0.0, 0.0)]
    # It has rolled away.
    assert sees(0.5, 0.05) == [(0.25, 0.0)]
    assert sees(1.0, math.nan) == []
    assert controller.node.waypoint == 0
    assert sees(1.0, 0.1) == [(0.0, 0.0)]
    assert controller.node.waypoint is None


def test_canceling_says_how_far_the_robot_rolls(lockstep, capfd):
    lockstep.add(make(VirtualRobot, **SLOW))
    lockstep.add(make(GoToGoal, **SLOW))
    topics = Topics(lockstep)
    lockstep.run_for(0.1)
    lockstep.publish('goal_pose', goal(3.0, 0.0))
    lockstep.run_for(0.5)
    response = lockstep.call(Trigger, 'cancel_goal')
    v = topics.odom[-1].twist.twist.linear.x
    assert v > 0.1
    assert topics.statuses[-1] == CANCELED
    assert f'rolls on for about {v * v / 0.2:.3f} m' in response.message
    assert 'rolls on for about' in capfd.readouterr().err
