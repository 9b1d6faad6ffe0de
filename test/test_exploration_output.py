"""What an exploration prints about its findings, and what it writes and removes in its folder."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace

import pytest
from exploration_scenarios import Follower, Sensor, follow, robot
from hypothesis import strategies as st

from diffdrive_jacobian.exploration import SerialExecutor, explore, fault_schedules
from diffdrive_jacobian.faults import Hang, Loss
from diffdrive_jacobian.plots import run_figure
from diffdrive_jacobian.plots.fault_marks import VIOLATION
from diffdrive_jacobian.properties import NeverFasterThan


def serial(scenario, properties=(), **arguments):
    return explore(scenario, properties, **{'executor': SerialExecutor(), **arguments})


def failing(world, case):
    assert case < 60


class Interrupting(SerialExecutor):
    """Presses Ctrl-C."""

    def submit(self, fn, /, *args, **kwargs):
        raise KeyboardInterrupt


def test_what_was_not_found_again_is_removed(tmp_path):
    """Only what an exploration has written, not what the user has added, renamed or copied."""
    output = tmp_path / 'found'
    folder = serial(failing, cases=st.just(70), worlds=1, output=output).findings[0].directory
    for kept in ('kept', 'CopiedTest'):
        shutil.copytree(folder, output / kept)
    (output / 'CopiedTest' / 'test_copied_test.py').write_text('own = 1\n')
    (output / 'other' / 'run').mkdir(parents=True)
    (output / 'other' / 'test_other.py').write_text('own = 1\n')
    compiled = folder / '__pycache__' / 'test_no_exception_assertion_error.cpython-312.pyc'
    compiled.parent.mkdir()
    compiled.touch()
    before = {path for path in output.rglob('*') if not path.is_relative_to(folder)}
    stopped = serial(failing, executor=Interrupting(), output=output)
    assert stopped.stopped == 'interrupted'
    assert folder.exists()
    assert serial(failing, cases=st.just(1), worlds=1, output=output).findings == ()
    assert set(output.rglob('*')) == before
    found = serial(failing, cases=st.just(70), worlds=1, output=output)
    (found.findings[0].directory / 'notes.txt').write_text('mine')
    serial(failing, cases=st.just(1), worlds=1, output=output)
    assert [path.name for path in folder.iterdir()] == ['notes.txt']


def unfinished(world, case):
    """Wait in vain, while a fault acts."""
    world.create(lambda: Sensor(0.0))
    world.create(Follower)
    world.run_until(lambda: False, timeout=0.3, what='the last corner')


def test_an_exception_is_described_by_its_first_line(tmp_path):
    """Not by the last line of the report that follows it."""
    loss = Loss('speed', start=0.1, duration=0.1)
    found = serial(unfinished, faults=st.just([loss]), worlds=1, output=tmp_path)
    (finding,) = found.findings
    expected = 'LockstepError: not within 0.3 s of simulated time: the last corner'
    assert finding.violation.headline == expected
    assert re.fullmatch(
        r'LockstepError in test_exploration_output.py:\d+ \(unfinished\)', finding.violation.key
    )
    assert f'\n  failed at 0.3 s: {expected}\n' in str(finding)
    source = next(finding.directory.glob('test_*.py')).read_text()
    assert source.startswith(f'"""{finding.violation.key}, at 0.3 s.\n\n{expected}\n\n')


def test_the_picture_marks_the_violation(tmp_path, monkeypatch):
    """At its time since the first odometry, with the name of the property."""
    drawn = []
    monkeypatch.setattr(run_figure, 'render', lambda one, ending: drawn.append(one) or b'')
    fast = NeverFasterThan(0.2, 1.0)
    (finding,) = serial(robot, [fast], worlds=1, output=tmp_path).findings
    (drawing,) = drawn
    (legend,) = drawing.legends
    assert [text.get_text() for text in legend.get_texts()] == [f'violated: {fast!r}']
    marks = [line for line in drawing.axes[1].lines if line.get_color() == VIOLATION]
    assert [line.get_xdata()[0] for line in marks] == pytest.approx(
        [finding.violation.seconds], abs=0.05
    )


def test_faults_without_effect_are_noted_once_for_each_name():
    schedules = fault_schedules(['typo'], ['follwer'], kinds=[Loss, Hang], max_faults=2, duration=1.0)
    found = serial(follow, faults=schedules, worlds=12)
    notes = re.findall(r'^note: (.*) \(\d+ of 12 worlds\)$', str(found), re.MULTILINE)
    assert sorted(notes) == [
        'a fault had no effect: no node /follwer was seen',
        'a fault had no effect: no subscription of /typo was seen',
    ]


def test_many_notes_are_counted():
    found = serial(failing, cases=st.just(1), worlds=1)
    text = str(replace(found, notes=tuple(f'note {number}' for number in range(14))))
    assert text.count('\nnote: ') == 11
    assert 'note: and 4 more notes' in text
