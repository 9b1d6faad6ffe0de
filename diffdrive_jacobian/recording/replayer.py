"""The node that replays: it publishes the messages of a bag at the times of the recording."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rosbags.interfaces import Connection, ConnectionExtRosbag2
from rosbags.rosbag2 import Reader
from rosgraph_msgs.msg import Clock as ClockMessage

from diffdrive_jacobian.bags.bag_reader import BagError, messages
from diffdrive_jacobian.bags.message_definitions import UnknownTypeError, message_class
from diffdrive_jacobian.messages.conversion import set_time
from diffdrive_jacobian.recording.lateness import Lateness
from diffdrive_jacobian.recording.playback import NODE, NothingToPlayError, Playback
from diffdrive_jacobian.ros.qos import publisher_profile
from diffdrive_jacobian.ros.rclpy_internals import RCLError, reason, restart_timer

DEPTH = 1000


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
            BagError: The bag cannot be played: it is too short for the offset, too long for the rate,
                lacks a topic, or has messages of a type that is not installed; or a remapping or the
                rate of /clock is invalid.
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
        self.lateness = Lateness()
        """Delays of the messages."""
        self.done = False
        """Whether all messages were published."""
        self.position = self.start
        """Current time in the bag (ns)."""
        self._publishers_by_connection = {one.id: self._advertise(one) for one in self._connections}
        self._clock_publisher: Publisher | None = None
        if playback.clock:
            self._clock_publisher = self.create_publisher(ClockMessage, '/clock', 10)
        self._coming: Iterator[tuple[Connection, int, bytes]] = iter(())
        self._next: tuple[Connection, int, bytes] | None = None
        self._wall = 0
        self._paused_at: int | None = None
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = self.create_timer(1.0, self._on_timer, clock=steady, autostart=False)
        if playback.clock:
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

    @property
    def unmatched(self) -> list[str]:
        """The topics without a matched subscription."""
        return [topic for topic, readers in self.readers().items() if not readers]

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
            infos = self.get_publishers_info_by_topic(publisher.topic_name)
            names = [f'{info.node_namespace.rstrip("/")}/{info.node_name}' for info in infos]
            others = sorted(name for name in names if name != ours)
            if others:
                found[publisher.topic_name] = others
        return found

    def unacknowledged(self) -> list[str]:
        """Return the topics with a reliable subscription that has not acknowledged all messages."""
        return sorted(
            {
                one.topic_name
                for one in self._publishers_by_connection.values()
                if not one.wait_for_all_acked(Duration(seconds=0))
            }
        )

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
            late = time.monotonic_ns() - self._due(stamp)
            if late < 0:
                break
            self._publishers_by_connection[connection.id].publish(data)
            self.sent += 1
            self.lateness.add(late)
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
        if self._clock_publisher is None or not self._wall or self.done:
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
