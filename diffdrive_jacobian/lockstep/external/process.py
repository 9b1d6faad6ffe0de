"""Processes that a test starts, and the ROS domain in which they meet the world."""

from __future__ import annotations

import itertools
import os
import shlex
import signal
import socket
import subprocess
import threading
import time
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.ros.fastdds_profiles import VARIABLE
from diffdrive_jacobian.ros.runner import DISCOVERY

DOMAINS = range(1, 102)
"""Domains to choose from. 0 is everybody's; those above have ports that Linux gives to clients."""
PARTICIPANTS = 32
"""Number of participants of a domain whose ports are looked at. Each process has one or more."""
SHOWN_LINES = 15
"""Number of lines that an error quotes of what a process printed."""
CLOSING = 5.0
"""Time for a process to end after SIGINT (s). Then it is killed."""
NAP = 0.005
"""Period at which the end of a process is checked (s)."""
WORLD = 'LOCKSTEP_WORLD'
"""Environment variable of all processes that a world has started, and of those that they start."""
_numbers = itertools.count()


def free_domain() -> int:
    """Return a ROS domain that no process on this machine uses.

    Workers of pytest-xdist choose from different domains.

    Raises:
        LockstepError: There is none.
    """
    worker = int(os.environ.get('PYTEST_XDIST_WORKER', 'gw0').removeprefix('gw'))
    workers = int(os.environ.get('PYTEST_XDIST_WORKER_COUNT', '1'))
    domains = DOMAINS[worker % len(DOMAINS) :: workers]
    # Other programs on this machine begin elsewhere.
    first = zlib.crc32(str(os.getpid()).encode()) + next(_numbers)
    for number in range(len(domains)):
        domain = domains[(first + number) % len(domains)]
        if all(map(_is_free, _ports(domain))):
            return domain
    raise LockstepError(
        f'{len(domains)} ROS domains from {domains[0]} to {domains[-1]} are all in use on this machine: '
        'give domain_id='
    )


def _ports(domain: int) -> list[int]:
    """Return the UDP ports for discovery: multicast, and unicast of each participant.

    All of them: with discovery on the own machine only, no process may use the first, and the process
    of the first participant may have ended before the others.
    """
    multicast = 7400 + 250 * domain
    return [multicast, *(multicast + 10 + 2 * participant for participant in range(PARTICIPANTS))]


def _is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(('', port))
        except OSError:
            return False
    return True


