"""When a command takes effect."""

from __future__ import annotations

import pytest

from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.nodes.command_time import command_time

SECOND = 1_000_000_000
NOW = 10 * SECOND


@pytest.mark.parametrize(
    ('stamp', 'last', 'timeout', 'expected'),
    [
        (0, NOW - 5, SECOND, NOW),
        (NOW, 0, SECOND, NOW),
        (NOW - SECOND, 0, SECOND, NOW - SECOND),
        (NOW - 7, NOW - 7, SECOND, NOW - 7),
        (1, 0, 0, 1),
    ],
    ids=['no stamp', 'now', 'as old as the timeout', 'same as the last', 'no timeout'],
)
def test_command_takes_effect_at_its_stamp_or_on_receipt(stamp, last, timeout, expected):
    assert command_time(stamp, NOW, last, timeout) == expected


@pytest.mark.parametrize(
    ('stamp', 'last', 'words'),
    [
        (NOW + SECOND // 4, 0, 'its stamp is 0.250000 s in the future'),
        (NOW - SECOND - 1, 0, '1.000000 s old, more than the timeout of 1 s'),
        (NOW - SECOND // 2, NOW - SECOND // 4, '0.250000 s older than the last command'),
    ],
)
def test_invalid_stamps_are_reported(stamp, last, words):
    with pytest.raises(MessageError, match=words):
        command_time(stamp, NOW, last, SECOND)
