"""The keeper of the gates: decides what of a node is executed while it is frozen, busy or delayed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rclpy.event_handler import EventHandler
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.timer import Timer

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._gated_reader import GatedReader
from diffdrive_jacobian.lockstep._gates import Gate, Gates

if TYPE_CHECKING:
    from diffdrive_jacobian.lockstep._executor import QuiescentExecutor
    from diffdrive_jacobian.lockstep._served import Served


class Keeper:
    """Keeps the gates of the nodes of an executor."""

    def __init__(self, executor: QuiescentExecutor) -> None:
        """Start with open gates."""
        self._executor = executor
        self.gates = Gates(executor.agenda, self._on_change)
        self._by_node: dict[Node, Gate] = {}

    def gate(self, node: Node) -> Gate:
        """Return the gate of a node."""
        return self._by_node[node]

    def admit(self, served: Served) -> None:
        """Create the gate of a node."""
        gate = self.gates.of(served.node.get_fully_qualified_name())
        served.gate, served.gates = gate, self.gates
        self._by_node[served.node] = gate
        if gate.closed:
            check_holdable(served.node)

    def dismiss(self, node: Node) -> None:
        """Forget a node that was removed, and what waits for it."""
        self._by_node.pop(node).reset()

    def reader(self, subscription: Subscription, node: Node) -> GatedReader:
        """Return the reader of a subscription."""
        executor = self._executor
        return GatedReader(
            subscription,
            node,
            self.gate(node),
            executor.task_creator(node),
            executor.agenda,
            executor.deliveries.pending,
        )

    def closed(self, node: Node) -> bool:
        """Return whether no callback of a node is executed, which may have been removed."""
        gate = self._by_node.get(node)
        return gate is not None and gate.closed

    def run(self, node: Node, timer: Timer) -> Any:
        """Call the callback of a timer of a node. Return its result.

        That of a timer on wall time takes no simulated time, because nobody knows when it comes.
        """
        gate = self.gate(node)
        simulated = self._executor.timers.is_simulated(timer)
        return gate.run(timer.callback) if simulated else timer.callback()

    def may_tick(self, node: Node, timer: Timer) -> bool:
        """Return whether a timer that is due ticks now. Otherwise it does later."""
        gate = self.gate(node)
        if self._executor.timers.is_simulated(timer):
            return self.gates.may_tick(gate, timer)
        return not gate.closed

    def update_timers(self) -> None:
        """Find the timers that may tick."""
        nodes = [node for node in self._executor.nodes if not self.closed(node)]
        self._executor.timers.update(nodes, self.gates.suspended)

    def _on_change(self, gate: Gate) -> None:
        """Continue what was held back by a gate that has opened."""
        self.update_timers()
        node = next((node for node in self._executor.nodes if self.gate(node) is gate), None)
        if node is None:
            return
        if gate.closed:
            check_holdable(node)
            return
        while gate.waiting and not gate.closed:
            self._executor.handle_all()
            self._serve(gate, node)

    def _serve(self, gate: Gate, node: Node) -> None:
        """Execute what has waited longest: a message or request, or a timer of a node that is slow."""
        timers, agenda = self._executor.timers, self._executor.agenda
        entry = timers.most_overdue(node) if gate.costs else None
        if entry is not None and agenda.now - entry[0] < gate.waiting[0].since:
            _, handle, timer = entry
            if self.may_tick(node, timer):
                self._executor.call_timer(handle, timer, node)
        else:
            gate.serve_next()


def check_holdable(node: Node) -> None:
    """Raise LockstepError if a node has callbacks that cannot be held back."""
    if any(not isinstance(waitable, EventHandler) for waitable in node.waitables):
        name = node.get_fully_qualified_name()
        raise LockstepError(f'{name} has an action, which cannot be frozen or slow in lockstep')
