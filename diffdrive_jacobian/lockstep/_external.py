"""Nodes in other processes: simulated time waits until they have sent what the test declares.

What they publish on declared topics is counted by subscriptions of the world itself, and reaches the
nodes of the world when everything that is due has been received. So it is processed in an order that
does not depend on who was faster.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager

from rclpy.node import Node

from diffdrive_jacobian.lockstep._deliveries import Reader
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
from diffdrive_jacobian.time_units import NANOSECONDS

DISCOVERY_PERIOD = 0.01
"""Period at which the graph is queried during discovery (s)."""
ARRIVAL = 2.0
"""Longest time between the arrival of a message at two subscriptions of this process (s)."""
JUMP_CONFIRMATION = 5.0
"""Longest time for the responses of nodes after a jump back (s)."""
MIN_CONFIRMATION = 1.0
"""Shortest time for the responses of nodes that have been discovered (s)."""
REPETITION = 0.2
"""Period at which a request is repeated during discovery (s): a response may be lost then."""
UNCONFIRMED = 0.5
"""Time for which nodes without parameter services are given to discover those of the world (s)."""


class External:
    """What is awaited from other processes."""

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
            missing, untimed = self._discovery().missing(*self._awaited())
            if not (missing or untimed):
                break
            waited = time.monotonic() - begin
            only_untimed = None if missing else only_untimed or waited
            if waited > timeout or (only_untimed and waited - only_untimed > UNTIMED):
                raise LockstepError(self._not_discovered(waited, [*missing, *untimed]))
            self.waiting.serve()
            time.sleep(DISCOVERY_PERIOD)
        self.confirm(max(timeout - (time.monotonic() - begin), MIN_CONFIRMATION))
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
            if not all(one.started for one in expected):
                self._restart(topic, expected)
        self.began = True
        self._executor.deliveries.held.update(self._topics)
        self._executor.clocks.enabled = True
        self._executor.clocks.publish()

    def topics(self) -> list[str]:
        """Return the declared topics that have an external publisher."""
        return list(self._topics)

    def _awaits(self, process: ExternalProcess) -> bool:
        return self._expectations.include(process)

    def _awaited(self) -> tuple[list[Due], list[Probe]]:
        return self._expectations.due(), self._expectations.probes()

    def _discovery(self) -> Discovery:
        return Discovery(self.graph, self._executor.nodes)

    def _count_published_topics(self) -> None:
        """Subscribe to the declared topics that have an external publisher."""
        for one in self._expectations.due():
            infos = self.graph.publishers(one.topic)
            if infos and one.topic not in self._topics:
                topic = ExternalTopic(self._node, one.topic, infos, self._traffic)
                self._executor.unserved.add(topic.subscription)
                self._topics[one.topic] = topic

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

    # --- Answers

    def await_answers(self) -> bool:
        """Wait for all that is due.

        Returns:
            Whether there may be something to process.

        Raises:
            LockstepError: It does not come in time, there is more than that, or a process has ended.
        """
        if not self.began:
            return False
        self._forget_ended()
        self.waiting.check_processes()
        now, before = self._now(), self._before
        self._before = now
        if now < before:
            # Nodes that receive two times at once would not notice the jump.
            self.confirm(JUMP_CONFIRMATION)
        if late := self._outstanding():
            self.waiting.until(
                lambda: not self._outstanding(), max(one.within for one in late), self._no_answer
            )
        asked = self._ask_idle()
        return asked or any(topic.count() > topic.delivered for topic in self._topics.values())

    def announce(self) -> None:
        """Publish the time, and wait for what the timers of other processes send.

        They expire before those of the world. Otherwise it would depend on the machine whether the
        messages of one time reach a node before its timer expires.
        """
        if self.began and not self._executor.clock_pauses:
            self._executor.clocks.announce(self._now())
            self.await_answers()

    def release(self) -> None:
        """Deliver what was received to the nodes of the world, in the order of the declarations."""
        for topic in self._topics.values():
            messages = topic.deliver()
            self._traffic.note_external(topic, messages)
            for reader in self._executor.deliveries.readers_of(topic.topic_name):
                if reader.subscription not in self._endpoints:
                    # It was created at this time.
                    continue
                # A shorter queue has lost the first ones.
                for _ in range(min(len(messages), reader.depth)):
                    self._deliver(reader)

    def until_next(self) -> int | None:
        """Return the time until the next timer of an external node expires (ns); None: unknown."""
        now = self._now()
        expiries = [
            expiry - now for one in self._expectations.due() if (expiry := one.next_time()) is not None
        ]
        return max(min(expiries), 1) if expiries and not self._executor.clock_pauses else None

    def _deliver(self, reader: Reader) -> None:
        # Fast DDS passes a message to one subscription of a process after the other.
        if not reader.waits(self._node.context, ARRIVAL):
            raise LockstepError(
                f'a message on {reader.topic} has not reached all its subscriptions: it was lost, as '
                'best effort allows'
            )
        reader.accept()

    def _outstanding(self) -> list[Due]:
        """Return what is due and has not been received.

        Raises:
            LockstepError: More was received than is due.
        """
        now, found = self._now(), []
        for one in self._expectations.due():
            one.update(now, self._published)
        for topic in self._topics.values():
            those = self._expectations.due(topic.topic_name)
            left = sum(one.due for one in those) - topic.count()
            if left < 0:
                raise LockstepError(self._surplus(topic, -left))
            if left:
                found += those
        return found

    def _published(self, name: str) -> int:
        """Return the number of messages on a topic. Those of external nodes count if it is declared."""
        topic = self._topics.get(name)
        return self._traffic.count(name) + (topic.count() if topic is not None else 0)

    def _ask_idle(self) -> bool:
        """Ask the nodes that are to be idle whether they are, if anything was sent to them.

        Returns:
            Whether they were asked.
        """
        probes = self._expectations.probes()
        if not probes:
            return False
        sent = (
            self._executor.clocks.publications,
            self._traffic.sent_to_others(),
            *(topic.count() for topic in self._topics.values()),
        )
        if sent == self._sent:
            return False
        self._sent = sent
        for probe in probes:
            self.waiting.ask(probe, ROUNDS)
        return True

    # --- Failures

    def _no_answer(self) -> str:
        now = self._now()
        lines = []
        for one in self._outstanding():
            received = self._topics[one.topic].count()
            lines.append(
                f'no message on {one.topic} within {one.within:g} s of wall time: {one.describe(now)}; '
                f'{received} received'
            )
        return '\n  '.join(lines)

    def _surplus(self, topic: ExternalTopic, surplus: int) -> str:
        return (
            f'{surplus} more on {topic.topic_name} at {self._now() / NANOSECONDS:g} s than declared, '
            f"{topic.count()} received: see `count` and `when`, or declare Idle('NODE') instead"
        )

    def close(self) -> None:
        """End the processes."""
        end_all(self.waiting.processes)
        for topic in self._topics.values():
            topic.close()
