"""Executors of this machine: all cores, or this thread alone."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import Any, ParamSpec, TypeVar

from diffdrive_jacobian.exploration.child import Children, own_children

P = ParamSpec('P')
T = TypeVar('T')


class LocalExecutor(ThreadPoolExecutor):
    """Runs worlds on all cores, or on as many as are given, each in a process of its own.

    The processes import the module of the scenario, and never the program that explores. So a script
    needs no `if __name__ == '__main__'`, other than with a ProcessPoolExecutor.
    """

    def __init__(self, workers: int | None = None) -> None:
        """Start without processes.

        Args:
            workers: Number of processes; None: one for each core that this process may use.
        """
        self._children = Children()
        super().__init__(workers or cores(), initializer=own_children, initargs=(self._children,))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes, also those that are running a world if `cancel_futures` is true."""
        if cancel_futures:
            super().shutdown(wait=False, cancel_futures=True)
            self._end_children()
        super().shutdown(wait=wait, cancel_futures=cancel_futures)
        if wait:
            self._end_children()

    def _end_children(self) -> None:
        self._children.closed = True
        for child in list(self._children):
            child.close()


class SerialExecutor(Executor):
    """Executes everything at once in the calling thread: for debuggers, and for exploring in a test."""

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Execute a function and return its finished future."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def cores() -> int:
    """Return the number of cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:
        # Not on every system.
        return os.cpu_count() or 1
