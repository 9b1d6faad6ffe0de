# Copyright 2026 The diffdrive_jacobian developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The recording of a test, and its comparison with a golden run: a bag with which it is compared."""

from __future__ import annotations

import math
import shlex
import shutil
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator
from collections.abc import Sequence as Values
from contextlib import suppress
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from rclpy.serialization import deserialize_message

from diffdrive_jacobian.bags.bag_reader import BagError, custom_data, messages, open_bag
from diffdrive_jacobian.bags.bag_writer import build_bag
from diffdrive_jacobian.bags.files import journal_of
from diffdrive_jacobian.bags.journal import Channel, Message, Text
from diffdrive_jacobian.bags.message_definitions import UnknownTypeError, definition, message_class
from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.exploration.extensions import draw
from diffdrive_jacobian.exploration.recorded_world import record_world
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.messages.structure import (
    COUNT,
    Array,
    FieldType,
    Sequence,
    is_identifier,
    plain,
    structure,
    walk,
)
from diffdrive_jacobian.messages.topics import CLOCK, OF_EVERY_NODE, TRANSFORMS
from diffdrive_jacobian.numerics.checks import between
from diffdrive_jacobian.recording.recording import Recording, RecordingError
from diffdrive_jacobian.time_units import NANOSECONDS

BAG = 'run'
"""Name of the bag in the directory of a test."""
Messages: TypeAlias = Values[tuple[int, bytes]]
"""Messages of a topic: the time of each (ns), and its CDR."""
MAX_SHOWN = 200
"""Length of the longest value that is shown (characters)."""
TOLERANCE = 1e-9
"""Default tolerance of floats: the last bits may differ between CPUs."""
NOT_COMPARED = (CLOCK, *OF_EVERY_NODE, TRANSFORMS)
"""Topics that are neither stored nor compared. `/tf` is published only where tf2_ros is installed."""
MAX_TOPICS = 8
"""Number of topics with differences that are listed."""


class RecordedRun:
    """The recording of a test: the bag `run` in a directory, where it replaces an earlier one."""

    def __init__(self, world: Lockstep, directory: Path) -> None:
        """Start to record all topics.

        Raises:
            OSError: The bag cannot be written.
        """
        self._directory = directory
        bag = directory / BAG
        directory.mkdir(parents=True, exist_ok=True)
        for old in (journal_of(bag), _figure_of(bag)):
            old.unlink(missing_ok=True)
        self._recording = Recording(bag, lossless=True, replace=True)
        if bag.exists():
            # A bag, as the recording has checked.
            shutil.rmtree(bag)
        self._finished = False
        self._error: RecordingError | None = None
        self._kept: str | None = None
        record_world(world, self._recording)

    @property
    def bag(self) -> Path:
        """The directory of the bag. It exists after `finish`."""
        return self._recording.bag

    def finish(self) -> Path:
        """End the recording and write the bag, which is deleted after the test. Return its directory.

        Messages after the first call are not recorded. Later calls return or raise the same.

        Raises:
            RecordingError: The recording is not complete.
        """
        if not self._finished:
            self._finished = True
            try:
                self._recording.finish()
            except RecordingError as error:
                self._error = error
        if self._error is not None:
            raise self._error
        return self.bag

    def keep(self) -> str:
        """End the recording as `finish` does and keep it, with a figure if somebody can draw it.

        Returns:
            The path of the bag, and in a second line that of the figure, if there is one.

        Raises:
            RecordingError: The recording is not complete.
        """
        self.finish()
        if self._kept is None:
            picture = _figure_of(self.bag)
            why = draw(self.bag, picture)
            drawn = f'not drawn: {why}' if why else str(picture)
            self._kept = str(self.bag) if why is None else f'{self.bag}\n{drawn}'
        return self._kept

    def close(self) -> None:
        """Delete the recording, unless it was kept or is not complete."""
        if not self._finished:
            self._finished = True
            self._recording.discard()
        elif self._kept is None and self._error is None:
            shutil.rmtree(self.bag, ignore_errors=True)
        with suppress(OSError):
            # Only if it is empty.
            self._directory.rmdir()


def _figure_of(bag: Path) -> Path:
    return bag.with_name(bag.name + '.png')


class TopicDifference(NamedTuple):
    """How the messages of a topic differ from the golden ones."""

    topic: str
    time: int
    """Time of the first message that differs (ns)."""
    first: str
    """Which message that is, and how it differs."""
    different: int
    """Number of messages that differ, are missing or are additional."""
    compared: int
    """Number of messages, of the run that has more."""


