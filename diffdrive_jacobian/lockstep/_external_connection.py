"""Discovery of the external nodes, and when they begin to take part."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, suppress

from rclpy.node import Node

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._executor import QuiescentExecutor
from diffdrive_jacobian.lockstep._external_answers import Expectation, Idle
from diffdrive_jacobian.lockstep._external_discovery import UNTIMED, Discovery
from diffdrive_jacobian.lockstep._external_expectations import Due, Expectations
from diffdrive_jacobian.lockstep._external_graph import ExternalGraph
from diffdrive_jacobian.lockstep._external_probe import ROUNDS, Probe, Repeated
from diffdrive_jacobian.lockstep._external_process import ExternalProcess, end_all
from diffdrive_jacobian.lockstep._external_topic import ExternalTopic
from diffdrive_jacobian.lockstep._external_waiting import Waiting
from diffdrive_jacobian.lockstep._report import Traffic

DISCOVERY_PERIOD = 0.01
"""Period at which the graph is queried during discovery (s)."""
MIN_CONFIRMATION = 1.0
"""Shortest time for the responses of nodes that have been discovered (s)."""
SETTLING = 0.1
"""Time for the discovery of the publishers of idle nodes (s)."""
REPETITION = 0.2
"""Period at which a request is repeated during discovery (s): a response may be lost then."""
UNCONFIRMED = 0.5
"""Time for which nodes without parameter services are given to discover those of the world (s)."""


class Connection:
    """Declarations, and discovery of the nodes that are to meet them. Base class of `External`."""

    def __init__(
        self,
        node: Node,
        executor: QuiescentExecutor,
        traffic: Traffic,
        watched: Callable[[], AbstractContextManager[None]],
        report: Callable[[], str],
        now: Callable[[], int],
    ) -> None:
        """Start without expectations.

        Args:
            node: Node of the world.
            executor: Executes its nodes.
            traffic: Counts their messages.
            watched: Returns a context in which callbacks may be executed.
            report: Returns the last messages of all topics as text.
            now: Returns the simulated time (ns).
        """
        self._node = node
        self._executor = executor
        self._traffic = traffic
        self._now = now
        self.graph = ExternalGraph(node)
        self.waiting = Waiting(node, executor, watched, report, self._awaits)
        """Waits for other processes."""
        self.began = False
        """Whether the external nodes have received the time."""
        self._complete = False
        self._expectations = Expectations(node)
        self._topics: dict[str, ExternalTopic] = {}
        self._endpoints: frozenset[object] = frozenset()
        self._before = 0
        self._sent: tuple[int, ...] = ()
        executor.isolated = False
        executor.clocks.enabled = False

    # --- Declarations

    def declare(self, expected: Iterable[Expectation], process: ExternalProcess | None = None) -> None:
        """Await messages, until the test ends a process (None: always).

        Raises:
            ValueError: One of them is no `Answers`, `Every` or `Idle`.
        """
        self._expectations.add(expected, process)
        self._complete = False

    def _forget_ended(self) -> None:
        """Await nothing more from processes that the test has ended."""
        for name in self._expectations.forget_ended() & self._topics.keys():
            if left := self._expectations.due(name):
                self._restart(self._topics[name], left)
                continue
            # Nothing is due, so what still comes is delivered as it comes.
            topic = self._topics.pop(name)
            self._executor.deliveries.held.discard(name)
            self._executor.unserved.discard(topic.subscription)
            topic.close()

    def _restart(self, topic: ExternalTopic, expected: Iterable[Due]) -> None:
        topic.restart()
        for one in expected:
            one.restart(self._published)

    # --- Discovery

    def connected(self) -> bool:
        """Return whether all declared nodes have been discovered, and have discovered the world."""
        return self._complete and self._discovery().endpoints() == self._endpoints

    def connect(self, timeout: float) -> None:
        """Wait until the declared nodes are discovered, and have discovered the nodes of the world.

        They do not receive the time before `begin`.

        Args:
            timeout: Longest wall time (s).

        Raises:
            LockstepError: They are not in time, a process has ended, or the nodes do not fit.
        """
        self._executor.clocks.enabled = False
        self._forget_ended()
        begin = time.monotonic()
        only_untimed: float | None = None
        while True:
            self.waiting.check_processes()
            self._count_published_topics()
            known = len(self._topics)
            missing, untimed = self._discovery().missing(*self._awaited(), self._topics)
            if not (missing or untimed):
                # A node that responds has created its publishers, but they may be discovered later.
                self.confirm(max(timeout - (time.monotonic() - begin), MIN_CONFIRMATION))
                if self._expectations.probes():
                    time.sleep(SETTLING)
                    self._count_published_topics()
                if len(self._topics) == known:
                    break
                continue
            waited = time.monotonic() - begin
            only_untimed = None if missing else only_untimed or waited
            if waited > timeout or (only_untimed and waited - only_untimed > UNTIMED):
                raise LockstepError(self._not_discovered(waited, [*missing, *untimed]))
            self.waiting.serve()
            time.sleep(DISCOVERY_PERIOD)
        self._endpoints = self._discovery().endpoints()
        self._complete = True

    def begin(self) -> None:
        """Start to count what is due from nodes that are new, and let them receive the time.

        Callbacks are called with what external nodes have published before.
        """
        for name, topic in self._topics.items():
            for reader in self._executor.deliveries.readers_of(name):
                while reader.waits(self._node.context, 0.0):
                    reader.accept()
            expected = self._expectations.due(name)
            if name not in self._executor.deliveries.held or not all(one.started for one in expected):
                self._restart(topic, expected)
        self.began = True
        self._executor.deliveries.held.update(self._topics)
        self._executor.clocks.enabled = True
        self._executor.clocks.publish()

    def topics(self) -> list[str]:
        """Return the topics of external nodes on which messages are counted."""
        return list(self._topics)

    def _awaits(self, process: ExternalProcess) -> bool:
        return self._expectations.include(process)

    def _awaited(self) -> tuple[list[Due], list[Probe]]:
        return self._expectations.due(), self._expectations.probes()

    def _discovery(self) -> Discovery:
        return Discovery(self.graph, self._executor.nodes)

    def _count_published_topics(self) -> None:
        """Subscribe to the declared topics that have an external publisher, and those of idle nodes."""
        for one in self._expectations.due():
            self._subscribe(one.topic)
        for probe in self._expectations.probes():
            for name in self.graph.topics_of(probe.name):
                with suppress(LockstepError):
                    # A type that is not installed here has no subscription in the world, either.
                    self._subscribe(name)

    def _subscribe(self, name: str) -> None:
        infos = self.graph.publishers(name)
        if infos and name not in self._topics:
            topic = ExternalTopic(self._node, name, infos, self._traffic)
            self._executor.unserved.add(topic.subscription)
            self._topics[name] = topic
            # In the order of the declarations, not of their discovery; then those of idle nodes.
            declared = [one.topic for one in self._expectations.due()]
            names = sorted(self._topics, key=lambda one: (one not in declared, one))
            ordered = dict.fromkeys([one for one in declared if one in self._topics] + names)
            self._topics = {one: self._topics[one] for one in ordered}

    def _not_discovered(self, waited: float, missing: Sequence[str]) -> str:
        topics = ', '.join(self.graph.published_topics()) or 'none'
        lines = [
            f'not within {waited:.3g} s of wall time: {"; ".join(missing)}',
            f'topics that external nodes publish: {topics}',
            *self.waiting.describe(),
        ]
        return '\n  '.join(lines)

    def confirm(self, timeout: float) -> None:
        """Wait until the external nodes have discovered the world, and received the time.

        They discover endpoints in the order of their creation. So one that responds to a new client
        knows all that were created before.

        Args:
            timeout: Longest wall time for each node (s).

        Raises:
            LockstepError: A node does not respond in time, or a process has ended.
        """
        services = {name for name, _ in self._node.get_service_names_and_types()}
        nodes = self._discovery().awaited_nodes(*self._awaited())
        probes = [Probe(self._node, Idle(name, within=timeout)) for name in sorted(nodes)]
        try:
            known = [probe for probe in probes if probe.service in services]
            for probe in known:
                self.waiting.until(probe.ready, timeout, probe.unready)
                self.waiting.until(Repeated(probe, REPETITION).answered, timeout, probe.no_response)
                self.waiting.ask(probe, ROUNDS - 1)
            if len(known) < len(probes):
                # Without parameter services.
                time.sleep(UNCONFIRMED)
        finally:
            for probe in probes:
                probe.close()

    def _published(self, name: str) -> int:
        """Return the number of messages on a topic. Those of external nodes count if it is declared."""
        topic = self._topics.get(name)
        return self._traffic.count(name) + (topic.count() if topic is not None else 0)

    def close(self) -> None:
        """End the processes."""
        end_all(self.waiting.processes)
        for topic in self._topics.values():
            topic.close()
