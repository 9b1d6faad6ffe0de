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

"""What all modules share: errors with one base class, seconds and nanoseconds, text that is printed."""

from __future__ import annotations

import importlib
import pkgutil
import random
from collections.abc import Iterator

import pytest

import diffdrive_jacobian
from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.time_units import NANOSECONDS, nanoseconds, seconds

PACKAGE = diffdrive_jacobian.__name__
NOT_ERRORS = {'Stuck', 'StopShrinking', 'TaskNotEnded'}
"""They end the code of users or of Hypothesis, which catches Exception, and never leave the package."""


def raised(base: type[BaseException]) -> Iterator[type[BaseException]]:
    """Yield the exception classes of the package, whatever they derive from."""
    for one in base.__subclasses__():
        if one.__module__.partition('.')[0] == PACKAGE:
            yield one
        yield from raised(one)


def test_every_error_has_the_base_class():
    for module in pkgutil.walk_packages(diffdrive_jacobian.__path__, f'{PACKAGE}.'):
        importlib.import_module(module.name)
    classes = set(raised(BaseException))
    others = {one for one in classes if not issubclass(one, DiffdriveError)}
    assert {one.__name__ for one in others} == NOT_ERRORS
    assert not [one for one in others if issubclass(one, Exception)]
    assert len(classes - others) > 30


def test_durations_are_rounded_to_nanoseconds_and_only_zero_becomes_zero():
    cases = {1.0: NANOSECONDS, 0.1 + 0.2: 300_000_000, -1.5: -1_500_000_000, 0.0: 0}
    # A timeout of 0 means that there is none.
    cases |= {1e-12: 1, -5e-324: -1, 1e300: int(1e300) * NANOSECONDS}
    for duration, expected in cases.items():
        assert nanoseconds(duration) == expected
    stamp = 1_700_000_000 * NANOSECONDS
    assert nanoseconds(seconds(stamp)) == stamp


# --- Text of unknown origin


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        ('/größe 世界', '/größe 世界'),
        ('\x1b[2J\x1b]0;title\x07', r'\x1b[2J\x1b]0;title\x07'),
        ('a\r\nb\tc\0\u202e\udcff', r'a\r\nb\tc\x00\u202e\udcff'),
        (ValueError('bad\nvalue'), r'bad\nvalue'),
        ('x' * 80, 'x' * 80),
        ('x' * 81, 'x' * 77 + '...'),
        # An escape is not cut in two.
        ('x' * 75 + '\x1b' * 10, 'x' * 75 + '...'),
    ],
)
def test_text_is_printed_without_terminal_escapes_and_not_at_any_length(text, expected):
    assert printable(text) == expected


def test_any_text_is_printable():
    rng = random.Random(1)
    for limit in range(3, 100):
        text = ''.join(chr(rng.choice((rng.randrange(128), rng.randrange(0x110000)))) for _ in range(50))
        result = printable(text, limit)
        assert result.isprintable()
        assert len(result) <= limit
        # Printable text that fits is not changed.
        assert printable(result, limit) == result
