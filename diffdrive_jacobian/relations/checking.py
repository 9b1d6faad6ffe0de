"""Running the image of a world, and comparing what its nodes say."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, NamedTuple

from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message

from diffdrive_jacobian.faults import Fault
from diffdrive_jacobian.lockstep._border import Border, Endpoints, Message, Said, Speaker
from diffdrive_jacobian.lockstep._errors import LockstepError, PropertyViolation, described, raised
from diffdrive_jacobian.lockstep._link import Link
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.relations.base import Relation
from diffdrive_jacobian.relations.differences import (
    Difference,
    Spoken,
    differing,
    exact,
    first_difference,
)
from diffdrive_jacobian.relations.perturbed import Perturbed, nearby
from diffdrive_jacobian.relations.whole_world import WholeWorld
from diffdrive_jacobian.time_units import NANOSECONDS, in_seconds, nanoseconds

START = 1.0
"""What the clocks of the nodes show at the start of a world (s), as of `Lockstep`."""
Listen = Callable[[Lockstep], AbstractContextManager[Said]]
"""Returns what listens to a world while its scenario runs."""


class Ran(NamedTuple):
    """What the nodes of a world have said."""

    messages: Sequence[Message]
    nodes: Mapping[str, Endpoints]
    namespace: str
    """Namespace of the world."""
    end: int
    """World time at the end (ns)."""
    error: BaseException | None = None
    """What has ended the world; None: it came to its end."""

    @classmethod
    def of(cls, world: Lockstep, said: Said, error: BaseException | None = None) -> Ran:
        """Return what was said in a world until now."""
        return cls(said.messages, said.nodes, world.node.get_namespace(), world.world_time, error)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A scenario with its case and its faults, which can be run in several worlds."""

    scenario: Callable[[Lockstep, Any], object]
    case: Any
    faults: Sequence[Fault] = ()
    seed: int = 0
    args: Sequence[str] = ()
    on_world: Callable[[Lockstep, str], object] = lambda *_: None
    """Called with each world, and what it is."""

    def run(
        self, what: str, listen: Listen = Said, *, args: Sequence[str] = (), later: float = 0.0
    ) -> Ran:
        """Run it, and return what was said.

        Args:
            what: What the world is: 'the image'.
            listen: What listens to it.
            args: ROS arguments before those of the scene.
            later: How much later the clocks show at the start (s).
        """
        with Lockstep([*args, *self.args], start=START + later) as world:
            self.on_world(world, what)
            world.inject(*self.faults, seed=self.seed)
            with listen(world) as said:
                try:
                    self.scenario(world, self.case)
                except KeyboardInterrupt:
                    raise
                except BaseException as error:
                    return Ran.of(world, said, error)
                return Ran.of(world, said)


class RelationViolation(PropertyViolation):
    """What nodes say is not the image of what they said."""

    digest = ''
    """Hash of all messages of both worlds."""


class Image(NamedTuple):
    """What was said in the image of a world."""

    ran: Ran
    overtaken: int | None = None
    """World time from which on the order of what was heard is another one (ns); None: it is the same."""


class Checked(NamedTuple):
    """How the image of a world compares with it."""

    difference: Difference | None
    compared: int = 0
    """Number of messages that were compared."""
    topics: frozenset[str] = frozenset()
    """Their topics, as in the first world."""
    seconds: float = 0.0
    """Simulated time of the worlds that were run (s)."""
    note: str = ''
    """What was not compared; empty: everything was."""
    digest: str = ''
    """Hash of all messages of both worlds, if they differ."""


