"""Each entry point names itself in the errors that it prints."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
import sysconfig
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from diffdrive_jacobian.tools import entry_points as programs

TOOLS = sorted(
    one.name
    for one in entry_points(group='console_scripts')
    if one.value.startswith('diffdrive_jacobian.')
)
FAILING = """
import sys, types

def fail(*arguments):
    raise OSError('the disk is full')

for name in ('run_node', {tool!r}):
    module = types.ModuleType(name)
    module.main = module.run_node = fail
    sys.modules['diffdrive_jacobian.tools.' + name] = module
from diffdrive_jacobian.tools import entry_points
sys.exit(getattr(entry_points, {tool!r})())
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
    print('enabled')

module = types.ModuleType('run_node')
module.run_node = run
sys.modules['diffdrive_jacobian.tools.run_node'] = module
from diffdrive_jacobian.tools.entry_points import virtual_robot
virtual_robot()
"""


def test_a_process_that_was_started_without_stderr_gets_one():
    ended = subprocess.run(
        [sys.executable, '-c', WITHOUT_STDERR], capture_output=True, text=True, timeout=60
    )
    assert ended.stdout == 'enabled\n'


@pytest.mark.parametrize('tool', TOOLS)
def test_an_error_of_the_system_names_the_tool(tool):
    ended = subprocess.run(
        [sys.executable, '-c', FAILING.format(tool=tool)], capture_output=True, text=True, timeout=60
    )
    assert (ended.returncode, ended.stdout) == (1, '')
    assert ended.stderr == f'{tool}: error: the disk is full\n'


@pytest.mark.parametrize('tool', TOOLS)
def test_an_installed_command_starts(tool):
    """As a new process, with its imports. Other tests fork processes that have imported them."""
    command = Path(sysconfig.get_path('scripts'), tool)
    ended = subprocess.run([command, '--bogus'], capture_output=True, text=True, timeout=60)
    assert (ended.returncode, ended.stdout) == (2, '')
    assert ended.stderr.splitlines()[-1].startswith(f'{tool}: error: ')


def test_the_programs_are_the_nodes_and_the_modules_with_a_main():
    """A new tool needs its module and the line in setup.py, and nothing else."""
    listed = (Path(__file__).parents[2] / 'setup.py').read_text().split('COMMANDS = [')[1].split(']')[0]
    assert sorted(re.findall(r"'(\w+)'", listed)) == sorted([*programs.NODES, *programs.tools()])
    for name in programs.tools():
        assert callable(importlib.import_module(f'diffdrive_jacobian.tools.{name}').main)
    assert set(programs.tools()) < set(dir(programs))


def test_another_name_is_no_program():
    for name in ('nothing', '_cli', 'run_node', 'entry_points', '__init__'):
        with pytest.raises(AttributeError, match=f"has no attribute '{name}'"):
            programs.__getattr__(name)
