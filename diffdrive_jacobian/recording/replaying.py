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

"""Replay of a bag: what of it is played, the node that publishes it, and the stages of a replay.

from pathlib import Path

from diffdrive_jacobian.recording import Playback, replay

result = replay(Path('drive_2026_01_31-12_00_00'), Playback(rate=2.0))
print(result.played, result.messages)
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node
from rclpy.publisher import Publisher
from rosbags.interfaces import Connection, ConnectionExtRosbag2
from rosbags.rosbag2 import Reader
from rosgraph_msgs.msg import Clock as ClockMessage

from diffdrive_jacobian.bags.bag_reader import BagError, messages, open_bag
from diffdrive_jacobian.bags.message_definitions import UnknownTypeError, message_class
from diffdrive_jacobian.errors import NotDoneError
from diffdrive_jacobian.messages.conversion import set_time
from diffdrive_jacobian.messages.names import base_name, namespace_of, node_of
from diffdrive_jacobian.recording.progress import ReplayProgress
from diffdrive_jacobian.recording.qos import publisher_profile
from diffdrive_jacobian.ros.fastdds_profiles import fast_heartbeats
from diffdrive_jacobian.ros.rclpy_internals import RCLError, reason, restart_timer
from diffdrive_jacobian.ros.runner import ros_context, running
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.time_units import NANOSECONDS, seconds

NODE = 'replay_run'
"""Name of the node."""
MAX_DURATION = 2**62
"""Longest playback (ns): 146 years, half of the longest period of a timer of rcl."""
MAX_STAMP = 2**31 * NANOSECONDS
"""Limit of the times in messages (ns)."""
CLOCK_RATES = (1e-9, 1e4)
"""Lowest and highest rate of /clock (Hz). A Python process publishes some thousand messages a second."""
COMMANDS = ('cmd_vel',)
"""Topics of the commands to a robot."""
GOALS = ('goal_pose', 'goals')
"""Topics of the goals of its controller."""
DEPTH = 1000
DISCOVERY_PATIENCE = 5.0
"""Default of the longest wait for subscriptions where no number is required (s): an older participant
is announced every 3 s."""
MATCH_QUIET = 0.5
"""Time for which the numbers of subscriptions must not have changed before playback starts (s)."""


class NothingToPlayError(BagError, NotDoneError):
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
            BagError: The bag is too short for the offset, too long for the rate, or has times that
                cannot be published on /clock, or not at this rate.
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
        lowest, highest = CLOCK_RATES
        if self.clock is not None and not lowest <= self.clock <= highest:
            raise BagError(f'--clock must be in [{lowest:g}, {highest:g}] Hz, got {self.clock:g}')
        valid = -MAX_STAMP <= reader.start_time <= reader.end_time < MAX_STAMP
        if self.clock is not None and not valid:
            raise BagError(
                f'{reader.path} cannot be played with --clock: a message on /clock must have less than '
                f'{MAX_STAMP // NANOSECONDS} s, the bag ends at {reader.end_time / NANOSECONDS:.3f} s'
            )
        return start

    def _wants(self, topic: str, topics: Collection[str]) -> bool:
        if topics:
            return topic in topics
        namespace = self.namespace
        if self.names is None:
            return namespace in (None, '/') or topic.startswith(f'{namespace}/')
        return base_name(topic) in self.names and namespace in (None, namespace_of(topic))


def _resolved(name: str, there: Sequence[str], reader: Reader) -> str:
    """Return the fully qualified name of a topic of a bag."""
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


# --- The node


class Replayer(Node):  # type: ignore[misc]
    """Publishes each message when it is due, from `begin` on.

    With `loop` the next round starts at the end of the bag, also if the selected messages end sooner:
    every round takes as long as the recording, divided by the rate.
    """

    def __init__(self, reader: Reader, playback: Playback, **kwargs: Any) -> None:
        """Create the publishers.

        Args:
            reader: An open bag.
            playback: Which of its messages are played, and how.
            kwargs: As for `rclpy.node.Node`.

        Raises:
            NothingToPlayError: The bag has no message of the selected topics, or none after the offset.
            BagError: As of `Playback.choose`, `start` and `names_by_topic`; or a type is not installed,
                or a new name is invalid.
        """
        connections, start = playback.choose(reader), playback.start(reader)
        names = playback.names_by_topic(connections)
        if next(_messages_from(reader, connections, start), None) is None:
            topics = ', '.join(sorted({one.topic for one in connections}))
            raise NothingToPlayError(
                f'nothing to play: {reader.path} has no messages of {topics} after '
                f'--start-offset {playback.start_offset:g}'
            )
        super().__init__(NODE, start_parameter_services=False, **kwargs)
        self._reader = reader
        self._playback = playback
        self._connections = connections
        self._names = names
        self.start = start
        """Time in the bag at which playing starts (ns)."""
        self.end = reader.end_time
        """Time in the bag after its last message (ns)."""
        self.expected = 0
        """Number of messages that the bag counts; 0 if it is played in part or repeatedly."""
        if not playback.start_offset and not playback.loop:
            self.expected = sum(one.msgcount for one in connections)
        self.sent = 0
        """Number of messages published."""
        self.done = False
        """Whether all messages were published."""
        self.position = self.start
        """Current time in the bag (ns)."""
        self._publishers_by_connection = {one.id: self._advertise(one) for one in self._connections}
        self._coming: Iterator[tuple[Connection, int, bytes]] = iter(())
        self._next: tuple[Connection, int, bytes] | None = None
        self._wall = 0
        self._paused_at: int | None = None
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = self.create_timer(1.0, self._on_timer, clock=steady, autostart=False)
        if playback.clock:
            self._clock_publisher = self.create_publisher(ClockMessage, '/clock', 10)
            self._ticks = self.create_timer(1.0 / playback.clock, self._publish_time, clock=steady)

    def _advertise(self, connection: Connection) -> Publisher:
        topic = self._names.get(connection.topic, connection.topic)
        try:
            # Here all invalid names give the same error. In create_publisher they do not.
            self.resolve_topic_name(topic)
        except RCLError as error:
            raise BagError(
                f'{connection.topic} cannot be played as {topic!r}: {reason(error)}'
            ) from error
        assert isinstance(connection.ext, ConnectionExtRosbag2)
        profile = publisher_profile(connection.ext.offered_qos_profiles, DEPTH)
        try:
            return self.create_publisher(message_class(connection.msgtype), topic, profile)
        except UnknownTypeError as error:
            raise BagError(f'{connection.topic} cannot be played: {error}') from error

    # --- Subscriptions

    def readers(self) -> dict[str, int]:
        """Return the number of matched subscriptions of each topic."""
        found: dict[str, int] = {}
        for publisher in self._publishers_by_connection.values():
            # Several connections of a bag can have the same topic. Each has a publisher of its own.
            count = publisher.get_subscription_count()
            found[publisher.topic_name] = min(count, found.get(publisher.topic_name, count))
        return found

    def other_publishers(self) -> dict[str, list[str]]:
        """Return the names of other nodes that publish on the same topics, by topic."""
        ours = self.get_fully_qualified_name()
        found = {}
        for publisher in self._publishers_by_connection.values():
            names = map(node_of, self.get_publishers_info_by_topic(publisher.topic_name))
            if others := sorted(name for name in names if name != ours):
                found[publisher.topic_name] = others
        return found

    def unacknowledged(self) -> list[str]:
        """Return the topics with a reliable subscription that has not acknowledged all messages."""
        publishers = self._publishers_by_connection.values()
        now = Duration(seconds=0)
        return sorted({one.topic_name for one in publishers if not one.wait_for_all_acked(now)})

    # --- Playback

    def begin(self) -> None:
        """Start playback."""
        self._rewind(time.monotonic_ns())
        if self._playback.paused:
            self._paused_at = self._wall
            return
        self._arm()

    def _rewind(self, wall: int) -> None:
        """Return to the start, which is due at a monotonic time (ns)."""
        self._coming = _messages_from(self._reader, self._connections, self.start)
        self._next = next(self._coming, None)
        self._wall = wall
        self.position = self.start

    @property
    def paused(self) -> bool:
        """Whether playback is paused."""
        return self._paused_at is not None

    def toggle(self) -> None:
        """Pause or resume playback."""
        now = time.monotonic_ns()
        if self._paused_at is None:
            self._paused_at = now
            self.position = self._bag_time(now)
            self._timer.cancel()
            return
        self._wall += now - self._paused_at
        self._paused_at = None
        self._arm()

    def _due(self, stamp: int) -> int:
        """Return the monotonic time at which a time in the bag is due (ns)."""
        return self._wall + round((stamp - self.start) / self._playback.rate)

    def _bag_time(self, wall: int) -> int:
        # Not beyond the end: at a high rate that soon is no valid time.
        return self.start + round(min((wall - self._wall) * self._playback.rate, self.end - self.start))

    def _on_timer(self) -> None:
        self._timer.cancel()
        while self._next is not None:
            connection, stamp, data = self._next
            if time.monotonic_ns() < self._due(stamp):
                break
            self._publishers_by_connection[connection.id].publish(data)
            self.sent += 1
            self.position = stamp
            self._next = next(self._coming, None)
        if self._next is None and self._playback.loop and time.monotonic_ns() >= self._due(self.end):
            self._rewind(time.monotonic_ns())
        self._arm()

    def _arm(self) -> None:
        """Set the timer to the next message, or to the end of the bag if another round follows."""
        if self._next is None and not self._playback.loop:
            self.done = True
            return
        due = self._due(self.end if self._next is None else self._next[1])
        restart_timer(self._timer, max(due - time.monotonic_ns(), 1))

    def _publish_time(self) -> None:
        if not self._wall or self.done:
            return
        now = self.position if self.paused else self._bag_time(time.monotonic_ns())
        message = ClockMessage()
        set_time(message.clock, now)
        self._clock_publisher.publish(message)


def _messages_from(
    reader: Reader, connections: Sequence[Connection], start: int
) -> Iterator[tuple[Connection, int, bytes]]:
    """Yield the messages that were recorded at `start` (ns) or later, in the order of recording."""
    return (one for one in messages(reader, connections) if one[1] >= start)


# --- The stages of a replay


@dataclass(frozen=True, kw_only=True, slots=True)
class ReplayResult:
    """What became of a replay."""

    started: bool
    """Whether playback started. False: there were not enough subscriptions."""
    played: bool
    """Whether it came to the end of the bag."""
    interrupted: bool
    """Whether a signal ended it."""
    messages: int
    """Number of messages that were published."""
    too_few: dict[str, int] = field(default_factory=dict)
    """If playback did not start: number of subscriptions of each topic that has fewer than required."""
    unacknowledged: tuple[str, ...] = ()
    """Topics with subscriptions that have not acknowledged all messages in time."""
    missing: int = 0
    """If the whole bag was played once: how many messages less than it counts were found in it."""


def replay(
    bag: Path,
    playback: Playback | None = None,
    *,
    patience: float = DISCOVERY_PATIENCE,
    readers: int | None = None,
    timeout: float = math.inf,
    acknowledgement_timeout: float | None = None,
    ros_arguments: Sequence[str] = (),
    signals: Signals | None = None,
    progress: ReplayProgress | None = None,
) -> ReplayResult:
    """Publish the messages of a bag.

    Args:
        bag: The bag.
        playback: What of it is played, and how. None: the default.
        patience: Longest wait for subscriptions where no number is required (s).
        readers: Number of subscriptions that each topic must have before anything is played. None: those
            that are discovered within `patience`.
        timeout: Longest wait for the required number (s).
        acknowledgement_timeout: Longest wait at the end until all subscriptions have acknowledged all
            messages (s). 0: no limit. None: no wait.
        ros_arguments: ROS arguments of the node.
        signals: Counter of the signals that end the replay. None: no signal does.
        progress: Receives the progress. None: nothing does.

    Raises:
        UserError: The ROS arguments are invalid.
        BagError: The bag cannot be played, or not with these remappings.
        NothingToPlayError: It has no message to play.
    """
    playback, signals, progress = (
        playback or Playback(),
        signals or Signals(),
        progress or ReplayProgress(),
    )
    with (
        open_bag(bag) as reader,
        fast_heartbeats(),
        ros_context([NODE, *ros_arguments]) as context,
        running(context, isolated=False) as runner,
    ):
        player = runner.add(lambda: Replayer(reader, playback, context=context))
        session = _Session(player, partial(runner.spin, signals=signals), progress)
        if readers is None:
            session.wait_for_discovery(patience)
        elif not session.wait_for_readers(readers, timeout):
            return ReplayResult(
                started=False,
                played=False,
                interrupted=signals.count > 0,
                messages=0,
                too_few=_too_few(player, readers),
            )
        for topic, others in player.other_publishers().items():
            player.get_logger().warning(f'{", ".join(others)} also publishes on {topic}')
        for topic in _too_few(player, 1):
            player.get_logger().warning(f'no node is subscribed to {topic} (-w 1 waits for one)')
        played = session.play()
        unacknowledged: list[str] = []
        if played and acknowledgement_timeout is not None:
            unacknowledged = session.wait_for_acknowledgements(acknowledgement_timeout)
        return ReplayResult(
            started=True,
            played=played,
            interrupted=signals.count > 0,
            messages=player.sent,
            unacknowledged=tuple(unacknowledged),
            missing=max(0, player.expected - player.sent) if played else 0,
        )


def _too_few(player: Replayer, readers: int) -> dict[str, int]:
    """Return the number of subscriptions of each topic that has fewer than required."""
    return {topic: number for topic, number in player.readers().items() if number < readers}


def describe_too_few(counts: dict[str, int], readers: int) -> str:
    """Describe which topics have fewer subscriptions than required."""
    return ', '.join(
        f'{topic} has {number} of {readers} subscriptions' for topic, number in counts.items()
    )


@dataclass(frozen=True, slots=True)
class _Session:
    """The stages of a replay."""

    player: Replayer
    spin: Callable[..., bool]
    """`NodeRunner.spin` until a signal."""
    progress: ReplayProgress

    def wait_for_discovery(self, patience: float) -> None:
        """Wait, at most so long (s), until each topic has a subscription and no more are discovered."""
        before: dict[str, int] = {}
        since = time.monotonic()

        def complete() -> bool:
            nonlocal before, since
            counts = self.player.readers()
            if counts != before:
                before, since = counts, time.monotonic()
            without = ', '.join(topic for topic, count in counts.items() if not count)
            self.progress.waiting(
                f'no subscription to {without} (starting after {patience:g} s without it)'
                if without
                else 'further subscriptions may be discovered'
            )
            return not without and time.monotonic() - since >= MATCH_QUIET

        self.spin(complete, timeout=patience)

    def wait_for_readers(self, readers: int, timeout: float) -> bool:
        """Wait until each topic has so many subscriptions; return False after a time (s) or a signal."""

        def complete() -> bool:
            if missing := _too_few(self.player, readers):
                self.progress.waiting(describe_too_few(missing, readers))
            return not missing

        return self.spin(complete, timeout=timeout)

    def play(self) -> bool:
        """Play the bag; return whether it was played to its end."""
        player = self.player
        self.progress.started(seconds(player.end - player.start))

        def done() -> bool:
            if self.progress.toggled():
                player.toggle()
            self.progress.playing(seconds(player.position - player.start), paused=player.paused)
            return player.done

        try:
            player.begin()
            self.spin(done)
        finally:
            self.progress.ended()
        return player.done

    def wait_for_acknowledgements(self, timeout: float) -> list[str]:
        """Wait at most so long (s; 0: no limit); return the topics that were not acknowledged."""

        def complete() -> bool:
            if missing := self.player.unacknowledged():
                topics = ', '.join(missing)
                self.progress.waiting(
                    f'not all subscriptions to {topics} have acknowledged all messages'
                )
            return not missing

        return [] if self.spin(complete, timeout=timeout or math.inf) else self.player.unacknowledged()
