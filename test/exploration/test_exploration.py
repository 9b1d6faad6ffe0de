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

"""`explore`: finds, shrinks, counts, replays and stops, in worlds of tiny nodes in this process."""

from __future__ import annotations

import re
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from dataclasses import replace
from pathlib import Path

import exploration_scenarios as scenarios
import pytest
from exploration_scenarios import changing, divide, failing, follow, identified, nothing, serial
from hypothesis import strategies as st
from support import inner_sessions  # noqa: F401  What it imports is not imported again.

from diffdrive_jacobian.faults import Hang, Loss
from diffdrive_jacobian.properties import NeverFasterThan
from diffdrive_jacobian.relations import Repeated
from diffdrive_jacobian.testing import (
    ExplorationError,
    Replay,
    SerialExecutor,
    fault_schedules,
    numbers,
)

pytestmark = pytest.mark.slow
SLOW = NeverFasterThan(0.75, 1.0)
LOSSES = fault_schedules(['speed'], kinds=[Loss], max_faults=2, duration=1.2)
SPEEDS = {'speed': numbers(0.0, 5.0)}


@pytest.fixture(scope='module')
def found(tmp_path_factory):
    """Explore the follower, which is too fast when readings are lost for 0.7 s."""
    output = tmp_path_factory.mktemp('explored')
    return serial(follow, [SLOW], faults=LOSSES, worlds=12, output=output)


# --- What is found


def test_the_smallest_case_is_one_round_fault_and_all_is_counted(found):
    (finding,) = found.findings
    assert finding.violation.key == repr(SLOW)
    assert finding.trial.faults == (Loss('speed', duration=1.0),)
    assert (finding.trial.case, finding.trial.seed) == (None, 0)
    assert finding.violation.seconds == pytest.approx(0.7)
    assert finding.deterministic
    assert finding.complete
    assert (found.worlds, found.wanted, found.stopped, found.notes) == (12, 12, '', ())
    assert found.simulated == pytest.approx(12 * 1.2)
    assert found.faults >= len(finding.first_trial.faults) > 0
    assert found.checks > 12 * 12
    assert 0 < finding.shrink_worlds == found.shrink_worlds <= 60
    assert 1 <= finding.count < 12
    text = str(found)
    for words in (
        r'^12 worlds of 12 in [\d.]+ s \([\d.]+ worlds/s\), 14 s of simulated time, seed 0$',
        rf'^{found.faults} faults injected, {found.checks} checks of properties, 1 violated$',
        rf"^  faults: \[Loss\('speed', duration=1.0\)\], seed {finding.trial.seed}$",
        r'^  violated at 0.7 s: /cmd_vel: v 0.8 m/s',
    ):
        assert re.search(words, text, re.MULTILINE), text


def test_the_same_seed_finds_the_same(found):
    first = found.findings[0]
    again = serial(follow, [SLOW], faults=LOSSES, worlds=first.first_world + 1, shrink_worlds=0)
    assert again.findings[0].first_trial == first.first_trial


def test_a_finding_is_replayed(found, monkeypatch):
    replay = found.replay()
    assert replay.same_bits
    assert str(replay) == 'the same as found, bit for bit, with the same versions and processor'
    monkeypatch.setattr(scenarios, 'TIMEOUT', 0.5)
    mended = found.replay(found.findings[0])
    assert mended.violation is None
    assert str(mended).startswith('not violated as it was found')
    elsewhere = Replay(
        violation=None,
        same_verdict=True,
        same_bits=False,
        differences=('numpy 1 here, 2 there',),
    )
    assert str(elsewhere) == 'violated as found, but not bit for bit; numpy 1 here, 2 there'


def test_the_written_test_fails_until_the_controller_is_mended(found, pytester, monkeypatch):
    file = found.findings[0].directory / 'test_never_faster_than.py'
    options = ('-p', 'no:cacheprovider', '-p', 'no:xdist', '-p', 'no:launch_testing', file)
    result = pytester.runpytest_inprocess(*options)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        [
            f'E*{SLOW!r} is violated at 0.7 s: /cmd_vel: v 0.8 m/s*',
            'E*the same as found, bit for bit, with the same versions and processor*',
        ]
    )
    monkeypatch.setattr(scenarios, 'TIMEOUT', 0.5)
    pytester.runpytest_inprocess(*options).assert_outcomes(passed=1)


def test_each_property_and_each_exception_is_a_finding(tmp_path):
    """Also a property that the scenario requires."""
    found = serial(
        divide,
        [NeverFasterThan(0.15, 1.0)],
        cases=SPEEDS,
        worlds=10,
        output=tmp_path,
    )
    cases = {one.directory.name: one.trial.case['speed'] for one in found.findings}
    assert cases == {
        'NoExceptionZeroDivisionError': 0.0,
        'NeverFasterThan': 1.0,
        'NoExceptionAssertionError': 3.0,
    }
    crash = next(one for one in found.findings if 'ZeroDivision' in one.violation.key)
    assert re.search(r'in exploration_scenarios.py:\d+ \(on_speed\)$', crash.violation.key)
    assert crash.violation.text.startswith('Traceback')
    assert 'ZeroDivisionError' in str(crash)
    assert crash.deterministic
    (finding,) = serial(scenarios.demanding, worlds=1).findings
    assert finding.violation.key == repr(NeverFasterThan(0.1, 1.0))


def test_a_scenario_that_is_not_deterministic_is_reported():
    (finding,) = serial(changing, cases=SPEEDS, worlds=6).findings
    assert 'not deterministic: a second run' in str(finding)
    # Random identifiers of goals do not count.
    assert serial(identified, worlds=1).findings[0].deterministic


