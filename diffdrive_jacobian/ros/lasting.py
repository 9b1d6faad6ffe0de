"""Faults that are reported when they have lasted for a while, once until they change."""

from __future__ import annotations


class LastingFault:
    """A fault that is checked periodically.

    The order in which nodes start must not matter, so a fault counts only after several checks.
    """

    def __init__(self, patience: int) -> None:
        """Start without the fault.

        Args:
            patience: Number of consecutive checks with the same fault after which it is reported.
        """
        self._patience = patience
        self._present: str | None = None
        self._checks = 0

    def check(self, present: str | None) -> str | None:
        """Return the fault if it is to be reported now.

        Args:
            present: Description of the fault at this check. None: there is none.
        """
        if present != self._present:
            self._present, self._checks = present, 0
        self._checks += 1
        return present if self._checks == self._patience else None


class Interleaving:
    """Detects several publishers whose messages alternate, by the sequence numbers of the messages.

    The numbers of one publisher increase. Where messages of two of them alternate, they fall again and
    again. A publisher that is restarted lets them fall once.
    """

    def __init__(self) -> None:
        """Start without messages."""
        self.number: int | None = None
        """Sequence number of the present message. None: the middleware has none."""
        self._last = -1
        self._falls = 0

    def count(self) -> None:
        """Count the present message."""
        number = self.number
        if number is not None:
            if number <= self._last:
                self._falls += 1
            self._last = number

    def falls(self) -> int:
        """Return how often the numbers did not increase since the last call."""
        falls, self._falls = self._falls, 0
        return falls