class ExternalProcess:
    """A process in the ROS domain of a world, as of `Lockstep.start`. It is ended with the world."""

    def __init__(
        self, command: Sequence[str], environment: Mapping[str, str], directory: Path, cwd: str | None
    ) -> None:
        """Start it.

        Args:
            command: The program and its arguments.
            environment: Variables that differ from those of this process.
            directory: Folder for what it prints, of the world alone.
            cwd: Its working directory; None: that of this process.

        Raises:
            LockstepError: It cannot be started.
        """
        self.command = shlex.join(command)
        """The command line."""
        self.world = str(directory)
        """What identifies the world that has started it."""
        self.ended_by_test = False
        """Whether the test has ended it."""
        self._kept: dict[int, str] = {}
        number = next(_numbers)
        self._files = [directory / f'{number}.{name}' for name in ('out', 'err')]
        # Not what isolates this process, or the profiles of Fast DDS that it uses.
        inherited = {
            name: value for name, value in os.environ.items() if name not in (VARIABLE, *DISCOVERY)
        }
        try:
            with (
                self._files[0].open('wb') as out,
                self._files[1].open('wb') as err,
                _children_receive_sigint(),
            ):
                self._process = subprocess.Popen(
                    list(command),
                    stdin=subprocess.DEVNULL,
                    stdout=out,
                    stderr=err,
                    env={**inherited, **environment, WORLD: str(directory)},
                    cwd=cwd,
                    # With a group of its own, so that children, as of `ros2 run`, receive signals, too.
                    start_new_session=True,
                )
        except OSError as error:
            raise LockstepError(f'{self.command} cannot be started: {error}') from error

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    @property
    def returncode(self) -> int | None:
        """Exit code, negative if a signal ended it. None: it runs. Its children end with it."""
        options = os.WEXITED | os.WNOHANG | os.WNOWAIT
        if self._process.returncode is None and os.waitid(os.P_PID, self.pid, options):
            # Until it is waited for, its id belongs to its group.
            os.killpg(self.pid, signal.SIGKILL)
        return self._process.poll()

    @property
    def stdout(self) -> str:
        """What it has printed on the standard output."""
        return self._printed(0)

    @property
    def stderr(self) -> str:
        """What it has printed on the standard error stream."""
        return self._printed(1)

    def _printed(self, number: int) -> str:
        text = self._kept.get(number)
        return self._files[number].read_text(errors='replace') if text is None else text

    def close(self) -> None:
        """End it, and keep what it printed."""
        self.stop()
        self._kept = {number: self._printed(number) for number in range(len(self._files))}

    def signal(self, number: int) -> None:
        """Send a signal to it and its children. Nothing happens if it has ended."""
        if self.returncode is None:
            os.killpg(self.pid, number)

    def stop(self, timeout: float = CLOSING) -> int:
        """End it by SIGINT, and kill it if it does not end. Return the exit code.

        The answers that were declared with it are not awaited any more.

        Args:
            timeout: Longest time for its end (s).
        """
        self.ended_by_test = True
        self.signal(signal.SIGINT)
        return self._join(timeout)

    def kill(self) -> None:
        """Kill it. The answers that were declared with it are not awaited any more."""
        self.ended_by_test = True
        self._join(0.0)

    def _join(self, timeout: float) -> int:
        end = time.monotonic() + timeout
        while (code := self.returncode) is None and time.monotonic() < end:
            time.sleep(NAP)
        if code is None:
            self.signal(signal.SIGKILL)
            code = self._process.wait()
        return code

    def describe(self) -> str:
        """Return its state, and the end of what it printed if it has ended."""
        code = self.returncode
        if code is None:
            state = f'{self.command} (pid {self.pid}) is running'
        elif code < 0:
            state = f'{self.command} was ended by {_signal_name(-code)}'
        else:
            state = f'{self.command} has exited with {code}'
        printed = (self._printed(1) or self._printed(0)).splitlines()
        return '\n    '.join([state, *printed[-SHOWN_LINES:]])


@contextmanager
def _children_receive_sigint() -> Iterator[None]:
    """Make processes that are started meanwhile receive SIGINT, which ends them.

    If a shell has started this process in the background, this process ignores SIGINT, and what it
    starts would, too. A new process has no handlers of this one. Only the main thread can set them.
    """
    ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    if not ignored or threading.current_thread() is not threading.main_thread():
        yield
        return
    signal.signal(signal.SIGINT, lambda *_: None)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def end_all(processes: Sequence[ExternalProcess]) -> None:
    """End processes at the same time, with all that they have started."""
    for process in processes:
        process.signal(signal.SIGCONT)
        process.signal(signal.SIGINT)
    for process in processes:
        process.close()
    for world in {process.world for process in processes}:
        # They may start others meanwhile.
        while left := list(_processes_of(world)):
            for pid in left:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            time.sleep(NAP)


def _processes_of(world: str) -> Iterator[int]:
    """Yield the ids of the processes that a world has started, also in sessions of their own.

    Only on Linux. The variable is not there any more if a program has replaced its environment.
    """
    marked = f'{WORLD}={world}'.encode()
    for variables in Path('/proc').glob('[0-9]*/environ'):
        with suppress(OSError):
            if marked in variables.read_bytes().split(b'\0'):
                yield int(variables.parent.name)


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f'signal {number}'
