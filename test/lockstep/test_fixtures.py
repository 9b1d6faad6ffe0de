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

"""The plugin of pytest as a user of the package has it: without any line in a conftest.py."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
import warnings

import pytest
from nav_msgs.msg import Odometry
from rclpy.node import Node
from support.domains import domain_id
from support.harness import PATIENCE
from support.inner_sessions import draw_quickly, run_inner
from support.ros_messages import twist

from diffdrive_jacobian.faults import EncoderSteps, Kill
from diffdrive_jacobian.ros.runner import ros_context
from diffdrive_jacobian.testing import Lockstep

PLUGIN = 'diffdrive_jacobian.testing.fixtures'
OF_ROBOTS = 'diffdrive_jacobian.robot_testing.fixtures'


@pytest.fixture
def run(pytester, monkeypatch):
    """Run tests in this process; gives the result and its text."""
    draw_quickly(monkeypatch)

    def run_tests(tests, *options, **outcomes):
        result = run_inner(pytester, tests, *options)
        result.assert_outcomes(**outcomes)
        # Under `colcon test` the summary of warnings goes to standard error.
        text = result.stdout.str() + result.stderr.str()
        assert 'INTERNALERROR' not in text
        return text

    return run_tests


# --- The plugin


UNRELATED = """
import json, os, sys

class Blocker:
    wanted = []

    def find_spec(self, name, *_):
        if name.partition('.')[0] in ('rclpy', 'numpy', 'matplotlib', 'rosbags'):
            self.wanted.append(name)
            raise ModuleNotFoundError(f'No module named {name!r}', name=name)

sys.meta_path.insert(0, Blocker())

def pytest_collection_finish():
    with open('found.json', 'w') as file:
        json.dump({'wanted': Blocker.wanted, 'modules': [*sys.modules], 'env': dict(os.environ)}, file)
"""


@pytest.mark.process
def test_the_plugin_does_nothing_in_projects_without_ros(pytester):
    """In a process of its own, in which neither ROS nor NumPy can be imported."""
    pytester.makepyfile(
        blocker=UNRELATED,
        test_unrelated='def test_passes(): pass',
        test_robot='def test_needs_ros(lockstep): pass',
    )
    command = [sys.executable, '-m', 'pytest', '-p', 'blocker', '-p', 'no:hypothesispytest', '-q']
    command += ['-p', 'no:launch_testing']
    before = {**os.environ, 'PYTHONPATH': os.pathsep.join(['.', os.environ.get('PYTHONPATH', '')])}
    ended = subprocess.run(command, cwd=pytester.path, env=before, capture_output=True, text=True)
    assert '1 passed, 1 error' in ended.stdout, ended.stdout + ended.stderr
    words = "the fixture lockstep needs ROS 2, which cannot be imported: No module named 'rclpy'"
    assert words in ended.stdout
    found = json.loads((pytester.path / 'found.json').read_text())
    assert found['wanted'] == []
    ours = {name for name in found['modules'] if name.startswith('diffdrive_jacobian')}
    plugins = {PLUGIN, OF_ROBOTS, 'diffdrive_jacobian.grading.plugin'}
    packages = {plugin.rpartition('.')[0] for plugin in plugins}
    assert ours == {'diffdrive_jacobian', 'diffdrive_jacobian.lazy', *packages, *plugins}
    changed = {name for name, value in found['env'].items() if before.get(name) != value}
    assert all(name.startswith('PYTEST_') for name in changed)
    assert before.keys() <= found['env'].keys()


def test_the_plugin_may_be_named_again_or_left_out(run, pytester):
    pytester.makeconftest(f"pytest_plugins = ['{PLUGIN}']")
    run('def test_has_the_fixture(lockstep): pass', '-p', PLUGIN, passed=1)
    pytester.makeconftest('')
    text = run('def test_has_none(lockstep): pass', '-p', f'no:{PLUGIN}', errors=1)
    assert "fixture 'lockstep' not found" in text


CHECKED = """
    import os
    from conftest import AT_START

    def test_checks():
        assert AT_START == os.environ.get('ROS_PYTHON_CHECK_FIELDS') == {expected!r}
