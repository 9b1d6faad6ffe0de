"""Topics that do not connect: types, quality of service, missing ends, several publishers, names."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from diffdrive_jacobian.diagnosis.description import (
    Endpoint,
    Finding,
    Graph,
    Quality,
)
from diffdrive_jacobian.messages.names import base_name
from diffdrive_jacobian.messages.topics import CLOCK, OF_EVERY_NODE, SAME_NAMES, TOPICS, Topic
from diffdrive_jacobian.text import listed

_UNKNOWN = Topic(name='')


def _known(topic: str) -> Topic:
    """Return what is known of a topic of this name, in any namespace."""
    return TOPICS.get(base_name(topic), _UNKNOWN)


def check_topics(graph: Graph) -> Iterator[Finding]:
    """Yield what keeps nodes from communicating."""
    yield from _check_names(graph)
    for topic in graph.topics():
        yield from _check_types(graph, topic)
        yield from _check_quality(graph, topic)
        yield from _check_number_of_publishers(graph, topic)
        yield from _check_missing(graph, topic)


def _check_names(graph: Graph) -> Iterator[Finding]:
    names = Counter(node.name for node in graph.nodes)
    for name, count in sorted(names.items()):
        if count > 1:
            yield Finding(
                f'{count} nodes have the name {name}',
                'stop one of them, or give each a name or a namespace of its own (-r __node:=NAME, '
                '-r __ns:=/NAME); one that was killed disappears within 20 s',
            )


def _check_types(graph: Graph, topic: str) -> Iterator[Finding]:
    publishers: dict[str, list[str]] = {}
    subscriptions: dict[str, list[str]] = {}
    for one in graph.publishers(topic):
        publishers.setdefault(one.kind, []).append(one.node)
    for one in graph.subscriptions(topic):
        subscriptions.setdefault(one.kind, []).append(one.node)
    for theirs, sources in sorted(publishers.items()):
        for ours, sinks in sorted(subscriptions.items()):
            if theirs != ours:
                yield Finding(
                    f'{listed(sources)} publishes {topic} as {theirs}, but {listed(sinks)} subscribes '
                    f'to it as {ours}: no message arrives',
                    type_remedy(theirs, ours),
                )


def type_remedy(first: str, second: str) -> str:
    """Return what to do about two types of one topic."""
    if 'Twist' in first and 'Twist' in second:
        return (
            'set enable_stamped_cmd_vel of both to the same value (true: TwistStamped, false: Twist); '
            'teleop_twist_keyboard has -p stamped:=true'
        )
    if 'Joint' in first + second or 'MultiArray' in first + second:
        return 'set joint_command_type of wheel_bridge to the type that the other one uses'
    return 'use one type, or remap one of the topics to another name'


def mismatch(offered: Quality, requested: Quality) -> list[str]:
    """Return the policies for which a publisher offers less than a subscription requests, in words."""
    reasons = []
    if (offered.reliability, requested.reliability) == ('BEST_EFFORT', 'RELIABLE'):
        reasons.append('reliability: it offers best effort, reliable is requested')
    if (offered.durability, requested.durability) == ('VOLATILE', 'TRANSIENT_LOCAL'):
        reasons.append('durability: it offers volatile, transient local is requested')
    if offered.deadline > requested.deadline:
        reasons.append(
            f'deadline: it offers {_duration(offered.deadline)}, {_duration(requested.deadline)} is '
            'requested'
        )
    if (offered.liveliness, requested.liveliness) == ('AUTOMATIC', 'MANUAL_BY_TOPIC'):
        reasons.append('liveliness: it offers automatic, manual by topic is requested')
    if offered.lease > requested.lease:
        reasons.append(
            f'lease of the liveliness: it offers {_duration(offered.lease)}, '
            f'{_duration(requested.lease)} is requested'
        )
    return reasons


def _duration(nanoseconds: int) -> str:
    return 'no limit' if nanoseconds >= INFINITE_FROM else f'{nanoseconds / 1e9:g} s'


INFINITE_FROM = 2**62
"""Durations from here on mean no limit (ns): implementations of DDS round the largest one."""


def _check_quality(graph: Graph, topic: str) -> Iterator[Finding]:
    for subscription in graph.subscriptions(topic):
        publishers = [one for one in graph.publishers(topic) if one.kind == subscription.kind]
        bad = [one for one in publishers if mismatch(one.quality, subscription.quality)]
        for publisher in bad:
            reasons = mismatch(publisher.quality, subscription.quality)
            rest = ' It receives the other publishers.' if len(bad) < len(publishers) else ''
            yield Finding(
                f'{subscription.node} receives nothing of {publisher.node} on {topic}, because their '
                f'quality of service does not match ({"; ".join(reasons)}).{rest}',
                f'change one of both; for nodes of this package as in -p '
                f'qos_overrides.{topic}.subscription.{_changed_policy(reasons[0])}',
            )


def _changed_policy(reason: str) -> str:
    return {
        'reliability': 'reliability:=best_effort',
        'durability': 'durability:=volatile',
    }.get(reason.split(':')[0], 'POLICY:=VALUE')


def _check_number_of_publishers(graph: Graph, topic: str) -> Iterator[Finding]:
    nodes = [one.node for one in graph.publishers(topic)]
    known = _known(topic)
    if len(nodes) < 2 or topic == CLOCK:
        return
    if known.if_several:
        yield Finding(f'{listed(nodes)} publish {topic}', known.if_several)
    elif known.name == 'cmd_vel':
        yield Finding(
            f'{listed(nodes)} publish {topic}: the robot follows the last command of either',
            'drive by hand only while no goal is active, or use a multiplexer such as twist_mux',
            problem=False,
        )


def _check_missing(graph: Graph, topic: str) -> Iterator[Finding]:
    publishers = graph.publishers(topic)
    # A node that listens to what it publishes itself, as go_to_goal may, does not act on it.
    subscriptions = [
        one
        for one in graph.subscriptions(topic)
        if one.node not in {publisher.node for publisher in publishers}
    ]
    known = _known(topic)
    if topic in OF_EVERY_NODE:
        return
    if publishers and not subscriptions and known.if_unread:
        yield Finding(
            f'{listed([one.node for one in publishers])} publishes {topic}, but nobody subscribes to it',
            f'{known.if_unread} {SAME_NAMES.format(known.name)}'
            f'{_namesake(graph, topic, publishes=False)}',
            # Tools that publish goals come and go.
            problem=known.name in ('cmd_vel', 'joint_command'),
        )
    if subscriptions and not publishers and known.if_unpublished:
        yield Finding(
            f'{listed([one.node for one in subscriptions])} subscribes to {topic}, but nobody publishes '
            'it',
            f'{known.if_unpublished} {SAME_NAMES.format(known.name)}'
            f'{_namesake(graph, topic, publishes=True)}',
        )


def _namesake(graph: Graph, topic: str, *, publishes: bool) -> str:
    """Return a hint to a topic of the same base name that has the missing end."""
    others: list[Endpoint] = [
        one
        for one in graph.endpoints
        if one.publishes == publishes and one.topic != topic and base_name(one.topic) == base_name(topic)
    ]
    if not others:
        return ''
    verb = 'publishes' if publishes else 'subscribes to'
    return f'; {others[0].node} {verb} {others[0].topic}'
