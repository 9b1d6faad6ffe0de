"""The program that changes the package and runs its tests, on a package of one function."""

from __future__ import annotations

import ast
from dataclasses import replace

import mutants
import pytest
from mutation import Mutant, Statements, mutated

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

def test_half_of_the_speed():
    assert speed(0.5) == 1.0
"""


@pytest.fixture
def run(tmp_path, monkeypatch):
    """What becomes of a mutant of another package if some tests execute its last line."""
    (tmp_path / 'toy' / 'laws').mkdir(parents=True)
    (tmp_path / 'toy' / 'laws' / 'law.py').write_text(LAW)
    (tmp_path / 'test').mkdir()
    (tmp_path / 'test' / 'test_speed.py').write_text(TESTS)
    monkeypatch.setattr(mutants, 'ROOT', tmp_path)
    monkeypatch.setattr(mutants, 'SOURCE', tmp_path / 'toy')
    monkeypatch.syspath_prepend(tmp_path / 'toy')

    def run(mutant, *tests):
        names = [f'test/test_speed.py::{name}' for name in tests]
        lines = {'laws/law.py': {9: names}}
        coverage = mutants.Coverage(cpu=dict.fromkeys(names, 0.1), lines=lines)
        ((_, outcome),) = mutants.run_mutants([mutant], coverage, 1)
        return outcome

    return run


def test_a_mutant_is_killed_by_the_test_that_notices_it_and_survives_without(run):
    both = run(SPEED, 'test_speed', 'test_half_of_the_speed')
    assert both.result == 'killed'
    assert both.by == 'test/test_speed.py::test_half_of_the_speed'
    assert run(SPEED, 'test_speed').result == 'survived'
    assert run(SPEED).result == 'untested'
    assert run(replace(SPEED, statement='return distance'), 'test_speed').result == 'gone'


def test_a_mutant_that_does_not_end_is_stopped(run, monkeypatch):
    monkeypatch.setattr(mutants, 'GRACE', 0.3)
    monkeypatch.setattr(mutants, 'SLOWER', 1.0)
    assert run(replace(SPEED, mutant='while True:'), 'test_speed').result == 'timeout'


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
