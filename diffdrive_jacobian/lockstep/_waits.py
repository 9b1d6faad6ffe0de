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

"""Waits of callbacks in the process of the test that nothing can end, and that would end in silence.

A response or a message cannot arrive before the callback returns. With a timeout rclpy would give up,
and the callback would go on without it, though in other executors it gets it. What is raised is `Stuck`,
which `except Exception` does not catch.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterable
from types import FrameType
from typing import Any

from rclpy.client import Client
from rclpy.context import Context
from rclpy.node import Node
from rclpy.task import Future

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._guard import Guard, Stuck
from diffdrive_jacobian.ros.rclpy_internals import (
    is_of_executor,
    is_of_rate,
    is_of_rclpy,
    wrap_waits,
)

__tracebackhide__ = True
HERE = __file__.rpartition('/')[0]
POLLS = 3
"""Number of times that a callback may find a response missing."""
QUESTIONS = ('done', 'result', 'cancelled')
"""Methods by which a callback may ask a future again and again."""


class Waits:
    """Refuses the waits of callbacks. Each callback that is executed counts on its own."""

    def __init__(
        self,
        context: Context,
        guard: Guard,
        nodes: Callable[[], Iterable[Node]],
        busy: Callable[[], bool],
    ) -> None:
        """Refuse them until `close`.

        Args:
            context: That of the clients.
            guard: Reports what was raised, also if the callback has caught it.
            nodes: Returns the nodes of the context.
            busy: Returns whether callbacks are being executed.
        """
        self._context, self._guard, self._nodes, self._busy = context, guard, nodes, busy
        self._thread = threading.get_ident()
        self._executing: FrameType | None = None
        """What executes the callback that has sent the requests."""
        self._sent: list[tuple[Callable[[], bool], Client]] = []
        """Whether each has been answered, and the client that has sent it."""
        self.close = wrap_waits(self._call, self._call_async, self._wait, self._guard_condition)
        """Refuses nothing any more."""

    def _in_callback(self, frame: FrameType | None) -> FrameType | None:
        """Return what executes the callback to which a frame belongs. None: it belongs to none."""
        if threading.get_ident() != self._thread or not self._busy():
            return None
        while frame is not None and not frame.f_code.co_filename.startswith(HERE):
            frame = frame.f_back
        return frame

    def _stuck(self, what: str, place: FrameType) -> Stuck:
        """Return the error of a wait, which is raised again if the callback catches it."""
        while is_of_rclpy(place) and place.f_back is not None:
            place = place.f_back
        code = place.f_code
        self._guard.raised = Stuck(
            f'{what}, in {code.co_name} ({code.co_filename}:{place.f_lineno}): it cannot arrive before '
            'the callback returns. Await call_async, or subscribe; a test calls services by '
            'lockstep.call'
        )
        return self._guard.raised

    def _where(self, client: Client) -> str:
        names = [
            node.get_fully_qualified_name()
            for node in self._nodes()
            if any(one is client for one in node.clients)
        ]
        who = f'node {names[0]}' if names else 'a callback'
        return f'{who} waits for a response of {client.service_name}'

    # --- What is replaced

    def _call(self, call: Callable[..., Any]) -> Callable[..., Any]:
        waits = self

        def calls(self: Client, *args: Any, **kwargs: Any) -> Any:
            if self.context is waits._context and threading.get_ident() == waits._thread:
                if waits._in_callback(sys._getframe(1)) is not None:
                    raise waits._stuck(f'{waits._where(self)} (client.call)', sys._getframe(1))
                raise LockstepError(
                    f'client.call of {self.service_name} would never return: time passes by run_for, '
                    'and lockstep.call calls a service'
                )
            return call(self, *args, **kwargs)

        return calls

    def _call_async(self, call_async: Callable[..., Future]) -> Callable[..., Future]:
        waits = self

        def calls_async(self: Client, *args: Any, **kwargs: Any) -> Future:
            future = call_async(self, *args, **kwargs)
            if self.context is not waits._context:
                return future
            done = future.done
            executing = waits._in_callback(sys._getframe(1))
            if executing is not None:
                if executing is not waits._executing:
                    waits._executing, waits._sent = executing, []
                waits._sent.append((done, self))
            waits._count_questions(future, done, self)
            return future

        return calls_async

    def _count_questions(self, future: Future, done: Callable[[], bool], client: Client) -> None:
        """Let a future raise an error if a callback asks it again and again."""
        asked: list[Any] = [None, 0]

        def counting(name: str) -> Callable[[], Any]:
            answer = getattr(future, name)

            def ask() -> Any:
                place = sys._getframe(1)
                if not done() and (executing := self._in_callback(place)) is not None:
                    asked[:] = executing, asked[1] + 1 if asked[0] is executing else 1
                    # An executor of the callback's own would wait for the whole timeout.
                    if asked[1] > POLLS or is_of_executor(place):
                        raise self._stuck(f'{self._where(client)} (future.{name})', place)
                return answer()

            return ask

        for name in QUESTIONS:
            setattr(future, name, counting(name))

    def _wait(self, wait: Callable[..., bool]) -> Callable[..., bool]:
        """Refuse to wait in vain for what would follow a response, and for a rate."""
        waits = self

        def waiting(self: threading.Condition, timeout: float | None = None) -> bool:
            if threading.get_ident() != waits._thread or not waits._busy():
                return wait(self, timeout)
            place = sys._getframe(1)
            while place.f_code.co_filename == threading.__file__ and place.f_back is not None:
                place = place.f_back
            if is_of_rate(place):
                raise waits._stuck('a callback sleeps by a rate', place)
            if wait(self, timeout):
                return True
            executing = waits._in_callback(place)
            if executing is not None and executing is waits._executing:
                for done, client in waits._sent:
                    if not done():
                        raise waits._stuck(f'{waits._where(client)} until a timeout', place)
            return False

        return waiting

    def _guard_condition(self, present: Callable[..., Any]) -> Callable[..., Any]:
        def create(*args: Any, **kwargs: Any) -> Any:
            if self._in_callback(place := sys._getframe(1)) is not None:
                raise self._stuck('wait_for_message waits for a message', place)
            if threading.get_ident() == self._thread:
                raise LockstepError(
                    'wait_for_message would wait in vain: time passes by run_for; lockstep.last and '
                    'lockstep.listen have the messages of a topic'
                )
            return present(*args, **kwargs)

        return create
