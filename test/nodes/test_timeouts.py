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

KINDS = {
    'virtual_robot': (VirtualRobot, 'cmd_vel_timeout', {}, TwistStamped, 'cmd_vel_out'),
    'wheel_bridge': (WheelBridge, 'cmd_vel_timeout', {}, JointState, 'joint_command'),
    'go_to_goal': (
        *(GoToGoal, 'odom_timeout', {'enable_stamped_cmd_vel': True}),
        *(TwistStamped, 'cmd_vel'),
    ),
}
"""Class, parameter of the timeout, further parameters, and what the node sends."""


class Driven:
    """A node that something must be sent to, and what it lets the robot do."""

    def __init__(self, lockstep, add, name, timeout):
        kind, self.parameter, others, message, topic = KINDS[name]
        self.lockstep, self.name = lockstep, name
        self.out = lockstep.listen(message, topic)
        self.node = add(kind, **{self.parameter: timeout}, **others)
        if name == 'go_to_goal':
            lockstep.publish('goal_pose', goal(1.0, 0.0))

    def drive(self):
        """Send what it waits for."""
        if self.name == 'go_to_goal':
            self.lockstep.publish('odom', odometry(0.0, 0.0, 0.0))
        else:
            self.lockstep.publish('cmd_vel', twist(0.5, 0.0))

    def change_timeout(self, timeout):
        assert change(self.node, **{self.parameter: timeout}).successful

    @property
    def moves(self):
        return _moves(self.out[-1])

    @property
    def stops(self):
        """The times of the zeros (ns)."""
        return [time_of(one) for one in self.out if not _moves(one)]


def _moves(message):
    return bool(any(message.velocity) if isinstance(message, JointState) else message.twist.linear.x)


@pytest.fixture(params=KINDS)
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
        driven.change_timeout(timeout)
    lockstep.run_for(0.3)
    assert driven.stops == [last + 7 * SECOND // 10]
    # One that is over when it is set stops the robot.
    driven.drive()
    lockstep.run_for(0.3)
    driven.change_timeout(0.1)
    lockstep.run_for(0.03)
    assert len(driven.stops) == 2
    # Without one it drives on.
    driven.drive()
    driven.change_timeout(0.0)
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
