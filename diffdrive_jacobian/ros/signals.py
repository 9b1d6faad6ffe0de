"""Signals that only count: the one who runs the loop decides what they mean.

This module imports nothing slow, so that an entry point can catch signals before it loads rclpy.
"""

from __future__ import annotations

import signal
from types import FrameType

CAUGHT = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Signals:
    """Counts SIGINT, SIGTERM and SIGHUP in the place of their ending the process."""

    def __init__(self) -> None:
        """Nothing was caught yet."""
        self.count = 0

    def catch(self) -> None:
        """Count from here on."""
        for number in CAUGHT:
            signal.signal(number, self._on_signal)

    def ignore(self) -> None:
        """Let no signal disturb the interpreter while it exits."""
        for number in CAUGHT:
            signal.signal(number, signal.SIG_IGN)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
