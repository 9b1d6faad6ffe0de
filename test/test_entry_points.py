"""Each entry point names itself in the errors that it prints."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import entry_points

import pytest

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


@pytest.mark.parametrize('tool', TOOLS)
def test_an_error_of_the_system_names_the_tool(tool):
    ended = subprocess.run(
        [sys.executable, '-c', FAILING.format(tool=tool)], capture_output=True, text=True, timeout=60
    )
    assert (ended.returncode, ended.stdout) == (1, '')
    assert ended.stderr == f'{tool}: error: the disk is full\n'
