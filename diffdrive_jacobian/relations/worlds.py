"""Running a scenario in several worlds, and keeping what was said in them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, NamedTuple

from rclpy.serialization import deserialize_message

from diffdrive_jacobian.faults import Fault
from diffdrive_jacobian.lockstep._border import Endpoints, Message, Said
from diffdrive_jacobian.lockstep._pause import ends_all
from diffdrive_jacobian.lockstep.world import Lockstep

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
    debugged: bool = False
    """Whether somebody looks into the worlds."""

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
            self.on_world(world, what)
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
                    return Ran.of(world, said, error)
                return Ran.of(world, said)


def decoded(message: Message) -> Any:
    """Return a message as an object, or its bytes if they are no message."""
    try:
        return deserialize_message(message.data, message.type)
    except RuntimeError:
        return message.data
