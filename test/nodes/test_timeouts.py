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

"""The timeouts of all three nodes: a robot that is driven blindly stops, exactly then, whatever happens
to the time."""

from __future__ import annotations

import pytest
from geometry_msgs.msg import TwistStamped
from sensor_msgs.msg import JointState
from support.lockstep_nodes import NANOSECOND, SECOND, change
from support.ros_messages import goal, odometry, time_of, twist

from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge


class Driven:
    """A node that something must be sent to, and what it lets the robot do."""

    parameter = 'cmd_vel_timeout'

    def __init__(self, lockstep, add, kind, timeout):
        self.lockstep, self.kind, stamped = lockstep, kind, {}
        if kind is GoToGoal:
            self.parameter, stamped = 'odom_timeout', {'enable_stamped_cmd_vel': True}
        message = JointState if kind is WheelBridge else TwistStamped
        topic = {VirtualRobot: 'cmd_vel_out', WheelBridge: 'joint_command', GoToGoal: 'cmd_vel'}[kind]
        self.out = lockstep.listen(message, topic)
        self.node = add(kind, **{self.parameter: timeout}, **stamped)
        if kind is GoToGoal:
            lockstep.publish('goal_pose', goal(1.0, 0.0))

    def drive(self):
        """Send what it waits for."""
        if self.kind is GoToGoal:
            self.lockstep.publish('odom', odometry(0.0, 0.0, 0.0))
        else:
            self.lockstep.publish('cmd_vel', twist(0.5, 0.0))

    @property
    def moves(self):
        return self._moves(self.out[-1])

    @property
    def stops(self):
        """The times of the zeros (ns)."""
        return [time_of(one) for one in self.out if not self._moves(one)]

    def _moves(self, message):
        return any(message.velocity) if self.kind is WheelBridge else message.twist.linear.x != 0.0


@pytest.fixture(params=[VirtualRobot, WheelBridge, GoToGoal])
def create(lockstep, add, request):
    """Create one of the nodes, with a timeout (s)."""
    return lambda timeout=0.5: Driven(lockstep, add, request.param, timeout)


@pytest.mark.parametrize('timeout', [1e-9, 0.3333])
def test_zero_comes_once_and_exactly_the_timeout_after_the_last_message(lockstep, create, timeout):
    driven, held = create(timeout), round(timeout * SECOND)
    for _ in range(3):
        driven.drive()
        last = lockstep.now
        lockstep.run_for(max(timeout / 3.0, NANOSECOND))
    lockstep.run_for(2.0)
    assert driven.stops[-1] == last + held
    # Nor any other, but for messages that come as seldom as the timeout allows.
    assert len(driven.stops) == (1 if held > 1 else 3)
    driven.drive()
    assert driven.moves


def test_a_new_timeout_counts_from_the_last_message_on(lockstep, create):
    """Requests of another process must not replace commands."""
    driven = create()
    driven.drive()
    last = lockstep.now
    for timeout in (2.0, 0.7):
        lockstep.run_for(0.3)
        assert change(driven.node, **{driven.parameter: timeout}).successful
    lockstep.run_for(0.3)
    assert driven.stops == [last + 7 * SECOND // 10]
    # One that is over when it is set stops the robot.
    driven.drive()
    lockstep.run_for(0.3)
    assert change(driven.node, **{driven.parameter: 0.1}).successful
    lockstep.run_for(0.03)
    assert len(driven.stops) == 2
    # Without one it drives on.
    driven.drive()
    assert change(driven.node, **{driven.parameter: 0.0}).successful
    lockstep.run_for(5.0)
    assert driven.moves


@pytest.mark.lockstep(start=100.0)
@pytest.mark.parametrize('seconds', [-50.0, -1e-9, 0.3, 1000.0])
def test_jumps_of_time_put_the_stop_off_by_a_timeout_at_most(lockstep, create, seconds):
    driven = create()
    driven.drive()
    lockstep.run_for(0.1)
    lockstep.jump(seconds)
    lockstep.run_for(0.5 if seconds < 0.0 else max(0.4 - seconds, 0.03))
    assert not driven.moves
    assert len(driven.stops) == 1
    # Nor is the node deaf then, and it stops the robot as before.
    driven.drive()
    assert driven.moves
    last = lockstep.now
    lockstep.run_for(0.6)
    assert driven.stops[1:] == [last + SECOND // 2]
