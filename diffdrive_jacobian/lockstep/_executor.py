"""An executor that detects when all work is done, and does it in a reproducible order.

Messages, service calls and tasks run on the EventsExecutor of rclpy, in the order in which they were
sent. Within a process Fast DDS delivers a message before `publish` returns. The EventsExecutor would
call timers from a second thread, at times and in an order that vary. Timers are therefore hidden from it
and called here one by one, the most overdue first, each after all messages are processed.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.task import Task
from rclpy.timer import Timer

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._served import Served, is_latched
from diffdrive_jacobian.ros.rclpy_internals import (
    RCLError,
    TimerHandle,
    events_executor,
    new_task,
    timer_handle,
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
        self._facade = _Facade(self)
        self._changed = False
        self._tasks: list[_Task] = []
        # With their handles, whose methods take a third of the time of those of the timers.
        self._sim_timers: list[tuple[TimerHandle, Timer]] = []
        self._wall_timers: list[tuple[TimerHandle, Timer]] = []

    # --- Nodes

    @property
    def nodes(self) -> list[Node]:
        """The nodes, in the order in which they were added."""
        return list(self._served)

    def add(self, node: Node) -> None:
        """Add a node."""
        self._served[node] = Served(node, self.create_task)
        node.executor = self._facade
        self._events.add_node(self._served[node])
        self._changed = True

    def remove(self, node: Node) -> None:
        """Remove a node."""
        served = self._served.pop(node)
        self._release(node)
        self._events.remove_node(served)
        self._events.wake()
        self._changed = True
        self.settle()

    def close(self) -> None:
        """Remove all nodes and shut down."""
        for task in self._tasks:
            task.future.cancel()
        for node in self.nodes:
            self._release(node)
        self._served.clear()
        self._events.shutdown()

    def _release(self, node: Node) -> None:
        self._facade.released = node
        node.executor = None

    # --- Work

    def settle(self) -> int | None:
        """Execute all callbacks that are due at the current time, and all that they cause.

        Returns:
            Time until the next timer in simulated time expires (ns); None: there is no such timer.
        """
        self._handle_all()
        while True:
            due, until_next = self._due_timers()
            if not due:
                return until_next
            for handle, timer in due:
                if _is_due(handle):
                    self._call(handle, timer)
                    self._handle_all()

    def create_task(self, callback: Any, *args: Any, **kwargs: Any) -> Task:
        """Schedule a function or a coroutine for the current time. Return its future."""
        if _is_async(callback):
            callback, args, kwargs = callback(*args, **kwargs), (), {}
        task = _Task(callback, new_task(callback, args, kwargs, self._facade))
        self._tasks.append(task)
        return task.future

    def _handle_all(self) -> None:
        """Process messages, service calls and tasks until none is left that can continue."""
        while True:
            self._drain()
            if self._changed:
                self._register()
            elif not (self._tasks and self._run_tasks()):
                return

    def _run_tasks(self) -> bool:
        """Continue each task once. Return whether any made progress.

        It is not known what a coroutine waits for, so it is continued and may wait again.
        """
        progress = False
        tasks, self._tasks = self._tasks, []
        waiting = []
        try:
            while tasks:
                task = tasks.pop(0)
                progress |= task.proceed()
                if (error := task.future.exception()) is not None:
                    raise error
                if not (task.future.done() or task.future.cancelled()):
                    waiting.append(task)
        finally:
            self._tasks = [*waiting, *tasks, *self._tasks]
        return progress

    def _drain(self) -> None:
        """Process events until none is left.

        A task runs after all events that were queued before it. If it is the first event, the queue was
        empty.
        """
        create_task, spin_once = self._events.create_task, self._events.spin_once
        while True:
            last = create_task(_nothing)
            done, events = last.done, 0
            while not done():
                spin_once()
                events += 1
            if events == 1:
                return

    def _due_timers(self) -> tuple[list[tuple[TimerHandle, Timer]], int | None]:
        """Return the due timers, the most overdue first, and the time until the next one (ns)."""
        due, until_next = [], None
        for pair in self._sim_timers:
            left = pair[0].time_until_next_call()
            if left is None:
                continue
            if left <= 0:
                due.append((left, pair))
            elif until_next is None or left < until_next:
                until_next = left
        for pair in self._wall_timers:
            left = pair[0].time_until_next_call()
            if left is not None and left <= 0:
                due.append((left, pair))
        # Sorting is stable: timers that are due at the same time stay in the order of their creation.
        due.sort(key=lambda item: item[0])
        return [pair for _, pair in due], until_next

    def _call(self, handle: TimerHandle, timer: Timer) -> None:
        handle.call_timer()
        result = timer.callback()
        if inspect.iscoroutine(result):
            self.create_task(result)

    # --- Entities

    def changed(self) -> None:
        """Note that a node has created or destroyed an entity."""
        self._changed = True

    def _register(self) -> None:
        """Register entities that the nodes have created since the last call, and forget destroyed ones.

        Another thread delivers latched messages to later subscriptions. This waits for them, and
        registers the subscriptions of latched topics one by one, which fixes the order of the messages.
        """
        self._changed = False
        for node, served in self._served.items():
            if list(node.guards):
                raise LockstepError(
                    f'{node.get_fully_qualified_name()} has a guard condition, which lockstep does not '
                    'support'
                )
            for publisher in node.publishers:
                if is_latched(publisher):
                    publisher.wait_for_all_acked(LATCHED_PATIENCE)
            served.update()
            self._on_registered(node)
        self._events.wake()
        self._drain()
        for served in self._served.values():
            while served.admit_latched():
                self._events.wake()
                self._drain()
        timers = [timer for node in self._served for timer in node.timers]
        self._sim_timers = [(timer_handle(timer), timer) for timer in timers if _follows_sim_time(timer)]
        self._wall_timers = [
            (timer_handle(timer), timer) for timer in timers if not _follows_sim_time(timer)
        ]


def _nothing() -> None:
    """Do nothing, as a task."""


def _follows_sim_time(timer: Timer) -> bool:
    clock = timer.clock
    return clock.clock_type == ClockType.ROS_TIME and bool(clock.ros_time_is_active)


def _is_due(handle: TimerHandle) -> bool:
    try:
        left = handle.time_until_next_call()
    except RCLError:
        # A callback has destroyed the timer.
        return False
    return left is not None and left <= 0


class _Task:
    """A task and the point at which its coroutine waits."""

    def __init__(self, handler: Any, future: Task) -> None:
        self.future = future
        self._handler = handler
        # A reference is kept so that no later object has the same identity.
        self._waits_for: Any = self

    def proceed(self) -> bool:
        """Continue the task. Return whether it made progress."""
        before = self._waits_for
        self.future()
        self._waits_for = self._innermost()
        return bool(self.future.done()) or self._waits_for is not before

    def _innermost(self) -> Any:
        """Return the innermost object that the coroutine awaits."""
        point = self._handler
        while (
            inner := getattr(point, 'cr_await', None) or getattr(point, 'gi_yieldfrom', None)
        ) is not None:
            point = inner
        return point


def _is_async(callback: Any) -> bool:
    return inspect.iscoroutinefunction(callback) or inspect.iscoroutinefunction(
        getattr(callback, '__call__', None)  # noqa: B004
    )


class _Facade:
    """The executor of the nodes, as they see it."""

    def __init__(self, executor: QuiescentExecutor) -> None:
        self._executor = executor
        self.released: Node | None = None

    def add_node(self, node: Node) -> bool:
        """Accept a node. It was added before its `executor` is set."""
        return True

    def remove_node(self, node: Node) -> None:
        """Accept the removal of a node by lockstep.

        Raises:
            LockstepError: Another executor is about to add the node.
        """
        if node is not self.released:
            raise LockstepError(
                f'node {node.get_fully_qualified_name()} is in lockstep and cannot be spun by another '
                'executor'
            )

    def wake(self) -> None:
        """Note that a node has created or destroyed an entity."""
        self._executor.changed()

    def create_task(self, callback: Any, *args: Any, **kwargs: Any) -> Task:
        """Schedule a function or a coroutine. Return its future."""
        return self._executor.create_task(callback, *args, **kwargs)

    def __getattr__(self, name: str) -> Any:
        raise _NoAttributeError(
            f'a node in lockstep cannot call executor.{name}: lockstep executes its callbacks'
        )


class _NoAttributeError(LockstepError, AttributeError):
    """The executor has no such attribute. `hasattr` returns False."""
