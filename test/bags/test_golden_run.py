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

"""Golden runs of tests, and the comparison of messages."""

from __future__ import annotations

import math
import re
import shutil
from functools import partial

import pytest
from geometry_msgs.msg import Point32, PoseStamped
from nav_msgs.msg import Odometry
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from support.bags import write_bag
from support.inner_sessions import draw_quickly, run_inner
from support.raw_bags import contents, data_file
from support.ros_messages import twist
from unique_identifier_msgs.msg import UUID

from diffdrive_jacobian.bags import read_run
from diffdrive_jacobian.bags.bag_reader import open_bag
from diffdrive_jacobian.testing.recorded_run import Comparison, GoldenRun, GoldenRunError

pytestmark = pytest.mark.slow


# --- Messages


def differences(run, golden, tolerance=1e-9, comparison=None):
    """Compare lists of (time, message) of one type."""
    kind = type((run or golden)[0][1])
    one, other = (
        [(time, serialize_message(message)) for time, message in side] for side in (run, golden)
    )
    deserialize = partial(deserialize_message, message_type=kind)
    return (comparison or Comparison(tolerance)).of_topic('/t', one, other, deserialize)


def first(message, golden, tolerance=1e-9):
    """Return how a message differs from a golden one, at 1.5 s."""
    found = differences([(1_500_000_000, message)], [(1_500_000_000, golden)], tolerance)
    return None if found is None else found.first.removeprefix('message 1 of /t, at 1.5 s: ')


def test_the_first_field_that_differs_is_named():
    moved, golden = Odometry(), Odometry()
    moved.pose.pose.position.x, moved.pose.covariance[7] = 1.0, 2.0
    assert first(moved, golden) == (
        'pose.pose.position.x is 1.0, golden 0.0: differs by 1, allowed 1e-09'
    )
    golden.pose.pose.position.x = 1.0
    late = PoseStamped()
    late.header.stamp.nanosec = 1
    joints = JointState(name=['left', 'right'], velocity=[1.0])
    for message, other, words in (
        (moved, golden, 'pose.covariance[7] is 2.0, golden 0.0: differs by 2, allowed 1e-09'),
        (late, PoseStamped(), 'header.stamp.nanosec is 1, golden 0'),
        (String(data='a\n'), String(data='b'), "data is 'a\\n', golden 'b'"),
        (joints, JointState(name=['left'], velocity=[1.0]), 'len(name) is 2, golden 1'),
        (joints, JointState(name=['left', 'r']), "name[1] is 'right', golden 'r'"),
        (Point32(x=0.5), Point32(x=0.25), 'x is 0.5, golden 0.25: differs by 0.25, allowed 1e-09'),
    ):
        assert first(message, other) == words


def test_floats_are_equal_within_the_tolerance():
    for value, golden, same in (
        *((0.0, 9e-10, True), (0.0, 2e-9, False), (1e6, 1e6 + 9e-4, True), (1e6, 1e6 + 2e-3, False)),
        *((0.0, -0.0, True), (math.nan, math.nan, True), (math.nan, 0.0, False), (0.0, math.nan, False)),
        *((math.inf, math.inf, True), (math.inf, -math.inf, False)),
        *((math.inf, 1e300, False), (1e300, math.inf, False)),
    ):
        assert (first(twist(value, 0), twist(golden, 0)) is None) == same, (value, golden)
    for value, same in ((1.0, True), (math.nextafter(1.0, 2.0), False)):
        assert (first(twist(value, 0), twist(1, 0), tolerance=0.0) is None) == same


def test_missing_and_additional_messages_and_times_are_differences():
    one, two, three = ((number * 1_000_000_000, twist(number, 0)) for number in (1, 2, 3))
    assert differences([one, two], [one, two]) is None
    missing = differences([one], [one, two])
    assert (missing.first, missing.time) == ('message 2 of /t, at 2 s, is missing', two[0])
    assert (missing.different, missing.compared) == (1, 2)
    additional = differences([one, two, three], [])
    assert additional.first == 'message 1 of /t, at 1 s, is additional'
    assert (additional.different, additional.compared) == (3, 3)
    late = differences([one, (two[0] + 1, two[1])], [one, two])
    assert late.first == 'message 2 of /t, was published at 2.000000001 s, golden at 2 s'
    # From one that is missing on, each is compared with another.
    assert differences([one, three], [one, two, three]).different == 2


def test_random_identifiers_are_compared_by_what_they_identify():
    a, b, c = (UUID(uuid=[number] * 16) for number in (1, 2, 3))
    comparison = Comparison(0.0)
    same = partial(differences, comparison=comparison)
    assert same([(1, a), (2, b), (3, a)], [(1, b), (2, c), (3, b)]) is None
    # Also on another topic.
    assert same([(1, a)], [(1, b)]) is None
    assert 'identifies something else' in same([(1, a)], [(1, c)]).first
    assert 'identifies something else' in same([(1, c)], [(1, b)]).first


# --- Bags


class Recorded:
    """A recorded run with a bag of two topics."""

    def __init__(self, bag, *speeds, other=0.0, topic='/cmd_vel'):
        sent = [(number / 50, topic, twist(v, 0.0)) for number, v in enumerate(speeds)]
        shutil.rmtree(bag, ignore_errors=True)
        self.bag = write_bag(bag, [*sent, (0.0, '/other', twist(other, 0.0))])

    def finish(self):
        return self.bag


@pytest.fixture
def golden(tmp_path):
    """Return a function that makes the golden run of a recorded one; its bag is at `golden/run`."""

    def golden(*speeds, update=False, **kwargs):
        recorded = Recorded(tmp_path / 'run', *speeds, **kwargs)
        return GoldenRun(recorded, tmp_path / 'golden' / 'run', 'test_a.py::test_b[x]', update)

    return golden


