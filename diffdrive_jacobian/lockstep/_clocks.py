"""The clocks of the nodes."""

from __future__ import annotations

from collections.abc import Iterable

from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

from diffdrive_jacobian.messages.conversion import set_time
from diffdrive_jacobian.ros.rclpy_internals import SimulatedClock


class Clocks:
    """Sets the clocks of the nodes directly. A message for each would double the time of a step.

    Other subscriptions to /clock receive messages.
    """

    def __init__(self) -> None:
        """Start without clocks."""
        self.publisher: Publisher | None = None
        """Publisher of /clock."""
        self.enabled = True
        """Whether the time is published."""
        self.publications = 0
        """Number of messages on /clock."""
        self._clocks: list[SimulatedClock] = []
        self._message = Clock()
        self._now = 0
        self._announced = 0

    def find(self, nodes: Iterable[Node]) -> set[Subscription]:
        """Find the clocks of nodes. Return the subscriptions to /clock that are replaced.

        A clock whose topic was renamed follows that topic.
        """
        topic = self.publisher and self.publisher.topic_name
        replaced = set()
        self._clocks = []
        for node in nodes:
            clock = SimulatedClock(node)
            if clock.subscription is not None and clock.subscription.topic_name == topic:
                self._clocks.append(clock)
                replaced.add(clock.subscription)
        return replaced

    def set(self, now: int) -> None:
        """Set the time (ns), and publish it if somebody else receives it."""
        self._now = now
        time = Time(nanoseconds=now, clock_type=ClockType.ROS_TIME)
        for clock in self._clocks:
            clock.set(time)
        if self.publisher is None or now == self._announced:
            return
        if self.publisher.get_subscription_count() > len(self._clocks):
            self.publish()

    def announce(self, now: int) -> None:
        """Publish the time (ns), before the clocks of the nodes are set to it."""
        self._now = self._announced = now
        self.publish()

    def publish(self) -> None:
        """Publish the time that was set last, once more."""
        if self.enabled and self.publisher is not None:
            self.publications += 1
            set_time(self._message.clock, self._now)
            self.publisher.publish(self._message)
