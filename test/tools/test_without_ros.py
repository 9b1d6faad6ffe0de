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

"""Without ROS: tools that need no ROS work, all others report the remedy in one line.

The absence is simulated in processes of their own, by a finder that hides the packages that
come with ROS or with the extra `jazzy`.
"""

from __future__ import annotations

import re
import shutil
import socket
from pathlib import Path

import numpy as np
import pytest
from support.bags import REAL, SECOND, changed, odom, start, status, write_bag
from support.commands import COMMANDS, error_of, run, run_each
from support.ros_messages import goal, goals, joint_command, twist_stamped

from diffdrive_jacobian.bags import read_run
from diffdrive_jacobian.tools.entry_points import ROS_MODULES

pytestmark = pytest.mark.process

CONFIG = Path(__file__).parents[2] / 'config' / 'turtlebot3_burger.yaml'
WITHOUT_ROS = {
    *('calibrate_run', 'drive_to', 'grade_hand_ins', 'plot_jacobian', 'plot_run', 'recover_run'),
    *('sweep_gains', 'verify_run'),
}
ARGUMENTS = {'send_goal': (1, 1), 'send_path': ('circle:1',), 'replay_run': (REAL,)}
ABSENT = """
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in {modules!r}:
            raise ModuleNotFoundError(f'No module named {{name!r}}', name=name)

sys.meta_path.insert(0, Absent())
"""
HIDDEN = ABSENT.format(modules=(*ROS_MODULES, 'rpyutils'))


def without_ros(*calls, **kwargs):
    """Run commands in a fork of a process that has never imported ROS."""
    return run_each(calls, HIDDEN, **kwargs)


def test_one_line_reports_the_remedy_and_help_needs_no_ros(tmp_path):
    ros = [command for command in COMMANDS if command not in WITHOUT_ROS]
    assert len(ros) == len(COMMANDS) - len(WITHOUT_ROS)
    calls = [(command, '--help') for command in COMMANDS]
    calls += [(command, *ARGUMENTS.get(command, ())) for command in ros]
    for (command, *arguments), ended in zip(calls, without_ros(*calls, cwd=tmp_path), strict=True):
        if '--help' in arguments:
            assert (ended.code, ended.err) == (0, '')
            assert ended.out.startswith(f'usage: {command} ')
            continue
        assert (ended.code, ended.out, ended.err.count('\n')) == (1, '', 1), command
        message = error_of(command, ended)
        assert message.startswith('ROS 2 is not available, there is no Python module ')
        assert 'source the setup file' in message
        assert "pip install '.[jazzy]'" in message
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope='module')
def ours(tmp_path_factory):
    """A bag that is written here with rclpy. It is read where there is none."""
    sent = [
        (1.0, '/start_pose', start(0.0, 0.0, 0.0, seconds=1.0)),
        (1.0, '/cmd_vel_out', twist_stamped(0.5, 0.0, SECOND)),
        (1.05, '/goals', goals(goal(0.2, 0.0), goal(0.5, 0.0), stamp=1)),
        (1.06, '/goal_status', status(2, seconds=1)),
        (1.5, '/parameter_events', changed('/virtual_robot', 'wheel_radius', 0.04)),
    ]
    for at in (1.1 + index / 20 for index in range(20)):
        sent.append((at, '/odom', odom(0.5 * (at - 1.0), 0.0, 0.0, 0.5, seconds=at)))
        sent.append((at, '/joint_states', joint_command(10.0, 10.0, round(at * SECOND))))
    return write_bag(
        tmp_path_factory.mktemp('bags') / 'run',
        sorted(sent, key=lambda one: one[0]),
        parameters={'/virtual_robot': {'wheel_radius': 0.03}},
    )


