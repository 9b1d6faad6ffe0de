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

"""Faults of nodes, and of the world around them: clock, services, and who changes parameters.

The name of a node without a slash at the beginning is taken to be in the namespace of the test, which is
`/` by default.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from rclpy.exceptions import ParameterUninitializedException
from rclpy.node import Node
from rclpy.parameter import Parameter

from diffdrive_jacobian.faults.fault import Fault, RosName, Undo
from diffdrive_jacobian.lockstep._clock import MAX_SECONDS
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._injection import Injection
from diffdrive_jacobian.numerics.checks import Name, Positive, PositiveOrInfinite, between
from diffdrive_jacobian.ros.rclpy_internals import PARAMETERS_OF_RCLPY, declared_parameters
from diffdrive_jacobian.time_units import in_seconds, nanoseconds


@dataclass(frozen=True, repr=False)
class NodeFault(Fault):
    """A fault of one node, by its name."""

    node: Name

    @property
    def affected_node(self) -> str:
        """Name of the node."""
        return self.node


@dataclass(frozen=True, repr=False)
class Kill(NodeFault):
    """The node is killed, as by SIGKILL: it stops without a last message, and what waits for it is lost.

    After `duration` the factory that made it (`Lockstep.create`) makes it again, with a fresh state.
    Without a duration it stays away. Others notice by the graph, and by its silence. What it published
    last is still under way; its latched messages are gone.
    """

    def install(self, injection: Injection) -> None:
        """Destroy the node when the fault begins, and create it again when it ends."""
        world, name = injection.world, injection.gate(self.node).name
        # The faults because of which the node is not there.
        deaths = world.shared[f'deaths of {name}']
        victims = world.shared[f'victims of the name {name}']

        def die() -> Undo:
            deaths.append(self)
            victim = world.find(name)
            if victim is None:
                injection.note('the node is not there')
                return rise
            if math.isfinite(self.duration) and not world.restartable(name):
                raise LockstepError(
                    f'{self!r} cannot start {name} again: create it with Lockstep.create'
                )
            world.kill(victim)
            victims.append(self)
            injection.note(f'{name} is killed')
            return rise

        def rise() -> None:
            deaths.remove(self)
            # One that was created after the fault began was not killed, nor one that was not there.
            if victims and not deaths and world.restartable(name) and world.find(name) is None:
                victims.clear()
                world.restart(name)
                injection.note(f'{name} is started again')

        injection.during(die)


@dataclass(frozen=True, repr=False)
class Hang(NodeFault):
    """The node is frozen, as between SIGSTOP and SIGCONT: none of its callbacks is executed.

    Messages and requests that arrive wait in its queues, of which a full one loses the oldest. When it
    continues, it processes what waits, in the order of arrival. A timer that expired meanwhile ticks
    once, and skips the other periods.
    """

    def install(self, injection: Injection) -> None:
        """Delay the callbacks of the node until the fault ends."""
        gate = injection.gate(self.node)

        def freeze() -> Undo:
            gate.hold()
            return thaw

        def thaw() -> None:
            what = [f'{len(gate.waiting)} messages and requests wait', gate.lost()]
            injection.note(', '.join(filter(None, what)))
            gate.release()

        injection.during(freeze)

    def reaction_delay(self, node: Node, since: float, now: float) -> float:
        """Return for how long the node was frozen (s)."""
        return max(self.overlap(since, now), 0.0)


@dataclass(frozen=True, repr=False)
class Slow(NodeFault):
    """Each callback of the node takes `seconds` of simulated time.

    What it publishes or responds leaves that long after it began. Until then the node is busy: what
    arrives waits in its queues, of which a full one loses the oldest. Then comes whatever has waited
    longest, a message, a request or a timer. The callback reads the clock of its beginning. Its requests
    to services leave at once, and what a coroutine does after its first `await` takes no time. The same
    holds for timers on wall time.
    """

    seconds: Positive

    def install(self, injection: Injection) -> None:
        """Set the duration of the callbacks."""
        gate, cost = injection.gate(self.node), nanoseconds(self.seconds)

        def slow() -> Undo:
            gate.slow(cost)
            return quicken

        def quicken() -> None:
            gate.quicken(cost)
            if lost := gate.lost():
                injection.note(lost)

        injection.during(slow)

    @property
    def longest_delay(self) -> float:
        """Duration of a callback (s)."""
        return self.seconds

    def reaction_delay(self, node: Node, since: float, now: float) -> float:
        """Return the duration of the callbacks that may come first (s).

        One that has begun, others that wait, and that of the timer, which may expire early.
        """
        longest = (3.0 + len(list(node.timers))) * self.seconds
        return longest if self.overlap(since, now) > -longest else 0.0


@dataclass(frozen=True, repr=False)
class TimerJitter(NodeFault):
    """Each tick of the node's timers comes late, by up to `seconds`, uniformly distributed.

    The ticks after it are not shifted. A tick that is more than a period late replaces those between.
    """

    seconds: Positive

    def install(self, injection: Injection) -> None:
        """Delay the ticks of the timers."""
        rng, delays = injection.rng(self.node), injection.gate(self.node).timer_delays

        def draw() -> int:
            return nanoseconds(self.seconds * rng.random())

        def begin() -> Undo:
            delays.append(draw)
            return lambda: delays.remove(draw)

        injection.during(begin)

    @property
    def longest_delay(self) -> float:
        """Longest delay of a tick (s)."""
        return self.seconds

    def reaction_delay(self, node: Node, since: float, now: float) -> float:
        """Return the longest delay of a tick (s)."""
        return self.seconds if self.overlap(since, now) > -self.seconds else 0.0


def _jump(name: str, value: Any) -> float:
    """Require a number of seconds that is not zero in nanoseconds, and that a stamp can represent."""
    seconds = between(-MAX_SECONDS, MAX_SECONDS)(name, value)
    if nanoseconds(seconds) == 0:
        raise ValueError(f'{name} must not be zero, got {seconds!r}')
    return seconds


def _parameter_value(name: str, value: Any) -> Any:
    """Require a value that a parameter of ROS can have. Returns a list as a tuple."""
    elements = value if isinstance(value, (list, tuple)) else [value]
    if not any(all(type(element) is kind for element in elements) for kind in (bool, int, float, str)):
        raise ValueError(
            f'{name} must be a bool, int, float, str, or a list of one of them, got {value!r}'
        )
    return tuple(value) if isinstance(value, list) else value


@dataclass(frozen=True, repr=False)
class TimeJump(Fault):
    """The clock of all nodes jumps, forward or back, as when a simulator is reset.

    After `duration` it jumps back by as much. The new time is between 1 ns and 2147483647 s, as a
    stamp can represent, where it stays if it should go further. rcl determines how timers react: one
    whose time lies before the new time ticks once.

    Attributes:
        seconds: Length of the jump (s), negative: back.
    """

    seconds: Annotated[float, _jump]

    at_once: ClassVar[bool] = True

    def install(self, injection: Injection) -> None:
        """Shift the clock when the fault begins, and back when it ends."""

        def jump(duration: int) -> int:
            done = injection.world.shift_clock(duration)
            injection.note(f'the clock has jumped by {in_seconds(done)}')
            return done

        def begin() -> Undo:
            done = jump(nanoseconds(self.seconds))

            def back() -> None:
                jump(-done)

            return back

        injection.during(begin)

    @property
    def clock_jumps(self) -> tuple[float, ...]:
        """World times at which it begins and ends (s)."""
        return self.start, self.start + self.duration


@dataclass(frozen=True, repr=False)
class ClockPause(Fault):
    """The clock of all nodes stands still, as when a simulator is paused, then goes on from there.

    No timer expires. Messages that are under way still arrive.
    """

    def install(self, injection: Injection) -> None:
        """Stop the clock during the fault."""
        injection.during(injection.world.pause_clock)


@dataclass(frozen=True, repr=False)
class LateService(Fault):
    """A service responds late, or never. Its callback is executed in time.

    Attributes:
        service: Name of the service, resolved as by `Lockstep.call`.
        seconds: Delay of each response (s); infinite: it is never sent.
    """

    service: RosName
    seconds: PositiveOrInfinite

    def install(self, injection: Injection) -> None:
        """Delay the responses of the service."""
        world = injection.world
        name = world.node.resolve_service_name(self.service)
        late = nanoseconds(self.seconds) if math.isfinite(self.seconds) else None
        held = 'a response is never sent' if late is None else f'a response is {in_seconds(late)} late'

        def is_there(nodes: Iterable[Node]) -> bool:
            return any(one.service_name == name for node in nodes for one in node.services)

        injection.expect(f'no service {name} was seen', is_there)
        injection.during(lambda: world.delay_responses(name, late, lambda: injection.note(held)))

    @property
    def longest_delay(self) -> float:
        """Delay of a response (s); 0: it is never sent."""
        return self.seconds if math.isfinite(self.seconds) else 0.0


@dataclass(frozen=True, repr=False)
class ParameterChange(NodeFault):
    """Somebody changes a parameter of a node, and changes it back after `duration`.

    If another change of it began meanwhile and still lasts, that one remains until its own end, and the
    value is then as before both. That the node refuses the value is noted in the events. It is an error
    if it has no such parameter.

    Attributes:
        name: Name of the parameter.
        value: The new value: bool, int, float, str, or a list of one of them.
    """

    name: Name
    value: Annotated[Any, _parameter_value]

    def install(self, injection: Injection) -> None:
        """Change the parameter when the fault begins, and back when it ends."""
        gate, world = injection.gate(self.node), injection.world
        # The parameters that are changed now, the earliest change first.
        changes: list[_Change] = world.shared[f'parameters of {gate.name}']
        own: list[_Change] = []

        def begin() -> Undo:
            target = world.find(gate.name)
            if target is None:
                injection.note('the node is not there')
            else:
                gate.enter(self, 'parameters', lambda: change(target))
            return end

        def change(target: Node) -> None:
            before = self._set(injection, target, self.value)
            if before is not None:
                own.append(_Change(target, self.name, before))
                changes.extend(own)

        def end() -> None:
            target = world.find(gate.name)
            if target is not None:
                # A frozen node may not have processed the change yet.
                gate.enter(self, 'parameters', lambda: change_back(target))

        def change_back(target: Node) -> None:
            for one in own:
                later = [
                    other
                    for other in changes[changes.index(one) + 1 :]
                    if (other.node, other.name) == (one.node, self.name)
                ]
                changes.remove(one)
                if later:
                    later[0].before = one.before
                elif one.node is target:
                    self._set(injection, target, one.before)

        injection.during(begin)

    def _set(self, injection: Injection, node: Node, value: Any) -> Any:
        """Return the value before it was set; None: it is refused, or there was none."""
        if not node.has_parameter(self.name):
            declared = sorted(declared_parameters(node))
            known = ', '.join(one for one in declared if not one.startswith(PARAMETERS_OF_RCLPY))
            raise LockstepError(
                f'{self!r}: {node.get_fully_qualified_name()} has no parameter {self.name!r}; '
                f'it has {known or "none"}'
            )
        value = list(value) if isinstance(value, tuple) else value
        before = None
        with suppress(ParameterUninitializedException):
            before = node.get_parameter(self.name).value
        result = node.set_parameters_atomically([Parameter(self.name, value=value)])
        if not result.successful:
            injection.note(f'{self.name} = {value!r} is refused: {result.reason}')
            return None
        injection.note(f'{self.name} is {value!r}, was {before!r}')
        return before


@dataclass(eq=False)
class _Change:
    """A parameter that a fault has changed."""

    node: Node
    name: str
    before: Any
    """Value before the change."""
