"""Seconds and nanoseconds."""

from __future__ import annotations

import pytest

from diffdrive_jacobian.time_units import NANOSECONDS, nanoseconds, seconds


@pytest.mark.parametrize(
    ('duration', 'expected'),
    [(1.0, NANOSECONDS), (0.02, 20_000_000), (0.1 + 0.2, 300_000_000), (-1.5, -1_500_000_000), (0.0, 0)],
)
def test_durations_are_rounded_to_nanoseconds(duration, expected):
    assert nanoseconds(duration) == expected
    assert seconds(expected) == pytest.approx(duration)


@pytest.mark.parametrize('duration', [1e-12, 5e-324])
def test_only_a_zero_duration_becomes_zero(duration):
    """A timeout of 0 means that there is none."""
    assert nanoseconds(duration) == 1
    assert nanoseconds(-duration) == -1


def test_the_longest_duration_is_finite():
    assert nanoseconds(1e300) == int(1e300) * NANOSECONDS


def test_timestamps_survive_the_round_trip():
    assert nanoseconds(seconds(1_700_000_000 * NANOSECONDS)) == 1_700_000_000 * NANOSECONDS
