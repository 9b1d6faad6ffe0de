"""Bit-identity: how many different results the same drive in lockstep gives, in fresh processes.

Robot and controller drive a curve to a goal that lies aside. The result of a run is the hash of all
odometry messages as they are serialized, and the final pose in hexadecimal. Some of the processes run
one by one on the machine as it is, some in parallel, some at low priority while a busy process per core
runs. Goal ids are random, so goal_status does not count.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import child
from table import Goal, Row


def drive(seconds: float) -> str:
    """Drive for so much simulated time; gives hash and final pose."""
    from geometry_msgs.msg import PoseStamped
    from nav_msgs.msg import Odometry
    from rclpy.parameter import Parameter
    from rclpy.serialization import serialize_message

    from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
    from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
    from diffdrive_jacobian.testing import Lockstep

    with Lockstep(['--ros-args', '--log-level', 'error']) as world:
        world.add(VirtualRobot())
        # Slow to turn: a wide curve, which lasts.
        limits = {'linear.x.max_velocity': 0.4, 'angular.z.max_velocity': 0.05}
        overrides = [Parameter(name, value=value) for name, value in limits.items()]
        world.add(GoToGoal(parameter_overrides=overrides))
        digest, last, count = hashlib.sha256(), Odometry(), 0

        def on_odometry(message: Odometry) -> None:
            nonlocal last, count
            digest.update(serialize_message(message))
            last, count = message, count + 1

        world.node.create_subscription(Odometry, 'odom', on_odometry, 10)
        goal = PoseStamped()
        goal.pose.position.x, goal.pose.position.y = -20.0, 30.0
        world.publish('goal_pose', goal)
        world.run_for(seconds)
        position, turn = last.pose.pose.position, last.pose.pose.orientation
        if count < seconds * 49 or last.twist.twist.linear.x == 0.0:
            raise RuntimeError(f'the robot did not drive to the end: {count} messages, {last}')
        pose = ' '.join(value.hex() for value in (position.x, position.y, turn.z, turn.w))
        return f'{count} {pose} {digest.hexdigest()}'


def burn(seconds: float) -> int:
    """Keep a core busy, but no longer than the parent lives; gives how often it looked."""
    parent, end, looks = os.getppid(), time.monotonic() + seconds, 0
    while time.monotonic() < end and os.getppid() == parent:
        looks += 1
    return looks


@contextlib.contextmanager
def _busy_cores() -> Iterator[None]:
    busy = [child.start('identity', 'burn', seconds=1800.0) for _ in range(os.cpu_count() or 1)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.communicate()


def _drive(seconds: float, *prefix: str) -> str:
    return child.call('identity', 'drive', prefix=prefix, seconds=seconds)


def rows(quick: bool) -> list[Row]:
    """Count the different results."""
    seconds, (alone, parallel, loaded) = (1.0, (1, 1, 1)) if quick else (60.0, (5, 5, 10))
    results = [_drive(seconds) for _ in range(alone)]
    with ThreadPoolExecutor(parallel) as pool:
        results += pool.map(_drive, [seconds] * parallel)
    with _busy_cores():
        results += [_drive(seconds, 'nice', '-n', '10') for _ in range(loaded)]
    return [
        Row(
            group='lockstep',
            ours=f'{len(results)} drives in fresh processes: {alone} alone, {parallel} in parallel, '
            f'{loaded} under load',
            beside='one result',
            quantity=f'different results of {seconds:g} s of simulated time',
            pairs=[(float(len(set(results))), 1.0)],
            goal=Goal(1.0),
            notes=[f'final drive: {result}' for result in sorted(set(results))],
        )
    ]
