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

"""SE(2): wrapping, the group, its exponential, the exact arc of a held twist, the Jacobians of exp.

Laws are checked for one batch of random poses and twists. On purpose many turns are next to zero and
next to half a turn, where formulas lose digits.
"""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest

from diffdrive_jacobian.kinematics import se2

TURN = 2.0 * np.pi
EPS = np.finfo(float).eps
COUNT = 500
ORIGIN = np.zeros(3)


def random_turns(rng):
    small, from_half_a_turn = 10.0 ** rng.uniform([[-300.0], [-15.0]], 0.0, (2, COUNT))
    choices = small, np.pi - from_half_a_turn, rng.uniform(0.0, np.pi, COUNT)
    return rng.choice([-1.0, 1.0], COUNT) * np.choose(rng.integers(3, size=COUNT), choices)


def random_poses(seed):
    """Return poses, or twists for unit time."""
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-1e3, 1e3, (COUNT, 2)), random_turns(rng)])


A, B = map(random_poses, range(2))


def size(*vectors):
    """Return the scale of rounding errors in positions, shape (COUNT,)."""
    return 1e-14 * sum(np.abs(vector[..., :2]).sum(axis=-1) for vector in vectors)


def assert_same_pose(actual, expected, tolerance):
    assert np.all(tolerance >= np.abs(actual - expected)[..., :2].T)
    np.testing.assert_allclose(se2.wrap_angle(actual - expected)[..., 2], 0.0, atol=1e-14)


# --- Angles


def test_wrapping_is_the_exact_remainder_and_leaves_angles_inside_as_they_are():
    edges = [
        *(sign * multiple * np.pi for sign in (-1, 1) for multiple in (0, 1, 2, 3, 4, 5, 101)),
        *(np.nextafter(edge, to) for edge in (-np.pi, np.pi, 3.0 * np.pi) for to in (-np.inf, np.inf)),
        *(1e15, -1e15, 1e22, -1e100, 1.7e308, 5e-324, -5e-324),
    ]
    rng = np.random.default_rng(3)
    angles = [*edges, *A[:, 2], *(rng.choice([-1.0, 1.0], COUNT) * 10.0 ** rng.uniform(-1, 20, COUNT))]
    # The IEEE remainder by the double 2 pi is exact; only the lower end of its range is moved.
    exact = [math.remainder(angle, TURN) for angle in angles]
    exact = [math.pi if rest == -math.pi else rest for rest in exact]
    assert se2.wrap_angle(angles).tolist() == exact
    assert [se2.wrap_angle(float(angle)) for angle in edges] == exact[: len(edges)]
    assert se2.wrap_angle(exact).tolist() == exact
    assert np.array_equal(se2.wrap_angle(A[:, 2]), A[:, 2])


# --- The group and its exponential


def test_exp_and_log_undo_each_other_and_log_takes_the_least_turn():
    back = se2.log(se2.exp(A))
    assert np.all(size(A) >= np.abs(back - A)[:, :2].T)
    assert np.array_equal(back[:, 2], A[:, 2])
    windings = np.random.default_rng(4).integers(-2, 3, COUNT)
    twist = se2.log(A + np.outer(windings, [0.0, 0.0, TURN]))
    assert_same_pose(se2.exp(twist), A, size(A))
    assert np.all((twist[:, 2] > -np.pi) & (twist[:, 2] <= np.pi))


def test_exp_makes_one_parameter_groups():
    s, t = np.random.default_rng(5).uniform(-3.0, 3.0, (2, COUNT, 1))
    both = se2.compose(se2.exp(s * A), se2.exp(t * A))
    assert_same_pose(se2.exp((s + t) * A), both, 10.0 * size(A))
    assert_same_pose(se2.exp(-A), se2.inverse(se2.exp(A)), size(A))


def test_poses_compose_and_are_inverted_as_their_homogeneous_transforms():
    H_a, tolerance = se2.homogeneous(A), (size(A, B) + 1e-14)[:, np.newaxis, np.newaxis]
    product = H_a @ se2.homogeneous(B)
    assert np.all(np.abs(se2.homogeneous(se2.compose(A, B)) - product) <= tolerance)
    assert np.all(np.abs(se2.homogeneous(se2.inverse(A)) @ H_a - np.eye(3)) <= tolerance)
    assert_same_pose(se2.compose(A, ORIGIN), A, 0.0)


def test_homogeneous_transforms_have_position_and_heading():
    H_a = se2.homogeneous(A)
    assert np.array_equal(H_a[:, :2, 2], A[:, :2])
    assert np.array_equal(H_a[:, 2], np.tile([0.0, 0.0, 1.0], (COUNT, 1)))
    np.testing.assert_allclose(np.arctan2(H_a[:, 1, 0], H_a[:, 0, 0]), A[:, 2], rtol=1e-15, atol=1e-15)
    # In space the same motion, about the vertical: heights stay.
    in_space, plane = se2.homogeneous_3d(A), np.ix_(range(COUNT), [0, 1, 3], [0, 1, 3])
    assert np.array_equal(in_space[plane], H_a)
    assert np.array_equal(in_space[:, 2], np.tile([0.0, 0.0, 1.0, 0.0], (COUNT, 1)))
    assert not in_space[:, [0, 1, 3], 2].any()


