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

"""Processes that a test starts."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep.external.launch import remove_abandoned, shared_memory_of
from diffdrive_jacobian.lockstep.external.linux import first_child, has_random_addresses
from diffdrive_jacobian.ros.fastdds_profiles import VARIABLE
from diffdrive_jacobian.ros.runner import DISCOVERY
from diffdrive_jacobian.text import printable

SHOWN_LINES = 15
"""Number of lines that an error quotes of what a process printed."""
TITLE = 160
"""Most characters of a command line that an error quotes, so that its reason follows soon."""
LINE = 500
"""Most characters of a line that an error quotes."""
CLOSING = 5.0
"""Time for a process to end after SIGINT (s). Then it is killed."""
NAP = 0.005
"""Period at which the end of a process is checked (s)."""
LAUNCHER = [sys.executable, '-IS', str(Path(__file__).with_name('launch.py'))]
"""Command that runs another one, and ends all that it has started."""
FATAL = (signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGKILL)


class ExternalProcess:
    """A process with all that it starts. It ends with this one, however that ends."""

    def __init__(
        self,
        command: Sequence[str],
        environment: Mapping[str, str] | None = None,
        cwd: str | None = None,
        unnamed: Sequence[str] = (),
    ) -> None:
        """Start it.

        Args:
            command: The program and its arguments.
            environment: Variables that differ from those of this process.
            cwd: Its working directory; None: that of this process.
            unnamed: Further arguments, which errors do not name.

        Raises:
            LockstepError: It cannot be started.
        """
        self.command = shlex.join(command)
        """The command line."""
        self.title = printable(self.command, TITLE)
        """The command line as errors name it."""
        self.ended_by_test = False
        """Whether the test has ended it."""
        self._signals: set[int] = set()
        """What the test has sent."""
        self.wake: Callable[[], object] = lambda: None
        """Called while it is waited for: Python notices a signal only when its node is woken up."""
        self._files = [tempfile.TemporaryFile() for _ in range(2)]  # noqa: SIM115
        self._printed = ['', '']
        self._segments: set[str] = set()
        # Not what isolates this process, or the profiles of Fast DDS that it uses.
        inherited = {
            name: value for name, value in os.environ.items() if name not in (VARIABLE, *DISCOVERY)
        }
        try:
            self._process = subprocess.Popen(
                [*LAUNCHER, *command, *unnamed],
                stdin=subprocess.PIPE,
                stdout=self._files[0],
                stderr=self._files[1],
                env={**inherited, **(environment or {})},
                cwd=cwd,
                # With a group of its own, so that children, as of `ros2 run`, receive signals, too.
                start_new_session=True,
            )
        except OSError as error:
            for file in self._files:
                file.close()
            raise LockstepError(f'{self.title} cannot be started: {error}') from error
        self.root = self._process.pid
        """Id of the process from which all others descend."""
        self.pid = self.root
        """Process id of the command."""
        while self.pid == self.root and self.returncode is None:
            self.pid = first_child(self.root) or self.root
            time.sleep(NAP)

    @property
    def has_ended_well(self) -> bool:
        """Whether it has ended with exit code 0, or by a signal of the test."""
        code = self.returncode
        if code is None:
            return False
        by_signal = -code in self._signals or any(
            number in self._signals for number in _signals_in(code)
        )
        return code == 0 or self.ended_by_test or by_signal

    def check_running(self, node: str = '') -> None:
        """Raise LockstepError if it has ended by itself. `node` says what depends on it."""
        if self.returncode is not None and not self.ended_by_test:
            what = f'{node}: ' if node else ''
            background = '\n  what runs in the background ends then: start it in the foreground'
            raise LockstepError(
                f'{what}{self.describe()}{"" if self.returncode or node else background}'
            )

    def check_addresses(self) -> None:
        """Raise LockstepError if the addresses of the process are random."""
        if has_random_addresses(self.root):
            raise LockstepError(
                'addresses of processes are random here, and executors call what is ready in the order '
                'of addresses: a container needs --security-opt seccomp=unconfined'
            )

    @property
    def returncode(self) -> int | None:
        """Exit code, negative if a signal ended it. None: it runs. Its children end with it."""
        return self._process.poll()

    def printed(self, number: int) -> str:
        """Return what it has printed on the standard output (0) or the standard error stream (1)."""
        file = self._files[number]
        if not file.closed:
            # The position in the file is that of the process, too.
            size = os.fstat(file.fileno()).st_size
            self._printed[number] = os.pread(file.fileno(), size, 0).decode(errors='replace')
        return self._printed[number]

    def signal(self, number: int) -> None:
        """Send a signal to it and its children. Nothing happens if it has ended."""
        if not isinstance(number, int) or number not in signal.valid_signals():
            raise LockstepError(f'signal takes its number, got {printable(repr(number), 200)}')
        self._signals.add(number)
        if number == signal.SIGKILL:
            self.kill()
        elif self.returncode is None:
            # A program that ends by an exception of its handler leaves them, too.
            self._segments |= shared_memory_of(self.pid)
            os.killpg(self.root, number)

    def note_shared_memory(self, pids: Iterable[int]) -> None:
        """Note the files in shared memory of its processes, which are removed when it has ended."""
        for pid in pids:
            self._segments |= shared_memory_of(pid)

    def stop(self, timeout: float = CLOSING) -> int:
        """End it by SIGINT, and kill it if it does not end. Return the exit code.

        Args:
            timeout: Longest time for its end (s).
        """
        self.ended_by_test = True
        self.signal(signal.SIGINT)
        end = time.monotonic() + timeout
        while (code := self.returncode) is None and time.monotonic() < end:
            self.wake()
            time.sleep(NAP)
        code = self.kill() if code is None else code
        remove_abandoned(self._segments)
        return code

    def kill(self) -> int:
        """Kill it with all that it has started. Return the exit code."""
        self.ended_by_test = True
        if self.returncode is None:
            os.killpg(self.root, signal.SIGCONT)
            assert self._process.stdin is not None
            with suppress(BrokenPipeError):
                os.write(self._process.stdin.fileno(), b'\n')
        return self._process.wait()

    def close(self) -> None:
        """End it, and keep what it printed."""
        self.stop()
        for number, file in enumerate(self._files):
            self.printed(number)
            file.close()
        assert self._process.stdin is not None
        self._process.stdin.close()

    def describe(self) -> str:
        """Return its state, and the end of what it printed."""
        code = self.returncode
        if code is None:
            state = f'{self.title} (pid {self.pid}) is running'
        elif code < 0:
            state = f'{self.title} was ended by {_signal_name(-code)}'
        elif code > 128 and (name := _signal_of_child(code)):
            state = f'{self.title} has exited with {code}: what it started was ended by {name}'
        else:
            state = f'{self.title} has exited with {code}'
        lines = [state]
        for number, name in enumerate(('stdout', 'stderr')):
            if shown := self.printed(number).splitlines()[-SHOWN_LINES:]:
                lines += [f'  {name}:', *(f'    {printable(line, LINE)}' for line in shown)]
        return '\n'.join(lines)


def end_all(processes: Sequence[ExternalProcess]) -> None:
    """End processes at the same time, with all that they have started."""
    for process in processes:
        process.ended_by_test = True
        process.signal(signal.SIGCONT)
        process.signal(signal.SIGINT)
    for process in processes:
        process.close()


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f'signal {number}'


def _signal_of_child(code: int) -> str:
    """Return the signal that has ended a child, by the exit code of its parent; empty: none.

    A shell exits with 128 + signal, and `ros2 run` with 256 - signal.
    """
    found = [number for number in _signals_in(code) if number in FATAL]
    return _signal_name(found[0]) if found else ''


def _signals_in(code: int) -> tuple[int, int]:
    """Return which signals an exit code may stand for."""
    return code - 128, 256 - code
