"""Relations in explored worlds: shrunk, counted, written, replayed; and what no world has touched."""

from __future__ import annotations

from dataclasses import dataclass

import exploration_scenarios as scenarios
import pytest
from defective_controllers import ARRIVING, RELATIONS, drive
from exploration_scenarios import Follower, Sensor, failing, follow, serial
from hypothesis import strategies as st
from related_nodes import LAWS, cases, driven, schedules
from related_nodes import RELATIONS as OWN
from support import inner_sessions  # noqa: F401  What it imports is not imported again.

from diffdrive_jacobian.bags.bag_reader import open_bag
from diffdrive_jacobian.faults import Hang, Loss, ParameterChange
from diffdrive_jacobian.properties import FieldWithin, NeverFasterThan
from diffdrive_jacobian.relations import Mirrored, Moved, Relation, Repeated, check_relation
from diffdrive_jacobian.testing import ExplorationError, PropertyViolation, fault_schedules, numbers

SPEEDS = {'speed': numbers(0.0, 5.0)}


@dataclass(frozen=True, repr=False)
class Doubled(Relation):
    """Twice the speed gives twice the command."""

    def image(self, topic, message):
        target = message.linear if topic == '/cmd_vel' else message
        target.x *= 2.0
        return message


DOUBLED = Doubled(node='follower')


def explored(relations, **arguments):
    """Explore a few worlds of the follower, whose command grows with the age of the speed."""
    return serial(follow, relations=relations, cases=SPEEDS, worlds=5, **arguments)


def test_a_relation_is_found_shrunk_and_replayed():
    found = explored([DOUBLED, Mirrored(node='follower')])
    (finding,) = found.findings
    assert finding.violation.key == "Doubled(node='follower')"
    assert finding.count == 5
    assert finding.trial.case == {'speed': 0.0}
    assert '/follower on /cmd_vel: linear.x is 0.1, expected 0.2' in finding.violation.text
    assert found.compared > 50
    assert found.simulated > 5 * 3 * 1.2
    assert finding.deterministic
    assert finding.digest
    assert found.replay().same_bits
    assert f'{found.compared} messages compared with images, 1 violated' in str(found)


def test_the_written_test_compares_again(tmp_path, pytester):
    faults = st.just([Loss('speed', start=0.5, duration=0.1)])
    args = ('--ros-args', '-p', 'rate:=1.0')
    (finding,) = explored([DOUBLED], faults=faults, args=args, output=tmp_path / 'found').findings
    source = (finding.directory / 'test_doubled.py').read_text()
    assert "check_relation(follow, Doubled(node='follower'), case=CASE, faults=FAULTS, seed=" in source
    assert f'pause_at={finding.violation.seconds!r}' in source
    with open_bag(finding.directory / 'run') as bag:
        assert '/cmd_vel' in bag.topics
    result = pytester.runpytest_inprocess('-q', '-p', 'no:cacheprovider', str(finding.directory))
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        ['*the same as found, bit for bit, with the same versions and processor*']
    )


@pytest.mark.parametrize(
    ('relations', 'text'),
    [
        (DOUBLED, r'relations must be a list: \[Doubled'),
        ([Repeated], r'relations must be instances of Relation, got .*create one: Repeated'),
        ([DOUBLED, DOUBLED], 'relations: each can be given once'),
        (3, 'relations must be a list, got 3'),
        ([Repeated('nothing')], 'in a world without faults: .*no node has the topic /nothing'),
    ],
)
def test_relations_are_checked(relations, text):
    with pytest.raises(ExplorationError, match=text):
        explored(relations)


def test_a_world_that_fails_is_compared_until_then():
    found = serial(failing, relations=[], cases=st.just(70), worlds=1)
    assert [one.violation.index for one in found.findings] == [-1]
    found = serial(scenarios.divide, relations=[Repeated('speed')], cases=SPEEDS, worlds=4)
    assert {one.violation.index for one in found.findings} <= {-1}


def test_a_node_that_fails_at_once_is_a_finding():
    found = serial(scenarios.refusing, relations=[Repeated('speed')], worlds=1)
    assert [one.violation.message for one in found.findings] == ['ValueError: not today']


