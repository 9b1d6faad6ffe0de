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

"""Comparing worlds with their images: what is found, what is not, and why."""

from __future__ import annotations

import math
import pickle
from bdb import BdbQuit
from dataclasses import dataclass
from typing import Any

import pytest
from geometry_msgs.msg import Quaternion, Vector3, Vector3Stamped
from rclpy.node import Node
from relation_nodes import (
    Answer,
    Echo,
    Source,
    age,
    crashing,
    from_the_clock,
    impatient,
    previous,
    scene,
    seconds,
    side,
    total,
)
from std_msgs.msg import Float64MultiArray, Int32, String, UInt8
from std_srvs.srv import Trigger

from diffdrive_jacobian import relations
from diffdrive_jacobian.faults import Kill, Loss, Slow, TimeJump
from diffdrive_jacobian.lockstep._border import Border
from diffdrive_jacobian.relations import (
    Late,
    Mirrored,
    Moved,
    Relation,
    Renamed,
    Repeated,
    Shifted,
    check_relation,
)
from diffdrive_jacobian.relations.checking import (
    UNTIL_OTHERS,
    UNTIL_OVERTAKEN,
    UNTIL_ROUNDING,
    checked,
)
from diffdrive_jacobian.relations.worlds import Scene, decoded
from diffdrive_jacobian.testing import LockstepError, PropertyViolation

pytestmark = pytest.mark.slow
QUIET = ('--ros-args', '--disable-rosout-logs', '--disable-stdout-logs', '--disable-external-lib-logs')


@dataclass(frozen=True, repr=False)
class Negated(Relation):
    """Negative numbers give negative answers."""

    def image(self, topic, message):
        vector = message.vector if topic.endswith('number') else message
        vector.x = -vector.x
        return message


NEGATED = Negated(node='answer')


def result(relation, scenario, **arguments):
    """Return how an image compares."""
    played = Scene(scenario=scenario, case=None, args=QUIET, topics=relation.topics, **arguments)
    return checked(relation, played.run('the first world'), played)


# --- What is found


@pytest.mark.parametrize(
    ('answer', 'relation', 'text'),
    [
        (lambda _, message: abs(message.vector.x), NEGATED, '/answer on /answer: x is 1, expected -1'),
        (total, Repeated('number'), '/answer on /answer: Vector3(x=2) is said, expected nothing'),
        (
            lambda node, message: message.vector.x if message.vector.x not in node.seen else None,
            Repeated('number', after=0.15),
            None,
        ),
        (lambda *_: 0.0, Repeated('number', after=0.15), 'Vector3() is said, expected nothing'),
        (impatient, Late('number'), 'Vector3(x=1) in the first world, and nothing in the image'),
        (age, Late('number', 0.05), 'x is 0 in the first world, from 0.05 to 0.05 in the image'),
        (from_the_clock, Shifted(), '/answer on /answer: x is 1001, expected 1'),
        (crashing, Negated(node='answer', tolerance=1e9), 'it raised ZeroDivisionError: float division'),
        (previous, NEGATED, None),
        (previous, Repeated('number'), 'Vector3(x=1) is said, expected nothing'),
        (total, NEGATED, None),
        (total, Late('number'), None),
        (age, Shifted(), None),
        (age, Renamed(), None),
        (None, Repeated('number'), None),
    ],
)
def test_a_relation_finds_its_defect(answer, relation, text):
    values = (lambda count: 8.0 if count > 3 else 1.0) if answer is crashing else math.cos
    difference = result(relation, scene(answer, values)).difference
    assert (difference is None) == (text is None), difference
    assert difference is None or text in difference.text


def test_names_that_are_in_no_namespace_are_found():
    relation = Renamed('/robots/r1')
    text = result(relation, scene(topic='/answer')).difference.text
    assert text.startswith('/robots/r1/answer on /answer: Vector3(x=1) is said, expected nothing')
    inside = (*QUIET, '--ros-args', '-r', '__ns:=/r')
    check_relation(scene(age), relation, args=inside)
    # Names may be remapped.
    remapped = (*QUIET, '--ros-args', '-r', 'number:=figure')
    check_relation(scene(), Repeated('number'), args=remapped)
    check_relation(scene(), Late('number'), args=remapped)


