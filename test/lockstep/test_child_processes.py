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

"""`ExternalProcess` starts a program: it and all that it starts end with the world."""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from pathlib import Path

import pytest

from diffdrive_jacobian.lockstep.external import domain as domain_module
from diffdrive_jacobian.lockstep.external import process as external_process
from diffdrive_jacobian.lockstep.external.process import ExternalProcess
from diffdrive_jacobian.lockstep.external.threads import Threads
from diffdrive_jacobian.testing import LockstepError

pytestmark = pytest.mark.process


@pytest.fixture
def started():
    """Return a function that starts a shell command, which is ended with the test."""
    processes = []

    def start(text, until=''):
        processes.append(ExternalProcess(['sh', '-c', text]))
        while until not in processes[-1].printed(0):
            assert processes[-1].returncode is None
        return processes[-1]

    yield start
    external_process.end_all(processes)


def test_a_process_and_its_children_are_ended(started):
    stubborn = started('trap "" INT; echo hi; sleep 60 & wait; sleep 60', until='hi')
    assert 'is running' in stubborn.describe()
    assert stubborn.stop(timeout=0.1) == -signal.SIGKILL
    polite = started('trap "echo bye; exit 7" INT; echo hi; while :; do sleep 0.05; done', until='hi')
    assert polite.stop() == 7
    assert polite.printed(0) == 'hi\nbye\n'


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('kill -SEGV $$', 'was ended by SIGSEGV'),
        # As `ros2 run`, which is the parent of the node, and a shell.
        ('exit 245', 'has exited with 245: what it started was ended by SIGSEGV'),
        ('exit 139', 'has exited with 139: what it started was ended by SIGSEGV'),
        ("printf '\\033[2J%1000000d' 1; exit 3", r'(?s)has exited with 3\n  stdout:\n.{100,1000}$'),
    ],
)
def test_the_end_of_a_process_is_described(started, text, words):
    process = started(text)
    while process.returncode is None:
        time.sleep(0.001)
    with pytest.raises(LockstepError, match=words) as caught:
        process.check_running()
    assert '\033' not in str(caught.value)


def test_a_process_in_a_session_of_its_own_is_ended_with_the_world(started):
    """As the daemon of ros2, and what that has started."""
    launcher = started('setsid sh -c "echo hi; sleep 60" & sleep 60', until='hi')
    left = set(Threads(launcher.root, ()).processes())
    assert len(left) >= 4
    launcher.kill()
    assert not any(Path(f'/proc/{pid}').exists() for pid in left)


WORLD = """
import sys, time
from diffdrive_jacobian.lockstep.external.process import ExternalProcess
from diffdrive_jacobian.lockstep.external.threads import Threads
process = ExternalProcess(['sh', '-c', 'echo hi; sleep 60 & sleep 60'])
while not process.printed(0) or len(found := Threads(process.root, ()).processes()) < 3:
    time.sleep(0.001)
print(*found, flush=True)
time.sleep(60.0)
"""


def test_nothing_is_left_of_a_world_that_is_killed():
    """As by a time limit of the tests."""
    world = ExternalProcess([sys.executable, '-c', WORLD])
    while not (printed := world.printed(0)).endswith('\n'):
        world.check_running()
        time.sleep(0.01)
    left = set(map(int, printed.split()))
    assert len(left) >= 3
    os.kill(world.pid, signal.SIGKILL)
    while any(Path(f'/proc/{pid}').exists() for pid in left):
        time.sleep(0.01)
    world.close()


def test_a_process_receives_sigint_that_the_tests_ignore(started):
    """As they do if a shell has started them in the background."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        process = started('exec sleep 60')
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        assert process.stop() == -signal.SIGINT
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_domain_with_a_port_in_use_is_not_chosen(monkeypatch):
    domains = domain_module.DOMAINS
    assert len({domain_module.free_domain() for _ in range(10)}) > 1
    monkeypatch.delenv('PYTEST_XDIST_WORKER', raising=False)
    monkeypatch.delenv('PYTEST_XDIST_WORKER_COUNT', raising=False)
    # The last one without ports that Linux gives to clients. No other test uses it.
    domain = domains[0] - 1
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        # Of the fourth participant: the first may have ended before.
        taken.bind(('', domain_module._ports(domain)[4]))
        monkeypatch.setattr(domain_module, 'DOMAINS', [domain, *domains])
        assert domain not in {domain_module.free_domain() for _ in range(2 * len(domains))}
        monkeypatch.setattr(domain_module, 'DOMAINS', [domain])
        with pytest.raises(LockstepError, match=f'from {domain} to {domain} are all in use'):
            domain_module.free_domain()
    assert domain_module.free_domain() == domain
