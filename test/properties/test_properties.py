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

"""Requiring properties of a run, and properties as values."""

from __future__ import annotations

import pickle
import re

import pytest
from documentation.pages import PAGES, blocks
from nav_msgs.msg import Odometry
from property_nodes import Scene, odometry_at, twist

from diffdrive_jacobian import properties
from diffdrive_jacobian.properties import (
    AccelerationWithin,
    ArrivesOnceFaultsEnd,
    FieldWithin,
    KeepsDriving,
    NeverFasterThan,
    NoCommandAfterCancel,
    NoStaleGoals,
    PoseFinite,
    ReachesGoal,
    Settles,
    StatusProtocol,
    StaysNear,
    StaysOnPath,
    StaysWithin,
    StopsAfterLastCommand,
    StopsAfterLostOdometry,
    StopsOnShutdown,
)
from diffdrive_jacobian.testing import LockstepError, PropertyViolation

SLOW, FAST = NeverFasterThan(0.5, 2.0), NeverFasterThan(1.0, 2.0)


@pytest.fixture
def send(lockstep):
    return Scene(lockstep).send


# --- Requiring


def test_a_violation_names_property_time_value_and_limit(lockstep, send):
    lockstep.require(SLOW)
    send(twist(0.25))
    lockstep.run_for(1.0)
    send(twist(0.75, -1.0))
    with pytest.raises(PropertyViolation) as raised:
        lockstep.run_for(1.0)
    violation = raised.value
    assert str(violation).startswith(
        'NeverFasterThan(0.5, 2.0) is violated at 1 s: /cmd_vel: v 0.75 m/s, omega -1 rad/s; '
        'allowed: |v| <= 0.5 m/s, |omega| <= 2 rad/s\nbefore that:\n'
        '  0 s: /cmd_vel: v 0.25 m/s, omega 0 rad/s'
    )
    assert 'last messages, at 2 s of the clock, 1 s after the start:' in str(violation)
    assert (violation.property, violation.seconds) == (SLOW, 1.0)
    assert isinstance(violation, LockstepError)
    again = pickle.loads(pickle.dumps(violation))
    assert (str(again), again.property) == (str(violation), violation.property)


def test_a_violation_is_raised_once_and_the_other_properties_stay(lockstep, send):
    lockstep.require(SLOW, FAST)
    send(twist(0.75))
    with pytest.raises(PropertyViolation, match=r'^NeverFasterThan\(0.5, 2.0\)'):
        lockstep.settle()
    lockstep.run_for(1.0)
    send(twist(1.75))
    with pytest.raises(PropertyViolation, match=r'^NeverFasterThan\(1.0, 2.0\)'):
        lockstep.run_for(1.0)
    lockstep.finish()


def test_a_violation_is_seen_in_every_way_of_advancing_time(lockstep, send):
    lockstep.node.create_timer(0.1, lambda: send(twist(1.0)))
    for advance in (
        lockstep.step,
        lambda: lockstep.run_until(lambda: False, 1.0),
        lambda: lockstep.run_for(0.1),
        lambda: lockstep.jump(5.0),
        lambda: lockstep.jump(-2.0) or lockstep.step(),
    ):
        lockstep.require(SLOW)
        with pytest.raises(PropertyViolation):
            advance()


def test_what_is_no_property_cannot_be_required(lockstep):
    for argument, words in (
        (NeverFasterThan, r'got the class NeverFasterThan; create one: NeverFasterThan\(...\)'),
        (0.5, 'require takes properties, got an object of the class float'),
    ):
        with pytest.raises(LockstepError, match=words):
            lockstep.require(argument)


def test_a_topic_without_publisher_is_an_error_at_the_end(lockstep, send):
    lockstep.require(NeverFasterThan(0.5, 2.0, topic='cmd_vell'))
    send(twist(0.1))
    lockstep.run_for(0.1)
    words = r"topic='cmd_vell'\) observes /cmd_vell, which no .* topics and services: /cmd_vel$"
    with pytest.raises(LockstepError, match=words) as raised:
        lockstep.finish()
    assert not isinstance(raised.value, PropertyViolation)


def test_a_topic_of_another_type_is_an_error(lockstep, robot_at):
    lockstep.require(NeverFasterThan(0.5, 2.0, topic='joint_states'))
    with pytest.raises(LockstepError, match=r'geometry_msgs/msg/Twist, .* sensor_msgs/msg/JointState'):
        robot_at()


def test_nothing_that_a_node_can_notice_is_changed(lockstep):
    def graph():
        count = lockstep.node.count_subscribers
        return [count(topic) for topic in ('cmd_vel', 'odom', 'goal_pose', 'goal_status')]

    before = graph()
    lockstep.require(*(one for one, _ in VALUES))
    assert graph() == before
    with pytest.raises(LockstepError, match='which no node has a publisher'):
        lockstep.finish()


def test_the_speed_of_odometry_in_a_namespace(lockstep, robot_at):
    lockstep.require(NeverFasterThan(0.25, 1.0, topic='odom', namespace='/one'))
    robot_at(namespace='/one')
    lockstep.publish('/one/cmd_vel', twist(0.25))
    lockstep.run_for(0.1)
    lockstep.publish('/one/cmd_vel', twist(0.3))
    with pytest.raises(PropertyViolation) as raised:
        lockstep.run_for(1.0)
    assert raised.value.text.startswith('/one/odom: v 0.3 m/s')


