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

"""Which callback comes next: the scheduler detects when all work is done, and does it in a fixed order.

Messages are taken from the links in the order in which they were published. Requests and responses of
services, actions and events of QoS come through the EventsExecutor of rclpy, services in their place
among the messages. Timers are called one by one, the most overdue first, each after all messages are
processed: the EventsExecutor would call them from a second thread, at times and in an order that vary.
"""

from __future__ import annotations

import inspect
import math
import threading
import warnings
import weakref
from collections.abc import Callable
from typing import Any

from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.event_handler import EventHandler
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.timer import Timer

from diffdrive_jacobian.lockstep._clock import Agenda, Clocks, Timers, is_due
from diffdrive_jacobian.lockstep._errors import LockstepError, one_type_per_topic
from diffdrive_jacobian.lockstep._gate import Gate, Gates
from diffdrive_jacobian.lockstep._link import is_latched
from diffdrive_jacobian.lockstep._links import Links, SentElsewhere
from diffdrive_jacobian.lockstep._services import Member, Responses, check_holdable
from diffdrive_jacobian.lockstep._tasks import Tasks
from diffdrive_jacobian.lockstep._wall_time import Qualities
from diffdrive_jacobian.messages.names import type_name
from diffdrive_jacobian.messages.topics import NOT_OF_ROBOTS
from diffdrive_jacobian.ros.rclpy_internals import (
    SERVICES_OF_RCLPY,
    TimerHandle,
    events_executor,
    on_new_node,
    replaced,
    wrap_calls,
)

__tracebackhide__ = True

LATCHED_PATIENCE = Duration(seconds=5.0)
"""Longest time for a latched message to reach a later subscription (s). It takes microseconds."""


