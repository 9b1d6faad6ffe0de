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

"""Unchanged processes whose timers, threads and loops live by wall time, in simulated wall time."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from std_msgs.msg import String
from std_srvs.srv import Trigger

from diffdrive_jacobian.exploration.trial import MessageDigest
from diffdrive_jacobian.lockstep.external import idle, wall_time
from diffdrive_jacobian.testing import Lockstep, LockstepError

pytestmark = pytest.mark.process
NODES = Path(__file__).with_name('wall_time_nodes.py')
PERIODS = {
    **dict.fromkeys(('steady', 'system', 'sleep', 'event', 'select', 'poll', 'posted'), 20.0),
    # Python computes again for how long is left, and asyncio waits a millisecond longer.
    'queue': 20.001,
    'children': 21.0,
    'asyncio': 21.0,
}
"""When each kind of timer or thread publishes (ms)."""
compiled = pytest.mark.skipif(
    not any(map(shutil.which, wall_time.COMPILERS)),
    reason='simulated wall time needs a C compiler',
)


def run(*kinds, **options):
    """Run a node. Return what each kind said and when (ms), and the digest of all messages."""
    heard = {kind: [] for kind in kinds}
    with Lockstep() as world, MessageDigest(world) as digest:
        world.node.create_service(Trigger, 'offered', lambda _, response: response)

        def hear(message):
            kind, said = message.data.split(maxsplit=1)
            heard[kind].append((round(1000.0 * world.elapsed, 6), said))

        world.node.create_subscription(String, 'tick', hear, 100)
        process = world.start([sys.executable, str(NODES), *kinds], wall_time='simulated', **options)
        if len(kinds) > 1:
            world.publish('poke', String())
        world.run_for(0.3)
        value = digest.value()
        assert process.stop() == 0
        return heard, value


def check_period(heard, period):
    """Check the times of messages, to the millisecond, and what the node's own clock said."""
    times, said = zip(*heard, strict=True)
    assert times == pytest.approx([period * number for number in range(1, 1 + int(300.0 / period))])
    spans = np.diff([float(text) for text in said])
    assert spans == pytest.approx(np.full(len(spans), period / 1000.0), abs=1.1e-3)


@compiled
def test_what_waits_on_wall_time_goes_on_in_simulated_time():
    heard, _ = run(*PERIODS)
    for kind, period in PERIODS.items():
        check_period(heard[kind], period)


@compiled
@pytest.mark.parametrize('kind', ['late', 'waiting'])
def test_who_waits_at_the_start_goes_on_in_simulated_time(kind):
    heard, _ = run(kind)
    check_period(heard[kind], 20.0)


@compiled
@pytest.mark.parametrize('kind', ['sleep', 'asyncio'])
def test_each_run_is_the_same(kind):
    assert run(kind) == run(kind)


@compiled
def test_a_loop_that_spins_once_at_a_time_repeats():
    """Each message, also the time every 10 ms, ends a wait of it."""
    (heard, digest), again = run('once'), run('once')
    assert (heard, digest) == again
    assert {10.0, 20.0, 300.0} <= {time for time, _ in heard['once']}


@compiled
def test_who_is_due_at_once_goes_on_in_the_order_of_its_threads():
    """Also without use_sim_time. Nothing is left open."""
    # What rclpy opens once stays open.
    run('sleep')
    before = len(os.listdir('/proc/self/fd'))
    heard, _ = run('two', use_sim_time=False)
    assert heard['two'] == [(20.0 * number, 'timer thread') for number in range(1, 16)]
    assert len(os.listdir('/proc/self/fd')) <= before


@compiled
def test_a_loop_that_waits_until_it_is_later_gets_later():
    """By microseconds, after some looks."""
    heard, _ = run('pipe')
    times = [time for time, _ in heard['pipe']]
    assert times == pytest.approx([20.0 * number for number in range(1, 15)], abs=0.5)


@compiled
def test_what_cannot_follow_is_named():
    with pytest.raises(
        LockstepError, match=r"alarm .* calls setitimer, which wall_time='simulated' does not"
    ):
        run('alarm')


@pytest.mark.parametrize('how', ['real', pytest.param('simulated', marks=compiled)])
def test_a_callback_that_never_returns_is_named(how):
    """A mutex that is locked twice: by the second message."""
    with Lockstep() as world:
        world.start([sys.executable, str(NODES), 'deadlock'], wall_time=how)
        for _ in range(2):
            world.publish('poke', String())
            world.run_for(0.5)
        world.run_for(1.4)
        with pytest.raises(LockstepError, match=r'callback of /ticker has not returned since 0\.5\d* s'):
            world.run_for(0.2)


def test_a_thread_in_cpp_that_waits_on_wall_time_is_warned_of(monkeypatch):
    """As if it were in C++: a library that the process has."""
    monkeypatch.setattr(idle, 'RCLCPP', '_rclpy_pybind11')
    with Lockstep() as world:
        world.start([sys.executable, str(NODES), 'later'])
        world.publish('poke', String())
        with pytest.warns(UserWarning, match='a thread that it has started meanwhile waits with'):
            world.run_for(0.1)


@compiled
@pytest.mark.parametrize(('root', 'first'), [(0, 5), (32760, 32761)])
def test_of_those_that_are_due_at_once_the_oldest_thread_is_first(root, first, monkeypatch, tmp_path):
    """Also where the system begins anew with small ids, after the largest one.

    A process 32760 has started the threads 32761, 5 and 300.
    A negative id is of one that waits as an executor.
    """
    monkeypatch.setattr(wall_time, 'PID_MAX', tmp_path / 'pid_max')
    wall_time.PID_MAX.write_text('32768\n')
    there = wall_time.WallTime(1)
    there.root = root
    slots = there._slots
    slots['until'][:3], slots['state'][:3], slots['thread'][:3] = 20, wall_time.WAITS, [5, -32761, 300]
    until, slot = there.next()
    assert (until, abs(int(slots['thread'][slot]))) == (20, first)
    del slots
    there.close()


@compiled
def test_slots_of_threads_that_were_killed_are_free_again(monkeypatch):
    monkeypatch.setattr(wall_time, 'MANY', 2)
    there = wall_time.WallTime(1)
    slots = there._slots
    slots['until'][:4], slots['state'][:4] = [5, 6, 7, 8], wall_time.WAITS
    slots['thread'][:4] = [2**22 + 1, 2**22 + 2, os.getpid(), 2**22 + 3]
    there.next()
    assert there.next() == (7, 2)
    del slots
    there.close()


def test_a_library_that_cannot_be_built_is_named(monkeypatch, tmp_path):
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path))
    with monkeypatch.context() as patched:
        patched.setenv('PATH', str(tmp_path))
        with pytest.raises(LockstepError, match='needs a C compiler once, cc, gcc or clang'):
            wall_time.built()
    compiler = tmp_path / 'cc'
    monkeypatch.setenv('PATH', f'{tmp_path}:{os.environ["PATH"]}')
    for script, words in (
        ('printf "no \\377" >&2; exit 1', r'(?s)cc .*\.c -ldl fails:\nno'),
        ('exit 0', 'cannot be built in .*: .*No such file'),
    ):
        compiler.write_text(f'#!/bin/sh\n{script}\n')
        compiler.chmod(0o755)
        monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'cache'))
        with pytest.raises(LockstepError, match=words):
            wall_time.built()
    for folder, words in (
        ('a b', 'neither spaces nor colons'),
        ('cc', 'cannot be built in .*: .*Not a dir'),
    ):
        monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / folder))
        with pytest.raises(LockstepError, match=words):
            wall_time.built()
