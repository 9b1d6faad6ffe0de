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

"""What the tests of the nodes share: the lockstep world, and for what must run in real time one context
per test that no other test can hear, and waiting for conditions instead of sleeping."""

from __future__ import annotations

import gc
import os
import resource
import signal
import sys

# Before rclpy is loaded: nobody outside a test's context hears it, messages check their fields'
# types, and nothing is written into the home directory.
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'OFF'
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'
# Threads of BLAS would compete with the other workers.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
os.environ.setdefault('ROS_LOG_DIR', os.path.join(os.environ.get('TMPDIR', '/tmp'), 'ros_test_log'))

import pytest
from support.harness import Harness

pytest_plugins = ['pytester']

# What the tests start must not ignore these, also if a shell started the tests in the background or with
# nohup. They themselves go on ignoring them.
for number in (signal.SIGHUP, signal.SIGINT):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, lambda *_: None)

COST = ('pages', 'browser', 'process', 'slow')
"""Marks of tests that are not quick. The dearest start first, so that none is left for the end."""
MEMORY = 700 << 20
"""What a test with `bounded_memory` may take (bytes)."""
CHUNK = 4
"""Most tests that a worker of pytest-xdist gets at once."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers():
    """Start two workers more than there are cores for `-n auto`: many tests wait for processes."""
    return len(os.sched_getaffinity(0)) + 2


def pytest_configure(config):
    if getattr(config.option, 'maxschedchunk', CHUNK) is None:
        config.option.maxschedchunk = CHUNK


@pytest.hookimpl(hookwrapper=True)
def pytest_collection():
    """Collect the tests without garbage collection, which afterwards leaves them alone.

    They are a million objects that stay until the end. What the tests leave is collected less often.
    """
    gc.disable()
    yield
    gc.freeze()
    gc.enable()
    gc.set_threshold(20_000, 50, 100)


def cost(item):
    """Return the place of a test in the order in which all start."""
    return min(
        (COST.index(mark.name) for mark in item.iter_markers() if mark.name in COST), default=len(COST)
    )


@pytest.hookimpl(tryfirst=True)
def pytest_itemcollected(item):
    if cost(item) == len(COST):
        item.add_marker('quick')


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items):
    items.sort(key=cost)


@pytest.fixture(params=['events', 'single'])
def executor_kind(request):
    """Both executors; tests that do not ask for this run on the faster one."""
    return request.param


@pytest.fixture
def ros(request):
    """A harness in a context of its own."""
    from rclpy.executors import SingleThreadedExecutor

    from diffdrive_jacobian.ros.runner import make_executor, ros_context

    single = (
        'executor_kind' in request.fixturenames and request.getfixturevalue('executor_kind') == 'single'
    )
    with ros_context(['test']) as context:
        executor = (
            SingleThreadedExecutor(context=context) if single else make_executor(context, isolated=True)
        )
        harness = Harness(context, executor)
        yield harness
        harness.close()


@pytest.fixture
def world(tmp_path_factory):
    """Processes of the commands, in a ROS domain of their own, see `processes.World`."""
    from support.processes import open_world

    with open_world(tmp_path_factory.mktemp('world')) as made:
        yield made


@pytest.fixture
def quick_disk(monkeypatch):
    """Wait for no disk: the files of a test need not survive a power cut."""
    monkeypatch.setattr(os, 'fsync', lambda descriptor: None)


@pytest.fixture
def bounded_memory():
    """Let this process take a few hundred megabytes more, and no more."""
    with open('/proc/self/statm') as file:
        now = int(file.read().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (now + MEMORY, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.fixture
def no_display(monkeypatch):
    """Ask matplotlib for a window, where there is none. `matplotlib.pyplot`, which obeys, is absent."""
    monkeypatch.delenv('DISPLAY', raising=False)
    monkeypatch.setenv('MPLBACKEND', 'tkagg')
    # Another test may have imported it. `from matplotlib import pyplot` reads the attribute.
    monkeypatch.delattr('matplotlib.pyplot', raising=False)
    monkeypatch.setitem(sys.modules, 'matplotlib.pyplot', None)


@pytest.fixture
def add(lockstep):
    """Put one of our nodes into the world; see `lockstep_nodes.make`."""
    from support.lockstep_nodes import make

    return lambda node_class, namespace='', **parameters: lockstep.add(
        make(node_class, namespace, **parameters)
    )


def pytest_terminal_summary(terminalreporter):
    """Report loudly what a missing browser left untested."""
    for report in terminalreporter.stats.get('skipped', []):
        if 'chromium is not installed' in str(report.longrepr):
            text = 'NOT TESTED: the live page in a browser. Install chromium (apt install chromium).'
            terminalreporter.write_line(f'\n{text}\n', red=True, bold=True)
            break


@pytest.fixture
def add_complete(lockstep):
    """Put one of our nodes into the world; see `lockstep_nodes.make_complete`."""
    from support.lockstep_nodes import make_complete

    return lambda node_class, namespace='', **parameters: lockstep.add(
        make_complete(node_class, namespace, **parameters)
    )


@pytest.fixture
def team(lockstep):
    """The topics of a robot with bridge and quick controller, and the nodes."""
    from support.lockstep_nodes import QUICK, Topics, add_team

    topics = Topics(lockstep)
    topics.robot, topics.bridge, topics.controller = add_team(lockstep, **QUICK)
    return topics
