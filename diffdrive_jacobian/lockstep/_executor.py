"""An executor that knows when nothing is left to do, and does everything in a reproducible order.

Messages, service calls and tasks run on rclpy's EventsExecutor, in the order in which they were sent:
within one process Fast DDS hands a message to its readers before publish() returns. The timers are
kept from it, for it fires them from a second thread, at an instant and in an order of that thread's
own; here they are called one by one, the most overdue first, each after all messages were handled.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.task import Task
from rclpy.timer import Timer

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._served import Served, is_latched
from diffdrive_jacobian.ros.runner import events_executor

LATCHED_PATIENCE = Duration(seconds=5.0)
"""How long a latched message may take to reach a late reader (s); it takes microseconds."""


class QuiescentExecutor:
    """Serves nodes until nothing is left to do at the present instant."""

    def __init__(self, context: Context, on_registered: Callable[[Node], None]) -> None:
        """Begin without nodes.

        Args:
            context: The context of the nodes.
            on_registered: Called with each node whose entities are new or changed.

        Raises:
            LockstepError: This rclpy has no EventsExecutor.
        """
        events: Any = events_executor(context)
        if events is None:
            raise LockstepError(
                'lockstep needs the EventsExecutor of rclpy, which this ROS installation is too old for'
            )
        self._events = events
        self._on_registered = on_registered
        self._served: dict[Node, Served] = {}
        self._facade = _Facade(self)
        self._changed = False
        self._tasks: list[_Task] = []
        # Handles with their timers: asking the handle for its time costs a third of asking the timer.
        self._sim_timers: list[tuple[Any, Timer]] = []
        self._wall_timers: list[tuple[Any, Timer]] = []

    # --- Nodes

    @property
    def nodes(self) -> list[Node]:
        """The nodes served, in the order in which they were added."""
        return list(self._served)

    def add(self, node: Node) -> None:
        """Serve a node."""
        self._served[node] = Served(node, self.create_task)
        node.executor = self._facade
        self._events.add_node(self._served[node])
        self._changed = True

    def remove(self, node: Node) -> None:
        """Serve a node no longer."""
        served = self._served.pop(node)
        self._release(node)
        self._events.remove_node(served)
        self._events.wake()
        self._changed = True
        self.settle()

    def close(self) -> None:
        """Serve nobody any more."""
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
        """Handle what there is to handle at this instant, and all that follows from it.

        Returns:
            The time until the next timer of simulated time is due (ns); None: there is no such timer.
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
        """Run a function or a coroutine at this instant, or as far as it comes; gives its future."""
        if _is_async(callback):
            callback, args, kwargs = callback(*args, **kwargs), (), {}
        task = _Task(callback, Task(callback, args, kwargs, executor=self._facade))
        self._tasks.append(task)
        return task.future

    def _handle_all(self) -> None:
        """Handle messages, service calls and tasks until none is left that can go on."""
        while True:
            self._drain()
            if self._changed:
                self._register()
            elif not (self._tasks and self._run_tasks()):
                return

    def _run_tasks(self) -> bool:
        """Let each task go on once; whether any of them did.

        A coroutine does not tell what it waits for, so it is asked to go on and may wait again.
        """
        progress = False
        tasks, self._tasks = self._tasks, []
        waiting = []
        try:
            while tasks:
                task = tasks.pop(0)
                progress |= task.go_on()
                if (error := task.future.exception()) is not None:
                    raise error
                if not (task.future.done() or task.future.cancelled()):
                    waiting.append(task)
        finally:
            self._tasks = [*waiting, *tasks, *self._tasks]
        return progress

    def _drain(self) -> None:
        """Handle events until none is left.

        A task runs after all that was in the queue before it: if it is the first to run, there was
        nothing else.
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

    def _due_timers(self) -> tuple[list[tuple[Any, Timer]], int | None]:
        """Find the timers that are due, the most overdue first, and the time until the next one (ns)."""
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
        # Sorting is stable: equals stay in the order of their creation.
        due.sort(key=lambda one: one[0])
        return [pair for _, pair in due], until_next

    def _call(self, handle: Any, timer: Timer) -> None:
        handle.call_timer()
        result = timer.callback()
        if inspect.iscoroutine(result):
            self.create_task(result)

    # --- Entities

    def changed(self) -> None:
        """Take note that a node has made or destroyed something."""
        self._changed = True

    def _register(self) -> None:
        """Look for what the nodes have made or destroyed since the last time.

        A latched message reaches a late reader from another thread: it is waited for, and the readers
        of latched topics are registered one by one, so that their messages come in one order.
        """
        self._changed = False
        for node, served in self._served.items():
            if list(node.guards):
                raise LockstepError(
                    f'{node.get_fully_qualified_name()} has a guard condition, which the executor of '
                    'this world cannot serve'
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
        self._sim_timers = [(timer.handle, timer) for timer in timers if _follows_sim_time(timer)]
        self._wall_timers = [(timer.handle, timer) for timer in timers if not _follows_sim_time(timer)]


def _nothing() -> None:
    """Be a task."""


def _follows_sim_time(timer: Timer) -> bool:
    clock = timer.clock
    return clock.clock_type == ClockType.ROS_TIME and bool(clock.ros_time_is_active)


def _is_due(handle: Any) -> bool:
    try:
        left = handle.time_until_next_call()
    except rclpy_implementation.RCLError:
        # A callback has destroyed it.
        return False
    return left is not None and left <= 0


class _Task:
    """A task and how far its coroutine came."""

    def __init__(self, handler: Any, future: Task) -> None:
        self.future = future
        self._handler = handler
        # Kept, so that no later one can take its identity.
        self._waits_for: Any = self

    def go_on(self) -> bool:
        """Run it as far as it comes; whether it came any farther."""
        before = self._waits_for
        self.future()
        self._waits_for = self._innermost()
        return bool(self.future.done()) or self._waits_for is not before

    def _innermost(self) -> Any:
        """Follow the coroutine through all that it awaits."""
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
    """What a node takes for its executor."""

    def __init__(self, executor: QuiescentExecutor) -> None:
        self._executor = executor
        self.released: Node | None = None

    def add_node(self, node: Node) -> bool:
        """Accept what `Node.executor` announces; the world added the node before."""
        return True

    def remove_node(self, node: Node) -> None:
        """Accept it from the world only: else another executor is about to take the node."""
        if node is not self.released:
            raise LockstepError(
                f'node {node.get_fully_qualified_name()} cannot be spun by somebody else: it is in '
                'lockstep, and the world does the spinning'
            )

    def wake(self) -> None:
        """Hear that a node has made or destroyed something."""
        self._executor.changed()

    def create_task(self, callback: Any, *args: Any, **kwargs: Any) -> Task:
        """Run a function or a coroutine."""
        return self._executor.create_task(callback, *args, **kwargs)

    def __getattr__(self, name: str) -> Any:
        raise _NoAttributeError(
            f'a node in lockstep cannot call executor.{name}: the world does the spinning'
        )


class _NoAttributeError(LockstepError, AttributeError):
    """What the executor does not have; `hasattr` gives False."""
