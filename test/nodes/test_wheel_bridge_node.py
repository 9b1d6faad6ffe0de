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

"""The node wheel_bridge: twists in, wheel speeds out, in the order and the shape that motors take."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from support.lockstep_nodes import SECOND, change
from support.ros_messages import WHEELS, instants, twist, twist_stamped

from diffdrive_jacobian.drives.nodes import overrides
from diffdrive_jacobian.faults import TimeJump
from diffdrive_jacobian.kinematics.diff_drive import body_to_wheel
from diffdrive_jacobian.nodes.same_wheels import TRIES
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.parameters.wheels import WHEELS as WHEEL_PARAMETERS
from diffdrive_jacobian.ros.service_client import Liveness
from diffdrive_jacobian.simulation import Robot
from diffdrive_jacobian.simulation.actuators import Actuators

R, L = 0.033, 0.16
TWISTS = [(0.5, 3.0 * math.pi / 4.0), (0.0, -2.0), (-0.3, 1.0), (1000.0, -1000.0)]
GO, STOP = [0.2 / R] * 2, [0.0, 0.0]


@pytest.fixture
def out(lockstep):
    return lockstep.listen(JointState, 'joint_command')


def speeds(out):
    return [list(one.velocity) for one in out]


# --- Commands


def test_each_command_gives_one_message_with_left_and_right(lockstep, add):
    names, expected = 'abc', []
    outs = [lockstep.listen(JointState, f'{name}/joint_command') for name in 'ab']
    outs.append(lockstep.listen(Float64MultiArray, 'c/joint_command'))
    add(WheelBridge, 'a')
    add(WheelBridge, 'b', enable_stamped_cmd_vel=True)
    add(WheelBridge, 'c', joint_command_type='Float64MultiArray')
    for command in TWISTS:
        for name in names:
            message = twist_stamped(*command, lockstep.now) if name == 'b' else twist(*command)
            lockstep.publish(f'{name}/cmd_vel', message)
        right, left = body_to_wheel(*command, R, L)
        # After the timeout zero follows.
        expected += [[left, right], STOP]
        lockstep.run_for(0.7)
    assert speeds(outs[0]) == [list(one.data) for one in outs[2]] == expected
    assert outs[0] == outs[1]
    assert outs[0][0].name == WHEELS
    assert list(outs[0][0].position) == list(outs[0][0].effort) == []


def test_every_parameter_counts_from_the_next_command_on(lockstep, add, out):
    node = add(WheelBridge)

    def wheels(**parameters):
        assert change(node, **parameters).successful
        lockstep.publish('cmd_vel', twist(1.0, 1.0))
        return list(out[-1].velocity)

    assert wheels(wheel_radius=0.1, wheel_separation=1.0) == pytest.approx([5.0, 15.0])
    assert wheels(right_wheel_radius_multiplier=4.0) == pytest.approx([5.0, 3.75])
    assert wheels(left_wheel_radius_multiplier=0.5) == [10.0, 3.75]
    assert wheels(wheel_separation_multiplier=2.0) == pytest.approx([0.0, 5.0], abs=1e-14)
    names = {'left_wheel_name': 'l', 'right_wheel_name': 'r'}
    slowed = wheels(wheel_separation_multiplier=1.0, max_wheel_velocity=4.0, **names)
    assert slowed == pytest.approx([4.0, 1.5])
    assert out[-1].name == ['l', 'r']
    assert wheels(max_wheel_velocity=math.nan) == [10.0, 3.75]
    assert len(out) == 6


def test_invalid_and_old_commands_are_dropped_and_do_not_end_a_silence(lockstep, add, out, capfd):
    add(WheelBridge, enable_stamped_cmd_vel=True)
    lockstep.run_for(9.0)
    now = lockstep.now
    lockstep.publish('cmd_vel', twist_stamped(0.2, 0.0, now - 5))
    for v, offset in ((math.nan, 0), (0.1, 1), (0.1, -6)):
        lockstep.publish('cmd_vel', twist_stamped(v, 0.0, now + offset))
    assert 'command dropped: twist must be finite' in capfd.readouterr().err
    lockstep.run_for(0.3)
    lockstep.publish('cmd_vel', twist_stamped(math.nan, 0.0, 0))
    lockstep.run_for(0.2)
    assert 'no command on /cmd_vel for 0.5 s' in capfd.readouterr().err
    # Nor is one from before the stop followed.
    lockstep.publish('cmd_vel', twist_stamped(0.2, 0.0, lockstep.now - SECOND // 5))
    assert speeds(out) == [GO, STOP]
    assert instants(out) == [now - 5, now + SECOND // 2]


def test_stop_leaves_the_wheels_standing_and_reports_it_once(lockstep, add, out, capfd):
    node = add(WheelBridge)
    node.stop('too early')
    lockstep.publish('cmd_vel', twist(0.2, 0.0))
    node.stop('the test says so')
    node.stop('too late')
    lockstep.settle()
    assert speeds(out) == [GO, STOP]
    said = capfd.readouterr().err
    assert 'the wheels are stopped: the test says so' in said
    assert 'too' not in said


# --- Acceleration

LIMITS = {
    'linear__x__max_acceleration': 0.5,
    'linear__x__max_deceleration': -1.0,
    'angular__z__max_acceleration': 1.5,
    'max_wheel_acceleration': 40.0,
}


def test_wheels_accelerate_as_those_of_the_robot_and_stop_by_deceleration(lockstep, add, out, capfd):
    bridge = add(WheelBridge, **LIMITS, cmd_vel_timeout=0.7, publish_rate=40.0)
    model = bridge.parameters.model()
    actuators = Actuators(acceleration=bridge.parameters.acceleration_limits())
    robot = Robot(model=replace(model, actuators=actuators), stamp=lockstep.now, pose=(0.0, 0.0, 0.0))
    robots = [robot]
    for v, omega, seconds in ((0.4, 1.0, 0.33), (0.4, -0.5, 0.4), (-0.2, 0.0, 0.111), (0.3, 0.0, 2.0)):
        robots.append(robots[-1].commanded((v, omega), lockstep.now))
        lockstep.publish('cmd_vel', twist(v, omega))
        lockstep.run_for(seconds)
    silent = robots[-1].stamp + 7 * SECOND // 10
    robots.append(robots[-1].commanded((0.0, 0.0), silent))
    stamps = instants(out)
    for stamp, message in zip(stamps, out, strict=True):
        latest = [one for one in robots if one.stamp <= stamp][-1].at(stamp)
        right, left = latest.wheel_speeds
        assert list(message.velocity) == pytest.approx([left, right], abs=1e-12)
    assert max(map(abs, np.diff([one.velocity[0] for one in out]))) > 0.3
    # From 0.3 m/s at 1 m/s^2.
    assert stamps[-1] - silent == pytest.approx(0.3 * SECOND, abs=SECOND // 40 + 1)
    assert speeds(out)[-1] == STOP
    assert next(one for one in stamps if one > silent) == silent + SECOND // 40
    assert 'for 0.7 s: the wheels are stopped' in capfd.readouterr().err


def test_a_new_rate_counts_from_the_next_command_on(lockstep, add, out):
    bridge = add(WheelBridge, **LIMITS, publish_rate=10.0)
    for rate, v in ((10.0, 0.5), (50.0, -0.5)):
        assert change(bridge, publish_rate=rate).successful
        lockstep.publish('cmd_vel', twist(v, 0.0))
        out.clear()
        lockstep.run_for(0.31)
        assert len(out) == int(0.3 * rate)


def test_wheels_go_on_to_accelerate_where_time_goes_back_and_from_rest_after_a_stop(lockstep, add, out):
    bridge = add(WheelBridge, **LIMITS, cmd_vel_timeout=0.0)
    lockstep.inject(TimeJump(-5.0, start=0.1))
    lockstep.publish('cmd_vel', twist(0.4, 0.0))
    lockstep.run_for(1.2)
    v = [one.velocity[0] * R for one in out]
    assert v == sorted(v)
    assert max(np.diff(v)) == pytest.approx(0.5 * 0.02)
    assert v[-1] == pytest.approx(0.4)
    count = len(out)
    lockstep.run_for(1.0)
    assert len(out) == count
    bridge.stop('test')
    lockstep.settle()
    assert speeds(out)[-1] == STOP
    assert len(out) == count + 1
    lockstep.publish('cmd_vel', twist(0.4, 0.0))
    lockstep.run_for(0.02)
    assert out[-1].velocity[0] * R == pytest.approx(0.01)


# --- Whether the robot has the same wheels


def command(lockstep, times=4):
    for _ in range(times):
        lockstep.publish('cmd_vel', twist(0.2))
        lockstep.run_for(0.1)


@pytest.mark.parametrize(
    ('robot', 'bridge', 'said'),
    [
        (
            {'wheel_radius': 0.06},
            {'wheel_radius': 0.05},
            'wheel_radius 0.06 m instead of 0.05 m, for which its wheel speeds are computed: it drives '
            '1.2 times and turns 1.2 times as fast as commanded; give both nodes the same dimensions',
        ),
        ({'wheel_separation': 0.32}, {'wheel_separation_multiplier': 2.0}, None),
        ({}, {'wheel_separation_multiplier': 2.0}, 'wheel_separation 0.16 m instead of 0.32 m'),
        (
            {'right_wheel_radius_multiplier': 1.2},
            {},
            'right wheel radius 0.0396 m instead of 0.033 m, for which its wheel speeds are computed: '
            'it drives 1.1 times, straight lines on a curve, and turns 1.1 times',
        ),
    ],
)
def test_a_robot_with_other_wheels_is_warned_of_once(lockstep, capfd, robot, bridge, said):
    node = lockstep.add(WheelBridge(parameter_overrides=overrides({'wheel_radius': 1.0})))
    # The wheels are those when the robot answers.
    assert change(node, **{'wheel_radius': R, **bridge}).successful
    before = len(list(node.clients))
    robot = {'command_interface': 'wheels', **robot}
    lockstep.add(VirtualRobot(parameter_overrides=overrides(robot)))
    command(lockstep)
    text = capfd.readouterr().err
    assert text.count('/virtual_robot has ') == (said is not None)
    assert said is None or said in text
    # Nothing is left of the question.
    assert len(list(node.clients)) == before


@pytest.mark.parametrize('value', [None, 0.0, math.inf])
def test_who_has_no_wheels_or_impossible_ones_is_not_compared(lockstep, capfd, value):
    other = lockstep.add(Node('recorder'))
    if value is not None:
        other.declare_parameters('', [(name, value) for name in WHEEL_PARAMETERS])
    other.create_subscription(JointState, 'joint_command', lambda _: None, 10)
    lockstep.add(WheelBridge())
    command(lockstep)
    assert 'instead of' not in capfd.readouterr().err


@pytest.mark.parametrize('name', ['_ros2cli_1', 245 * 'n'])
def test_a_node_that_cannot_be_asked_is_not_looked_for_for_ever(lockstep, name):
    """It is hidden, or its name leaves no room for that of a service."""
    without = overrides({'start_type_description_service': False})
    other = lockstep.add(Node(name, start_parameter_services=False, parameter_overrides=without))
    other.create_subscription(JointState, 'joint_command', lambda _: None, 10)
    bridge = lockstep.add(WheelBridge())
    command(lockstep, TRIES - 1)
    assert bridge._same_wheels is not None
    command(lockstep, 2)
    assert bridge._same_wheels is None
    assert Liveness(lockstep.node, [f'/{name}']).silence() == 0.0
