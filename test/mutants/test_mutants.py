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

"""The program that changes the package and runs its tests, on a package of one function."""

from __future__ import annotations

import ast
import os
from dataclasses import replace
from pathlib import Path

import pytest
from mutation import Mutant, Statements, mutated
from support.processes import run_python

LAW = '''
GAIN: float = 2.0


def speed(distance, *, limit=1.0):
    """Return 2.0 * distance."""
    if distance > limit:
        raise ValueError(f'too far: {distance + limit}')
    return GAIN * distance
'''
SPEED = Mutant(
    *('laws', 'laws/law.py', 'speed', 'return GAIN * distance', 'return GAIN / distance', 'operator'),
)
TESTS = """
from laws.law import speed

def test_speed():
    assert speed(1.0) == 2.0

def test_half():
    assert speed(0.5) == 1.0
"""


RUN = """
import sys
from pathlib import Path

import mutants
from mutation import Mutant

mutants.ROOT, mutants.SOURCE = Path.cwd(), Path('toy').absolute()
mutants.GRACE, mutants.SLOWER = 0.3, 1.0
sys.path.insert(0, str(mutants.SOURCE))
for mutant, tests in eval(sys.argv[1]):
    names = [f'test/test_speed.py::{name}' for name in tests]
    coverage = mutants.Coverage(cpu=dict.fromkeys(names, 0.1), lines={'laws/law.py': {9: names}})
    ((_, outcome),) = mutants.run_mutants([mutant], coverage, 1)
    print(outcome.result, outcome.by)
"""


@pytest.mark.process
def test_a_mutant_is_killed_by_the_test_that_notices_it_and_survives_without(tmp_path):
    """In a process of its own: it forks, which one that has run nodes must not do."""
    (tmp_path / 'toy' / 'laws').mkdir(parents=True)
    (tmp_path / 'toy' / 'laws' / 'law.py').write_text(LAW)
    (tmp_path / 'test').mkdir()
    (tmp_path / 'test' / 'test_speed.py').write_text(TESTS)
    cases = {
        'killed test/test_speed.py::test_half': (SPEED, ['test_speed', 'test_half']),
        'survived ': (SPEED, ['test_speed']),
        'untested ': (SPEED, []),
        'gone ': (replace(SPEED, statement='return distance'), ['test_speed']),
        'timeout test/test_speed.py::test_speed': (replace(SPEED, mutant='while True:'), ['test_speed']),
    }
    path = {**os.environ, 'PYTHONPATH': str(Path(__file__).parent)}
    ended = run_python(RUN, repr([*cases.values()]), cwd=tmp_path, env=path)
    assert ended.stdout.splitlines() == [*cases], ended.stderr


def test_a_statement_is_found_in_another_file_and_function_if_it_is_the_only_one():
    moved = ast.parse(LAW.replace('def speed', 'def velocity'))
    assert Statements({'laws/other.py': moved}).find(SPEED).function == 'velocity'
    assert Statements({'laws/law.py': moved, 'laws/other.py': moved}).find(SPEED) is None


def test_numbers_conditions_and_statements_change_but_no_text_the_same_ones_for_a_seed():
    statements = Statements({'laws/law.py': ast.parse(LAW)})
    samples = [statements.sample('laws', 9, seed) for seed in range(100)]
    assert samples == [statements.sample('laws', 9, seed) for seed in range(100)]
    assert {mutant.mutant for sample in samples for mutant in sample} == {
        *('GAIN: float = 4.0', 'def speed(distance, *, limit=2.0):', 'pass', 'return None'),
        *('if distance >= limit:', 'if distance < limit:', 'if not distance > limit:'),
        *('return GAIN / distance',),
    }


def test_a_changed_module_has_the_same_lines():
    original = ast.parse(LAW)
    changed = mutated(original, Statements({'laws/law.py': original}).find(SPEED), SPEED)
    assert ast.unparse(changed) == ast.unparse(ast.parse(LAW.replace('GAIN *', 'GAIN /')))
    lines, changed_lines = (
        [(type(node), node.lineno) for node in ast.walk(each) if isinstance(node, ast.stmt)]
        for each in (original, changed)
    )
    assert changed_lines == lines
