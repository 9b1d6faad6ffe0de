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

"""A graph of nodes as values, and what is wrong with its topics and clocks."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from diffdrive_jacobian.messages.names import base_name
from diffdrive_jacobian.messages.topic_faults import (
    ALTERNATING,
    OF_SOMEBODY_ELSE,
    SEVERAL,
    UNPUBLISHED,
    UNREAD,
)
from diffdrive_jacobian.messages.topics import CLOCK, OF_EVERY_NODE, TOPICS, Topic
from diffdrive_jacobian.parameters.wheels import SAME_WHEELS, Dimensions, different_wheels
from diffdrive_jacobian.text import listed

INFINITE = 2**63 - 1
"""Duration that means no limit (ns)."""
INFINITE_FROM = 2**62
"""Durations from here on mean no limit, too (ns): implementations of DDS round the largest one."""
COMMANDS = ('cmd_vel', 'joint_command')
"""Topics that must have a subscription."""
MAX_AGE = 1.0
"""Largest age of a message on receipt (s)."""
MAX_AHEAD = 0.1
"""Largest time by which a stamp may lie in the future (s)."""
PATIENCE = 1.0
"""Shortest observation after which a silent /clock is reported (s)."""


@dataclass(frozen=True, slots=True)
class Problem:
    """Something that is wrong or worth knowing, and what to do about it."""

    what: str
    remedy: str
    problem: bool = True
    """Whether something does not work. False: a note."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Quality:
    """The policies of a quality of service that decide whether two endpoints match."""

    reliability: str = 'RELIABLE'
    durability: str = 'VOLATILE'
    liveliness: str = 'AUTOMATIC'
    deadline: int = INFINITE
    """Longest period between two messages (ns)."""
    lease: int = INFINITE
    """Lease duration of the liveliness (ns)."""

    @classmethod
    def of(cls, profile: Any) -> Quality:
        """Return the policies of a profile of rclpy. What is not given there is 0 or the default."""
        liveliness = profile.liveliness.name
        return cls(
            reliability=profile.reliability.name,
            durability=profile.durability.name,
            liveliness='AUTOMATIC' if liveliness == 'SYSTEM_DEFAULT' else liveliness,
            deadline=profile.deadline.nanoseconds or INFINITE,
            lease=profile.liveliness_lease_duration.nanoseconds or INFINITE,
        )


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A publisher or a subscription."""

    node: str
    """Fully qualified name of its node."""
    topic: str
    """Fully qualified name of the topic."""
    kind: str
    """Type of the messages, package/msg/Name."""
    publishes: bool
    quality: Quality = Quality()


@dataclass(frozen=True, slots=True)
class Participant:
    """A node."""

    name: str
    """Fully qualified name."""
    use_sim_time: bool | None = None
    """None: it did not report it."""
    wheels: Dimensions | None = None
    """Dimensions of its wheels. None: it has none."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Stream:
    """What was received on a topic."""

    topic: str
    messages: int
    rate: float
    """Messages per second."""
    age: float | None = None
    """Age of the youngest message on receipt, by the system clock (s). None: no message has a stamp."""
    simulated_age: float | None = None
    """The same by the last message on /clock. None: there was none."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ClockMessages:
    """What was received on /clock."""

    messages: int = 0
    advanced: float = 0.0
    """Time by which it advanced (s)."""
    went_back: int = 0
    """Number of messages with an earlier time than the one before."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Graph:
    """Nodes with their topics, and what was received while they were observed."""

    nodes: tuple[Participant, ...] = ()
    endpoints: tuple[Endpoint, ...] = ()
    streams: tuple[Stream, ...] = ()
    clock: ClockMessages = ClockMessages()
    seconds: float = 0.0
    """Duration of the observation (s)."""

    def topics(self) -> list[str]:
        """Return the names of the topics, sorted, without those that every node has."""
        return sorted({one.topic for one in self.endpoints} - set(OF_EVERY_NODE))

    def publishers(self, topic: str) -> list[Endpoint]:
        """Return the publishers of a topic."""
        return [one for one in self.endpoints if one.topic == topic and one.publishes]

    def subscriptions(self, topic: str) -> list[Endpoint]:
        """Return the subscriptions to a topic."""
        return [one for one in self.endpoints if one.topic == topic and not one.publishes]