def test_tools_work_as_with_ros(tmp_path, ours):
    verify = [('verify_run', ours), ('verify_run', REAL), ('replay_run', '--verify', ours)]
    sweep = ('sweep_gains', '--grid', 2, '--starts', 2, '--rate', 10, '--params-file', CONFIG)
    calls = [*verify, (*sweep, '-o', 's.png'), ('plot_run', ours, '-o', 'run.png', '--csv', 'run.csv')]
    for number, bag in enumerate((ours, REAL)):
        damaged = shutil.copytree(bag, tmp_path / f'bag{number}')
        (damaged / 'metadata.yaml').unlink()
        calls.append(('recover_run', damaged))
    with socket.create_server(('127.0.0.1', 0)) as taken:
        # The bag is read, and then there is no port for the page.
        port = taken.getsockname()[1]
        watch = ('watch_run', ours, '--no-browser', '--port', port)
        *ended, watched = without_ros(*calls, watch, cwd=tmp_path)
    assert f'--port {port} is in use' in error_of('watch_run', watched)
    assert [(one.code, one.err) for one in ended] == len(ended) * [(0, '')]
    assert ended[:3] == [run(*call) for call in verify]
    for name in ('s.png', 'run.png'):
        assert (tmp_path / name).stat().st_size > 10_000
    assert len((tmp_path / 'run.csv').read_text().splitlines()) == 1 + len(read_run(ours).odometry)
    for number, bag in enumerate((ours, REAL)):
        saved, original = (read_run(path) for path in (tmp_path / f'bag{number}_recovered', bag))
        np.testing.assert_array_equal(saved.odometry.values, original.odometry.values)


NO_POSIX = f"""
import signal, sys
del signal.SIGHUP
sys.modules.pop('fcntl', None)
{ABSENT.format(modules=(*ROS_MODULES, 'rpyutils', 'fcntl'))}
"""


def test_runs_are_driven_drawn_and_verified_where_files_have_no_locks(tmp_path, ours):
    """As on Windows, which has no SIGHUP either."""
    calls = [('plot_run', ours, '-o', 'run.png'), ('verify_run', ours), ('recover_run', ours)]
    driven = ('drive_to', 0.2, 0, '--lockstep', '--no-plot', '-o', 'driven')
    *ended, drive, verified = run_each(
        [*calls, driven, ('verify_run', 'driven')], NO_POSIX, cwd=tmp_path
    )
    assert [(one.code, one.err) for one in ended[:2]] == 2 * [(0, '')]
    assert (tmp_path / 'run.png').stat().st_size > 10_000
    assert 'is complete: nothing to recover' in ended[2].err
    assert drive.code == verified.code == 0
    assert 'arrived: ' in drive.out


def test_other_missing_modules(tmp_path):
    """A ROS installation has no rosbags, which is needed in addition. Others are a defect."""
    calls = [(tool, REAL) for tool in ('plot_run', 'recover_run', 'replay_run', 'verify_run')]
    calls += [('drive_to', 1, 1), ('record_run', '-o', 'run')]
    ended = run_each(calls, ABSENT.format(modules=('rosbags',)), cwd=tmp_path)
    for (tool, *_), one in zip(calls, ended, strict=True):
        message = f'{tool}: error: there is no Python module rosbags: call pip install rosbags mcap\n'
        assert one == (1, '', message)
    assert not list(tmp_path.iterdir())
    with pytest.raises(AssertionError, match="ModuleNotFoundError: No module named 'numpy'"):
        run_each([('drive_to', 1, 1)], ABSENT.format(modules=('numpy',)))


def test_drive_to_drives_without_nodes_and_says_so(tmp_path):
    parameters = ('--ros-args', '-p', 'kv:=3', '-p', 'kp:=12')
    drive = ('drive_to', 0.2, 0.1, '--lockstep', '--no-record')
    calls = [
        (*drive, *parameters),
        ('drive_to', 0.1, 0, '--no-plot', '-o', 'run', *parameters),
        *((*drive, *more) for more in (('--robot', 'turtlebot3_burger'), ('--timeout', 0.5))),
        *((*drive, '--ros-args', *more) for more in (('-p', 'kpp:=4.0'), ('-r', 'a:=b'), ('-p', 'kp'))),
        ('drive_to', 1, 1, '--open', '--no-record'),
    ]
    first, real, *others = without_ros(*calls, cwd=tmp_path)
    said = 'drive_to: ROS 2 is not available: the same robot drives by the same laws without nodes'
    assert (first.code, first.err.splitlines()[0]) == (0, said)
    assert first.out == run(*calls[0]).out
    assert real.code == 0
    assert len(read_run(tmp_path / 'run').odometry) > 10
    assert [one.code for one in others] == [0, 1, 2, 2, 2, 2]
    words = (
        'parameter .kpp.; did you mean .kp.',
        "got '-r'",
        "got 'kp'",
        '--open needs',
    )
    for word, one in zip(words, others[2:], strict=True):
        assert re.search(word, one.err), one
