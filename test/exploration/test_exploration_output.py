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

"""What an exploration writes and removes in its folder, and how a finding is described there."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import dataclass

import pytest
from exploration_scenarios import Follower, Sensor, failing, moving, robot, serial
from geometry_msgs.msg import Twist
from hypothesis import strategies as st

from diffdrive_jacobian.bags.bag_reader import open_bag
from diffdrive_jacobian.exploration.output import remove_others, write_finding
from diffdrive_jacobian.faults import Loss
from diffdrive_jacobian.plots import rendering
from diffdrive_jacobian.plots.run_panels import VIOLATION
from diffdrive_jacobian.properties import FieldWithin, NeverFasterThan, Property, StaysNear
from diffdrive_jacobian.testing import Lockstep, SerialExecutor

pytestmark = pytest.mark.slow
TEST = 'test_no_exception_assertion_error.py'


def explored(output, case=70):
    """Explore one world in which a scenario fails, if the case is large."""
    return serial(failing, cases=st.just(case), worlds=1, output=output).findings


# --- Folders


@pytest.fixture(scope='module')
def written(tmp_path_factory):
    """Return a finding, whose folder is to be copied."""
    return explored(tmp_path_factory.mktemp('written'))[0]


class Interrupting(SerialExecutor):
    """Presses Ctrl-C."""

    def submit(self, fn, /, *args, **kwargs):
        raise KeyboardInterrupt


def test_another_exploration_replaces_only_what_was_written(tmp_path, written):
    """Not what the user has added, renamed or copied. One that is interrupted removes nothing."""
    output = tmp_path / 'found'
    folder = output / written.directory.name
    for copied in (folder, output / 'kept', output / 'CopiedTest'):
        shutil.copytree(written.directory, copied)
    (output / 'CopiedTest' / 'test_copied_test.py').write_text('own = 1\n')
    compiled = folder / '__pycache__' / 'test_no_exception_assertion_error.cpython-312.pyc'
    compiled.parent.mkdir()
    compiled.touch()
    before = {path for path in output.rglob('*') if not path.is_relative_to(folder)}
    assert serial(failing, executor=Interrupting(), output=output).stopped == 'interrupted'
    assert folder.exists()
    assert explored(output, 1) == ()
    assert set(output.rglob('*')) == before
    explored(output)
    (folder / 'notes.txt').write_text('mine')
    explored(output, 80)
    assert json.loads((folder / 'counterexample.json').read_text())['case'] == '80'
    explored(output, 1)
    assert [path.name for path in folder.iterdir()] == ['notes.txt']


def test_a_relative_output_stays_beside_files_of_others(tmp_path, monkeypatch):
    precious = tmp_path / 'found' / 'NoExceptionValueError' / 'run' / 'precious'
    precious.parent.mkdir(parents=True)
    precious.touch()
    monkeypatch.chdir(tmp_path)
    (finding,) = serial(moving, worlds=1, output='found').findings
    assert precious.exists()
    assert finding.directory == tmp_path / 'found' / 'NoExceptionValueError_2'
    assert (finding.directory / 'run').is_dir()


def lay(folder, name, text='1'):
    """Write a file."""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def replace_by_link(path, own):
    """Replace a file or folder by a link to one with the same contents."""
    own.mkdir()
    path.rename(own / path.name)
    path.symlink_to(own / path.name)


IN_THE_WAY = {
    'a case of somebody else': lambda folder, own: lay(folder, 'counterexample.json', '{}'),
    'a file': lambda folder, own: folder.write_text('1'),
    'a link to a folder': lambda folder, own: (own.mkdir(), folder.symlink_to(own)),
    'a link to nothing': lambda folder, own: folder.symlink_to(own),
    'an unreadable mark': lambda folder, own: lay(folder, '.written_by_explore', '\0\n\n  \n../x'),
}
"""What is in the place of a folder before anything was written."""
CHANGED = {
    'the case': lambda folder, own: lay(folder, 'counterexample.json', '{}'),
    'the test': lambda folder, own: lay(folder, TEST, 'mine = 1\n'),
    'the test, renamed': lambda folder, own: (folder / TEST).rename(folder / 'test_mine.py'),
    'the bag': lambda folder, own: lay(folder, 'run/metadata.yaml', 'mine'),
    'a file in the bag': lambda folder, own: lay(folder, 'run/mine'),
    'a link in the bag': lambda folder, own: (folder / 'run' / 'mine').symlink_to(own),
    'a link for the bag': lambda folder, own: replace_by_link(folder / 'run', own),
    'a link for the test': lambda folder, own: replace_by_link(folder / TEST, own),
    'a link for the folder': lambda folder, own: replace_by_link(folder, own),
    'another name': lambda folder, own: folder.rename(folder.with_name('Mine')),
}
"""What a user has done with a folder that was written."""


def contents(folder):
    """Return all files and folders with what is in them."""
    return {
        path: path.readlink() if path.is_symlink() else path.is_dir() or path.read_bytes()
        for path in folder.rglob('*')
    }


@pytest.mark.parametrize('what', [*IN_THE_WAY, *CHANGED])
def test_what_somebody_else_has_written_stays(tmp_path, written, what):
    """With the rest of its folder: a changed test needs the case."""
    folder = tmp_path / 'found' / written.directory.name
    folder.parent.mkdir()
    if what in CHANGED:
        shutil.copytree(written.directory, folder)
    {**IN_THE_WAY, **CHANGED}[what](folder, tmp_path / 'own')
    before = contents(tmp_path)
    again = write_finding(written, folder.parent, [], seed=0)
    free = what == 'another name'
    assert again.directory == (folder if free else folder.with_name(f'{folder.name}_2'))
    assert again.notes == written.notes
    assert contents(tmp_path).items() >= before.items()
    remove_others(folder.parent, [])
    assert contents(tmp_path) == before


# --- Files and texts


def unfinished(world, case):
    """Wait in vain, while a fault acts."""
    world.create(lambda: Sensor(0.0))
    world.create(Follower)
    world.run_until(lambda: False, timeout=0.3, what='the last corner')


def test_a_case_a_bag_and_a_test_are_written(tmp_path):
    """An exception is described by its first line, not by the last one of the report after it."""
    loss = Loss('speed', start=0.1, duration=0.1)
    (finding,) = serial(unfinished, faults=st.just([loss]), worlds=1, output=tmp_path).findings
    expected = 'LockstepError: not within 0.3 s of simulated time: the last corner'
    assert finding.violation.headline == expected
    assert f'\n  failed at 0.3 s: {expected}\n' in str(finding)
    folder = finding.directory
    assert folder.name == 'NoExceptionLockstepError'
    case = json.loads((folder / 'counterexample.json').read_text())
    assert case['faults'] == ["Loss('speed', start=0.1, duration=0.1)"]
    assert case['digest'] == finding.digest
    assert case['versions']['python']
    with open_bag(folder / 'run') as bag:
        assert {'/speed', '/cmd_vel', '/fault_events'} <= {one.topic for one in bag.connections}
    # There is no odometry, so nobody can draw it.
    assert finding.notes == ()
    source = (folder / 'test_no_exception_lockstep_error.py').read_text()
    assert source.startswith(f'"""{finding.violation.key}, at 0.3 s.\n\n{expected}\n\n')


