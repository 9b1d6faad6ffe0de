"""What a test declares about nodes in other processes, and what is due from them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import KW_ONLY, dataclass
from typing import Annotated

from rclpy.node import Node

from diffdrive_jacobian.lockstep.external.process import ExternalProcess
from diffdrive_jacobian.lockstep.external.waiting import Probe
from diffdrive_jacobian.numerics.checks import NotNegative
from diffdrive_jacobian.numerics.fields import Checked, Count, Name, between
from diffdrive_jacobian.time_units import NANOSECONDS

WITHIN = 5.0
"""Default of `within` (s)."""


# Less than a nanosecond is zero for rcl.
Period = Annotated[float, between(1e-9, unit='s')]


@dataclass(frozen=True)
class Answers(Checked):
    """Each message on a topic is answered by messages on another one.

    Simulated time does not advance until the answers have been received. A message on `topic` that
    answers nothing is an error.

    Attributes:
        topic: Topic that nodes in other processes publish.
        to: Topic that is answered, whoever publishes it.
        count: Number of answers to each message.
        within: Longest wall time for an answer (s).
        when: Called once there are new messages on `to`. If it returns a false value, they are not
            answered. None: all are.
    """

    topic: Name
    to: Name
    _: KW_ONLY
    count: Count = 1
    within: Period = WITHIN
    when: Callable[[], object] | None = None


@dataclass(frozen=True)
class Every(Checked):
    """A topic is published by a timer in simulated time.

    Simulated time stops at each expiry of the timer until the message has been received. Any other
    message on `topic` is an error. A timer on wall time, as of rclcpp's `create_wall_timer`, is no such
    timer.

    Attributes:
        topic: Topic that a node in another process publishes.
        period: Period of the timer (s).
        created: Time at which the timer is created (s). 0: before the node has received the time, as in
            its constructor. Then it expires once when the node receives the time, and from then on at
            multiples of the period.
        within: Longest wall time for a message (s).
        when: Called at each expiry. If it returns a false value, nothing is published. None: always.
    """

    topic: Name
    period: Period
    _: KW_ONLY
    created: NotNegative = 0.0
    within: Period = WITHIN
    when: Callable[[], object] | None = None


@dataclass(frozen=True)
class Idle(Checked):
    """A node is idle when it has processed all that it received, which its parameter services show.

    Whenever something was sent to the node, it is asked for its parameters three times before simulated
    time advances. An executor with one thread responds to the last request after the callbacks of the
    messages and timers before it. For nodes whose answers cannot be counted. It needs the node's
    parameter services.

    Attributes:
        node: Name of the node.
        within: Longest wall time for a response (s).
    """

    node: Name
    _: KW_ONLY
    within: Period = WITHIN


Expectation = Answers | Every | Idle


class AnswersDue:
    """Counts the answers that are due."""

    def __init__(self, declared: Answers, topic: str, question: str) -> None:
        """Start with none. `topic` and `question` are full names."""
        self.topic = topic
        self.question = question
        self.within = declared.within
        self.started = False
        """Whether the node has been discovered."""
        self.due = 0
        self._count = declared.count
        self._when = declared.when
        self._asked = 0

    def restart(self, published: Callable[[str], int]) -> None:
        """Start with none again. What was published before is not answered.

        Args:
            published: Returns the number of messages that were published on a topic.
        """
        self.started = True
        self.due = 0
        self._asked = published(self.question)

    def update(self, now: int, published: Callable[[str], int]) -> None:
        """Count the messages that have been published since the last call.

        Args:
            now: Simulated time (ns).
            published: Returns the number of messages that were published on a topic.
        """
        if not self.started:
            return
        number = published(self.question)
        new, self._asked = number - self._asked, number
        if new and (self._when is None or self._when()):
            self.due += new * self._count

    def next_time(self) -> int | None:
        """Return None: the next time is not known."""
        return None

    def describe(self, now: int) -> str:
        """Return what is due."""
        return f'answer to message {self._asked} on {self.question}, at {now / NANOSECONDS:g} s'


class TicksDue:
    """Counts the messages of a timer that are due, by the rules of rcl."""

    def __init__(self, declared: Every, topic: str) -> None:
        """Start with none. `topic` is a full name."""
        self.topic = topic
        self.question = ''
        self.within = declared.within
        self.started = False
        """Whether the node has been discovered."""
        self.due = 0
        # rclpy and rclcpp truncate.
        self._period = int(declared.period * NANOSECONDS)
        self._next = round(declared.created * NANOSECONDS) + self._period
        self._last = 0
        self._when = declared.when

    def restart(self, published: Callable[[str], int]) -> None:
        """Start with none again. Nothing expires before the node has received the time."""
        self.started = True
        self.due = 0

    def update(self, now: int, published: Callable[[str], int]) -> None:
        """Count the expiries up to a time (ns), which may have jumped."""
        if now < self._last:
            # A timer restarts when time jumps back behind its last expiry.
            self._last, self._next = now, now + self._period
        while self.started and self._next <= now:
            self._last = now
            self._next += self._period
            if self._next < now:
                # Periods that were missed are skipped.
                self._next += (1 + (now - self._next) // self._period) * self._period
            if self._when is None or self._when():
                self.due += 1

    def next_time(self) -> int | None:
        """Return the time of the next expiry (ns)."""
        return self._next if self.started else None

    def describe(self, now: int) -> str:
        """Return what is due."""
        return f'message of the timer of {self._period / NANOSECONDS:g} s, at {now / NANOSECONDS:g} s'


Due = AnswersDue | TicksDue


class Expectations:
    """The expectations, each with the process that is to meet it (None: any)."""

    def __init__(self, node: Node) -> None:
        """Start with none.

        Args:
            node: Node of the world, which resolves names.
        """
        self._node = node
        self._due: list[tuple[Due, ExternalProcess | None]] = []
        self._probes: list[tuple[Probe, ExternalProcess | None]] = []

    def add(self, expected: Iterable[Expectation], process: ExternalProcess | None) -> None:
        """Add expectations, until the test ends a process (None: always).

        Raises:
            ValueError: One of them is no `Answers`, `Every` or `Idle`.
        """
        resolve = self._node.resolve_topic_name
        for one in expected:
            if isinstance(one, Answers):
                answers = AnswersDue(one, resolve(one.topic), resolve(one.to))
                self._due.append((answers, process))
            elif isinstance(one, Every):
                self._due.append((TicksDue(one, resolve(one.topic)), process))
            elif isinstance(one, Idle):
                self._probes.append((Probe(self._node, one.node, one.within), process))
            else:
                raise ValueError(f'external must consist of Answers, Every and Idle, got {one!r}')

    def forget_ended(self) -> set[str]:
        """Forget the expectations of processes that the test has ended.

        Returns:
            Their topics.
        """
        ended = [one for one, process in self._due if process is not None and process.ended_by_test]
        if ended:
            self._due = [pair for pair in self._due if pair[0] not in ended]
        self._probes = [pair for pair in self._probes if pair[1] is None or not pair[1].ended_by_test]
        return {one.topic for one in ended}

    def due(self, topic: str | None = None) -> list[Due]:
        """Return the messages that are due on a topic; None: on all."""
        return [one for one, _ in self._due if topic is None or one.topic == topic]

    def probes(self) -> list[Probe]:
        """Return the probes of the nodes that are to be idle."""
        return [probe for probe, _ in self._probes]

    def include(self, process: ExternalProcess) -> bool:
        """Return whether anything is awaited from a process."""
        return any(owner is process for _, owner in (*self._due, *self._probes))
