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

"""Saturation keeps the curvature and meets every limit."""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_jacobian.control import VelocityLimits, saturate
from diffdrive_jacobian.kinematics.diff_drive import body_to_wheel
from diffdrive_jacobian.simulation import RobotModel

R, L = 0.033, 0.16
BODY_LIMITS = ['min_v', 'max_v', 'min_omega', 'max_omega']
EVERY_LIMIT = [*BODY_LIMITS, 'max_wheel_speed']


def random_limits(rng, count):
    """Draw limits around the size of the commands; a random half of them is infinite: none."""
    drawn = {name: 10.0 ** rng.uniform(-3.0, 0.5, count) for name in EVERY_LIMIT}
    for name, values in drawn.items():
        values *= -1.0 if name.startswith('min') else 1.0 / R if 'wheel' in name else 1.0
        values[rng.random(count) < 0.5] *= np.inf
    return drawn


def random_commands(rng, count):
    """Draw commands over six decades and all four quadrants, shape (2, count)."""
    return rng.choice([-1.0, 1.0], (2, count)) * 10.0 ** rng.uniform(-4.0, 2.0, (2, count))


def fastest_wheel(v, omega):
    return np.max(np.abs(body_to_wheel(v, omega, R, L)), axis=0)


def violates(limits, v, omega):
    """Return which twists break a limit, without any tolerance."""
    beyond = (v < limits.min_v) | (v > limits.max_v)
    beyond |= (omega < limits.min_omega) | (omega > limits.max_omega)
    return beyond | (fastest_wheel(v, omega) > limits.max_wheel_speed)


def test_the_curvature_is_kept_and_no_larger_factor_meets_the_limits():
    rng = np.random.default_rng(1)
    limits = VelocityLimits(**random_limits(rng, 20_000))
    v, omega = random_commands(rng, 20_000)
    limited = v_limited, omega_limited = saturate(v, omega, limits, R, L)
    np.testing.assert_allclose(v_limited / omega_limited, v / omega, rtol=1e-12)
    assert np.all(np.sign(v_limited) == np.sign(v))
    # Not beyond a limit by a single bit, but slower only by a few units in the last place.
    assert not violates(limits, *limited).any()
    unchanged = (v_limited == v) & (omega_limited == omega)
    assert np.all(unchanged | violates(limits, *np.multiply(limited, 1.0 + 3e-15)))
    # What is within the limits passes to the last bit.
    assert np.array_equal(unchanged, ~violates(limits, v, omega))
    assert 2_000 < np.count_nonzero(unchanged) < 18_000


def test_without_limits_everything_passes_and_no_wheels_are_needed():
    assert VelocityLimits().unlimited
    assert not VelocityLimits(max_wheel_speed=1e9).unlimited
    twists = random_commands(np.random.default_rng(4), 100)
    assert np.array_equal(saturate(*twists, VelocityLimits()), twists)
    assert saturate(1.0, 2.0, VelocityLimits(max_v=0.5)) == (0.5, 1.0)


@pytest.mark.parametrize('name', BODY_LIMITS)
def test_a_limit_of_zero_forbids_a_direction_and_leaves_the_rest(name):
    twist = random_commands(np.random.default_rng(5), 100)
    component = 0 if name.endswith('_v') else 1
    forbidden = (twist[component] < 0.0) if name.startswith('min') else (twist[component] > 0.0)
    limited = saturate(*twist, VelocityLimits(**{name: 0.0, 'max_wheel_speed': 20.0}), R, L)
    # As if the forbidden component had not been commanded, and nothing less of the other.
    dropped = twist.copy()
    dropped[component, forbidden] = 0.0
    assert np.array_equal(limited, saturate(*dropped, VelocityLimits(max_wheel_speed=20.0), R, L))


def test_numbers_of_any_size_are_within_their_limits():
    rng, count = np.random.default_rng(10), 6_000
    drawn = 10.0 ** rng.uniform(-60.0, 60.0, (6, count))
    drawn[:, ::7] = np.exp(rng.uniform(-4.0, 4.0, drawn[:, ::7].shape))
    v, omega = drawn[:2] * rng.choice([-1.0, 1.0], (2, count))
    r, separation, wheels, body = drawn[2:]
    limits = VelocityLimits(max_v=body, min_omega=-body, max_wheel_speed=wheels)
    limited = saturate(v, omega, limits, r, separation)
    assert np.all(np.max(np.abs(body_to_wheel(*limited, r, separation)), axis=0) <= wheels)
    assert np.all(limited[0] <= body)
    assert np.all(limited[1] >= -body)


def test_an_invalid_limit_is_named():
    for name in EVERY_LIMIT:
        allowed = 'positive' if name == 'max_wheel_speed' else 'zero or '
        wrong = [1e-300, np.inf] if name.startswith('min') else [-1e-300, -np.inf]
        for bad in (*wrong, [0.5, -0.5]):
            with pytest.raises(ValueError, match=rf'^{name} must be {allowed}'):
                VelocityLimits(**{name: bad})
    with pytest.raises(ValueError, match='max_wheel_speed'):
        VelocityLimits(max_wheel_speed=0.0)


@pytest.mark.parametrize(
    ('v', 'limits', 'wheels', 'message'),
    [
        (np.ones(3), {'max_v': np.ones(2)}, (R, L), r'leading axes .*\(3,\).*\(2,\)'),
        (1.0, {'max_wheel_speed': 1.0}, (0.0, L), '^r must be positive'),
        (1.0, {'max_wheel_speed': 1.0}, (R, -L), '^L must be positive'),
        (1.0, {'max_wheel_speed': 1.0}, (R,), 'max_wheel_speed, so r and L must be given'),
        (1.0, {'max_wheel_speed': 1.0}, (None, L), 'so r and L must be given'),
        (1e308, {'max_wheel_speed': 1.0}, (1e-3, 16.0), 'finite'),
        ([1e308, 0.0], {'max_wheel_speed': 1.0}, (1e-3, 16.0), 'finite'),
    ],
)
def test_limits_and_commands_that_do_not_fit_together_are_named(v, limits, wheels, message):
    with pytest.raises(ValueError, match=message):
        saturate(v, 1.0, VelocityLimits(**limits), *wheels)


def test_wheels_of_different_radii_do_not_exceed_their_limit_by_the_last_bit():
    model = RobotModel(
        right_wheel_radius_multiplier=1.03,
        left_wheel_radius_multiplier=0.97,
        limits=VelocityLimits(max_wheel_speed=10.0),
    )
    for command in np.random.default_rng(3).uniform(-5.0, 5.0, (2000, 2)).tolist():
        assert max(map(abs, model.wheel_speeds(*model.limited(command)))) <= 10.0
