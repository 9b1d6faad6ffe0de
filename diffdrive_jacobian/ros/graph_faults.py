"""Faults of the graph around a node: topics that nobody reads or publishes, and several publishers.

Each function returns a check for `ParameterizedNode.watch`, which calls it once a second. It returns
a description with the remedy, or None, and costs microseconds unless there is a fault.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription

from diffdrive_jacobian.diagnosis.description import base_name, listed
from diffdrive_jacobian.diagnosis.lasting import Interleaving
from diffdrive_jacobian.diagnosis.topics import (
    ONE_PUBLISHER,
    SAME_NAMES,
    START_PUBLISHER,
    START_READER,
)
from diffdrive_jacobian.text import printable

Check: TypeAlias = Callable[[], str | None]

ALTERNATION_PATIENCE = 3
"""Number of checks with alternating commands before that is reported: a driver may take over."""
MIN_FALLS = 2
"""Number of falls of the sequence numbers within a second that no restarted publisher explains."""


def unread(publisher: Publisher, own: Callable[[], int] = lambda: 0) -> Check:
    """Return a check whether nobody reads a topic.

    Args:
        publisher: The publisher of the node.
        own: Returns the number of subscriptions of the node itself.
    """
    topic = publisher.topic_name
    name = base_name(topic)
    start = START_READER.get(name, 'start a node that is')

    def check() -> str | None:
        if publisher.get_subscription_count() > own():
            return None
        return f'no node is subscribed to {topic}: {start} {SAME_NAMES.format(name)}'

    return check


def unpublished(subscription: Subscription, count: Callable[[str], int]) -> Check:
    """Return a check whether nobody publishes a topic.

    Args:
        subscription: The subscription of the node.
        count: Returns the number of publishers of a topic.
    """
    topic = subscription.topic_name
    name = base_name(topic)
    start = START_PUBLISHER.get(name, 'start a node that does')

    def check() -> str | None:
        if count(topic):
            return None
        return f'no node publishes {topic}: {start} {SAME_NAMES.format(name)}'

    return check


def several_publishers(node: Node, topic: str) -> Check:
    """Return a check whether several nodes publish a topic that must have one publisher.

    Args:
        node: The node that asks.
        topic: Name of the topic before it is remapped, one of ONE_PUBLISHER.
    """
    remedy = ONE_PUBLISHER[topic]
    topic = node.resolve_topic_name(topic)

    def check() -> str | None:
        if node.count_publishers(topic) < 2:
            return None
        return f'{listed(publishers_of(node, topic))} publish {topic}: {remedy}'

    return check


def alternating_commands(node: Node, topic: str, commands: Interleaving) -> Check:
    """Return a check whether the commands of several publishers alternate.

    Args:
        node: The node that receives them.
        topic: Name of the topic.
        commands: Counts the commands of the node that are not zero.
    """
    topic = node.resolve_topic_name(topic)

    def check() -> str | None:
        if commands.falls() < MIN_FALLS or node.count_publishers(topic) < 2:
            return None
        return (
            f'{listed(publishers_of(node, topic))} publish {topic}, and their commands alternate: stop '
            'one of them, or put a multiplexer such as twist_mux between'
        )

    return check


def goals_without_controller(node: Node, *topics: str) -> Check:
    """Return a check whether goals are published that no controller receives."""
    resolved = {node.resolve_topic_name(topic): START_READER[topic] for topic in topics}

    def check() -> str | None:
        for topic, start in resolved.items():
            if node.count_publishers(topic) and not node.count_subscribers(topic):
                return (
                    f'{listed(publishers_of(node, topic))} publishes {topic}, but no controller is '
                    f'subscribed to it, so that goals are lost: {start} '
                    f'{SAME_NAMES.format(base_name(topic))}'
                )
        return None

    return check


def publishers_of(node: Node, topic: str, *, others: bool = False) -> list[str]:
    """Return the fully qualified names of the nodes that publish a topic, sorted.

    Args:
        node: The node that asks.
        topic: Name of the topic.
        others: Whether to leave out one publisher of the node itself.
    """
    infos = node.get_publishers_info_by_topic(topic)
    names = sorted(printable(f'{one.node_namespace.rstrip("/")}/{one.node_name}') for one in infos)
    own = node.get_fully_qualified_name()
    if others and own in names:
        names.remove(own)
    return names
