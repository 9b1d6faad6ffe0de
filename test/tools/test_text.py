"""Text of unknown origin is printed without terminal escapes, and not at any length."""

from __future__ import annotations

import random

import pytest

from diffdrive_jacobian.text import printable


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        ('/größe 世界', '/größe 世界'),
        ('\x1b[2J\x1b]0;title\x07', r'\x1b[2J\x1b]0;title\x07'),
        ('a\r\nb\tc\0', r'a\r\nb\tc\x00'),
        ('\x9b31m\u202e\udcff', r'\x9b31m\u202e\udcff'),
        (ValueError('bad\nvalue'), r'bad\nvalue'),
        ('x' * 80, 'x' * 80),
        ('x' * 81, 'x' * 77 + '...'),
    ],
)
def test_printable(text, expected):
    assert printable(text) == expected
    # An escape is not cut in two.
    assert printable('abc' + '\x1b' * 10, limit=12) == r'abc\x1b...'


def test_any_text_is_printable():
    rng = random.Random(1)
    for limit in range(3, 100):
        text = ''.join(chr(rng.choice((rng.randrange(128), rng.randrange(0x110000)))) for _ in range(50))
        result = printable(text, limit)
        assert result.isprintable()
        assert len(result) <= limit
        # Printable text that fits is not changed.
        assert printable(result, limit) == result


def test_long_text_is_cut_before_it_is_escaped():
    class Text(str):
        def __iter__(self):
            raise AssertionError('the whole text is examined')

    assert printable(Text('\n' * 10_000_000)).startswith(r'\n\n')
