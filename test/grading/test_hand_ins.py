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

"""A hand-in: what its functions return, what it may not do, and what the student reads then."""

from __future__ import annotations

import math
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from diffdrive_jacobian.grading import HandIn, HandInError, agree

pytestmark = pytest.mark.process


@pytest.fixture
def start(tmp_path):
    """Start a hand-in with a source."""
    started = []

    def starting(source, **how):
        file = tmp_path / 'anna.py'
        file.write_text(source, encoding='utf-8')
        started.append(HandIn(file, **{'seconds': 20.0, **how}))
        return started[-1]

    yield starting
    for one in started:
        one.close()


def test_arguments_and_results_are_numbers_texts_lists_and_arrays(start):
    hand_in = start('import numpy as np\nprint("x" * 10**6)\ndef same(one): return one\n')
    for value in (1, -0.1, True, None, 'é', [1.0, [2, 'a']], math.inf):
        assert hand_in.call('same', value) == value
    assert math.isnan(hand_in.call('same', math.nan))
    for array in (np.eye(2), np.zeros((0, 3)), np.float64(0.1)):
        found = hand_in.call('same', array)
        np.testing.assert_array_equal(found, array)
        assert np.shape(found) == np.shape(array)
    assert hand_in.has('same')
    assert not hand_in.has('other')
    np.testing.assert_array_equal(hand_in.array('same', [1, 2], shape=(2,)), [1.0, 2.0])


STUDENTS = {
    'a dataclass': b'from dataclasses import dataclass\n'
    b'@dataclass\nclass A:\n    r: float\ndef f(): return A(2.0).r\n',
    'annotations as texts': b'from __future__ import annotations\nfrom dataclasses import dataclass\n'
    b'@dataclass\nclass A:\n    r: float\ndef f(): return A(2.0).r\n',
    'a mark of the encoding': b'\xef\xbb\xbfdef f(): return 2.0\r\n',
    'Latin-1': b'# coding: latin-1\nl\xe4nge = 2.0\ndef f(): return l\xe4nge\n',
    'a part of a program': b'def f(): return 2.0\nif __name__ == "__main__":\n    f(1)\n',
    'masked arrays': b'import numpy as np\ndef f(): return np.ma.array([2.0]).sum()\n',
}
"""What students write, and their editors."""


@pytest.mark.parametrize('source', STUDENTS.values(), ids=STUDENTS)
def test_what_students_write_runs(tmp_path, source):
    file = tmp_path / 'anna.py'
    file.write_bytes(source)
    hand_in = HandIn(file, seconds=20.0)
    assert hand_in.call('f') == 2.0
    hand_in.close()


REFUSED = {
    'return open("/etc/passwd").read()': r'opens or changes a file \(line 3\)',
    'import io; return io.FileIO("/etc/passwd")': 'opens or changes a file',
    'import numpy; numpy.save("a.npy", numpy.eye(2))': 'opens or changes a file|uses os',
    'return os.listdir("/")': 'uses os.listdir, which a hand-in may not',
    'return os.open("/etc/passwd", 0)': 'uses os.open',
    'os.truncate("anna.py", 0)': 'uses os.truncate',
    'os.mkfifo("grades.json")': 'uses os.mkfifo',
    'os.kill(os.getppid(), 9)': 'uses os.getppid',
    'os.system("true")': 'uses os.system',
    'os.fork()': 'uses os.fork',
    'os._exit(0)': 'uses os._exit',
    'import sys; sys.modules["resource"].prlimit(1, 7, (0, 0))': 'changes files or other programs',
    'import sys; sys.modules["_signal"].raise_signal(9)': r'ended the process \(signal 9\)',
    'import diffdrive_jacobian': 'imports diffdrive_jacobian, and may import numpy',
    'import multiprocessing': 'imports multiprocessing',
    'from math import sinn': r"ImportError: cannot import name 'sinn' from 'math'.* \(line 3\)",
    'import sys; sys.modules["__main__"].raise_fence.__code__ = f.__code__': 'changes how Python works',
    'return input("?")': 'asks for input, which nobody answers',
    'raise SystemExit': 'SystemExit',
    'return 1 / 0': r'f\(\): ZeroDivisionError: division by zero \(line 3\)',
    'return {}': 'must return numbers, arrays, lists or texts, got dict',
    'return "x" * 10**7': 'must return less than 1000000 characters',
    'return f()': 'RecursionError',
    'raise type("E", (Exception,), {"__str__": lambda self: 1 / 0})': 'an error without a text',
    'raise ValueError("\\ud800")': 'ValueError',
    'while True: pass': 'took longer than 1 s: is there a loop without end',
    'import sys; sys._getframe(1).f_locals["answers"].write("[1]\\n" * 9)': 'written what is no answer',
    'import sys; sys._getframe(1).f_locals["answers"].write(\'["value", {"a": 1}]\\n\')': 'no answer',
}


