"""The exact moments of odometry's error: against a matrix exponential, in pieces, and in Monte Carlo."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from support.moments_reference import DRIVES, noisy_runs, reference

from diffdrive_jacobian.kinematics.se2 import integrate
from diffdrive_jacobian.simulation import Robot, RobotModel
from diffdrive_jacobian.simulation.exact_moments import (
    SHORT_NOISE,
    SHORT_TURN,
    NoiseMoments,
    central,
    gaussian,
    propagate_moments,
    series,
    short_arc,
)
from diffdrive_jacobian.simulation.odometry_noise import propagate_covariance

L, K = 0.16, 1e-5
START = np.array([0.7, -1.2, 0.4])
COVARIANCE = 1e-3 * np.array([[4.0, 1.0, -0.5], [1.0, 2.0, 0.3], [-0.5, 0.3, 9.0]])
NONE = np.zeros((3, 3))
SURE = gaussian(NONE)
SECOND = 10**9
# v, omega, duration: straight, both sides of the series' end, in place, one wheel at rest, long.
ARCS = [
    *((0.2, omega, 4.0) for omega in (0.0, 1e-12, -1e-6, 0.0124, -0.0126, 2.0)),
    *((-0.2, omega, 4.0) for omega in (0.0, 1e-3)),
    *((0.0, omega, 4.0) for omega in (1e-12, -1.0)),
    *((0.08, 1.0, duration) for duration in (1e-9, 0.02, 0.0499, 0.0501, 5.0)),
    *((0.22, omega, 300.0) for omega in (0.0, 1e-4, 0.5)),
    *((0.22, 0.0, 1e-9), (0.0, 0.0, 1.0)),
]
STARTS = (NONE, COVARIANCE, np.diag([0.0, 0.0, 1.0]))


def scales(moments):
    """What rounding errors are measured by: positions by the larger axis, for they are rotated."""
    position = math.sqrt(moments.xx + moments.yy)
    heading = math.sqrt(moments.tt)
    trigonometric = position * min(heading, 1.0)
    return np.array(
        [
            *(position**2, position**2, position * heading, position**2, position * heading),
            *(heading**2, *[trigonometric] * 6),
        ]
    )


def close(actual, expected, tolerance=1e-12):
    error = np.abs(np.subtract(actual, expected))
    assert np.all(error <= tolerance * scales(actual)), error / scales(actual)


def positive_semidefinite(moment, tolerance=1e-12):
    assert np.array_equal(moment, moment.T)
    assert np.all(np.diag(moment) >= 0.0)
    deviations = np.sqrt(np.maximum(np.diag(moment), 1e-300))
    assert np.linalg.eigvalsh(moment / np.outer(deviations, deviations)).min() >= -tolerance


# --- Identities


@pytest.mark.parametrize(('v', 'omega', 'duration'), ARCS)
def test_the_closed_form_solves_the_differential_equation(v, omega, duration):
    """A matrix exponential in extended precision is the reference."""
    for start, k in itertools.product(STARTS, (K, 1e-2)):
        actual = propagate_moments(gaussian(start), START, (v, omega), duration, L, k)
        close(actual, reference(gaussian(start), START[2], (v, omega), duration, L, k))
        positive_semidefinite(actual.second_moment)


@pytest.mark.parametrize(('v', 'omega', 'duration'), ARCS)
def test_an_arc_in_pieces_has_the_moments_of_the_whole(v, omega, duration):
    for start, k, share in itertools.product(STARTS, (0.0, K), (1e-6, 0.9)):
        whole = propagate_moments(gaussian(start), START, (v, omega), duration, L, k)
        halfway = propagate_moments(gaussian(start), START, (v, omega), share * duration, L, k)
        pose = integrate(START, (v, omega), share * duration)
        close(propagate_moments(halfway, pose, (v, omega), (1.0 - share) * duration, L, k), whole)


@pytest.mark.parametrize(('v', 'omega', 'duration'), [arc for arc in ARCS if arc[2] < 100.0])
def test_for_small_noise_it_is_the_first_order_form(v, omega, duration):
    k, covariance = 1e-12, 1e-9 * COVARIANCE
    for start in (NONE, covariance):
        exact = propagate_moments(gaussian(start), START, (v, omega), duration, L, k)
        first = propagate_covariance(start, START, (v, omega), duration, L, k)
        deviations = np.sqrt(np.diag(first))
        error = np.abs(exact.second_moment - first)
        assert np.all(error <= 1e-7 * np.outer(deviations, deviations))


@pytest.mark.parametrize('m', [SHORT_NOISE, 1e-9])
@pytest.mark.parametrize('turn', [SHORT_TURN, -SHORT_TURN, 1e-6, 0.0])
@pytest.mark.parametrize('alpha', [0.0, -0.1, -100.0])
def test_the_short_form_is_the_series_up_to_its_limits(m, turn, alpha):
    """With wheels one metre apart, `nu = m / 2` and `|beta| <= m`; alpha is a multiple of that."""
    nu, to_end = m / 2.0, complex(math.cos(turn / 2.0), -math.sin(turn / 2.0))
    for beta in (m, -m, 0.3 * m, 0.0):
        short = NoiseMoments(*short_arc(alpha, turn, nu, beta, m))
        expected = NoiseMoments(*central(series(alpha, turn, nu, beta, m), m))
        position = nu + alpha * alpha * m
        for x, y in (('x', 'y'), ('xt', 'yt'), ('xc', 'yc'), ('xs', 'ys')):
            turned = complex(getattr(short, x), getattr(short, y)) * to_end
            error = turned - complex(getattr(expected, x), getattr(expected, y))
            assert abs(error) <= 1e-13 * math.sqrt(position * m)
        assert short.xx + short.yy == pytest.approx(expected.xx + expected.yy, rel=1e-13)
        turned = complex(short.xx - short.yy, 2.0 * short.xy) * to_end * to_end
        error = turned - complex(expected.xx - expected.yy, 2.0 * expected.xy)
        assert abs(error) <= 1e-13 * position


@pytest.mark.parametrize('offset', [0.0, 1e6])
def test_far_from_the_origin_nothing_cancels(offset):
    rng = np.random.default_rng(3)
    robots = []
    for place in (0.0, offset):
        pose = np.array([place, -place, 0.3])
        robot, stamp = Robot(model=RobotModel(), stamp=0, pose=pose, covariance=COVARIANCE), 0
        for v, omega in rng.normal(0.0, [0.3, 1.0], (50, 2)).tolist():
            stamp += SECOND // 7
            robot = robot.commanded((v, omega), stamp)
            positive_semidefinite(robot.at(stamp + 1).covariance)
        robots.append(robot.at(stamp + 10 * SECOND))
        positive_semidefinite(robots[-1].covariance)
        rng = np.random.default_rng(3)
    assert np.array_equal(robots[0].covariance, robots[1].covariance)


def test_the_first_million_metres_are_positive_semidefinite():
    for duration in (1e3, 1e4, 1e5, 1e6):
        for omega in (0.0, 1e-6, 1e-3, 0.5):
            moments = propagate_moments(SURE, np.zeros(3), (1.0, omega), duration, L, K)
            positive_semidefinite(moments.second_moment)


def test_what_overflows_raises_an_error():
    with pytest.raises(ValueError, match='overflows'):
        propagate_moments(SURE, START, (1e200, 0.0), 1e10, L, K)
    with pytest.raises(ValueError, match='positive semidefinite'):
        gaussian(-COVARIANCE)
    with pytest.raises(ValueError, match=r'covariance must have shape \(3, 3\)'):
        gaussian(np.zeros((2, 3, 3)))


# --- Monte Carlo


@pytest.mark.parametrize(
    ('drive', 'start'),
    [*zip([drive(60.0) for drive in DRIVES.values()], [NONE, COVARIANCE] * 2, strict=True)],
    ids=DRIVES,
)
def test_the_moments_are_those_of_two_thousand_noisy_runs(drive, start):
    count = 2000
    moments, pose = gaussian(start), np.zeros(3)
    for twist, duration in drive:
        moments = propagate_moments(moments, pose, twist, duration, L, K)
        pose = integrate(pose, twist, duration)
    errors = noisy_runs(np.random.default_rng(7), drive, start, count, L, K)
    second = moments.second_moment
    # The mean normalized error squared is 3 by definition; its standard error is that of the sample.
    nees = np.einsum('ni,ij,nj->n', errors, np.linalg.inv(second), errors)
    assert abs(nees.mean() - 3.0) < 5.0 * nees.std() / math.sqrt(count)
    for i, j in itertools.product(range(3), repeat=2):
        products = errors[:, i] * errors[:, j]
        assert abs(products.mean() - second[i, j]) < 5.0 * products.std() / math.sqrt(count)
    deviation = errors.std(axis=0) / math.sqrt(count)
    assert np.all(np.abs(errors.mean(axis=0) - moments.mean) < 5.0 * deviation)
    turned = errors[:, 2]
    for index, trigonometric in enumerate((np.cos(turned) - 1.0, np.sin(turned))):
        for axis, name in enumerate('xy'):
            products = errors[:, axis] * trigonometric
            expected = getattr(moments, name + 'cs'[index])
            assert abs(products.mean() - expected) < 5.0 * products.std() / math.sqrt(count) + 1e-15


def test_the_first_order_form_is_too_small_after_a_minute():
    """What the exact moments are for: 5 times too small, NEES 45 instead of 3."""
    count, drive = 500, DRIVES['straight'](60.0)
    errors = noisy_runs(np.random.default_rng(8), drive, NONE, count, L, K)
    first = propagate_covariance(NONE, np.zeros(3), *drive[0], L, K)
    assert errors[:, 0].std() > 4.0 * math.sqrt(first[0, 0])
    assert np.einsum('ni,ij,nj->n', errors, np.linalg.inv(first), errors).mean() > 30.0
