"""What of a bag is played, and how."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

from rclpy.expand_topic_name import expand_topic_name
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader

from diffdrive_jacobian.bags.bag_reader import BagError, base_name, namespace_of
from diffdrive_jacobian.ros.rclpy_internals import reason
from diffdrive_jacobian.time_units import NANOSECONDS

NODE = 'replay_run'
"""Name of the node."""
MAX_DURATION = 2**62
"""Longest playback (ns): 146 years, half of the longest period of a timer of rcl."""
MAX_STAMP = 2**31 * NANOSECONDS
"""Limit of the times in messages (ns)."""
CLOCK_RATES = (1e-9, 1e9)
"""Lowest and highest rate of /clock (Hz). The period of a timer is a number of ns, of at least 1."""
COMMANDS = ('cmd_vel',)
"""Topics of the commands to a robot."""
GOALS = ('goal_pose', 'goals')
"""Topics of the goals of its controller."""


class NothingToPlayError(BagError):
    """The bag is readable, but has no message of the selected topics."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Playback:
    """Which messages of a bag are played, and how."""

    names: tuple[str, ...] | None = COMMANDS
    """Base names of the topics; None: all."""
    topics: tuple[str, ...] = ()
    """Names of the topics, instead of `names`. A name without its leading slash is in the namespace /,
    or in the only namespace of the bag that has it."""
    namespace: str | None = None
    """Namespace of the topics of `names`, such as `/robot1`. With all names also the namespaces in it.
    None: every namespace."""
    remap: Mapping[str, str] = field(default_factory=dict)
    """Topics to the other names under which they are published. A relative topic is in the namespace /,
    a relative new name in that of the node."""
    rate: float = 1.0
    """Factor on the speed."""
    start_offset: float = 0.0
    """Time after the beginning of the bag at which playback starts (s)."""
    loop: bool = False
    """Whether to start again at the end of the bag."""
    clock: float | None = None
    """Rate at which the time of the bag is published on /clock (Hz). None: it is not."""
    paused: bool = False
    """Whether to start in the paused state."""

    def choose(self, reader: Reader) -> list[Connection]:
        """Return the connections of a bag that are played.

        Raises:
            BagError: The bag lacks one of `topics`, or has several of that relative name.
            NothingToPlayError: It has no message of them.
        """
        there = sorted({connection.topic for connection in reader.connections})
        topics = {_resolved(topic, there, reader) for topic in self.topics}
        chosen = [one for one in reader.connections if self._wants(one.topic, topics)]
        if not any(connection.msgcount for connection in chosen):
            if not reader.message_count:
                raise NothingToPlayError(f'nothing to play: {reader.path} has no messages')
            wanted = ' or '.join(self.topics or self.names or ('any topic',))
            if self.namespace is not None:
                wanted += f' in the namespace {self.namespace}'
            full = sorted({one.topic for one in reader.connections if one.msgcount})
            raise NothingToPlayError(
                f'nothing to play: {reader.path} has no messages of {wanted}, only of '
                f'{", ".join(full)} (--all-topics plays them)'
            )
        return chosen

    def names_by_topic(self, connections: Sequence[Connection]) -> dict[str, str]:
        """Return the other names under which topics are published, by fully qualified topic.

        Args:
            connections: The connections that are played.

        Raises:
            BagError: A key of `remap` is not the name of a topic that is played, or two are the same.
        """
        played = sorted({connection.topic for connection in connections})
        names: dict[str, str] = {}
        for old, new in self.remap.items():
            try:
                topic = expand_topic_name(old, NODE, '/')
            except ValueError as error:
                raise BagError(f'remapping {old}:={new}: {reason(error)}') from error
            if topic not in played:
                raise BagError(
                    f'remapping {old}:={new} must rename a topic that is played, {", ".join(played)}, '
                    f'got {topic}'
                )
            if topic in names:
                raise BagError(f'{topic} must be remapped once, got {names[topic]} and {new}')
            names[topic] = new
        return names

    def start(self, reader: Reader) -> int:
        """Return the time in the bag at which playing starts (ns).

        Raises:
            BagError: The bag is not that long, or takes too long at this rate; or its times cannot be
                published on /clock, or not at this rate.
        """
        length = (reader.end_time - reader.start_time) / NANOSECONDS
        # An offset beyond the end can be too large for an integer of nanoseconds.
        start = reader.start_time + round(min(self.start_offset, length + 1.0) * NANOSECONDS)
        if start >= reader.end_time:
            raise BagError(
                f'--start-offset must be less than the length of the bag, {length:.3f} s, '
                f'got {self.start_offset:g}'
            )
        slowest = (reader.end_time - start) / MAX_DURATION
        if self.rate < slowest:
            raise BagError(
                f'--rate must be at least {slowest:.3g} for a bag of {length:.3f} s, got {self.rate:g}'
            )
        self._check_clock(reader)
        return start

    def _check_clock(self, reader: Reader) -> None:
        """Raise BagError if the times of a bag cannot be published on /clock, or not at this rate."""
        if self.clock is None:
            return
        lowest, highest = CLOCK_RATES
        if not lowest <= self.clock <= highest:
            raise BagError(f'--clock must be in [{lowest:g}, {highest:g}] Hz, got {self.clock:g}')
        if not -MAX_STAMP <= reader.start_time <= reader.end_time < MAX_STAMP:
            raise BagError(
                f'{reader.path} cannot be played with --clock: a message on /clock must have less than '
                f'{MAX_STAMP // NANOSECONDS} s, the bag ends at {reader.end_time / NANOSECONDS:.3f} s'
            )

    def _wants(self, topic: str, topics: Collection[str]) -> bool:
        if topics:
            return topic in topics
        namespace = self.namespace
        if self.names is None:
            return namespace in (None, '/') or topic.startswith(f'{namespace}/')
        return base_name(topic) in self.names and namespace in (None, namespace_of(topic))


def _resolved(name: str, there: Sequence[str], reader: Reader) -> str:
    """Return the fully qualified name of a topic of a bag.

    Raises:
        BagError: The bag does not have it, or has it in several namespaces, none of which is /.
    """
    for topic in (name, f'/{name}'):
        if topic in there:
            return topic
    relative = name and not name.startswith('/')
    found = [topic for topic in there if relative and topic.endswith(f'/{name}')]
    if len(found) > 1:
        raise BagError(f'{name} is ambiguous, it can be {" or ".join(found)}')
    if not found:
        raise BagError(f'{reader.path} has no topic {name}; it has {", ".join(there) or "none"}')
    return found[0]
