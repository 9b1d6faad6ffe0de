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

"""Small nodes that relations compare: a source of vectors, and what answers it."""

from __future__ import annotations

import math

from geometry_msgs.msg import Vector3, Vector3Stamped
from rclpy.node import Node
from std_srvs.srv import Trigger

from diffdrive_jacobian.messages.conversion import set_time

PERIOD = 0.1
END = 1.0


class Source(Node):
    """Says a number ten times a second, with its time."""

    def __init__(self, values=math.cos, period=PERIOD):
        super().__init__('source', start_parameter_services=False)
        self.values, self.count = values, 0
        self.publisher = self.create_publisher(Vector3Stamped, 'number', 10)
        self.create_timer(period, self.on_timer)

    def on_timer(self):
        message = Vector3Stamped()
        set_time(message.header.stamp, self.get_clock().now().nanoseconds)
        message.vector.x = float(self.values(self.count))
        self.count += 1
        self.publisher.publish(message)


class Answer(Node):
    """Answers each number by what `answer` makes of it."""

    def __init__(self, answer=lambda node, message: message.vector.x, topic='answer'):
        super().__init__('answer', start_parameter_services=False)
        self.answer, self.seen = answer, []
        self.publisher = self.create_publisher(Vector3, topic, 10)
        self.create_subscription(Vector3Stamped, 'number', self.on_number, 10)
        self.create_service(Trigger, 'forget', self.on_forget)

    def on_number(self, message):
        value = self.answer(self, message)
        self.seen.append(message.vector.x)
        if value is not None:
            self.publisher.publish(Vector3(x=float(value)))

    def on_forget(self, _, response):
        self.seen.clear()
        return response


class Echo(Node):
    """Answers each answer, later than a message that it hears at the same time."""

    def __init__(self):
        super().__init__('echo', start_parameter_services=False)
        self.publisher = self.create_publisher(Vector3, 'echo', 10)
        self.create_subscription(Vector3, 'answer', self.publisher.publish, 10)


def seconds(message):
    return message.header.stamp.sec + message.header.stamp.nanosec / 1e9


def total(node, message):
    """Return the sum of all numbers so far."""
    return sum(node.seen) + message.vector.x


def previous(node, message):
    """Return the number before: old, and the same in every image."""
    return node.seen[-1] if node.seen else 0.0


def from_the_clock(node, message):
    """Return the time on the clock."""
    return node.get_clock().now().nanoseconds / 1e9


def age(node, message):
    """Return how old the number is."""
    return from_the_clock(node, message) - seconds(message)


def impatient(node, message):
    """Return the number unless it is old."""
    return message.vector.x if age(node, message) < 0.005 else None


def side(node, message):
    """Return on which side of zero it is: rounding decides at zero."""
    return 1.0 if message.vector.x >= 0.0 else -1.0


def crashing(node, message):
    """Divide by what is never zero in the first world."""
    return 1.0 / max(0.0, message.vector.x + 2.0 * math.pi)


def scene(answer=None, values=math.cos, end=END, topic='answer'):
    """Return a scenario with these functions."""

    def scenario(world, case):
        world.create(lambda: Answer(answer, topic) if answer else Answer(topic=topic))
        world.create(Echo)
        world.create(lambda: Source(values))
        world.run_for(end)

    return scenario
