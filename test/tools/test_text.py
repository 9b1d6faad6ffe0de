"""Text of unknown origin is printed without terminal escapes, and not at any length."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_jacobian.text import printable


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        ('', ''),
        ('/odom', '/odom'),
        ('/größe 世界', '/größe 世界'),
        ('\x1b[2J\x1b]0;title\x07', r'\x1b[2J\x1b]0;title\x07'),
        ('a\r\nb\tc\0', r'a\r\nb\tc\x00'),
        ('\x9b31m', r'\x9b31m'),
        ('\u202eabc\u2066', r'\u202eabc\u2066'),
        ('\udcff', r'\udcff'),
        (ValueError('bad\nvalue'), r'bad\nvalue'),
        (b'\x1b', r"b'\x1b'"),
        ('x' * 80, 'x' * 80),
        ('x' * 81, 'x' * 77 + '...'),
    ],
)
def test_printable(text, expected):
    assert printable(text) == expected


def test_an_escape_is_not_cut_in_two():
    assert printable('abc' + '\x1b' * 10, limit=12) == r'abc\x1b...'


@given(st.text(alphabet=st.characters(exclude_categories=())), st.integers(3, 100))
def test_printable_for_any_text(text, limit):
    result = printable(text, limit)
    assert result.isprintable()
    assert len(result) <= limit
    # Printable text that fits is not changed.
    assert printable(result, limit) == result
    if text.isprintable() and len(text) <= limit:
        assert result == text


def test_long_text_is_cut_before_it_is_escaped():
    class Text(str):
        def __iter__(self):
            raise AssertionError('the whole text is examined')

    assert printable(Text('\n' * 10_000_000)).startswith(r'\n\n')
