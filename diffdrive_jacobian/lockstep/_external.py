"""Nodes in other processes: simulated time waits until they have sent what the test declares.

What they publish on declared topics is counted by subscriptions of the world itself, and reaches the
nodes of the world when everything that is due has been received. So it is processed in an order that
does not depend on who was faster.
"""

from __future__ import annotations

from diffdrive_jacobian.lockstep._deliveries import Reader
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._external_connection import Connection
from diffdrive_jacobian.lockstep._external_expectations import Due
from diffdrive_jacobian.lockstep._external_probe import ROUNDS
from diffdrive_jacobian.lockstep._external_topic import ExternalTopic
from diffdrive_jacobian.time_units import NANOSECONDS

ARRIVAL = 2.0
"""Longest time between the arrival of a message at two subscriptions of this process (s)."""
JUMP_CONFIRMATION = 5.0
"""Longest time for the responses of nodes after a jump back (s)."""


class External(Connection):
    """What is awaited from other processes."""

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

    def announce(self) -> bool:
        """Publish the time, and wait for what the timers of other processes send.

        They expire before those of the world. Otherwise it would depend on the machine whether the
        messages of one time reach a node before its timer expires.

        Returns:
            Whether the time was published, so that it has advanced.
        """
        if not self.began or self._executor.clock_pauses:
            return False
        self._executor.clocks.announce(self._now())
        self.await_answers()
        return True

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
        # Before it is updated what is due: what arrives meanwhile may itself have to be answered.
        received = [topic.count() for topic in self._topics.values()]
        for one in self._expectations.due():
            one.update(now, self._published)
        for topic, count in zip(self._topics.values(), received, strict=True):
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
            self.waiting.ask(probe, ROUNDS)
        if len(probes) == 1:
            self._sent = self._count_sent()
        return True

    def _count_sent(self) -> tuple[int, ...]:
        """Return numbers that change with every message to an external node."""
        return (
            self._executor.clocks.publications,
            self._traffic.sent_to_others(),
            *(topic.count() for topic in self._topics.values()),
        )

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
