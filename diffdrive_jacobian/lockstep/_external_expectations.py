"""What is awaited from other processes at present."""

from __future__ import annotations

from collections.abc import Iterable

from rclpy.node import Node

from diffdrive_jacobian.lockstep._external_answers import (
    Answers,
    AnswersDue,
    Every,
    Expectation,
    Idle,
    TicksDue,
)
from diffdrive_jacobian.lockstep._external_probe import Probe
from diffdrive_jacobian.lockstep._external_process import ExternalProcess

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
                self._probes.append((Probe(self._node, one), process))
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