def test_texts_may_have_the_namespace_or_not():
    def scenario(world, case):
        publisher = world.create(Source).create_publisher(String, 'frame', 10)
        name = world.find('source').get_namespace().lstrip('/')
        for text in ('odom', f'{name}/odom' if name else 'odom'):
            publisher.publish(String(data=text))
        world.run_for(0.1)

    check_relation(scenario, Renamed('r1'))


def test_a_violation_has_the_same_hash_with_and_without_a_pause(monkeypatch):
    """So a written test says whether it is as found, with a pause, too."""
    monkeypatch.setattr('sys.breakpointhook', lambda **_: None)
    digests = []
    for pause_at in (None, 0.2):
        with pytest.raises(PropertyViolation) as raised:
            check_relation(scene(total), Repeated('number'), args=QUIET, pause_at=pause_at)
        digests.append(raised.value.digest)
    assert digests[0] == digests[1] != ''
    violation = raised.value
    assert str(violation).startswith("Repeated('number') is violated at 0 s: /answer on /answer: ")
    assert (violation.property, violation.seconds) == (Repeated('number'), 0.0)
    assert pickle.loads(pickle.dumps(violation)).text == violation.text


def test_numbers_between_others_are_late_as_they_may_be():
    """Also in arrays, as integers, and as the components of a quaternion. A single byte may not."""

    def turning(world, case):
        world.create(Source)
        other = world.create(lambda: Node('turning', start_parameter_services=False))
        heard, publishers = [], {}
        other.create_subscription(Vector3Stamped, 'number', heard.append, 10)

        def say(topic, message):
            if topic not in publishers:
                publishers[topic] = other.create_publisher(type(message), topic, 10)
            publishers[topic].publish(message)

        def tick():
            half = 0.05 * (seconds(heard[-1]) if heard else 1.0)
            say('turn', Quaternion(z=math.sin(half), w=math.cos(half)))
            say('array', Float64MultiArray(data=[half, -half]))
            say('count', Int32(data=int(100 * half)))
            say('byte', UInt8(data=case(half)))

        other.create_timer(0.15, tick)
        world.run_for(2.0)

    late = Late('number', 0.06, period=0.2)
    check_relation(turning, late, case=lambda half: 7, args=QUIET)
    with pytest.raises(PropertyViolation, match='/turning on /byte: data is'):
        check_relation(turning, late, case=lambda half: int(1000 * half), args=QUIET)


def test_what_is_said_in_turns_counts_once():
    def both(node, message):
        node.publisher.publish(Vector3(x=1.0, y=message.vector.x))
        return 2.0

    assert result(Repeated('number'), scene(both)).difference is None


def test_a_topic_is_that_of_its_full_name():
    """Not one that ends likewise, which the node hears, too."""

    def two(world, case):
        node = world.create(lambda: Answer(total))
        node.create_subscription(Vector3Stamped, 'wheel/number', node.on_number, 10)
        world.create(Source)
        wheel = world.node.create_publisher(Vector3Stamped, 'wheel/number', 10)
        for _ in range(3):
            world.run_for(0.1)
            message = Vector3Stamped()
            message.vector.x = 5.0
            wheel.publish(message)
            world.settle()

    assert '/answer' in result(Repeated('number'), two).difference.text
    wheel = result(Repeated('wheel/number'), two).difference
    assert wheel.time == 100_000_000


# --- What is not


def test_only_the_nodes_under_test_run_again():
    """The others hear what was said in the first world, in the same order, whatever is said now."""
    scenario = scene(lambda *_: 0.5)
    first = Scene(scenario=scenario, case=None, args=QUIET).run('the first world')

    def silent(world, case):
        world.create(lambda: Answer(lambda *_: None))
        world.create(Echo)
        world.create(Source)
        world.run_for(1.0)

    again = Scene(scenario=silent, case=None, args=QUIET).run(
        'the image',
        lambda world: Border(world, first.messages, {'/answer'}, lambda _, data: [(0, data)]),
    )

    def of_others(ran):
        return [
            (one.time, one.speaker, decoded(one))
            for one in ran.messages
            if one.speaker.node != '/answer'
        ]

    assert of_others(again) == of_others(first)
    assert {one.speaker.node for one in again.messages} == {'/source', '/echo'}
    assert sum(one.speaker.node == '/echo' for one in first.messages) == 11


