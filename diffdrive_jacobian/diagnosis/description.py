"""Descriptions of a graph of nodes as values, and of what is found in them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from diffdrive_jacobian.messages.topics import OF_EVERY_NODE

INFINITE = 2**63 - 1
"""Duration that means no limit (ns)."""


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
