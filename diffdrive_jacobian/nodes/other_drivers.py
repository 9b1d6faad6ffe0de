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

"""Commands of other nodes while this one drives a robot."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message

from diffdrive_jacobian.messages.codecs import TWIST, TWIST_STAMPED
from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.ros.graph_faults import publishers_of
from diffdrive_jacobian.time_units import NANOSECONDS

PERIOD = NANOSECONDS
"""Shortest time between two searches for other publishers (ns)."""
REMEMBERED = 64
"""Number of own commands that are remembered. At most as many as the queue is long arrive later."""


class OtherDrivers:
    """Calls a function when another node sends a command that is not zero.

    A command that equals one of the last own ones counts as own. It is subscribed to the commands only
    once another node publishes them. So its usual cost is that of remembering a command.
    """

    def __init__(self, node: Node, publisher: Publisher, callback: Callable[[list[str]], None]) -> None:
        """Start inactive.

        Args:
            node: The node.
            publisher: Its publisher of commands, Twist or TwistStamped.
            callback: Receives the names of the other nodes.
        """
        self._node = node
        self._publisher = publisher
        self._callback = callback
        self._active = False
        self._subscribed = False
        # Serialized, as they arrive again, perhaps several times.
        self._sent: deque[bytes] = deque(maxlen=REMEMBERED)
        self.sent = self._sent.append
        """Remember a serialized command of the node itself."""
        kind = publisher.msg_type
        codec = TWIST_STAMPED if kind.__name__ == 'TwistStamped' else TWIST
        self._read = codec.reader(kind, deserialize_message)
        self.searched = 0
        """Time of the last search (ns): `search` is due after each `PERIOD`."""

    @property
    def subscriptions(self) -> int:
        """Number of subscriptions to the commands that belong to the node itself."""
        return int(self._subscribed)

    def start(self) -> None:
        """Search for other drivers from now on."""
        self._active = True
        self.search(self.searched)

    def stop(self) -> None:
        """Ignore other drivers from now on."""
        self._active = False

    def search(self, now: int) -> None:
        """Search for other drivers, at a time of the node (ns).

        With a timer a simulated run would take longer.
        """
        self.searched = now
        topic = self._publisher.topic_name
        if self._subscribed or self._node.count_publishers(topic) < 2:
            return
        self._subscribed = True
        # Best effort matches every publisher, whatever its quality of service.
        profile = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        kind = self._publisher.msg_type
        self._node.create_subscription(kind, topic, self._on_command, profile, raw=True)

    def _on_command(self, data: bytes) -> None:
        if not self._active or data in self._sent:
            return
        try:
            v, omega = self._read(data).twist
        except MessageError:
            # The robot drops it as well.
            return
        # A joystick that nobody touches may send zeros.
        if v or omega:
            names = publishers_of(self._node, self._publisher.topic_name, others=True)
            self._callback(names or ['another node'])
