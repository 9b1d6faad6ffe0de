"""Limits and tolerances are values: compared and hashed by their entries, and not to be changed."""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_jacobian.control import Arrival, StraightLine, VelocityLimits
from diffdrive_jacobian.numerics.checks import equal, hashable
from diffdrive_jacobian.simulation import RobotModel

CASES = [(VelocityLimits, 'max_v'), (VelocityLimits, 'max_wheel_speed'), (Arrival, 'offset')]


@pytest.mark.parametrize(('cls', 'name'), CASES)
def test_values_with_arrays_are_equal_where_their_entries_are(cls, name):
    entries = [0.25, 0.5]
    value = cls(**{name: entries})
    for same in (cls(**{name: tuple(entries)}), cls(**{name: np.array(entries)})):
        assert value == same
        assert hash(value) == hash(same)
    for other in ([0.25, 0.75], [[0.25, 0.5]], [0.25], 0.25):
        assert value != cls(**{name: other})
    assert value != 0.25
    assert cls(**{name: np.array(0.25)}) == cls(**{name: 0.25})
    assert hash(cls(**{name: np.array(0.25)})) == hash(cls(**{name: 0.25}))
    assert len({value, cls(**{name: entries}), cls()}) == 2


def test_signed_zeros_are_equal_and_so_are_their_hashes():
    positive, negative = VelocityLimits(min_v=[0.0, -1.0]), VelocityLimits(min_v=[-0.0, -1.0])
    assert positive == negative
    assert hash(positive) == hash(negative)
    assert equal(np.array([np.nan]), np.array([np.nan]))
    assert hashable(np.zeros(2)) == hashable(-np.zeros(2))


def test_models_are_compared_by_their_limits():
    assert RobotModel(limits=VelocityLimits(max_v=1.0)) == RobotModel(limits=VelocityLimits(max_v=1.0))
    assert RobotModel(limits=VelocityLimits(max_v=1.0)) != RobotModel()
    with pytest.raises(ValueError, match=r'^limits must be numbers for one robot'):
        RobotModel(limits=VelocityLimits(max_v=[1.0, 2.0]))


@pytest.mark.parametrize(
    ('cls', 'valid', 'name'),
    [
        *((cls, {}, name) for cls, name in CASES),
        (StraightLine, {'end': [1.0, 0.0], 'speed': 0.1}, 'start'),
    ],
)
def test_a_value_does_not_change_with_the_array_it_was_given(cls, valid, name):
    given = np.array([0.25, 0.5])
    value = cls(**valid, **{name: given})
    given[:] = 7.0
    assert getattr(value, name).tolist() == [0.25, 0.5]
    with pytest.raises(ValueError, match='read-only'):
        getattr(value, name)[0] = 7.0
