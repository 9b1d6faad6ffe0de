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

"""`recorded_run` keeps the recordings of tests that fail, under the name of the test."""

from __future__ import annotations

import pytest
from support.inner_sessions import OPTIONS, SETTING, draw_quickly, run_inner

from diffdrive_jacobian.bags import read_run
from diffdrive_jacobian.bags.verification import verify
from diffdrive_jacobian.testing.fixtures import MAX_LENGTH, artifact_name, name_beside_the_file

pytestmark = pytest.mark.slow
RECORDED = """
    from support.inner_sessions import draw_quickly

    @pytest.mark.parametrize('speed', [0.5])
    def test_fails(lockstep, robot_at, recorded_run, speed):
        robot_at()
        twist = Twist()
        twist.linear.x = speed
        lockstep.publish('cmd_vel', twist)
        lockstep.run_for(0.2)
        assert False

    def test_kept_by_hand(lockstep, robot_at, recorded_run, monkeypatch):
        draw_quickly(monkeypatch)
        robot_at()
        lockstep.run_for(0.2)
        first = recorded_run.keep()
        lockstep.run_for(0.2)
        assert recorded_run.keep() == first
        assert False, first

    def test_finished_by_hand(lockstep, robot_at, recorded_run):
        robot_at()
        assert recorded_run.finish() == recorded_run.bag
        assert recorded_run.bag.is_dir()
"""


def test_run_of_a_failed_test_is_kept_and_of_others_is_not(pytester):
    result = run_inner(pytester, RECORDED, '--basetemp=kept')
    result.assert_outcomes(failed=2, passed=1)
    folders = sorted(path.name for path in (pytester.path / 'kept').iterdir() if 'test_' in path.name)
    assert folders == ['test_0.test_fails-0.5', 'test_0.test_kept_by_hand']
    failed, by_hand = (pytester.path / 'kept' / name / 'run' for name in folders)
    run_of_it = read_run(failed)
    assert len(run_of_it.odometry) >= 10
    assert verify(run_of_it).holds(1e-9, 1e-9)
    # Kept once, and not after that.
    assert len(read_run(by_hand).odometry) == 11
    assert failed.with_suffix('.png').read_bytes().startswith(b'\x89PNG')
    for bag in (failed, by_hand):
        assert f'\n{bag}\n{bag}.png\n' in result.stdout.str()
        assert sorted(path.name for path in bag.parent.iterdir()) == ['run', 'run.png']


FAILS_OR_PASSES = """
    import os

    def test_drives(lockstep, robot_at, recorded_run):
        robot_at()
        lockstep.run_for(0.1)
        assert 'FAIL' not in os.environ
"""


def test_recordings_go_to_the_directory_of_the_option_and_replace_those_of_before(pytester, monkeypatch):
    draw_quickly(monkeypatch)
    pytester.makeini('[pytest]\nlockstep_artifacts = artifacts')
    pytester.makepyfile(test_it=SETTING + FAILS_OR_PASSES)
    place = pytester.path / 'artifacts' / 'test_it.test_drives'
    monkeypatch.setenv('FAIL', '1')
    for _ in range(2):
        pytester.runpytest_inprocess(*OPTIONS).assert_outcomes(failed=1)
        assert sorted(path.name for path in place.iterdir()) == ['run', 'run.png']
        # As a test leaves it that was killed.
        (place / 'run.journal.mcap').touch()
    monkeypatch.delenv('FAIL')
    pytester.runpytest_inprocess(*OPTIONS).assert_outcomes(passed=1)
    assert not place.exists()
    monkeypatch.setenv('FAIL', '1')
    pytester.runpytest_inprocess(*OPTIONS, '--lockstep-artifacts=others').assert_outcomes(failed=1)
    assert (pytester.path / 'others' / place.name / 'run' / 'metadata.yaml').exists()
    # Never anything that is not ours.
    (place / 'run').mkdir(parents=True)
    (place / 'run' / 'notes.txt').touch()
    result = pytester.runpytest_inprocess(*OPTIONS)
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(['*FileExistsError: *run exists already and is not a bag*'])
    assert (place / 'run' / 'notes.txt').exists()


def test_artifacts_have_the_names_of_the_tests():
    assert artifact_name('tests/a.py::TestArm::test_b[0.5-left]') == 'tests.a.TestArm.test_b-0.5-left'
    assert name_beside_the_file('tests/test_a.py::test_b[y]') == 'test_a.test_b-y'
    assert name_beside_the_file('tests/test_a.py::test_b[x/y]').startswith('test_a.test_b-x_y-')
    awkward = [
        *('a.py::t[x/y]', 'a.py::t[x_y]', 'a.py::t[x y]', 'a.py::t[]', 'a.py::t[..]', 'a.py::t[\\x00é]'),
        *(f'a.py::t[{"x" * 300}]', f'a.py::t[{"x" * 301}]', '../a.py::t', 'a.py::t[x:"<>|*?\r\n]'),
    ]
    names = [artifact_name(one) for one in awkward]
    assert len({*names}) == len(names)
    for one in names:
        assert len(one) <= MAX_LENGTH
        assert one == one.strip('.') or one.endswith('..')
        assert not set(one) - set('abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_.+-')
