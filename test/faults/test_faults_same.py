"""Random faults of all kinds on our three nodes: the same messages in each run, bit for bit."""

from __future__ import annotations

import random
from functools import partial
from hashlib import sha256
from pathlib import Path

from action_msgs.msg import GoalStatus
from fork_server import forked
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from diffdrive_jacobian import faults
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.testing import Lockstep

TOPICS = {
    'odom': Odometry,
    'cmd_vel': Twist,
    'joint_states': JointState,
    'joint_command': JointState,
    'cmd_vel_out': TwistStamped,
    'goal_status': GoalStatus,
    'fault_events': String,
}


def schedule(seed):
    """Return a random schedule of faults of all kinds for robot, bridge and controller."""
    rng = random.Random(seed)
    topics = ('odom', 'cmd_vel', 'joint_command', 'goal_pose')
    nodes = ('virtual_robot', 'go_to_goal', 'wheel_bridge')

    def times():
        return {'start': rng.uniform(0.0, 0.4), 'duration': rng.choice([0.1, 0.2, 0.5])}

    def one():
        topic, node = rng.choice(topics), rng.choice(nodes)
        return rng.choice(
            [
                lambda: faults.Loss(topic, probability=0.3, burst=2, **times()),
                lambda: faults.Delay(topic, 0.03, spread=0.1, growth=0.1, **times()),
                lambda: faults.Reorder(topic, 0.3, 0.05, **times()),
                lambda: faults.Duplicate(topic, probability=0.5, seconds=0.01, **times()),
                lambda: faults.RateLimit(topic, 20.0, **times()),
                lambda: faults.Stale(topic, **times()),
                lambda: faults.Kill(node, **times()),
                lambda: faults.Hang(node, **times()),
                lambda: faults.Slow(node, 0.015, **times()),
                lambda: faults.TimerJitter(node, 0.01, **times()),
                lambda: faults.TimeJump(rng.uniform(-2.0, 2.0), **times()),
                lambda: faults.ClockPause(**times()),
                lambda: faults.LateService('reset', 0.3, **times()),
                lambda: faults.ParameterChange('virtual_robot', 'publish_rate', 20.0, **times()),
            ]
        )()

    return [one() for _ in range(5)]


def numbers(message):
    """Yield what a message contains, without the identifiers of goals, which are random."""
    for name in message.get_fields_and_field_types():
        value = getattr(message, name)
        if hasattr(value, 'get_fields_and_field_types'):
            yield from numbers(value)
        elif name != 'uuid':
            yield value.tobytes() if hasattr(value, 'tobytes') else repr(value).encode()


def drive(seed, seconds=0.6):
    """Return the hash of all messages of a drive of our three nodes under a random schedule."""
    digest = sha256()
    with Lockstep(['--ros-args', '--log-level', 'fatal']) as world:
        quick = {'start_parameter_services': False}
        wheels = [Parameter('command_interface', value='wheels')]
        world.create(lambda: VirtualRobot(parameter_overrides=wheels, **quick))
        world.create(lambda: WheelBridge(**quick))
        world.create(lambda: GoToGoal(**quick))

        def add(topic, message):
            digest.update(b''.join([topic.encode(), *numbers(message)]))

        for topic, message_type in TOPICS.items():
            world.node.create_subscription(message_type, topic, partial(add, topic), 1000)
        world.inject(*schedule(seed), seed=seed)
        goal = PoseStamped()
        goal.pose.position.x, goal.pose.position.y, goal.pose.orientation.w = 2.0, 1.0, 1.0
        world.publish('goal_pose', goal)
        world.run_for(seconds)
        digest.update(str([str(event) for event in world.fault_events]).encode())
        digest.update(str(world.now).encode())
        return digest.hexdigest(), len(world.fault_events)


def test_twenty_random_schedules_are_the_same_each_time_also_in_another_process():
    first = [drive(seed) for seed in range(20)]
    assert len({digest for digest, _ in first}) == 20
    assert all(count > 3 for _, count in first)
    program = 'import test_faults_same as t; print(*[t.drive(seed)[0] for seed in range(20)])'
    run = forked.run(program, cwd=Path(__file__).parent, timeout=120)
    assert run.stdout.split() == [digest for digest, _ in first]
    assert [drive(seed) for seed in (3, 1)] == [first[3], first[1]]