def test_what_rounding_decides_is_no_difference():
    """At zero, and from there on. `check_relation` warns of what it did not compare."""
    sides = scene(side, lambda count: 1.0 if count < 4 else 0.0)
    found = result(NEGATED, sides)
    assert (found.difference, found.note) == (None, UNTIL_ROUNDING)
    assert found.compared > 0
    with pytest.warns(UserWarning, match='compared until 0.4 s of 1 s: what came after an event that'):
        check_relation(sides, NEGATED, args=QUIET)
    clamped = scene(lambda _, message: max(-0.5, message.vector.x), lambda count: math.cos(count))
    assert result(NEGATED, clamped).difference.time == 0


def test_rounding_of_times_may_move_an_event_by_a_period():
    """0.3 s after a message, which is more or less than 0.3 in floats."""

    def late(node, message):
        node.first = getattr(node, 'first', from_the_clock(node, message))
        return float(from_the_clock(node, message) - node.first > 0.3)

    found = [result(Shifted(seconds), scene(late)) for seconds in (1.0, 7.0, 1000.0)]
    assert [one.difference for one in found] == [None] * 3
    assert {one.note for one in found} == {'', UNTIL_ROUNDING}


def test_faults_that_disturb_a_relation_are_left_out():
    lost = [Loss('number', start=0.2, duration=0.3)]
    slow = [*lost, Slow('answer', 0.15)]
    assert result(NEGATED, scene(total), faults=slow).difference is None
    check_relation(scene(total), Late('number'), faults=slow, args=QUIET)
    back = [TimeJump(-5.0, start=0.5)]
    check_relation(scene(age), Shifted(), faults=back, args=QUIET)
    # Random numbers are the same in each namespace.
    check_relation(scene(total), Renamed(), faults=[Loss('number', probability=0.5)], args=QUIET)


def test_a_node_is_under_test_again_after_it_was_killed():
    killed = [Kill('answer', start=0.35, duration=0.3)]
    check_relation(scene(total), NEGATED, faults=killed, args=QUIET)
    broken = scene(lambda node, message: total(node, message) ** (2 if len(node.seen) == 2 else 1))
    assert result(NEGATED, broken, faults=killed).difference.time == 200_000_000


def test_requests_that_overtake_what_is_late_end_the_comparison():
    def asking(world, case):
        scene(total, end=0.5)(world, case)
        world.call(Trigger, 'forget')
        world.run_for(0.5)

    def leaving(world, case):
        scene(total, end=0.5)(world, case)
        world.find('answer').destroy_node()
        world.run_for(0.5)

    for scenario in (asking, leaving):
        found = result(Late('number', 0.05), scenario)
        assert (found.difference, found.note) == (None, UNTIL_OVERTAKEN)
        assert found.compared == 4
    assert result(NEGATED, asking).note == ''


def test_a_scenario_that_looks_into_the_node_ends_the_comparison():
    def looking(world, case):
        scene(total, end=0.5)(world, case)
        publisher = world.node.create_publisher(Vector3, 'sum', 10)
        publisher.publish(Vector3(x=sum(world.find('answer').seen)))
        world.run_for(0.5)

    found = result(NEGATED, looking)
    assert (found.difference, found.note, found.end) == (None, UNTIL_OTHERS, 500_000_000)


def test_infinite_numbers_stay_where_rounding_is_looked_at():
    def counting(node, message):
        return -1.0 if math.isnan(message.vector.x) else len(node.seen)

    found = result(Repeated('number'), scene(counting, lambda _: math.inf))
    assert found.difference is not None


@pytest.mark.parametrize('period', [0.3, 1 / 30])
def test_a_shift_is_a_multiple_of_the_periods_of_all_timers(period):
    """So a defect at later times is found with each of them."""

    def late_only(node, message):
        return float(len(node.seen) > 3 and from_the_clock(node, message) > 500.0)

    def scenario(world, case):
        world.create(lambda: Answer(late_only))
        world.create(lambda: Source(period=period))
        world.run_for(8 * period)

    found = result(Shifted(), scenario)
    assert found.difference is not None, found
    assert found.difference.text.startswith('/answer on /answer: x is 1, expected 0')


# --- Misuse


@dataclass(frozen=True, repr=False)
class Wrong(Negated):
    """Has no right image, or is heard in no right way."""

    images: type | None = None
    hears: Any = None

    def image(self, topic, message):
        return super().image(topic, message) if self.images is None else self.images()

    def heard(self, topic, message):
        return super().heard(topic, message) if self.hears is None else self.hears


