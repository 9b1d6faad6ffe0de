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

"""Faults of all kinds on our three nodes: the same messages in each run, bit for bit."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.lockstep_nodes import make
from support.processes import run_python
from support.ros_messages import goal

from diffdrive_jacobian import faults
from diffdrive_jacobian.exploration.trial import MessageDigest
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.testing import Lockstep

SCHEDULES = (
    [
        faults.Loss('odom', probability=0.3, burst=2),
        faults.Delay('cmd_vel', 0.03, spread=0.1, growth=0.1, start=0.05, duration=0.2),
        faults.Duplicate('joint_command', probability=0.5, seconds=0.01),
        faults.Slow('virtual_robot', 0.015, start=0.1, duration=0.1),
        faults.TimeJump(-1.5, start=0.2, duration=0.1),
    ],
    [
        faults.Reorder('odom', 0.3, 0.05),
        faults.TimerJitter('go_to_goal', 0.01),
        faults.Kill('virtual_robot', start=0.1, duration=0.1),
        faults.RateLimit('joint_command', 20.0, start=0.2),
        faults.ParameterChange('virtual_robot', 'publish_rate', 20.0, start=0.05, duration=0.2),
    ],
    [
        faults.Hang('go_to_goal', start=0.1, duration=0.1),
        faults.Stale('odom', start=0.2, duration=0.1),
        faults.ClockPause(start=0.15, duration=0.1),
        faults.LateService('reset', 0.3),
        faults.Corrupt('cmd_vel', 'linear.x', 'scale', 0.9, probability=0.5),
    ],
)


def drive(number):
    """Return the hash of all messages of a drive of our three nodes under a schedule."""
    with Lockstep(['--ros-args', '--log-level', 'fatal']) as world, MessageDigest(world) as messages:
        world.create(lambda: make(VirtualRobot, command_interface='wheels'))
        world.create(lambda: make(WheelBridge))
        world.create(lambda: make(GoToGoal))
        world.inject(*SCHEDULES[number], seed=number)
        world.publish('goal_pose', goal(2.0, 1.0))
        world.run_for(0.4)
        # The events are messages, too.
        assert {event.fault for event in world.fault_events} == {*SCHEDULES[number]}
        return messages.value()


@pytest.mark.process
def test_schedules_are_the_same_each_time_also_in_another_process():
    first = [drive(number) for number in range(len(SCHEDULES))]
    assert len({*first}) == len(SCHEDULES)
    here = Path(__file__).parent
    program = (
        f'import sys; sys.path[:0] = {[str(here), str(here.parent)]}\n'
        f'import test_faults_same as t; print(*map(t.drive, range({len(SCHEDULES)})))'
    )
    run = run_python(program, timeout=120)
    assert run.stdout.split() == first, run.stderr
