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

"""Processes that run worlds, and the executors of this machine that use them.

A `Lockstep` needs the main thread of its process. So a thread, of the default executor or of a worker
of Dask, has a process of its own. It lives as long as its thread, and ends with the process that started
it, also if that was killed while a world runs that does not end.
"""

from __future__ import annotations

import importlib
import os
import pickle
import select
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import suppress
from multiprocessing.connection import Connection, Pipe
from typing import Any, ParamSpec, TypeVar

import rclpy

from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.exploration.scenario import ExplorationError
from diffdrive_jacobian.exploration.trial import DIED, Outcome, Setting, Trial, Violation, run
from diffdrive_jacobian.text import error_text

P = ParamSpec('P')
T = TypeVar('T')

serving = False
"""Whether this is a process that runs worlds."""
MODULE = 'diffdrive_jacobian.exploration.processes'


class ChildDiedError(DiffdriveError):
    """The process ended without an answer; the message says how."""


class ChildProcess:
    """A Python process that executes functions in its main thread.

    It starts with a call, if there is none or it has ended.
    """

    def __init__(self) -> None:
        """Start no process yet."""
        self._process: subprocess.Popen[bytes] | None = None
        self.closed = False
        """Whether none may be started any more."""

    def call(self, function: Any, *args: Any) -> Any:
        """Call a function of a module in the process, and return what it returns.

        Raises:
            ChildDiedError: The process ended. The next call starts another one.
            Exception: What the function raises.
        """
        process = self._process
        if process is None or process.returncode is not None:
            self._connection, theirs = Pipe()
            with theirs:
                self._process = process = subprocess.Popen(
                    [sys.executable, '-m', MODULE, str(theirs.fileno())],
                    stdin=subprocess.DEVNULL,
                    # What nodes print must not mix with what the program prints about them.
                    stdout=2,
                    pass_fds=[theirs.fileno()],
                    # Ctrl-C in a terminal is for this process, which ends the child.
                    start_new_session=True,
                    env={**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, sys.path))},
                )
            if self.closed:
                # Another thread has ended the one before.
                self.end()
        try:
            self._connection.send((function, args))
            failed, result = self._connection.recv()
        except (EOFError, ConnectionError):
            code = process.wait()
            how = f'was ended by signal {-code}' if code < 0 else f'ended with exit code {code}'
            raise ChildDiedError(f'the process of the world {how}') from None
        except BaseException:
            # Its answer would be taken for that of the next call.
            self.end()
            raise
        if failed:
            raise result
        return result

    def end(self) -> None:
        """End the process. A call in another thread raises ChildDiedError."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def __del__(self) -> None:
        """End the process with the thread that it belongs to."""
        self.end()


_of_thread = threading.local()


def call_in_child(function: Any, *args: Any, afresh: bool = False) -> Any:
    """Call a function in the process of this thread, or in a new one that ends afterwards if `afresh`.

    Raises:
        ChildDiedError: The process ended. The next call starts another one.
        Exception: What the function raises.
    """
    child: ChildProcess = _of_thread.__dict__.setdefault('child', ChildProcess())
    if not afresh:
        return child.call(function, *args)
    child.end()
    try:
        return child.call(function, *args)
    finally:
        child.end()


# --- In the process


def _serve(connection: Connection) -> None:
    """Execute the functions that come from a connection, until it ends."""
    # As of the module that others import: this one is __main__.
    importlib.import_module(MODULE).serving = True  # type: ignore[attr-defined]
    threading.Thread(target=_end_with, args=(connection.fileno(),), daemon=True).start()
    while True:
        try:
            data = connection.recv_bytes()
        except (EOFError, ConnectionError):
            return
        try:
            function, args = pickle.loads(data)
            answer = pickle.dumps((False, function(*args)))
        except Exception as error:
            answer = pickle.dumps((True, _picklable(error)))
        with suppress(ConnectionError):
            connection.send_bytes(answer)


def _end_with(descriptor: int) -> None:
    """End this process when that which sends requests has ended, also while a request is executed."""
    hung_up = select.poll()
    # Not for what can be read, which is for the main thread.
    hung_up.register(descriptor, 0)
    hung_up.poll()
    os._exit(0)


def _picklable(error: Exception) -> Exception:
    """Return an error that another process can read."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f'{type(error).__name__}: {error_text(error)}')
    return error


# --- Tasks of an executor


def packed(
    setting: Setting, trials: Sequence[Trial], *, only: int | None = None, digest: bool = False
) -> bytes:
    """Return the arguments of `run_worlds` as bytes.

    Raises:
        ExplorationError: They cannot be pickled.
    """
    try:
        return pickle.dumps((setting, tuple(trials), only, digest))
    except Exception as error:
        raise ExplorationError(
            'properties, cases and faults are sent to other processes, so they must be picklable: '
            f'{type(error).__name__}: {error_text(error)}'
        ) from error


def can_run_here() -> bool:
    """Return whether this thread may open a `Lockstep`."""
    return threading.current_thread() is threading.main_thread() and not rclpy.ok()


def run_worlds(data: bytes, *, afresh: bool = False) -> list[Outcome]:
    """Run `packed` worlds, in this process if it can run a `Lockstep`, else in one of its own.

    Args:
        data: The worlds.
        afresh: Whether to run them, each, in a new process. That one ends it is a finding.

    Raises:
        ExplorationError: The scenario cannot be imported, or a fault or property is invalid.
    """
    if can_run_here() and not afresh:
        return _run_here(data)
    try:
        return list(call_in_child(_run_here, data, afresh=afresh))
    except ChildDiedError as error:
        setting, trials, only, digest = pickle.loads(data)
        if afresh:
            died = Violation(key=str(error), seconds=0.0, text=str(error), name=DIED)
            return [Outcome(violations=(died,))]
        # One of the worlds has ended it.
        alone = (packed(setting, [trial], only=only, digest=digest) for trial in trials)
        return [run_worlds(one, afresh=True)[0] for one in alone]


def _run_here(data: bytes) -> list[Outcome]:
    setting, trials, only, digest = pickle.loads(data)
    return [run(setting, trial, only=only, digest=digest) for trial in trials]


# --- Executors


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
        self._children: list[ChildProcess] = []
        super().__init__(workers or _cores(), initializer=_own_child, initargs=(self._children,))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes, also those that are running a world if `cancel_futures` is true."""
        if cancel_futures:
            super().shutdown(wait=False, cancel_futures=True)
            self._end_children()
        super().shutdown(wait=wait, cancel_futures=cancel_futures)
        if wait:
            self._end_children()

    def _end_children(self) -> None:
        for child in self._children:
            child.closed = True
            child.end()


def _own_child(children: list[ChildProcess]) -> None:
    """Give this thread a process that the executor can end."""
    _of_thread.child = ChildProcess()
    children.append(_of_thread.child)


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


def _cores() -> int:
    """Return the number of cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:
        # Not on every system.
        return os.cpu_count() or 1


if __name__ == '__main__':
    _serve(Connection(int(sys.argv[1])))
