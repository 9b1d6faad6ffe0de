"""Waiting in wall time, while simulated time stands still and the processes are observed."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager

from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.task import Future

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._scheduler import Scheduler
from diffdrive_jacobian.lockstep.external.process import ExternalProcess

CLOCK_PERIOD = 0.1
"""Period at which the time is published again, because a message may be lost (s)."""
NAP = 0.0001
"""Period at which a condition is checked (s)."""
SLOW_NAP = 0.002
"""The same after `CLOCK_PERIOD` (s)."""
ROUNDS = 3
"""Number of requests.

When the first response is there, all that was sent before the first request has arrived. When the
second is there, the callbacks of its messages have been executed, and when the third is there, those of
the timers that the time among them has made due.
"""


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


class Probe:
    """Asks a node for none of its parameters."""

    def __init__(self, node: Node, name: str, within: float) -> None:
        """Create a client.

        Args:
            node: Node of the client.
            name: Name of the node that is asked.
            within: Longest wall time for a response (s).
        """
        self.service: str = node.resolve_service_name(f'{name}/get_parameters')
        self.name = self.service.removesuffix('/get_parameters')
        """Full name of the node that is asked."""
        self.within = within
        self._node = node
        self._client = node.create_client(GetParameters, self.service)

    def ready(self) -> bool:
        """Return whether a request can be sent."""
        return bool(self._client.service_is_ready())

    def unready(self) -> str:
        """Return the message of the error that no request can be sent."""
        return f'the service {self.service} cannot be reached'

    def no_response(self) -> str:
        """Return the message of the error that a request is not answered."""
        return f'{self.name} has not responded to {self.service} within {self.within:g} s of wall time'

    def ask(self) -> Future:
        """Send a request. Return the future of its response."""
        return self._client.call_async(GetParameters.Request())

    def close(self) -> None:
        """Destroy the client."""
        self._node.destroy_client(self._client)


class Repeated:
    """A request that is repeated until one is answered."""

    def __init__(self, probe: Probe, period: float) -> None:
        """Send the first one.

        Args:
            probe: Sends the requests.
            period: Period of the repetition (s).
        """
        self._probe = probe
        self._period = period
        self._responses = [probe.ask()]
        self._sent = time.monotonic()

    def answered(self) -> bool:
        """Return whether any request was answered. Repeat it if it is time."""
        now = time.monotonic()
        if now - self._sent > self._period:
            self._sent = now
            self._responses.append(self._probe.ask())
        return any(response.done() for response in self._responses)
