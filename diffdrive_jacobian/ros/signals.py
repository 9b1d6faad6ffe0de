"""Signals that only count: the one who runs the loop decides what they mean.

This module imports nothing slow, so that an entry point can catch signals before it loads rclpy.
"""

from __future__ import annotations

import signal
from types import FrameType, TracebackType

CAUGHT = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Signals:
    """Counts SIGINT, SIGTERM and SIGHUP instead of ending the process, inside a `with` block."""

    def __init__(self) -> None:
        """Nothing was caught yet."""
        self.count = 0
        self._previous: dict[signal.Signals, object] = {}

    def __enter__(self) -> Signals:
        """Catch from here on."""
        for number in CAUGHT:
            self._previous[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Give the signals back."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.count += 1


def ignore_from_now_on() -> None:
    """Let no signal disturb the interpreter while it exits."""
    for number in CAUGHT:
        signal.signal(number, signal.SIG_IGN)
