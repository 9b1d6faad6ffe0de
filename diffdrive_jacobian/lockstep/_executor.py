"""An executor that detects when all work is done, and does it in a reproducible order.

Messages are taken from the subscriptions in the order in which they were published. Requests and
responses of services, actions and events of QoS come through the EventsExecutor of rclpy, services in
their place among the messages. Timers are called one by one, the most overdue first, each after all
messages are processed: the EventsExecutor would call them from a second thread, at times and in an order
that vary.
"""

from __future__ import annotations

import inspect
import threading
import weakref
from collections.abc import Callable
from typing import Any

from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.event_handler import EventHandler
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.task import Task
from rclpy.timer import Timer

from diffdrive_jacobian.lockstep._agenda import Agenda
from diffdrive_jacobian.lockstep._clocks import Clocks
from diffdrive_jacobian.lockstep._deliveries import Deliveries, SentElsewhere, is_latched
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._facade import Facade
from diffdrive_jacobian.lockstep._keeper import Keeper
from diffdrive_jacobian.lockstep._served import Responded, Served
from diffdrive_jacobian.lockstep._tasks import Tasks
from diffdrive_jacobian.lockstep._timers import Timers, is_due
from diffdrive_jacobian.ros.rclpy_internals import (
    TimerHandle,
    events_executor,
    on_new_node,
    wrap_calls,
)

LATCHED_PATIENCE = Duration(seconds=5.0)
"""Longest time for a latched message to reach a later subscription (s). It takes microseconds."""