UNTIL_ROUNDING = 'what came after an event that rounding decides was not compared'
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
    names = relation.under_test(first.nodes, first.namespace)
    image = _image_of(relation, first, scene, names)
    result = _compared(relation, first, image, names)
    seconds = image.ran.end / NANOSECONDS
    if result.difference is None:
        return result._replace(seconds=seconds)
    # Of all nodes that of the difference, so that the others keep their order.
    speaker = result.difference.speaker
    names = names if speaker is None else {speaker.node}
    for near in nearby(relation.perturbed, relation.tolerance) if relation.perturbed else ():
        other = _image_of(near, first, scene, names)
        seconds += other.ran.end / NANOSECONDS
        moved = _compared(near, first, other, names).difference
        if moved is not None and moved.time <= result.difference.time:
            # Where a change of 1e-9 changes what is said, rounding may, too.
            return result._replace(difference=None, note=UNTIL_ROUNDING, seconds=seconds)
    return result._replace(seconds=seconds, digest=_digest(first, image.ran))


def _image_of(relation: Relation | Perturbed, first: Ran, scene: Scene, names: Collection[str]) -> Image:
    """Run the image of a world."""
    if isinstance(relation, WholeWorld):
        return Image(scene.run('the image', args=relation.args, later=relation.start))
    hearings: list[_Hearing] = []

    def listen(world: Lockstep) -> Border:
        hearings.append(_Hearing(relation, world, names))
        return Border(world, first.messages, names, hearings[0])

    ran = scene.run('the image', listen)
    (hearing,) = hearings
    if hearing.failed is not None:
        raise hearing.failed
    return Image(ran, hearing.overtaken)


class _Hearing:
    """What the nodes under test hear in an image."""

    def __init__(self, relation: Relation | Perturbed, world: Lockstep, names: Collection[str]) -> None:
        self._relation, self._world, self._names = relation, world, names
        self.failed: LockstepError | None = None
        """Why an image could not be made. Not an error of the node that hears it."""
        self.overtaken: int | None = None
        """World time at which a request or the end of a node overtook what is late (ns); None: never."""
        self._until: dict[Node, int] = {}
        self._services: set[str] = set()
        if isinstance(relation, Perturbed):
            relation.world = world
        if relation.keeps_order:
            world.on_new_topics(self._look)

    def __call__(self, link: Link, data: bytes) -> list[tuple[int, bytes]]:
        """Return what is heard instead of a message, with delays (ns)."""
        try:
            message = deserialize_message(data, link.message_type)
        except RuntimeError:
            # Bytes that are no message have no image.
            return [(0, data)]
        try:
            images = _images(self._relation, link.topic, message, self._relation.heard)
            out = [(nanoseconds(delay), serialize_message(one)) for delay, one in images]
        except LockstepError as error:
            self.failed = error
            raise
        if self._relation.keeps_order:
            now = self._world.world_time
            out = [(max(delay, self._until.get(link.owner, 0) - now), one) for delay, one in out]
            self._until[link.owner] = now + max(delay for delay, _ in out)
        return out

    def _look(self) -> None:
        nodes = self._world.nodes
        for node in self._until.keys() - nodes:
            # A node that is destroyed does not hear what is late.
            self._note_overtaking(node)
        for node in nodes:
            if node.get_fully_qualified_name() in self._names:
                for service in node.services:
                    if service.service_name not in self._services:
                        self._services.add(service.service_name)
                        self._world.on_response(service.service_name, self._on_response)

    def _on_response(self, node: Node, _: Any) -> None:
        self._note_overtaking(node)

    def _note_overtaking(self, node: Node) -> None:
        if self.overtaken is None and self._until.get(node, 0) > self._world.world_time:
            self.overtaken = self._world.world_time


def _images(relation: Any, topic: str, message: Any, image_of: Callable[[str, Any], Any]) -> Any:
    """Return what a method of a relation makes of a message: an image, or several with delays.

    Raises:
        LockstepError: It raises something, or an image is no message of the same type.
    """
    try:
        images = image_of(topic, message)
    except LockstepError:
        raise
    except Exception as error:
        raise LockstepError(f'{relation!r}: image of a message of {topic}: {raised(error)}') from error
    for image in [one for _, one in images] if isinstance(images, list) else [images]:
        if type(image) is not type(message):
            raise LockstepError(
                f'{relation!r}: the image of a message of {topic} must be a {type(message).__name__}, '
                f'got {described(image)}'
            )
    return images