"""


@pytest.mark.parametrize(('ini', 'expected'), [('lockstep_check_fields = true', '1'), ('', None)])
def test_fields_are_checked_from_the_beginning_if_the_option_is_set(
    run, pytester, monkeypatch, ini, expected
):
    monkeypatch.delenv('ROS_PYTHON_CHECK_FIELDS')
    pytester.makeini(f'[pytest]\n{ini}')
    pytester.makeconftest("import os\nAT_START = os.environ.get('ROS_PYTHON_CHECK_FIELDS')")
    run(CHECKED.format(expected=expected), passed=1)
    assert 'ROS_PYTHON_CHECK_FIELDS' not in os.environ


def test_a_message_type_that_was_imported_before_its_fields_are_checked_is_reported(
    run, pytester, monkeypatch
):
    monkeypatch.setattr('geometry_msgs.msg._twist.ros_python_check_fields', '')
    # As launch_testing does: the category is left out.
    monkeypatch.setattr(warnings, 'formatwarning', lambda message, *_, **__: f'{message}\n')
    pytester.makeini('[pytest]\nlockstep_check_fields = true')
    text = run('def test_passes(): pass', '-W', 'default', passed=1, warnings=1)
    assert 'has no effect on message types that were imported before, of geometry_msgs: set ' in text


# --- Worlds


def test_robots_have_a_pose_a_namespace_and_parameters_of_their_own(lockstep, robot_at):
    robot_at(1.0, -2.0, 0.5, namespace='one', linear__x__max_velocity=0.2)
    two = robot_at(namespace='two')
    odometry = lockstep.listen(Odometry, '/one/odom')
    lockstep.publish('/one/cmd_vel', twist(1.0, 0.0))
    lockstep.run_for(0.5)
    assert odometry[-2].twist.twist.linear.x == 0.2
    position = odometry[-1].pose.pose.position
    assert math.dist((position.x, position.y), (1.0, -2.0)) == pytest.approx(0.1)
    assert two.pose.tolist() == [0.0, 0.0, 0.0]
    with pytest.raises(TypeError, match=r"no parameter 'max_speed'; it has linear\.x\.max_velocity"):
        robot_at(max_speed=3.0)


def test_a_robot_that_is_killed_is_made_again_where_it_was_put(lockstep, robot_at):
    robot = robot_at(1.0)
    lockstep.inject(Kill('virtual_robot', start=1.0, duration=1.0))
    lockstep.run_for(3.0)
    again = lockstep.find('virtual_robot')
    assert again is not robot
    assert again.pose.tolist() == [1.0, 0.0, 0.0]


def test_a_robot_has_its_pose_by_odometry_and_its_true_one(lockstep, robot_at):
    robot = robot_at(1.0, 2.0, 0.5, simulate_slip=True, slip_seed=3)
    assert robot.pose.tolist() == robot.truth.tolist() == [1.0, 2.0, 0.5]
    lockstep.publish('cmd_vel', twist(1.0, 0.0))
    lockstep.run_for(0.4)
    assert robot.pose == pytest.approx([1.0 + 0.4 * math.cos(0.5), 2.0 + 0.4 * math.sin(0.5), 0.5])
    assert math.dist(robot.pose[:2], robot.truth[:2]) > 1e-4
    # Between two messages, too, as copies.
    lockstep.run_for(0.01)
    robot.pose[:] = robot.truth[:] = 0.0
    assert math.dist(robot.pose[:2], (1.0, 2.0)) == pytest.approx(0.41)
    # It is that of the encoders.
    lockstep.inject(EncoderSteps(per_revolution=10))
    lockstep.run_for(0.13)
    assert robot.pose[0] == lockstep.last('odom').pose.pose.position.x
    assert 1e-4 < math.dist(robot.pose[:2], robot.truth[:2]) < 0.03


def test_no_other_node_sees_those_of_a_world(monkeypatch):
    """On one domain, also in one process, where nodes of two contexts see each other."""
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    monkeypatch.setenv('ROS_DOMAIN_ID', str(domain_id()))
    with Lockstep() as world, ros_context(['test']) as context, ros_context(['test']) as other:
        world.node.create_publisher(Odometry, 'odom', 10)
        observer = Node('observer', context=context)
        later = Node('later', context=other)
        later.create_publisher(Odometry, 'odom', 10)
        deadline = time.monotonic() + PATIENCE
        while observer.count_publishers('odom') == 0:
            assert time.monotonic() < deadline
        assert observer.count_publishers('odom') == 1
        assert world.node.count_publishers('odom') == 1
        for node in (observer, later):
            node.destroy_node()


# --- Reports


FAILURES = """
    from dataclasses import dataclass
    from diffdrive_jacobian import properties
    from diffdrive_jacobian.testing import PropertyViolation

    def test_fails(lockstep, robot_at):
        robot_at()
        lockstep.publish('cmd_vel', Twist())
        assert False

    def test_raises(lockstep):
        def on_tick():
            raise KeyError('no such wheel')
        lockstep.node.create_timer(0.1, on_tick)
        lockstep.run_for(1.0)

    @pytest.fixture
    def driving(lockstep, robot_at, recorded_run):
        robot_at(namespace='driving')
        lockstep.publish('/driving/cmd_vel', Twist())
        assert False

    def test_is_not_set_up(driving):
        pass

    @dataclass(repr=False)
    class Ends(properties.Property):
        def begin(self):
            pass

        def finish(self):
            return 'it never ends'

    def test_ends(lockstep, robot_at, recorded_run):
        robot_at()
        lockstep.require(Ends())
        lockstep.run_for(0.1)

    def test_is_closed_by_hand(lockstep):
        lockstep.require(Ends())
        with pytest.raises(PropertyViolation, match='it never ends'):
            lockstep.finish()
        lockstep.close()

    @pytest.mark.lockstep(3)
    def test_has_a_mark_without_a_name(lockstep):
        pass

    def test_fails_for_another_reason(lockstep):
        lockstep.require(Ends())
        assert 1 == 2
