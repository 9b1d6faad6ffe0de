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

"""Options that several tools have: robots, namespaces, --force, and what is printed while one waits."""

from __future__ import annotations

import math
import os
import threading
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from geometry_msgs.msg import Twist
from rclpy.parameter import Parameter
from support.commands import refused, run
from support.lockstep_nodes import make_complete
from support.recorded import LockstepRecording
from support.ros_messages import twist

from diffdrive_jacobian.bags import BagError, read_run
from diffdrive_jacobian.bags.bag_reader import open_bag
from diffdrive_jacobian.bags.bag_writer import build_bag
from diffdrive_jacobian.bags.journal import Text
from diffdrive_jacobian.drives import in_lockstep
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.remote_goal import send_goal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.parameters import file as configuration_files
from diffdrive_jacobian.parameters.chosen_law import ignores_heading
from diffdrive_jacobian.parameters.file import configurations
from diffdrive_jacobian.plots import rendering
from diffdrive_jacobian.recording import NothingToPlayError, Playback
from diffdrive_jacobian.recording.recording import open_recording
from diffdrive_jacobian.testing import Lockstep
from diffdrive_jacobian.tools import _output

pytestmark = pytest.mark.slow


def test_the_configurations_of_an_installation_are_found(tmp_path, monkeypatch):
    folder = tmp_path / 'share' / 'diffdrive_jacobian' / 'config'
    folder.mkdir(parents=True)
    (folder / 'rover.yaml').write_text('')

    def found(module, prefixes):
        monkeypatch.setattr(configuration_files, '__file__', str(tmp_path / module / 'a' / 'b' / 'c.py'))
        monkeypatch.setenv('AMENT_PREFIX_PATH', prefixes)
        return configurations()

    assert 'rover' not in found('lib', '/nowhere')
    assert found('lib', os.pathsep.join(['/nowhere', str(tmp_path)]))['rover'] == folder / 'rover.yaml'
    assert found('', '')['rover'] == folder / 'rover.yaml'
    # As pip and colcon install. The list of the installed files, which is slow to read, is not needed.
    monkeypatch.setattr(configuration_files, '_listed_files', lambda: pytest.fail('it reads the list'))
    assert found('lib/python3/site-packages', '') == {'rover': folder / 'rover.yaml'}


# --- Bags of several robots


@pytest.fixture(scope='module')
def robots(tmp_path_factory):
    """A bag of two robots with different limits; the second one stands elsewhere."""
    path = tmp_path_factory.mktemp('bags') / 'two'
    with Lockstep() as world:
        world.add(make_complete(VirtualRobot, 'one'))
        world.add(make_complete(VirtualRobot, 'two', x=5.0, linear__x__max_velocity=0.5))
        made = LockstepRecording(world, path, everything=True)
        for robot in ('one', 'two'):
            world.node.create_publisher(Twist, f'/{robot}/cmd_vel', 10)
        made.look()
        for speed in (0.25, 0.5):
            world.publish('/one/cmd_vel', twist(speed, 0.0))
            world.publish('/two/cmd_vel', twist(2.0 * speed, 0.0))
            world.run_for(0.4)
        world.remove(made.recorder)
        made.recording.finish()
    return path


def test_a_bag_of_several_robots_is_read_by_namespace(robots, tmp_path, monkeypatch):
    with pytest.raises(BagError, match='choose one of them, or one namespace'):
        read_run(robots)
    with pytest.raises(BagError, match=r'in the namespace /three; it has them in /one, /two'):
        read_run(robots, namespace='/three')
    first, second = (read_run(robots, namespace=name) for name in ('/one', '/two'))
    ends = (first.odometry.values[-1, 0], second.odometry.values[-1, 0])
    assert ends == pytest.approx((0.3, 5.36), abs=0.05)
    assert second.of_node('virtual_robot')['linear.x.max_velocity'] == 0.5
    assert math.isnan(first.of_node('virtual_robot')['linear.x.max_velocity'])
    assert list(first.parameters) == ['/one/virtual_robot']
    for tool in (('verify_run', robots), ('replay_run', '--verify', robots)):
        ended = run(*tool, '--namespace', 'two')
        assert (ended.code, 'moves as recorded' in ended.out) == (0, True)
    assert 'one namespace (--namespace)' in refused('verify_run', robots)
    # Parameters that it does not use are refused.
    message = refused('verify_run', robots, '--namespace', 'one', '--robot', 'create3')
    assert 'have no effect: the bag has cmd_vel_out' in message
    monkeypatch.setattr(rendering, 'render', lambda *_: b'picture')
    ended = run('plot_run', robots, '--namespace', 'two', '--csv', tmp_path / 'two.csv')
    assert (ended.code, Path(ended.out.splitlines()[0]).name) == (0, 'two_two.png')
    x = np.loadtxt(tmp_path / 'two.csv', delimiter=',', skiprows=1, usecols=1)
    assert x[0] == pytest.approx(5.0, abs=0.05)


def test_playback_chooses_a_namespace(robots):
    def topics(**how):
        with open_bag(robots) as reader:
            return {one.topic for one in Playback(**how).choose(reader)}

    assert topics() == {'/one/cmd_vel', '/two/cmd_vel'}
    assert topics(namespace='/two') == {'/two/cmd_vel'}
    everything = topics(names=None, namespace='/two')
    assert {'/two/odom', '/two/cmd_vel_out'} <= everything
    assert all(one.startswith('/two/') for one in everything)
    assert topics(names=None, namespace='/') == topics(names=None)
    assert topics(topics=('/one/odom', 'two/odom')) == {'/one/odom', '/two/odom'}
    with pytest.raises(BagError, match='odom is ambiguous, it can be /one/odom or /two/odom'):
        topics(topics=('odom',))
    for missing in ('dom', '/odom', ''):
        with pytest.raises(BagError, match=f'has no topic {missing}; it has /clock, '):
            topics(topics=(missing,))
    with pytest.raises(NothingToPlayError, match='cmd_vel in the namespace /three'):
        topics(namespace='/three')


