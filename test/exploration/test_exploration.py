"""`explore`: finds, shrinks, counts, writes and replays, in worlds of tiny nodes in this process."""

from __future__ import annotations

import ast
import json
import re
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from pathlib import Path

import exploration_scenarios as scenarios
import pytest
from exploration_scenarios import (
    changing,
    demanding,
    divide,
    failing,
    follow,
    identified,
    moving,
    nothing,
    serial,
)
from hypothesis import strategies as st
from support import inner_sessions  # noqa: F401  What it imports is not imported again.

from diffdrive_jacobian.bags.bag_reader import open_bag
from diffdrive_jacobian.faults import Delay, Loss
from diffdrive_jacobian.properties import AccelerationWithin, NeverFasterThan
from diffdrive_jacobian.testing import (
    ExplorationError,
    Replay,
    SerialExecutor,
    fault_schedules,
    numbers,
)

pytestmark = pytest.mark.slow
SLOW = NeverFasterThan(0.75, 1.0)
LOSSES = fault_schedules(['speed'], kinds=[Loss, Delay], max_faults=2, duration=1.2)
SPEEDS = {'speed': numbers(0.0, 5.0)}


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
        violation=None, same_verdict=True, same_bits=False, differences=('numpy 1 here, 2 there',)
    )
    assert str(elsewhere) == 'violated as found, but not bit for bit; numpy 1 here, 2 there'


def test_what_is_written(found):
    (finding,) = found.findings
    folder = finding.directory
    assert folder.name == 'NeverFasterThan'
    case = json.loads((folder / 'counterexample.json').read_text())
    assert case['faults'] == ["Loss('speed', duration=1.0)"]
    assert case['digest'] == finding.digest
    assert case['versions']['python']
    with open_bag(folder / 'run') as bag:
        assert {'/speed', '/cmd_vel', '/fault_events'} <= {one.topic for one in bag.connections}
    # There is no odometry.
    assert 'no picture' in finding.notes[0]
    # What the test imports, it uses.
    tree = ast.parse((folder / 'test_never_faster_than.py').read_text())
    imported = [
        name.asname or name.name
        for node in ast.walk(tree)
        if isinstance(node, (ast.Import, ast.ImportFrom)) and node.module != '__future__'
        for name in node.names
    ]
    used = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    assert used.issuperset(imported)


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
    required = [NeverFasterThan(0.15, 1.0), AccelerationWithin(0.1, 0.1)]
    found = serial(divide, required, cases=SPEEDS, worlds=15, output=tmp_path)
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


def test_a_property_that_the_scenario_requires_is_a_finding():
    (finding,) = serial(demanding, worlds=1).findings
    assert finding.violation.key == repr(NeverFasterThan(0.1, 1.0))
    assert finding.deterministic


def test_a_scenario_that_is_not_deterministic_is_reported():
    (finding,) = serial(changing, cases=SPEEDS, worlds=8).findings
    assert 'not deterministic: a second run' in str(finding)
    # Random identifiers of goals do not count.
    assert serial(identified, worlds=1).findings[0].deterministic


# --- Stops


@pytest.mark.parametrize(
    ('scenario', 'arguments', 'worlds', 'stopped'),
    [
        (nothing, {'cases': st.integers(1, 51)}, 51, 'there are no more than 51 different worlds'),
        (
            failing,
            {'stop_at_first': True, 'shrink_worlds': 0},
            50,
            'after the first block with a violation',
        ),
        (nothing, {'time_limit': 1e-9}, 5, 'time limit of 1e-09 s'),
    ],
)
def test_fewer_worlds_than_asked_for_are_explained(scenario, arguments, worlds, stopped):
    found = serial(scenario, worlds=60, **{'cases': st.integers(0, 70), **arguments})
    assert (found.worlds, found.stopped) == (worlds, stopped)
    assert f'stopped: {stopped}' in str(found)
    assert len(found.findings) == (scenario is failing)


class Broken(SerialExecutor):
    """Of one of its tasks there is no result, but an error for who waits for it."""

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


@pytest.mark.parametrize('number', [3, 7], ids=['exploring', 'shrinking'])
@pytest.mark.parametrize(
    ('error', 'stopped'),
    [
        (KeyboardInterrupt, 'interrupted'),
        (FutureTimeoutError, 'time limit of 1000 s; a world still'),
    ],
)
def test_what_was_found_is_kept_when_an_exploration_ends_early(tmp_path, number, error, stopped):
    """By Ctrl-C, or since a world does not end."""
    executor = Broken(number, error)
    arguments = {'cases': st.integers(50, 70), 'worlds': 21, 'time_limit': 1000.0}
    found = serial(failing, executor=executor, output=tmp_path, **arguments)
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


def test_a_limit_of_shrinking_is_reported():
    found = serial(failing, cases=st.integers(0, 1000), worlds=5, shrink_worlds=1)
    (finding,) = found.findings
    assert (finding.shrink_worlds, finding.complete) == (1, False)


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


MISTAKES = [
    ({'scenario': lambda world, case: None}, 'top level'),
    ({'properties': SLOW}, 'properties must be a list'),
    ({'properties': [NeverFasterThan]}, r'create one: NeverFasterThan\(...\)'),
    ({'properties': None}, 'properties must be a list, got None'),
    ({'properties': ['fast']}, "instances of Property, got 'fast'"),
    ({'properties': [SLOW, SLOW]}, 'given once'),
    ({'properties': [NeverFasterThan(1.0, 1.0, topic='typo')]}, 'without faults: .*typo'),
    ({'faults': st.just(Loss('odom'))}, r"lists of faults; it gave Loss\('odom'\)"),
    ({'faults': [Loss('odom')]}, 'faults must be a strategy'),
    ({'cases': {'x': 3}}, 'cases must be strategies'),
    ({'cases': st.builds(object)}, 'a case must consist of'),
    ({'worlds': 0}, 'worlds must be an integer of at least 1, got 0'),
    ({'seed': -1}, 'seed'),
    ({'shrink_worlds': 1.5}, 'shrink_worlds'),
    ({'time_limit': 0.0}, 'time_limit must be positive'),
    ({'time_limit': '1'}, "time_limit must be a number, got '1'"),
    ({'executor': 4}, 'executor must be an Executor'),
    ({'output': Path(__file__)}, 'cannot be created'),
    ({'args': ['-p', 'x:=1']}, "args must begin with '--ros-args'"),
]


@pytest.mark.parametrize(('arguments', 'words'), MISTAKES)
def test_mistakes_are_named(arguments, words):
    with pytest.raises(ExplorationError, match=words):
        serial(**{'scenario': nothing, 'worlds': 1, **arguments})