def test_faults_without_effect_are_noted_once_for_each_name():
    schedules = fault_schedules(['typo'], ['follwer'], kinds=[Loss, Hang], max_faults=2, duration=1.0)
    found = serial(follow, faults=schedules, worlds=6)
    notes = re.findall(r'^note: (.*) \(\d+ of 6 worlds\)$', str(found), re.MULTILINE)
    assert sorted(notes) == [
        'a fault had no effect: no node /follwer was seen',
        'a fault had no effect: no subscription of /typo was seen',
    ]
    text = str(replace(found, notes=tuple(f'note {number}' for number in range(14))))
    assert text.count('\nnote: ') == 11
    assert 'note: and 4 more notes' in text


# --- Stops


@pytest.mark.parametrize(
    ('scenario', 'arguments', 'stopped'),
    [
        (nothing, {'cases': st.integers(1, 51)}, 'there are no more than 51 different worlds'),
        (failing, {'stop_at_first': True}, 'after the first block with a violation'),
        (nothing, {'time_limit': 1e-9}, 'time limit of 1e-09 s'),
    ],
)
def test_fewer_worlds_than_asked_for_are_explained(scenario, arguments, stopped):
    # One case more than a block has trials.
    cases = {'cases': st.integers(20, 70), 'shrink_worlds': 0}
    found = serial(scenario, worlds=60, **{**cases, **arguments})
    assert 5 <= found.worlds < 52
    assert found.stopped == stopped
    assert f'stopped: {stopped}' in str(found)
    assert len(found.findings) == (scenario is failing)


def test_a_limit_of_shrinking_is_reported():
    (finding,) = serial(failing, cases=st.integers(0, 1000), worlds=5, shrink_worlds=1).findings
    assert (finding.shrink_worlds, finding.complete) == (1, False)


class Broken(SerialExecutor):
    """Raises an error instead of one task, which is numbered from 1."""

    def __init__(self, number, error):
        self.left, self.error = number, error

    def submit(self, fn, /, *args, **kwargs):
        self.left -= 1
        if self.left:
            return super().submit(fn, *args, **kwargs)
        future = Future()
        future.result = self.fail
        return future

    def fail(self, timeout=None):
        raise self.error


@pytest.mark.parametrize(
    ('error', 'number', 'stopped'),
    [
        (KeyboardInterrupt, 3, 'interrupted'),
        (KeyboardInterrupt, 7, 'interrupted'),
        (FutureTimeoutError, 3, 'time limit of 1000 s; a world still'),
    ],
    ids=['exploring', 'shrinking', 'not ending'],
)
def test_an_exploration_that_ends_early_keeps_what_was_found(tmp_path, error, number, stopped):
    arguments = {'cases': st.integers(50, 70), 'worlds': 21, 'time_limit': 1000.0}
    found = serial(failing, executor=Broken(number, error), output=tmp_path, **arguments)
    assert found.stopped.startswith(stopped)
    assert found.worlds == (10 if number == 3 else 21)
    (finding,) = found.findings
    assert not finding.complete
    assert finding.trial == finding.first_trial
    assert '(not shrunk to the end)' in str(finding)
    assert (finding.directory / 'counterexample.json').exists()


@pytest.mark.parametrize('number', [2, 8], ids=['exploring', 'shrinking'])
def test_an_executor_that_fails_once_is_reported(number):
    """Also while Hypothesis shrinks, which would try again and call the results unreliable."""
    executor = Broken(number, ConnectionError('the worker is gone'))
    with pytest.raises(ExplorationError, match=r'not be run: ConnectionError: the worker is gone$'):
        serial(failing, executor=executor, cases=st.integers(0, 10**6), worlds=21)


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        ({'scenario': lambda world, case: None}, 'top level'),
        ({'properties': SLOW}, r'properties must be a list: \[NeverFasterThan'),
        ({'properties': [NeverFasterThan]}, r'create one: NeverFasterThan\(...\)'),
        ({'properties': None}, 'properties must be a list, got None'),
        ({'properties': ['fast']}, "instances of Property, got 'fast'"),
        ({'properties': [SLOW, SLOW]}, 'properties: each can be given once'),
        ({'properties': [NeverFasterThan(1.0, 1.0, topic='typo')]}, 'without faults: .*typo'),
        ({'relations': Repeated('x')}, 'relations must be a list'),
        ({'relations': [SLOW]}, 'relations must be instances of Relation, got NeverFasterThan'),
        ({'relations': [Repeated('typo')]}, 'without faults: .*no node has the topic /typo'),
        ({'faults': st.just(Loss('odom'))}, r"lists of faults; it gave Loss\('odom'\)"),
        ({'faults': [Loss('odom')]}, 'faults must be a strategy'),
        ({'cases': {'x': 3}}, 'cases must be strategies'),
        ({'cases': st.builds(object)}, 'a case must consist of'),
        ({'worlds': 0}, 'worlds must be an integer of at least 1, got 0'),
        ({'seed': -1}, 'seed'),
        ({'shrink_worlds': 1.5}, 'shrink_worlds'),
        ({'time_limit': 0.0}, 'time_limit must be positive'),
        ({'executor': 4}, 'executor must be an Executor'),
        ({'output': Path(__file__)}, 'cannot be created'),
        ({'args': ['-p', 'x:=1']}, "args must begin with '--ros-args'"),
    ],
)
def test_mistakes_are_named(arguments, words):
    with pytest.raises(ExplorationError, match=words):
        serial(**{'scenario': nothing, 'worlds': 1, **arguments})