@pytest.mark.parametrize('code', REFUSED)
def test_what_it_may_not_do_is_refused_in_words(start, code):
    hand_in = start(f'import os\ndef f():\n    {code}\n', seconds=1.0 if 'while' in code else 20.0)
    with pytest.raises(HandInError, match=REFUSED[code]):
        hand_in.call('f')


@pytest.mark.skipif(sys.platform != 'linux', reason='limits are read where Linux shows them')
def test_the_system_refuses_files_even_if_python_does_not(start):
    """And it starts in an empty folder, not in that of whoever grades."""
    hand_in = start('import sys\ndef f():\n    return sys.argv\n')
    process = Path('/proc', str(hand_in._process.pid))
    limits = (process / 'limits').read_text()
    assert re.search(r'Max open files +0 +0 ', limits)
    assert re.search(r'Max file size +0 +0 ', limits)
    assert list((process / 'cwd').iterdir()) == []
    assert hand_in.call('f') == ['anna.py']


def test_nothing_is_left_behind(start):
    hand_in = start('def f(): pass\n')
    process, folder = hand_in._process, hand_in._folder.name
    hand_in.close()
    assert process.poll() is not None
    assert not Path(folder).exists()


@pytest.mark.parametrize('end', ['exit()', 'raise SystemExit("done")'])
def test_a_program_that_ends_itself_has_its_functions(start, end):
    assert start(f'def f(): return 1\n{end}\ndef g(): pass\n').call('f') == 1


BROKEN = {
    'a b': r'anna.py cannot be run: SyntaxError: invalid syntax \(line 1\)',
    '1 / 0': r'cannot be run: ZeroDivisionError: division by zero \(line 1\)',
    'import os; os._exit(3)': 'anna.py cannot be run: uses os._exit',
    'import sys; sys.modules["_signal"].raise_signal(9)': r'has ended the process \(signal 9\)',
    'while True: pass': 'anna.py took longer than 1 s',
}


@pytest.mark.parametrize('source', BROKEN)
def test_a_hand_in_that_cannot_be_run_is_named(start, source):
    with pytest.raises(HandInError, match=BROKEN[source]):
        start(source, seconds=1.0 if 'while' in source else 20.0)


def test_names_and_shapes_that_are_wrong_are_named(start, tmp_path):
    hand_in = start('def jacobain(r): return [r]\ndef nothing(): pass\n')
    with pytest.raises(HandInError, match=r'no function jacobian in anna.py: is it jacobain\?'):
        hand_in.call('jacobian', 1.0)
    with pytest.raises(HandInError, match=r'jacobain\(1\) must return finite numbers of shape \(2,\)'):
        hand_in.array('jacobain', 1.0, shape=(2,))
    with pytest.raises(HandInError, match=r'nothing\(\) must return a finite number, got None'):
        hand_in.array('nothing', shape=())
    hand_in.close()
    with pytest.raises(HandInError, match='has ended before'):
        hand_in.call('nothing')
    with pytest.raises(HandInError, match='there is no file'):
        HandIn(tmp_path / 'none.py')


@pytest.mark.parametrize(
    ('found', 'words'),
    [
        ([1.0, 2.1], r'f must be \[1, 2\], got \[1, 2.1\]'),
        ([1.0], r'f must have shape \(2,\), as \[1, 2\], got \(1,\): \[1\]'),
        ('no', "f must be .*, got 'no'"),
        (None, 'f must be .*, got None'),
        (['1', '2'], "f must be .*, got \\['1', '2'\\]"),
        ([[1.0], [1.0, 2.0]], 'f must be .*, got '),
        ([math.nan, 2.0], 'f must be .*, got .nan, 2'),
    ],
)
def test_a_wrong_answer_is_shown_beside_the_right_one(found, words):
    agree([1.0, 2.0 + 1e-7], [1.0, 2.0], 'f')
    with pytest.raises(AssertionError, match=words):
        agree(found, [1.0, 2.0], 'f')
