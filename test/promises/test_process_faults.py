"""A short form of what `promises.py` tries for hours: signals, hostile input, failing disks.

How long something takes is not asserted here. `promises.py` counts it.
"""

from __future__ import annotations

import random

import promises
import pytest
from process_faults import clocks, ends, fuzzed_parameters, hostile, recording, stopped
from process_faults.outcome import Outcome
from process_faults.worlds import quiet_world

pytestmark = pytest.mark.process


@pytest.fixture
def world():
    with quiet_world(life=90.0) as made:
        yield made


def test_programs_end_by_signals(world, tmp_path, monkeypatch):
    monkeypatch.setattr(ends, 'LIMIT', ends.PATIENCE)
    campaign = ends.Campaign(world, tmp_path, tmp_path, random.Random(1))
    programs = {program.name: program for program in ends.PROGRAMS}
    cases = {'go_to_goal': 'busy', 'wheel_bridge': 'callback', 'virtual_robot': 'start-up'}
    for name, mode in cases.items():
        assert campaign.end(programs[name], mode)[0] == []
    # Exit codes that are not as expected, and a time that is too long, are counted.
    monkeypatch.setattr(ends, 'LIMIT', 0.0)
    wrong = programs['wheel_bridge']._replace(codes=(3,))
    code, time = campaign.end(wrong, 'twice')[0]
    assert 'exit code 0' in code
    assert 'exits after' in time


def test_a_controller_is_stopped_and_continued(world, monkeypatch):
    monkeypatch.setattr(stopped, 'LATE', 5.0)
    team = stopped.Team(world)
    violations, _ = stopped.disturb(team, 'go_to_goal', kill=False, chance=random.Random(1))
    assert violations == []


def test_a_clock_jumps(world):
    assert clocks.disturb(clocks.Simulation(world), clocks.jump, random.Random(1)) == []


def test_fuzzed_parameters(world):
    chance = random.Random(1)
    fuzzer = fuzzed_parameters.Fuzzer(world, 'go_to_goal', chance)
    for _ in range(30):
        fuzzer.change()
    assert fuzzer.violations == []
    assert fuzzed_parameters.start_up(world.harness, chance, 3) == []


def test_hostile_messages(world):
    case = next(one for one in hostile.INPUTS if (one.node, one.topic) == ('go_to_goal', 'goals'))
    violations, _ = hostile.Attack(world, case, random.Random(1)).run(200)
    assert violations == []


@pytest.mark.parametrize('fault', ['disk that becomes read-only', 'few descriptors'])
def test_recordings_under_faults(world, tmp_path, fault):
    made, code = recording.FAULTS[fault](world, tmp_path, random.Random(1))
    assert recording.check(fault, made, code, tmp_path) == []


def test_the_page_has_a_row_for_each_promise_and_receives_its_result():
    page = promises.PAGE.read_text()
    assert len(promises.rows(page.splitlines())) == len(promises.PROMISES)
    broken = Outcome(1234, [f'`{number}`' for number in range(12)], 'at most 1 s')
    changed = promises.updated(page, 'clocks', broken, '2026-11-24')
    assert '| 1,234 events, 2026-11-24 | **12 broke it**; at most 1 s |' in changed
    assert "\n## What broke clocks\n\n- `'0'`\n" in changed
    assert changed.endswith("- `'9'`\n- and 2 more\n")
    soaked = promises.updated(changed, 'soak', broken, '2026-11-24')
    assert '\n- and 2 more\n\n## What broke soak\n\n' in soaked
    # Nothing of that is left once it is kept.
    kept = Outcome(42, [])
    for name in ('clocks', 'soak'):
        soaked = promises.updated(soaked, name, kept, '2026-11-21')
    assert '| 42 events, 2026-11-21 | kept |' in soaked
    assert len(soaked.splitlines()) == len(page.splitlines())
