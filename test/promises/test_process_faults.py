"""A short form of what `promises.py` tries for hours: signals, hostile input, failing disks.

How long something takes is not asserted here. `promises.py` counts it.
"""

from __future__ import annotations

import random

import promises
import pytest
from process_faults import ends, fuzzed_parameters, hostile, recording, stopped
from process_faults.worlds import quiet_world

pytestmark = pytest.mark.process


@pytest.fixture
def world(tmp_path):
    place = tmp_path / 'world'
    place.mkdir()
    with quiet_world(place, life=90.0) as made:
        yield made


def test_programs_end_by_signals(world, tmp_path, monkeypatch):
    monkeypatch.setattr(ends, 'LIMIT', ends.PATIENCE)
    campaign = ends.Campaign(world, tmp_path, tmp_path, random.Random(1))
    programs = {program.name: program for program in ends.PROGRAMS}
    cases = {'go_to_goal': 'busy', 'wheel_bridge': 'callback', 'virtual_robot': 'start-up'}
    for name, mode in cases.items():
        violations, _ = campaign.end(programs[name], mode)
        assert violations == []


def test_a_violation_is_counted(world, tmp_path, monkeypatch):
    """Exit codes that are not as expected, and a time that is too long."""
    monkeypatch.setattr(ends, 'LIMIT', 0.0)
    campaign = ends.Campaign(world, tmp_path, tmp_path, random.Random(1))
    program = next(one for one in ends.PROGRAMS if one.name == 'wheel_bridge')
    violations, _ = campaign.end(program._replace(codes=(3,)), 'twice')
    assert len(violations) == 2
    assert 'exit code 0' in violations[0]
    assert 'exits after' in violations[1]


def test_a_controller_is_stopped_and_continued(world, monkeypatch):
    monkeypatch.setattr(stopped, 'LATE', 5.0)
    team = stopped.Team(world)
    violations, _ = stopped.disturb(team, 'go_to_goal', kill=False, chance=random.Random(1))
    assert violations == []


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
    folder = tmp_path / 'folder'
    folder.mkdir()
    made, code = recording.FAULTS[fault](world, folder, random.Random(1))
    assert recording.check(fault, made, code, folder) == []


def test_the_page_has_the_stored_results():
    assert promises.PAGE.read_text() == promises.page(promises.stored())
