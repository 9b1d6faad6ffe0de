"""The number of messages that a subscription missed, from gaps in their sequence numbers."""

from __future__ import annotations

from collections.abc import Callable


class MissedMessages:
    """Counts the missing messages of a topic.

    Each publisher numbers its messages 1, 2, 3, ... A message does not identify its publisher. A number
    is therefore attributed to the publisher whose last number is the closest below. The sum of all gaps
    does not depend on this choice. Messages that a publisher sent before the first one that was received
    are not counted.
    """

    def __init__(self, publishers: Callable[[], int]) -> None:
        """Start without messages.

        Args:
            publishers: Returns the current number of publishers of the topic. It is called for each gap.
        """
        self._publishers = publishers
        # The last number of each publisher, most recently received first.
        self._last: list[int] = []
        self.count = 0
        """Number of missing messages."""

    def received(self, number: int) -> None:
        """Process the sequence number of a received message."""
        last = self._last
        if last and last[0] == number - 1:
            last[0] = number
            return
        if number - 1 in last:
            last.remove(number - 1)
        else:
            before = [one for one in last if one < number]
            publishers = max(1, self._publishers())
            if before and len(last) >= publishers:
                last.remove(max(before))
                self.count += number - max(before) - 1
            # Otherwise it is the first one of another publisher. An older publisher may be gone.
            del last[max(0, publishers - 1) :]
        last.insert(0, number)
