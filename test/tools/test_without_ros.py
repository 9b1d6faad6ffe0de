"""Without ROS: tools that need no ROS work, all others report the remedy in one line.

The absence is simulated in processes of their own, by a finder that hides the packages that
come with ROS or with the extra `jazzy`.
"""

from __future__ import annotations

import shutil
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from fork_server import forked
from rclpy.serialization import serialize_message
from support.bags import SECOND, changed, odom, start, status, write_bag
from support.ros_messages import goal, goals, joint_command, twist_stamped

from diffdrive_jacobian.bags import read_run, verify
from diffdrive_jacobian.bags.journal import Channel, JournalWriter, Message
from diffdrive_jacobian.bags.message_definitions import known_definition
from diffdrive_jacobian.tools.entry_points import ROS_MODULES

CONFIG = Path(__file__).parents[2] / 'config' / 'turtlebot3_burger.yaml'
TOOLS = sorted(
    one.name
    for one in entry_points(group='console_scripts')
    if one.value.startswith('diffdrive_jacobian.')
)
WITHOUT_ROS = (
    *('calibrate_run', 'plot_jacobian', 'plot_run', 'recover_run', 'sweep_gains', 'verify_run'),
)
BAG = Path(__file__).parents[1] / 'bags' / 'turtlebot3_fake_sqlite'
"""Recorded with ros2 bag record."""
READ = """
from diffdrive_jacobian.bags import read_run, verify
run = read_run(sys.argv[1])
print(len(run.odometry), run.skipped, repr(run.odometry.values.sum()), verify(run).source)
"""
ABSENT = """
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in {modules!r}:
            raise ModuleNotFoundError(f'No module named {{name!r}}', name=name)

sys.meta_path.insert(0, Absent())
"""
RUN = """
from diffdrive_jacobian.tools import entry_points
sys.exit(getattr(entry_points, {tool!r})())
"""
HIDDEN = (*ROS_MODULES, 'rpyutils')


def execute(program, *arguments, modules=HIDDEN, **kwargs):
    """Run a program without some packages, in a fork of a process that has never imported them."""
    return forked.run(
        ABSENT.format(modules=modules) + program,
        arguments,
        modules=forked.LIBRARIES if modules == HIDDEN else (),
        timeout=60,
        **kwargs,
    )


def run(tool, *arguments, **kwargs):
    return execute(RUN.format(tool=tool), *arguments, **kwargs)


def test_every_tool_is_known():
    assert {'drive_to', 'go_to_goal', 'sweep_gains', 'virtual_robot', 'wheel_bridge'} <= set(TOOLS)


@pytest.mark.parametrize('tool', [tool for tool in TOOLS if tool not in WITHOUT_ROS])
def test_one_line_reports_the_remedy(tmp_path, tool):
    arguments = {
        'send_goal': ('1', '1'),
        'send_path': ('circle:1',),
        'drive_to': ('1', '1'),
    }.get(tool, ())
    if tool == 'replay_run':
        arguments = (tmp_path,)
    ended = run(tool, *arguments, cwd=tmp_path)
    assert (ended.returncode, ended.stdout) == (1, '')
    assert ended.stderr.count('\n') == 1
    assert ended.stderr.startswith(f'{tool}: error: ROS 2 is not available, there is no Python module ')
    assert 'source the setup file' in ended.stderr
    assert "pip install '.[jazzy]'" in ended.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize('tool', TOOLS)
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


# --- Runs


@pytest.fixture(scope='module', params=['ours', 'ros2 bag record'])
def bag(request, tmp_path_factory):
    if request.param != 'ours':
        return BAG
    # Written here with rclpy; it is read where there is none.
    return write_bag(
        tmp_path_factory.mktemp('bags') / 'run',
        sorted(everything(), key=lambda one: one[0]),
        parameters={'/virtual_robot': {'wheel_radius': 0.03}},
    )


def everything():
    yield 1.0, '/start_pose', start(0.0, 0.0, 0.0, seconds=1.0)
    yield 1.0, '/cmd_vel_out', twist_stamped(0.5, 0.0, SECOND)
    yield 1.05, '/goals', goals(goal(0.2, 0.0), goal(0.5, 0.0), stamp=1)
    yield 1.06, '/goal_status', status(2, seconds=1)
    yield 1.5, '/parameter_events', changed('/virtual_robot', 'wheel_radius', 0.04)
    for index in range(20):
        at = 1.1 + index / 20
        yield at, '/odom', odom(0.5 * (at - 1.0), 0.0, 0.0, 0.5, seconds=at)
        yield at, '/joint_states', joint_command(10.0, 10.0, round(at * SECOND))


