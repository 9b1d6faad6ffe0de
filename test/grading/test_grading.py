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

"""Exercises with their solutions, and tables of many hand-ins."""

from __future__ import annotations

import csv
import importlib
import inspect
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image
from support.commands import refused, run

from diffdrive_jacobian.grading.grader import exercises, find_exercise
from diffdrive_jacobian.grading.hand_in import HandIn

pytestmark = pytest.mark.process

PAGE = Path(__file__).parents[2] / 'doc' / 'solutions.md'
SOLUTIONS = dict(re.findall(r'```python\n# (\w+)\.py\n(.*?)```', PAGE.read_text(), flags=re.DOTALL))
WRONG = {
    'wheels': [
        ('jacobian turning_in_place', 'r / L, -r / L', '-r / L, r / L'),
        ('inverse', '1 / r, -L', '1 / r, L'),
    ],
    'angles': [
        ('wrap bearing_error', 'np.arctan2(np.sin(angle), np.cos(angle))', 'angle % (2 * np.pi)'),
        ('arrays', 'np.arctan2(np.sin(angle), np.cos(angle))', 'math.remainder(angle, math.tau)'),
    ],
    'gains': [
        ('gains', '6.0, 1.5', '1.5, 6.0'),
        ('error_rate', 'e + kv', 'e - kv'),
        ('turns_to_goal', 'kp > kv', 'kp > kv / 2'),
    ],
    'three_laws': [
        ('straight', 'math.hypot(dx, dy), 3.0 * error', 'math.hypot(dx, dy), 0.01'),
        ('as_short_as_others', 'return 0.0, 3.0 * error', 'return -0.5, 3.0 * error'),
        ('corners', '0.5 * math.hypot', '0.005 * math.hypot'),
    ],
    'offset_point': [
        ('inverse', '-sine / d', 'sine / d'),
        ('jacobian', '-d * sine', 'd * sine'),
        ('law', 'k * (np', 'np.array([k, k / 2]) * (np'),
    ],
    'damping': [
        ('damped_inverse bounded', 'damping**2', 'damping'),
        ('damped_inverse', 'damping**2', '0.04'),
        (
            'bounded',
            'return J.T @ np',
            'return np.eye(2) / (2 * damping) if len(J.T) == 2 else J.T @ np',
        ),
        ('jacobian', '-reach[1], reach', '-steps[1], steps'),
    ],
    'null_space': [
        ('task', '+ projector(J) @ wanted', '+ wanted'),
        ('wanted', '+ projector(J) @ wanted', ''),
        ('projector', '- np.linalg.pinv(J) @ J', '- J.T @ J'),
    ],
    'limits': [
        ('limited limited_wheels', 'v / scale, omega / scale', 'v / scale, omega'),
        ('gains', '3.0 * max_omega', '0.1 * max_omega'),
    ],
    'eight': [
        ('errors', 'cosine * dx + sine', 'cosine * dx - sine'),
        ('on_the_path eight slip', '2.0 * along, omega', '2.0 * along, 0.5 * omega'),
    ],
    'lost_odometry': [
        ('old_pose in_lockstep', 'age > 0.3', 'age > 3.0'),
        ('before_odometry', 'pose is None or ', ''),
    ],
}
"""Tests that notice a mistake, what is right, and what students may write."""


def named_tests(exercise):
    """Return the tests of an exercise of this package by their names."""
    module = importlib.import_module(f'diffdrive_jacobian.exercises.{exercise}')
    return {name[5:]: value for name, value in vars(module).items() if name.startswith('test_')}


def try_tests(tmp_path, exercise, source, names):
    """Call tests of an exercise with a hand-in; return those that fail."""
    file, failed = tmp_path / 'hand_in.py', []
    file.write_text(source)
    for name in names:
        test, hand_in = named_tests(exercise)[name], HandIn(file)
        draws = 'save_picture' in inspect.signature(test).parameters
        try:
            test(hand_in, *[bool] * draws)
        except AssertionError:
            failed.append(name)
        finally:
            hand_in.close()
    return failed


def test_each_exercise_is_complete():
    assert exercises() == sorted(SOLUTIONS)
    for exercise in SOLUTIONS:
        tests = named_tests(exercise)
        assert {*' '.join(names for names, *_ in WRONG[exercise]).split()} == {*tests}
        assert all('points' in [mark.name for mark in test.pytestmark] for test in tests.values())


@pytest.mark.parametrize('exercise', sorted(SOLUTIONS))
def test_a_solution_passes(tmp_path, exercise):
    assert try_tests(tmp_path, exercise, SOLUTIONS[exercise], named_tests(exercise)) == []


@pytest.mark.parametrize(
    ('exercise', 'names', 'right', 'wrong'),
    [(exercise, *one) for exercise, mistakes in WRONG.items() for one in mistakes],
)
def test_a_mistake_is_noticed(tmp_path, exercise, names, right, wrong):
    source = SOLUTIONS[exercise]
    assert right in source
    assert try_tests(tmp_path, exercise, source.replace(right, wrong), names.split()) == names.split()


