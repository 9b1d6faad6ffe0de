"""CPU per odometry message: the three nodes beside the same traffic between bare rclpy nodes.

Run as `python test/benchmark/cpu.py`. Every figure is measured in a process of its own, the two sides
of a ratio in turn, so that a change of the machine's speed meets both. Each line gives the medians and
the median of the ratios, pair by pair.

The bare nodes send the same messages to each other and compute nothing: odometry and joint states by a
timer, a twist for each odometry, a joint command for each twist, a stamped twist for each joint command.
They make each message anew and stamp it, as rclpy's tutorials do; `prepared` ones send messages made
beforehand, which no real node could.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import statistics
import subprocess
import sys
import time
from functools import partial

os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'OFF'

WARM_UP = 1.0


def bare_nodes(context, rate, prepared=False):
    from geometry_msgs.msg import Twist, TwistStamped
    from nav_msgs.msg import Odometry
    from rclpy.node import Node
    from sensor_msgs.msg import JointState

    robot, controller, bridge = (
        Node(name, context=context) for name in ('robot', 'controller', 'bridge')
    )

    def made(make):
        message = make()
        return (lambda node: message) if prepared else (lambda node: make(node))

    def stamped(message, node):
        if node is not None:
            message.header.stamp = node.get_clock().now().to_msg()
        return message

    odometry = made(lambda node=None: stamped(Odometry(), node))
    twist = made(lambda node=None: Twist())
    applied = made(lambda node=None: stamped(TwistStamped(), node))
    wheels = made(
        lambda node=None: stamped(
            JointState(name=['left', 'right'], position=[0.0, 0.0], velocity=[0.0, 0.0]), node
        )
    )
    odom = robot.create_publisher(Odometry, 'odom', 10)
    joint_states = robot.create_publisher(JointState, 'joint_states', 10)
    out = robot.create_publisher(TwistStamped, 'cmd_vel_out', 10)
    cmd_vel = controller.create_publisher(Twist, 'cmd_vel', 10)
    joint_command = bridge.create_publisher(JointState, 'joint_command', 10)
    counter = {'odom': 0}

    def tick():
        odom.publish(odometry(robot))
        joint_states.publish(wheels(robot))

    def on_odometry(_):
        counter['odom'] += 1
        cmd_vel.publish(twist(controller))

    robot.create_timer(1.0 / rate, tick)
    controller.create_subscription(Odometry, 'odom', on_odometry, 10)
    bridge.create_subscription(Twist, 'cmd_vel', lambda _: joint_command.publish(wheels(bridge)), 10)
    robot.create_subscription(JointState, 'joint_command', lambda _: out.publish(applied(robot)), 10)
    return [robot, controller, bridge], counter


def our_nodes(context, rate):
    from geometry_msgs.msg import PoseStamped
    from rclpy.parameter import Parameter

    from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
    from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
    from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge

    counter = {'odom': 0}

    class Counting(GoToGoal):
        def _on_odometry(self, message):
            counter['odom'] += 1
            super()._on_odometry(message)

    robot = VirtualRobot(
        context=context,
        parameter_overrides=[
            Parameter('publish_rate', value=float(rate)),
            Parameter('command_interface', value='wheels'),
        ],
    )
    # Slow, and far from the goal: it is driven to for as long as the measurement lasts.
    slow = Parameter('linear.x.max_velocity', value=0.2)
    controller = Counting(context=context, parameter_overrides=[slow])
    goal = PoseStamped()
    goal.pose.position.x = goal.pose.position.y = 1e5
    controller._on_goal_pose(goal)
    return [robot, controller, WheelBridge(context=context)], counter


def measure(side, executor_name, rate, seconds):
    """Spin one side; print CPU seconds per odometry message."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    from diffdrive_jacobian.ros.runner import make_executor, ros_context

    with ros_context(['benchmark']) as context:
        if executor_name == 'events':
            executor = make_executor(context, closed_world=True)
            assert not isinstance(executor, SingleThreadedExecutor), 'no EventsExecutor here'
        else:
            executor = SingleThreadedExecutor(context=context)
        sides = {'ours': our_nodes, 'bare': bare_nodes, 'prepared': partial(bare_nodes, prepared=True)}
        nodes, counter = sides[side](context, rate)
        for node in nodes:
            executor.add_node(node)
        result = {}

        def begin():
            result['cpu'], result['odom'] = time.process_time(), counter['odom']

        def end():
            result['cpu'] = time.process_time() - result['cpu']
            result['odom'] = counter['odom'] - result['odom']
            executor.wake()

        if executor_name == 'rclpy.spin':
            # As a user would write it: rclpy.spin(node, executor), ended by a timer.
            begun = nodes[0].create_timer(WARM_UP, lambda: (begin(), begun.cancel()))
            ended = nodes[0].create_timer(
                WARM_UP + seconds, lambda: (end(), ended.cancel(), context.try_shutdown())
            )
            with contextlib.suppress(rclpy.executors.ExternalShutdownException):
                rclpy.spin(nodes[0], executor)
        else:
            stop = time.monotonic() + WARM_UP
            while time.monotonic() < stop:
                executor.spin_once(timeout_sec=0.1)
            begin()
            stop = time.monotonic() + seconds
            while time.monotonic() < stop:
                executor.spin_once(timeout_sec=0.1)
            end()
            executor.shutdown()
            for node in nodes:
                node.destroy_node()
        print(result['cpu'] / result['odom'], result['odom'] / seconds)


def run(*arguments):
    command = [sys.executable, __file__, '--measure', *map(str, arguments)]
    output = subprocess.run(command, check=True, capture_output=True, text=True, timeout=120).stdout
    return [float(word) for word in output.split()]


def compare(title, first, second, rounds):
    pairs = [(run(*first), run(*second)) for _ in range(rounds)]
    a, b = (statistics.median(pair[side][0] for pair in pairs) * 1e6 for side in (0, 1))
    ratio = statistics.median(one[0] / other[0] for one, other in pairs)
    reached = min(min(one[1], other[1]) for one, other in pairs)
    print(f'{title:52s} {a:9.0f} us {b:9.0f} us {ratio:7.2f}   {reached:6.1f} Hz', flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--measure', nargs=4, help=argparse.SUPPRESS)
    parser.add_argument('--seconds', type=float, default=8.0)
    parser.add_argument('--rounds', type=int, default=3)
    options = parser.parse_args()
    if options.measure:
        side, executor, rate, seconds = options.measure
        measure(side, executor, float(rate), float(seconds))
        return
    seconds, rounds = options.seconds, options.rounds
    print(f'{"CPU per odometry message":52s} {"first":>12s} {"second":>12s} {"ratio":>7s}   slowest')
    for rate in (50, 500):
        for executor in ('events', 'single'):
            for bare in ('bare', 'prepared'):
                compare(
                    f'three nodes / {bare} nodes, {executor}, {rate} Hz',
                    ('ours', executor, rate, seconds),
                    (bare, executor, rate, seconds),
                    rounds,
                )
        compare(
            f'three nodes, as in drive_to / on rclpy.spin, {rate} Hz',
            ('ours', 'events', rate, seconds),
            ('ours', 'rclpy.spin', rate, seconds),
            rounds,
        )


if __name__ == '__main__':
    main()
