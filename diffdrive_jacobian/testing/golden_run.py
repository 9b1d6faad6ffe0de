"""The golden run of a test: a recorded bag, with which later runs of the test are compared."""

from __future__ import annotations

import shlex
from collections import defaultdict
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rclpy.serialization import deserialize_message

from diffdrive_jacobian.bags.bag_reader import BagError, custom_data, messages, open_bag
from diffdrive_jacobian.bags.bag_writer import build_bag
from diffdrive_jacobian.bags.journal import Channel, Message, Text
from diffdrive_jacobian.bags.message_definitions import UnknownTypeError, definition, message_class
from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.messages.topics import CLOCK, OF_EVERY_NODE, TRANSFORMS
from diffdrive_jacobian.numerics.fields import between
from diffdrive_jacobian.testing.differences import Comparison, TopicDifference
from diffdrive_jacobian.testing.recorded_run import RecordedRun

TOLERANCE = 1e-9
"""Default tolerance of floats: the last bits may differ between CPUs."""
NOT_COMPARED = (CLOCK, *OF_EVERY_NODE, TRANSFORMS)
"""Topics that are neither stored nor compared. `/tf` is published only where tf2_ros is installed."""
MAX_TOPICS = 8
"""Number of topics with differences that are listed."""


class GoldenRunError(DiffdriveError, AssertionError):
    """A run differs from its golden run, or there is none."""


@dataclass(frozen=True, slots=True)
class _Topic:
    type_name: str
    messages: list[tuple[int, bytes]]


class GoldenRun:
    """The golden run of a test. It is checked when the test has passed, unless the test did so."""

    def __init__(self, run: RecordedRun, path: Path, test: str, update: bool) -> None:
        """Compare a recorded run with a golden one.

        Args:
            run: The recording of the test.
            path: Directory of the golden bag.
            test: Node id of the test.
            update: Whether to write the golden bag if there is none, or if the run differs from it.
        """
        self._run = run
        self._update = update
        self.path = path
        """Directory of the golden bag."""
        self._command = f'pytest --update-golden-runs {shlex.quote(test)}'
        self.checked = False
        """Whether `check` was called."""
        self.written = False
        """Whether the golden bag was written."""

    def check(self, *, tolerance: float = TOLERANCE, without: Collection[str] = ()) -> None:
        """End the recording and compare it with the golden run, message by message.

        The messages of each topic are compared in their order: their times, and each of their fields.
        The order of messages of different topics at one time is not compared.

        Args:
            tolerance: Largest difference of two floats, relative to the smaller one if that exceeds 1.
                Everything else must be equal, except identifiers (UUID), which are random: each one
                must stand for one of the golden run.
            without: Topics that are not compared, besides `/clock`, `/rosout`, `/parameter_events` and
                `/tf`. Fully qualified names.

        Raises:
            GoldenRunError: The run differs, or there is no golden run. Not if it is to be updated.
            RecordingError: The recording is not complete.
            ValueError: The tolerance is negative or not finite, or a topic is not fully qualified.
        """
        __tracebackhide__ = True
        self.checked = True
        between(0.0)('tolerance', tolerance)
        if isinstance(without, str) or any(not topic.startswith('/') for topic in without):
            raise ValueError(f"without must be names of topics such as '/odom', got {without!r}")
        bag = self._run.finish()
        omitted = {*NOT_COMPARED, *without}
        if (problem := self._problem(bag, omitted, tolerance)) is None:
            return
        if self._update:
            _store(bag, self.path, omitted)
            self.written = True
            return
        raise GoldenRunError(problem)

    def _problem(self, bag: Path, omitted: set[str], tolerance: float) -> str | None:
        """Return how the run differs from the golden one; None: it does not."""
        if not self.path.exists():
            return (
                f'there is no golden run {self.path}\nto make this run the golden one: {self._command}'
            )
        try:
            run, golden = _topics(bag, omitted), _topics(self.path, omitted)
            differences = _differences(run, golden, tolerance)
        except (BagError, UnknownTypeError) as error:
            return f'the golden run cannot be compared: {error}\nto replace it: {self._command}'
        if not differences:
            return None
        return self._described(differences)

    def _described(self, differences: list[TopicDifference]) -> str:
        differences = sorted(differences, key=lambda one: (one.time, one.topic))
        shown = [f'{one.topic} {one.different} of {one.compared}' for one in differences[:MAX_TOPICS]]
        if len(differences) > MAX_TOPICS:
            shown.append(f'and {len(differences) - MAX_TOPICS} more topics')
        return (
            f'the run differs from the golden run, first in {differences[0].first}\n'
            f'messages that differ: {", ".join(shown)}\n'
            f'golden run: {self.path}\n'
            f'to make this run the golden one: {self._command}'
        )


def _topics(bag: Path, omitted: set[str]) -> dict[str, _Topic]:
    """Return the messages of a bag by topic. Topics without messages are left out.

    Raises:
        BagError: It cannot be read.
    """
    found: dict[str, list[tuple[int, bytes]]] = defaultdict(list)
    with open_bag(bag) as reader:
        connections = [one for one in reader.connections if one.topic not in omitted]
        types = {one.topic: one.msgtype for one in connections}
        for connection, time, data in messages(reader, connections):
            found[connection.topic].append((time, data))
    return {topic: _Topic(types[topic], content) for topic, content in found.items()}


def _differences(
    run: dict[str, _Topic], golden: dict[str, _Topic], tolerance: float
) -> list[TopicDifference]:
    """Return the differences of all topics.

    Raises:
        UnknownTypeError: A type is not installed.
    """
    found = []
    comparison = Comparison(tolerance)
    for topic in sorted(run.keys() | golden.keys()):
        here, there = run.get(topic), golden.get(topic)
        type_name = (here or golden[topic]).type_name
        if here is not None and there is not None and here.type_name != there.type_name:
            what = f'message 1 of {topic}, is of type {here.type_name}, golden {there.type_name}'
            count = max(len(here.messages), len(there.messages))
            found.append(TopicDifference(topic, here.messages[0][0], what, count, count))
            continue
        difference = comparison.of_topic(
            topic,
            here.messages if here else (),
            there.messages if there else (),
            _deserializer(type_name),
        )
        if difference is not None:
            found.append(difference)
    return found


def _deserializer(type_name: str) -> Callable[[bytes], Any]:
    kind = message_class(type_name)
    return lambda data: deserialize_message(data, kind)


def _store(bag: Path, target: Path, omitted: set[str]) -> None:
    """Write the topics of a bag that are compared to another one, which may be replaced.

    Raises:
        OSError: It cannot be written.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    with open_bag(bag) as reader:
        connections = [one for one in reader.connections if one.topic not in omitted]
        channels = {
            one.id: Channel(
                id=number,
                topic=one.topic,
                type_name=one.msgtype,
                definition=definition(one.msgtype).text,
                type_hash=one.digest,
                qos=tuple(getattr(one.ext, 'offered_qos_profiles', ())),
            )
            for number, one in enumerate(connections)
        }
        texts = [Text(key, value) for key, value in custom_data(reader).items()]
        data = [
            Message(channels[connection.id].id, time, data)
            for connection, time, data in messages(reader, connections)
        ]
    build_bag(channels.values(), [*texts, *data], target, 'mcap', replace=True, compressed=True)
