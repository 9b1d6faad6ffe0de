"""Arms, tasks and random joints that the tests of inverse kinematics share."""

from __future__ import annotations

import numpy as np

from diffdrive_jacobian.kinematics.inverse_kinematics import pose_difference, solve
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm

TOLERANCE = 1e-6
ROUNDING = 1.0 + 1e-14
"""Lengths of the same error that are computed in two ways differ by a few units in the last place."""
DOWNHILL = ('transpose', 'levenberg_marquardt')
TWO, THREE, FIVE = (PlanarArm(lengths) for lengths in ([1.0, 0.7], [1.0, 0.7, 0.4], [0.5] * 5))
LONG_FIRST = (PlanarArm([1.0, 0.7]), PlanarArm([1.0, 0.3, 0.2]))


class Task:
    """An arm's position or pose, and what was asked of it."""

    def __init__(self, arm, heading=False):
        self.arm, self.heading, self.asked, self.derived = arm, heading, [], []

    def forward(self, q):
        self.asked.append(len(q))
        return self.arm.forward_kinematics(q)[:, : 3 if self.heading else 2]

    def jacobian(self, q):
        self.derived.append(q.copy())
        return self.arm.jacobian(q, heading=self.heading)

    def solve(self, target, q0, **options):
        if self.heading:
            options.setdefault('difference', pose_difference)
        return solve(self.forward, self.jacobian, target, q0, **options)


def configurations(arm, count, seed=0):
    """Random ones, joints bent by 20 to 150 degrees: none next to a singularity."""
    rng = np.random.default_rng(seed)
    q = rng.choice([-1.0, 1.0], (count, 1)) * rng.uniform(0.35, 2.6, (count, arm.joints))
    q[:, 0] = rng.uniform(-np.pi, np.pi, count)
    return q


def anywhere(arm, count, seed=1):
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, (count, arm.joints))


def at(distance, angle):
    return np.stack([distance * np.cos(angle), distance * np.sin(angle)], axis=-1)


def unreachable(arm, where, count=60):
    """Give targets, the reachable points nearest to them, and how far these are."""
    rng = np.random.default_rng(3)
    reach, angle = arm.lengths.sum(), rng.uniform(-np.pi, np.pi, count)
    if where == 'too far':
        distance, nearest = reach * rng.uniform(1.02, 2.0, count), reach
    else:
        nearest = 2.0 * arm.lengths.max() - reach
        distance = nearest * rng.uniform(0.3, 0.9, count)
    return at(distance, angle), at(nearest, angle), np.abs(distance - nearest)


def assert_same(actual, expected):
    assert np.array_equal(actual.converged, expected.converged)
    for name in ('iterations', 'restarts', 'start'):
        assert np.array_equal(getattr(actual, name), getattr(expected, name)), name
    np.testing.assert_allclose(actual.q, expected.q, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(actual.error, expected.error, rtol=0.0, atol=1e-9)
