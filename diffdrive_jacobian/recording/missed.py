"""Which messages of a topic were received and which were missed, from their sequence numbers."""

from __future__ import annotations

from bisect import bisect_right

from diffdrive_jacobian.ros.rclpy_internals import ReceivedMessage

MAX_RUNS = 100
"""Runs of consecutive numbers that are kept of each publisher, to recognize messages received twice."""


class _Publisher:
    """The numbers received from one publisher, which numbers its messages consecutively."""

    def __init__(self, number: int) -> None:
        """Start with the number of the first received message."""
        self.received = 1
        self.ended = False
        # First and last number of each run, ascending.
        self.runs = [[number, number]]

    @property
    def missing(self) -> int:
        """Number of messages between the first and the last received one that were not received."""
        return self.runs[-1][1] - self.runs[0][0] + 1 - self.received

    def add(self, number: int) -> bool:
        """Add a number. Return whether it is new."""
        runs = self.runs
        if number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            place = bisect_right(runs, number, key=lambda run: run[0])
            if place and number <= runs[place - 1][1]:
                return False
            runs.insert(place, [number, number])
            for left in (place, place - 1):
                if 0 <= left < len(runs) - 1 and runs[left][1] + 1 == runs[left + 1][0]:
                    self._join(left)
            if len(runs) > MAX_RUNS:
                # What is missing between the oldest two stays missing.
                self._join(0)
        self.received += 1
        return True

    def _join(self, left: int) -> None:
        self.runs[left][1] = self.runs.pop(left + 1)[1]


class MissedMessages:
    """Counts the missing messages of a topic, and recognizes those that are received twice.

    A message is identified by its publisher and its number. Missing are the numbers between the first
    and the last one received from a publisher. What a publisher sent before the first message that was
    received does not count: it may have sent that before there was a subscription.
    """

    def __init__(self) -> None:
        """Start without messages."""
        self._publishers: dict[bytes, _Publisher] = {}
        self._numbered = True

    @property
    def count(self) -> int:
        """Number of missing messages. 0 with a middleware that does not number them."""
        return sum(one.missing for one in self._publishers.values()) if self._numbered else 0

    def received(self, message: ReceivedMessage) -> bool:
        """Process a message. Return whether it is new."""
        number = self._number(message)
        if message.publisher in self._publishers:
            return self._publishers[message.publisher].add(number)
        self._publishers[message.publisher] = _Publisher(number)
        return True

    def received_late(self, message: ReceivedMessage) -> None:
        """Process a message that was sent after the end of the recording.

        Those between the last one before the end and the first one after it are missing.
        """
        publisher = self._publishers.get(message.publisher)
        if publisher is not None and not publisher.ended:
            publisher.ended = True
            publisher.add(self._number(message))

    def _number(self, message: ReceivedMessage) -> int:
        if message.number is not None:
            return message.number
        # The time, too, tells the messages of a publisher apart.
        self._numbered = False
        return message.sent