def test_a_run_is_read_and_verified_without_ros(bag):
    ended = execute(READ, bag)
    expected = read_run(bag)
    told = (
        f'{len(expected.odometry)} {{}} {expected.odometry.values.sum()!r} {verify(expected).source}\n'
    )
    assert (ended.returncode, ended.stderr, ended.stdout) == (0, '', told)


def test_a_run_is_drawn_and_exported_without_ros(tmp_path, bag):
    ended = run('plot_run', bag, '-o', tmp_path / 'run.png', '--csv', tmp_path / 'run.csv')
    assert (ended.returncode, ended.stderr) == (0, '')
    assert (tmp_path / 'run.png').stat().st_size > 10_000
    lines = (tmp_path / 'run.csv').read_text().splitlines()
    assert len(lines) == 1 + len(read_run(bag).odometry)


@pytest.mark.parametrize('tool', [('verify_run',), ('replay_run', '--verify')])
def test_a_run_is_verified_by_the_tools_without_ros(bag, tool):
    ended = run(*tool, bag)
    assert (ended.returncode, ended.stderr) == (0, '')
    assert ended.stdout.endswith('the robot moves as recorded\n')


def test_a_bag_is_recovered_without_ros(tmp_path, bag):
    damaged = shutil.copytree(bag, tmp_path / 'bag')
    (damaged / 'metadata.yaml').unlink()
    ended = run('recover_run', damaged)
    assert (ended.returncode, ended.stderr) == (0, '')
    assert 'lost: ' not in ended.stdout
    assert 'not checked' not in ended.stdout
    assert len(read_run(tmp_path / 'bag_recovered').odometry) == len(read_run(bag).odometry)


def test_a_journal_is_recovered_without_ros(tmp_path):
    """Of types that are not known the messages are saved, and reported as not checked."""
    writer = JournalWriter(tmp_path / 'run.journal.mcap')
    mine = Channel(
        id=0, topic='/x', type_name='a_msgs/msg/A', definition='int32 a\n', type_hash='RIHS01_0'
    )
    known = known_definition('nav_msgs/msg/Odometry')
    theirs = Channel(
        id=1, topic='/odom', type_name=known.name, definition=known.text, type_hash=known.type_hash
    )
    for record in (
        *(mine, theirs, Message(0, SECOND, b'\0\1\0\0\1\0\0\0')),
        *(Message(1, SECOND, data) for data in (serialize_message(odom(0, 0, 0)), b'\0\1\0\0xyz')),
    ):
        writer.add(record)
    writer.flush()
    writer.close()
    ended = run('recover_run', tmp_path / 'run.journal.mcap')
    assert (ended.returncode, ended.stderr) == (0, '')
    assert 'the 1 messages on /x were not checked' in ended.stdout
    assert '1 of 2 messages on /odom cannot be decoded' in ended.stdout
    assert len(read_run(tmp_path / 'run').odometry) == 1


@pytest.mark.parametrize(
    ('tool', 'arguments'),
    [
        ('drive_to', ('1', '1')),
        ('plot_run', (BAG,)),
        ('record_run', ('-o', 'run')),
        ('recover_run', (BAG,)),
        ('replay_run', (BAG,)),
        ('verify_run', (BAG,)),
    ],
)
def test_without_rosbags_one_line_reports_the_remedy(tmp_path, tool, arguments):
    """A ROS installation has no rosbags. This package needs it in addition."""
    ended = run(tool, *arguments, modules=('rosbags',), cwd=tmp_path)
    assert (ended.returncode, ended.stdout) == (1, '')
    assert ended.stderr == (
        f'{tool}: error: there is no Python module rosbags: call pip install rosbags\n'
    )
    assert not list(tmp_path.iterdir())


def test_another_module_that_is_missing_is_a_defect_and_surfaces():
    ended = run('drive_to', '1', '1', modules=('numpy',))
    assert ended.returncode == 1
    assert ended.stderr.splitlines()[-1] == "ModuleNotFoundError: No module named 'numpy'"
    assert 'Traceback' in ended.stderr
