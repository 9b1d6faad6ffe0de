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

"""Comparing what the nodes under test say in the image of a world."""

from __future__ import annotations

import hashlib
import warnings
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from diffdrive_jacobian.faults import Fault
from diffdrive_jacobian.lockstep._border import Message, Speaker
from diffdrive_jacobian.lockstep._errors import LockstepError, PropertyViolation, described, raised
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.relations.base import Relation
from diffdrive_jacobian.relations.between import first_outside
from diffdrive_jacobian.relations.differences import (
    Difference,
    Spoken,
    differing,
    exact,
    first_difference,
)
from diffdrive_jacobian.relations.images import Image, check_image, image_made, image_of
from diffdrive_jacobian.relations.imaging import Imaging
from diffdrive_jacobian.relations.worlds import Ran, Scene, decoded
from diffdrive_jacobian.time_units import NANOSECONDS, in_seconds, nanoseconds


class RelationViolation(PropertyViolation):
    """What nodes say is not the image of what they said."""

    digest = ''
    """Hash of all messages of both worlds."""


class Checked(NamedTuple):
    """How the image of a world compares with it."""

    difference: Difference | None
    compared: int = 0
    """Number of messages that were compared."""
    topics: frozenset[str] = frozenset()
    """Their topics, as in the first world."""
    end: int = 0
    """World time until which they were compared (ns)."""
    seconds: float = 0.0
    """Simulated time of the worlds that were run (s)."""
    note: str = ''
    """Why what came later was not compared; empty: it was."""
    digest: str = ''
    """Hash of all messages of both worlds, if they differ."""


UNTIL_ROUNDING = 'what came after an event that rounding decides was not compared'
UNCHANGED = 'no message that the nodes under test hear is changed'
UNTIL_OVERTAKEN = 'what came after a request or an end that overtook a late message was not compared'
UNTIL_OTHERS = 'what came after a change of the other nodes was not compared'


def checked(relation: Relation, first: Ran, scene: Scene) -> Checked:
    """Run the image of a world, and compare.

    Args:
        relation: The relation.
        first: The world.
        scene: What was run in it, without faults that disturb the relation.

    Raises:
        LockstepError: There is no node under test, or an image cannot be made.
    """
    relation = relation.fitted(first)
    names = relation.under_test(first)
    image = image_of(relation, first, scene, names)
    result = _compared(relation, first, image, names)
    seconds = image.ran.end / NANOSECONDS
    if result.difference is None:
        return result._replace(seconds=seconds)
    decides = False
    if scene.pause_at is None:
        decides, spent = _rounding_decides(relation, first, scene, names, result.difference)
        seconds += spent
    if decides:
        end = result.difference.time
        count = sum(one.time < end for one in first.messages if one.speaker.node in names)
        return result._replace(
            difference=None, compared=count, end=end, note=UNTIL_ROUNDING, seconds=seconds
        )
    return result._replace(seconds=seconds, digest=_digest(first, image.ran))


def _rounding_decides(
    relation: Relation, first: Ran, scene: Scene, names: Collection[str], found: Difference
) -> tuple[bool, float]:
    """Return whether rounding may be the cause of a difference, and how much was simulated (s).

    It may if a world that differs by little more than rounding differs until then, too, or cannot be
    compared so far. If whole worlds all differ, rounding is not the cause.
    """
    if found.speaker is not None and not relation.whole_world:
        # So the other nodes do the same as before, in the same order.
        names = {found.speaker.node}
    seconds, same, differ = 0.0, 0, 0
    for near in relation.nearby(first):
        image = image_of(near, first, scene, names)
        seconds += image.ran.end / NANOSECONDS
        result = _compared(near, first, image, names)
        until = result.end if result.difference is None else result.difference.time
        if found.time < until:
            same += 1
        else:
            differ += 1
        if differ and (same or not relation.whole_world):
            return True, seconds
    return False, seconds


def _compared(imaging: Imaging, first: Ran, image: Image, names: Collection[str]) -> Checked:
    """Compare what nodes said with the image of what they had said."""
    ran = image.ran
    # What was said at the time of an error is incomplete.
    end = min(one.end + (one.error is None) for one in (first, ran))
    note = ''
    if image.overtaken is not None:
        end, note = image.overtaken, UNTIL_OVERTAKEN
    if not imaging.whole_world:
        others = _change_of_others(first, ran, names, imaging.tolerance)
        if others < end:
            end, note = others, UNTIL_OTHERS
    expected = _spoken(first, names, end, lambda one: _expected(imaging, first, one))
    apart = {imaging.renamed(name, first.namespace) for name in names}
    actual = _spoken(ran, apart, end, lambda one: _actual(imaging, ran, one))
    found: list[Difference] = []
    if ran.error is not None and first.error is None and ran.end <= end:
        what = raised(ran.error) if isinstance(ran.error, Exception) else f'it raised {ran.error!r}'
        found.append(Difference(ran.end, what))
    for speaker in dict.fromkeys([*expected, *actual]):
        both = expected.get(speaker, ()), actual.get(speaker, ())
        until = None
        if imaging.late:
            difference = first_outside(
                speaker,
                *both,
                tolerance=imaging.tolerance,
                early=nanoseconds(imaging.early),
                late=nanoseconds(imaging.late),
                end=end,
            )
        else:
            difference, until = first_difference(
                speaker, *both, tolerance=imaging.tolerance, period=imaging.longest_move
            )
        if difference is not None:
            found.append(difference)
        if until is not None and until < end:
            end, note = until, UNTIL_ROUNDING
    found = [one for one in found if one.time < end or (one.speaker is None and one.time == end)]
    count = _count(expected, end - nanoseconds(max(imaging.early, imaging.late)))
    if not image.changed:
        count, note = 0, UNCHANGED
    compared = [one for one in first.messages if count and one.time < end and one.speaker.node in names]
    topics = {one.speaker.topic for one in compared}
    return Checked(_first(found, ran), count, frozenset(topics), end, note=note)


