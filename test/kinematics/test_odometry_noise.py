"""The covariance of odometry: the integral along the arc, by quadrature.

That noisy wheels have it, test/simulation/test_exact_moments.py shows.
"""

from __future__ import annotations

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
TWISTS, DURATIONS = np.array(ARCS)[:, :2], np.array(ARCS)[:, 2]


def spectral_density(v, omega):
    """W: `B diag(K |v_R|, K |v_L|) B^T`, from the rim speeds."""
    B = np.array([[0.5, 0.5], [1.0 / L, -1.0 / L]])
    rim_speeds = np.array([v + omega * L / 2.0, v - omega * L / 2.0])
    return B @ np.diag(K * np.abs(rim_speeds)) @ B.T


def transition(displacement):
    """Phi for displacements in the world, shape (..., 2)."""
    Phi = np.broadcast_to(np.eye(3), (*displacement.shape[:-1], 3, 3)).copy()
    Phi[..., 0, 2], Phi[..., 1, 2] = -displacement[..., 1], displacement[..., 0]
    return Phi


def by_quadrature(covariance, pose, twist, duration):
    """The integral, panel by panel: Gauss-Legendre, exact to rounding on arcs of half a radian."""
    edges = np.linspace(0.0, duration, 2 + int(2.0 * abs(twist[1]) * duration))
    half = np.diff(edges)[:, np.newaxis] / 2.0
    s, weights = (edges[:-1, np.newaxis] + half * (1.0 + NODES)).ravel(), (half * WEIGHTS).ravel()
    theta = pose[2] + twist[1] * s
    still_to_come = integrate(np.outer(theta, [0.0, 0.0, 1.0]), twist, duration - s)[:, :2]
    g = transition(still_to_come) @ unicycle_jacobian(theta)
    noise = np.einsum('s,sij,jk,slk->il', weights, g, spectral_density(*twist), g)
    Phi = transition(integrate([0.0, 0.0, pose[2]], twist, duration)[:2])
    return Phi @ covariance @ Phi.T + noise


def close(actual, expected):
    """Compare by what rounding errors are measured by: positions by the larger axis, as they rotate."""
    variances = np.diagonal(expected, axis1=-2, axis2=-1)
    deviations = np.sqrt(variances[..., [0, 0, 2]] + variances[..., [1, 1, 2]] * [1.0, 1.0, 0.0])
    scales = deviations[..., :, np.newaxis] * deviations[..., np.newaxis, :]
    assert np.all(np.abs(actual - expected) <= 1e-13 * scales)


def propagated(covariance, pose, twist, duration, k=K):
    return propagate_covariance(covariance, pose, twist, duration, L, k)


@pytest.mark.parametrize('start', [NONE, COVARIANCE], ids=['certain', 'uncertain'])
def test_the_closed_form_is_the_integral(start):
    actual = propagated(start, START, TWISTS, DURATIONS)
    expected = [by_quadrature(start, START, *arc) for arc in zip(TWISTS, DURATIONS, strict=True)]
    close(actual, np.array(expected))
    assert np.array_equal(actual, np.swapaxes(actual, 1, 2))


def test_across_a_nearly_straight_path_no_digits_are_lost():
    """Along the path, x and y differ by decades: each entry is compared relative to its own size."""
    for omega in (1e-12, 1e-3):
        arc = [0.0, 0.0, -4.0 * omega], np.array([0.2, omega]), 4.0
        actual, expected = propagated(NONE, *arc), by_quadrature(NONE, *arc)
        deviations = np.sqrt(np.diag(expected))
        assert np.all(np.abs(actual - expected) <= 1e-13 * np.outer(deviations, deviations))


def test_the_twist_covariance_is_the_density_over_the_interval():
    for twist in ((0.3, 0.0), (-0.3, 1.0), (0.0, 2.0), (0.1, -4.0)):
        actual = twist_covariance(twist, L, K, 0.02)
        np.testing.assert_allclose(actual, spectral_density(*twist) / 0.02, rtol=1e-13, atol=1e-18)


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'dt': [1.0, -1.0]}, 'dt must be zero or positive'),
        ({'wheel_travel_variance': -1e-5}, 'wheel_travel_variance must be zero or positive'),
        ({'covariance': [np.eye(3), -np.eye(3)]}, 'covariance must be symmetric and positive semidef'),
        ({'covariance': [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]}, 'covariance must be symmetric'),
        ({'covariance': 0.9 * np.ones((3, 3)) - 0.5 * np.eye(3)}, 'covariance must be symmetric'),
    ],
)
def test_nothing_that_gives_negative_variances_is_accepted(changes, message):
    valid = {'covariance': COVARIANCE, 'pose': START, 'twist': (0.2, 0.1), 'dt': 1.0, 'L': L}
    with pytest.raises(ValueError, match=f'^{message}'):
        propagate_covariance(**valid | {'wheel_travel_variance': K} | changes)
