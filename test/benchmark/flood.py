"""A flood: another process publishes as fast as it can; the nodes must keep their rate and stop in time.

Run as `python test/benchmark/flood.py`. Each node runs in a process of its own, as its entry point
starts it. Printed for each flood: the timer's rate beside that before the flood, the growth of the
resident memory, and whether the timeout still stopped the robot.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ.setdefault('ROS_DOMAIN_ID', str(os.getpid() % 100 + 1))

from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from diffdrive_jacobian.ros.runner import ros_context

TYPES = {'odom': Odometry, 'cmd_vel': Twist}
ENTRY = 'import sys; from diffdrive_jacobian.tools.entry_points import {0}; sys.exit({0}())'


def flood(topic, seconds):
    """Publish on a topic as fast as it goes; print how many."""
    with ros_context(['flood']) as context:
        node = Node('flood', context=context)
        publisher = node.create_publisher(TYPES[topic], topic, 10)
        message = TYPES[topic]()
        if topic == 'odom':
            message.header.frame_id = 'odom'
        else:
            message.linear.x = 0.1
        end, count = time.monotonic() + seconds, 0
        while time.monotonic() < end:
            publisher.publish(message)
            count += 1
        print(count / seconds)
        node.destroy_node()


def resident(process):
    """Resident memory of a process (MB)."""
    status = Path(f'/proc/{process.pid}/status').read_text()
    return int(status.split('VmRSS:')[1].split()[0]) / 1024.0


class Observer:
    """Counts odometry and remembers how the robot moves, by the robot's own stamps."""

    def __init__(self, context, name):
        self.node = Node('observer', context=context)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        self.stamps, self.moving = [], False
        self.node.create_subscription(Odometry, name, self._on_odometry, 10)

    def _on_odometry(self, message):
        self.stamps.append(message.header.stamp.sec + message.header.stamp.nanosec * 1e-9)
        self.moving = message.twist.twist != Twist()

    def spin(self, seconds=None, until=None, patience=10.0):
        end = time.monotonic() + (patience if seconds is None else seconds)
        while time.monotonic() < end and not (until and until()):
            self.executor.spin_once(timeout_sec=0.05)

    def rate(self, seconds):
        """Rate and worst gap of the odometry over a while (Hz, s)."""
        self.stamps.clear()
        self.spin(seconds)
        gaps = [b - a for a, b in zip(self.stamps, self.stamps[1:], strict=False)]
        return len(gaps) / sum(gaps), max(gaps)


def under_flood(name, topic, seconds, arguments=()):
    """Start a node, measure it idle and under a flood of a topic, print a line."""
    with ros_context(['observer']) as context:
        # The robot's odometry goes by another name where odometry is what floods.
        odom = 'robot_odom' if topic == 'odom' else 'odom'
        robot_arguments = ['--ros-args', '-r', f'odom:={odom}']
        robot = subprocess.Popen([sys.executable, '-c', ENTRY.format('virtual_robot'), *robot_arguments])
        node = robot
        if name != 'virtual_robot':
            node = subprocess.Popen([sys.executable, '-c', ENTRY.format(name), *arguments])
        observer = Observer(context, odom)
        try:
            observer.spin(until=lambda: len(observer.stamps) > 50)
            idle, _ = observer.rate(3.0)
            goal = observer.node.create_publisher(PoseStamped, 'goal_pose', 10)
            if name == 'go_to_goal':
                observer.spin(until=lambda: goal.get_subscription_count() > 0)
                far = PoseStamped()
                far.pose.position.x = 1e4
                goal.publish(far)
            before = resident(node)
            flooding = subprocess.Popen(
                [sys.executable, __file__, '--flood', topic, str(seconds)],
                stdout=subprocess.PIPE,
                text=True,
            )
            observer.spin(3.0)
            after_start = resident(node)
            rate, worst = observer.rate(seconds - 4.0)
            moved = observer.moving
            after = resident(node)
            sent, _ = flooding.communicate(timeout=60)
            observer.spin(2.0)
            print(
                f'{name:14s} under {topic:8s} {float(sent):7.0f} msg/s sent: odometry {idle:6.2f} -> '
                f'{rate:6.2f} Hz, worst gap {worst * 1e3:5.0f} ms, memory {before:.0f} -> '
                f'{after_start:.0f} -> {after:.0f} MB, moved: {moved}, '
                f'at rest after: {not observer.moving}',
                flush=True,
            )
        finally:
            for process in {robot, node}:
                process.terminate()
                process.wait(10)
            observer.node.destroy_node()


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--flood', nargs=2, help=argparse.SUPPRESS)
    parser.add_argument('--seconds', type=float, default=20.0)
    options = parser.parse_args()
    if options.flood:
        flood(options.flood[0], float(options.flood[1]))
        return
    under_flood('virtual_robot', 'cmd_vel', options.seconds)
    under_flood('go_to_goal', 'odom', options.seconds)
    under_flood('wheel_bridge', 'cmd_vel', options.seconds)


if __name__ == '__main__':
    main()
