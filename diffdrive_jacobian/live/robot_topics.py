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

"""The topics of one robot: its latest messages, and what the page publishes."""

from __future__ import annotations

from collections.abc import Callable
from itertools import islice
from typing import Any, TypeVar

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

from diffdrive_jacobian.bags.message_definitions import message_class
from diffdrive_jacobian.messages import conversion as messages
from diffdrive_jacobian.messages.codecs import TWIST, Codec, Command
from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.messages.names import full_name
from diffdrive_jacobian.messages.topics import TOPICS
from diffdrive_jacobian.nodes.goal_client import MESSAGES, goals_message
from diffdrive_jacobian.ros.rclpy_internals import Polled, waiting_messages
from diffdrive_jacobian.ros.serialization import MAX_SIZE, ignoring_invalid
from diffdrive_jacobian.ros.topic_errors import explaining_failure

V = TypeVar('V')

LATEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Matches every publisher, and never makes one wait."""
LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Latest:
    """The latest message of a topic, as bytes until somebody looks at it."""

    def __init__(self, node: Node, codec: Codec[Any], topic: str, *, polled: bool) -> None:
        """Subscribe. If polled, `take` must fetch messages, otherwise the executor delivers them.

        Raises:
            ParameterError: The topic has another type in this process.
        """
        kind = message_class(codec.type_name)
        self._read: Callable[[bytes], Any] = codec.reader(kind, deserialize_message)
        self._polled = polled
        self._data: bytes | None = None
        self._count = 0
        self.messages = 0
        """How many messages came before the last call of `take`, which returned the last one."""
        group = Polled() if polled else None
        with explaining_failure(node, kind, topic):
            self._subscription: Subscription = node.create_subscription(
                kind, topic, self._store, LATEST, raw=True, callback_group=group
            )

    def _store(self, data: bytes) -> None:
        self._data = data
        self._count += 1

    def take(self) -> Any | None:
        """Return the value that was received since the last call. None: none, or an invalid one."""
        if self._polled:
            # The queue has one place; more than that is a flood, which must not hold up the page.
            for message in islice(waiting_messages(self._subscription), 2):
                self._store(message.data)
        latest, self._data = self._data, None
        self.messages, self._count = self._count, 0
        if latest is None or len(latest) > MAX_SIZE:
            return None
        try:
            return self._read(latest)
        except MessageError:
            return None

    def destroy(self, node: Node) -> None:
        """Unsubscribe."""
        node.destroy_subscription(self._subscription)


class RobotTopics:
    """Subscriptions and publishers of one robot."""

    def __init__(self, node: Node, namespace: str, names: dict[str, str], *, polled: bool) -> None:
        """Subscribe in a namespace; `names` are those of topics without namespace, by the usual ones.

        Raises:
            ParameterError: A topic has another type in this process.
        """
        self._node, self._namespace, self._names, self._polled = node, namespace, names, polled
        self._publishers: dict[str, Publisher] = {}
        self.followed = {
            topic.name: Latest(node, topic.codecs[0], self.full(topic.name), polled=polled)
            for topic in TOPICS.values()
            if topic.followed
        }
        """Topics whose latest values the page shows, by their usual names."""
        self.command: Latest | None = None
        """cmd_vel. None: nobody publishes or reads it yet."""
        self._subscriptions: list[Subscription] = []
        self._use_twist(TWIST)
        # Before they are used, so that the readers of goals are discovered by then.
        for topic, kind in MESSAGES.items():
            self._publisher(kind, topic)

    def full(self, name: str) -> str:
        """Return the fully qualified name of a topic or service of the robot."""
        return full_name(self._namespace, self._names.get(name, name))

    def listen(
        self, codec: Codec[V], topic: str, callback: Callable[[V], None], *, latched: bool
    ) -> None:
        """Receive every message of a topic, except for what `ignoring_invalid` ignores."""
        kind = message_class(codec.type_name)
        received, qos = ignoring_invalid(codec, kind, callback), LATCHED if latched else 10
        with explaining_failure(self._node, kind, self.full(topic)):
            self._subscriptions.append(
                self._node.create_subscription(kind, self.full(topic), received, qos, raw=True)
            )

    def use_twist_type(self, types: list[str]) -> None:
        """Take the types that cmd_vel has in the graph."""
        known = [codec for codec in TOPICS['cmd_vel'].codecs if codec.type_name in types]
        if not known or (self.command is not None and self._twist in known):
            return
        if self.command is not None:
            self.command.destroy(self._node)
        self._discard('cmd_vel')
        self._use_twist(known[0])
        self.command = Latest(self._node, self._twist, self.full('cmd_vel'), polled=self._polled)

    def _use_twist(self, codec: Codec[Command]) -> None:
        self._twist = codec
        self._write_twist = codec.writer(message_class(codec.type_name)())

    # --- Publishing

    def publish_twist(self, twist: tuple[float, float], now: int) -> None:
        """Publish a command, at a time (ns)."""
        data = self._write_twist(Command(twist, now))
        self._publisher(message_class(self._twist.type_name), 'cmd_vel').publish(data)

    def publish(
        self, topic: str, goals: NDArray[np.float64], now: int, times: NDArray[np.float64] | None = None
    ) -> None:
        """Publish goals or a path; the arguments are those of `goals_message`."""
        self._publisher(MESSAGES[topic], topic).publish(goals_message(topic, goals, now, times))

    def publish_pose(self, pose: NDArray[np.float64], frame: str, now: int) -> None:
        """Publish where the robot is, `[x, y, theta]` in a frame, at a time (ns)."""
        message = PoseWithCovarianceStamped()
        messages.set_time(message.header.stamp, now)
        message.header.frame_id = frame
        messages.set_pose(message.pose.pose, pose)
        self._publisher(PoseWithCovarianceStamped, 'initialpose').publish(message)

    def readers(self, topic: str) -> int:
        """Return the number of subscriptions to a topic, without those of this node."""
        own = {(self._node.get_namespace(), self._node.get_name())}
        found = self._node.get_subscriptions_info_by_topic(self.full(topic))
        return sum((one.node_namespace, one.node_name) not in own for one in found)

    def _publisher(self, kind: type, topic: str) -> Publisher:
        if topic not in self._publishers:
            with explaining_failure(self._node, kind, self.full(topic)):
                self._publishers[topic] = self._node.create_publisher(kind, self.full(topic), 10)
        return self._publishers[topic]

    def _discard(self, topic: str) -> None:
        publisher = self._publishers.pop(topic, None)
        if publisher is not None:
            self._node.destroy_publisher(publisher)

    def destroy(self) -> None:
        """Destroy all subscriptions and publishers."""
        for latest in (*self.followed.values(), *([self.command] if self.command else [])):
            latest.destroy(self._node)
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        for topic in list(self._publishers):
            self._discard(topic)
