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

"""A hand-in: functions in a file of somebody else, which run in a process of their own."""

from __future__ import annotations

import difflib
import json
import queue
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.grading import student
from diffdrive_jacobian.grading.answers import as_numbers, shown
from diffdrive_jacobian.text import printable

SECONDS = 5.0
"""Longest duration of a call (s)."""
PROCESSOR = 60
"""Longest time of the processor that one process may use (s)."""
START = 20.0
"""Longest time until the process runs (s)."""


class HandInError(DiffdriveError, AssertionError):
    """A hand-in lacks a function, failed, took too long, or did what it may not. The message says so."""


class HandIn:
    """The functions of a file, called in a process that may open no file and is ended in time."""

    def __init__(self, path: str | Path, *, seconds: float = SECONDS) -> None:
        """Start the process.

        Args:
            path: The file.
            seconds: Longest duration of a call (s).

        Raises:
            HandInError: It cannot be read or run.
        """
        self.path, self._seconds = Path(path), seconds
        if not self.path.is_file():
            raise HandInError(f'there is no file {printable(self.path)}')
        # Isolated: neither the folder nor the variables of whoever grades count.
        command = [sys.executable, '-I', student.__file__, str(self.path.resolve()), str(PROCESSOR)]
        # Where it finds nothing.
        self._folder = tempfile.TemporaryDirectory()
        self._process = subprocess.Popen(
            command,
            cwd=self._folder.name,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env={'OPENBLAS_NUM_THREADS': '1', 'PYTHONDONTWRITEBYTECODE': '1', **_needed()},
        )
        # One answer at a time: a flood waits in the pipe.
        self._answers: queue.Queue[bytes] = queue.Queue(1)
        self._thread = threading.Thread(target=self._receive, daemon=True)
        self._thread.start()
        self._names: list[str] = []
        what = f'{self.path.name}'
        self._answer(what, START)
        kind, value = self._answer(what, seconds)
        if kind != 'ready':
            self.close()
            raise HandInError(f'{what} cannot be run: {value}')
        self._names = value

    def _receive(self) -> None:
        assert self._process.stdout is not None
        while True:
            line = self._process.stdout.readline(2 * student.LONGEST)
            self._answers.put(line)
            if not line:
                self._process.stdout.close()
                return

    def _answer(self, what: str, seconds: float) -> tuple[str, Any]:
        try:
            line = self._answers.get(timeout=seconds)
        except queue.Empty:
            self.close()
            raise HandInError(
                f'{what} took longer than {seconds:g} s: is there a loop without end?'
            ) from None
        if not line:
            self.close()
            code = self._process.returncode
            why = f'signal {-code}' if code < 0 else f'exit code {code}'
            raise HandInError(f'{what} has ended the process ({why})')
        try:
            kind, value = json.loads(line)
        except (ValueError, TypeError, RecursionError):
            self.close()
            raise HandInError(f'{what} has written what is no answer') from None
        if kind == 'ready' and not isinstance(value, list):
            self.close()
            raise HandInError(f'{what} has written what is no answer')
        return str(kind), value

    def has(self, name: str) -> bool:
        """Return whether there is a function of a name."""
        return name in self._names

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a function.

        Args:
            name: Its name.
            arguments: Numbers, texts, arrays, and lists of these.

        Returns:
            What it returned: numbers, texts, lists, and arrays.

        Raises:
            HandInError: There is none, it failed, took too long, or did what it may not.
        """
        if self._process.poll() is not None:
            raise HandInError(f'{self.path.name} has ended before')
        what = f'{name}({", ".join(map(shown, arguments))})'
        if name not in self._names:
            close = difflib.get_close_matches(name, self._names, n=1)
            hint = f': is it {close[0]}?' if close else ''
            raise HandInError(f'there is no function {name} in {self.path.name}{hint}')
        assert self._process.stdin is not None
        request = json.dumps([name, [_sent(one) for one in arguments]])
        try:
            self._process.stdin.write(request.encode() + b'\n')
            self._process.stdin.flush()
        except OSError:
            raise HandInError(f'{self.path.name} has ended before') from None
        kind, value = self._answer(what, self._seconds)
        if kind != 'value':
            raise HandInError(f'{what}: {value}')
        try:
            return _received(value)
        except (KeyError, TypeError, ValueError, MemoryError, RecursionError):
            raise HandInError(f'{what} has written what is no answer') from None

    def array(self, name: str, *arguments: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
        """Call a function that must return finite numbers of a shape; the rest as for `call`.

        Raises:
            HandInError: It returned something else, or as for `call`.
        """
        found = self.call(name, *arguments)
        what = f'{name}({", ".join(map(shown, arguments))})'
        numbers = as_numbers(found)
        if numbers is None or numbers.shape != shape or not np.isfinite(numbers).all():
            wanted = f'finite numbers of shape {shape}' if shape else 'a finite number'
            raise HandInError(f'{what} must return {wanted}, got {shown(found)}')
        return numbers

    def function(self, name: str) -> Callable[..., Any]:
        """Return a function that calls one of the hand-in, for a control law for example."""
        return lambda *arguments: self.call(name, *arguments)

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        while self._thread.is_alive():
            # It may wait for somebody to take an answer.
            with suppress(queue.Empty):
                self._answers.get(timeout=0.01)
        for pipe in (self._process.stdin, self._process.stderr):
            if pipe is not None:
                pipe.close()
        self._folder.cleanup()


def _needed() -> dict[str, str]:
    """Return the variables without which Python does not run, on Windows."""
    import os

    return {name: os.environ[name] for name in ('SYSTEMROOT', 'TEMP') if name in os.environ}


def _sent(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {'array': value.tolist(), 'shape': value.shape}
    if isinstance(value, np.generic):
        return value.item()
    return [_sent(one) for one in value] if isinstance(value, (list, tuple)) else value


def _received(value: Any) -> Any:
    if isinstance(value, dict):
        return np.array(value['array']).reshape(value['shape'])
    return [_received(one) for one in value] if isinstance(value, list) else value
