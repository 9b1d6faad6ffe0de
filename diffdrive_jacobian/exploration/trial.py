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

"""One world: its case and its faults, how it is run, what comes out, and a hash of its messages."""

from __future__ import annotations

import hashlib
import sys
import sysconfig
import traceback
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any

from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message

import diffdrive_jacobian
from diffdrive_jacobian.exploration.scenario import ScenarioName
from diffdrive_jacobian.exploration.unseen import Seen, Watcher
from diffdrive_jacobian.faults import Fault
from diffdrive_jacobian.faults.fault import Expression
from diffdrive_jacobian.lockstep._border import Said
from diffdrive_jacobian.lockstep._errors import IneffectiveFaultsError, LockstepError, PropertyViolation
from diffdrive_jacobian.lockstep._pause import ends_all
from diffdrive_jacobian.lockstep._properties import answer
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.messages.structure import (
    Array,
    FieldType,
    Number,
    Sequence,
    Structure,
    is_identifier,
    plain,
    structure,
    walk,
)
from diffdrive_jacobian.messages.topics import NOT_OF_ROBOTS
from diffdrive_jacobian.properties.base import Property
from diffdrive_jacobian.relations.base import Relation
from diffdrive_jacobian.relations.checking import checked
from diffdrive_jacobian.relations.worlds import Ran, Scene
from diffdrive_jacobian.ros.rclpy_internals import wrap_publish
from diffdrive_jacobian.text import error_text, printable_lines
from diffdrive_jacobian.time_units import NANOSECONDS

QUIET = ('--disable-rosout-logs', '--disable-stdout-logs', '--disable-external-lib-logs')
"""ROS arguments of explored worlds. Logs of thousands of worlds help nobody, and take time."""
DIED = 'NoExceptionProcessDied'
"""Name of the violation of a world that ends its process."""
LONGEST_TEXT = 20_000
"""Length beyond which the text of a violation is cut (characters)."""
LONGEST_LINE = 500
"""Length beyond which the first line of an exception is cut (characters)."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What all worlds of an exploration have in common."""

    scenario: ScenarioName
    properties: tuple[Property, ...]
    relations: tuple[Relation, ...] = ()
    args: tuple[str, ...] = ()
    """ROS arguments of all nodes."""

    def required(self, index: int) -> Expression:
        """Return the property, or after those the relation, with an index."""
        return (*self.properties, *self.relations)[index]


@dataclass(frozen=True, kw_only=True)
class Trial:
    """What distinguishes one world from the others."""

    case: Any
    faults: tuple[Fault, ...] = ()
    seed: int = 0
    """Seed of the random numbers of the faults."""