class Scheduler:
    """Executes the callbacks of nodes until none is left at the current simulated time."""

    def __init__(self, context: Context, start: int) -> None:
        """Start without nodes.

        Args:
            context: The context of the nodes.
            start: What their clocks show at the start (ns).

        Raises:
            LockstepError: This rclpy has no EventsExecutor.
        """
        events: Any = events_executor(context)
        if events is None:
            raise LockstepError(
                'lockstep needs the EventsExecutor of rclpy, which this ROS installation does not have'
            )
        self._events = events
        self.registered: Callable[[Node], None] = lambda _: None
        """Called with each node when it is new or has created or destroyed an entity."""
        self._members: dict[Node, Member] = {}
        self._changed = False
        self._has_actions = False
        self._has_events = False
        self.killed: set[Node] = set()
        """The nodes that were removed without being stopped."""
        self.agenda = Agenda()
        """What happens at later times."""
        self.clocks = Clocks(start)
        self.timers = Timers()
        self.tasks = Tasks()
        self._qualities = Qualities()
        self.gates = Gates(self.agenda)
        self.gates.changed = self._on_gate
        self.links = Links(self.agenda, self.gates, self.clocks)
        self.responses = Responses(self.agenda)
        self._restore_calls = wrap_calls(self._noting)
        self._context = context
        self._created: list[weakref.ref[Node]] = []
        self._missing: weakref.WeakSet[Node] = weakref.WeakSet()
        self._restore_nodes = on_new_node(self._note_node)
        self._restore_topics = replaced(
            one_type_per_topic, (Node, 'create_publisher'), (Node, 'create_subscription')
        )
        self.links.start(self.note_thread)

    def _noting(self, send: Callable[..., Any]) -> Callable[..., Any]:
        """Return a method that sends a request or a response, and takes its place among the messages."""
        links, pending = self.links, self.links.pending

        def sent(entity: Any, *args: Any, **kwargs: Any) -> Any:
            if threading.get_ident() != links.thread:
                self.note_thread(entity, f'calls or answers {entity.service_name}')
            result = send(entity, *args, **kwargs)
            pending.append(None)
            return result

        return sent

    def note_thread(self, entity: Any, does: str, *, heard: bool = True) -> None:
        """Note what a publisher, client or service sends from this thread, another one.

        The thread may destroy the entity afterwards.

        Args:
            entity: The publisher, client or service.
            does: What it does: 'publishes /cmd_vel'.
            heard: Whether it matters if the node was not added.
        """
        for node in self.existing:
            if any(one is entity for one in (*node.publishers, *node.clients, *node.services)):
                added = node in self._members
                if added or heard:
                    what = f'node {node.get_fully_qualified_name()} {does}'
                    sent = SentElsewhere(node, added, what, threading.current_thread().name)
                    self.links.elsewhere[entity] = sent

    # --- Nodes

    def _note_node(self, node: Node) -> None:
        if node.context is self._context:
            self._created.append(weakref.ref(node))

    @property
    def existing(self) -> list[Node]:
        """The nodes of the context that were not destroyed, added or not."""
        nodes = [created() for created in self._created]
        return [node for node in nodes if node is not None and not _is_destroyed(node)]

    def warn_of_missing(self) -> None:
        """Warn of nodes that have something to do, and were created but not added."""
        for node in self.existing:
            if node in self._members or node in self._missing:
                continue
            topics = [
                one.topic_name for one in node.subscriptions if one.topic_name not in NOT_OF_ROBOTS
            ]
            services = [
                one.srv_name
                for one in node.services
                if not type_name(one.srv_type).startswith(SERVICES_OF_RCLPY)
            ]
            if topics or services or list(node.timers):
                self._missing.add(node)
                warnings.warn(
                    f'node {node.get_fully_qualified_name()} was created, but not added: none of its '
                    'callbacks is called; lockstep.add(node) adds it',
                    stacklevel=2,
                )

    @property
    def nodes(self) -> list[Node]:
        """The nodes, in the order in which they were added."""
        return list(self._members)

    def add(self, node: Node) -> None:
        """Add a node."""
        gate = self.gates.of(node.get_fully_qualified_name())
        member = Member(node, gate, self.tasks, self._note_change, self.responses)
        self._members[node] = member
        if gate.closed:
            check_holdable(member.node)
        node.executor = member.facade
        self._events.add_node(member)
        self.clocks.find(self._members)
        self._changed = True

    def remove(self, node: Node) -> None:
        """Remove a node, after it has processed what was sent to it."""
        self.settle()
        if node in self._members:
            # Otherwise it was destroyed before.
            self._forget(node)
        self._note_change()
        self.settle()

    def kill(self, node: Node) -> None:
        """Remove and destroy a node at once. Nothing that was sent to it is processed."""
        self.killed.add(node)
        self._forget(node)
        node.destroy_node()
        self._note_change()

    def forget_destroyed(self) -> None:
        """Forget the nodes that were destroyed."""
        for node in [node for node in self._members if _is_destroyed(node)]:
            self._forget(node)

    def _forget(self, node: Node) -> None:
        member = self._members.pop(node)
        self.tasks.cancel(node)
        member.gate.reset()
        member.release()
        self._events.remove_node(member)

    def close(self) -> None:
        """Remove all nodes and shut down."""
        self._restore_calls()
        self._restore_nodes()
        self._restore_topics()
        self.tasks.cancel()
        for member in self._members.values():
            member.release()
        self._members.clear()
        # So that the subscriptions can be destroyed.
        self.links.update(())
        self._events.shutdown()

    # --- Work

    def settle(self) -> float:
        """Execute all callbacks that are due at the current time, and all that they cause.

        Returns:
            Time until the next timer in simulated time expires, or the next action is due (ns);
            infinity: there is none.
        """
        self.handle_all()
        return self._call_timers()[1]

    def catch_up(self) -> float:
        """Settle, after little or nothing was done since the last time.

        It takes a tenth of the time of `settle` if no message or request was sent, no task or entity was
        created, and no timer is due.
        """
        if not self._has_work():
            due, until_next = self.timers.due()
            if not due:
                return self._sooner(until_next)
        return self.settle()

    def advance(self) -> float:
        """Set the clocks of the nodes to the present time, and settle."""
        if not self.clocks.pauses:
            self.clocks.set()
        if not self._has_work():
            called, until_next = self._call_timers()
            if called:
                return until_next
        return self.settle()

    def _has_work(self) -> bool:
        """Return whether anything waits to be executed, or may wait without having been noticed."""
        return bool(self.links.pending or self._changed or self.tasks.waiting or self._has_actions)

    def _sooner(self, until_next: float) -> float:
        """Return the time until the next timer or action (ns); infinity: there is none."""
        if self.clocks.pauses:
            until_next = math.inf
        # The minimum of integers is exact, also beside infinity.
        return min(until_next, self.agenda.next - self.agenda.now)

    def _call_timers(self) -> tuple[bool, float]:
        """Execute the actions and the timers that are due, and all callbacks that they cause.

        Returns:
            Whether there were any, and the time until the next timer expires, as of `settle`.
        """
        called, agenda = False, self.agenda
        while True:
            while agenda.next <= agenda.now:
                called = True
                agenda.pop()()
                self.handle_all()
            # Once at each time is enough for those on wall time.
            due, until_next = self.timers.due(wall=not called)
            if not due:
                return called, self._sooner(until_next)
            for _, (handle, timer, node) in due:
                # The callback of one may have cancelled the next.
                if (len(due) == 1 or is_due(handle)) and self._tick(handle, timer, node):
                    called = True
                    self.handle_all(after_callback=True)

    def handle_all(self, *, after_callback: bool = False) -> None:
        """Process messages, service calls and tasks until none is left that can continue.

        Args:
            after_callback: Whether nothing but a callback was executed since the last call. What it has
                sent is known.
        """
        events = not after_callback or self._has_events
        while True:
            self._drain(events)
            if self._changed:
                self._register_changed()
                # A new client or service may already have been called.
                events = True
            elif not (self.tasks.waiting and self.tasks.run()):
                return

    def _drain(self, events: bool = True) -> None:
        """Process messages and events until none is left.

        Args:
            events: Whether the EventsExecutor may have events although no request or response was sent.
        """
        links, pending = self.links, self.links.pending
        take = pending.popleft
        while True:
            while pending:
                if (link := take()) is None:
                    self._handle_events()
                    events = True
                else:
                    link.deliver()
            if not ((events and self._handle_events()) or pending or (links.polled and links.poll())):
                return

    def _handle_events(self) -> bool:
        """Process events that the EventsExecutor has queued. Return whether there were any.

        A task runs after all events that were queued before it. If it is the first event, the queue was
        empty.
        """
        spin_once = self._events.spin_once
        done, events = self._events.create_task(_nothing).done, 0
        while not done():
            spin_once()
            events += 1
        return events > 1

    # --- Timers and gates

    def _tick(self, handle: TimerHandle, timer: Timer, node: Node) -> bool:
        """Call the callback of a timer that is due, if the gate of its node lets it tick now.

        Return whether it was called. That of a timer on wall time takes no simulated time, because
        nobody knows when it comes.
        """
        member = self._members[node]
        gate, simulated = member.gate, timer in self.timers.simulated
        if not gate.free or gate.timer_delays or gate.delayed:
            may_tick = gate.may_tick(timer) if simulated else not gate.closed
            if not may_tick:
                return False
        handle.call_timer()
        result = gate.run(timer.callback) if gate.costs and simulated else timer.callback()
        if result is not None and inspect.iscoroutine(result):
            member.create_task(result)
        return True

    def _update_timers(self) -> None:
        """Find the timers that may tick."""
        self.timers.update(
            (timer, node)
            for node, member in self._members.items()
            if not member.gate.closed
            for timer in node.timers
            if timer not in member.gate.suspended
        )

    def _on_gate(self, gate: Gate) -> None:
        """Continue what was held back by a gate that has opened."""
        self._update_timers()
        member = next((member for member in self._members.values() if member.gate is gate), None)
        if member is None:
            return
        if gate.closed:
            check_holdable(member.node)
            return
        while gate.waiting and not gate.closed:
            self.handle_all()
            self._serve(gate, member.node)

    def _serve(self, gate: Gate, node: Node) -> None:
        """Execute what has waited longest: a message or request, or a timer of a node that is slow."""
        entry = self.timers.most_overdue(node) if gate.costs else None
        if entry is not None and self.agenda.now - entry[0] < gate.waiting[0].since:
            _, handle, timer = entry
            self._tick(handle, timer, node)
        else:
            gate.serve_next()

    # --- Entities

    def _note_change(self) -> None:
        """Note that a node has created or destroyed an entity.

        New ones are registered when all is processed that waits. Destroyed ones receive nothing more.
        """
        self._changed = True
        self.links.drop_destroyed(self._members)

    def _register_changed(self) -> None:
        """Register what the nodes have created or destroyed, again if that fails."""
        self._changed = False
        try:
            self._register()
        except BaseException:
            self._changed = True
            raise

    def _register(self) -> None:
        """Register entities that the nodes have created since the last call, and forget destroyed ones.

        Another thread delivers latched messages to later subscriptions. This waits for them, and
        processes those of one topic before those of the next, which fixes their order.
        """
        self.forget_destroyed()
        for node, member in self._members.items():
            if list(node.guards):
                raise LockstepError(
                    f'node {node.get_fully_qualified_name()} has a guard condition, which lockstep does '
                    'not support: any thread can trigger it, at any time; use a timer or a topic'
                )
            for publisher in node.publishers:
                if is_latched(publisher):
                    publisher.wait_for_all_acked(LATCHED_PATIENCE)
            self._qualities.check(node)
            member.update()
            self.registered(node)
        self._events.wake()
        # The registration itself does not count as an event.
        self._handle_events()
        new = self.links.update(
            self._members.values(),
            self.clocks.find(self._members),
            [publisher for node in self.existing for publisher in node.publishers],
        )
        # Messages that a subscription has received before.
        for link in sorted(new, key=lambda link: link.latched):
            self.links.admit(link)
            self._drain()
        # Actions, or a user's own entities. Who sends them something is not known.
        waitables = [waitable for node in self._members for waitable in node.waitables]
        self._has_actions = any(not isinstance(waitable, EventHandler) for waitable in waitables)
        self._has_events = not all(map(_is_of_discovery, waitables))
        self._update_timers()


def _nothing() -> None:
    """Do nothing, as a task."""


def _is_of_discovery(waitable: Any) -> bool:
    """Return whether a waitable has events only when a publisher or subscription is created.

    Those of rclpy itself, which report that two do not match.
    """
    return isinstance(waitable, EventHandler) and 'INCOMPATIBLE' in waitable.event_type.name


def _is_destroyed(node: Node) -> bool:
    try:
        node.get_fully_qualified_name()
    except InvalidHandle:
        return True
    return False
