"""Programs start fast: they import only what they need, and leave out what rclpy imports in vain."""

from __future__ import annotations

import gc
import json
import os
import signal
import subprocess
import sys

import pytest

from diffdrive_jacobian.signals import CAUGHT, Signals
from diffdrive_jacobian.tools.entry_points import long_lived

pytestmark = pytest.mark.process

STARTED = """
import gc, json, os, sys
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import entry_points

def catch(self):
    # It ends when everything is imported.
    self.count, self._end = 1, lambda: None

Signals.catch = catch
sys.argv = ['virtual_robot']
code = entry_points.virtual_robot()
threads = os.environ.get('OPENBLAS_NUM_THREADS')
collector = gc.isenabled(), gc.get_freeze_count()
print(json.dumps([code, sorted(sys.modules), threads, collector]))
"""
WITHOUT_STDERR = """
import faulthandler, os, sys
os.close(2)
sys.stderr = sys.__stderr__ = None

import types

def run(*arguments):
    # As rclpy does.
    sys.stderr = sys.__stderr__
    faulthandler.enable()
    print('enabled', os.environ['OPENBLAS_NUM_THREADS'])

module = types.ModuleType('run_node')
module.run_node = run
sys.modules['diffdrive_jacobian.tools.run_node'] = module
from diffdrive_jacobian.tools.entry_points import virtual_robot
virtual_robot()
"""
HELP = """
import contextlib, importlib, io, sys
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import entry_points

for tool in sys.argv[1:]:
    with contextlib.redirect_stdout(io.StringIO()) as output, contextlib.suppress(SystemExit):
        importlib.import_module(f'diffdrive_jacobian.tools.{tool}').main(['--help'], Signals())
    assert f'usage: {tool}' in output.getvalue()
print(*sys.modules)
"""


def run(*arguments: str, **variables: str) -> str:
    """Run an interpreter of its own, and return what it prints."""
    environment = {**os.environ, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF'}
    environment.pop('OPENBLAS_NUM_THREADS', None)
    environment.update(variables)
    return subprocess.run(
        [sys.executable, '-c', *arguments],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        timeout=60,
    ).stdout


@pytest.fixture(scope='module')
def started():
    """Exit code, modules, threads of OpenBLAS and the collector's state of a robot that was started."""
    return json.loads(run(STARTED))


def test_a_node_starts_without_what_only_the_tools_need(started):
    """What is slow to import would delay its first odometry."""
    code, modules, _, _ = started
    assert code == 0
    assert {'numpy', 'rclpy', 'diffdrive_jacobian.nodes.virtual_robot'} <= set(modules)
    unneeded = {
        *('matplotlib', 'rich', 'rosbags', 'ruamel.yaml'),
        # With the installed controllers.
        *('importlib.metadata', 'difflib'),
        *('diffdrive_jacobian.diagnosis.graph', 'diffdrive_jacobian.parameters.go_to_goal'),
    }
    assert not unneeded & set(modules)


def test_message_classes_are_loaded_without_their_generator(started):
    """It has the parser lark and the template engine em, which take as long as to create a node."""
    modules = set(started[1])
    assert 'rosidl_generator_py.import_type_support_impl' in modules
    assert not {'lark', 'em', 'rosidl_parser.parser', 'rosidl_pycommon'} & modules


def test_the_collector_does_not_visit_what_was_created_at_the_start(started):
    enabled, frozen = started[3]
    assert enabled
    assert frozen > 20_000


def test_openblas_starts_no_threads(started):
    assert started[2] == '1'


def test_a_collector_that_was_disabled_before_stays_so():
    gc.disable()
    try:
        with long_lived():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_a_process_is_ended_once_however_many_signals_come():
    ended = []

    def end():
        ended.append(len(ended))
        os.kill(os.getpid(), signal.SIGHUP)

    before = {number: signal.getsignal(number) for number in CAUGHT}
    try:
        signals = Signals(end)
        signals.catch()
        with signals.ending_at_once():
            os.kill(os.getpid(), signal.SIGHUP)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert (ended, signals.count) == ([0], 2)


def test_the_help_of_programs_that_need_ros_imports_nothing_slow():
    modules = set(run(HELP, 'send_goal', 'record_run', 'replay_run', 'watch_run', 'doctor').split())
    assert 'diffdrive_jacobian.tools.doctor' in modules
    slow = {'numpy', 'rclpy', 'rosbags', 'ruamel.yaml', 'matplotlib', 'rich'}
    assert not slow & modules


def test_a_process_without_stderr_gets_one_and_keeps_the_number_of_threads_of_the_user():
    assert run(WITHOUT_STDERR, OPENBLAS_NUM_THREADS='3') == 'enabled 3\n'
