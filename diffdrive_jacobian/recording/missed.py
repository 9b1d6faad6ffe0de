"""How many messages never reached a reader, by gaps in the numbers that the publishers give them."""

from __future__ import annotations

from collections.abc import Callable


class MissedMessages:
    """Counts the missing messages of a topic.

    Each publisher numbers its messages 1, 2, 3, ... A message does not name its publisher, so a number
    is attributed to the publisher whose last number is closest below. To which of them a gap is
    attributed does not change the sum of all gaps. What a publisher sent before its first message that
    arrived is not counted.
    """

    def __init__(self, publishers: Callable[[], int]) -> None:
        """Start without messages.

        Args:
            publishers: Returns how many publishers the topic has now. It is called for each gap.
        """
        self._publishers = publishers
        # The last number of each publisher; the one heard last comes first.
        self._last: list[int] = []
        self.count = 0
        """Messages that are missing."""

    def received(self, number: int) -> None:
        """Note the number of a message."""
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
            # Otherwise it is the first one of another publisher; one of those before may be gone.
            del last[max(0, publishers - 1) :]
        last.insert(0, number)
