"""Discovery of the external nodes, and when they begin to take part."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, suppress

from rclpy.node import Node

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._scheduler import Scheduler
from diffdrive_jacobian.lockstep.external.expectations import Due, Expectation, Expectations
from diffdrive_jacobian.lockstep.external.graph import UNTIMED, Discovery, ExternalGraph
from diffdrive_jacobian.lockstep.external.process import ExternalProcess, end_all
from diffdrive_jacobian.lockstep.external.topic import ExternalTopic
from diffdrive_jacobian.lockstep.external.waiting import ROUNDS, Probe, Repeated, Waiting
from diffdrive_jacobian.ros.rclpy_internals import wait_for_message

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
    """Declarations, and discovery of the nodes that are to meet them."""

    def __init__(
        self,
        node: Node,
        scheduler: Scheduler,
        watched: Callable[[], AbstractContextManager[None]],
        report: Callable[[], str],
    ) -> None:
        """Start without expectations.

        Args:
            node: Node of the world.
            scheduler: Executes its nodes.
            watched: Returns a context in which callbacks may be executed.
            report: Returns the last messages of all topics as text.
        """
        self._node = node
        self._scheduler = scheduler
        self._links, self._clocks = scheduler.links, scheduler.clocks
        self.graph = ExternalGraph(node)
        self.expectations = Expectations(node)
        """What is awaited at present."""
        self.waiting = Waiting(scheduler, watched, report, self.expectations.include)
        """Waits for other processes."""
        self.began = False
        """Whether the external nodes have received the time."""
        self.topics: dict[str, ExternalTopic] = {}
        """The topics of external nodes on which messages are counted, in the order of their delivery."""
        self.endpoints: frozenset[object] = frozenset()
        """The publishers and subscriptions of the world that external nodes have discovered."""
        self._complete = False
        scheduler.isolated = False
        self._clocks.enabled = False

    # --- Declarations

    def declare(self, expected: Iterable[Expectation], process: ExternalProcess | None = None) -> None:
        """Await messages, until the test ends a process (None: always).

        Raises:
            ValueError: One of them is no `Answers`, `Every` or `Idle`.
        """
        self.expectations.add(expected, process)
        self._complete = False

    def forget_ended(self) -> None:
        """Await nothing more from processes that the test has ended."""
        for name in self.expectations.forget_ended() & self.topics.keys():
            if left := self.expectations.due(name):
                self._restart(self.topics[name], left)
                continue
            # Nothing is due, so what still comes is delivered as it comes.
            topic = self.topics.pop(name)
            self._links.held.discard(name)
            self._scheduler.unserved.discard(topic.subscription)
            topic.close()

    def _restart(self, topic: ExternalTopic, expected: Iterable[Due]) -> None:
        topic.restart()
        for one in expected:
            one.restart(self.published)

    # --- Discovery

    def connected(self) -> bool:
        """Return whether all declared nodes have been discovered, and have discovered the world."""
        return self._complete and self._discovery().endpoints() == self.endpoints

    def connect(self, timeout: float) -> None:
        """Wait until the declared nodes are discovered, and have discovered the nodes of the world.

        They do not receive the time before `begin`.

        Args:
            timeout: Longest wall time (s).

        Raises:
            LockstepError: They are not in time, a process has ended, or the nodes do not fit.
        """
        self._clocks.enabled = False
        self.forget_ended()
        begin = time.monotonic()
        only_untimed: float | None = None
        while True:
            self.waiting.check_processes()
            self._count_published_topics()
            known = len(self.topics)
            missing, untimed = self._discovery().missing(*self._awaited(), self.topics)
            if not (missing or untimed):
                # A node that responds has created its publishers, but they may be discovered later.
                self.confirm(max(timeout - (time.monotonic() - begin), MIN_CONFIRMATION))
                if self.expectations.probes():
                    time.sleep(SETTLING)
                    self._count_published_topics()
                if len(self.topics) == known:
                    break
                continue
            waited = time.monotonic() - begin
            only_untimed = None if missing else only_untimed or waited
            if waited > timeout or (only_untimed and waited - only_untimed > UNTIMED):
                raise LockstepError(self._not_discovered(waited, [*missing, *untimed]))
            self.waiting.serve()
            time.sleep(DISCOVERY_PERIOD)
        self.endpoints = self._discovery().endpoints()
        self._complete = True

    def begin(self) -> None:
        """Start to count what is due from nodes that are new, and let them receive the time.

        Callbacks are called with what external nodes have published before.
        """
        for name, topic in self.topics.items():
            for link in self._links.to(name):
                while wait_for_message(self._node.context, link.endpoint, 0.0):
                    link.accept()
            expected = self.expectations.due(name)
            if name not in self._links.held or not all(one.started for one in expected):
                self._restart(topic, expected)
        self.began = True
        self._links.held.update(self.topics)
        self._clocks.enabled = True
        self._clocks.publish()

    def _awaited(self) -> tuple[list[Due], list[Probe]]:
        return self.expectations.due(), self.expectations.probes()

    def _discovery(self) -> Discovery:
        return Discovery(self.graph, self._scheduler.nodes)

    def _count_published_topics(self) -> None:
        """Subscribe to the declared topics that have an external publisher, and those of idle nodes."""
        for one in self.expectations.due():
            self._subscribe(one.topic)
        for probe in self.expectations.probes():
            for name in self.graph.topics_of(probe.name):
                with suppress(LockstepError):
                    # A type that is not installed here has no subscription in the world, either.
                    self._subscribe(name)

    def _subscribe(self, name: str) -> None:
        infos = self.graph.publishers(name)
        if infos and name not in self.topics:
            topic = ExternalTopic(self._node, name, infos, self._links)
            self._scheduler.unserved.add(topic.subscription)
            self.topics[name] = topic
            # In the order of the declarations, not of their discovery; then those of idle nodes.
            declared = [one.topic for one in self.expectations.due()]
            names = sorted(self.topics, key=lambda one: (one not in declared, one))
            ordered = dict.fromkeys([one for one in declared if one in self.topics] + names)
            self.topics = {one: self.topics[one] for one in ordered}

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
        probes = [Probe(self._node, name, timeout) for name in sorted(nodes)]
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

    def published(self, name: str) -> int:
        """Return the number of messages on a topic. Those of external nodes count if it is declared."""
        topic = self.topics.get(name)
        return self._links.count(name) + (topic.count() if topic is not None else 0)

    def close(self) -> None:
        """End the processes."""
        end_all(self.waiting.processes)
        for topic in self.topics.values():
            topic.close()
