"""Waiting in wall time, while simulated time stands still and the processes are observed."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._external_probe import Probe
from diffdrive_jacobian.lockstep._external_process import ExternalProcess
from diffdrive_jacobian.lockstep._scheduler import Scheduler

CLOCK_PERIOD = 0.1
"""Period at which the time is published again, because a message may be lost (s)."""
NAP = 0.0001
"""Period at which a condition is checked (s)."""
SLOW_NAP = 0.002
"""The same after `CLOCK_PERIOD` (s)."""


class Waiting:
    """Waits for other processes."""

    def __init__(
        self,
        scheduler: Scheduler,
        watched: Callable[[], AbstractContextManager[None]],
        report: Callable[[], str],
        awaited: Callable[[ExternalProcess], bool],
    ) -> None:
        """Start without processes.

        Args:
            scheduler: Executes the nodes of the world.
            watched: Returns a context in which callbacks may be executed.
            report: Returns the last messages of all topics, and the states of the processes, as text.
            awaited: Returns whether anything is awaited from a process.
        """
        self._scheduler = scheduler
        self._watched = watched
        self._report = report
        self._awaited = awaited
        self.processes: list[ExternalProcess] = []
        """The processes that were started."""

    def until(self, condition: Callable[[], object], timeout: float, failure: Callable[[], str]) -> None:
        """Wait for a condition.

        Args:
            condition: The condition.
            timeout: Longest wall time (s).
            failure: Returns the message of the error.

        Raises:
            LockstepError: It is not true in time, or a process has ended.
        """
        begin = repeated = time.monotonic()
        while not condition():
            now = time.monotonic()
            if now - begin > timeout:
                raise LockstepError(f'{failure()}\n{self._report()}')
            if now - repeated > CLOCK_PERIOD:
                repeated = now
                self.check_processes()
                self._scheduler.clocks.publish()
            self.serve()
            time.sleep(NAP if now - begin < CLOCK_PERIOD else SLOW_NAP)

    def ask(self, probe: Probe, rounds: int) -> None:
        """Send requests to a node, each after the response to the one before.

        Raises:
            LockstepError: It does not respond in time, or a process has ended.
        """
        for _ in range(rounds):
            self.until(probe.ask().done, probe.within, probe.no_response)

    def serve(self) -> None:
        """Process requests and responses. Messages wait until everything has been received."""
        with self._watched():
            self._scheduler.serve()

    def check_processes(self) -> None:
        """Check that no process has failed.

        Raises:
            LockstepError: One has, or it has ended while something is awaited from it.
        """
        for process in self.processes:
            if process.ended_by_test or (code := process.returncode) is None:
                continue
            if code or self._awaited(process):
                raise LockstepError(f'{process.describe()}\n{self._report()}')

    def describe(self) -> list[str]:
        """Return the states of the processes."""
        return [process.describe() for process in self.processes]
