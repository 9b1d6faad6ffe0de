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

"""The same results on any executor: this thread, processes, threads with processes, a Dask cluster."""

from __future__ import annotations

import math
import multiprocessing.spawn
import os
import signal
import subprocess
import sys
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from exploration_scenarios import crowded, deadly, follow, serial
from hypothesis import strategies as st

from diffdrive_jacobian import signals
from diffdrive_jacobian.control import find_controller
from diffdrive_jacobian.exploration.exploring import result_of
from diffdrive_jacobian.exploration.processes import _picklable, call_in_child
from diffdrive_jacobian.faults import Loss
from diffdrive_jacobian.properties import NeverFasterThan
from diffdrive_jacobian.simulation import SweepSetup, sweep
from diffdrive_jacobian.testing import ExplorationError, LocalExecutor, explore, fault_schedules

pytestmark = pytest.mark.process
FOLLOW = {
    'scenario': follow,
    'properties': [NeverFasterThan(0.35, 1.0)],
    'faults': fault_schedules(['speed'], kinds=[Loss], duration=1.2),
    'worlds': 7,
    'shrink_worlds': 0,
}
SPEEDS = st.fixed_dictionaries({'speed': st.sampled_from([0.0, 1.0, 2.0])})
SETUP = SweepSetup(grid=3, starts=2, rate=20.0)


@pytest.fixture(scope='module')
def local():
    """Return the default executor, with one process for all tests."""
    with LocalExecutor(1) as executor:
        yield executor


@pytest.fixture(scope='module')
def expected():
    """Return an exploration and a sweep of this thread."""
    return serial(**FOLLOW), sweep(SETUP)


@contextmanager
def processes():
    with ProcessPoolExecutor(1, multiprocessing.get_context('spawn')) as executor:
        yield executor


@contextmanager
def dask():
    distributed = pytest.importorskip('distributed')
    # On a machine without a network, for which it warns.
    address = {'host': '127.0.0.1', 'protocol': 'tcp://', 'dashboard_address': None}
    cluster = distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=False, **address)
    with cluster, distributed.Client(cluster) as client, client.get_executor() as executor:
        yield executor


@pytest.mark.parametrize('make', [processes, lambda: LocalExecutor(1), dask])
def test_an_executor_gives_the_results_of_this_thread(make, expected, monkeypatch):
    # One row of the grid for each task.
    monkeypatch.setattr(sys.modules[SweepSetup.__module__], 'LOOPS_PER_TASK', 1)
    found, swept = expected
    with make() as executor:
        again = explore(**FOLLOW, executor=executor)
        parts = sweep(SETUP, executor=executor)
    assert again.findings == found.findings
    assert again.findings[0].digest
    assert (again.worlds, again.checks, again.faults) == (found.worlds, found.checks, found.faults)
    for ours, theirs in zip(swept.outcomes, parts.outcomes, strict=True):
        assert ours.dtype == theirs.dtype
        np.testing.assert_array_equal(ours, theirs)


# --- Processes


def test_a_process_that_dies_is_a_finding(local, tmp_path):
    died = explore(deadly, cases=SPEEDS, worlds=3, executor=local, shrink_worlds=0, output=tmp_path)
    (finding,) = died.findings
    assert finding.trial.case == {'speed': 2.0}
    assert finding.count == 1
    assert 'process of the world ended with exit code 3' in finding.violation.text
    assert 'not recorded: the process of the world ended with exit code 3' in str(finding)
    assert (finding.directory / 'counterexample.json').exists()
    # Not in this process.
    assert died.replay().same_verdict


def test_a_scenario_reads_no_input_and_depends_on_no_earlier_world(local):
    found = explore(crowded, cases=SPEEDS, worlds=3, executor=local, shrink_worlds=0)
    (finding,) = found.findings
    assert 'not the first' in finding.violation.text
    assert not finding.deterministic


def test_an_exception_in_the_process_of_a_thread_is_raised(local):
    with pytest.raises(ValueError, match='invalid literal'):
        local.submit(call_in_child, int, 'x').result()
    assert local.submit(call_in_child, int, '7').result() == 7


def test_an_error_that_cannot_be_pickled_or_described_is_reported():
    class LocalError(Exception):
        def __str__(self):
            raise ValueError('of a bug')

    for error in (_picklable(LocalError()), LocalError()):
        future = Future()
        future.set_exception(error)
        with pytest.raises(ExplorationError, match=r'could not be run: .*LocalError: '):
            result_of(future, None)


class PressedTwice(LocalExecutor):
    """SIGINT comes while a world is waited for, and again as the processes are ended."""

    def __init__(self):
        super().__init__(1)

    def submit(self, fn, /, *args, **kwargs):
        future = super().submit(int)
        future.result = lambda timeout=None: signal.raise_signal(signal.SIGINT)
        return future

    def _end_children(self):
        signal.raise_signal(signal.SIGINT)
        super()._end_children()


def test_two_sigint_of_one_request_end_an_exploration_once(monkeypatch):
    monkeypatch.setattr(signals, 'TOGETHER', math.inf)
    monkeypatch.setattr(sys.modules[explore.__module__], 'LocalExecutor', PressedTwice)
    assert explore(follow, worlds=1).stopped == 'interrupted'
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


ENDLESS = """
import os
from diffdrive_jacobian.exploration.processes import ChildProcess
child = ChildProcess()
print(child.call(os.getpid), flush=True)
child.call(exec, 'print("busy", flush=True)\\nwhile True: pass')
"""


def test_a_process_ends_with_a_program_that_is_killed():
    """Also while its world does not end."""
    pipes = {'stdout': subprocess.PIPE, 'stderr': subprocess.PIPE, 'text': True}
    with subprocess.Popen([sys.executable, '-c', ENDLESS], **pipes) as program:
        pid = int(program.stdout.readline())
        assert program.stderr.readline() == 'busy\n'
        program.kill()
        try:
            # Until nobody can write any more.
            program.communicate(timeout=60.0)
        except subprocess.TimeoutExpired:
            os.kill(pid, signal.SIGKILL)
            raise


# --- Sweeps


def test_a_sweep_reports_progress_and_mistakes():
    def stop(loops):
        raise KeyError(f'after {loops}')

    with ThreadPoolExecutor(1) as executor:
        own = replace(find_controller('go_to_goal'), name='own', law=lambda *_: None)
        with pytest.raises(ValueError, match="controller 'own' cannot be sent"):
            sweep(replace(SETUP, controller=own), executor=executor)
        with pytest.raises(KeyError, match=f'after {SETUP.loops}'):
            sweep(SETUP, stop, executor=executor)
