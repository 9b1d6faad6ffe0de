"""A limit on how often something may happen."""

from __future__ import annotations


class TokenBucket:
    """Permits a burst, and then a rate."""

    def __init__(self, rate: float, burst: float, now: float) -> None:
        """Start with the whole burst.

        Args:
            rate: Permitted events per second.
            burst: Permitted events at once.
            now: Present time (s).
        """
        self._rate, self._burst = rate, burst
        self._left, self._time = burst, now

    def permits(self, now: float) -> bool:
        """Return whether an event at a time (s) is permitted, and count it if it is."""
        self._left = min(self._burst, self._left + (now - self._time) * self._rate)
        self._time = now
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True
