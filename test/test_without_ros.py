"""Without ROS: tools that need no ROS work, all others report the remedy in one line.

The absence is simulated in processes of their own, by a finder that hides the packages that
come with ROS or with the extra `jazzy`.
"""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from diffdrive_jacobian.tools.entry_points import ROS_MODULES

CONFIG = Path(__file__).parents[1] / 'config' / 'turtlebot3_burger.yaml'
TOOLS = sorted(
    one.name
    for one in entry_points(group='console_scripts')
    if one.value.startswith('diffdrive_jacobian.')
)
RUN = """
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in {modules!r}:
            raise ModuleNotFoundError(f'No module named {{name!r}}', name=name)

sys.meta_path.insert(0, Absent())
from diffdrive_jacobian.tools import entry_points
sys.exit(getattr(entry_points, {tool!r})())
"""


def run(tool, *arguments, modules=ROS_MODULES, **kwargs):
    program = RUN.format(modules=(*modules, 'rpyutils'), tool=tool)
    return subprocess.run(
        [sys.executable, '-c', program, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=60,
        **kwargs,
    )


def test_every_tool_is_known():
    assert {'drive_to', 'go_to_goal', 'sweep_gains', 'virtual_robot', 'wheel_bridge'} <= set(TOOLS)


@pytest.mark.parametrize('tool', [tool for tool in TOOLS if tool != 'sweep_gains'])
def test_one_line_reports_the_remedy(tmp_path, tool):
    arguments = {'send_goal': ('1', '1'), 'drive_to': ('1', '1')}.get(tool, ())
    if tool in ('plot_run', 'replay_run', 'recover_run'):
        arguments = (tmp_path,)
    ended = run(tool, *arguments, cwd=tmp_path)
    assert (ended.returncode, ended.stdout) == (1, '')
    assert ended.stderr.count('\n') == 1
    assert ended.stderr.startswith(f'{tool}: error: ROS 2 is not available, there is no Python module ')
    assert 'source the setup file' in ended.stderr
    assert "pip install '.[jazzy]'" in ended.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize('tool', [tool for tool in TOOLS if tool not in ('plot_run', 'recover_run')])
def test_help_and_wrong_arguments_need_no_ros(tool):
    helped, mistaken = run(tool, '--help'), run(tool, '--bogus')
    assert (helped.returncode, helped.stderr) == (0, '')
    assert helped.stdout.startswith(f'usage: {tool} ')
    assert mistaken.returncode == 2
    assert mistaken.stderr.splitlines()[-1].startswith(f'{tool}: error: ')


def test_gains_are_swept_without_ros(tmp_path):
    arguments = ('--grid', '2', '--starts', '2', '--rate', '10', '--params-file', CONFIG)
    ended = run('sweep_gains', *arguments, cwd=tmp_path)
    assert (ended.returncode, ended.stderr) == (0, '')
    assert sorted(one.suffix for one in tmp_path.iterdir()) == ['.csv', '.png']
    refused = run('sweep_gains', '--tolerance', '0', cwd=tmp_path)
    assert refused.stderr.splitlines()[-1].startswith('sweep_gains: error: ')


def test_another_module_that_is_missing_is_a_defect_and_surfaces():
    ended = run('drive_to', '1', '1', modules=('numpy',))
    assert ended.returncode == 1
    assert ended.stderr.splitlines()[-1] == "ModuleNotFoundError: No module named 'numpy'"
    assert 'Traceback' in ended.stderr
