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

"""Detection of callbacks that block, or that cause each other without end.

When one simulated time takes more than `patience` seconds of wall time, a second thread sends a signal
to the main thread. Its handler also runs within a callback that sleeps. It observes for a moment which
callbacks are called, then raises an error that names them.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import sys
import sysconfig
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import partial
from types import FrameType
from typing import Any

import rclpy
from rclpy.node import Node

from diffdrive_jacobian.lockstep import _scheduler
from diffdrive_jacobian.ros import rclpy_internals
from diffdrive_jacobian.time_units import NANOSECONDS

SIGNAL = signal.SIGUSR2
"""Signal that neither pytest nor its plugins use: pytest-timeout uses SIGALRM."""
PERIOD = 0.25
"""Period of the checks, and the time for which callbacks are observed (s)."""
UNANSWERED = 20
"""Number of signals without effect after which the tracebacks of all threads are written to stderr."""
MAX_NAMED = 8
"""Largest number of callbacks that are named."""
_STANDARD = sysconfig.get_path('stdlib') + os.sep
_PACKAGES = sysconfig.get_path('platlib') + os.sep
_INFRASTRUCTURE = (
    os.path.dirname(rclpy.__file__) + os.sep,
    os.path.dirname(__file__) + os.sep,
    rclpy_internals.__file__,
)


class Stuck(BaseException):
    """Raised within a callback that blocks. `except Exception` does not catch it."""


class Guard:
    """Measures the wall time for which simulated time does not advance."""

    def __init__(self, patience: float, nodes: Callable[[], Iterable[Node]]) -> None:
        """Start the thread.

        Args:
            patience: Longest wall time for one simulated time (s).
            nodes: Returns the nodes whose callbacks can be named.
        """
        self._patience = patience
        self._nodes = nodes
        self.raised: Stuck | None = None
        """What was raised at the current time."""
        self.since: float | None = None
        """Wall time since which callbacks are executed (s); None: none is."""
        self.seen: dict[str, bool] | None = None
        """What was called while callbacks are observed, and whether it is one of a node. None: they are
        not."""
        self.unlimited = False
        """Whether callbacks may take as long as they like, because somebody debugs them."""
        self._profiler: Any = None
        self._main = threading.get_ident()
        self._closed = threading.Event()
        self._previous = signal.signal(SIGNAL, self._on_signal)
        self._thread = threading.Thread(target=self._watch, name='lockstep guard', daemon=True)
        self._thread.start()

    def extend(self, seconds: float) -> None:
        """Leave out a duration (s) for which another process was waited for."""
        if self.since is not None:
            self.since += seconds

    def close(self) -> None:
        """Stop the thread."""
        self._closed.set()
        self._thread.join()
        signal.signal(SIGNAL, self._previous)

    def _overdue(self) -> bool:
        if self.unlimited:
            return False
        return self.since is not None and time.monotonic() - self.since > self._patience

    def _watch(self) -> None:
        unanswered = 0
        while not self._closed.wait(PERIOD):
            if not self._overdue():
                unanswered = 0
                continue
            signal.pthread_kill(self._main, SIGNAL)
            unanswered += 1
            if unanswered == UNANSWERED:
                # Blocked outside of Python, where signal handlers do not run.
                faulthandler.dump_traceback()

    def _on_signal(self, _: int, frame: FrameType | None) -> None:
        if not self._overdue() or any(caller.f_code.co_name == '__del__' for caller in _stack(frame)):
            # An exception in __del__ would be lost. The next signal follows soon.
            return
        if debugger_is_active():
            self.since = time.monotonic()
            return
        if self.seen is None:
            self.seen = {}
            self._profiler = sys.getprofile()
            sys.setprofile(self._on_call)
            return
        self.raised = Stuck(self._diagnose(self.stop_observing(), frame))
        # What handles the exception has as much time again, before another one replaces it.
        self.since = time.monotonic()
        raise self.raised

    def stop_observing(self) -> list[str]:
        """Return which callbacks were called, and observe them no longer."""
        sys.setprofile(self._profiler)
        seen, self.seen = self.seen or {}, None
        # Functions that rclpy calls for them, as constructors of messages, say nothing.
        of_nodes = [text for text, of_node in seen.items() if of_node]
        return (of_nodes or list(seen))[:MAX_NAMED]

    def _on_call(self, frame: FrameType, event: str, _: Any) -> None:
        if event == 'call' and self.seen is not None and len(self.seen) < 10 * MAX_NAMED:
            below = iter(_stack(frame))
            if _is_user(next(below, None)) and not any(map(_is_user, below)) and not _is_standard(frame):
                text, of_node = describe(frame, self._nodes())
                self.seen[text] = of_node

    def _diagnose(self, seen: list[str], frame: FrameType | None) -> str:
        stack = list(filter(_is_user, _stack(frame)))
        if not seen and stack:
            inner, outer = stack[0], stack[-1]
            callback, _ = describe(outer, self._nodes())
            return (
                f'{callback} has not returned for {self._patience:g} s of wall time; it '
                f'is at {inner.f_code.co_filename}:{inner.f_lineno} in {inner.f_code.co_name}'
            )
        return (
            f'callbacks without end: for {self._patience:g} s of wall time simulated time did not '
            f'advance, called: {"; ".join(seen) or "unknown"}'
        )


def debugger_is_active() -> bool:
    """Return whether a debugger follows this thread: pdb, or the one of an IDE."""
    bdb = sys.modules.get('bdb')
    followed = bdb is not None and isinstance(getattr(sys.gettrace(), '__self__', None), bdb.Bdb)
    return followed or 'pydevd' in sys.modules


def _stack(frame: FrameType | None) -> Iterator[FrameType]:
    """Yield the frames of the running callback, innermost first, without those of the scheduler."""
    while frame is not None and frame.f_code.co_filename != _scheduler.__file__:
        yield frame
        frame = frame.f_back


def _is_user(frame: FrameType | None) -> bool:
    return frame is not None and not frame.f_code.co_filename.startswith(_INFRASTRUCTURE)


def _is_standard(frame: FrameType) -> bool:
    """Return whether a frame is of the standard library."""
    name = frame.f_code.co_filename
    return name.startswith(_STANDARD) and not name.startswith(_PACKAGES)


def describe(frame: FrameType, nodes: Iterable[Node]) -> tuple[str, bool]:
    """Return a description of what a frame runs, and whether that is a callback of one of the nodes."""
    where = f'{frame.f_code.co_filename}:{frame.f_code.co_firstlineno}'
    for node in nodes:
        named = f'node {node.get_fully_qualified_name()}, {where}'
        for subscription in node.subscriptions:
            if name := _runs(frame, subscription.callback):
                return f'{name} (subscribed to {subscription.topic_name}, {named})', True
        for timer in node.timers:
            if name := _runs(frame, timer.callback):
                return f'{name} (timer of {timer.timer_period_ns / NANOSECONDS:g} s, {named})', True
        for service in node.services:
            if name := _runs(frame, service.callback):
                return f'{name} (service {node.resolve_service_name(service.srv_name)}, {named})', True
    return f'{frame.f_code.co_name} ({where})', False


def _runs(frame: FrameType, callback: Any) -> str:
    """Return the name of a callback if a frame runs it, otherwise an empty string."""
    while isinstance(callback, partial):
        callback = callback.func
    function = getattr(callback, '__func__', getattr(callback, '__wrapped__', callback))
    if not hasattr(function, '__code__'):
        # An object that is called.
        callback = getattr(callback, '__call__', callback)  # noqa: B004
        function = getattr(callback, '__func__', callback)
    if getattr(function, '__code__', None) is not frame.f_code:
        return ''
    # Functions of one definition, as that which decodes the messages of our nodes, differ in what they
    # enclose.
    variables = frame.f_locals
    for name, cell in zip(frame.f_code.co_freevars, function.__closure__ or (), strict=False):
        with suppress(ValueError):
            if variables.get(name) is not cell.cell_contents:
                return ''
    owner = getattr(callback, '__self__', None)
    if owner is not None and frame.f_code.co_varnames:
        first = frame.f_locals.get(frame.f_code.co_varnames[0])
        if first is not owner and not (isinstance(first, tuple) and first[:1] == (owner,)):
            return ''
    return str(getattr(callback, '__qualname__', frame.f_code.co_name))