class QuiescentExecutor:
    """Executes the callbacks of nodes until none is left at the current simulated time."""

    def __init__(self, context: Context, on_registered: Callable[[Node], None]) -> None:
        """Start without nodes.

        Args:
            context: The context of the nodes.
            on_registered: Called with each node when it is new or has created or destroyed an entity.

        Raises:
            LockstepError: This rclpy has no EventsExecutor.
        """
        events: Any = events_executor(context)
        if events is None:
            raise LockstepError(
                'lockstep needs the EventsExecutor of rclpy, which this ROS installation does not have'
            )
        self._events = events
        self._on_registered = on_registered
        self._served: dict[Node, Served] = {}
        self._changed = False
        self._has_actions = False
        self._has_events = False
        self.isolated = True
        """Whether there are no messages from other processes."""
        self.unserved: set[Subscription] = set()
        """Subscriptions whose messages are not taken."""
        self.tasks = Tasks()
        self.agenda = Agenda()
        """What happens at later times."""
        self.deliveries = Deliveries(self.task_creator)
        """The messages that wait."""
        self.response_observers: list[Responded] = []
        """Called with each response that a node gives."""
        self.killed: set[Node] = set()
        """The nodes that were removed without being stopped."""
        self._restore_calls = wrap_calls(self._noting)
        self._context = context
        self._created: list[weakref.ref[Node]] = []
        self._restore_nodes = on_new_node(self._note_node)
        self.clocks = Clocks()
        self.clock_pauses = 0
        """Number of faults because of which the clocks of the nodes stand."""
        self.timers = Timers()
        self.keeper: Keeper | None = None
        """Keeper of the gates of the nodes. None: they are always open."""

    def _noting(self, send: Callable[..., Any]) -> Callable[..., Any]:
        """Return a method that sends a request or a response, and takes its place among the messages."""
        deliveries, pending = self.deliveries, self.deliveries.pending

        def sent(entity: Any, *args: Any, **kwargs: Any) -> Any:
            if threading.get_ident() != deliveries.thread:
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
                added = node in self._served
                if added or heard:
                    what = f'node {node.get_fully_qualified_name()} {does}'
                    sent = SentElsewhere(node, added, what, threading.current_thread().name)
                    self.deliveries.elsewhere[entity] = sent

    # --- Nodes

    def _note_node(self, node: Node) -> None:
        if node.context is self._context:
            self._created.append(weakref.ref(node))

    @property
    def existing(self) -> list[Node]:
        """The nodes of the context that were not destroyed, added or not."""
        nodes = [created() for created in self._created]
        return [node for node in nodes if node is not None and not _is_destroyed(node)]

    @property
    def nodes(self) -> list[Node]:
        """The nodes, in the order in which they were added."""
        return list(self._served)

    def add(self, node: Node) -> None:
        """Add a node."""
        create_task = self.task_creator(node)
        # The node itself keeps a weak reference only.
        facade = Facade(self._note_change, create_task)
        served = Served(node, create_task, facade, self.response_observers)
        self._served[node] = served
        if self.keeper is not None:
            self.keeper.admit(served)
        node.executor = facade
        self._events.add_node(served)
        self.clocks.find(self._served)
        self._changed = True

    def use(self, keeper: Keeper) -> None:
        """Set the keeper of the gates of the nodes."""
        self.keeper = keeper
        for served in self._served.values():
            keeper.admit(served)

    def remove(self, node: Node) -> None:
        """Remove a node, after it has processed what was sent to it."""
        self.settle()
        if node in self._served:
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

    def _forget(self, node: Node) -> None:
        served = self._served.pop(node)
        self.tasks.cancel(node)
        if self.keeper is not None:
            self.keeper.dismiss(node)
        _release(served)
        self._events.remove_node(served)

    def close(self) -> None:
        """Remove all nodes and shut down."""
        self._restore_calls()
        self._restore_nodes()
        self.tasks.cancel()
        for served in self._served.values():
            _release(served)
        self._served.clear()
        self.deliveries.close()
        self._events.shutdown()

    # --- Work

    def settle(self) -> int | None:
        """Execute all callbacks that are due at the current time, and all that they cause.

        Returns:
            Time until the next timer in simulated time expires, or the next action is due (ns); None:
            there is none.
        """
        self.handle_all()
        return self._call_timers()[1]

    def catch_up(self) -> int | None:
        """Settle, after little or nothing was done since the last time.

        It takes a tenth of the time of `settle` if no message or request was sent, no task or entity was
        created, and no timer is due.
        """
        if not self._has_work():
            due, until_next = self.timers.due()
            if not due:
                return self._sooner(until_next)
        return self.settle()

    def advance(self, now: int) -> int | None:
        """Set the clocks of the nodes to a time (ns), and settle."""
        if not self.clock_pauses:
            self.clocks.set(now)
        if not self._has_work():
            called, until_next = self._call_timers()
            if called:
                return until_next
        return self.settle()

    def _has_work(self) -> bool:
        """Return whether anything waits to be executed, or may wait without having been noticed."""
        return bool(
            self.deliveries.pending
            or self._changed
            or self.tasks
            or self._has_actions
            or not self.isolated
        )

    def _sooner(self, until_next: int | None) -> int | None:
        """Return the time until the next timer or action (ns); None: there is none."""
        if self.clock_pauses:
            until_next = None
        until_action = self.agenda.until_next()
        if until_action is None or until_next is None:
            return until_action if until_next is None else until_next
        return min(until_action, until_next)

    def _call_timers(self) -> tuple[bool, int | None]:
        """Execute the actions and the timers that are due, and all callbacks that they cause.

        Returns:
            Whether there were any, and the time until the next timer expires, as of `settle`.
        """
        called = False
        while True:
            while (action := self.agenda.pop_due()) is not None:
                called = True
                action()
                self.handle_all()
            due, until_next = self.timers.due()
            if not due:
                return called, self._sooner(until_next)
            keeper = self.keeper
            for handle, timer, node in due:
                if is_due(handle) and (keeper is None or keeper.may_tick(node, timer)):
                    called = True
                    self.call_timer(handle, timer, node)
                    self.handle_all(after_callback=True)

    def task_creator(self, node: Node) -> Callable[..., Task]:
        """Return a function that schedules functions and coroutines of a node for the current time."""

        def create_task(callback: Any, *args: Any, **kwargs: Any) -> Task:
            return self.tasks.create(node, callback, args, kwargs, node.executor)

        return create_task

    def handle_all(self, *, after_callback: bool = False) -> None:
        """Process messages, service calls and tasks until none is left that can continue.

        Args:
            after_callback: Whether nothing but a callback was executed since the last call. What it has
                sent is known.
        """
        events = not after_callback or self._has_events or not self.isolated
        while True:
            self._drain(events)
            if self._register_changed():
                # A new client or service may already have been called.
                events = True
            elif not self._run_tasks():
                return

    def _run_tasks(self) -> bool:
        """Continue the tasks. Return whether any made progress."""
        return bool(
            self.tasks and self.tasks.run(self.keeper.closed if self.keeper is not None else None)
        )

    def serve(self) -> None:
        """Process requests and responses. Messages wait."""
        self._handle_events()
        self._register_changed()

    def _drain(self, events: bool = True) -> None:
        """Process messages and events until none is left.

        Args:
            events: Whether the EventsExecutor may have events although no request or response was sent.
        """
        pending, poll = self.deliveries.pending, self.deliveries.poll
        take = pending.popleft
        while True:
            while pending:
                if (reader := take()) is None:
                    self._handle_events()
                    events = True
                else:
                    reader.deliver()
            if not ((events and self._handle_events()) or pending or poll() or pending):
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

    def call_timer(self, handle: TimerHandle, timer: Timer, node: Node) -> None:
        """Call the callback of a timer."""
        handle.call_timer()
        keeper = self.keeper
        result = timer.callback() if keeper is None else keeper.run(node, timer)
        if inspect.iscoroutine(result):
            self.task_creator(node)(result)

    # --- Entities

    def _note_change(self) -> None:
        """Note that a node has created or destroyed an entity.

        New ones are registered when all is processed that waits. Destroyed ones receive nothing more.
        """
        self._changed = True
        self.deliveries.drop_destroyed(self._served)

    def _register_changed(self) -> bool:
        """Register if a node has created or destroyed an entity. Return whether one has."""
        if not self._changed:
            return False
        self._changed = False
        try:
            self._register()
        except BaseException:
            self._changed = True
            raise
        return True

    def _register(self) -> None:
        """Register entities that the nodes have created since the last call, and forget destroyed ones.

        Another thread delivers latched messages to later subscriptions. This waits for them, and
        processes those of one topic before those of the next, which fixes their order.
        """
        for node in [node for node in self._served if _is_destroyed(node)]:
            self._forget(node)
        for node, served in self._served.items():
            if list(node.guards):
                raise LockstepError(
                    f'node {node.get_fully_qualified_name()} has a guard condition, which lockstep does '
                    'not support: any thread can trigger it, at any time; use a timer or a topic'
                )
            for publisher in node.publishers:
                if is_latched(publisher):
                    publisher.wait_for_all_acked(LATCHED_PATIENCE)
            served.update()
            self._on_registered(node)
        self._events.wake()
        # The registration itself does not count as an event.
        self._handle_events()
        without = self.clocks.find(self._served) | self.unserved
        new = self.deliveries.update(self._served, without)
        # Messages that a subscription has received before.
        for reader in sorted(new, key=lambda reader: reader.latched):
            self.deliveries.admit(reader)
            self._drain()
        # Actions, or a user's own entities. Who sends them something is not known.
        waitables = [waitable for node in self._served for waitable in node.waitables]
        self._has_actions = any(not isinstance(waitable, EventHandler) for waitable in waitables)
        self._has_events = not all(map(_is_of_discovery, waitables))
        self.update_timers()

    def update_timers(self) -> None:
        """Find the timers that may tick."""
        if self.keeper is None:
            self.timers.update(self._served)
        else:
            self.keeper.update_timers()


def _nothing() -> None:
    """Do nothing, as a task."""


def _is_of_discovery(waitable: Any) -> bool:
    """Return whether a waitable has events only when a publisher or subscription is created.

    Those of rclpy itself, which report that two do not match.
    """
    return isinstance(waitable, EventHandler) and 'INCOMPATIBLE' in waitable.event_type.name


def _release(served: Served) -> None:
    served.facade.released = True
    served.node.executor = None


def _is_destroyed(node: Node) -> bool:
    try:
        node.get_fully_qualified_name()
    except InvalidHandle:
        return True
    return False