def test_a_run_is_compared_with_the_golden_one_by_tolerance_and_topics(golden):
    written = golden(0.0, 1.0, 2.0, update=True)
    written.check()
    assert written.written
    same = golden(0.0, 1.0, 2.0)
    same.check(tolerance=0.0)
    assert (same.checked, same.written) == (True, False)
    near = golden(0.0, 1.0, 2.0 + 1e-6)
    near.check(tolerance=1e-5)
    with pytest.raises(GoldenRunError) as caught:
        near.check()
    assert str(caught.value).splitlines() == [
        'the run differs from the golden run, first in message 3 of /cmd_vel, at 0.04 s: linear.x is '
        '2.000001, golden 2.0: differs by 1e-06, allowed 1e-09',
        'messages that differ: /cmd_vel 1 of 3',
        f'golden run: {near.path}',
        "to make this run the golden one: pytest --update-golden-runs 'test_a.py::test_b[x]'",
    ]
    # The first in time, not by name.
    other = golden(0.0, 1.0, 3.0, 4.0, other=1.0)
    words = r'first in message 1 of /other, .*\nmessages that differ: /other 1 of 1, /cmd_vel 2 of 4\n'
    with pytest.raises(GoldenRunError, match=words):
        other.check()
    other.check(without=['/other', '/cmd_vel'])
    with pytest.raises(GoldenRunError, match='first in message 1 of /cmd_vel, at 0 s, is missing'):
        golden(0.0, 1.0, 2.0, topic='/z').check()


def test_the_arguments_of_check_are_checked(golden):
    run = golden(0.0)
    for given, words in (
        *(({'tolerance': one}, 'tolerance must be finite and at least 0') for one in (-1.0, math.nan)),
        ({'without': '/odom'}, "without must be names of topics such as '/odom', got"),
        ({'without': ['/a', 'b']}, 'without must be names of topics'),
    ):
        with pytest.raises(ValueError, match=words):
            run.check(**given)


def test_a_golden_run_is_replaced_only_if_the_run_differs(golden):
    path = golden(0.0).path
    golden(0.0, 1.0, update=True).check(without=['/other'])
    with open_bag(path) as reader:
        assert [one.topic for one in reader.connections] == ['/cmd_vel']
    before = contents(path)
    again = golden(0.0, 1.0 + 1e-10, update=True)
    again.check(without=['/other'])
    assert not again.written
    assert contents(path) == before
    different = golden(0.0, 2.0, update=True)
    different.check()
    assert different.written
    golden(0.0, 2.0).check()


def test_an_unreadable_golden_run_is_reported_and_replaced(golden):
    run = golden(0.0, update=True)
    run.check()
    data = data_file(run.path)
    data.write_bytes(data.read_bytes()[:2000])
    words = 'the golden run cannot be compared: .* is damaged: .*\nto replace it: pytest --update'
    with pytest.raises(GoldenRunError, match=words):
        golden(0.0).check()
    golden(0.0, update=True).check()
    golden(0.0).check()
    (run.path / 'notes.txt').touch()
    with pytest.raises(OSError, match='exists already and is not a bag'):
        golden(1.0, update=True).check()


# --- Tests with a golden run


GOAL = """
    from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
    from geometry_msgs.msg import PoseStamped, TransformStamped
    from rclpy.node import Node

    class TestGoal:
        @pytest.mark.parametrize('kind', ['left/up', 'failing'])
        def test_drives(self, lockstep, robot_at, golden_run, kind):
            robot_at(theta=0.5)
            lockstep.add(GoToGoal())
            node = lockstep.add(Node('transforms'))
            tf = node.create_publisher(TransformStamped, '/tf', 100)
            node.create_timer(0.05, lambda: tf.publish(TransformStamped()))
            goal = PoseStamped()
            goal.pose.position.x = 1.0
            lockstep.publish('goal_pose', goal)
            lockstep.run_for(0.2)
            assert kind != 'failing'
"""


def test_the_golden_run_of_a_test(pytester, monkeypatch):
    draw_quickly(monkeypatch)
    result = run_inner(pytester, GOAL, '-k', 'left')
    result.assert_outcomes(failed=1)
    text = result.stdout.str()
    (path,) = re.findall('^there is no golden run (.*)$', text, re.MULTILINE)
    assert path.startswith(f'{pytester.path}/golden/test_0.TestGoal.test_drives-left_up-')
    command = "pytest --update-golden-runs 'test_0.py::TestGoal::test_drives[left/up]'"
    assert f'to make this run the golden one: {command}' in text
    assert '- recorded run -' in text
    assert 'Traceback' not in text
    (pytester.path / 'test_0.py').unlink()
    # Not by a test that fails.
    result = run_inner(pytester, GOAL, '--update-golden-runs')
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(['*golden runs*', f'written: {path}'])
    assert len(list((pytester.path / 'golden').iterdir())) == 1
    # It is a bag like others, without what says nothing about the run.
    with open_bag(pytester.path / path) as reader:
        assert {one.topic for one in reader.connections} == {
            *('/cmd_vel', '/cmd_vel_out', '/goal_pose', '/goal_status', '/joint_states', '/odom'),
            '/start_pose',
        }
    assert len(read_run(path).odometry) == 11
    # Another run has other random identifiers of its goal.
    (pytester.path / 'test_0.py').unlink()
    run_inner(pytester, GOAL, '-k', 'left').assert_outcomes(passed=1)
