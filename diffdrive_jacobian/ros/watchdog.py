"""A timer that strikes once nothing has fed it for a while."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node


class Watchdog:
    """Calls back when it was not fed for `timeout` on the node's clock; once, until fed again.

    Feeding only notes the instant: resetting a timer for every message costs more than the message.
    When the timer strikes, it is set again for what is left since the last meal.
    """

    def __init__(self, node: Node, callback: Callable[[], None]) -> None:
        """Create it; `start` lets it watch."""
        self._clock = node.get_clock()
        self._callback = callback
        self._timeout = 0
        self._fed_at = 0
        self._awake = False
        self._timer = node.create_timer(1.0, self._on_timer, autostart=False)
        back = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1))
        self._jumps = self._clock.create_jump_callback(back, post_callback=self._on_jump_back)

    def start(self, timeout: int) -> None:
        """Watch from now on with a timeout (ns); 0: never strike."""
        self.stop()
        self._timeout = timeout
        self.feed(self._clock.now().nanoseconds)

    def feed(self, now: int) -> None:
        """Put the strike off to `timeout` after now (ns)."""
        self._fed_at = now
        if not self._awake and self._timeout:
            self._sleep(self._timeout)

    def stop(self) -> None:
        """Watch no longer, until started again."""
        self._timeout = 0
        self._awake = False
        self._timer.cancel()

    def _sleep(self, duration: int) -> None:
        self._awake = True
        self._timer.timer_period_ns = duration
        self._timer.reset()

    def _on_jump_back(self, _: TimeJump) -> None:
        # rcl may leave the timer waiting for an instant of the old time line.
        if self._awake:
            self._fed_at = self._clock.now().nanoseconds
            self._sleep(self._timeout)

    def _on_timer(self) -> None:
        waited = self._clock.now().nanoseconds - self._fed_at
        if 0 <= waited < self._timeout:
            self._sleep(self._timeout - waited)
            return
        # Time that went back (waited < 0) is no proof of life.
        self._awake = False
        self._timer.cancel()
        self._callback()