UNPRINTABLE = '"""a\0\x1b\ud800\\N{x}\ud83d"'


class SilentError(Exception):
    """Cannot be described."""

    def __str__(self):
        raise ValueError('of a bug')

    __repr__ = __str__


@dataclass(repr=False)
class Garbled(Property):
    """Is never satisfied, and says so with characters that no file of Python may contain."""

    text: str

    def begin(self):
        self.found(self.text)


ERRORS = {
    'text': lambda: ValueError(UNPRINTABLE),
    'no text': SilentError,
    'key without text': lambda: KeyError(SilentError()),
}


def garbled(world, case):
    """Publish bytes that are no message, and raise the error of a case, if it names one."""
    world.node.create_publisher(Twist, 'cmd_vel', 10).publish(b'\0')
    world.run_for(0.1)
    if case in ERRORS:
        raise ERRORS[case]()


@pytest.mark.parametrize(
    ('case', 'properties'),
    [
        *((case, []) for case in ERRORS),
        (UNPRINTABLE, [Garbled(UNPRINTABLE)]),
        (None, [FieldWithin('cmd_vel', 'linear.x', -1.0, 1.0)]),
    ],
)
def test_whatever_an_error_is_its_finding_is_kept(tmp_path, case, properties):
    """The written test can be imported, and reproduces it."""
    found = serial(garbled, properties, cases=st.just(case), worlds=1, output=tmp_path / 'Ω')
    (finding,) = found.findings
    assert finding.deterministic
    assert finding.violation.index == len(properties) - 1
    str(found).encode()
    (file,) = finding.directory.glob('test_*.py')
    module = {'__file__': str(file)}
    exec(compile(file.read_bytes(), file, 'exec'), module)
    assert module['CASE'] == case
    with Lockstep() as world, pytest.raises(Exception) as error:  # noqa: PT011
        module[file.stem](world)
    assert 'the same as found, bit for bit' in error.value.__notes__[0]


def test_a_long_property_is_cut_and_the_picture_marks_the_time(tmp_path, monkeypatch):
    """At its time since the first odometry, with the name of the property."""
    drawn = []
    monkeypatch.setattr(rendering, 'render', lambda one, ending: drawn.append(one) or b'')
    near = StaysNear([(0.1 * number, 5.0) for number in range(61)], 0.1)
    fast = NeverFasterThan(0.2, 1.0)
    found = serial(robot, [near, fast], worlds=1, shrink_worlds=0, output=tmp_path).findings
    long, short = sorted(found, key=lambda one: one.violation.name, reverse=True)
    assert long.violation.key == repr(near)
    assert len(str(long)) < 1000
    title = next(long.directory.glob('test_*.py')).read_text().partition('\n')[0]
    assert re.fullmatch(r'"""StaysNear.{1,200}\.\.\. is violated at [\d.]+ s\.', title)
    drawing = drawn[found.index(short)]
    (legend,) = drawing.legends
    time, _, said = legend.get_texts()[-1].get_text().partition(' s: ')
    assert said == f'violated: {fast!r}'
    assert float(time) == pytest.approx(short.violation.seconds, abs=0.1)
    (mark,) = (line for line in drawing.axes[1].lines if line.get_color() == VIOLATION)
    assert mark.get_xdata()[0] == pytest.approx(short.violation.seconds, abs=0.05)
