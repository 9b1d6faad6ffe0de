"""Saturation keeps the curvature: the largest common factor on v and omega that meets every limit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from diffdrive_jacobian.control import VelocityLimits, saturate
from diffdrive_jacobian.kinematics.diff_drive import body_to_wheel

R, L = 0.033, 0.16
BODY_LIMITS = ['min_v', 'max_v', 'min_omega', 'max_omega']
EVERY_LIMIT = [*BODY_LIMITS, 'max_wheel_speed']
ACTIVE = [*([name] for name in EVERY_LIMIT), BODY_LIMITS, EVERY_LIMIT]


def random_limits(rng, names) -> VelocityLimits:
    """Draw limits around the size of the commands, so that each of them is often the tightest."""
    drawn = dict(zip(names, 10.0 ** rng.uniform(-3.0, 0.5, len(names)), strict=True))
    for name in drawn:
        if name.startswith('min'):
            drawn[name] *= -1.0
        if name == 'max_wheel_speed':
            drawn[name] /= R
    return VelocityLimits(**drawn)


def random_commands(rng, count=100):
    """Draw commands over six decades and all four quadrants."""
    return rng.choice([-1.0, 1.0], (2, count)) * 10.0 ** rng.uniform(-4.0, 2.0, (2, count))


def cases(names, seed):
    """Yield 100 sets of limits, each with 100 commands and what becomes of them."""
    rng = np.random.default_rng(seed)
    for _ in range(100):
        limits, (v, omega) = random_limits(rng, names), random_commands(rng)
        yield limits, (v, omega), saturate(v, omega, limits, R, L)


def fastest_wheel(v, omega):
    return np.max(np.abs(body_to_wheel(v, omega, R, L)), axis=0)


def violates(limits, v, omega):
    """Tell which twists break a limit, without any tolerance."""
    body = (
        (v < limits.min_v) | (v > limits.max_v) | (omega < limits.min_omega) | (omega > limits.max_omega)
    )
    return body | (fastest_wheel(v, omega) > limits.max_wheel_speed)


@pytest.mark.parametrize('names', ACTIVE, ids='+'.join)
def test_the_ratio_is_the_commanded_one(names):
    slowed = 0
    for _, (v, omega), (v_limited, omega_limited) in cases(names, 1):
        np.testing.assert_allclose(v_limited / omega_limited, v / omega, rtol=1e-12)
        assert np.all(np.sign(v_limited) == np.sign(v))
        slowed += np.count_nonzero(v_limited != v)
    assert slowed > 2_000


@pytest.mark.parametrize('names', ACTIVE, ids='+'.join)
def test_every_limit_is_met_and_no_larger_factor_would_do(names):
    for limits, (v, omega), limited in cases(names, 2):
        v_limited, omega_limited = limited
        assert np.all((limits.min_v <= v_limited) & (v_limited <= limits.max_v))
        assert np.all((limits.min_omega <= omega_limited) & (omega_limited <= limits.max_omega))
        assert np.all(fastest_wheel(*limited) <= limits.max_wheel_speed * (1.0 + 1e-12))
        unchanged = (v_limited == v) & (omega_limited == omega)
        more = np.multiply(limited, 1.0 + 1e-9)
        assert np.all(unchanged | violates(limits, *more))
        # Only what breaks a limit is slowed down.
        assert np.array_equal(unchanged, ~violates(limits, v, omega))


@pytest.mark.parametrize('names', ACTIVE, ids='+'.join)
def test_what_is_within_the_limits_passes_to_the_last_bit(names):
    for limits, _, limited in cases(names, 3):
        inside = np.multiply(limited, 1.0 - 1e-9)
        for before, after in zip(inside, saturate(*inside, limits, R, L), strict=True):
            assert before.tobytes() == after.tobytes()


def test_without_limits_everything_passes():
    limits = VelocityLimits()
    assert limits.unlimited
    assert not VelocityLimits(max_wheel_speed=1e9).unlimited
    v, omega = random_commands(np.random.default_rng(4))
    for before, after in zip((v, omega), saturate(v, omega, limits, R, L), strict=True):
        assert before.tobytes() == after.tobytes()


@pytest.mark.parametrize('name', BODY_LIMITS)
def test_a_limit_of_zero_forbids_a_direction_and_leaves_the_rest(name):
    rng = np.random.default_rng(5)
    limits = VelocityLimits(**{name: 0.0, 'max_wheel_speed': 20.0})
    twist = random_commands(rng)
    component = 0 if name.endswith('_v') else 1
    forbidden = (twist[component] < 0.0) if name.startswith('min') else (twist[component] > 0.0)
    assert 20 < np.count_nonzero(forbidden) < 80
    limited = np.array(saturate(*twist, limits, R, L))
    # As if the forbidden component had not been asked for: nothing of it, and nothing less of the other.
    dropped = twist.copy()
    dropped[component, forbidden] = 0.0
    wheels_alone = VelocityLimits(max_wheel_speed=20.0)
    assert np.array_equal(limited, saturate(*dropped, wheels_alone, R, L))
    assert not limited[component, forbidden].any()
    assert limited[1 - component].all()


def test_limits_of_zero_in_both_directions_leave_nothing_of_a_component():
    v, omega = random_commands(np.random.default_rng(6))
    v_limited, omega_limited = saturate(v, omega, VelocityLimits(min_v=0.0, max_v=0.0), R, L)
    assert not v_limited.any()
    assert np.array_equal(omega_limited, omega)
    v_limited, omega_limited = saturate(v, omega, VelocityLimits(min_omega=0.0, max_omega=0.0), R, L)
    assert np.array_equal(v_limited, v)
    assert not omega_limited.any()


def test_standing_still_is_within_any_limits():
    rng = np.random.default_rng(7)
    for names in ACTIVE:
        assert saturate(0.0, 0.0, random_limits(rng, names), R, L) == (0.0, 0.0)


def test_leading_axes_of_commands_and_robots_broadcast():
    rng = np.random.default_rng(8)
    limits = random_limits(rng, EVERY_LIMIT)
    v, omega = random_commands(rng, 4)
    r, separation = rng.uniform(0.01, 0.1, (3, 1)), rng.uniform(0.1, 0.5, (3, 1))
    v_limited, omega_limited = saturate(v, omega, limits, r, separation)
    for i, j in np.ndindex(3, 4):
        one = saturate(v[j], omega[j], limits, r[i, 0], separation[i, 0])
        assert (v_limited[i, j], omega_limited[i, j]) == one


@pytest.mark.parametrize(
    ('name', 'bad', 'allowed'),
    [
        *(
            (name, bad, 'zero or negative')
            for name in ('min_v', 'min_omega')
            for bad in (1e-300, np.inf, np.nan)
        ),
        *(
            (name, bad, 'zero or positive')
            for name in ('max_v', 'max_omega')
            for bad in (-1e-300, -np.inf, np.nan)
        ),
        *(('max_wheel_speed', bad, 'positive') for bad in (0.0, -1.0, -np.inf, np.nan)),
    ],
)
def test_a_limit_on_the_wrong_side_of_zero_is_named(name, bad, allowed):
    with pytest.raises(ValueError, match=rf'^{name} must be {allowed}, got {bad}$'):
        VelocityLimits(**{name: bad})


@pytest.mark.parametrize(
    ('r', 'separation', 'name'), [(0.0, L, 'r'), (np.nan, L, 'r'), (R, -L, 'L'), (R, np.inf, 'L')]
)
def test_a_robot_without_dimensions_is_refused_where_wheels_count(r, separation, name):
    with pytest.raises(ValueError, match=rf'^{name} must be positive and finite'):
        saturate(1.0, 1.0, VelocityLimits(max_wheel_speed=1.0), r, separation)


SPEEDS = st.just(0.0) | st.floats(1e-60, 1e60) | st.floats(-1e60, -1e-60)
SIZES = st.floats(1e-60, 1e60)


@given(v=SPEEDS, omega=SPEEDS, r=SIZES, separation=SIZES, wheels=SIZES, body=st.none() | SIZES)
@settings(max_examples=200, deadline=None)
def test_no_wheel_is_faster_than_its_limit_by_a_single_bit(v, omega, r, separation, wheels, body):
    limits = VelocityLimits(max_wheel_speed=wheels)
    if body is not None:
        limits = VelocityLimits(max_v=body, min_omega=-body, max_wheel_speed=wheels)
    limited = saturate(v, omega, limits, r, separation)
    assert max(map(abs, body_to_wheel(*limited, r, separation))) <= wheels
    assert limits.min_v <= limited[0] <= limits.max_v
    assert limits.min_omega <= limited[1] <= limits.max_omega
    in_batch = saturate([v, 0.0], [omega, 0.0], limits, r, separation)
    assert (in_batch[0][0], in_batch[1][0]) == limited


def test_wheels_of_any_size_are_not_faster_than_their_limit_by_a_single_bit():
    rng = np.random.default_rng(10)
    drawn = 10.0 ** rng.uniform(-60.0, 60.0, (6, 20_000))
    drawn[:, ::7] = np.exp(rng.uniform(-4.0, 4.0, drawn[:, ::7].shape))
    v, omega = drawn[:2] * rng.choice([-1.0, 1.0], (2, 20_000))
    r, separation, wheels, body = drawn[2:]
    for body_limits in ({}, {'max_v': body, 'min_omega': -body}):
        limits = VelocityLimits(**body_limits, max_wheel_speed=wheels)
        limited = saturate(v, omega, limits, r, separation)
        speeds = np.abs(body_to_wheel(*limited, r, separation))
        assert np.all(np.maximum(*speeds) <= wheels)
        assert np.all((limits.min_v <= limited[0]) & (limited[0] <= limits.max_v))
        assert np.all((limits.min_omega <= limited[1]) & (limited[1] <= limits.max_omega))


def test_usual_wheels_are_never_faster_than_their_limit_by_a_single_bit():
    rng = np.random.default_rng(9)
    v, omega = rng.normal(0.0, 10.0, (2, 100_000))
    limit = rng.uniform(0.1, 5.0, 100_000)
    limited = saturate(v, omega, VelocityLimits(max_wheel_speed=limit), R, L)
    assert np.all(fastest_wheel(*limited) <= limit)
    # And not slower than a few units in the last place.
    assert np.all((fastest_wheel(*limited) > limit * (1.0 - 3e-15)) | (limited[0] == v))


@pytest.mark.parametrize('fast', [1e308, [-1e308, 0.0]])
def test_a_twist_whose_wheel_speeds_overflow_is_refused(fast):
    with pytest.raises(ValueError, match='must give a finite result'):
        saturate(fast, 1e308, VelocityLimits(max_wheel_speed=1.0), 1.0, 16.0)


def test_wheel_geometry_is_needed_only_for_a_limit_of_the_wheels():
    limits = VelocityLimits(max_v=0.5)
    assert saturate(1.0, 2.0, limits) == saturate(1.0, 2.0, limits, R, L) == (0.5, 1.0)
    for missing in ((), (R,), (None, L)):
        with pytest.raises(ValueError, match='limits have a max_wheel_speed, so r and L must be given'):
            saturate(1.0, 2.0, VelocityLimits(max_wheel_speed=1.0), *missing)
