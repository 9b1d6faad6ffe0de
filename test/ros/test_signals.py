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

"""A second signal ends a process that does not react, and no other."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading

import pytest

from diffdrive_jacobian import signals as module
from diffdrive_jacobian.signals import Signals

HUNG = """
import os, sys, threading
from diffdrive_jacobian import signals
from diffdrive_jacobian.tools.entry_points import _exit
signals.TOGETHER, signals.GRACE = 0.0, 0.1
caught = signals.Signals()
caught.catch()
caught.exit_on_second(lambda: _exit('tool', 'ended by a second signal'))
lock = threading.Lock()
lock.acquire()
print('hangs', flush=True)
lock.acquire()
"""


@pytest.mark.process
def test_a_second_signal_ends_a_process_that_hangs():
    child = subprocess.Popen(
        [sys.executable, '-c', HUNG],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert child.stdout.readline() == 'hangs\n'
    timer = threading.Timer(60.0, child.kill)
    timer.start()
    # Equal signals that are pending together come as one.
    while child.poll() is None:
        child.send_signal(signal.SIGINT)
        threading.Event().wait(0.01)
    timer.cancel()
    assert child.returncode == 130
    assert child.communicate()[1] == 'tool: ended by a second signal\n'


@pytest.fixture
def handlers():
    """Restore the handlers of signals."""
    before = {number: signal.getsignal(number) for number in module.CAUGHT}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize('number', module.CAUGHT)
def test_signals_are_counted_and_end_what_leaves_nothing_at_once(handlers, number):
    ends = []
    caught = Signals(lambda: ends.append(caught.count))
    caught.catch()
    os.kill(os.getpid(), number)
    assert (caught.count, ends) == (1, [])
    # Also by one that was caught before.
    with caught.ending_at_once():
        assert ends == [1]
        # Once.
        os.kill(os.getpid(), number)
    caught.count = 0
    with caught.ending_at_once():
        os.kill(os.getpid(), number)
        assert ends == [1, 1]
    with caught.ending_at_once():
        pass
    os.kill(os.getpid(), number)
    assert caught.count == 2


class Watched:
    """A watch without a process: signals are bytes in a socket."""

    def __init__(self, monkeypatch, *, together=0.0, grace=0.0, max_grace=60.0):
        for name, value in (('TOGETHER', together), ('GRACE', grace), ('MAX_GRACE', max_grace)):
            monkeypatch.setattr(module, name, value)
        self.signals = Signals()
        self.ended = threading.Event()
        reader, writer = socket.socketpair()
        # Not closed, as in `exit_on_second`.
        self._writer = writer.detach()
        self._thread = threading.Thread(
            target=self.signals._watch, args=(reader, False, self.ended.set), daemon=True
        )
        self._thread.start()

    def send(self, *numbers):
        os.write(self._writer, bytes(numbers))

    def until_ended(self):
        self._thread.join(60.0)
        assert not self._thread.is_alive()


def test_another_kind_of_signal_is_no_request(monkeypatch):
    watched = Watched(monkeypatch)
    watched.send(signal.SIGINT)
    watched.send(signal.SIGUSR2, signal.SIGCHLD)
    assert not watched.ended.wait(0.05)
    watched.send(signal.SIGTERM)
    watched.until_ended()
    assert watched.ended.is_set()


def test_signals_to_the_whole_group_are_one_request(monkeypatch):
    watched = Watched(monkeypatch, together=60.0)
    watched.send(signal.SIGINT, signal.SIGTERM)
    watched.send(signal.SIGINT)
    assert not watched.ended.wait(0.05)


def test_a_process_that_reads_the_count_is_given_time(monkeypatch):
    watched = Watched(monkeypatch, grace=60.0, max_grace=0.2)
    watched.send(signal.SIGINT)
    watched.send(signal.SIGINT)
    while not watched.ended.is_set():
        assert watched.signals.count == 0
    watched.until_ended()


def test_a_process_that_exits_by_itself_is_not_ended(monkeypatch, handlers):
    watched = Watched(monkeypatch, grace=0.2)
    watched.send(signal.SIGINT)
    watched.send(signal.SIGINT)
    watched.signals.ignore()
    watched.until_ended()
    assert not watched.ended.is_set()
