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

"""Lockstep: how many times faster than real time nodes run in simulated time.

Ours: robot and controller (and bridge) at 50 Hz in `Lockstep`, driving all the time. The reference is
the bare prototype: two bare typed nodes on the plain EventsExecutor. It publishes /clock, spins until
the robot has received its command, which is known to be the answer, and advances. The bare nodes are
also run in `Lockstep`: the difference to the prototype is what `Lockstep` itself takes or saves. CPU
time of the driving alone is measured, each side in a process of its own.
"""

from __future__ import annotations

import time
from typing import Any

import child
from table import Goal, Row, interleave

PERIOD = 20_000_000
"""Of the robot's odometry (ns)."""
ARGUMENTS = ['--ros-args', '--log-level', 'error']
SIDES = {
    'pair': ('robot and controller in Lockstep', Goal(1.25, at_most=False)),
    'bridge': ('robot, controller and bridge in Lockstep', Goal(1.0, at_most=False)),
    'bare': ('bare robot and controller in Lockstep', None),
}


def drive(side: str, seconds: float) -> float:
    """Return how many times faster than real time a side drives, by its CPU time."""
    return seconds / (_prototype(seconds) if side == 'prototype' else _lockstep(side, seconds))


def _lockstep(side: str, seconds: float) -> float:
    import sides

    from diffdrive_jacobian.testing import Lockstep

    with Lockstep(ARGUMENTS) as world:
        if side == 'bare':
            nodes = sides.bare_nodes(lean=True)
        else:
            nodes = sides.our_nodes(bridge=side == 'bridge')
        for node in nodes:
            world.add(node)
        world.run_for(1.0)
        before = nodes[1].received
        begun = time.process_time()
        world.run_for(seconds)
        taken = time.process_time() - begun
        _check(nodes[1].received - before, seconds)
    return taken


def _prototype(seconds: float) -> float:
    import rclpy
    import sides
    from rclpy.experimental.events_executor import EventsExecutor
    from rclpy.node import Node
    from rosgraph_msgs.msg import Clock

    rclpy.init(args=['prototype', *ARGUMENTS, '-p', 'use_sim_time:=true'])
    world, nodes = Node('world'), sides.bare_nodes(lean=True)
    clock, message, now = world.create_publisher(Clock, '/clock', 10), Clock(), 1_000_000_000
    executor = EventsExecutor()
    for node in nodes:
        executor.add_node(node)

    def advance() -> None:
        nonlocal now
        now += PERIOD
        message.clock.sec, message.clock.nanosec = divmod(now, 1_000_000_000)
        clock.publish(message)

    robot = nodes[0]
    for _ in range(5):
        # One after the other: time that passes unseen puts the timer out of step.
        advance()
        _spin_out(executor)
    begun, steps = time.process_time(), round(seconds * 1e9 / PERIOD)
    robot.received = 0
    for step in range(steps):
        advance()
        while robot.received <= step:
            executor.spin_once()
    taken = time.process_time() - begun
    _check(robot.received, seconds)
    executor.shutdown()
    for node in (*nodes, world):
        node.destroy_node()
    rclpy.shutdown()
    return taken


def _spin_out(executor: Any) -> None:
    """Handle what is left over."""
    end = time.monotonic() + 0.1
    while time.monotonic() < end:
        executor.spin_once(timeout_sec=0.01)


def _check(commands: int, seconds: float) -> None:
    expected = round(seconds * 1e9 / PERIOD)
    if abs(commands - expected) > 1:
        raise RuntimeError(f'{expected} commands expected, got {commands}')


def rows(quick: bool) -> list[Row]:
    """Measure all sides in turn."""
    seconds, rounds = (3.0, 1) if quick else (60.0, 9)
    figures = interleave(
        ('prototype', *SIDES),
        rounds,
        lambda side: child.call('lockstep', 'drive', side=side, seconds=seconds),
    )
    return [
        Row(
            group='lockstep',
            ours=what,
            beside='bare typed prototype that knows the answer',
            quantity=f'{seconds:g} s of simulated time: x real time, by CPU time',
            pairs=list(zip(figures[side], figures['prototype'], strict=True)),
            goal=goal,
        )
        for side, (what, goal) in SIDES.items()
    ]
