"""Faults of nodes, services and the clock."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any

from rclpy.exceptions import ParameterUninitializedException
from rclpy.node import Node
from rclpy.parameter import Parameter

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._fault_log import in_seconds
from diffdrive_jacobian.lockstep._gates import Change, Gate, ResponseDelay
from diffdrive_jacobian.lockstep._injection_base import InjectionBase, full_name
from diffdrive_jacobian.ros.rclpy_internals import PARAMETERS_OF_RCLPY, declared_parameters


class NodeInjection(InjectionBase):
    """Holds at gates, deaths, changes of nodes, of parameters and of the clock."""

    _meet: Callable[[], None] | None = None

    def look(self) -> None:
        """Check whether there is anything that the fault affects, and change new nodes."""
        super().look()
        if self._meet is not None:
            self._meet()

    def _gate(self, node: str) -> Gate:
        """Return the gate of a node, which is expected to be there some time."""
        name = full_name(node, self._world.node)
        if name == self._world.node.get_fully_qualified_name():
            raise LockstepError(f'{self.fault!r} names the node of the test itself')
        self._expect(
            f'no node {name} was seen',
            lambda nodes: any(one.get_fully_qualified_name() == name for one in nodes),
        )
        return self._world.gate(name)

    def hold(self, node: str) -> None:
        """Freeze a node."""
        gate = self._gate(node)

        def release() -> None:
            waiting = len(gate.waiting)
            self.note(f'{waiting} messages and requests wait{_lost(gate)}')
            gate.release()

        self.at_start(gate.hold)
        self.at_end(release)

    def slow(self, node: str, duration: int) -> None:
        """Set the duration of each callback of a node (ns)."""
        gate = self._gate(node)

        def end() -> None:
            gate.costs.remove(duration)
            if text := _lost(gate):
                self.note(text.removeprefix(', '))

        self.at_start(lambda: gate.costs.append(duration))
        self.at_end(end)

    def delay_timers(self, node: str, draw: Callable[[], int]) -> None:
        """Delay each tick of the timers of a node by a time that a function returns (ns)."""
        gate = self._gate(node)
        self.at_start(lambda: gate.timer_delays.append(draw))
        self.at_end(lambda: gate.timer_delays.remove(draw))

    # --- Death

    def kill(self, node: str) -> None:
        """Destroy a node when the fault begins, and make it again when it ends."""
        gate, world, name = self._gate(node), self._world, full_name(node, self._world.node)

        def die() -> None:
            gate.deaths += 1
            victim = world.find(name)
            if victim is None:
                self.note('the node is not there')
                return
            if math.isfinite(self.fault.duration) and not world.restartable(name):
                raise LockstepError(
                    f'{self.fault!r} cannot start {name} again: create it with Lockstep.create'
                )
            world.executor.kill(victim)
            self.note(f'{name} is killed')

        def rise() -> None:
            gate.deaths -= 1
            # One that was created after the fault began was not killed.
            if gate.deaths == 0 and world.restartable(name) and world.find(name) is None:
                world.restart(name)
                self.note(f'{name} is started again')

        self.at_start(die)
        self.at_end(rise)

    # --- Changes of a node

    def change_node(self, node: str, begin: Callable[[Node], None], end: Callable[[Node], None]) -> None:
        """Change the node of a name while the fault lasts, also one that is added later.

        Args:
            node: Name of the node.
            begin: Called with the node when the fault begins, or when the node is added.
            end: Called with it when the fault ends, if it is still there.
        """
        gate = self._gate(node)
        changed: Node | None = None

        def meet() -> None:
            nonlocal changed
            found = self._world.find(gate.name) if self.active else None
            if found is not None and found is not changed:
                changed = found
                begin(found)

        def leave() -> None:
            if changed is not None and changed is self._world.find(gate.name):
                end(changed)

        self._meet = meet
        self.at_start(meet)
        self.at_end(leave)

    # --- Parameters

    def change_parameter(self, node: str, name: str, value: Any) -> None:
        """Change a parameter of a node when the fault begins, and back when it ends.

        While a later change of it lasts, that one remains, and at its end the value is as before both.
        """
        gate = self._gate(node)
        changed: list[Change] = []
        value = list(value) if isinstance(value, tuple) else value

        def change() -> None:
            target = self._world.find(gate.name)
            if target is None:
                self.note('the node is not there')
            else:
                gate.enter(self, 'parameters', None, lambda: set_value(target))

        def set_value(target: Node) -> None:
            before = self._set(target, name, value)
            if before is not None:
                changed.append(Change(target, name, before))
                gate.changes.extend(changed)

        def change_back() -> None:
            target = self._world.find(gate.name)
            if target is not None:
                # A frozen node may not have processed the change yet.
                gate.enter(self, 'parameters', None, lambda: set_back(target))

        def set_back(target: Node) -> None:
            for one in changed:
                later = [
                    other
                    for other in gate.changes[gate.changes.index(one) + 1 :]
                    if (other.node, other.name) == (one.node, name)
                ]
                gate.changes.remove(one)
                if later:
                    later[0].before = one.before
                elif one.node is target:
                    self._set(target, name, one.before)

        self.at_start(change)
        self.at_end(change_back)

    def _set(self, node: Node, name: str, value: Any) -> Any:
        """Set a parameter. Return its value before; None: the node refused it, or it had none."""
        if not node.has_parameter(name):
            declared = sorted(declared_parameters(node))
            known = ', '.join(one for one in declared if not one.startswith(PARAMETERS_OF_RCLPY))
            raise LockstepError(
                f'{self.fault!r}: {node.get_fully_qualified_name()} has no parameter {name!r}; '
                f'it has {known or "none"}'
            )
        before = None
        with suppress(ParameterUninitializedException):
            before = node.get_parameter(name).value
        result = node.set_parameters_atomically([Parameter(name, value=value)])
        if not result.successful:
            self.note(f'{name} = {value!r} is refused: {result.reason}')
            return None
        self.note(f'{name} is {value!r}, was {before!r}')
        return before

    # --- Services

    def delay_responses(self, service: str, late: int | None) -> None:
        """Delay the responses of a service by a time (ns); None: they are never sent."""
        name = self._world.node.resolve_service_name(service)

        def look(nodes: Iterable[Node]) -> bool:
            return any(one.service_name == name for node in nodes for one in node.services)

        self._expect(f'no service {name} was seen', look)
        gates = self._world.keeper.gates
        delays = ResponseDelay(name, late, lambda: self.note(_held(late)))
        self.at_start(lambda: gates.response_delays.append(delays))
        self.at_end(lambda: gates.response_delays.remove(delays))

    # --- Clock

    def jump(self, duration: int) -> None:
        """Shift the clock by a time (ns) when the fault begins, and back when it ends."""
        done: list[int] = []

        def there() -> None:
            done.append(self._world.shift_clock(duration))
            self.note(f'the clock has jumped by {in_seconds(done[0])}')

        def back() -> None:
            self.note(f'the clock has jumped by {in_seconds(self._world.shift_clock(-done[0]))}')

        self.at_start(there)
        self.at_end(back)

    def pause_clock(self) -> None:
        """Stop the clock during the fault."""
        executor = self._world.executor

        def pause() -> None:
            executor.clock_pauses += 1

        def go_on() -> None:
            executor.clock_pauses -= 1

        self.at_start(pause)
        self.at_end(go_on)


def _lost(gate: Gate) -> str:
    """Return what was lost from full queues, and forget it."""
    texts = [f'{count} of {name}' for name, count in sorted(gate.lost.items())]
    gate.lost.clear()
    return f', lost from full queues: {", ".join(texts)}' if texts else ''


def _held(late: int | None) -> str:
    return 'a response is never sent' if late is None else f'a response is {in_seconds(late)} late'
