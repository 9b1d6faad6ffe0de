"""Processes of `external_nodes` from forks, which have done their imports: half a second of CPU each.

Lockstep starts a program by its launcher, which starts the program and waits. Here both are forks of the
server of `forked`. All else is as usual: the launcher itself, the processes, their signals and streams.
"""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import contextmanager
from types import SimpleNamespace
from unittest import mock

import external_nodes
from fork_server import forked
from std_msgs.msg import Float64

from diffdrive_jacobian.lockstep.external import process

LAUNCH = """
import os, runpy, signal, sys, warnings
from diffdrive_jacobian.lockstep.external import launch
from forked import _Tracing

def spawn(program, arguments, environment, *, file_actions, setsigdef):
    tracing.before_fork()
    pid = os.fork()
    tracing.after_fork(child=pid == 0)
    if pid == 0:
        signal.set_wakeup_fd(-1)
        for number in (*setsigdef, signal.SIGCHLD):
            signal.signal(number, signal.SIG_DFL)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        sys.argv = arguments[1:]
        runpy.run_path(arguments[1], run_name='__main__')
        os._exit(0)
    return pid

# Tracing runs threads, which it restarts in the fork.
warnings.simplefilter('ignore', DeprecationWarning)
tracing = _Tracing()
os.setsid()
os.dup2(os.open(sys.argv.pop(1), os.O_RDONLY), 0)
os.posix_spawnp = spawn
launch.main()
"""


class Launcher(forked.Popen):
    """A launcher, used like `subprocess.Popen`."""

    def __init__(self, arguments, cwd, **streams):
        # Open as long as this object, so that the fork can open it.
        self._read, write = os.pipe()
        self.stdin = open(write, 'wb', buffering=0)  # noqa: SIM115
        pipe = f'/proc/{os.getpid()}/fd/{self._read}'
        super().__init__(LAUNCH, [pipe, *arguments], cwd=cwd, **streams)

    def __del__(self):
        os.close(self._read)


def start(command, *, cwd=None, env=None, stdout=None, stderr=None, **kwargs):
    """Start a launcher: that of nodes of `external_nodes` in a fork."""
    arguments = command[len(process.LAUNCHER) :]
    if arguments[:2] == [sys.executable, external_nodes.__file__]:
        return Launcher(arguments, cwd, env=env, stdout=stdout, stderr=stderr)
    return subprocess.Popen(command, cwd=cwd, env=env, stdout=stdout, stderr=stderr, **kwargs)


@contextmanager
def started_in_forks():
    replaced = SimpleNamespace(Popen=start, PIPE=subprocess.PIPE)
    with mock.patch.object(process, 'subprocess', replaced):
        yield


def command(*names):
    """Return the command that starts a process with some nodes of `external_nodes`."""
    return [sys.executable, external_nodes.__file__, *names]


def send(world, name, *values):
    """Publish numbers on the input of a node of `external_nodes`."""
    for value in values:
        world.publish(f'{name}/in', Float64(data=float(value)))
