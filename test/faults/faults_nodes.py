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

"""Nodes for the tests of faults, which know nothing of them, and what they received."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Int64
from std_srvs.srv import Trigger
from support.lockstep_nodes import LEAN

MILLISECOND = 1_000_000
START = 1_000_000_000
"""Time of the clock at the start of a `Lockstep` (ns)."""
LATCHED = QoSProfile(depth=3, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Source(Node):
    """Publishes 0, 1, 2, ... every 100 ms, 0 when it is added."""

    def __init__(self, name='source', topic='count', profile=10, period=0.1):
        super().__init__(name, **LEAN)
        self.publisher = self.create_publisher(Int64, topic, profile)
        self.number = 0
        self.timer = self.create_timer(period, self.on_tick)

    def on_tick(self):
        self.publisher.publish(Int64(data=self.number))
        self.number += 1


class Sink(Node):
    """Keeps what it receives and when, by its own clock since the start (ms)."""

    def __init__(self, name='sink', topic='count', profile=10):
        super().__init__(name, **LEAN)
        self.received = []
        self.create_subscription(Int64, topic, self.on_message, profile)

    def on_message(self, message):
        self.received.append((message.data, self.milliseconds()))

    def milliseconds(self):
        return (self.get_clock().now().nanoseconds - START) / MILLISECOND

    @property
    def numbers(self):
        return [number for number, _ in self.received]


class Relay(Sink):
    """Publishes what it receives, ticks every 100 ms, and has a service and a parameter."""

    def __init__(self, name='relay', period=0.1, profile=10):
        super().__init__(name, profile=profile)
        self.publisher = self.create_publisher(Int64, 'relayed', 10)
        self.ticks, self.calls = [], []
        self.declare_parameter('gain', 1.0)
        self.create_timer(period, lambda: self.ticks.append(self.milliseconds()))
        self.create_service(Trigger, 'ask', self.on_request)

    def on_message(self, message):
        super().on_message(message)
        self.publisher.publish(message)

    def on_request(self, request, response):
        self.calls.append(self.milliseconds())
        response.success = True
        return response


def play(world, *injected, seconds=1.0, seed=0, profile=10):
    """Return what a sink receives of a source under faults: numbers and times (ms)."""
    sink = world.create(lambda: Sink(profile=profile))
    world.create(lambda: Source(profile=profile))
    sink.received.clear()
    world.inject(*injected, seed=seed)
    world.run_for(seconds)
    return sink.received


def in_time(first, last, late=0.0):
    """Return the messages from the first to the last, with their times (ms)."""
    return [(number, 100.0 * number + late) for number in range(first, last + 1)]


def whats(world):
    """Return the texts of the events."""
    return [event.what for event in world.fault_events]
