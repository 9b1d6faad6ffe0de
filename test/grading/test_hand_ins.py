"""A hand-in: what its functions return, what it may not do, and what the student reads then."""

from __future__ import annotations

import math
import os

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


REFUSED = {
    'return open("/etc/passwd").read()': r'opens or changes a file \(line 3\)',
    'return os.listdir("/")': 'opens or changes a file',
    'return os.open("/etc/passwd", 0)': 'opens or changes a file',
    'os.remove("anna.py")': 'opens or changes a file',
    'os.system("true")': 'starts or ends another program',
    'os.kill(os.getppid(), 9)': 'starts or ends another program',
    'os.fork()': 'starts another program',
    'import diffdrive_jacobian': 'imports diffdrive_jacobian, and may import numpy',
    'import multiprocessing': 'imports multiprocessing',
    'os._exit(0)': r'f\(\) has ended the process \(exit code 0\)',
    'raise SystemExit': 'SystemExit',
    'return 1 / 0': r'f\(\): ZeroDivisionError: division by zero \(line 3\)',
    'return {}': 'must return numbers, arrays, lists or texts, got dict',
    'return "x" * 10**7': 'must return less than 1000000 characters',
    'return f()': 'RecursionError',
    'while True: pass': 'took longer than 1 s: is there a loop without end',
    '[os.write(fd, b"x" * 100 + b"\\n") for fd in range(3, 20)]': r'no answer|Bad file descriptor',
}


@pytest.mark.parametrize('code', REFUSED)
def test_what_it_may_not_do_is_refused_in_words(start, code):
    hand_in = start(f'import os\ndef f():\n    {code}\n', seconds=1.0 if 'while' in code else 20.0)
    with pytest.raises(HandInError, match=REFUSED[code]):
        hand_in.call('f')


@pytest.mark.skipif(os.name != 'posix', reason='limits of the system are those of POSIX')
def test_the_system_refuses_files_even_if_python_does_not(start):
    """Also what was loaded before reads nothing then: the descriptors are used up."""
    hand_in = start('import os\ndef f():\n    return os.dup(0)\ndef g():\n    return os.pipe()\n')
    for name in 'fg':
        with pytest.raises(HandInError, match='OSError'):
            hand_in.call(name)


BROKEN = {
    'a b': r'anna.py cannot be run: SyntaxError: invalid syntax \(line 1\)',
    '1 / 0': r'cannot be run: ZeroDivisionError: division by zero \(line 1\)',
    'import os; os._exit(3)': r'has ended the process \(exit code 3\)',
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
        ([math.nan, 2.0], 'f must be .*, got .nan, 2'),
    ],
)
def test_a_wrong_answer_is_shown_beside_the_right_one(found, words):
    agree([1.0, 2.0 + 1e-7], [1.0, 2.0], 'f')
    with pytest.raises(AssertionError, match=words):
        agree(found, [1.0, 2.0], 'f')