def check_topics(graph: Graph) -> Iterator[Problem]:
    """Yield what keeps nodes from communicating."""
    for name, count in sorted(Counter(node.name for node in graph.nodes).items()):
        if count > 1:
            yield Problem(
                f'{count} nodes have the name {name}',
                'stop one of them, or give each a namespace of its own, which its topics then have, too '
                f'(-r __ns:=/NAME); one that was killed disappears within 20 s; {OF_SOMEBODY_ELSE}',
            )
    for topic in graph.topics():
        yield from _check_types(graph, topic)
        yield from _check_quality(graph, topic)
        yield from _check_ends(graph, topic)
        if base_name(topic) == 'joint_command':
            yield from _check_wheels(graph, topic)


def _check_types(graph: Graph, topic: str) -> Iterator[Problem]:
    publishers: dict[str, list[str]] = defaultdict(list)
    subscriptions: dict[str, list[str]] = defaultdict(list)
    for one in graph.endpoints:
        if one.topic == topic:
            (publishers if one.publishes else subscriptions)[one.kind].append(one.node)
    for theirs, sources in sorted(publishers.items()):
        for ours, sinks in sorted(subscriptions.items()):
            if theirs != ours:
                yield Problem(
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


def _check_quality(graph: Graph, topic: str) -> Iterator[Problem]:
    for subscription in graph.subscriptions(topic):
        publishers = [one for one in graph.publishers(topic) if one.kind == subscription.kind]
        bad = [one for one in publishers if mismatch(one.quality, subscription.quality)]
        for publisher in bad:
            reasons = mismatch(publisher.quality, subscription.quality)
            rest = ' It receives the other publishers.' if len(bad) < len(publishers) else ''
            policy = {
                'reliability': 'reliability:=best_effort',
                'durability': 'durability:=volatile',
            }.get(reasons[0].split(':')[0], 'POLICY:=VALUE')
            yield Problem(
                f'{subscription.node} receives nothing of {publisher.node} on {topic}, because their '
                f'quality of service does not match ({"; ".join(reasons)}).{rest}',
                f'change one of both; for nodes of this package as in -p '
                f'qos_overrides.{topic}.subscription.{policy}',
            )


def _check_ends(graph: Graph, topic: str) -> Iterator[Problem]:
    known = TOPICS.get(base_name(topic), Topic(name=''))
    publishers = [one.node for one in graph.publishers(topic)]
    # A node that listens to what it publishes itself, as go_to_goal may, does not act on it.
    subscriptions = [one.node for one in graph.subscriptions(topic) if one.node not in publishers]
    for fault in (SEVERAL, ALTERNATING, UNREAD, UNPUBLISHED):
        remedy = fault.remedy(known)
        if remedy and fault.present(len(publishers), len(subscriptions)):
            missing_end = fault in (UNREAD, UNPUBLISHED)
            yield Problem(
                fault.found(topic, publishers, subscriptions),
                remedy + (_namesake(graph, topic, publishes=not publishers) if missing_end else ''),
                # Tools that publish goals come and go.
                problem=fault.problem and (fault is not UNREAD or known.name in COMMANDS),
            )


def _check_wheels(graph: Graph, topic: str) -> Iterator[Problem]:
    known = {node.name: node.wheels for node in graph.nodes if node.wheels is not None}
    for source in graph.publishers(topic):
        for sink in graph.subscriptions(topic):
            if source.node in known and sink.node in known:
                found = different_wheels(known[source.node], sink.node, known[sink.node])
                if found:
                    yield Problem(f'{found} by {source.node}', SAME_WHEELS)


def _namesake(graph: Graph, topic: str, *, publishes: bool) -> str:
    """Return a hint to a topic of the same base name that has the missing end."""
    for one in graph.endpoints:
        same = one.topic != topic and base_name(one.topic) == base_name(topic)
        if same and one.publishes == publishes:
            return f'; {one.node} {"publishes" if publishes else "subscribes to"} {one.topic}'
    return ''


def check_clocks(graph: Graph) -> Iterator[Problem]:
    """Yield what is wrong with the clocks of the nodes."""
    publishers = [one.node for one in graph.publishers(CLOCK)]
    simulated = [node.name for node in graph.nodes if node.use_sim_time]
    real = [
        node.name for node in graph.nodes if node.use_sim_time is False and node.name not in publishers
    ]
    if len(publishers) > 1:
        yield Problem(
            f'{listed(publishers)} publish {CLOCK}: the time jumps back and forth',
            'stop all but one (a simulator, replay_run --clock or ros2 bag play --clock)',
        )
    if simulated and not publishers:
        yield Problem(
            f'{listed(simulated)} uses simulated time (use_sim_time), but nobody publishes {CLOCK}: '
            'its time stands at zero',
            'start the simulator, or set use_sim_time to false',
        )
    if publishers and graph.seconds >= PATIENCE:
        yield from _check_messages(graph, publishers, simulated)
    if simulated and real and publishers:
        yield Problem(
            f'{listed(simulated)} uses simulated time, {listed(real)} does not: their stamps cannot be '
            'compared',
            'set use_sim_time to the same value everywhere (-p use_sim_time:=true)',
        )
    elif publishers and real:
        yield Problem(
            f'{listed(publishers)} publishes {CLOCK}, but no node uses it',
            'set use_sim_time to true (-p use_sim_time:=true) if it is the time of the robot',
            problem=False,
        )
    for stream in graph.streams:
        yield from _check_stamps(graph, stream)


def _check_messages(graph: Graph, publishers: list[str], simulated: list[str]) -> Iterator[Problem]:
    if not graph.clock.messages:
        yield Problem(
            f'nothing was received on {CLOCK} in {graph.seconds:.1f} s, although '
            f'{listed(publishers)} publishes it',
            'start or resume the simulator; it may be paused',
            problem=bool(simulated),
        )
    elif graph.clock.messages > 1 and graph.clock.advanced <= 0.0 and not graph.clock.went_back:
        yield Problem(
            f'the time on {CLOCK} stands still', 'resume the simulator', problem=bool(simulated)
        )
    elif graph.clock.went_back:
        yield Problem(
            f'the time on {CLOCK} went back {graph.clock.went_back} times in {graph.seconds:.1f} s',
            'one source must publish it; a bag that loops sets it back at each round',
            problem=bool(simulated),
        )


def _check_stamps(graph: Graph, stream: Stream) -> Iterator[Problem]:
    clocks = {node.name: node.use_sim_time for node in graph.nodes}
    nodes = [one.node for one in graph.publishers(stream.topic)]
    known = {clocks.get(node) for node in nodes}
    ages = {True: stream.simulated_age, False: stream.age}
    # A node that did not report its clock may have either.
    wanted = known if known <= {True, False} and len(known) == 1 else {True, False}
    present = [age for clock, age in ages.items() if clock in wanted and age is not None]
    if not present:
        return
    age = min(present, key=abs)
    if -MAX_AHEAD <= age <= MAX_AGE:
        return
    where = f'{age:.3g} s old on receipt' if age > 0.0 else f'{-age:.3g} s in the future'
    yield Problem(
        f'the messages of {listed(nodes)} on {stream.topic} have stamps that are {where}',
        'set the clocks of the machines (chrony or NTP), and use_sim_time to the same value everywhere',
    )
