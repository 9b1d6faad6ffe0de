"""What an exploration prints about its findings, and what it writes and removes in its folder."""

from __future__ import annotations

import re
import shutil
from concurrent.futures import Future
from dataclasses import dataclass, replace

import pytest
from exploration_scenarios import Follower, Sensor, follow, robot
from hypothesis import strategies as st

from diffdrive_jacobian.exploration.child import _picklable
from diffdrive_jacobian.exploration.worker import result_of
from diffdrive_jacobian.faults import Hang, Loss
from diffdrive_jacobian.plots import run_figure
from diffdrive_jacobian.plots.fault_marks import VIOLATION
from diffdrive_jacobian.properties import NeverFasterThan, Property, StaysNear, Watch
from diffdrive_jacobian.testing import (
    ExplorationError,
    Lockstep,
    PropertyViolation,
    SerialExecutor,
    explore,
    fault_schedules,
)


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


TEST = 'test_no_exception_assertion_error.py'


def lay(folder, **files):
    """Write files with a name and an extension each, or below `run`."""
    for name, text in files.items():
        path = folder / name.replace('__', '/').replace('_json', '.json').replace('_py', '.py')
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def with_link(folder, name, target):
    """Replace a file or folder of a finding by a link to one with the same contents."""
    target.parent.mkdir(exist_ok=True)
    (folder / name).rename(target)
    (folder / name).symlink_to(target)


IN_THE_WAY = {
    'a case of somebody else': lambda folder, own: lay(folder, counterexample_json='{}', run__data='1'),
    'a bag': lambda folder, own: lay(folder, run__data='1'),
    'a note': lambda folder, own: lay(folder, notes='1'),
    'a file': lambda folder, own: folder.write_text('1'),
    'a link to a folder': lambda folder, own: (own.mkdir(), folder.symlink_to(own)),
    'a link to nothing': lambda folder, own: folder.symlink_to(own),
    'an unreadable mark': lambda folder, own: lay(folder, **{'.written_by_explore': '\0\n\n  \n../x'}),
}
"""What is in the place of a folder before anything was written."""
CHANGED = {
    'the case': lambda folder, own: (folder / 'counterexample.json').write_text('{}'),
    'the test': lambda folder, own: (folder / TEST).write_text('mine = 1\n'),
    'the test, renamed': lambda folder, own: (folder / TEST).rename(folder / 'test_mine.py'),
    'the bag': lambda folder, own: (folder / 'run' / 'metadata.yaml').write_text('mine'),
    'a file in the bag': lambda folder, own: (folder / 'run' / 'mine').touch(),
    'a link in the bag': lambda folder, own: (folder / 'run' / 'mine').symlink_to(own),
    'a link for the bag': lambda folder, own: with_link(folder, 'run', own / 'run'),
    'a link for the test': lambda folder, own: with_link(folder, TEST, own / TEST),
    'a link for the folder': lambda folder, own: with_link(
        folder.parent, folder.name, own / folder.name
    ),
    'another name': lambda folder, own: folder.rename(folder.with_name('Mine')),
}
"""What a user has done with a folder that was written."""


def contents(folder):
    """Return all files and folders with what is in them."""
    return {
        path: path.readlink() if path.is_symlink() else path.is_dir() or path.read_bytes()
        for path in folder.rglob('*')
    }


@pytest.mark.parametrize('what', IN_THE_WAY)
def test_what_somebody_else_has_written_stays(tmp_path, what):
    folder = tmp_path / 'found' / 'NoExceptionAssertionError'
    folder.parent.mkdir()
    IN_THE_WAY[what](folder, tmp_path / 'own')
    before = contents(tmp_path)
    (finding,) = serial(failing, cases=st.just(70), worlds=1, output=folder.parent).findings
    assert finding.directory == folder.with_name(f'{folder.name}_2')
    assert contents(tmp_path).items() >= before.items()
    serial(failing, cases=st.just(1), worlds=1, output=folder.parent)
    assert contents(tmp_path) == before


