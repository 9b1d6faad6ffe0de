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

"""Odometry messages: CPU per message, and latency from an odometry message to the command.

CPU: robot and controller (and bridge) beside bare nodes that send the same messages to each other; CPU
time of the process over the odometry messages that the controller received. Latency: a prober in the
controller's process publishes odometry by a timer and receives the command; from before publish() to the
callback, median of all. Executors: `events` and `single` are spun as our runner does it, `rclpy.spin` is
rclpy's own, on the SingleThreadedExecutor. Each figure comes from a process of its own.
"""

from __future__ import annotations

import contextlib
import statistics
import time
from typing import Any, NamedTuple

import child
from table import Goal, Row, interleave

WARM_UP = 1.0
"""How long the nodes run before anything counts (s)."""


class Side(NamedTuple):
    """What is measured, and on which executor."""

    nodes: str
    executor: str
    bridge: bool = False

    def __str__(self) -> str:
        what = 'three nodes' if self.bridge else 'two nodes'
        return f'{self.nodes} {what}, {self.executor}'


_OURS, _BARE = str(Side('our', 'events')), str(Side('bare', 'events'))
GOALS = {
    ('cpu', _OURS, _BARE, 500.0): Goal(0.5),
    ('latency', _OURS, _BARE, 500.0): Goal(0.6),
}
"""Goals by function, side, reference and rate."""


def cpu(nodes: str, executor: str, bridge: bool, rate: float, seconds: float) -> float:
    """Measure CPU per odometry message (us)."""
    import sides

    with _spinning(executor, guarded=nodes == 'our') as (context, spin):
        if nodes == 'our':
            made = sides.our_nodes(rate=rate, bridge=bridge, context=context)
        else:
            prepared = nodes == 'prepared'
            made = sides.bare_nodes(rate=rate, bridge=bridge, prepared=prepared, context=context)
        figures = []

        def look() -> None:
            figures.append((time.process_time(), made[1].received))

        spin(made, seconds, look)
        (cpu_before, before), (cpu_after, after) = figures
        return (cpu_after - cpu_before) / (after - before) * 1e6


def latency(nodes: str, executor: str, bridge: bool, rate: float, seconds: float) -> float:
    """Measure the median time from an odometry message to the command (us)."""
    import sides

    with _spinning(executor, guarded=nodes == 'our') as (context, spin):
        make = sides.our_controller if nodes == 'our' else sides.BareController
        prober = _prober(context, rate)
        spin([prober, make(context=context)], seconds, prober.latencies.clear, lambda: None)
        return statistics.median(prober.latencies) * 1e-3


def _prober(context: Any, rate: float) -> Any:
    from geometry_msgs.msg import Twist
    from nav_msgs.msg import Odometry
    from rclpy.node import Node

    class Prober(Node):
        def __init__(self) -> None:
            super().__init__('prober', context=context)
            self.latencies: list[int] = []
            self._published = 0
            self._message = Odometry()
            self._odom = self.create_publisher(Odometry, 'odom', 10)
            self.create_subscription(Twist, 'cmd_vel', self._on_cmd_vel, 10)
            self.create_timer(1.0 / rate, self._on_tick)

        def _on_tick(self) -> None:
            self._message.header.stamp = self.get_clock().now().to_msg()
            self._published = time.perf_counter_ns()
            self._odom.publish(self._message)

        def _on_cmd_vel(self, _: Twist) -> None:
            # The controller answers before the next tick, or this one is answered late.
            self.latencies.append(time.perf_counter_ns() - self._published)

    return Prober()


@contextlib.contextmanager
def _spinning(name: str, *, guarded: bool) -> Any:
    """Give a context and a function that spins nodes: `begin` after the warm-up, `end` at the end.

    Ours run on the guarded EventsExecutor, as their programs do, others on that of rclpy.
    """
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    from diffdrive_jacobian.ros.rclpy_internals import events_executor
    from diffdrive_jacobian.ros.runner import make_executor, ros_context

    with ros_context(['benchmark', '--ros-args', '--log-level', 'error']) as context:
        executor: Any = SingleThreadedExecutor(context=context)
        if name == 'events':
            executor = make_executor(context, isolated=False) if guarded else events_executor(context)
        nodes: list[Any] = []

        def spin(given: list[Any], seconds: float, begin: Any, end: Any = None) -> None:
            end = end or begin
            nodes[:] = given
            for node in nodes:
                executor.add_node(node)
            if name == 'rclpy.spin':
                # As a user would write it, ended by a timer.
                first = nodes[0].create_timer(WARM_UP, lambda: (begin(), first.cancel()))
                last = nodes[0].create_timer(
                    WARM_UP + seconds, lambda: (end(), last.cancel(), context.try_shutdown())
                )
                with contextlib.suppress(rclpy.executors.ExternalShutdownException):
                    rclpy.spin(nodes[0], executor)
                return
            spin_for(executor, WARM_UP)
            begin()
            spin_for(executor, seconds)
            end()

        try:
            yield context, spin
        finally:
            executor.shutdown()
            for node in nodes:
                node.destroy_node()


def spin_for(executor: Any, seconds: float) -> None:
    """Spin as our runner does."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        executor.spin_once(timeout_sec=0.1)


def rows(quick: bool) -> list[Row]:
    """Measure all comparisons."""
    seconds, rounds = (1.0, 1) if quick else (6.0, 3)
    found = []
    for rate in (50.0,) if quick else (50.0, 500.0):
        for function, quantity, comparisons in _plan(quick):
            sides = dict.fromkeys(side for pair in comparisons for side in pair)
            figures = interleave(
                sides,
                rounds,
                lambda side, function=function, rate=rate: child.call(
                    'odometry', function, **side._asdict(), rate=rate, seconds=seconds
                ),
            )
            found += [
                Row(
                    group='odometry messages',
                    ours=str(ours),
                    beside=str(beside),
                    quantity=f'{quantity} at {rate:g} Hz',
                    pairs=list(zip(figures[ours], figures[beside], strict=True)),
                    goal=GOALS.get((function, str(ours), str(beside), rate)),
                )
                for ours, beside in comparisons
            ]
    return found


def _plan(quick: bool) -> list[tuple[str, str, list[tuple[Side, Side]]]]:
    events, spin = Side('our', 'events'), Side('bare', 'rclpy.spin')
    both = [(events, Side('bare', 'events')), (events, spin)]
    if not quick:
        single = Side('our', 'single')
        both += [(single, Side('bare', 'single')), (single, spin)]
    cpus = [*both]
    if not quick:
        cpus += [
            (events, Side('prepared', 'events')),
            (Side('our', 'events', True), Side('bare', 'events', True)),
            (Side('our', 'events', True), Side('our', 'rclpy.spin', True)),
        ]
    return [
        ('cpu', 'CPU per odometry message (us)', cpus),
        ('latency', 'latency odom to cmd_vel (us)', both),
    ]
