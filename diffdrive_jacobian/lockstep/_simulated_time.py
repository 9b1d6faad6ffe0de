"""Simulated time that passes from one due timer to the next."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rclpy.executors import ExternalShutdownException
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._executor import QuiescentExecutor
from diffdrive_jacobian.lockstep._guard import Guard, Stuck
from diffdrive_jacobian.lockstep._report import Traffic
from diffdrive_jacobian.time_units import NANOSECONDS

MAX_SECONDS = 2**31 - 1
"""What a stamp can hold."""


class SimulatedTime:
    """The time of a world. `Lockstep` documents and builds it."""

    _executor: QuiescentExecutor
    _guard: Guard
    _clock_publisher: Publisher

    def __init__(self, start: int) -> None:
        """Begin at an instant (ns)."""
        self._now = self._start = start
        self._clock = Clock()
        self._until_next: int | None = None
        self._busy = False
        self._traffic = Traffic(lambda: self._now)

    def _check_open(self) -> None:
        """Refuse to go on in a world that was closed."""
        raise NotImplementedError

    @property
    def now(self) -> int:
        """Simulated time (ns)."""
        return self._now

    @property
    def elapsed(self) -> float:
        """How much of it has passed (s)."""
        return (self._now - self._start) / NANOSECONDS

    def settle(self) -> None:
        """Let every node handle what there is to handle, without time passing."""
        self._check_open()
        with self._watched():
            self._until_next = self._executor.settle()

    def step(self, at_most: float | None = None) -> None:
        """Advance to the instant at which the next timer is due.

        Args:
            at_most: Advance no further than this (s).

        Raises:
            ValueError: `at_most` is not positive, or too long.
            LockstepError: No timer is running and `at_most` is not given; or time cannot pass.
        """
        end = math.inf if at_most is None else self._now + nanoseconds('at_most', at_most)
        self.settle()
        if self._until_next is None and at_most is None:
            raise LockstepError('no timer is running that a step could lead to: give at_most')
        self._advance(end)

    def run_for(self, seconds: float) -> None:
        """Advance by so much simulated time, from one due timer to the next.

        Raises:
            ValueError: `seconds` is not positive, or too long.
            LockstepError: Time cannot pass.
        """
        end = self._now + nanoseconds('seconds', seconds)
        self.settle()
        while self._now < end:
            self._advance(end)

    def run_until(self, condition: Callable[[], object], timeout: float, what: str = '') -> None:
        """Advance until a condition holds. It is looked at once at each instant, when all is handled.

        Args:
            condition: What must become true.
            timeout: In how much simulated time (s).
            what: What the condition means, for the message of the error.

        Raises:
            ValueError: `timeout` is not positive, or too long.
            LockstepError: It did not come true in time; or time cannot pass.
        """
        end = self._now + nanoseconds('timeout', timeout)
        self.settle()
        while not condition():
            if self._now >= end:
                what = what or _place(condition)
                raise LockstepError(
                    f'not within {timeout:g} s of simulated time: {what}\n{self.report()}'
                )
            # The condition may have changed something, too.
            self.settle()
            self._advance(end)

    def jump(self, seconds: float) -> None:
        """Let time jump, also back: as when a simulator is reset, a bag looped, or a clock set.

        The timers in between do not tick one by one; what they do about it is up to rcl.

        Raises:
            ValueError: `seconds` is zero or not finite, or time would begin before it exists.
        """
        if not math.isfinite(seconds) or seconds == 0.0:
            raise ValueError(f'seconds must be finite and not zero, got {seconds!r}')
        now = self._now + round(seconds * NANOSECONDS)
        if now <= 0:
            raise ValueError(
                f'seconds must not lead to time 0 or before it, got {seconds!r} '
                f'at {self._now / NANOSECONDS:g} s'
            )
        self.settle()
        self._now = now
        self._tell_time()

    def _advance(self, end: float) -> None:
        """Go on to the next due timer, but not past an end (ns)."""
        until_next = math.inf if self._until_next is None else self._until_next
        # Of integers, which are exact, the lesser.
        self._now = int(min(self._now + until_next, end))
        self._tell_time()

    def _tell_time(self) -> None:
        stamp = self._clock.clock
        stamp.sec, stamp.nanosec = divmod(self._now, NANOSECONDS)
        self._clock_publisher.publish(self._clock)
        with self._watched():
            self._until_next = self._executor.settle()

    @contextmanager
    def _watched(self) -> Iterator[None]:
        if self._busy:
            raise LockstepError(
                'time cannot pass and nodes cannot come or go within a callback of theirs'
            )
        self._busy = True
        self._guard.arm()
        try:
            yield
        except ExternalShutdownException:
            raise LockstepError('rclpy was shut down: leave that to the world') from None
        except Stuck as stuck:
            raise LockstepError(f'at {self._now / NANOSECONDS:g} s: {stuck}\n{self.report()}') from stuck
        finally:
            self._guard.disarm()
            self._busy = False

    def report(self) -> str:
        """Tell the last message of every topic."""
        return self._traffic.describe(self._executor.nodes)


def nanoseconds(name: str, seconds: float) -> int:
    """Convert a positive time (s).

    Raises:
        ValueError: It is not positive, or longer than a stamp can tell; `name` is what it is called.
    """
    if not (seconds <= MAX_SECONDS and round(seconds * NANOSECONDS) > 0):
        raise ValueError(
            f'{name} must be a positive number of seconds, at most {MAX_SECONDS}, got {seconds!r}'
        )
    return round(seconds * NANOSECONDS)


def _place(condition: Callable[[], object]) -> str:
    code = getattr(inspect.unwrap(condition), '__code__', None)
    where = f' ({code.co_filename}:{code.co_firstlineno})' if code else ''
    return f'condition {getattr(condition, "__qualname__", condition)}{where}'