def _count(expected: Mapping[Speaker, Sequence[Spoken]], end: int) -> int:
    """Return how many messages were said before a time (ns)."""
    return sum(one.time < end for spoken in expected.values() for one in spoken)


def _first(found: Sequence[Difference], image: Ran) -> Difference | None:
    """Return the first difference; of those at one time that which was said first."""
    if not found:
        return None
    time = min(one.time for one in found)
    order: list[Speaker | None] = [one.speaker for one in image.messages if one.time == time]
    same = [one for one in found if one.time == time]
    return min(same, key=lambda one: [*order, one.speaker].index(one.speaker))


def _spoken(
    ran: Ran, names: Iterable[str], end: int, read: Callable[[Message], tuple[Speaker, Any]]
) -> dict[Speaker, list[Spoken]]:
    """Return what nodes have said before a time (ns), by publisher."""
    spoken = defaultdict(list)
    wanted = frozenset(names)
    for one in ran.messages:
        if one.time < end and one.speaker.node in wanted:
            speaker, message = read(one)
            spoken[speaker].append(Spoken(one.time, message))
    return spoken


def _expected(imaging: Imaging, first: Ran, one: Message) -> tuple[Speaker, Any]:
    node, topic, number = one.speaker
    speaker = Speaker(
        imaging.renamed(node, first.namespace), imaging.renamed(topic, first.namespace), number
    )
    message = decoded(one)
    if isinstance(message, bytes):
        return speaker, message
    image = image_made(imaging, topic, message, imaging.said)
    check_image(imaging, topic, message, image)
    return speaker, imaging.compared(image, first.namespace)


def _actual(imaging: Imaging, ran: Ran, one: Message) -> tuple[Speaker, Any]:
    message = decoded(one)
    return one.speaker, message if isinstance(message, bytes) else imaging.compared(
        message, ran.namespace
    )


def _change_of_others(first: Ran, image: Ran, names: Collection[str], tolerance: float) -> int:
    """Return the time at which the other nodes first say something else than in the first world (ns)."""
    before, now = (
        [one for one in ran.messages if one.speaker.node not in names] for ran in (first, image)
    )
    for one, other in zip(before, now, strict=False):
        if one.time != other.time or one.speaker != other.speaker:
            return min(one.time, other.time)
        if one.data != other.data and differing(decoded(other), decoded(one), tolerance):
            return one.time
    rest = [*before[len(now) :], *now[len(before) :]]
    return rest[0].time if rest else max(first.end, image.end) + 1


def _digest(*worlds: Ran) -> str:
    """Return a hash of all messages. Random identifiers do not count, nor does padding."""
    digest = hashlib.sha256()
    for world in worlds:
        for one in world.messages:
            digest.update(f'{one.time} {one.speaker} {exact(decoded(one))}'.encode())
    return digest.hexdigest()[:32]


def check_relation(
    scenario: Callable[[Lockstep, Any], object],
    relation: Relation,
    *,
    case: Any = None,
    faults: Sequence[Fault] = (),
    seed: int = 0,
    args: Sequence[str] = (),
    pause_at: float | None = None,
) -> None:
    """Run a world and its image, and compare what the nodes under test say.

    Args:
        scenario: `scenario(world, case)` creates nodes in a `Lockstep` and advances its time, as of
            `explore`. It must not depend on which of the worlds it is in.
        relation: The relation, such as `Mirrored()`.
        case: Second argument of the scenario.
        faults: Faults of both worlds.
        seed: Seed of their random numbers.
        args: ROS arguments of all nodes, as for `Lockstep`.
        pause_at: World time at which the world and its image are paused for a debugger (s), as by
            `Lockstep.pause_at`. Whether rounding decides is not looked at then. None: they are not.

    Raises:
        PropertyViolation: What they say is not the image of what they said.
        LockstepError: There is no node under test, or it said nothing; or an image cannot be made.

    Warns:
        UserWarning: Only a part of the world was compared. The message says why.
    """
    given: Any = relation
    if not isinstance(given, Relation):
        hint = f'; create one: {given.__name__}()' if isinstance(given, type) else ''
        raise LockstepError(f'check_relation takes a relation, got {described(given)}{hint}')

    if not callable(scenario):
        raise LockstepError(f'scenario must be a function (world, case), got {described(scenario)}')
    if not isinstance(faults, (list, tuple)):
        raise LockstepError(f'faults must be a list, got {described(faults)}')

    scene = Scene(
        scenario=scenario,
        case=case,
        faults=[one for one in faults if not relation.is_disturbed_by(one)],
        seed=seed,
        args=args,
        topics=relation.topics,
        pause_at=pause_at,
    )
    first = scene.run('the first world', strict=True)
    if first.error is not None:
        raise first.error
    result = checked(relation, first, scene)
    if result.difference is not None:
        time, text, _ = result.difference
        violation = RelationViolation(relation, time / NANOSECONDS, text)
        violation.digest = result.digest
        raise violation
    if not result.compared:
        why = result.note or f'the nodes under test said nothing until {in_seconds(first.end)}'
        raise LockstepError(f'{relation!r}: nothing was compared: {why}')
    if result.note:
        until = in_seconds(min(result.end, first.end))
        warnings.warn(
            f'{relation!r}: compared until {until} of {in_seconds(first.end)}: {result.note}',
            stacklevel=2,
        )
