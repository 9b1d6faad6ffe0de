"""The node that replays: it publishes a bag's messages as they were recorded, in their rhythm."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rosbags.interfaces import Connection, ConnectionExtRosbag2
from rosbags.rosbag2 import Reader
from rosgraph_msgs.msg import Clock as ClockMessage

from diffdrive_jacobian.bags.definitions import UnknownTypeError, message_class
from diffdrive_jacobian.bags.qos import to_offer_again
from diffdrive_jacobian.bags.reading import BagError, base_name, messages

NANOSECONDS = 1_000_000_000
DEPTH = 1000
COMMANDED = ('cmd_vel',)
"""What a robot was told."""
TOLD = ('goal_pose', 'goals')
"""What its controller was told."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Playback:
    """What of a bag is played, and how."""

    names: tuple[str, ...] | None = COMMANDED
    """Base names of the topics; None: all."""
    topics: tuple[str, ...] = ()
    """Full names of the topics, in the place of `names`."""
    remap: Mapping[str, str] = field(default_factory=dict)
    """Topics that are published under another name."""
    rate: float = 1.0
    """How much faster than it was recorded."""
    start_offset: float = 0.0
    """How much of the beginning is left out (s)."""
    loop: bool = False
    clock: float | None = None
    """How often the bag's time is published on /clock (Hz); None: not."""
    paused: bool = False
    """Whether it waits for somebody to resume it."""

    def choose(self, reader: Reader) -> list[Connection]:
        """Say what of a bag is played.

        Raises:
            BagError: The bag has nothing of it.
        """
        there = sorted({connection.topic for connection in reader.connections})
        missing = [topic for topic in self.topics if topic not in there]
        if missing:
            raise BagError(
                f'{reader.path} has no topic {missing[0]}; it has {", ".join(there) or "none"}'
            )
        chosen = [one for one in reader.connections if self._wants(one.topic)]
        if not any(connection.msgcount for connection in chosen):
            wanted = ' or '.join(self.names or ())
            raise BagError(
                f'{reader.path} has no messages of {wanted or "any topic"} to play; it has '
                f'{", ".join(there) or "no topics"} (--all-topics plays what there is)'
            )
        return chosen

    def _wants(self, topic: str) -> bool:
        if self.topics:
            return topic in self.topics
        return self.names is None or base_name(topic) in self.names


class Replayer(Node):  # type: ignore[misc]
    """Publishes, from `begin` on, each message when its time has come."""

    def __init__(self, reader: Reader, playback: Playback, **kwargs: Any) -> None:
        """Advertise the topics.

        Args:
            reader: An open bag.
            playback: What of it is played.
            kwargs: As for `rclpy.node.Node`.

        Raises:
            BagError: The bag has nothing to play, or of a type that is not installed.
        """
        super().__init__('replay_run', start_parameter_services=False, **kwargs)
        self._reader = reader
        self._playback = playback
        self._connections = playback.choose(reader)
        self.start = reader.start_time + round(playback.start_offset * NANOSECONDS)
        """The instant of the bag at which it begins (ns)."""
        self.end = reader.end_time
        """The instant after its last message (ns)."""
        if self.start >= self.end:
            length = (reader.end_time - reader.start_time) / NANOSECONDS
            raise BagError(
                f'--start-offset must be less than the length of the bag, {length:.3f} s, '
                f'got {playback.start_offset:g}'
            )
        self.sent = 0
        """How many messages were published."""
        self.lateness: list[int] = []
        """How late each was (ns)."""
        self.done = False
        self.position = self.start
        """The instant of the bag that is played (ns)."""
        self._outlets = {one.id: self._advertise(one) for one in self._connections}
        self._clock_outlet: Publisher | None = None
        if playback.clock:
            self._clock_outlet = self.create_publisher(ClockMessage, '/clock', 10)
        self._coming: Iterator[tuple[Connection, int, bytes]] = iter(())
        self._next: tuple[Connection, int, bytes] | None = None
        self._wall = 0
        self._paused_at: int | None = None
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = self.create_timer(1.0, self._on_timer, clock=steady, autostart=False)
        if playback.clock:
            self._ticks = self.create_timer(1.0 / playback.clock, self._tell_time, clock=steady)

    def _advertise(self, connection: Connection) -> Publisher:
        topic = self._playback.remap.get(connection.topic, connection.topic)
        assert isinstance(connection.ext, ConnectionExtRosbag2)
        profile = to_offer_again(connection.ext.offered_qos_profiles, DEPTH)
        try:
            return self.create_publisher(message_class(connection.msgtype), topic, profile)
        except UnknownTypeError as error:
            raise BagError(f'{connection.topic} cannot be played: {error}') from error

    # --- Who listens

    @property
    def unheard(self) -> list[str]:
        """The topics that nobody is matched to."""
        return self.heard_by_fewer(1)

    def heard_by_fewer(self, readers: int) -> list[str]:
        """Give the topics that have fewer readers."""
        outlets = self._outlets.values()
        return [one.topic_name for one in outlets if one.get_subscription_count() < readers]

    def rivals(self) -> dict[str, list[str]]:
        """Name the others that publish on the same topics."""
        ours = self.get_fully_qualified_name()
        found = {}
        for publisher in self._outlets.values():
            infos = self.get_publishers_info_by_topic(publisher.topic_name)
            names = [f'{info.node_namespace.rstrip("/")}/{info.node_name}' for info in infos]
            others = sorted(name for name in names if name != ours)
            if others:
                found[publisher.topic_name] = others
        return found

    def wait_for_all_acked(self, timeout: Duration) -> bool:
        """Wait until every reader has everything; whether that came true."""
        acked = [one.wait_for_all_acked(timeout) for one in self._outlets.values()]
        return all(acked)

    # --- Playing

    def begin(self) -> None:
        """Play from the start."""
        self._coming = messages(self._reader, self._connections)
        self._next = next((one for one in self._coming if one[1] >= self.start), None)
        self._wall = time.monotonic_ns()
        self.position = self.start
        if self._playback.paused and self._paused_at is None and not self.sent:
            self._paused_at = self._wall
            return
        self._arm()

    @property
    def paused(self) -> bool:
        """Whether it waits to be resumed."""
        return self._paused_at is not None

    def toggle(self) -> None:
        """Pause it, or go on."""
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
        """Give the wall time at which an instant of the bag has come (ns)."""
        return self._wall + round((stamp - self.start) / self._playback.rate)

    def _bag_time(self, wall: int) -> int:
        return self.start + round((wall - self._wall) * self._playback.rate)

    def _on_timer(self) -> None:
        self._timer.cancel()
        while self._next is not None:
            connection, stamp, data = self._next
            late = time.monotonic_ns() - self._due(stamp)
            if late < 0:
                break
            self._outlets[connection.id].publish(data)
            self.sent += 1
            self.lateness.append(late)
            self.position = stamp
            self._next = next(self._coming, None)
        self._arm()

    def _arm(self) -> None:
        if self._next is None:
            if self._playback.loop:
                self.begin()
            else:
                self.done = True
            return
        self._timer.timer_period_ns = max(self._due(self._next[1]) - time.monotonic_ns(), 1)
        self._timer.reset()

    def _tell_time(self) -> None:
        if self._clock_outlet is None or not self._wall or self.done:
            return
        now = self.position if self.paused else self._bag_time(time.monotonic_ns())
        message = ClockMessage()
        message.clock.sec, message.clock.nanosec = divmod(now, NANOSECONDS)
        self._clock_outlet.publish(message)
