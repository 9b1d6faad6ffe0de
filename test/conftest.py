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
from fork_server import forked
from support.harness import Harness

pytest_plugins = ['pytester']

# What the tests start must not ignore these, also if a shell started the tests in the background or with
# nohup. They themselves go on ignoring them.
for number in (signal.SIGHUP, signal.SIGINT):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, lambda *_: None)

LONGEST_FIRST = (
    *('test_pages', 'test_explored_nodes', 'test_forked', 'test_damage_fuzz', 'test_processes'),
    *('test_replay_run', 'test_recover_crash', 'test_calibrate_run', 'test_exploration'),
    *('test_external', 'test_external_failures', 'test_own_controllers', 'test_fixtures'),
    *('test_process_faults', 'test_record_run', 'test_live_browser', 'test_flood', 'test_calibration'),
    *('test_faults_same', 'test_faulty_drives'),
)
"""Files with tests that take seconds. They start first, so that none is left for the end."""
SLOW = {
    *('test_calibrate_run', 'test_calibration', 'test_cdr', 'test_closed_loop'),
    *('test_damage_fuzz', 'test_defective_controllers', 'test_drives', 'test_exploration'),
    *('test_exploration_output', 'test_exploration_strategies', 'test_explored_nodes'),
    *('test_faulty_drives', 'test_fixtures', 'test_go_to_goal_paths', 'test_golden_run'),
    *('test_ground_truth', 'test_hostile_bags', 'test_live_node', 'test_lockstep_failures'),
    *('test_options', 'test_own_controllers', 'test_own_gains', 'test_paths_driven'),
    *('test_plot_run', 'test_properties_nodes', 'test_recover', 'test_replay_run'),
    *('test_sweep_gains', 'test_three_nodes', 'test_timeline', 'test_verification'),
    *('test_virtual_robot', 'test_virtual_robot_commands'),
}
"""Files that are marked as slow as a whole: their tests take more than a second of CPU time together."""
MEMORY = 700 << 20
"""What a test with `bounded_memory` may take (bytes)."""
CHUNK = 4
"""Most tests that a worker of pytest-xdist gets at once."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers():
    """Start two workers more than there are cores for `-n auto`: many tests wait for processes."""
    return len(os.sched_getaffinity(0)) + 2


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node):
    """Let the workers of pytest-xdist share their servers of forks."""
    node.workerinput['forks'] = forked.share()


def pytest_configure(config):
    if hasattr(config, 'workerinput'):
        forked.use(config.workerinput['forks'])
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


@pytest.hookimpl(tryfirst=True)
def pytest_itemcollected(item):
    if item.path.stem in SLOW:
        item.add_marker('slow')


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items):
    places = {name: place for place, name in enumerate(LONGEST_FIRST)}
    items.sort(key=lambda item: places.get(item.path.stem, len(places)))


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


@pytest.fixture(scope='session')
def forked_python(tmp_path_factory):
    """Return a command that is used like the Python interpreter, and has done its imports."""
    return forked.make_commands(tmp_path_factory.mktemp('forked') / 'commands', ['python']) / 'python'


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
