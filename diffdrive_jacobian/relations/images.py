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

"""The image of a world: what its nodes under test hear there."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message

from diffdrive_jacobian.lockstep._border import Border
from diffdrive_jacobian.lockstep._errors import LockstepError, described, raised
from diffdrive_jacobian.lockstep._link import Link
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.relations.differences import exact
from diffdrive_jacobian.relations.imaging import Imaging
from diffdrive_jacobian.relations.worlds import Ran, Scene
from diffdrive_jacobian.time_units import nanoseconds


class Image(NamedTuple):
    """What was said in the image of a world."""

    ran: Ran
    changed: bool = True
    """Whether anything was heard otherwise."""
    overtaken: int | None = None
    """World time from which on the order of what was heard is another one (ns); None: it is the same."""


def image_of(imaging: Imaging, first: Ran, scene: Scene, names: Collection[str]) -> Image:
    """Run the image of a world."""
    if imaging.whole_world:
        return Image(scene.run(f'the image of {imaging!r}', args=imaging.args, later=imaging.start))
    hearings: list[_Hearing] = []

    def listen(world: Lockstep) -> Border:
        hearings.append(_Hearing(imaging, world, names))
        return Border(world, first.messages, names, hearings[0])

    ran = scene.run(f'the image of {imaging!r}', listen)
    (hearing,) = hearings
    if hearing.failed is not None:
        raise hearing.failed
    return Image(ran, hearing.changed, hearing.overtaken)


class _Hearing:
    """What the nodes under test hear in an image."""

    def __init__(self, imaging: Imaging, world: Lockstep, names: Collection[str]) -> None:
        self._imaging, self._world, self._names = imaging.in_world(world), world, names
        self.failed: LockstepError | None = None
        """Why an image could not be made. Not an error of the node that hears it."""
        self.changed = False
        """Whether anything was heard otherwise."""
        self.overtaken: int | None = None
        """World time at which a request or the end of a node overtook what is late (ns); None: never."""
        self._until: dict[Node, int] = {}
        self._services: set[str] = set()
        if imaging.keeps_order:
            world.on_new_topics(self._look)

    def __call__(self, link: Link, data: bytes) -> list[tuple[int, bytes]]:
        """Return what is heard instead of a message, with delays (ns)."""
        try:
            message = deserialize_message(data, link.message_type)
        except RuntimeError:
            # Bytes that are no message have no image.
            return [(0, data)]
        before = '' if self.changed else exact(message)
        try:
            heard = self._heard(link.topic, message)
            out = [(nanoseconds(delay), serialize_message(one)) for delay, one in heard]
        except LockstepError as error:
            self.failed = error
            raise
        if before:
            self.changed = [(0.0, before)] != [(delay, exact(one)) for delay, one in heard]
        if self._imaging.keeps_order:
            now = self._world.world_time
            out = [(max(delay, self._until.get(link.owner, 0) - now), one) for delay, one in out]
            self._until[link.owner] = now + max(delay for delay, _ in out)
        return out

    def _heard(self, topic: str, message: Any) -> list[tuple[float, Any]]:
        heard = image_made(self._imaging, topic, message, self._imaging.heard)
        pairs = heard if isinstance(heard, list) else [heard]
        for pair in pairs:
            if not (isinstance(pair, tuple) and len(pair) == 2 and _is_delay(pair[0])):
                raise LockstepError(
                    f'{self._imaging!r}: heard must return a list of pairs, each a delay (s), finite '
                    f'and not negative, and a message; got {described(heard)}'
                )
            check_image(self._imaging, topic, message, pair[1])
        return pairs

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


def _is_delay(value: Any) -> bool:
    return isinstance(value, (int, float)) and 0.0 <= value < math.inf


def image_made(imaging: Imaging, topic: str, message: Any, make: Callable[[str, Any], Any]) -> Any:
    """Return what a method of a relation makes of a message.

    Raises:
        LockstepError: It raises something.
    """
    try:
        return make(topic, message)
    except LockstepError:
        raise
    except Exception as error:
        raise LockstepError(f'{imaging!r}: image of a message of {topic}: {raised(error)}') from error


def check_image(imaging: Imaging, topic: str, message: Any, image: Any) -> None:
    """Raise LockstepError if an image is no message of the same type."""
    if type(image) is not type(message):
        raise LockstepError(
            f'{imaging!r}: the image of a message of {topic} must be a {type(message).__name__}, '
            f'got {described(image)}'
        )
