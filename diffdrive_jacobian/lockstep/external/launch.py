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

"""Run a command, and end all that it has started when it ends, or when nobody waits for it any more.

    python -IS launch.py PROGRAM ARGUMENT ...

Standard input is a pipe from the world that has started this. When anything arrives there, or the world
is gone, everything is killed. Descendants whose parents have ended become children of this process, so
none is missed. It ends as the command does.
"""

import ctypes
import fcntl
import os
import resource
import select
import signal
import sys

PR_SET_CHILD_SUBREAPER = 36
ADDR_NO_RANDOMIZE = 0x0040000
SEGMENT = '/dev/shm/fastrtps_'
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
"""Signals to the group, which are for the command."""


def main() -> None:
    """Run the command that the arguments give."""
    libc = ctypes.CDLL(None)
    libc.prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    # Executors call what is ready in the order of addresses.
    libc.personality(libc.personality(0xFFFFFFFF) | ADDR_NO_RANDOMIZE)
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    try:
        pid = os.posix_spawnp(
            sys.argv[1],
            sys.argv[1:],
            os.environ,
            file_actions=[(os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0)],
            # Python ignores the last two.
            setsigdef=(*SIGNALS, signal.SIGPIPE, signal.SIGXFSZ),
        )
    except OSError as error:
        sys.exit(f'{sys.argv[1]} cannot be started: {error}')
    status = None
    while status is None and 0 not in select.select([0, reader], [], [])[0]:
        os.read(reader, 100)
        status = ended_children(os.WNOHANG).get(pid)
    segments: set[str] = set()
    while children := own_children():
        for child in children:
            segments |= shared_memory_of(child)
            os.kill(child, signal.SIGKILL)
        status = ended_children(0).get(pid, status)
    remove_abandoned(segments)
    code = os.waitstatus_to_exitcode(status or 0)
    if code >= 0:
        os._exit(code)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if -code not in (signal.SIGKILL, signal.SIGSTOP):
        signal.signal(-code, signal.SIG_DFL)
    os.kill(os.getpid(), -code)


def shared_memory_of(pid: int) -> set[str]:
    """Return the files of Fast DDS in shared memory that a process has mapped."""
    try:
        with open(f'/proc/{pid}/maps', encoding='utf-8', errors='replace') as maps:
            mapped = {line.split(maxsplit=5)[-1].strip() for line in maps if SEGMENT in line}
    except OSError:
        return set()
    return {name for name in mapped if name.startswith(SEGMENT)}


def remove_abandoned(segments: set[str]) -> None:
    """Remove the files of processes that were killed. Those of living ones are locked (`NAME_el`)."""
    for name in segments:
        try:
            with open(f'{name}_el', 'rb') as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                os.unlink(name)
                os.unlink(f'{name}_el')
        except OSError:
            # It is in use, or has gone, or has no lock.
            pass


def own_children() -> list[int]:
    """Return the ids of the children, also of those that have ended and were not waited for."""
    with open(f'/proc/self/task/{os.getpid()}/children', encoding='ascii') as file:
        return [int(child) for child in file.read().split()]


def ended_children(options: int) -> dict[int, int]:
    """Wait for children that have ended. Return the status of each. 0: wait for one, at least."""
    found = {}
    try:
        while (ended := os.waitpid(-1, options))[0]:
            found[ended[0]] = ended[1]
            options = os.WNOHANG
    except ChildProcessError:
        pass
    return found


if __name__ == '__main__':
    main()