@pytest.mark.parametrize(
    ('relation', 'text'),
    [
        (Repeated('nothing'), 'no node has the topic /nothing; nodes: /answer, /echo, /source'),
        (Moved(), r'Moved\(\): no node has the topic /cmd_vel; nodes:'),
        (Repeated('number', node='nobody'), 'there is no node /nobody; nodes: /answer'),
        (Negated(), 'needs the node under test: Negated'),
        (Repeated('number', node='source'), 'no message that the nodes under test hear is changed'),
        (Wrong(dict, node='answer'), 'must be a Vector3Stamped, got'),
        (Wrong(Relation, node='answer'), 'image of a message of /number: it raised TypeError'),
        (Late, r'check_relation takes a relation, got .*create one: Late\(\)'),
        (Late('number', 0.1), 'seconds must be less than the period of /number, which is 0.1 s'),
        (Wrong(hears=Vector3Stamped(), node='answer'), 'heard must return a list of pairs'),
        (Wrong(hears=[(-1.0, Vector3Stamped())], node='answer'), 'heard must return a list of pairs'),
        (Wrong(hears=[(0.0, Vector3())], node='answer'), 'must be a Vector3Stamped, got'),
    ],
)
def test_misuse_is_an_error(relation, text):
    with pytest.raises(LockstepError, match=text):
        check_relation(scene(), relation, args=QUIET)


def failing(world, case):
    scene()(world, case)
    raise KeyError(case)


def apart(world, case):
    world.create(Source)
    world.create(lambda: Node('own', namespace='a', start_parameter_services=False))
    world.run_for(0.2)


@pytest.mark.parametrize(
    ('scenario', 'relation', 'arguments', 'error', 'text'),
    [
        (3, NEGATED, {}, LockstepError, 'scenario must be a function'),
        (scene(), NEGATED, {'faults': Loss('number')}, LockstepError, 'faults must be a list'),
        (scene(), NEGATED, {'faults': [Loss('numer')]}, LockstepError, 'no subscription of /numer was'),
        (scene(lambda *_: None), NEGATED, {}, LockstepError, 'the nodes under test said nothing'),
        (apart, Renamed(), {}, LockstepError, 'the namespace of the world, /; node /a/own is in'),
        # Of the first world.
        (failing, NEGATED, {'case': 7}, KeyError, '7'),
    ],
)
def test_what_cannot_be_compared_is_an_error(scenario, relation, arguments, error, text):
    with pytest.raises(error, match=text):
        check_relation(scenario, relation, args=QUIET, **arguments)


def test_invalid_fields_are_refused():
    for make, value, words in (
        (Renamed, '/', 'namespace must be'),
        (Renamed, 'no spaces', "namespace must be a namespace such as '/robot1', got 'no spaces'"),
        (Shifted, 1e12, 'seconds must be in'),
        (lambda value: Moved(fixed=value), 'map', 'fixed must be'),
    ):
        with pytest.raises(ValueError, match=f'^[A-Z][a-z]*: {words}'):
            make(value)


def test_who_quits_the_debugger_ends_all():
    """In the first world, and in the image."""
    for number in (1, 2):
        worlds = []

        def quitting(world, case, worlds=worlds):
            scene()(world, case)
            worlds.append(world)
            if len(worlds) == case:
                raise BdbQuit

        with pytest.raises(BdbQuit):
            check_relation(quitting, NEGATED, case=number, args=QUIET)
        assert len(worlds) == number


# --- Values

VALUES = [
    (Moved(), 'Moved()'),
    (Moved(1.0, theta=0.5), 'Moved(x=1.0, theta=0.5)'),
    (Mirrored(commands='cmd'), "Mirrored(commands='cmd')"),
    (Shifted(10.0), 'Shifted(seconds=10.0)'),
    (Repeated('odom', after=0.1), "Repeated('odom', after=0.1)"),
    (Late('odom', 0.02, node='a'), "Late('odom', seconds=0.02, node='a')"),
    (Renamed('r1'), "Renamed(namespace='/r1')"),
]


def test_relations_are_values():
    kinds = {getattr(relations, name) for name in relations.__all__}
    assert {type(one) for one, _ in VALUES} == kinds - {Relation, check_relation}
    for one, expression in VALUES:
        assert repr(one) == expression
        assert eval(expression, vars(relations)) == one == pickle.loads(pickle.dumps(one))
