"""Faults of the graph around a node: topics that nobody reads or publishes, and several publishers.

Each function returns a check for `ParameterizedNode.watch`, which refreshes the `SharedGraph` and calls
it once a second. It returns a description with the remedy, or None, and costs microseconds unless there
is a fault.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription

from diffdrive_jacobian.messages.topics import SAME_NAMES, TOPICS
from diffdrive_jacobian.ros.lasting import Interleaving
from diffdrive_jacobian.ros.shared_graph import SharedGraph
from diffdrive_jacobian.text import listed, printable

Check: TypeAlias = Callable[[], str | None]

ALTERNATION_PATIENCE = 3
"""Number of checks with alternating commands before that is reported: a driver may take over."""
MIN_FALLS = 2
"""Number of falls of the sequence numbers within a second that no restarted publisher explains."""


def unread(publisher: Publisher, name: str, own: Callable[[], int] = lambda: 0) -> Check:
    """Return a check whether nobody reads a topic.

    Args:
        publisher: The publisher of the node.
        name: Name of the topic as the node gives it, before it is remapped.
        own: Returns the number of subscriptions of the node itself.
    """
    topic = publisher.topic_name
    start = TOPICS[name].if_unread

    def check() -> str | None:
        if publisher.get_subscription_count() > own():
            return None
        return f'no node is subscribed to {topic}: {start} {SAME_NAMES.format(name)}'

    return check


def unpublished(node: Node, subscription: Subscription, name: str) -> Check:
    """Return a check whether nobody publishes a topic.

    Args:
        node: The node.
        subscription: Its subscription.
        name: Name of the topic as the node gives it, before it is remapped.
    """
    graph, topic = SharedGraph(node), subscription.topic_name
    start = TOPICS[name].if_unpublished

    def check() -> str | None:
        if graph.count_publishers(topic):
            return None
        return f'no node publishes {topic}: {start} {SAME_NAMES.format(name)}'

    return check


def several_publishers(node: Node, name: str) -> Check:
    """Return a check whether several nodes publish a topic that must have one publisher."""
    graph, topic, remedy = SharedGraph(node), node.resolve_topic_name(name), TOPICS[name].if_several

    def check() -> str | None:
        if graph.count_publishers(topic) < 2:
            return None
        names = publishers_of(node, topic)
        # The graph keeps a node that was killed for 20 s, also beside its successor.
        killed = '; one that was killed disappears within 20 s' if len({*names}) < len(names) else ''
        return f'{listed(names)} publish {topic}: {remedy}{killed}'

    return check


def alternating_commands(node: Node, topic: str, commands: Interleaving) -> Check:
    """Return a check whether the commands of several publishers alternate.

    Args:
        node: The node that receives them.
        topic: Name of the topic.
        commands: Counts the commands of the node that are not zero.
    """
    graph, topic = SharedGraph(node), node.resolve_topic_name(topic)

    def check() -> str | None:
        if commands.falls() < MIN_FALLS or graph.count_publishers(topic) < 2:
            return None
        return (
            f'{listed(publishers_of(node, topic))} publish {topic}, and their commands alternate: stop '
            'one of them, or put a multiplexer such as twist_mux between'
        )

    return check


def goals_without_controller(node: Node, *names: str) -> Check:
    """Return a check whether goals are published that no controller receives."""
    graph, resolved = SharedGraph(node), {name: node.resolve_topic_name(name) for name in names}

    def check() -> str | None:
        for name, topic in resolved.items():
            if graph.count_publishers(topic) and not graph.count_subscriptions(topic):
                return (
                    f'{listed(publishers_of(node, topic))} publishes {topic}, but no controller is '
                    f'subscribed to it, so that goals are lost: {TOPICS[name].if_unread} '
                    f'{SAME_NAMES.format(name)}'
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
