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

"""Nodes as users of the lockstep world write them: they know nothing of it."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Vector3
from rclpy.node import Node
from std_srvs.srv import Trigger


class Blinker(Node):
    """A user's own node: a timer, a service, a parameter, nothing about lockstep."""

    def __init__(self, name='blinker', rate=100.0, **kwargs):
        super().__init__(name, **kwargs)
        self.rate = self.declare_parameter('rate', rate).value
        self.ticks = []
        self.publisher = self.create_publisher(Time, 'blink', 10)
        self.create_timer(1.0 / self.rate, self.on_tick)
        self.create_service(Trigger, f'{name}/forget', self.on_forget)

    def on_tick(self):
        now = self.get_clock().now()
        self.ticks.append(now.nanoseconds)
        self.publisher.publish(now.to_msg())

    def on_forget(self, request, response):
        self.ticks.clear()
        response.success = True
        return response


class Echo(Node):
    """Answers each message of one topic by one on another."""

    def __init__(self, name, source, sink):
        super().__init__(name)
        self.publisher = self.create_publisher(Vector3, sink, 10)
        self.create_subscription(Vector3, source, self.on_message, 10)

    def on_message(self, message):
        self.publisher.publish(message)
