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

"""What runs on wall time in a world, and so differs from run to run. A warning tells of it."""

from __future__ import annotations

import warnings
from weakref import WeakSet

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rclpy.timer import Timer

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.time_units import NANOSECONDS

PACKAGE = 'diffdrive_jacobian.'
SHORTEST_PERIOD = 1000
"""Shortest period of a timer (ns)."""
INFINITE = 2**63 - 1
"""Duration of a quality of service that has no limit, as the graph tells it (ns)."""
REMEDY = 'on wall time: what it does differs from run to run, check_repeats shows it'


def check_timer(timer: Timer, node: Node, *, simulated: bool) -> None:
    """Refuse a timer with which simulated time would not get on; warn of one on wall time."""
    period, name = timer.timer_period_ns, node.get_fully_qualified_name()
    # Those of our own nodes check the graph, or expire once.
    if str(getattr(timer.callback, '__module__', '')).startswith(PACKAGE):
        return
    if simulated and period < SHORTEST_PERIOD:
        raise LockstepError(
            f'a timer of node {name} has a period of {period} ns; in lockstep it must be at least '
            f'{SHORTEST_PERIOD} ns, because simulated time stops at each tick'
        )
    if not simulated:
        warnings.warn(
            f'a timer of node {name} with a period of {period / NANOSECONDS:g} s is not on the clock of '
            f'the node but {REMEDY}',
            stacklevel=2,
        )


class Qualities:
    """The publishers and subscriptions of the nodes that were checked."""

    def __init__(self) -> None:
        """Start without any."""
        self._seen: WeakSet[Publisher | Subscription] = WeakSet()

    def check(self, node: Node) -> None:
        """Warn of the new publishers and subscriptions of a node whose quality has limits of time."""
        for kind, ends in (('publisher', node.publishers), ('subscription', node.subscriptions)):
            for end in ends:
                if end in self._seen:
                    continue
                self._seen.add(end)
                for limit in _limits(end.qos_profile):
                    warnings.warn(
                        f'the {kind} of {end.topic_name} of node {node.get_fully_qualified_name()} has '
                        f'a {limit}, which DDS measures {REMEDY}',
                        stacklevel=2,
                    )


def _limits(profile: QoSProfile) -> list[str]:
    """Return the limits of time of a quality of service: 'deadline of 0.1 s'."""
    return [
        f'{name} of {limit / NANOSECONDS:g} s'
        for name, limit in (
            ('deadline', profile.deadline.nanoseconds),
            ('lifespan', profile.lifespan.nanoseconds),
            ('lease duration', profile.liveliness_lease_duration.nanoseconds),
        )
        if 0 < limit < INFINITE
    ]
