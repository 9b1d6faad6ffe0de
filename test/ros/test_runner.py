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

"""The one runner: which executor it takes, when its loop ends, and what it does last."""

from __future__ import annotations

import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest
from rclpy.logging import get_logger
from rclpy.node import Node

from diffdrive_jacobian.lockstep.runner import running_in_lockstep
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.goal_client import GoalClient
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.ros.runner import UserError, make_executor, ros_context, running
from diffdrive_jacobian.signals import Signals


@pytest.mark.parametrize(
    ('isolated', 'with_info', 'kind', 'without_events'),
    [
        (False, False, 'GuardedExecutor', False),
        (True, False, 'EventsExecutor', False),
        (False, True, 'SingleThreadedExecutor', False),
        (False, False, 'SingleThreadedExecutor', True),
        (True, False, 'SingleThreadedExecutor', True),
    ],
)
def test_kind_of_executor(ros, monkeypatch, isolated, with_info, kind, without_events):
    if without_events:
        monkeypatch.setitem(sys.modules, 'rclpy.experimental.events_executor', None)
    executor = make_executor(ros.context, isolated=isolated, with_info=with_info)
    assert type(executor).__name__ == kind
    executor.shutdown()


def test_nodes_of_this_package_run_on_events(ros):
    executor = make_executor(ros.context, isolated=False)
    for node_class in (VirtualRobot, GoToGoal, WheelBridge):
        node = node_class(context=ros.context)
        executor.add_node(node)
        assert not executor.fair
        node.destroy_node()
    executor.shutdown()


@pytest.mark.parametrize('isolated', [False, True])
def test_loop_ends_when_its_condition_holds_or_ros_shuts_down(isolated):
    with ros_context(['test']) as context, running(context, isolated=isolated) as runner:
        node = runner.add(lambda: Node('ticking', context=context))
        ticks = []
        node.create_timer(0.01, lambda: ticks.append(1))
        assert runner.spin(lambda: len(ticks) == 3)
        node.create_timer(0.01, context.try_shutdown)
        assert not runner.spin(lambda: False)


@contextmanager
def real_time():
    with ros_context(['test']) as context, running(context, isolated=True) as runner:
        yield runner


@pytest.mark.parametrize('create', [real_time, lambda: running_in_lockstep(['--ros-args'])])
def test_loop_ends_after_a_time_or_on_a_signal_that_is_new(create):
    signals, calls = Signals(), []

    def never():
        calls.append(1)
        return False

    with create() as runner:
        runner.add(lambda: VirtualRobot(context=runner.context))
        # The condition comes first, also when the time is over.
        assert runner.spin(lambda: True, timeout=-1.0)
        signals.count = 1
        assert not runner.spin(never, signals=signals)
        assert calls == [1]
        start = runner.seconds()
        assert not runner.spin(never, timeout=0.1, signals=signals, handled=1)
        assert runner.seconds() - start > 0.1

        def second():
            signals.count += len(calls) == 3
            return never()

        calls.clear()
        assert not runner.spin(second, signals=signals, handled=1)
        assert len(calls) == 4


def test_every_node_is_stopped_before_any_is_destroyed():
    told = []

    class Telling(GoToGoal):
        def stop(self, why):
            told.append((why, self.context.ok(), len(self.get_node_names())))

    with ros_context(['test']) as context:
        with running(context, isolated=True) as runner:
            runner.add(lambda: VirtualRobot(context=context))
            runner.add(lambda: Telling(context=context))
        assert told == [('shutting down', True, 2)]


def test_a_node_that_cannot_be_created_leaves_nothing_in_the_graph():
    override = 'qos_overrides./odom.publisher.depth:=-1'
    name = 240 * 'n'
    arguments = ['test', '--ros-args', '-p', override, '-r', f'cancel_goal:=/a/{name}/b']
    with ros_context(arguments) as context, running(context, isolated=True) as runner:
        with pytest.raises(UserError, match='qos_overrides of /odom are invalid'):
            runner.add(lambda: VirtualRobot(context=context))
        with pytest.raises(UserError):
            runner.add(lambda: GoalClient('client', np.zeros((1, 3)), context, namespace=name))
        observer = runner.add(lambda: Node('observer', context=context))
        assert observer.get_node_names() == ['observer']