# --- --force


def test_a_bag_replaces_another_one_only_if_asked(tmp_path):
    target = tmp_path / 'run'
    build_bag([], [Text('a', 'old')], target)
    with pytest.raises(FileExistsError):
        build_bag([], [Text('a', 'new')], target)
    before = (target / 'metadata.yaml').read_text()

    def failing():
        yield Text('a', 'new')
        raise OSError('the disk is full')

    with pytest.raises(OSError, match='the disk is full'):
        build_bag([], failing(), target, replace=True)
    assert (target / 'metadata.yaml').read_text() == before
    build_bag([], [Text('a', 'new')], target, replace=True)
    assert 'new' in (target / 'metadata.yaml').read_text()
    assert sorted(one.name for one in target.iterdir()) == ['metadata.yaml', 'run.mcap']
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize('content', [(), ('metadata.yaml', 'thesis.tex'), ('other.journal.mcap',)])
def test_a_directory_that_is_no_bag_is_never_replaced(tmp_path, content):
    target = tmp_path / 'thesis'
    target.mkdir()
    for name in content:
        (target / name).touch()
    (tmp_path / 'link').symlink_to(target)
    for name in ('thesis', 'link'):
        with pytest.raises(UserError, match='is not a bag: it is not replaced'):
            open_recording('run', str(tmp_path / name), replace=True)
    assert sorted(one.name for one in target.iterdir()) == sorted(content)


def test_force_replaces_bags_and_files_and_no_directories(tmp_path, robots, monkeypatch):
    monkeypatch.setattr(rendering, 'render', lambda *_: b'picture')
    monkeypatch.chdir(tmp_path)
    for name in ('run.png', 'a.png', 'a.csv'):
        (tmp_path / name).write_text('old')
    (tmp_path / 'b.png').mkdir()
    build_bag([], [Text('a', 'old')], tmp_path / 'run')
    plot = ('plot_run', robots, '--namespace', 'one', '-o')
    for command in (
        ('drive_to', 0.2, 0, '--lockstep', '-o', 'run', '--tolerance', 0.1),
        (*plot, 'a.png'),
        ('sweep_gains', '--grid', 2, '--starts', 1, '--duration', 1, '--csv', 'a.csv'),
    ):
        assert run(*command, '--force').code == 0
    assert read_run(tmp_path / 'run').goals.values[0, 0] == 0.2
    for name in ('run.png', 'a.png'):
        assert (tmp_path / name).read_bytes() == b'picture'
    assert (tmp_path / 'a.csv').read_text().startswith('kp_per_s')
    assert run(*plot, 'b.png', '--force').code == 2
    assert {one.name for one in tmp_path.iterdir()} == {'a.csv', 'a.png', 'b.png', 'run', 'run.png'}
    # Not even the bag to recover.
    message = refused('recover_run', robots, '-o', robots, '--force')
    assert 'is the bag to recover: it is not replaced' in message


# --- What is printed


def test_what_is_waited_for_is_said_after_half_a_second_of_each_wait(monkeypatch, capsys):
    now = 100.0
    monkeypatch.setattr(_output.time, 'monotonic', lambda: now)
    waiting = _output.Waiting()
    said = []
    for step in range(100):
        now = 100.0 + 0.1 * step
        waiting.show('a reader')
        if capsys.readouterr().out:
            said.append(step)
    assert said == pytest.approx([5, 35, 65, 95], abs=1)
    for later, line in ((5.0, ''), (5.3, ''), (5.6, 'waiting: the end\n')):
        now = 109.9 + later
        waiting.show('the end')
        assert capsys.readouterr().out == line


def test_long_work_is_named_on_a_terminal(monkeypatch):
    written = threading.Event()
    terminal = Mock(**{'isatty.return_value': True, 'flush.side_effect': written.set})
    monkeypatch.setattr(_output, 'FIRST', 0.01)
    monkeypatch.setattr(_output.sys, 'stderr', terminal)
    with _output.busy('tool', 'reading'):
        assert written.wait(10.0)
    assert terminal.write.call_args_list[0].args == ('tool: reading ...',)


@pytest.mark.parametrize(
    ('values', 'ignored'),
    [
        ({'controller': 'go_to_goal', 'use_goal_heading': False}, True),
        ({'controller': 'go_to_goal', 'use_goal_heading': True}, False),
        ({'controller': 'pose', 'use_goal_heading': False}, False),
        ({'controller': 'of_another_package', 'use_goal_heading': False}, False),
        ({}, False),
    ],
)
def test_a_controller_that_ignores_the_heading(values, ignored):
    assert ignores_heading(values) == ignored


@pytest.mark.parametrize(
    ('matters', 'follow', 'used'),
    [(True, True, False), (True, False, False), (False, True, False), (True, True, True)],
)
def test_a_heading_that_is_ignored_is_reported_if_it_matters(matters, follow, used):
    progress, given = Mock(), [Parameter('use_goal_heading', value=used)]
    with in_lockstep() as runner:
        runner.add(lambda: GoToGoal(context=runner.context, parameter_overrides=given))
        how = {'follow': follow, 'heading_matters': matters, 'timeout': 1.0, 'progress': progress}
        send_goal([1.0, 0.0, 1.5], runner=runner, **how)
    assert progress.heading_ignored.called == (matters and not used)
    waiting = {call.args for call in progress.waiting.call_args_list}
    assert (('no odometry on /odom',) in waiting) == follow
