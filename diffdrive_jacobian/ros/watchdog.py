# Copyright 2026 The diffdrive_jacobian developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Timeouts of the input of a node: messages that stay away."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node

from diffdrive_jacobian.ros.rclpy_internals import restart_timer


class Watchdog:
    """Calls a function once when it was not fed for `timeout` on the node's clock, until fed again.

    Feeding stores the time only, because resetting a timer costs more than receiving a message. When the
    timer expires early, it is restarted for the rest of the timeout.
    """

    def __init__(self, node: Node, callback: Callable[[], None]) -> None:
        """Create it. `start` enables it."""
        self._clock = node.get_clock()
        self._callback = callback
        self._timeout = 0
        self._fed_at = 0
        self._running = False
        self._timer = node.create_timer(1.0, self._on_timer, autostart=False)
        back = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1))
        self._jumps = self._clock.create_jump_callback(back, post_callback=self._on_jump_back)

    def start(self, timeout: int) -> None:
        """Start with a new timeout (ns); 0: it never expires."""
        self.stop()
        self._timeout = timeout
        self.feed(self._clock.now().nanoseconds)

    def change_timeout(self, timeout: int) -> None:
        """Change the timeout (ns); 0: it never expires. The time since it was fed counts."""
        expired = bool(self._timeout) and not self._running
        if not timeout:
            self.stop()
            return
        self._timeout = timeout
        if not expired:
            self._wait_for_rest()

    def feed(self, now: int) -> None:
        """Restart the timeout at a time (ns)."""
        self._fed_at = now
        if not self._running and self._timeout:
            self._wait(self._timeout)

    def stop(self) -> None:
        """Disable it until `start` or `change_timeout`."""
        self._timeout = 0
        self._running = False
        self._timer.cancel()

    def _wait(self, duration: int) -> None:
        self._running = True
        restart_timer(self._timer, duration)

    def _wait_for_rest(self) -> None:
        elapsed = max(0, self._clock.now().nanoseconds - self._fed_at)
        self._wait(max(1, self._timeout - elapsed))

    def _on_jump_back(self, jump: TimeJump) -> None:
        # The elapsed time stays the same: a clock that keeps going back must not prevent the timeout.
        # The timer of rcl may still wait for a time before the jump.
        self._fed_at += jump.delta.nanoseconds
        if self._running:
            self._wait_for_rest()

    def _on_timer(self) -> None:
        elapsed = self._clock.now().nanoseconds - self._fed_at
        if 0 <= elapsed < self._timeout:
            self._wait(self._timeout - elapsed)
            return
        # If time went back (elapsed < 0), the timeout has expired as well.
        self._running = False
        self._timer.cancel()
        self._callback()
