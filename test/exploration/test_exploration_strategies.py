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

"""What strategies of the exploration generate, and what it shrinks to. Without ROS running."""

from __future__ import annotations

import importlib
import math
import sys
from dataclasses import dataclass
from enum import Enum

import pytest
from exploration_scenarios import follow
from hypothesis import find, given, settings
from hypothesis import strategies as st

from diffdrive_jacobian import faults
from diffdrive_jacobian.exploration.result import differences, versions
from diffdrive_jacobian.exploration.scenario import ScenarioName, Source
from diffdrive_jacobian.exploration.schedules import generate, shrink, trials
from diffdrive_jacobian.exploration.trial import Trial
from diffdrive_jacobian.testing import (
    ExplorationError,
    angles,
    fault_schedules,
    gains,
    goals,
    numbers,
    poses,
    probabilities,
    scenario_from,
    times,
    waypoints,
)

pytestmark = pytest.mark.slow
FEW = settings(max_examples=25, database=None, derandomize=True, deadline=None)
SHRINK = settings(max_examples=60, database=None, derandomize=True)
FIELDS = {'odom': ['pose.pose.position.x', 'header.stamp', 'header.frame_id']}


def on_grid(value, step=0.1):
    return value == round(round(value / step) * step, 10)


# --- Values


@FEW
@given(numbers(-2.0, 5.0), times(7.3), poses(3.0), goals(), waypoints(), gains(), probabilities())
def test_values_are_on_their_grids(number, time, pose, goal, route, gain, probability):
    assert -2.0 <= number <= 5.0
    assert 0.0 <= time <= 7.3
    assert all(map(on_grid, (number, time, *pose[:2], *goal[:2])))
    assert max(map(abs, pose[:2])) <= 3.0
    assert -math.pi <= pose[2] <= math.pi
    assert 1 <= len(route) <= 5
    assert 0.2 <= gain <= 5.0
    assert 0.0 < probability <= 1.0
    assert on_grid(probability, 0.05)


@pytest.mark.parametrize(
    ('strategy', 'condition', 'smallest'),
    [
        (numbers(-5.0, 5.0), lambda x: x < -2.6, -3.0),
        (numbers(0.0, 10.0), lambda x: 2.3 <= x <= 2.7, 2.5),
        (numbers(2.0, 8.0), lambda x: True, 2.0),
        (numbers(0.25, 0.75, decimals=2), lambda x: True, 0.25),
        (times(10.0), lambda t: t > 3.1, 4.0),
        (angles(), lambda a: a > 3.12, math.pi),
        (gains(), lambda k: True, 1.0),
        (gains(), lambda k: k > 2.2, 5.0),
        (probabilities(), lambda p: p < 0.5, 0.05),
        (goals(), lambda goal: True, (1.0, 0.0, 0.0)),
    ],
)
def test_values_shrink_to_round_ones(strategy, condition, smallest):
    assert find(strategy, condition, settings=SHRINK) == smallest


@pytest.mark.parametrize(
    ('make', 'words'),
    [
        (lambda: numbers(1.0, 0.0), 'low <= high'),
        (lambda: numbers(0.0, math.nan), 'finite'),
        (lambda: numbers(0.01, 0.02), 'no number with 1 decimals'),
        (lambda: numbers(0.0, 1.0, decimals=7), 'decimals'),
        (lambda: gains(0.0, 1.0), 'positive'),
        (lambda: gains(0.011, 0.012), 'no gain'),
        (lambda: fault_schedules(), 'needs topics, nodes'),
        (lambda: fault_schedules(fields={'odom': 'x'}), 'odom must be a list or tuple of names'),
        (lambda: fault_schedules(fields=['odom']), r"fields must be a dict .* got \['odom'\]"),
        (lambda: fault_schedules('odom'), 'topics must be a list or tuple of names, got .odom'),
        (lambda: fault_schedules(['odom'], max_faults=0), 'max_faults'),
        (lambda: fault_schedules(['odom'], duration=math.inf), 'duration'),
        (lambda: fault_schedules(kinds=[faults.Loss]), 'Loss needs topics'),
        (lambda: fault_schedules(kinds=[int]), 'kinds must be among Loss, .* got int'),
    ],
)
def test_mistakes_are_named(make, words):
    with pytest.raises(ValueError, match=words):
        make()


# --- Schedules of faults


def lost(schedule, seconds, at):
    return any(
        isinstance(one, faults.Loss) and one.duration >= seconds and one.start <= at < one.end
        for one in schedule
    )


def test_a_schedule_shrinks_to_one_round_fault():
    strategy = fault_schedules(['cmd_vel', 'odom'], ['robot'], duration=8.0)
    assert find(strategy, lambda s: lost(s, 0.55, 4.2), settings=SHRINK) in (
        [faults.Loss('cmd_vel', start=4.0, duration=1.0)],
        [faults.Loss('cmd_vel', duration=5.0)],
    )