class Comparison:
    """Comparison of a run with a golden one; arguments as for `GoldenRun.check`."""

    def __init__(self, tolerance: float) -> None:
        """Start without known identifiers."""
        self._tolerance = tolerance
        self._golden_of: dict[bytes, bytes] = {}
        self._run_of: dict[bytes, bytes] = {}

    def of_topic(
        self, topic: str, run: Messages, golden: Messages, deserialize: Callable[[bytes], Any]
    ) -> TopicDifference | None:
        """Compare the messages of a topic, each with the golden one of the same number.

        `deserialize` returns a message from its CDR.

        Returns:
            The difference; None: there is none.
        """
        first: tuple[int, str] | None = None
        different = 0
        for number, (one, other) in enumerate(zip_longest(run, golden), start=1):
            what = self._difference(one, other, deserialize)
            if what is None:
                continue
            different += 1
            if first is None:
                time = min(message[0] for message in (one, other) if message is not None)
                first = time, f'message {number} of {topic}, {what}'
        if first is None:
            return None
        return TopicDifference(topic, *first, different, max(len(run), len(golden)))

    def _difference(
        self,
        one: tuple[int, bytes] | None,
        golden: tuple[int, bytes] | None,
        deserialize: Callable[[bytes], Any],
    ) -> str | None:
        """Return how a message differs from the golden one; None: it does not."""
        if one is None or golden is None:
            present = one or golden
            assert present is not None
            return f'at {_seconds(present[0])}, is {"missing" if one is None else "additional"}'
        if one[0] != golden[0]:
            return f'was published at {_seconds(one[0])}, golden at {_seconds(golden[0])}'
        if one[1] == golden[1]:
            return None
        for path, kind, value, expected in _pairs(deserialize(one[1]), deserialize(golden[1])):
            if (what := self._value_difference(kind, value, expected)) is not None:
                return f'at {_seconds(one[0])}: {path} {what}'
        # Only the bytes of the padding differ, or identifiers.
        return None

    def _value_difference(self, kind: FieldType, value: Any, golden: Any) -> str | None:
        """Return how a value differs from the golden one; None: it does not. NaN is equal to NaN."""
        if is_identifier(kind):
            one, other = bytes(value.uuid), bytes(golden.uuid)
            renamed = self._golden_of.setdefault(one, other), self._run_of.setdefault(other, one)
            return (
                None if renamed == (other, one) else 'identifies something else than in the golden run'
            )
        if value == golden or (value != value and golden != golden):
            return None
        if not isinstance(value, float):
            return f'is {_shown(value)}, golden {_shown(golden)}'
        apart = abs(value - golden)
        if math.isfinite(apart) and apart <= self._tolerance * max(1.0, min(abs(value), abs(golden))):
            return None
        return f'is {value!r}, golden {golden!r}: differs by {apart:.3g}, allowed {self._tolerance:g}'


def _pairs(value: Any, golden: Any) -> Iterator[tuple[str, FieldType, Any, Any]]:
    """Yield path and type of each number or string of two messages of one type, and its two values."""
    kind = structure(type(value))
    walks = (walk(kind, one, whole=is_identifier) for one in (value, golden))
    # Where a length differs, what follows does not correspond, but the length comes first.
    for (path, field, one), (_, _, other) in zip(*walks, strict=False):
        if not isinstance(field, (Array, Sequence)):
            yield path, field, one, other
            continue
        if len(one) != len(other):
            yield f'len({path})', COUNT, len(one), len(other)
        for index, pair in enumerate(zip(plain(one), plain(other), strict=False)):
            yield f'{path}[{index}]', field.element, *pair


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= MAX_SHOWN else f'{text[:MAX_SHOWN]}...'


def _seconds(time: int) -> str:
    seconds, rest = divmod(time, NANOSECONDS)
    # Exact, also for the time of today.
    return f'{seconds}.{rest:09}'.rstrip('0').rstrip('.') + ' s'


class GoldenRunError(DiffdriveError, AssertionError):
    """A run differs from its golden run, or there is none."""


class GoldenRun:
    """The golden run of a test. It is checked when the test has passed, unless the test did so."""

    def __init__(self, run: RecordedRun, path: Path, test: str, update: bool) -> None:
        """Compare a recorded run with the golden bag in a directory.

        `update` writes that bag if there is none, or if the run of the test (node id) differs from it.
        """
        self._run, self._update = run, update
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
                must always stand for the same one of the golden run.
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
        differences.sort(key=lambda one: (one.time, one.topic))
        shown = [f'{one.topic} {one.different} of {one.compared}' for one in differences[:MAX_TOPICS]]
        if len(differences) > MAX_TOPICS:
            shown.append(f'and {len(differences) - MAX_TOPICS} more topics')
        return (
            f'the run differs from the golden run, first in {differences[0].first}\n'
            f'messages that differ: {", ".join(shown)}\n'
            f'golden run: {self.path}\n'
            f'to make this run the golden one: {self._command}'
        )


def _topics(bag: Path, omitted: set[str]) -> dict[str, tuple[str, Messages]]:
    """Return type and messages of the topics of a bag. Topics without messages are left out.

    Raises:
        BagError: It cannot be read.
    """
    found: dict[str, list[tuple[int, bytes]]] = defaultdict(list)
    with open_bag(bag) as reader:
        connections = [one for one in reader.connections if one.topic not in omitted]
        types = {one.topic: one.msgtype for one in connections}
        for connection, time, data in messages(reader, connections):
            found[connection.topic].append((time, data))
    return {topic: (types[topic], content) for topic, content in found.items()}


def _differences(
    run: dict[str, tuple[str, Messages]], golden: dict[str, tuple[str, Messages]], tolerance: float
) -> list[TopicDifference]:
    """Return the differences of all topics.

    Raises:
        UnknownTypeError: A type is not installed.
    """
    found = []
    comparison = Comparison(tolerance)
    for topic in sorted(run.keys() | golden.keys()):
        kind, here = run.get(topic, ('', ()))
        golden_kind, there = golden.get(topic, ('', ()))
        if here and there and kind != golden_kind:
            what = f'message 1 of {topic}, is of type {kind}, golden {golden_kind}'
            count = max(len(here), len(there))
            found.append(TopicDifference(topic, here[0][0], what, count, count))
            continue
        deserialize = partial(deserialize_message, message_type=message_class(kind or golden_kind))
        difference = comparison.of_topic(topic, here, there, deserialize)
        if difference is not None:
            found.append(difference)
    return found


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
    build_bag(channels.values(), [*texts, *data], target, replace=True, compressed=True)
