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

"""Running a scenario in several worlds, and keeping what was said in them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

from rclpy.serialization import deserialize_message

from diffdrive_jacobian.faults import Fault
from diffdrive_jacobian.lockstep._border import Endpoints, Message, Said
from diffdrive_jacobian.lockstep._pause import ends_all
from diffdrive_jacobian.lockstep.world import Lockstep

START = 1.0
"""What the clocks of the nodes show at the start of a world (s), as of `Lockstep`."""
Listen = Callable[[Lockstep], AbstractContextManager[Said]]
"""Returns what listens to a world while its scenario runs."""


@dataclass(frozen=True, kw_only=True)
class Ran:
    """What the nodes of a world have said."""

    messages: Sequence[Message]
    nodes: Mapping[str, Endpoints]
    namespace: str
    """Namespace of the world."""
    names: Mapping[str, str]
    """Full names of topics, by those that relations know."""
    end: int
    """World time at the end (ns)."""
    error: BaseException | None = None
    """What has ended the world; None: it came to its end."""

    @classmethod
    def of(
        cls, world: Lockstep, said: Said, topics: Iterable[str], error: BaseException | None = None
    ) -> Ran:
        """Return what was said in a world until now, for relations that know topics."""
        return cls(
            messages=said.messages,
            nodes=said.nodes,
            namespace=world.node.get_namespace(),
            names={topic: world.node.resolve_topic_name(topic) for topic in topics},
            end=world.world_time,
            error=error,
        )

    def full(self, topic: str) -> str:
        """Return the full name of a topic that a relation knows."""
        return self.names[topic]

    def publishers(self, topic: str) -> set[str]:
        """Return the full names of the nodes that publish a topic that a relation knows."""
        return {name for name, one in self.nodes.items() if self.names[topic] in one.published}

    def subscribers(self, topic: str) -> set[str]:
        """Return the full names of the nodes that are subscribed to a topic that a relation knows."""
        return {name for name, one in self.nodes.items() if self.names[topic] in one.subscribed}

    def period(self) -> int:
        """Return the least common multiple of the periods of all timers (ns); 1: there are none."""
        return math.lcm(*(period for one in self.nodes.values() for period in one.periods))


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A scenario with its case and its faults, which can be run in several worlds."""

    scenario: Callable[[Lockstep, Any], object]
    case: Any
    faults: Sequence[Fault] = ()
    seed: int = 0
    args: Sequence[str] = ()
    topics: tuple[str, ...] = ()
    """The topics that relations know."""
    pause_at: float | None = None
    """World time before which the world and its image stop in a debugger (s); None: they do not."""

    def run(
        self,
        what: str,
        listen: Listen = Said,
        *,
        args: Sequence[str] = (),
        later: float = 0.0,
        strict: bool = False,
    ) -> Ran:
        """Run it, and return what was said.

        Args:
            what: What the world is: 'the image'.
            listen: What listens to it.
            args: ROS arguments before those of the scene.
            later: How much later the clocks show at the start (s).
            strict: Whether a fault that meets nothing is an error.
        """
        with Lockstep([*args, *self.args], start=START + later) as world:
            if self.pause_at is not None:
                world.pauses.what = what
                world.pause_at(self.pause_at)
            world.inject(*self.faults, seed=self.seed)
            with listen(world) as said:
                try:
                    self.scenario(world, self.case)
                    world.settle()
                    if strict:
                        world.check_faults()
                except BaseException as error:
                    if ends_all(error):
                        raise
                    return Ran.of(world, said, self.topics, error)
                return Ran.of(world, said, self.topics)


def decoded(message: Message) -> Any:
    """Return a message as an object, or its bytes if they are no message."""
    try:
        return deserialize_message(message.data, message.type)
    except RuntimeError:
        return message.data