@pytest.fixture(scope='module')
def written(tmp_path_factory):
    """Return the folder of a finding, to be copied."""
    found = serial(failing, cases=st.just(70), worlds=1, output=tmp_path_factory.mktemp('written'))
    return found.findings[0].directory


@pytest.mark.parametrize('what', CHANGED)
def test_what_a_user_has_changed_stays(tmp_path, written, what):
    """With the rest of its folder: a changed test needs the case."""
    folder = tmp_path / 'found' / written.name
    shutil.copytree(written, folder)
    CHANGED[what](folder, tmp_path / 'own')
    before = contents(tmp_path)
    serial(failing, cases=st.just(1), worlds=1, output=folder.parent)
    assert contents(tmp_path) == before
    (finding,) = serial(failing, cases=st.just(70), worlds=1, output=folder.parent).findings
    assert (finding.directory == folder) == (what == 'another name')
    assert contents(tmp_path).items() >= before.items()


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


class SilentError(Exception):
    """Cannot be described."""

    def __str__(self):
        raise ValueError('of a bug')

    __repr__ = __str__


@dataclass(frozen=True, repr=False)
class Garbled(Property):
    """Is never satisfied, and says so with characters that no file of Python may contain."""

    text: str

    def watch(self, world):
        watch = Watch(world)
        watch.found(self.text)
        return watch


UNPRINTABLE = '"""a\0\x1b\ud800\\N{x}\ud83d"'
ERRORS = {
    'text': lambda: ValueError(UNPRINTABLE),
    'no text': SilentError,
    'key without text': lambda: KeyError(SilentError()),
}


def garbled(world, case):
    """Raise the error of a case, if it names one."""
    world.create(lambda: Sensor(0.0))
    world.run_for(0.1)
    if case in ERRORS:
        raise ERRORS[case]()


@pytest.mark.parametrize('case', [*ERRORS, UNPRINTABLE])
def test_whatever_an_error_is_its_finding_is_kept(tmp_path, case):
    """The written test can be imported, and reproduces it."""
    properties = [] if case in ERRORS else [Garbled(UNPRINTABLE)]
    made = [create() for create in ERRORS.values()]
    found = serial(garbled, properties, cases=st.just(case), worlds=1, output=tmp_path / 'Ω')
    (finding,) = found.findings
    assert finding.deterministic
    str(found).encode()
    (file,) = finding.directory.glob('test_*.py')
    module = {'__file__': str(file)}
    exec(compile(file.read_bytes(), file, 'exec'), module)
    assert module['CASE'] == case
    reproduce = module[file.stem]
    with Lockstep() as world, pytest.raises((PropertyViolation, *map(type, made))) as error:
        reproduce(world)
    assert 'the same as found, bit for bit' in error.value.__notes__[0]


def test_an_error_without_text_of_a_process_is_reported():
    class LocalError(SilentError):
        """Cannot be pickled, either."""

    future = Future()
    future.set_exception(_picklable(LocalError()))
    with pytest.raises(ExplorationError, match='could not be run: RuntimeError: LocalError: '):
        result_of(future, None)
    future = Future()
    future.set_exception(LocalError())
    with pytest.raises(ExplorationError, match='could not be run: LocalError: '):
        result_of(future, None)


def test_a_long_property_does_not_hide_what_was_found(tmp_path):
    near = StaysNear([(0.1 * number, 5.0) for number in range(61)], 0.1)
    found = serial(robot, [near], worlds=1, output=tmp_path)
    (finding,) = found.findings
    assert finding.violation.key == repr(near)
    assert len(str(finding)) < 1000
    title = next(finding.directory.glob('test_*.py')).read_text().partition('\n')[0]
    assert re.fullmatch(r'"""StaysNear.{1,200}\.\.\. is violated at [\d.]+ s\.', title)


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