# --- The exact arc


def test_integration_is_composition_with_the_exponential_and_goes_back_in_time():
    rng = np.random.default_rng(6)
    twist, dt = rng.uniform([-1e3, -5.0], [1e3, 5.0], (COUNT, 2)), rng.uniform(-10.0, 10.0, COUNT)
    twist[:5, 1] = 0.0
    moved = np.insert(twist, 1, 0.0, axis=1) * dt[:, np.newaxis]
    reached, tolerance = se2.integrate(A, twist, dt), 50.0 * size(A, moved)
    # A heading of up to 50 rad is known to 50 eps only.
    assert_same_pose(reached, se2.compose(A, se2.exp(moved)), tolerance)
    assert_same_pose(se2.integrate(reached, twist, -dt), A, tolerance)
    assert np.all((reached[:, 2] > -np.pi) & (reached[:, 2] <= np.pi))
    straight = se2.integrate(ORIGIN, twist[:5], dt[:5])
    assert np.array_equal(straight, moved[:5])


def test_a_minute_of_arc_is_the_closed_form_and_not_eulers():
    v, omega, duration, rate = 0.22, 0.5, 60.0, 50
    a, radius = omega * duration, v / omega
    exact = np.array([radius * math.sin(a), radius * (1.0 - math.cos(a)), math.remainder(a, TURN)])
    steps, euler = ORIGIN, np.zeros(3)
    for _ in range(int(duration * rate)):
        steps = se2.integrate(steps, (v, omega), 1.0 / rate)
        euler += np.array([v * math.cos(euler[2]), v * math.sin(euler[2]), omega]) / rate
    for reached in (se2.integrate(ORIGIN, (v, omega), duration), steps):
        np.testing.assert_allclose(reached, exact, rtol=0.0, atol=1e-9)
    assert 2.8e-3 < np.hypot(*(euler - exact)[:2]) < 3.0e-3


def arc_by_series(distance, turn):
    """Return `distance [sin(a)/a, (1 - cos a)/a]` in rational numbers, to 40 digits for |a| <= 1."""
    a, n, term = Fraction(turn), 1, Fraction(1)
    along = across = Fraction(0)
    while abs(term) > 1e-40:
        along += term / n
        across += term * a / (n * (n + 1))
        # a^(n - 1) / (n - 1)! with alternating signs.
        term *= -a * a / (n * (n + 1))
        n += 2
    return Fraction(distance) * along, Fraction(distance) * across


def test_small_turns_lose_no_digits():
    turns = A[np.abs(A[:, 2]) < 1.0, 2][:50]
    reached = se2.integrate(ORIGIN, np.column_stack([A[: len(turns), 0], turns]), 1.0)
    for distance, (x, y, turn) in zip(A[:, 0], reached, strict=False):
        for found, exact in zip((x, y), arc_by_series(distance, turn), strict=True):
            # The last summand is for numbers below the smallest normal one.
            assert abs(Fraction(found) - exact) <= 4.0 * EPS * abs(exact) + Fraction(1, 10**300)
    np.testing.assert_allclose(se2.sinc(turns), np.sin(turns) / turns, rtol=4.0 * EPS)
    assert se2.sinc(0.0) == 1.0


# --- Adjoint and the Jacobians of exp. That these are derivatives, test_jacobians.py shows


def test_the_adjoint_carries_a_motion_into_the_world_and_composes_as_poses_do():
    carried = np.einsum('kij,kj->ki', se2.adjoint(A), B)
    moved = se2.compose(A, se2.exp(B))
    assert_same_pose(se2.compose(se2.exp(carried), A), moved, 10.0 * (size(A, B) + 1e-14 * np.pi * 1e3))
    product = se2.adjoint(A) @ se2.adjoint(B)
    np.testing.assert_allclose(product, se2.adjoint(se2.compose(A, B)), rtol=0.0, atol=1e-11)


@pytest.mark.parametrize('turn', [1e-2, 1e-200, 0.0])
def test_the_jacobians_of_exp_lose_no_digits_near_zero(turn):
    """The series `J = sum of ad^n / (n + 1)!`, ad the matrix of the Lie bracket."""
    vx, vy = 2.0, -3.0
    ad = np.array([[0.0, -turn, vy], [turn, 0.0, -vx], [0.0, 0.0, 0.0]])
    series = sum(np.linalg.matrix_power(ad, n) / math.factorial(n + 1) for n in range(9))
    left = se2.left_jacobian([vx, vy, turn])
    np.testing.assert_allclose(left, series, rtol=1e-14, atol=1e-300)
