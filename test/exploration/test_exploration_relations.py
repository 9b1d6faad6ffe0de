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

"""Relations in explored worlds: shrunk, counted, written, replayed; and what no world has touched."""

from __future__ import annotations

from dataclasses import dataclass

import exploration_scenarios as scenarios
import pytest
from exploration_scenarios import Follower, Sensor, follow, serial
from hypothesis import strategies as st
from support import inner_sessions  # noqa: F401  What it imports is not imported again.

from diffdrive_jacobian.bags.bag_reader import open_bag
from diffdrive_jacobian.faults import Hang, Loss, ParameterChange
from diffdrive_jacobian.properties import FieldWithin, NeverFasterThan
from diffdrive_jacobian.relations import Mirrored, Moved, Relation, Repeated
from diffdrive_jacobian.testing import fault_schedules, numbers

pytestmark = pytest.mark.slow
SPEEDS = {'speed': numbers(0.0, 5.0)}


@dataclass(frozen=True, repr=False)
class Doubled(Relation):
    """Twice the speed gives twice the command."""

    def image(self, topic, message):
        target = message.linear if topic == '/cmd_vel' else message
        target.x *= 2.0
        return message


DOUBLED = Doubled(node='follower')


def test_a_relation_is_found_shrunk_and_replayed():
    relations = [DOUBLED, Mirrored(node='follower')]
    found = serial(
        follow,
        relations=relations,
        cases=SPEEDS,
        worlds=5,
    )
    (finding,) = found.findings
    assert finding.violation.key == "Doubled(node='follower')"
    assert finding.count == 5
    assert finding.trial.case == {'speed': 0.0}
    assert '/follower on /cmd_vel: linear.x is 0.1, expected 0.2' in finding.violation.text
    assert found.compared > 50
    assert found.simulated > 5 * 3 * 1.2
    assert finding.deterministic
    assert found.replay().same_bits
    assert f'{found.compared} messages compared with images, 1 violated' in str(found)


def test_the_written_test_compares_again(tmp_path, pytester):
    (finding,) = serial(
        follow,
        relations=[DOUBLED],
        cases=st.just({'speed': 0.0}),
        faults=st.just([Loss('speed', start=0.5, duration=0.1)]),
        args=('--ros-args', '-p', 'rate:=1.0'),
        worlds=1,
        output=tmp_path / 'found',
    ).findings
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


def test_a_world_that_fails_is_compared_until_then():
    relations = [Repeated('speed')]
    found = serial(scenarios.divide, relations=relations, cases=SPEEDS, worlds=4)
    assert {one.violation.index for one in found.findings} == {-1}
    # Also before there is a node.
    found = serial(scenarios.failing, relations=relations, cases=st.just(70), worlds=1)
    assert [one.violation.index for one in found.findings] == [-1]


def test_a_relation_is_compared_without_the_faults_that_disturb_it():
    lost = st.just([Loss('speed', start=0.2, duration=0.5)])
    found = serial(
        follow,
        relations=[Repeated('speed')],
        faults=lost,
        worlds=1,
    )
    assert found.findings == ()
    # The world, the same without faults, and the image of that.
    assert found.simulated == pytest.approx(3 * 1.2)


def test_what_was_never_compared_is_noted():
    found = serial(scenarios.mute, relations=[Repeated('speed')], worlds=1)
    assert "note: Repeated('speed'): nothing was compared" in str(found)


# --- What no world has touched


def test_nodes_without_faults_and_unchecked_topics_are_named():
    faults = st.sampled_from(
        [
            [Loss('speed', duration=0.5)],
            [Hang('follower', duration=0.5)],
            [],
        ]
    )
    required = [NeverFasterThan(90.0, 90.0)]
    found = serial(
        follow,
        required,
        cases=SPEEDS,
        faults=faults,
        worlds=10,
    )
    unseen = found.unseen
    assert (unseen.nodes, unseen.topics, unseen.silent) == (('/sensor',), (), ())
    assert unseen.unchecked == ('/speed',)
    assert 'topics that nothing checked: /speed' in str(found)
    compared = serial(follow, relations=[Repeated('speed')], cases=SPEEDS, worlds=2).unseen
    assert compared.unchecked == ('/speed',)
    # Nothing was affected without faults: that is known.
    assert (compared.nodes, compared.topics) == ((), ())
    lost = fault_schedules(topics=['speed'], kinds=[Loss], max_faults=1, duration=1.0)
    found = serial(follow, relations=[Moved()], cases=SPEEDS, faults=lost, worlds=2)
    assert '  nodes that no fault affected: /follower, /sensor\n' in str(found)


def with_parameters(world, case):
    """Run two nodes with parameters, one of which differs from world to world."""
    sensor = world.create(lambda: Sensor(1.0))
    sensor.declare_parameter('same', 1.0)
    sensor.declare_parameter('drawn', case)
    world.create(Follower).declare_parameter('changed', 1.0)
    world.find('follower').create_subscription(type(world.last('speed')), 'unheard', lambda _: None, 1)
    world.run_for(0.3)


def test_constant_parameters_and_silent_topics_are_named():
    change = [ParameterChange('follower', 'changed', 2.0, start=0.1)]
    faults = st.sampled_from([change, []])
    unseen = serial(with_parameters, cases=st.integers(1, 9), faults=faults, worlds=8).unseen
    assert unseen.parameters == (('/sensor', 'same'),)
    assert unseen.silent == ('/unheard',)
    assert unseen.topics == ('/speed', '/unheard')
    required = [FieldWithin('speed', 'x', 0.0, 9.0)]
    # After one world all parameters have one value.
    one = serial(with_parameters, required, cases=st.just(1), worlds=1).unseen
    assert (one.parameters, one.unchecked) == ((), ('/cmd_vel',))
