"""The calibration of robots that are simulated by code of its own: no value is wrong without a note.

A small form of `benchmark/calibration_cases.py`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / 'benchmark'))

from calibration_cases import offenders, one_robot, table_row
from independent_robots import cramer_rao_bound, simulate

from diffdrive_jacobian.calibration import calibrate


@pytest.mark.slow
@pytest.mark.parametrize(
    ('case', 'noted'),
    [
        ('encoder of 16 steps', False),
        ('skid', True),
        ('slip in tight turns', True),
        ('clock -60 s', True),
        ('feet', True),
        ('wheels at 4 Hz', True),
    ],
)
def test_no_value_is_wrong_without_a_note(case, noted):
    row = one_robot((case, 0))
    assert offenders([row]) == []
    assert table_row(case, [row])[1] == ('0, 1, 0' if noted else '1, 0, 0')


@pytest.mark.slow
def test_the_stated_deviations_are_those_of_an_independent_cramer_rao_bound():
    recordings, nominal, _ = simulate('encoder of 2000 steps', 1)
    found = calibrate(recordings, nominal)
    stated = np.diag(found.covariance)[:3] / found.multipliers**2
    np.testing.assert_allclose(
        stated**0.5, cramer_rao_bound('encoder of 2000 steps', 1) ** 0.5, rtol=0.2
    )