@dataclass(frozen=True, kw_only=True)
class Violation:
    """What a world violated."""

    key: str
    """The property as Python source, or the exception and where it was raised."""
    seconds: float
    """World time since the start (s)."""
    text: str
    """Description; for an exception its traceback."""
    name: str
    """Short name, a valid identifier."""
    index: int = -1
    """Index of the property, or after those of the relation; -1: an exception."""
    message: str = ''
    """Kind and first line of an exception."""

    @property
    def headline(self) -> str:
        """The description in one line."""
        return self.message or self.text.strip().partition('\n')[0]


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came out of a world."""

    violations: tuple[Violation, ...] = ()
    """In the order in which they happened."""
    checks: int = 0
    """How often a property was checked."""
    compared: Mapping[str, int] = field(default_factory=dict)
    """Number of messages that were compared with their images, by relation."""
    seconds: float = 0.0
    """Duration in simulated time (s), with the images."""
    complaints: tuple[str, ...] = ()
    """What faults, a property or a relation needed and did not find."""
    notes: tuple[str, ...] = ()
    """What relations did not compare."""
    seen: Seen = field(default_factory=Seen)
    """What the world has had."""
    compared_topics: frozenset[str] = frozenset()
    """Topics whose messages were compared with their images."""
    digest: str = ''
    """Hash of all messages, if it was asked for."""

    def of(self, key: str) -> Violation | None:
        """Return the violation with a key; None: there is none."""
        return next((one for one in self.violations if one.key == key), None)


class _Collecting:
    """A property whose first violation is collected, and ends the world only if `stop`."""

    def __init__(self, watched: Property, index: int, found: list[Violation], *, stop: bool) -> None:
        self._watched, self._index, self._found, self._stop = watched, index, found, stop
        self._world: Any = None
        self._watch: Property | None = None
        self.checks = 0

    def __repr__(self) -> str:
        return repr(self._watched)

    def watch(self, world: Any) -> _Collecting:
        self._world, self._watch = world, self._watched.watch(world)
        return self

    def violated_now(self) -> str | None:
        if self._watch is None:
            return None
        self.checks += 1
        return self._collected(answer(self._watch.violated_now))

    def violated_at_end(self) -> str | None:
        return None if self._watch is None else self._collected(answer(self._watch.violated_at_end))

    def _collected(self, text: str | None) -> str | None:
        if text is None:
            return None
        self._watch = None
        self._found.append(
            Violation(
                key=printable_lines(repr(self._watched)),
                name=type(self._watched).__name__,
                seconds=self._world.world_seconds,
                text=printable_lines(text)[:LONGEST_TEXT],
                index=self._index,
            )
        )
        return text if self._stop else None


def run(
    setting: Setting,
    trial: Trial,
    *,
    only: int | None = None,
    digest: bool = False,
    during: Callable[[Lockstep], AbstractContextManager[Any]] = nullcontext,
) -> Outcome:
    """Run one world.

    Args:
        setting: What all worlds have in common.
        trial: The case and the faults.
        only: Index of the one property or relation to check; the violation of a property ends the world.
            None: all of them, and the world goes on after a violation. -1: only exceptions count, also
            of properties.
        digest: Whether to compute the hash of all messages.
        during: Returns a context manager in which the world is run, but not its images.

    Raises:
        ExplorationError: The scenario cannot be imported.
        ValueError, LockstepError: A fault or a property is invalid in this world.
    """
    scenario = setting.scenario.load()
    violations: list[Violation] = []
    complaints: tuple[str, ...] = ()
    properties = [
        _Collecting(one, index, violations, stop=only == index)
        for index, one in enumerate(setting.properties)
        if only in (None, -1, index)
    ]
    relations = {
        index: one
        for index, one in enumerate(setting.relations, len(setting.properties))
        if only in (None, index)
    }
    arguments = [*(setting.args or ['--ros-args']), '--ros-args', *QUIET]
    with Lockstep(arguments) as world, during(world):
        hashed: AbstractContextManager[MessageDigest | None] = (
            MessageDigest(world) if digest else nullcontext()
        )
        with hashed as messages:
            watcher = Watcher(world)
            world.inject(*trial.faults, seed=trial.seed)
            world.require(*properties)
            first: Ran | None = None
            with Said(world) if relations else nullcontext() as said:
                ended: BaseException | None = None
                try:
                    scenario(world, trial.case)
                    if relations:
                        # As in the images.
                        world.settle()
                    complaints = _finish(world)
                except BaseException as error:
                    if ends_all(error):
                        raise
                    ended = error
                    # What ends the world because of `only` is collected already.
                    if not isinstance(getattr(error, 'property', None), _Collecting):
                        violations.append(of_exception(error, world.world_seconds))
                if said is not None:
                    topics = tuple(topic for one in relations.values() for topic in one.topics)
                    first = Ran.of(world, said, topics, ended)
        outcome = Outcome(
            violations=tuple(one for one in violations if only != -1 or one.index < 0),
            checks=sum(one.checks for one in properties),
            seconds=world.world_seconds,
            complaints=complaints,
            digest='' if messages is None else messages.value(),
            seen=watcher.seen(trial.faults),
        )
    if first is None:
        return outcome
    scene = Scene(
        scenario=scenario,
        case=trial.case,
        faults=trial.faults,
        seed=trial.seed,
        args=arguments,
        topics=tuple(first.names),
    )
    return _with_images(outcome, relations, first, scene)


def _with_images(
    outcome: Outcome, relations: Mapping[int, Relation], first: Ran, scene: Scene
) -> Outcome:
    """Add to the outcome of a world how its images compare with it."""
    worlds: dict[tuple[int, ...], tuple[Ran, Scene]] = {(): (first, scene)}
    for index, relation in relations.items():
        without = tuple(n for n, one in enumerate(scene.faults) if relation.is_disturbed_by(one))
        try:
            if without not in worlds:
                faults = [one for n, one in enumerate(scene.faults) if n not in without]
                undisturbed = replace(scene, faults=faults)
                ran = undisturbed.run('the world without faults that disturb the relation')
                worlds[without] = ran, undisturbed
                outcome = replace(outcome, seconds=outcome.seconds + ran.end / NANOSECONDS)
            result = checked(relation, *worlds[without])
        except LockstepError as error:
            complaint = str(error).partition('\n')[0]
            if first.error is None:
                outcome = replace(outcome, complaints=(*outcome.complaints, complaint))
            # Else the world has ended before its nodes were there, which is a finding.
            continue
        outcome = replace(
            outcome,
            compared={**outcome.compared, repr(relation): result.compared},
            seconds=outcome.seconds + result.seconds,
            compared_topics=outcome.compared_topics | result.topics,
            notes=(*outcome.notes, *([f'{relation!r}: {result.note}'] if result.note else ())),
        )
        if result.difference is not None:
            violation = Violation(
                key=printable_lines(repr(relation)),
                seconds=result.difference.time / NANOSECONDS,
                text=printable_lines(result.difference.text)[:LONGEST_TEXT],
                name=type(relation).__name__,
                index=index,
            )
            outcome = replace(outcome, violations=(*outcome.violations, violation), digest=result.digest)
    return outcome


def _finish(world: Lockstep) -> tuple[str, ...]:
    """Check the properties at the end; return what faults and properties needed and did not find."""
    try:
        world.finish()
    except PropertyViolation:
        raise
    except IneffectiveFaultsError as error:
        return tuple(f'a fault had no effect: {reason}' for reason in error.reasons)
    except LockstepError as error:
        return (str(error).partition('\n')[0],)
    return ()


def of_exception(error: BaseException, seconds: float) -> Violation:
    """Return an exception of a node or of the scenario as a violation, at a world time (s)."""
    kind = type(error).__name__
    key = f'{kind}{_place(error.__traceback__)}'
    if isinstance(error, PropertyViolation):
        key = repr(error.property)
    # The last messages of all topics may follow.
    first = error_text(error).strip().partition('\n')[0]
    text = ''.join(traceback.format_exception(type(error), error, error.__traceback__))
    return Violation(
        key=printable_lines(key),
        name=f'NoException{kind}',
        seconds=error.seconds if isinstance(error, PropertyViolation) else seconds,
        text=printable_lines(text)[-LONGEST_TEXT:],
        message=f'{kind}: {first}'[:LONGEST_LINE] if first else kind,
    )


def _place(trace: TracebackType | None) -> str:
    """Return the innermost line of the user's code, or of this package if there is none."""
    frames = traceback.extract_tb(trace)
    own = [frame for frame in frames if not _is_library(frame.filename)]
    if not frames:
        return ''
    last = (own or frames)[-1]
    return f' in {Path(last.filename).name}:{last.lineno} ({last.name})'


