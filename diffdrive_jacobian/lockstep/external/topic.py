"""A topic on which messages from other processes are awaited."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._links import Links
from diffdrive_jacobian.messages.names import import_type
from diffdrive_jacobian.ros.rclpy_internals import message_taker

DEPTH = 1000
"""Queue size of the subscription: the number of messages at one simulated time."""


class ExternalTopic:
    """Counts the messages from other processes on a topic.

    Its subscription also receives the messages of the world, whose number is known.
    """

    def __init__(self, node: Node, topic: str, infos: list[TopicEndpointInfo], links: Links) -> None:
        """Subscribe.

        Args:
            node: The node of the subscription.
            topic: Full name of the topic.
            infos: The external publishers of the topic.
            links: Counts the messages of the world.

        Raises:
            LockstepError: The type of the topic is not installed, or the world has another one.
        """
        self.topic_name = topic
        self.msg_type = _import_type(infos[0].topic_type, topic)
        profile = QoSProfile(depth=DEPTH)
        everyone = node.get_publishers_info_by_topic(topic)
        if any(info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for info in everyone):
            profile.reliability = ReliabilityPolicy.BEST_EFFORT
        try:
            self.subscription = node.create_subscription(
                self.msg_type, topic, _nothing, profile, raw=True
            )
        except RuntimeError as error:
            # Within one process Fast DDS refuses a topic of two types.
            types = sorted({info.topic_type for info in everyone})
            raise LockstepError(f'{topic} has several types: {", ".join(types)}') from error
        self._node = node
        self._links = links
        self._take, self._release = message_taker(self.subscription)
        self._taken = 0
        self._not_counted = -links.count(topic)
        self._messages: list[bytes] = []
        self.delivered = 0
        """Number of those that the nodes of the world have received."""

    def count(self) -> int:
        """Return the number of messages from other processes so far."""
        while (taken := self._take(self.msg_type, True)) is not None:
            self._taken += 1
            self._messages.append(taken[0])
        return self._taken - self._links.count(self.topic_name) - self._not_counted

    def deliver(self) -> list[bytes]:
        """Return the messages since the last call, the oldest first, and count them as delivered."""
        received = self.count()
        new, self.delivered = received - self.delivered, received
        # With messages of the world among them, it is not known which are which.
        messages, self._messages = self._messages[len(self._messages) - new :], []
        return messages

    def restart(self) -> None:
        """Count from zero."""
        self._not_counted += self.count()
        self.delivered = 0
        self._messages.clear()

    def close(self) -> None:
        """Destroy the subscription."""
        self._release()
        self._node.destroy_subscription(self.subscription)


def _nothing(_: Any) -> None:
    """Ignore a message: gateways take them."""


def _import_type(name: str, topic: str) -> Any:
    """Return the class of a message type.

    Raises:
        LockstepError: It is not installed.
    """
    try:
        return import_type(name)
    except (ImportError, AttributeError) as error:
        raise LockstepError(f'the type {name} of {topic} is not installed') from error
