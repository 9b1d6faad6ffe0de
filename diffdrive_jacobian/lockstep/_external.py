"""Nodes in other processes: simulated time waits until they have sent what the test declares.

What they publish on declared topics is counted by subscriptions of the world itself, and reaches the
nodes of the world when everything that is due has been received. So it is processed in an order that
does not depend on who was faster.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, suppress

from rclpy.node import Node
from rclpy.publisher import Publisher

from diffdrive_jacobian.lockstep._deliveries import Reader
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._executor import QuiescentExecutor
from diffdrive_jacobian.lockstep._external_answers import (
    WITHIN,
    Answers,
    AnswersDue,
    Every,
    Expectation,
    Idle,
    TicksDue,
)
from diffdrive_jacobian.lockstep._external_discovery import UNTIMED, Discovery
from diffdrive_jacobian.lockstep._external_graph import ExternalGraph
from diffdrive_jacobian.lockstep._external_probe import ROUNDS, Probe, Repeated
from diffdrive_jacobian.lockstep._external_process import ExternalProcess, end_all
from diffdrive_jacobian.lockstep._external_topic import ExternalTopic
from diffdrive_jacobian.lockstep._report import Traffic
from diffdrive_jacobian.time_units import NANOSECONDS

CLOCK_PERIOD = 0.1
"""Period at which the time is published again while answers are awaited (s). A message may be lost."""
NAP = 0.0001
"""Period at which an answer is looked for (s)."""
SLOW_NAP = 0.002
"""The same after `CLOCK_PERIOD` (s)."""
DISCOVERY_PERIOD = 0.01
"""Period at which the graph is queried during discovery (s)."""
ARRIVAL = 2.0
"""Longest time between the arrival of a message at two subscriptions of this process (s)."""
REPETITION = 0.2
"""Period at which a request is repeated during discovery (s): a response may be lost then."""
UNCONFIRMED = 0.5
"""Time for which nodes without parameter services are given to discover those of the world (s)."""
Due = AnswersDue | TicksDue
"""Messages that are due."""


class External:
    """What is awaited from other processes."""

    def __init__(
        self,
        node: Node,
        executor: QuiescentExecutor,
        traffic: Traffic,
        watched: Callable[[], AbstractContextManager[None]],
        now: Callable[[], int],
    ) -> None:
        """Start without expectations.

        Args:
            node: Node of the world.
            executor: Executes its nodes.
            traffic: Counts their messages.
            watched: Returns a context in which callbacks may be executed.
            now: Returns the simulated time (ns).
        """
        self._node = node
        self._executor = executor
        self._traffic = traffic
        self._watched = watched
        self._now = now
        self.graph = ExternalGraph(node)
        self.processes: list[ExternalProcess] = []
        """The processes that were started."""
        self.began = False
        """Whether the external nodes have received the time."""
        self._complete = False
        self._expected: list[tuple[Due, ExternalProcess | None]] = []
        self._probes: list[tuple[Probe, ExternalProcess | None]] = []
        self._topics: dict[str, ExternalTopic] = {}
        self._endpoints: frozenset[object] = frozenset()
        self._sent: tuple[int, ...] = ()
        executor.isolated = False
        executor.clocks.enabled = False

    # --- Declarations

    def declare(self, expected: Iterable[Expectation], process: ExternalProcess | None = None) -> None:
        """Await messages, until the test ends a process (None: always).

        Raises:
            ValueError: One of them is no `Answers`, `Every` or `Idle`.
        """
        resolve = self._node.resolve_topic_name
        for one in expected:
            if isinstance(one, Answers):
                due: Due = AnswersDue(one, resolve(one.topic), resolve(one.to))
                self._expected.append((due, process))
            elif isinstance(one, Every):
                self._expected.append((TicksDue(one, resolve(one.topic)), process))
            elif isinstance(one, Idle):
                self._probes.append((Probe(self._node, one), process))
            else:
                raise ValueError(f'external must consist of Answers, Every and Idle, got {one!r}')
        self._complete = False

    def _forget_ended(self) -> None:
        """Await nothing more from processes that the test has ended."""
        self._expected = [pair for pair in self._expected if not _has_ended(pair[1])]
        self._probes = [pair for pair in self._probes if not _has_ended(pair[1])]
        awaited = {one.topic for one, _ in self._expected}
        for topic in [topic for topic in self._topics if topic not in awaited]:
            # Nothing is due, so what still comes is delivered as it comes.
            known = self._topics.pop(topic)
            self._executor.unserved.discard(known.subscription)
            known.close()
        self._executor.deliveries.held = set(self._topics) if self.began else set()

    # --- Discovery

    def connected(self) -> bool:
        """Return whether all declared nodes have been discovered, and have discovered the world."""
        return self._complete and self._discovery().endpoints() == self._endpoints

    def connect(self, timeout: float) -> None:
        """Wait until the declared nodes are discovered, and have discovered the nodes of the world.

        Args:
            timeout: Longest wall time (s).

        Raises:
            LockstepError: They are not in time, a process has ended, or the nodes do not fit.
        """
        self._forget_ended()
        begin = time.monotonic()
        complete_but_time: float | None = None
        while True:
            self._check_processes()
            self._count_published_topics()
            missing, untimed = self._discovery().missing(*self._awaited())
            if not (missing or untimed):
                break
            waited = time.monotonic() - begin
            complete_but_time = None if missing else (complete_but_time or waited)
            if waited > timeout or (complete_but_time and waited - complete_but_time > UNTIMED):
                raise LockstepError(self._not_discovered(waited, [*missing, *untimed]))
            self._serve()
            time.sleep(DISCOVERY_PERIOD)
        self._confirm(max(timeout - (time.monotonic() - begin), 1.0))
        self._endpoints = self._discovery().endpoints()
        self._complete = True

    def begin(self) -> None:
        """Start to count, and let external nodes receive the time."""
        self.began = True
        for topic in self._topics.values():
            topic.restart()
        for one, _ in self._expected:
            one.restart(self._published)
        self._executor.deliveries.held = set(self._topics)
        self._executor.clocks.enabled = True
        self._executor.clocks.publish()

    def _awaited(self) -> tuple[list[Due], list[Probe]]:
        return [one for one, _ in self._expected], [probe for probe, _ in self._probes]

    def _discovery(self) -> Discovery:
        return Discovery(self.graph, self._executor.nodes)

    def _count_published_topics(self) -> None:
        """Subscribe to the declared topics that have an external publisher."""
        for one, _ in self._expected:
            infos = self.graph.publishers(one.topic)
            if infos and one.topic not in self._topics:
                topic = ExternalTopic(self._node, one.topic, infos, self._traffic)
                self._executor.unserved.add(topic.subscription)
                self._topics[one.topic] = topic

    def _not_discovered(self, waited: float, missing: Sequence[str]) -> str:
        return '\n  '.join(
            [
                f'external nodes not discovered within {waited:.3g} s of wall time: {"; ".join(missing)}',
                f'topics of external nodes: {", ".join(self.graph.published_topics()) or "none"}',
                *self.describe(),
            ]
        )

    def _confirm(self, timeout: float) -> None:
        """Wait until the external nodes have discovered the world.

        They discover endpoints in the order of their creation. So one that responds to a new client
        knows all that were created before.
        """
        services = {name for name, _ in self._node.get_service_names_and_types()}
        nodes = self._discovery().awaited_nodes(*self._awaited())
        probes = [Probe(self._node, Idle(name, within=timeout)) for name in sorted(nodes)]
        try:
            known = [probe for probe in probes if probe.service in services]
            for probe in known:
                self._wait_for(probe.ready, timeout, probe.unready)
                self._wait_for(Repeated(probe, REPETITION).answered, timeout, probe.no_response)
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
        self._check_processes()
        if late := self._outstanding():
            self._wait_for(
                lambda: not self._outstanding(), max(one.within for one in late), self._no_answer
            )
        asked = self._ask_idle()
        return asked or any(topic.count() > topic.delivered for topic in self._topics.values())

    def release(self) -> None:
        """Deliver what was received to the nodes of the world, in the order of the declarations."""
        for topic in self._topics.values():
            received = topic.count()
            new, topic.delivered = received - topic.delivered, received
            if new:
                self._traffic.note_external(topic.topic_name, topic.msg_type, new, topic.last)
            for reader in self._executor.deliveries.readers_of(topic.topic_name):
                # A shorter queue has lost the first ones.
                for _ in range(min(new, reader.depth)):
                    self._deliver(reader)

    def until_next(self) -> int | None:
        """Return the time until the next timer of an external node expires (ns); None: unknown."""
        now = self._now()
        expiries = [expiry - now for one, _ in self._expected if (expiry := one.next_time()) is not None]
        return max(min(expiries), 1) if expiries and self.began else None

    def jumped(self) -> None:
        """Note that the time has jumped."""
        for one, _ in self._expected:
            one.jumped(self._now())

    def _deliver(self, reader: Reader) -> None:
        # Fast DDS passes a message to one subscription of a process after the other.
        if not reader.waits(self._node.context, ARRIVAL):
            raise LockstepError(
                f'a message on {reader.topic} has not reached all its subscriptions: it was lost, as '
                'best effort allows'
            )
        reader.deliver()

    def _outstanding(self) -> list[Due]:
        """Return what is due and has not been received.

        Raises:
            LockstepError: More was received than is due.
        """
        now, found = self._now(), []
        for one, _ in self._expected:
            one.update(now, self._published)
        for topic in self._topics.values():
            those = [one for one, _ in self._expected if one.topic == topic.topic_name]
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
        if not self._probes:
            return False
        sent = (
            self._executor.clocks.publications,
            self._traffic.sent_to_others(),
            *(topic.count() for topic in self._topics.values()),
        )
        if sent == self._sent:
            return False
        self._sent = sent
        for probe, _ in self._probes:
            self._ask(probe, ROUNDS)
        return True

    def _ask(self, probe: Probe, rounds: int) -> None:
        for _ in range(rounds):
            response = probe.ask()
            self._wait_for(
                response.done,
                probe.within,
                probe.no_response,
            )

    # --- Waiting

    def _wait_for(
        self, condition: Callable[[], object], timeout: float, failure: Callable[[], str]
    ) -> None:
        """Wait for a condition.

        Raises:
            LockstepError: It is not true within `timeout` s of wall time, or a process has ended.
        """
        begin = time.monotonic()
        repeated = begin
        while not condition():
            now = time.monotonic()
            if now - begin > timeout:
                raise LockstepError('\n  '.join([failure(), *self.describe()]))
            if now - repeated > CLOCK_PERIOD:
                repeated = now
                self._check_processes()
                self._executor.clocks.publish()
            self._serve()
            time.sleep(NAP if now - begin < CLOCK_PERIOD else SLOW_NAP)

    def wait_for(
        self, condition: Callable[[], object], timeout: float, failure: Callable[[], str]
    ) -> None:
        """Wait for a condition, as for an answer.

        Args:
            condition: The condition.
            timeout: Longest wall time (s).
            failure: Returns the message of the error.

        Raises:
            LockstepError: It is not true in time, or a process has ended.
        """
        self._wait_for(condition, timeout, failure)

    def wait_for_subscription(self, publisher: Publisher) -> None:
        """Wait until a publisher has a subscription. If none comes, return after a while."""
        with suppress(LockstepError):
            self._wait_for(publisher.get_subscription_count, WITHIN, lambda: '')

    def wait_for_service(self, name: str) -> None:
        """Wait until a service is discovered. If none is, return after a while."""

        def discovered() -> bool:
            return any(name == other for other, _ in self._node.get_service_names_and_types())

        with suppress(LockstepError):
            self._wait_for(discovered, WITHIN, lambda: '')

    def _serve(self) -> None:
        """Process requests and responses. Messages wait until everything has been received."""
        with self._watched():
            self._executor.serve()

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

    def _check_processes(self) -> None:
        """Check that no process has failed.

        Raises:
            LockstepError: One has, or it has ended while answers of it are awaited.
        """
        for process in self.processes:
            if process.ended_by_test or (code := process.returncode) is None:
                continue
            if code or any(owner is process for _, owner in (*self._expected, *self._probes)):
                raise LockstepError(process.describe())

    def describe(self) -> list[str]:
        """Return the states of the processes."""
        return [process.describe() for process in self.processes]

    def close(self) -> None:
        """End the processes."""
        end_all(self.processes)
        for topic in self._topics.values():
            topic.close()


def _has_ended(process: ExternalProcess | None) -> bool:
    return process is not None and process.ended_by_test