def test_a_node_is_removed_when_its_context_was_shut_down():
    with ros_context(['test']) as context, running(context, isolated=True) as runner:
        node = runner.add(lambda: VirtualRobot(context=context))
        context.shutdown()
        runner.remove(node)
        assert not runner.spin(lambda: False, timeout=10.0)


def start_robot(*arguments):
    """Start and stop a robot with ROS arguments."""
    with (
        ros_context(['test', '--ros-args', *arguments]) as context,
        running(context, isolated=True) as runner,
    ):
        runner.add(lambda: VirtualRobot(context=context))


INVALID = [
    (['-p', 'wheel_radius:=0.0'], "'wheel_radius' must be in [0.001, 10], got 0.0"),
    (['--bogus'], "unknown ROS arguments: ['--bogus']"),
    (['-p', 'kp=2'], "-p must be NAME:=VALUE, got 'kp=2'; did you mean 'kp:=2'?"),
    (['--param', 'kp'], "--param must be NAME:=VALUE, got 'kp'"),
    (['-r', 'a=b'], "-r must be OLD:=NEW, got 'a=b'; did you mean 'a:=b'?"),
    (['-r', '__ns:=robot1'], "got '__ns:=robot1'; did you mean '__ns:=/robot1'?"),
    (['-r', f'odom:={247 * "t"}'], 'with its leading slash, got 248'),
    (['--remap', f'odom:=/{247 * "t"}'], 'got 248'),
    (['-r', f'__node:={300 * "n"}'], 'got 301'),
    (['-r', f'virtual_robot:odom:={300 * "t"}'], "'virtual_robot:odom:=tttt"),
    # Each of these is short enough by itself.
    (
        ['-r', f'__ns:=/{120 * "n"}', '-r', f'reset_odometry:={130 * "s"}'],
        'topic length should not exceed',
    ),
]


@pytest.mark.parametrize(('arguments', 'words'), INVALID)
def test_mistakes_of_the_user_are_described_in_one_line(arguments, words):
    with pytest.raises(UserError) as caught:
        start_robot(*arguments)
    message = str(caught.value)
    assert words in message
    assert len(message) < 300
    assert '\n' not in message


def test_names_of_the_greatest_length_are_accepted():
    start_robot('-r', f'odom:={246 * "t"}', '-r', f'reset_odometry:={245 * "s"}')
    start_robot('-r', f'odom:=/{246 * "t"}', '-r', f'__node:={200 * "n"}')


@pytest.mark.parametrize('domain', ['233', '٣'])
def test_domains_that_do_not_exist_are_named(monkeypatch, domain):
    monkeypatch.setenv('ROS_DOMAIN_ID', domain)
    words = f'must be in 0 to 232, got {domain!r}'
    with pytest.raises(UserError, match=words), ros_context(['test']):
        pass


WITHOUT_LOG = """
import os
from diffdrive_jacobian.ros.runner import UserError, ros_context

for folder in ('/proc/none', os.curdir):
    os.environ['ROS_LOG_DIR'] = folder
    try:
        with ros_context(['test'], default=True) as context:
            print(context.ok())
    except UserError as error:
        print(error)
"""


@pytest.mark.process
def test_a_log_that_cannot_be_written_is_named_and_the_next_context_is_a_new_one(tmp_path):
    command = [sys.executable, '-c', WITHOUT_LOG]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True, timeout=60)
    first, second = ended.stdout.splitlines()
    assert first.endswith('set ROS_LOG_DIR to a folder that can be written')
    assert second == 'True'


def test_log_level_does_not_outlast_the_context(capfd):
    with ros_context(['test', '--ros-args', '--log-level', 'error']):
        get_logger('somebody').info('not to be heard')
    with ros_context(['test']):
        get_logger('somebody').info('to be heard')
    said = capfd.readouterr().err
    assert 'to be heard' in said
    assert 'not to be heard' not in said