def test_what_was_never_compared_is_noted():
    found = serial(scenarios.mute, relations=[Repeated('speed')], worlds=1)
    assert "note: Repeated('speed'): nothing was compared" in str(found)


# --- Defective controllers, and right ones

WORLDS = {
    'wraps angles below -pi only': ({}, 'Moved'),
    'uses old odometry': ({}, 'Repeated'),
    'time in single precision': ({}, 'Shifted'),
    'absolute names': ({}, 'Renamed'),
    'no defect': ({}, None),
}
QUIET = ('--ros-args', '--disable-rosout-logs', '--disable-stdout-logs', '--disable-external-lib-logs')


@pytest.mark.parametrize('name', WORLDS)
def test_each_defect_that_no_property_shows_is_found(name):
    assert {*WORLDS} == {*ARRIVING, 'no defect'}
    case = {
        'controller': name,
        'start': (1.0, 0.5, 0.3),
        'goals': [(0.2, (0.0, 0.0)), (2.0, (-1.0, 0.3))],
        'cancel': None,
        'shutdown': None,
    }
    found = set()
    for relation in RELATIONS:
        try:
            check_relation(drive, relation, case=case, args=QUIET)
        except PropertyViolation as violation:
            found.add(type(violation.property).__name__)
    assert WORLDS[name][1] is None or WORLDS[name][1] in found
    assert bool(found) == (name in ARRIVING)


@pytest.mark.slow
@pytest.mark.parametrize('law', [None, *LAWS])
def test_nothing_is_found_in_our_own_controller(law):
    found = serial(driven, relations=OWN, cases=cases(law), faults=schedules(), worlds=2)
    assert not found.findings, str(found)
    assert found.compared > 500


# --- What no world has touched


def test_what_no_world_has_touched():
    faults = st.sampled_from([[Loss('speed', duration=0.5)], [Hang('follower', duration=0.5)], []])
    found = serial(
        follow,
        [NeverFasterThan(90.0, 90.0)],
        cases=SPEEDS,
        faults=faults,
        worlds=10,
    )
    unseen = found.unseen
    assert unseen.nodes == ('/sensor',)
    assert unseen.topics == ()
    assert unseen.silent == ()
    assert unseen.unchecked == ('/speed',)
    assert 'topics that nothing checked: /speed' in str(found)
    compared = serial(follow, relations=[Repeated('speed')], cases=SPEEDS, worlds=2).unseen
    assert compared.unchecked == ('/speed',)
    # Nothing was affected without faults: that is known.
    assert (compared.nodes, compared.topics) == ((), ())


def with_parameters(world, case):
    """Run two nodes with parameters, one of which differs from world to world."""
    sensor = world.create(lambda: Sensor(1.0))
    sensor.declare_parameter('same', 1.0)
    sensor.declare_parameter('drawn', case)
    world.create(Follower).declare_parameter('changed', 1.0)
    world.find('follower').create_subscription(type(world.last('speed')), 'unheard', lambda _: None, 1)
    world.run_for(0.3)


def test_parameters_with_one_value_are_named():
    change = [ParameterChange('follower', 'changed', 2.0, start=0.1)]
    faults = st.sampled_from([change, []])
    unseen = serial(with_parameters, cases=st.integers(1, 9), faults=faults, worlds=8).unseen
    assert unseen.parameters == (('/sensor', 'same'),)
    assert unseen.silent == ('/unheard',)
    assert unseen.topics == ('/speed', '/unheard')
    one = serial(
        with_parameters, [FieldWithin('speed', 'x', 0.0, 9.0)], cases=st.just(1), worlds=1
    ).unseen
    assert one.parameters == ()
    assert one.unchecked == ('/cmd_vel',)


def test_a_schedule_without_the_topic_is_seen():
    faults = fault_schedules(topics=['speed'], kinds=[Loss], max_faults=1, duration=1.0)
    found = serial(follow, relations=[Moved()], cases=SPEEDS, faults=faults, worlds=10)
    assert found.unseen.nodes == ('/follower', '/sensor')
    assert '  nodes that no fault affected: /follower, /sensor\n' in str(found)