"""


def test_a_failure_reports_the_last_messages_once_and_required_properties_are_checked(run):
    # Without the summary, which repeats whole messages where the variable CI is set.
    text = run(FAILURES, '-rN', failed=4, passed=1, errors=2)
    assert text.count('  /cmd_vel: 1 from /lockstep, last at 1 s: Twist()') == 1
    assert text.count('  /driving/cmd_vel: 1 from /lockstep, last at 1 s: Twist()') == 1
    assert 'TypeError: the marker lockstep takes keyword arguments only' in text
    assert "raise KeyError('no such wheel')" in text
    assert '_scheduler.py' not in text
    assert text.count('Ends() is violated at 0.1 s: it never ends\nlast messages, at 1.1 s of the ') == 1
    assert 'E       assert 1 == 2' in text
    assert 'During handling' not in text
    # Once in each test, and in a violation as part of it.
    assert text.count('- lockstep -') == 4
    assert text.count('- recorded run -') == 2


BROKEN = """
    import errno, os
    from diffdrive_jacobian.bags.journal import JournalWriter
    from diffdrive_jacobian.recording.recording import RecordingError

    def broken():
        raise KeyError('of a bug')

    def test_fails(lockstep, recorded_run, monkeypatch):
        monkeypatch.setattr(lockstep, 'report', broken)
        monkeypatch.setattr(recorded_run, 'keep', broken)
        assert False

    @pytest.fixture
    def full_disk(lockstep, robot_at, recorded_run, monkeypatch):
        def write(*_):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        monkeypatch.setattr(JournalWriter, 'flush', write)
        robot_at()
        lockstep.run_for(1.0)

    def test_fails_on_a_full_disk(recorded_run, full_disk):
        assert False

    def test_keeps(recorded_run, full_disk):
        for _ in range(2):
            with pytest.raises(RecordingError, match='No space left on device'):
                recorded_run.keep()
"""


def test_what_fails_while_a_failure_is_reported_is_reported_and_the_session_goes_on(run):
    text = run(BROKEN, failed=2, passed=1)
    assert text.count("not available: KeyError: 'of a bug'") == 2
    assert 'the recording was aborted: No space left on device' in text