@FEW
@given(
    fault_schedules(['odom'], ['robot'], services=['reset'], max_faults=4, duration=3.0),
    fault_schedules(fields=FIELDS, robots=['virtual_robot'], duration=3.0),
)
def test_faults_are_of_their_kinds_and_have_ended_in_time(schedule, others):
    assert len(schedule) <= 4
    for fault in schedule:
        assert fault.start + fault.duration <= 3.0 + 1e-9
        assert on_grid(fault.start)
        assert on_grid(fault.duration)
    for fault in others:
        assert isinstance(fault, (faults.Corrupt, faults.RobotFault))
        if isinstance(fault, faults.Corrupt):
            assert fault.field in FIELDS[fault.topic]
            if fault.field == 'header.stamp':
                assert fault.change == 'offset'
                assert fault.amount != 0.0


def test_kinds_of_faults_may_be_chosen():
    jumps = fault_schedules(['odom'], ['robot'], kinds=[faults.TimeJump], max_faults=1)
    assert type(find(jumps, bool, settings=SHRINK)[0]) is faults.TimeJump
    own = faults.ParameterChange('robot', 'kp', 2.0)
    assert find(fault_schedules(kinds=[st.just(own)]), bool, settings=SHRINK) == [own]
    endless = fault_schedules(['odom'], kinds=[faults.Stale], endless=True)
    found = find(endless, lambda s: any(math.isinf(one.duration) for one in s), settings=SHRINK)
    assert found == [faults.Stale('odom')]


# --- Generation


def test_a_block_depends_on_its_seed_and_number_alone(tmp_path, monkeypatch):
    strategy = trials(st.fixed_dictionaries({'x': st.integers()}), fault_schedules(['odom']))
    before = generate(strategy, 1, 2, 50)
    assert len(before) == 50
    # Hypothesis would try the constants of a module that is loaded meanwhile.
    (tmp_path / 'constants.py').write_text(f'NUMBERS = {list(range(70_000, 70_900))}\n')
    monkeypatch.syspath_prepend(tmp_path)
    # So that it is removed afterwards.
    monkeypatch.setitem(sys.modules, 'constants', None)
    monkeypatch.delitem(sys.modules, 'constants')
    importlib.import_module('constants')
    tried = []

    def fails(trial):
        tried.append(trial)
        return trial.case['x'] > 1000

    smallest = shrink(strategy, 1, 2, 50, fails)
    first = next(index for index, trial in enumerate(before) if trial.case['x'] > 1000)
    assert tried[: first + 1] == before[: first + 1]
    assert smallest == Trial(case={'x': 1001})
    assert generate(strategy, 1, 3, 5) != before[:5]
    assert generate(strategy, 2, 2, 5) != before[:5]
    with pytest.raises(ExplorationError, match='no trial'):
        shrink(strategy, 0, 1, 5, lambda trial: False)


def test_hypothesis_that_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, 'hypothesis', None)
    monkeypatch.delitem(sys.modules, 'diffdrive_jacobian.exploration.schedules')
    with pytest.raises(ExplorationError, match=r"pip install 'diffdrive_jacobian\[explore\]'"):
        importlib.import_module('diffdrive_jacobian.exploration.schedules')


# --- Source and names


class Side(Enum):
    LEFT = 1


@dataclass
class Place:
    x: float
    side: Side = Side.LEFT


@pytest.mark.parametrize(
    'value',
    [
        *(None, [1, -2.5, True, 'a"b', b'\0'], {'a': (1.0,), 'b': ()}),
        *({1, 2}, frozenset(), set(), math.inf, Place(1.0), [Place(-math.inf, Side.LEFT)]),
        faults.Loss('odom', probability=0.5, start=1.0),
    ],
)
def test_source_evaluates_to_the_value(value):
    source = Source()
    text = source.expression(value)
    names = {name: getattr(importlib.import_module(module), name) for module, name in source.imports}
    assert eval(text, names) == value


def test_source_names_its_imports_and_refuses_other_objects():
    source = Source()
    assert source.expression(faults.Loss('odom', start=1.0)) == "Loss('odom', start=1.0)"
    assert source.imports == {('diffdrive_jacobian.faults', 'Loss')}
    assert Source().expression(math.nan) == "float('nan')"
    with pytest.raises(ExplorationError, match=r'a case must consist of .* got object'):
        Source().expression([object()])


def test_scenarios_are_found_by_name(tmp_path, monkeypatch):
    # Where scenarios are found remains in the search path.
    monkeypatch.setattr(sys, 'path', [*sys.path])
    name = ScenarioName.of(follow)
    assert (name.module, name.name) == ('exploration_scenarios', 'follow')
    assert name.load() is follow
    # Also when another module has the name already.
    (tmp_path / 'json.py').write_text('def drive(world, case):\n    return "own"\n')
    assert scenario_from(tmp_path, 'json', 'drive')(None, None) == 'own'
    with pytest.raises(ExplorationError, match=r'cannot be imported from .*, which has no nowhere.py'):
        scenario_from(tmp_path, 'nowhere', 'drive')


def test_what_is_no_scenario_is_refused():
    def nested(world, case):
        """Be in a function."""

    for wrong in (nested, lambda world, case: None, 3):
        with pytest.raises(ExplorationError, match='top level of a module'):
            ScenarioName.of(wrong)
    with pytest.raises(ExplorationError, match='takes 3'):
        ScenarioName.of(lost)


def test_versions_are_compared():
    here = versions()
    assert differences(here, here) == []
    assert differences(here, {**here, 'numpy': '0'}) == [f'numpy {here["numpy"]} here, 0 there']