def grade(exercise, folder, sources, *options):
    """Grade the hand-ins of files of a folder, and return the output and the rows of the table."""
    files = [os.fsencode(folder) + b'/' + name for name in sources]
    for file, source in zip(files, sources.values(), strict=True):
        os.makedirs(os.path.dirname(file), exist_ok=True)
        with open(file, 'w') as opened:
            opened.write(source)
    names, table = map(os.fsdecode, files), folder / 'points.csv'
    ended = run('grade_hand_ins', exercise, *names, '--csv', table, *options)
    assert ended.err == ''
    return ended, list(csv.DictReader(table.read_text().splitlines()))


EXERCISE = """
import pytest
from diffdrive_jacobian.grading import agree

@pytest.mark.points(2)
def test_twice(hand_in):
    '''Twice a number.'''
    agree(hand_in.call('twice', 3.0), 6.0, 'twice(3)')

def test_thrice(hand_in, save_picture):
    '''Three times a number.'''
    from matplotlib.figure import Figure
    agree(hand_in.call('thrice', 3.0), 9.0, 'thrice(3)')
    save_picture(Figure)

@pytest.mark.skip('no robot')
@pytest.mark.points(5)
def test_robot(hand_in):
    '''A robot.'''
"""


def test_a_table_has_points_and_reasons_that_no_spreadsheet_obeys(tmp_path):
    """Also of files of one name, and of names and texts that are no UTF-8."""
    exercise = tmp_path / 'exercise.py'
    exercise.write_text(EXERCISE)
    twice = 'def twice(a): return 2 * a\ndef thrice(a): '
    sources = {
        b'anna/mine.py': f'{twice}return 3 * a\n',
        b'bert/mine.py': f'{twice}raise ValueError("=cmd()")\n',
        b'slow.py': 'import time\ndef twice(a): time.sleep(60)\n',
        b'socket.py': 'import socket\n',
        b'bad\xff.py': 'def twice(a): raise ValueError("\\ud800")',
    }
    pictures = tmp_path / 'pictures'
    ended, rows = grade(exercise, tmp_path, sources, '--pictures', pictures)
    assert ended.code == 0
    assert [row['points'] for row in rows] == ['3', '2', '0', '0', '0']
    assert {row['of'] for row in rows} == {'3'}
    assert [rows[1][name] for name in ('twice', 'thrice', 'robot')] == ['2', '0', '0']
    assert rows[0]['reasons'] == 'A robot: not graded: no robot'
    assert 'Three times a number: thrice(3): ValueError: =cmd()' in rows[1]['reasons']
    assert 'took longer than 5 s' in rows[2]['reasons']
    assert 'socket.py cannot be run: imports socket' in rows[3]['reasons']
    assert [one.name for one in pictures.iterdir()] == ['1_anna_mine.png']
    with Image.open(pictures / '1_anna_mine.png') as picture:
        assert picture.width > 100
    assert '3 of 3' in ended.out


LATE = """
import time, pytest

@pytest.mark.points(2)
def test_quick(hand_in): hand_in.call('f')

@pytest.mark.points(3)
def test_slow(hand_in): time.sleep(60)
"""


def test_what_was_earned_before_the_time_was_over_counts(tmp_path):
    exercise = tmp_path / 'late.py'
    exercise.write_text(LATE)
    ended, (row,) = grade(exercise, tmp_path, {b'anna.py': 'def f(): pass\n'}, '--timeout', 4)
    assert ended.code == 1
    assert (row['points'], row['of'], row['quick'], row['slow']) == ('2', '5', '2', '0')
    assert 'not graded in time' in row['reasons']
    assert 'took longer than 4 s' in row['reasons']


def test_mistakes_of_the_lecturer_are_named(tmp_path):
    (tmp_path / 'broken.py').write_text('1 / 0\n')
    (tmp_path / 'empty.py').write_text('')
    (tmp_path / 'anna.py').write_text('')
    anna = tmp_path / 'anna.py'
    assert 'EXERCISE must be a file, or one of angles' in refused('grade_hand_ins', 'whels', anna)
    assert 'there is no exercise' in refused('grade_hand_ins', tmp_path / 'none.py', anna)
    assert 'there is no hand-in' in refused('grade_hand_ins', 'wheels', tmp_path / 'none.py')
    for name, words in (('broken', 'ZeroDivisionError'), ('empty', 'grades nothing')):
        assert words in refused('grade_hand_ins', tmp_path / f'{name}.py', anna, code=1)
    (tmp_path / 't.csv').write_text('')
    assert 'exists already' in refused('grade_hand_ins', 'wheels', anna, '--csv', tmp_path / 't.csv')


def test_the_same_by_pytest_alone(tmp_path):
    (tmp_path / 'anna.py').write_text(SOLUTIONS['wheels'].replace('r / L, -r / L', 'r, r'))
    command = [sys.executable, '-m', 'pytest', '-q', '-p', 'no:cacheprovider', find_exercise('wheels')]
    ended = subprocess.run(
        [*command, '--hand-in', 'anna.py'], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 1
    assert 'anna.py: 2 of 5 points' in ended.stdout
    assert '0/2  J_w maps the speeds of the right and the left wheel to v and omega: ' in ended.stdout
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert 'give it by --hand-in FILE' in ended.stdout
