"""Nodes in other processes: simulated time waits until they have sent what the test declares.

What they publish on declared topics is counted by subscriptions of the world itself, and reaches the
nodes of the world when everything that is due has been received. So it is processed in an order that
does not depend on who was faster.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, suppress
from pathlib import Path

from rclpy.node import Node
from rclpy.publisher import Publisher

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._link import Link
from diffdrive_jacobian.lockstep._scheduler import Scheduler
from diffdrive_jacobian.lockstep.external.connection import Connection
from diffdrive_jacobian.lockstep.external.expectations import WITHIN, Due, Expectation
from diffdrive_jacobian.lockstep.external.process import ExternalProcess, free_domain
from diffdrive_jacobian.lockstep.external.topic import ExternalTopic
from diffdrive_jacobian.lockstep.external.waiting import ROUNDS
from diffdrive_jacobian.numerics.fields import integer
from diffdrive_jacobian.ros.fastdds_profiles import open_to_others
from diffdrive_jacobian.ros.rclpy_internals import wait_for_message
from diffdrive_jacobian.ros.runner import DISCOVERY, MAX_DOMAIN_ID
from diffdrive_jacobian.time_units import NANOSECONDS

ARRIVAL = 2.0
"""Longest time between the arrival of a message at two subscriptions of this process (s)."""
JUMP_CONFIRMATION = 5.0
"""Longest time for the responses of nodes after a jump back (s)."""


def variables(external: object, domain_id: int | None) -> dict[str, str]:
    """Return the environment variables for the processes of a world; empty: it is isolated.

    Raises:
        ValueError: `domain_id` is invalid, or the world is not open.
    """
    if external is None:
        if domain_id is not None:
            raise ValueError(
                f'domain_id is for a world with external=, got {domain_id!r} for an isolated one'
            )
        return {}
    if domain_id is None:
        domain_id = free_domain()
    domain_id = integer('domain_id', domain_id, 0, MAX_DOMAIN_ID)
    # Read with the first participant of this process.
    open_to_others()
    return {DISCOVERY[0]: 'LOCALHOST', 'ROS_DOMAIN_ID': str(domain_id)}


class Isolated:
    """A world without other processes, for which nothing waits."""

    def connected(self) -> bool:
        """Return whether all declared nodes have been discovered, and have discovered the world."""
        return True

    def connect(self, timeout: float) -> None:
        """Wait until that is so, at most for a wall time (s)."""

    def begin(self) -> None:
        """Let nodes that are new receive the time."""

    def announce(self) -> bool:
        """Publish the time before it is set. Return whether it was published."""
        return False

    def await_answers(self) -> bool:
        """Wait for all that is due. Return whether there may be something to process."""
        return False

    def release(self) -> None:
        """Deliver what was received to the nodes of the world."""

    def until_next(self) -> int | None:
        """Return the time until the next timer of an external node expires (ns); None: unknown."""
        return None

    def topics(self) -> list[str]:
        """Return the topics of external nodes on which messages are counted."""
        return []

    def subscribed_nodes(self, topic: str) -> set[str]:
        """Return the names of the external nodes that are subscribed to a topic."""
        return set()

    def await_subscription(self, publisher: Publisher) -> None:
        """Wait until a publisher has a subscription. If none comes, return after a while."""

    def await_service(self, name: str) -> None:
        """Wait until a service is discovered. If none is, return after a while."""

    def until(self, condition: Callable[[], object], timeout: float, failure: Callable[[], str]) -> None:
        """Wait for a condition that other processes make true, at most for a wall time (s)."""

    def describe(self) -> list[str]:
        """Return the states of the processes."""
        return []

    @property
    def environment(self) -> dict[str, str]:
        """Environment variables for a process that is to be discovered."""
        raise LockstepError('this Lockstep is isolated: give it external=[...]')

    def start(
        self,
        command: tuple[str | os.PathLike[str], ...],
        answers: Iterable[Expectation],
        use_sim_time: bool,
        cwd: str | os.PathLike[str] | None,
        env: Mapping[str, str] | None,
    ) -> ExternalProcess:
        """Start a process, as `Lockstep.start`."""
        raise LockstepError('this Lockstep is isolated: give it external=[...]')


class External(Isolated):
    """What is awaited from other processes."""

    def __init__(
        self,
        node: Node,
        scheduler: Scheduler,
        watched: Callable[[], AbstractContextManager[None]],
        report: Callable[[], str],
        environment: dict[str, str],
    ) -> None:
        """Start without expectations.

        Args:
            node: Node of the world.
            scheduler: Executes its nodes.
            watched: Returns a context in which callbacks may be executed.
            report: Returns the last messages of all topics as text.
            environment: Environment variables of the processes.
        """
        self._node = node
        self._scheduler = scheduler
        self._clocks = scheduler.clocks
        self._environment = environment
        self._directory = tempfile.TemporaryDirectory(prefix='lockstep')
        self._connection = Connection(node, scheduler, watched, report)
        self._expectations = self._connection.expectations
        self._waiting = self._connection.waiting
        self._before = 0
        self._sent: tuple[int, ...] = ()

    # --- Processes

    @property
    def environment(self) -> dict[str, str]:
        """Environment variables for a process that is to be discovered."""
        return dict(self._environment)

    def start(
        self,
        command: tuple[str | os.PathLike[str], ...],
        answers: Iterable[Expectation],
        use_sim_time: bool,
        cwd: str | os.PathLike[str] | None,
        env: Mapping[str, str] | None,
    ) -> ExternalProcess:
        """Start a process, as `Lockstep.start`."""
        if not command:
            raise LockstepError('start takes a program and its arguments, got none')
        arguments = [os.fspath(part) for part in command]
        if use_sim_time:
            arguments += ['--ros-args', '-p', 'use_sim_time:=true']
        process = ExternalProcess(
            arguments,
            {**self._environment, **(env or {})},
            Path(self._directory.name),
            None if cwd is None else os.fspath(cwd),
        )
        self._waiting.processes.append(process)
        self._connection.declare(answers, process)
        return process

    def describe(self) -> list[str]:
        """Return the states of the processes."""
        return self._waiting.describe()

    def close(self) -> None:
        """End the processes."""
        self._connection.close()
        self._directory.cleanup()

    # --- Discovery

    def declare(self, expected: Iterable[Expectation]) -> None:
        """Await messages.

        Raises:
            ValueError: One of them is no `Answers`, `Every` or `Idle`.
        """
        self._connection.declare(expected)

    def connected(self) -> bool:
        """Return whether all declared nodes have been discovered, and have discovered the world."""
        return self._connection.connected()

    def connect(self, timeout: float) -> None:
        """Wait until that is so, at most for a wall time (s)."""
        self._connection.connect(timeout)

    def begin(self) -> None:
        """Let nodes that are new receive the time."""
        self._connection.begin()

    def topics(self) -> list[str]:
        """Return the topics of external nodes on which messages are counted."""
        return list(self._connection.topics)

    def subscribed_nodes(self, topic: str) -> set[str]:
        """Return the names of the external nodes that are subscribed to a topic."""
        return self._connection.graph.subscribed_nodes(topic)

    # --- Waiting

    def until(self, condition: Callable[[], object], timeout: float, failure: Callable[[], str]) -> None:
        """Wait for a condition that other processes make true, at most for a wall time (s)."""
        self._waiting.until(condition, timeout, failure)

    def await_subscription(self, publisher: Publisher) -> None:
        """Wait until a publisher has a subscription. If none comes, return after a while."""
        with suppress(LockstepError):
            self.until(publisher.get_subscription_count, WITHIN, str)

    def await_service(self, name: str) -> None:
        """Wait until a service is discovered. If none is, return after a while."""

        def discovered() -> bool:
            return any(name == other for other, _ in self._node.get_service_names_and_types())

        with suppress(LockstepError):
            self.until(discovered, WITHIN, str)

    def await_answers(self) -> bool:
        """Wait for all that is due.

        Returns:
            Whether there may be something to process.

        Raises:
            LockstepError: It does not come in time, there is more than that, or a process has ended.
        """
        if not self._connection.began:
            return False
        self._connection.forget_ended()
        self._waiting.check_processes()
        now, before = self._clocks.now, self._before
        self._before = now
        if now < before:
            # Nodes that receive two times at once would not notice the jump.
            self._connection.confirm(JUMP_CONFIRMATION)
        if late := self._outstanding():
            self._waiting.until(
                lambda: not self._outstanding(), max(one.within for one in late), self._no_answer
            )
        asked = self._ask_idle()
        return asked or any(
            topic.count() > topic.delivered for topic in self._connection.topics.values()
        )

    def announce(self) -> bool:
        """Publish the time, and wait for what the timers of other processes send.

        They expire before those of the world. Otherwise it would depend on the machine whether the
        messages of one time reach a node before its timer expires.

        Returns:
            Whether the time was published, so that it has advanced.
        """
        if not self._connection.began or self._clocks.pauses:
            return False
        self._clocks.announce()
        self.await_answers()
        return True

    def release(self) -> None:
        """Deliver what was received to the nodes of the world, in the order of the declarations."""
        links = self._scheduler.links
        for topic in self._connection.topics.values():
            messages = topic.deliver()
            links.note_external(topic, messages)
            for link in links.to(topic.topic_name):
                if link.endpoint not in self._connection.endpoints:
                    # It was created at this time.
                    continue
                # A shorter queue has lost the first ones.
                for _ in range(min(len(messages), link.depth)):
                    self._deliver(link)

    def until_next(self) -> int | None:
        """Return the time until the next timer of an external node expires (ns); None: unknown."""
        now = self._clocks.now
        expiries = [
            expiry - now for one in self._expectations.due() if (expiry := one.next_time()) is not None
        ]
        return max(min(expiries), 1) if expiries and not self._clocks.pauses else None

    def _deliver(self, link: Link) -> None:
        # Fast DDS passes a message to one subscription of a process after the other.
        if not wait_for_message(self._node.context, link.endpoint, ARRIVAL):
            raise LockstepError(
                f'a message on {link.topic} has not reached all its subscriptions: it was lost, as '
                'best effort allows'
            )
        link.accept()

    def _outstanding(self) -> list[Due]:
        """Return what is due and has not been received.

        Raises:
            LockstepError: More was received than is due.
        """
        now, found = self._clocks.now, []
        # Before it is updated what is due: what arrives meanwhile may itself have to be answered.
        received = [topic.count() for topic in self._connection.topics.values()]
        for one in self._expectations.due():
            one.update(now, self._connection.published)
        for topic, count in zip(self._connection.topics.values(), received, strict=True):
            those = self._expectations.due(topic.topic_name)
            if not those:
                # Of an idle node.
                continue
            left = sum(one.due for one in those) - count
            if left < 0:
                raise LockstepError(self._surplus(topic, -left))
            if left:
                found += those
        return found

    def _ask_idle(self) -> bool:
        """Ask the nodes that are to be idle whether they are, if anything was sent to them.

        Returns:
            Whether they were asked.
        """
        probes = self._expectations.probes()
        if not probes:
            return False
        if self._count_sent() == self._sent:
            return False
        if len(probes) > 1:
            # What one of them publishes may be for another one.
            self._sent = self._count_sent()
        for probe in probes:
            self._waiting.ask(probe, ROUNDS)
        if len(probes) == 1:
            self._sent = self._count_sent()
        return True

    def _count_sent(self) -> tuple[int, ...]:
        """Return numbers that change with every message to an external node."""
        return (
            self._clocks.publications,
            self._scheduler.links.sent_to_others(),
            *(topic.count() for topic in self._connection.topics.values()),
        )

    # --- Failures

    def _no_answer(self) -> str:
        now = self._clocks.now
        lines = []
        for one in self._outstanding():
            received = self._connection.topics[one.topic].count()
            lines.append(
                f'no message on {one.topic} within {one.within:g} s of wall time: {one.describe(now)}; '
                f'{received} received'
            )
        return '\n  '.join(lines)

    def _surplus(self, topic: ExternalTopic, surplus: int) -> str:
        now = self._clocks.now / NANOSECONDS
        return (
            f'{surplus} more on {topic.topic_name} at {now:g} s than declared, '
            f"{topic.count()} received: see `count` and `when`, or declare Idle('NODE') instead"
        )
