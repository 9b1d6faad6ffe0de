"""Lockstep: how many times faster than real time nodes run under simulated time.

Ours: robot and controller (and bridge) at 50 Hz through `diffdrive_jacobian.testing.Lockstep`, driving
all the time. Beside them the bare prototype: two bare nodes on the plain EventsExecutor, which publishes
/clock, spins until the robot has got its command (that answer is known), and advances. It waits for
nothing else, so it is the bound for anything that does not know the nodes. The bare nodes are run in
Lockstep, too. Only the driving is timed, each side in a process of its own.
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
    'pair': ('robot and controller in Lockstep', Goal(0.88, at_most=False, at_least=0.53)),
    'bridge': ('robot, controller and bridge in Lockstep', Goal(0.39, at_most=False)),
    'bare': ('bare robot and controller in Lockstep', None),
}


def drive(side: str, seconds: float) -> float:
    """Drive for so much simulated time; gives how many times faster than real time."""
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
        begun = time.perf_counter()
        world.run_for(seconds)
        taken = time.perf_counter() - begun
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
    begun, steps = time.perf_counter(), round(seconds * 1e9 / PERIOD)
    robot.received = 0
    for step in range(steps):
        advance()
        while robot.received <= step:
            executor.spin_once()
    taken = time.perf_counter() - begun
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
    seconds, rounds = (10.0, 2) if quick else (60.0, 9)
    figures = interleave(
        ('prototype', *SIDES),
        rounds,
        lambda side: child.call('lockstep', 'drive', side=side, seconds=seconds),
    )
    return [
        Row(
            group='lockstep',
            ours=what,
            beside='bare prototype that knows the answer',
            quantity=f'{seconds:g} s of simulated time: x real time',
            pairs=list(zip(figures[side], figures['prototype'], strict=True)),
            goal=goal,
        )
        for side, (what, goal) in SIDES.items()
    ]
