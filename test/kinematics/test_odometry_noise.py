"""The covariance of odometry: the integral along the arc, by quadrature and by noisy wheels."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from diffdrive_jacobian.kinematics.diff_drive import unicycle_jacobian
from diffdrive_jacobian.kinematics.se2 import integrate
from diffdrive_jacobian.simulation.odometry_noise import propagate_covariance, twist_covariance

L, K = 0.16, 1e-5
START = np.array([0.7, -1.2, 0.4])
COVARIANCE = np.array([[4e-4, 1e-4, -2e-4], [1e-4, 2e-4, 5e-5], [-2e-4, 5e-5, 9e-4]])
NONE = np.zeros((3, 3))
NODES, WEIGHTS = np.polynomial.legendre.leggauss(16)
# v, omega, duration: straight, next to straight, both sides of the series' end, spins, large turns.
ARCS = [
    *((v, omega, 4.0) for v in (0.2, -0.2) for omega in (0.0, 1e-12, 1e-3, -0.2499, 0.2501, 2.0)),
    *((0.0, omega, 4.0) for omega in (1e-12, -1.0, 12.5)),
    *((v, -2.5, 20.0) for v in (0.3, -0.01)),
    *((1.0, omega, 3.0) for omega in (12.5, -12.6)),  # one wheel (almost) at rest, or backwards
    *((0.5, 0.3, duration) for duration in (0.0, 1e-9)),
]


def spectral_density(v, omega, separation=L, k=K):
    """W: `B diag(k |v_R|, k |v_L|) B^T`, from the rim speeds."""
    B = np.array([[0.5, 0.5], [1.0 / separation, -1.0 / separation]])
    rim_speeds = np.array([v + omega * separation / 2.0, v - omega * separation / 2.0])
    return B @ np.diag(k * np.abs(rim_speeds)) @ B.T


def transition(displacement):
    """Phi for a displacement in the world."""
    Phi = np.eye(3)
    Phi[:2, 2] = -displacement[1], displacement[0]
    return Phi


def by_quadrature(covariance, pose, twist, duration):
    """The integral, panel by panel: Gauss-Legendre, exact to rounding on arcs of half a radian."""
    W = spectral_density(*twist)
    panels = 1 + int(2.0 * abs(twist[1]) * duration)
    edges = np.linspace(0.0, duration, panels + 1)
    noise = np.zeros((3, 3))
    for low, high in itertools.pairwise(edges):
        for node, weight in zip(NODES, WEIGHTS, strict=True):
            s = (low + high + node * (high - low)) / 2.0
            theta = pose[2] + twist[1] * s
            still_to_come = integrate([0.0, 0.0, theta], twist, duration - s)[:2]
            g = transition(still_to_come) @ unicycle_jacobian(theta)
            noise += weight * (high - low) / 2.0 * g @ W @ g.T
    Phi = transition(integrate([0.0, 0.0, pose[2]], twist, duration)[:2])
    return Phi @ covariance @ Phi.T + noise


def scales(covariance):
    """What rounding errors are measured by: positions by the larger axis, for they are rotated."""
    position = math.sqrt(covariance[0, 0] + covariance[1, 1])
    deviations = np.array([position, position, math.sqrt(covariance[2, 2])])
    return np.outer(deviations, deviations)


def close(actual, expected, tolerance=1e-13):
    assert np.all(np.abs(actual - expected) <= tolerance * scales(expected))


def propagated(covariance, pose, twist, duration, k=K):
    return propagate_covariance(covariance, pose, twist, duration, L, k)


# --- Identities


@pytest.mark.parametrize(('v', 'omega', 'duration'), ARCS)
def test_the_closed_form_is_the_integral(v, omega, duration):
    for start in (NONE, COVARIANCE):
        actual = propagated(start, START, (v, omega), duration)
        expected = by_quadrature(start, START, (v, omega), duration)
        close(actual, expected)
        assert np.array_equal(actual, actual.T)
        deviations = np.sqrt(np.maximum(np.diag(expected), 1e-300))
        assert np.linalg.eigvalsh(actual / np.outer(deviations, deviations)).min() >= -1e-13


@pytest.mark.parametrize('omega', [1e-12, -1e-6, 1e-3])
def test_across_a_nearly_straight_path_no_digits_are_lost(omega):
    """Along the path, x and y differ by decades: each entry is compared relative to its own size."""
    v, duration = 0.2, 4.0
    pose = np.array([0.0, 0.0, -omega * duration])
    actual = propagated(NONE, pose, (v, omega), duration)
    expected = by_quadrature(NONE, pose, (v, omega), duration)
    deviations = np.sqrt(np.diag(expected))
    assert np.all(np.abs(actual - expected) <= 1e-13 * np.outer(deviations, deviations))


def test_a_straight_path_has_the_textbook_covariance():
    """Along the path k d / 2, in heading 2 k d / L^2, across the path d^2 / 3 of the latter."""
    way = 0.8
    heading = 2.0 * K * way / L**2
    expected = [
        [K * way / 2.0, 0.0, 0.0],
        [0.0, heading * way**2 / 3.0, heading * way / 2.0],
        [0.0, heading * way / 2.0, heading],
    ]
    close(propagated(NONE, np.zeros(3), (0.2, 0.0), 4.0), np.array(expected))


@pytest.mark.parametrize(('v', 'omega', 'duration'), ARCS)
def test_two_pieces_are_one(v, omega, duration):
    whole = propagated(COVARIANCE, START, (v, omega), duration)
    for share in (1e-6, 0.3, 0.9):
        first, second = share * duration, (1.0 - share) * duration
        halfway = propagated(COVARIANCE, START, (v, omega), first)
        pose = integrate(START, (v, omega), first)
        close(propagated(halfway, pose, (v, omega), second), whole)


@pytest.mark.parametrize(('v', 'omega', 'duration'), ARCS)
def test_without_noise_the_start_is_carried_by_the_jacobian_of_the_motion(v, omega, duration):
    step, end = 1e-6, integrate(START, (v, omega), duration)
    columns = [
        (integrate(START + h, (v, omega), duration) - integrate(START - h, (v, omega), duration))
        / (2.0 * step)
        for h in step * np.eye(3)
    ]
    Phi = transition(end[:2] - START[:2])
    np.testing.assert_allclose(np.column_stack(columns), Phi, rtol=0.0, atol=1e-8)
    close(propagated(COVARIANCE, START, (v, omega), duration, k=0.0), Phi @ COVARIANCE @ Phi.T)


@pytest.mark.parametrize(('v', 'omega'), [(0.3, 0.0), (-0.3, 1.0), (0.0, 2.0), (0.1, -4.0)])
def test_the_twist_covariance_is_the_density_over_the_interval(v, omega):
    actual = twist_covariance((v, omega), L, K, 0.02)
    np.testing.assert_allclose(actual, spectral_density(v, omega) / 0.02, rtol=1e-13, atol=1e-18)
    assert np.array_equal(actual, actual.T)


# --- Monte Carlo: 5,000 noisy wheels


def assert_same_within_sampling_error(samples, expected, standard_errors=5.0):
    """Hold each entry of the covariance of whitened samples against the identity.

    Whitening by the Cholesky factor of the expected covariance asks for every direction at its own
    size. Of n Gaussian samples the entries have standard errors sqrt(2/n) on and sqrt(1/n) off the
    diagonal, the means sqrt(1/n). Five of them are allowed: 1 seed in 10^5 would fail by chance.
    """
    count, size = samples.shape
    whitened = np.linalg.solve(np.linalg.cholesky(expected), samples.T)
    error = np.sqrt((1.0 + np.eye(size)) / count)
    assert np.all(np.abs(np.cov(whitened) - np.eye(size)) < standard_errors * error)
    assert np.all(np.abs(whitened.mean(axis=1)) < standard_errors / math.sqrt(count))


@pytest.mark.parametrize(
    ('v', 'omega', 'duration', 'start'),
    [
        *((0.2, 0.7, 5.0, start) for start in (NONE, 1e-4 * COVARIANCE)),
        *((v, omega, 3.0, NONE) for v, omega in ((-0.2, 0.0), (0.05, -3.0), (0.0, 1.0))),
    ],
)
def test_five_thousand_noisy_wheels_have_the_reported_covariances(v, omega, duration, start):
    """Each wheel's travel is perturbed in 50 sub-steps by a variance of k times its distance.

    k is so small that the motion is linear in the noise to 1e-4 of it, far below the sampling error.
    """
    count, steps, k = 5_000, 50, 1e-9
    rng = np.random.default_rng(2)
    travel = np.array([v + omega * L / 2.0, v - omega * L / 2.0]) * duration
    poses = START + rng.multivariate_normal(np.zeros(3), start, count)
    means = np.zeros((count, 2))
    for _ in range(steps):
        noise = np.sqrt(k * np.abs(travel) / steps) * rng.normal(size=(count, 2))
        right, left = (travel / steps + noise).T
        moved = np.column_stack([(right + left) / 2.0, (right - left) / L])
        poses = integrate(poses, moved, 1.0)
        means += moved / duration
    deviations = poses - integrate(START, (v, omega), duration)
    deviations[:, 2] = np.arctan2(np.sin(deviations[:, 2]), np.cos(deviations[:, 2]))
    expected = propagated(start, START, (v, omega), duration, k)
    assert_same_within_sampling_error(deviations, expected)
    assert_same_within_sampling_error(means - [v, omega], twist_covariance((v, omega), L, k, duration))


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'dt': [1.0, -1.0]}, 'dt must be zero or positive'),
        ({'wheel_travel_variance': -1e-5}, 'wheel_travel_variance must be zero or positive'),
        ({'L': 0.0}, 'L must be positive'),
        ({'covariance': -np.eye(3)}, 'covariance must be symmetric and positive semidefinite'),
        ({'covariance': [np.eye(3), [[1, 2, 0], [2, 1, 0], [0, 0, 1]]]}, 'covariance must be symmetric'),
        ({'covariance': [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]}, 'covariance must be symmetric'),
        ({'covariance': 0.9 * np.ones((3, 3)) - 0.5 * np.eye(3)}, 'covariance must be symmetric'),
    ],
)
def test_nothing_that_gives_negative_variances_is_accepted(changes, message):
    valid = {'covariance': COVARIANCE, 'pose': START, 'twist': (0.2, 0.1), 'dt': 1.0, 'L': L}
    with pytest.raises(ValueError, match=f'^{message}'):
        propagate_covariance(**valid | {'wheel_travel_variance': K} | changes)
