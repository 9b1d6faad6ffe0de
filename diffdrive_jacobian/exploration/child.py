"""Processes that run worlds, one for each thread.

A `Lockstep` needs the main thread of its process. So a thread, of the default executor or of a worker
of Dask, has a process of its own. It lives as long as its thread, and ends with the process that started
it, also if that was killed while a world runs that does not end.
"""

from __future__ import annotations

import importlib
import os
import pickle
import select
import struct
import subprocess
import sys
import threading
from contextlib import suppress
from typing import IO, Any

from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.text import error_text

serving = False
"""Whether this is a process that runs worlds."""
LENGTH = struct.Struct('>Q')
MODULE = 'diffdrive_jacobian.exploration.child'


class Children(set['ChildProcess']):
    """The processes of an executor."""

    closed = False
    """Whether no more may be started."""


class ChildDiedError(DiffdriveError):
    """The process ended without an answer; the message says how."""


class ChildProcess:
    """A Python process that executes functions in its main thread."""

    def __init__(self) -> None:
        """Start the process."""
        answers, write = os.pipe()
        # In a session of its own: Ctrl-C in a terminal is for this process, which ends the child.
        try:
            self._process = subprocess.Popen(
                [sys.executable, '-m', MODULE, str(write)],
                stdin=subprocess.PIPE,
                pass_fds=[write],
                start_new_session=True,
                env={**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, sys.path))},
            )
        except BaseException:
            os.close(answers)
            raise
        finally:
            os.close(write)
        self._answers = os.fdopen(answers, 'rb')

    def call(self, function: Any, *args: Any) -> Any:
        """Call a function of a module in the process, and return what it returns.

        Raises:
            ChildDiedError: The process ended.
            Exception: What the function raises.
        """
        assert self._process.stdin is not None
        try:
            _send(self._process.stdin, pickle.dumps((function, args)))
            failed, result = pickle.loads(_receive(self._answers))
        except (BrokenPipeError, EOFError):
            code = self._process.wait()
            how = f'was ended by signal {-code}' if code < 0 else f'ended with exit code {code}'
            raise ChildDiedError(f'the process of the world {how}') from None
        except BaseException:
            # Its answer would be taken for that of the next call.
            self.close()
            raise
        if failed:
            raise result
        return result

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        if self._process.stdin is not None:
            with suppress(BrokenPipeError):
                self._process.stdin.close()
        self._answers.close()

    def __del__(self) -> None:
        """End the process with the thread that it belongs to."""
        if hasattr(self, '_process') and self._process.returncode is None:
            self.close()


_of_thread = threading.local()


def own_children(children: Children) -> None:
    """Keep the process of this thread in a set, as long as it lives."""
    _of_thread.children = children


def _children() -> Children:
    children: Children = _of_thread.__dict__.setdefault('children', Children())
    return children


def call_in_child(function: Any, *args: Any) -> Any:
    """Call a function in the process of this thread, and return what it returns.

    Raises:
        ChildDiedError: The process ended. The next call starts another one.
        Exception: What the function raises.
    """
    child: ChildProcess | None = getattr(_of_thread, 'child', None)
    if child is None:
        if _children().closed:
            raise ChildDiedError('the executor was shut down')
        child = _of_thread.child = ChildProcess()
        _children().add(child)
    try:
        return child.call(function, *args)
    except ChildDiedError:
        close_child()
        raise
    except BaseException:
        if child._process.returncode is not None:
            close_child()
        raise


def call_in_fresh_child(function: Any, *args: Any) -> Any:
    """Call a function in a new process, which ends afterwards, and return what it returns.

    Raises:
        ChildDiedError: The process ended.
        Exception: What the function raises.
    """
    children = _children()
    if children.closed:
        raise ChildDiedError('the executor was shut down')
    child = ChildProcess()
    children.add(child)
    try:
        return child.call(function, *args)
    finally:
        children.discard(child)
        child.close()


def close_child() -> None:
    """End the process of this thread, if it has one."""
    child = _of_thread.__dict__.pop('child', None)
    if child is not None:
        _children().discard(child)
        child.close()


def _send(stream: IO[bytes], data: bytes) -> None:
    stream.write(LENGTH.pack(len(data)) + data)
    stream.flush()


def _receive(stream: IO[bytes]) -> bytes:
    """Return the next message.

    Raises:
        EOFError: The stream has ended.
    """
    header = stream.read(LENGTH.size)
    if len(header) < LENGTH.size:
        raise EOFError
    (length,) = LENGTH.unpack(header)
    data = stream.read(length)
    if len(data) < length:
        raise EOFError
    return data


def _serve(descriptor: int) -> None:
    """Execute the functions that come from standard input, until it ends.

    Args:
        descriptor: File descriptor for the answers.
    """
    # As of the module that others import: this one is __main__.
    importlib.import_module(MODULE).serving = True  # type: ignore[attr-defined]
    requests = os.fdopen(os.dup(0), 'rb')
    answers = os.fdopen(descriptor, 'wb')
    threading.Thread(target=_end_with, args=(requests,), daemon=True).start()
    # A scenario that reads its input must not wait for that of this function.
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    # What nodes print must not mix with what the program prints about them.
    os.dup2(2, 1)
    while True:
        try:
            data = _receive(requests)
        except EOFError:
            return
        try:
            function, args = pickle.loads(data)
            answer = pickle.dumps((False, function(*args)))
        except Exception as error:
            answer = pickle.dumps((True, _picklable(error)))
        try:
            _send(answers, answer)
        except BrokenPipeError:
            # The process that asked is gone. The interpreter would complain that it cannot flush.
            os._exit(0)


def _end_with(requests: IO[bytes]) -> None:
    """End this process when that which sends requests has ended, also while a request is executed."""
    hung_up = select.poll()
    # Not for what can be read, which is for the main thread.
    hung_up.register(requests, 0)
    hung_up.poll()
    os._exit(0)


def _picklable(error: Exception) -> Exception:
    """Return an error that another process can read."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f'{type(error).__name__}: {error_text(error)}')
    return error


if __name__ == '__main__':
    _serve(int(sys.argv[1]))
