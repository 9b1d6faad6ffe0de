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

"""Programs start fast: they import only what they need, and leave out what rclpy imports in vain."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

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
HELP_WITHOUT_STDERR = """
import contextlib, faulthandler, importlib, io, os, sys, types
os.close(2)
sys.stderr = sys.__stderr__ = None
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import entry_points

for tool in sys.argv[1:]:
    with contextlib.redirect_stdout(io.StringIO()) as output, contextlib.suppress(SystemExit):
        importlib.import_module(f'diffdrive_jacobian.tools.{tool}').main(['--help'], Signals())
    assert f'usage: {tool}' in output.getvalue()
modules = [*sys.modules]

def run(*arguments):
    # As rclpy does.
    sys.stderr = sys.__stderr__
    faulthandler.enable()
    print('enabled', os.environ['OPENBLAS_NUM_THREADS'], *modules)

module = types.ModuleType('run_node')
module.run_node = run
sys.modules['diffdrive_jacobian.tools.run_node'] = module
entry_points.virtual_robot()
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


def test_a_node_starts_with_what_it_needs():
    """What is slow to import would delay its first odometry."""
    code, names, threads, (enabled, frozen) = json.loads(run(STARTED))
    modules = set(names)
    assert code == 0
    assert {'numpy', 'rclpy', 'diffdrive_jacobian.nodes.virtual_robot'} <= modules
    unneeded = {
        *('matplotlib', 'rich', 'rosbags', 'ruamel.yaml', 'importlib.metadata', 'difflib'),
        *('diffdrive_jacobian.diagnosis.graph', 'diffdrive_jacobian.parameters.go_to_goal'),
        # Of the generator of message classes. They take as long as to create a node.
        *('lark', 'em', 'rosidl_parser.parser', 'rosidl_pycommon'),
    }
    assert not unneeded & modules
    assert 'rosidl_generator_py.import_type_support_impl' in modules
    # OpenBLAS starts no threads, and the collector does not visit what was created so far.
    assert threads == '1'
    assert enabled
    assert frozen > 20_000


def test_help_imports_nothing_slow_and_a_process_without_stderr_gets_one():
    """And the number of threads that the user has set remains."""
    tools = ('send_goal', 'record_run', 'replay_run', 'watch_run', 'doctor')
    said, threads, *modules = run(HELP_WITHOUT_STDERR, *tools, OPENBLAS_NUM_THREADS='3').split()
    assert (said, threads) == ('enabled', '3')
    assert 'diffdrive_jacobian.tools.doctor' in modules
    assert not {'numpy', 'rclpy', 'rosbags', 'ruamel.yaml', 'matplotlib', 'rich'} & set(modules)
