"""`explore`: finds, shrinks, counts, writes and reports, in worlds of tiny nodes in this process."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from concurrent.futures import Future
from importlib.util import find_spec
from pathlib import Path

import exploration_scenarios as scenarios
import pytest
from exploration_scenarios import changing, divide, follow, identified, moving
from hypothesis import strategies as st
from support import inner_sessions  # noqa: F401  What it imports is not imported again.

from diffdrive_jacobian.bags.bag_reader import open_bag
from diffdrive_jacobian.exploration import search
from diffdrive_jacobian.faults import Delay, Loss
from diffdrive_jacobian.properties import AccelerationWithin, NeverFasterThan
from diffdrive_jacobian.testing import (
    ExplorationError,
    Replay,
    SerialExecutor,
    explore,
    fault_schedules,
    numbers,
)

SLOW = NeverFasterThan(0.75, 1.0)
LOSSES = fault_schedules(['speed'], kinds=[Loss, Delay], max_faults=2, duration=1.2)
SPEEDS = {'speed': numbers(0.0, 5.0)}


def serial(scenario, properties=(), **arguments):
    return explore(scenario, properties, executor=SerialExecutor(), **arguments)


@pytest.fixture(scope='module')
def found(tmp_path_factory):
    """Explore the follower, which is too fast when readings are lost for 0.7 s."""
    output = tmp_path_factory.mktemp('explored')
    return serial(follow, [SLOW], faults=LOSSES, worlds=12, output=output)


def test_the_smallest_case_is_one_round_fault(found):
    (finding,) = found.findings
    assert finding.violation.key == repr(SLOW)
    assert finding.trial.faults == (Loss('speed', duration=1.0),)
    assert (finding.trial.case, finding.trial.seed) == (None, 0)
    assert finding.violation.seconds == pytest.approx(0.7)
    assert finding.deterministic
    assert finding.complete


def test_the_numbers_are_counted(found):
    (finding,) = found.findings
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
    again = serial(follow, [SLOW], faults=LOSSES, worlds=12, shrink_worlds=0)
    assert (again.checks, again.faults) == (found.checks, found.faults)
    assert again.findings[0].first_trial == found.findings[0].first_trial


def test_a_finding_is_replayed(found, monkeypatch):
    replay = found.replay()
    assert replay.same_bits
    assert str(replay) == 'the same as found, bit for bit, with the same versions and processor'
    monkeypatch.setattr(scenarios, 'TIMEOUT', 0.5)
    mended = found.replay(found.findings[0])
    assert mended.violation is None
    assert str(mended).startswith('not violated as it was found')


def test_what_is_written(found):
    folder = found.findings[0].directory
    assert folder.name == 'NeverFasterThan'
    assert {path.name for path in folder.iterdir()} >= {
        'counterexample.json',
        'test_never_faster_than.py',
        'run',
    }
    case = json.loads((folder / 'counterexample.json').read_text())
    assert case['faults'] == ["Loss('speed', duration=1.0)"]
    assert case['digest'] == found.findings[0].digest
    assert case['versions']['python']
    with open_bag(folder / 'run') as bag:
        assert {'/speed', '/cmd_vel', '/fault_events'} <= {one.topic for one in bag.connections}
    # There is no odometry.
    assert 'no picture' in found.findings[0].notes[0]


def test_the_written_test_reproduces_it_until_the_controller_is_mended(found, pytester, monkeypatch):
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


@pytest.mark.skipif(find_spec('ruff') is None, reason='ruff is not installed')
def test_the_written_test_has_no_errors_that_ruff_finds(found):
    file = found.findings[0].directory / 'test_never_faster_than.py'
    command = [sys.executable, '-m', 'ruff', 'check', '--isolated', file]
    checked = subprocess.run(command, capture_output=True, text=True)
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_another_exploration_replaces_what_was_written(found):
    folder = found.findings[0].directory
    before = (folder / 'counterexample.json').read_text()
    (folder / 'notes.txt').write_text('mine')
    serial(follow, [SLOW], faults=LOSSES, worlds=12, seed=1, shrink_worlds=0, output=folder.parent)
    assert (folder / 'counterexample.json').read_text() != before
    assert (folder / 'notes.txt').read_text() == 'mine'
    assert (folder / 'run' / 'run.mcap').exists()
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]


def test_each_property_and_each_exception_is_a_finding(tmp_path):
    found = serial(
        divide,
        [NeverFasterThan(0.15, 1.0), AccelerationWithin(0.1, 0.1)],
        cases=SPEEDS,
        worlds=15,
        output=tmp_path,
    )
    cases = {one.directory.name: one.trial.case['speed'] for one in found.findings}
    assert cases == {
        'NoExceptionZeroDivisionError': 0.0,
        'NeverFasterThan': 1.0,
        'AccelerationWithin': 0.0,
        'NoExceptionAssertionError': 3.0,
    }
    crash = next(one for one in found.findings if 'ZeroDivision' in one.violation.key)
    assert re.search(r'in exploration_scenarios.py:\d+ \(on_speed\)$', crash.violation.key)
    assert crash.violation.text.startswith('Traceback')
    assert 'ZeroDivisionError' in str(crash)
    assert crash.deterministic


def test_a_scenario_that_is_not_deterministic_is_reported():
    (finding,) = serial(changing, cases=SPEEDS, worlds=8).findings
    assert not finding.deterministic
    assert 'not deterministic: a second run' in str(finding)


def test_random_identifiers_of_goals_do_not_count():
    (finding,) = serial(identified, worlds=1).findings
    assert finding.deterministic


# --- Stops


def nothing(world, case):
    """Do nothing."""


def failing(world, case):
    assert case < 60


def test_fewer_different_worlds_than_asked_for():
    found = serial(nothing, cases=st.sampled_from('abc'), worlds=100)
    assert found.worlds == 3
    assert found.stopped == 'there are no more than 3 different worlds'
    assert 'stopped: there are no more' in str(found)


def test_stop_after_the_first_block_with_a_violation(monkeypatch):
    monkeypatch.setattr('diffdrive_jacobian.exploration.search.BLOCK', 4)
    found = serial(failing, cases=st.integers(50, 65), worlds=200, stop_at_first=True)
    assert found.worlds < 15
    assert found.stopped == 'after the first block with a violation'
    assert found.findings[0].trial.case == 60


def test_a_time_limit_is_only_a_stop():
    found = serial(nothing, cases=st.integers(), worlds=50, time_limit=1e-9)
    assert found.worlds < 50
    assert found.stopped == 'time limit of 1e-09 s'


class Stuck(SerialExecutor):
    """Starts worlds that do not end, from a call on."""

    def __init__(self, at):
        self.left = at

    def submit(self, fn, /, *args, **kwargs):
        self.left -= 1
        return Future() if self.left < 0 else super().submit(fn, *args, **kwargs)


@pytest.mark.parametrize('at', [3, 5])
def test_a_world_that_does_not_end_is_given_up(tmp_path, monkeypatch, at):
    """In the fourth task of worlds, and while shrinking."""
    monkeypatch.setattr(search, 'GRACE', 0.0)
    arguments = {'cases': st.integers(50, 70), 'worlds': 21, 'output': tmp_path}
    # Long enough to get there on a busy machine.
    found = explore(failing, executor=Stuck(at), time_limit=5.0, **arguments)
    assert 'a world still ran' in found.stopped
    (finding,) = found.findings
    assert not finding.complete


def test_files_of_others_stay(tmp_path, monkeypatch):
    """Those in a folder of the same name. A relative output stays where it was, too."""
    precious = tmp_path / 'found' / 'NoExceptionValueError' / 'run' / 'precious'
    precious.parent.mkdir(parents=True)
    precious.touch()
    monkeypatch.chdir(tmp_path)
    found = serial(moving, worlds=1, output='found')
    assert precious.exists()
    assert found.findings[0].directory == tmp_path / 'found' / 'NoExceptionValueError_2'
    assert (found.findings[0].directory / 'run').is_dir()


class Interrupted(SerialExecutor):
    """Presses Ctrl-C at a call."""

    def __init__(self, at):
        self.left = at

    def submit(self, fn, /, *args, **kwargs):
        self.left -= 1
        if self.left == 0:
            future = Future()
            future.result = self.interrupt
            return future
        return super().submit(fn, *args, **kwargs)

    def interrupt(self, timeout=None):
        raise KeyboardInterrupt


@pytest.mark.parametrize('at', [3, 7])
def test_ctrl_c_keeps_what_was_found(tmp_path, at):
    """In the third task of worlds, and while shrinking."""
    executor = Interrupted(at)
    found = explore(failing, cases=st.integers(50, 70), worlds=21, executor=executor, output=tmp_path)
    assert found.stopped == 'interrupted'
    assert found.worlds == (10 if at == 3 else 21)
    (finding,) = found.findings
    assert not finding.complete
    assert finding.trial == finding.first_trial
    assert '(not shrunk to the end)' in str(finding)
    assert (finding.directory / 'counterexample.json').exists()


def test_a_limit_of_shrinking_is_reported():
    found = serial(failing, cases=st.integers(0, 1000), worlds=5, shrink_worlds=1)
    (finding,) = found.findings
    assert (finding.shrink_worlds, finding.complete) == (1, False)


# --- Mistakes


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        ({'scenario': lambda world, case: None}, 'top level'),
        ({'properties': SLOW}, 'properties must be a list'),
        ({'properties': [NeverFasterThan]}, r'create one: NeverFasterThan\(...\)'),
        ({'properties': ['fast']}, "instances of Property, got 'fast'"),
        ({'properties': [SLOW, SLOW]}, 'given once'),
        ({'properties': None}, 'properties must be a list, got None'),
        ({'time_limit': '1'}, "time_limit must be a number, got '1'"),
        ({'faults': st.just(Loss('odom'))}, r"lists of faults; it gave Loss\('odom'\)"),
        ({'worlds': 0}, 'worlds must be an integer of at least 1, got 0'),
        ({'seed': -1}, 'seed'),
        ({'shrink_worlds': 1.5}, 'shrink_worlds'),
        ({'time_limit': 0.0}, 'time_limit must be positive'),
        ({'cases': {'x': 3}}, 'cases must be strategies'),
        ({'cases': st.builds(object)}, 'a case must consist of'),
        ({'faults': [Loss('odom')]}, 'faults must be a strategy'),
        ({'executor': 4}, 'executor must be an Executor'),
        ({'output': Path(__file__)}, 'cannot be created'),
        ({'args': ['-p', 'x:=1']}, "args must begin with '--ros-args'"),
        ({'properties': [NeverFasterThan(1.0, 1.0, topic='typo')]}, 'without faults: .*typo'),
    ],
)
def test_mistakes_are_named(arguments, words):
    arguments = {'scenario': nothing, 'worlds': 1, **arguments}
    with pytest.raises(ExplorationError, match=words):
        explore(**{'executor': SerialExecutor(), **arguments})


def test_where_a_replay_differs():
    replay = Replay(
        violation=None, same_verdict=True, same_bits=False, differences=('numpy 1 here, 2 there',)
    )
    assert str(replay) == ('violated as found, but not bit for bit; numpy 1 here, 2 there')