_HERE = Path(diffdrive_jacobian.__file__).parent
_LIBRARIES = tuple(
    str(Path(folder).resolve())
    for folder in (
        *map(sysconfig.get_path, ('stdlib', 'purelib', 'platlib')),
        *(f'{sys.prefix}/lib', f'{_HERE}/lockstep', f'{_HERE}/exploration'),
    )
)


def _is_library(file: str) -> bool:
    return str(Path(file).resolve()).startswith(_LIBRARIES) or file.startswith('<')


class MessageDigest:
    """Hashes time, topic and fields of every message that a node publishes, as a context manager.

    Two worlds with the same hash are the same bit for bit. Serialized bytes are not hashed as they are,
    because their padding is arbitrary. Random identifiers of goals are replaced by their numbers in the
    order in which they appear.
    """

    def __init__(self, world: Lockstep, without: Collection[str] = ()) -> None:
        """Start without messages. Those on the topics `without` do not count."""
        self._world = world
        self._without = {*NOT_OF_ROBOTS, *without}
        self._hash = hashlib.sha256()
        self._identifiers: dict[bytes, int] = {}

    def __enter__(self) -> MessageDigest:
        """Start to hash."""

        def hashing(publish: Callable[..., None]) -> Callable[..., None]:
            def hashed(publisher: Publisher, msg: Any) -> None:
                publish(publisher, msg)
                if publisher.topic_name not in self._without:
                    self._add(publisher, msg)

            return hashed

        self._restore = wrap_publish(hashing)
        return self

    def __exit__(self, *_: object) -> None:
        """Stop."""
        self._restore()

    def value(self) -> str:
        """Return the hash of the messages so far."""
        return self._hash.hexdigest()[:32]

    def _add(self, publisher: Publisher, message: Any) -> None:
        words = [str(self._world.now), publisher.topic_name]
        if isinstance(message, bytes):
            try:
                message = deserialize_message(message, publisher.msg_type)
            except RuntimeError:
                # No message: nothing in it is padding.
                self._hash.update('\0'.join([*words, message.hex()]).encode())
                return
        for _, kind, value in walk(structure(type(message)), message, whole=is_identifier):
            words += self._words(kind, value)
        self._hash.update('\0'.join(words).encode())

    def _words(self, kind: FieldType, value: Any) -> list[str]:
        """Return a field of a message as text, with every bit of the numbers."""
        match kind:
            case Structure():
                identifier = bytes(value.uuid)
                number = self._identifiers.setdefault(identifier, len(self._identifiers))
                return [str(number) if any(identifier) else 'none']
            case Array() | Sequence() if hasattr(value, 'tobytes'):
                # Numbers, as rclpy has them: a megabyte of an image at once.
                return [str(len(value)), hashlib.sha256(value.tobytes()).hexdigest()]
            case Array(element=element) | Sequence(element=element):
                values = plain(value)
                words = [word for one in values for word in self._words(element, one)]
                return [str(len(values)), *words]
            case Number() if isinstance(value, float):
                return [value.hex()]
        return [repr(value)]