def test_a_long_property_does_not_hide_what_is_wrong(lockstep, send):
    """Its message is short. Its `repr` is complete."""
    near = StaysNear([(0.1 * number, 0.0) for number in range(61)], 0.1, odom='pose')
    assert eval(repr(near)) == near
    shown = "StaysNear(((0.0, 0.0), (0.1, 0.0), ... 61 in all), 0.1, odom='pose')"
    assert str(near) == shown
    lockstep.require(near)
    with pytest.raises(LockstepError, match=re.escape(f'{shown} observes /pose, which no node')):
        lockstep.finish()
    lockstep.require(near)
    send(odometry_at(0.0, 1.0), 'pose')
    with pytest.raises(PropertyViolation) as caught:
        lockstep.settle()
    assert str(caught.value).startswith(f'{shown} is violated at 0 s: /pose: ')


def test_bytes_that_are_no_message_violate_a_property_of_the_robot(lockstep):
    publisher = lockstep.node.create_publisher(Odometry, 'odom', 10)
    for required in (PoseFinite(), NeverFasterThan(1.0, 1.0, topic='odom')):
        lockstep.require(required)
        publisher.publish(b'\0')
        with pytest.raises(PropertyViolation, match='/odom: bytes that are no Odometry'):
            lockstep.settle()


# --- As values

VALUES = [
    (NeverFasterThan(0.5, 2.0), 'NeverFasterThan(0.5, 2.0)'),
    (
        NeverFasterThan(0.5, float('inf'), topic='odom', namespace='/one'),
        "NeverFasterThan(0.5, float('inf'), namespace='/one', topic='odom')",
    ),
    (AccelerationWithin(1, 2, slack=0.2), 'AccelerationWithin(1.0, 2.0, slack=0.2)'),
    (StatusProtocol(goals=['goal_pose']), "StatusProtocol(goals=('goal_pose',))"),
    (StopsAfterLostOdometry(0.5, node='a'), "StopsAfterLostOdometry(0.5, node='a')"),
    (StopsAfterLastCommand(0.5), 'StopsAfterLastCommand(0.5)'),
    (StopsOnShutdown(), 'StopsOnShutdown()'),
    (NoCommandAfterCancel(), 'NoCommandAfterCancel()'),
    (NoStaleGoals(), 'NoStaleGoals()'),
    (ReachesGoal(5, tolerance=0.1), 'ReachesGoal(5.0, tolerance=0.1)'),
    (Settles(5, 0.1), 'Settles(5.0, 0.1)'),
    (ArrivesOnceFaultsEnd(5), 'ArrivesOnceFaultsEnd(5.0)'),
    (KeepsDriving(1), 'KeepsDriving(1.0)'),
    (StaysWithin([0, 1], y=(-1, 1)), 'StaysWithin((0.0, 1.0), (-1.0, 1.0))'),
    (StaysNear([[0, 0], [1, 0]], 0.1), 'StaysNear(((0.0, 0.0), (1.0, 0.0)), 0.1)'),
    (PoseFinite(), 'PoseFinite()'),
    (StaysOnPath(0.1), 'StaysOnPath(0.1)'),
    (FieldWithin('x', 'a.b', 0, float('inf')), "FieldWithin('x', 'a.b', 0, float('inf'))"),
]


def test_properties_are_values_whose_expressions_make_them_again():
    public = {name: getattr(properties, name) for name in properties.__all__}
    for one, expression in VALUES:
        assert repr(one) == expression
        assert eval(expression, public) == one == pickle.loads(pickle.dumps(one))
    kinds = {
        one for one in public.values() if isinstance(one, type) and issubclass(one, properties.Property)
    }
    assert {type(one) for one, _ in VALUES} == kinds - {properties.Property}


NAN, INF = float('nan'), float('inf')


@pytest.mark.parametrize(
    ('kind', 'arguments', 'words'),
    [
        (NeverFasterThan, {'v': -1.0, 'omega': 2.0}, 'v must be zero or positive, got -1.0'),
        (NeverFasterThan, {'v': '1', 'omega': 2.0}, 'v must be a number'),
        (NeverFasterThan, {'v': 1.0, 'omega': 2.0, 'topic': ''}, 'topic must be a string that is not'),
        (StatusProtocol, {'goals': 'goal_pose'}, 'goals must be a list or tuple of names'),
        (StatusProtocol, {'namespace': 1}, 'namespace must be a string'),
        (StaysWithin, {'x': (1, 0), 'y': (0, 1)}, r'x must be the least and the .*, got \(1, 0\)'),
        (StaysWithin, {'x': (0, 1), 'y': 1.0}, 'y must be the least and the largest value, got 1.0'),
        (StaysNear, {'path': [1, 2], 'distance': 0.1}, r'path must be a sequence of \(x, y\)'),
        (Settles, {'within': 1.0, 'tolerance': 0.0}, 'tolerance must be positive'),
        (ReachesGoal, {'within': INF}, 'within must be zero or positive and finite'),
        (FieldWithin, {'topic': 'a', 'field': 'x', 'low': 1, 'high': 0}, 'low must be at most high'),
        (FieldWithin, {'topic': 'a', 'field': 'x', 'low': NAN, 'high': 0}, 'low must be a number'),
        (FieldWithin, {'topic': 'a', 'field': 'x', 'low': 'a', 'high': 0}, 'low must be a number'),
    ],
)
def test_invalid_fields_are_refused(kind, arguments, words):
    with pytest.raises(ValueError, match=f'^{kind.__name__}: {words}'):
        kind(**arguments)


# --- The page


def test_the_page_lists_every_property_and_has_one_of_ones_own(lockstep, robot_at):
    page = PAGES['doc/lockstep.md'].read_text()
    base = {'Property', 'PropertyViolation', 'end_of_faults'}
    assert [one for one in properties.__all__ if one not in base and f'`{one}(' not in page] == []
    (code,) = (block.code for block in blocks(page) if block.file == 'test_own_property.py')
    names = {}
    exec(code, names)
    names['test_a_robot_publishes_odometry'](lockstep, robot_at)
