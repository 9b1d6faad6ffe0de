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

"""Many robots: how many pairs of robot and controller hold 50 Hz in one process on one core.

A trial makes so many pairs, each in a namespace of its own, on one EventsExecutor in a process that is
bound to one core and that no other process hears. They hold 50 Hz if every robot's odometry comes to its
controller at 49.5 Hz or more, and 99 % of it is answered by a command that comes to the robot. The limit
is found by bisection. Beside ours: lean bare nodes (odometry and twist, nothing else), with the
parameter services that nodes have by default and without, and bare nodes that send all that ours send.
Memory is what the process grew by, from the context to the end, over the pairs.

A trial that fails while the process had little of its core was disturbed by others, and is repeated; how
often is noted. Pairs at the limit over their CPU load are a figure that others disturb less.

What a pair costs shows a trial under a profiler:
`python -m cProfile -s tottime child.py many_robots trial '{"side": "our", "pairs": 20, "seconds": 10}'`.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import child
from table import Goal, Row, interleave

RATE = 50.0
HELD = 0.99
"""Of the rate and of the answers, what counts as held."""
PRECISION = 0.03
"""How close the bisection goes, relative to the number of pairs."""
BUSY = 0.85
"""A failed trial with less CPU load than this was disturbed."""
ATTEMPTS = 3
"""How often a trial is made until one is not disturbed."""
BARE: dict[str, dict[str, bool]] = {
    'lean bare pairs': {'lean': True},
    'lean bare pairs without parameter services': {'lean': True, 'start_parameter_services': False},
    'bare pairs of the same traffic': {'lean': False},
}


def trial(side: str, pairs: int, seconds: float) -> dict[str, float]:
    """Run so many pairs; gives rate (Hz), share of answers, CPU load and memory per pair (MB)."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    import sides
    from odometry import spin_for
    from rclpy.experimental.events_executor import EventsExecutor

    from diffdrive_jacobian.ros.runner import ros_context

    with ros_context(['many', '--ros-args', '--log-level', 'error']) as context:
        executor, before = EventsExecutor(context=context), _resident()
        robots, controllers = [], []
        for number in range(pairs):
            namespace: dict[str, Any] = {'namespace': f'robot_{number}', 'context': context}
            if side == 'our':
                pair = sides.our_nodes(rate=RATE, **namespace)
            else:
                pair = sides.bare_nodes(rate=RATE, **BARE[side], **namespace)
            robots.append(pair[0])
            controllers.append(pair[1])
        for node in (*robots, *controllers):
            executor.add_node(node)
        spin_for(executor, 1.0)
        odometry = [controller.received for controller in controllers]
        answers, cpu, begun = (
            sum(robot.received for robot in robots),
            time.process_time(),
            time.monotonic(),
        )
        spin_for(executor, seconds)
        taken = time.monotonic() - begun
        counts = [
            controller.received - count for controller, count in zip(controllers, odometry, strict=True)
        ]
        answers = sum(robot.received for robot in robots) - answers
        figures = {
            'rate': min(counts) / taken,
            'answered': answers / max(1, sum(counts)),
            'cpu': (time.process_time() - cpu) / taken,
            'memory': (_resident() - before) / pairs,
        }
        executor.shutdown()
        for node in (*robots, *controllers):
            node.destroy_node()
    return figures


def _resident() -> float:
    """Resident memory of this process (MB)."""
    pages = int(Path('/proc/self/statm').read_text().split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / 2**20


class Search:
    """Looks for the limit of each side; the next search begins where the last one ended."""

    def __init__(self, seconds: float, precision: float, attempts: int) -> None:
        self._seconds = seconds
        self._precision = precision
        self._attempts = attempts
        self._guesses: dict[str, int] = {}
        self.repeated = 0
        """How many trials were disturbed and repeated."""

    def limit(self, side: str) -> dict[str, float]:
        """Find the limit of a side; gives the figures of the trial there, and `pairs`."""
        pairs, most, found = self._guesses.get(side, 16), None, {'pairs': 0.0, 'cpu': 1.0, 'memory': 0.0}
        growth = 1.15 if side in self._guesses else 2.0
        while True:
            figures = self._try(side, pairs)
            if _holds(figures):
                found = {'pairs': float(pairs), **figures}
            else:
                most = pairs
            least = int(found['pairs'])
            if most is None:
                pairs = max(least + 1, round(least * growth))
            elif most - least <= max(1.0, self._precision * most):
                self._guesses[side] = max(1, least)
                return {**found, 'full': found['pairs'] / found['cpu']}
            else:
                # Down by steps as up, until something holds.
                pairs = (least + most) // 2 if least else max(1, int(most / growth))

    def _try(self, side: str, pairs: int) -> dict[str, float]:
        for attempt in range(self._attempts):
            figures = child.call('many_robots', 'trial', side=side, pairs=pairs, seconds=self._seconds)
            if attempt == self._attempts - 1 or _holds(figures) or figures['cpu'] >= BUSY:
                break
            self.repeated += 1
        return figures


def _holds(figures: dict[str, float]) -> bool:
    return figures['rate'] >= HELD * RATE and figures['answered'] >= HELD


def rows(quick: bool) -> list[Row]:
    """Find the limits of all sides in turn."""
    sides = ['our', *BARE][: 2 if quick else None]
    search = Search(*((0.7, 0.5, 1) if quick else (5.0, PRECISION, ATTEMPTS)))
    limits = interleave(sides, 1 if quick else 3, search.limit)
    notes = [f'CPU load at the limit, {one}: {_loads(limits[one])}' for one in sides]
    notes.append(f'disturbed trials of many robots, repeated: {search.repeated}')
    found = []
    for side in sides[1:]:
        for key, quantity, digits, goal in (
            ('pairs', 'pairs that hold 50 Hz on one core', 0, Goal(1.0, at_most=False)),
            ('full', 'pairs at the limit / their CPU load', 0, None),
            ('memory', 'memory per pair (MB)', 2, None),
        ):
            both = zip(limits['our'], limits[side], strict=True)
            found.append(
                Row(
                    group='many robots',
                    ours='robot and controller pairs',
                    beside=side,
                    quantity=quantity,
                    pairs=[(ours[key], beside[key]) for ours, beside in both],
                    goal=goal if side == 'bare pairs of the same traffic' else None,
                    digits=digits,
                    notes=notes,
                )
            )
    return found


def _loads(limits: list[dict[str, float]]) -> str:
    return ', '.join(f'{limit["pairs"]:.0f} pairs {limit["cpu"]:.0%}' for limit in limits)