def _compared(
    relation: Relation | Perturbed, first: Ran, image_of: Image, names: Collection[str]
) -> Checked:
    """Compare what nodes said with the image of what they had said."""
    image = image_of.ran
    end, note = min(first.end, image.end) + 1, ''
    if image_of.overtaken is not None:
        end, note = image_of.overtaken, UNTIL_OVERTAKEN
    if not isinstance(relation, WholeWorld):
        others = _change_of_others(first, image, names, relation.tolerance)
        if others < end:
            end, note = others, UNTIL_OTHERS
    expected = _spoken(first, names, end, lambda one: _expected(relation, first, one))
    apart = {_renamed(relation, name, first) for name in names}
    actual = _spoken(image, apart, end, lambda one: _actual(relation, one))
    found: list[Difference] = []
    if image.error is not None and first.error is None and image.end < end:
        what = (
            raised(image.error) if isinstance(image.error, Exception) else f'it raised {image.error!r}'
        )
        found.append(Difference(image.end, what))
    for speaker in dict.fromkeys([*expected, *actual]):
        difference, until = first_difference(
            speaker,
            expected.get(speaker, ()),
            actual.get(speaker, ()),
            tolerance=relation.tolerance,
            end=end,
            early=relation.early,
            late=relation.late,
            period=relation.period if isinstance(relation, WholeWorld) else 0.0,
        )
        if difference is not None:
            found.append(difference)
        if until is not None and until < end:
            end, note = until, UNTIL_ROUNDING
    found = [one for one in found if one.time < end]
    count = sum(one.time < end for spoken in expected.values() for one in spoken)
    topics = {one.speaker.topic for one in first.messages if one.speaker.node in names}
    return Checked(_first(found, image), count, frozenset(topics), note=note)


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


def _expected(relation: Relation | Perturbed, first: Ran, one: Message) -> tuple[Speaker, Any]:
    node, topic, number = one.speaker
    speaker = Speaker(_renamed(relation, node, first), _renamed(relation, topic, first), number)
    message = decoded(one)
    if isinstance(message, bytes):
        return speaker, message
    return speaker, _images(relation, topic, message, relation.said)


def _actual(relation: Relation | Perturbed, one: Message) -> tuple[Speaker, Any]:
    message = decoded(one)
    if isinstance(relation, WholeWorld) and not isinstance(message, bytes):
        message = relation.compared(message)
    return one.speaker, message


def _renamed(relation: Relation | Perturbed, name: str, first: Ran) -> str:
    return relation.renamed(name, first.namespace) if isinstance(relation, WholeWorld) else name


def decoded(message: Message) -> Any:
    """Return a message as an object, or its bytes if they are no message."""
    try:
        return deserialize_message(message.data, message.type)
    except RuntimeError:
        return message.data


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
        case: Its second argument.
        faults: Faults of both worlds.
        seed: Seed of their random numbers.
        args: ROS arguments of all nodes, as for `Lockstep`.
        pause_at: World time at which each of the worlds is paused for a debugger (s), as by
            `Lockstep.pause_at`; None: none is.

    Raises:
        RelationViolation: A PropertyViolation: what they say is not the image of what they said.
        LockstepError: There is no node under test, or it said nothing; or an image cannot be made.
    """
    given: Any = relation
    if not isinstance(given, Relation):
        hint = f'; create one: {given.__name__}()' if isinstance(given, type) else ''
        raise LockstepError(f'check_relation takes a relation, got {described(given)}{hint}')

    def paused(world: Lockstep, what: str) -> None:
        if pause_at is not None:
            world.pause_at(pause_at, what)

    scene = Scene(
        scenario=scenario,
        case=case,
        faults=[one for one in faults if not relation.is_disturbed_by(one)],
        seed=seed,
        args=args,
        on_world=paused,
    )
    first = scene.run('the first world')
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
