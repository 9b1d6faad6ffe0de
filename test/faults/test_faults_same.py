"""Random faults of all kinds on our three nodes: the same messages in each run, bit for bit."""

from __future__ import annotations

import random
from functools import partial
from hashlib import sha256
from pathlib import Path

import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from support.lockstep_nodes import make
from support.processes import run_python
from support.ros_messages import goal

from diffdrive_jacobian import faults
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.testing import Lockstep

SCHEDULES = 3
TOPICS = {
    'odom': Odometry,
    'cmd_vel': Twist,
    'joint_states': JointState,
    'joint_command': JointState,
    'cmd_vel_out': TwistStamped,
    'goal_status': GoalStatus,
    'fault_events': String,
}
KINDS = [
    partial(faults.Loss, probability=0.3, burst=2),
    partial(faults.Delay, seconds=0.03, spread=0.1, growth=0.1),
    partial(faults.Reorder, probability=0.3, seconds=0.05),
    partial(faults.Duplicate, probability=0.5, seconds=0.01),
    partial(faults.RateLimit, rate=20.0),
    faults.Stale,
    faults.Kill,
    faults.Hang,
    partial(faults.Slow, seconds=0.015),
    partial(faults.TimerJitter, seconds=0.01),
    lambda **times: faults.TimeJump(-1.5, **times),
    lambda **times: faults.TimeJump(0.7, **times),
    faults.ClockPause,
    lambda **times: faults.LateService('reset', 0.3, **times),
    lambda **times: faults.ParameterChange('virtual_robot', 'publish_rate', 20.0, **times),
]


def schedules():
    """Return random schedules in which each kind of fault appears once."""
    chance = random.Random(1)
    kinds = chance.sample(KINDS, len(KINDS))
    made = [[] for _ in range(SCHEDULES)]
    for index, kind in enumerate(kinds):
        times = {'start': chance.uniform(0.0, 0.2), 'duration': chance.choice([0.1, 0.2, 0.5])}
        if isinstance(kind, partial) or kind in (faults.Stale, faults.Kill, faults.Hang):
            of_topic = issubclass(getattr(kind, 'func', kind), faults.TopicFault)
            topics, nodes = ('odom', 'cmd_vel', 'joint_command'), ('virtual_robot', 'go_to_goal')
            times['topic' if of_topic else 'node'] = chance.choice(topics if of_topic else nodes)
        made[index % SCHEDULES].append(kind(**times))
    return made


def drive(number):
    """Return the hash of all messages of a drive of our three nodes under a random schedule."""
    digest = sha256()
    with Lockstep(['--ros-args', '--log-level', 'fatal']) as world:
        world.create(lambda: make(VirtualRobot, command_interface='wheels'))
        world.create(lambda: make(WheelBridge))
        world.create(lambda: make(GoToGoal))

        def add(topic, message):
            digest.update(topic.encode() + message)

        for topic, message_type in TOPICS.items():
            world.node.create_subscription(message_type, topic, partial(add, topic), 1000, raw=True)
        world.inject(*schedules()[number], seed=number)
        world.publish('goal_pose', goal(2.0, 1.0))
        world.run_for(0.4)
        digest.update(str([str(event) for event in world.fault_events]).encode())
        digest.update(str(world.now).encode())
        return digest.hexdigest(), len(world.fault_events)


@pytest.mark.process
def test_random_schedules_are_the_same_each_time_also_in_another_process():
    first = [drive(number) for number in range(SCHEDULES)]
    assert len({digest for digest, _ in first}) == SCHEDULES
    assert all(count > 1 for _, count in first)
    here = Path(__file__).parent
    program = (
        f'import sys; sys.path[:0] = {[str(here), str(here.parent)]}\n'
        f'import test_faults_same as t; print(*[t.drive(number)[0] for number in range({SCHEDULES})])'
    )
    run = run_python(program, timeout=120)
    assert run.stdout.split() == [digest for digest, _ in first], run.stderr
