"""What the tests of the nodes share: the lockstep world, and for what must run in real time one context
per test that no other test can hear, and waiting for conditions instead of sleeping."""

from __future__ import annotations

import gc
import os
import signal
import sys
import time

# Before rclpy is loaded: nobody outside a test's context hears it, messages check their fields'
# types, and nothing is written into the home directory.
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'OFF'
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'
# Threads of BLAS would compete with the other workers.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
os.environ.setdefault('ROS_LOG_DIR', os.path.join(os.environ.get('TMPDIR', '/tmp'), 'ros_test_log'))

import forked
import pytest

pytest_plugins = ['pytester']

# What the tests start must not ignore these, also if a shell started the tests in the background or with
# nohup. They themselves go on ignoring them.
for number in (signal.SIGHUP, signal.SIGINT):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, lambda *_: None)

LONGEST_FIRST = (
    *('test_pages', 'test_explored_nodes', 'test_forked', 'test_salvage', 'test_processes'),
    *('test_replay_run', 'test_recover_crash', 'test_calibrate_run', 'test_exploration'),
    *('test_external', 'test_own_controllers', 'test_fixtures', 'test_se2', 'test_process_faults'),
    *('test_record_run', 'test_recording', 'test_live_browser', 'test_secondary_tracking'),
    *('test_flood', 'test_calibration', 'test_faults_same', 'test_tools'),
)
"""Files with tests that take seconds. They start first, so that none is left for the end."""
CHUNK = 4
"""Most tests that a worker of pytest-xdist gets at once."""
PATIENCE = 20.0
"""How long a condition may take to come true before the test fails (s)."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers():
    """Start one worker more than there are cores for `-n auto`: many tests wait for processes."""
    return len(os.sched_getaffinity(0)) + 1


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

    They are a million objects that stay until the end.
    """
    gc.disable()
    yield
    gc.freeze()
    gc.enable()


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items):
    places = {name: place for place, name in enumerate(LONGEST_FIRST)}
    items.sort(key=lambda item: places.get(item.path.stem, len(places)))


class Harness:
    """A context with its nodes, an executor that serves them, and a plain node to talk to them."""

    def __init__(self, context, executor):
        from rclpy.node import Node

        self.context = context
        self.executor = executor
        self.nodes = []
        self.peer = self.add(Node, node_name='peer')

    def add(self, node_class, *, parameters=None, **kwargs):
        """Make a node with parameter overrides and serve it."""
        from rclpy.parameter import Parameter

        overrides = [Parameter(name, value=value) for name, value in (parameters or {}).items()]
        node = node_class(context=self.context, parameter_overrides=overrides, **kwargs)
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def listen(self, message_type, topic, *, latched=False):
        """Collect the messages of a topic; returns the list that grows."""
        from rclpy.qos import DurabilityPolicy, QoSProfile

        received = []
        profile = QoSProfile(depth=1000)
        if latched:
            profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
        self.peer.create_subscription(message_type, topic, received.append, profile)
        return received

    def talk(self, message_type, topic):
        """Make a publisher that already has a reader."""
        publisher = self.peer.create_publisher(message_type, topic, 100)
        self.until(lambda: publisher.get_subscription_count() > 0, f'somebody reads {topic}')
        return publisher

    def until(self, condition, what='a condition', patience=PATIENCE):
        """Serve the nodes until a condition holds, and fail if it never does."""
        deadline = time.monotonic() + patience
        while not condition():
            assert time.monotonic() < deadline, f'not within {patience} s: {what}'
            self.executor.spin_once(timeout_sec=0.01)

    def until_said(self, capfd, *words):
        """Serve the nodes until all words stand in the log; returns the log so far."""
        said = ''

        def told():
            nonlocal said
            said += capfd.readouterr().err
            return all(word in said for word in words)

        self.until(told, f'the log says {words}')
        return said

    def call(self, service_type, name):
        """Call a service without arguments; returns the response."""
        client = self.peer.create_client(service_type, name)
        self.until(client.service_is_ready, f'service {name}')
        future = client.call_async(service_type.Request())
        self.until(future.done, f'answer of {name}')
        return future.result()

    def close(self):
        self.executor.shutdown()
        for node in self.nodes:
            node.destroy_node()


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
    from lockstep_nodes import make

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
    from lockstep_nodes import make_complete

    return lambda node_class, namespace='', **parameters: lockstep.add(
        make_complete(node_class, namespace, **parameters)
    )


@pytest.fixture
def team(lockstep):
    """The topics of a robot with bridge and quick controller, and the nodes."""
    from lockstep_nodes import QUICK, Topics, add_team

    topics = Topics(lockstep)
    topics.robot, topics.bridge, topics.controller = add_team(lockstep, **QUICK)
    return topics
