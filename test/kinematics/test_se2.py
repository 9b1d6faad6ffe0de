"""SE(2): wrapping, the group, its exponential, and the exact arc of a held twist."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from diffdrive_jacobian.kinematics import se2

TURN = 2.0 * np.pi
EPS = np.finfo(float).eps
deterministic = settings(deadline=None, derandomize=True, max_examples=60)

lengths = st.floats(-1e3, 1e3)
# On purpose often next to zero and next to half a turn, where formulas lose digits.
signs = st.sampled_from([-1.0, 1.0])
small_turns = st.builds(lambda sign, n: sign * 10.0**n, signs, st.floats(-300.0, 0.0))
turns = st.one_of(
    st.floats(-math.pi, math.pi, exclude_min=True),
    small_turns,
    st.builds(lambda sign, n: sign * (math.pi - 10.0**n), signs, st.floats(-15.0, 0.0)),
)
poses = twists = st.tuples(lengths, lengths, turns).map(np.array)
durations = st.floats(-10.0, 10.0)
EDGES = [
    *(sign * multiple * np.pi for sign in (-1, 1) for multiple in (0, 1, 2, 3, 4, 5, 101)),
    *(np.nextafter(edge, to) for edge in (-np.pi, np.pi, 3.0 * np.pi) for to in (-np.inf, np.inf)),
    *(1e15, -1e15, 1e22, -1e100, 1.7e308, 5e-324, -5e-324),
]


def wrapped_exactly(angle: float) -> float:
    """The IEEE remainder by the double 2 pi is exact; only the lower end of its range is moved."""
    rest = math.remainder(angle, TURN)
    return math.pi if rest == -math.pi else rest


def assert_same_pose(actual, expected, tolerance):
    np.testing.assert_allclose(actual[..., :2], expected[..., :2], rtol=0.0, atol=tolerance)
    turn = se2.wrap_angle(np.subtract(actual[..., 2], expected[..., 2]))
    np.testing.assert_allclose(turn, 0.0, atol=1e-14)


def size(*vectors) -> float:
    """The scale of rounding errors in positions; the tiny summand is for numbers below all scales."""
    return 1e-14 * sum(np.abs(vector[:2]).sum() for vector in vectors) + 1e-290


def arc_by_series(way: float, turn: float) -> tuple[Fraction, Fraction]:
    """Return `way [sin(a)/a, (1 - cos a)/a]` in rational numbers, to 40 digits for |a| <= 1."""
    a, n = Fraction(turn), 1
    along = across = Fraction(0)
    term = Fraction(1)
    while abs(term) > 1e-40:
        along += term / n
        across += term * a / (n * (n + 1))
        # a^(n - 1) / (n - 1)! with alternating signs.
        term *= -a * a / (n * (n + 1))
        n += 2
    return Fraction(way) * along, Fraction(way) * across


# --- Angles


def test_wrap_is_the_exact_remainder_at_the_edges_in_any_shape():
    exact = [wrapped_exactly(angle) for angle in EDGES]
    assert [se2.wrap_angle(angle) for angle in EDGES] == exact
    assert np.array_equal(se2.wrap_angle(np.reshape(EDGES, (3, 9))), np.reshape(exact, (3, 9)))


@deterministic
@given(st.one_of(st.floats(allow_nan=False, allow_infinity=False), turns))
def test_wrap_is_the_exact_remainder_and_leaves_what_is_inside_to_the_last_bit(angle):
    wrapped = se2.wrap_angle(angle)
    assert -math.pi < wrapped <= math.pi
    assert wrapped == wrapped_exactly(angle)
    assert se2.wrap_angle(wrapped) == wrapped
    if -math.pi < angle <= math.pi:
        assert wrapped == angle


# --- The group and its exponential


@deterministic
@given(twists)
def test_log_undoes_exp(twist):
    back = se2.log(se2.exp(twist))
    np.testing.assert_allclose(back[:2], twist[:2], rtol=0.0, atol=size(twist))
    assert back[2] == twist[2]


@deterministic
@given(poses, st.integers(-2, 2))
def test_exp_undoes_log_which_takes_the_least_turn(pose, windings):
    twist = se2.log(np.add(pose, [0.0, 0.0, windings * TURN]))
    assert_same_pose(se2.exp(twist), pose, size(pose))
    assert -math.pi < twist[2] <= math.pi


@deterministic
@given(twists, st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))
def test_exp_makes_one_parameter_groups(twist, s, t):
    both = se2.compose(se2.exp(s * twist), se2.exp(t * twist))
    assert_same_pose(se2.exp((s + t) * twist), both, 10.0 * size(twist))
    assert_same_pose(se2.exp(-twist), se2.inverse(se2.exp(twist)), size(twist))


@deterministic
@given(poses, poses, poses)
def test_group_axioms(a, b, c):
    identity = np.zeros(3)
    left, right = se2.compose(se2.compose(a, b), c), se2.compose(a, se2.compose(b, c))
    assert_same_pose(left, right, size(a, b, c))
    assert_same_pose(se2.compose(a, se2.inverse(a)), identity, size(a))
    assert_same_pose(se2.compose(se2.inverse(a), a), identity, size(a))
    assert_same_pose(se2.compose(a, identity), a, 0.0)
    assert_same_pose(se2.compose(identity, a), a, 0.0)


@deterministic
@given(poses, poses)
def test_homogeneous_is_a_homomorphism_into_rigid_transforms(a, b):
    tolerance = size(a, b) + 1e-14
    H_a, H_b = se2.homogeneous(a), se2.homogeneous(b)
    np.testing.assert_allclose(se2.homogeneous(se2.compose(a, b)), H_a @ H_b, rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(se2.homogeneous(se2.inverse(a)) @ H_a, np.eye(3), atol=tolerance)
    np.testing.assert_allclose(H_a[:2, :2].T @ H_a[:2, :2], np.eye(2), atol=1e-15)
    assert np.array_equal(H_a[2], [0.0, 0.0, 1.0])
    assert np.array_equal(H_a[:2, 2], a[:2])
    assert math.atan2(H_a[1, 0], H_a[0, 0]) == pytest.approx(a[2], rel=1e-15, abs=1e-15)
    assert np.linalg.det(H_a) == pytest.approx(1.0)
    # In space the same motion, about the vertical: heights stay.
    in_space, plane = se2.homogeneous_3d(a), [0, 1, 3]
    assert np.array_equal(in_space[np.ix_(plane, plane)], H_a)
    assert np.array_equal(in_space @ [0.0, 0.0, 2.0, 1.0], [*a[:2], 2.0, 1.0])
    assert np.array_equal(in_space[[2, 3]], np.eye(4)[[2, 3]])


# --- The exact arc


@deterministic
@given(poses, lengths, st.floats(-5.0, 5.0), durations)
def test_integrate_is_composition_with_the_exponential(pose, v, omega, dt):
    arc = se2.exp([v * dt, 0.0, omega * dt])
    # A heading of up to 50 rad is known to 50 eps only.
    tolerance = 50.0 * size(pose, [v * dt])
    reached = se2.integrate(pose, [v, omega], dt)
    assert_same_pose(reached, se2.compose(pose, arc), tolerance)
    assert_same_pose(se2.integrate(reached, [v, omega], -dt), pose, tolerance)


def test_a_minute_of_arc_is_the_closed_form_and_not_eulers():
    v, omega, duration, rate = 0.22, 0.5, 60.0, 50
    a, radius = omega * duration, v / omega
    exact = np.array([radius * math.sin(a), radius * (1.0 - math.cos(a)), math.remainder(a, TURN)])
    steps, euler = np.zeros(3), np.zeros(3)
    for _ in range(int(duration * rate)):
        steps = se2.integrate(steps, (v, omega), 1.0 / rate)
        euler += np.array([v * math.cos(euler[2]), v * math.sin(euler[2]), omega]) / rate
    for reached in (se2.integrate(np.zeros(3), (v, omega), duration), steps):
        assert np.hypot(*(reached - exact)[:2]) < 1e-9
        assert abs(reached[2] - exact[2]) < 1e-9
    assert 2.8e-3 < np.hypot(*(euler - exact)[:2]) < 3.0e-3


@deterministic
@example(0.22, 1e-12, 60.0)
@given(lengths, small_turns, st.floats(1e-3, 1.0))
def test_small_turns_lose_no_digits(v, omega, dt):
    x, y, theta = se2.integrate(np.zeros(3), (v, omega), dt)
    x_exact, y_exact = arc_by_series(v * dt, omega * dt)
    # The last summand is for numbers below the smallest normal one.
    assert abs(Fraction(x) - x_exact) <= 4.0 * EPS * abs(x_exact) + Fraction(1, 10**300)
    assert abs(Fraction(y) - y_exact) <= 4.0 * EPS * abs(y_exact) + Fraction(1, 10**300)
    assert theta == omega * dt


@deterministic
@given(lengths, durations)
def test_a_straight_run_is_the_product(v, dt):
    assert se2.integrate(np.zeros(3), (v, 0.0), dt).tolist() == [v * dt, 0.0, 0.0]


@deterministic
@given(poses, st.floats(-2.0, 2.0), st.floats(0.1, 10.0), st.sampled_from([-3, -1, 1, 2]))
def test_full_turns_return_to_the_start(pose, v, omega, circles):
    duration = circles * TURN / omega
    end = se2.integrate(pose, (v, omega), duration)
    ulps = np.spacing(np.abs(pose[:2]) + abs(v * duration))
    assert np.all(np.abs(end - pose)[:2] <= 4.0 * ulps)
    assert abs(se2.wrap_angle(end[2] - pose[2])) <= 4.0 * np.spacing(abs(circles) * TURN)


def test_many_steps_keep_the_heading_wrapped_and_the_pose_finite():
    """Rounding moves a heading by half an ulp of pi at most in each step."""
    dt, steps = 0.1, 1_000
    twists = np.random.default_rng(1).normal(0.0, [1.0, 5.0], (steps, 10, 2))
    pose, path = np.zeros((10, 3)), np.empty((steps, 10, 3))
    for index, twist in enumerate(twists):
        path[index] = pose = se2.integrate(pose, twist, dt)
    assert path[..., 2].min() > -np.pi
    assert path[..., 2].max() <= np.pi
    for heading, turns in zip(pose[:, 2], (twists[..., 1] * dt).T, strict=True):
        assert abs(math.remainder(heading - math.fsum(turns), TURN)) < steps * EPS
    # No step is longer than v dt.
    moved = np.hypot(*np.moveaxis(np.diff(path[..., :2], axis=0), -1, 0))
    assert np.all(moved <= np.abs(twists[1:, :, 0] * dt) + 1e-12)


# --- Adjoint and the Jacobians of exp

TWISTS = [
    [vx, vy, turn]
    for vx, vy in ((0.0, 0.0), (100.0, 30.0))
    for turn in (0.0, 1e-300, -1e-4, -0.99, 1.01, 3.1, -6.0, 9.5)
]


@deterministic
@given(poses, twists, poses)
def test_the_adjoint_carries_a_motion_into_the_world_and_is_a_homomorphism(pose, twist, other):
    moved = se2.compose(pose, se2.exp(twist))
    carried = se2.compose(se2.exp(se2.adjoint(pose) @ twist), pose)
    scale = size(pose, twist, np.array([np.pi * 1e3, 0.0]))
    assert_same_pose(carried, moved, 10.0 * scale)
    product = se2.adjoint(pose) @ se2.adjoint(other)
    np.testing.assert_allclose(product, se2.adjoint(se2.compose(pose, other)), rtol=0.0, atol=1e-11)
    back = se2.adjoint(pose) @ se2.adjoint(se2.inverse(pose))
    np.testing.assert_allclose(back, np.eye(3), rtol=0.0, atol=1e-11)


@pytest.mark.parametrize('twist', TWISTS, ids=str)
def test_both_jacobians_of_exp_describe_one_motion_and_are_the_identity_along_the_twist(twist):
    """That the right one is the derivative, test_jacobians.py shows."""
    tolerance = 1e-13 * (1.0 + math.hypot(twist[0], twist[1]))
    left, right = se2.left_jacobian(twist), se2.right_jacobian(twist)
    carried = se2.adjoint(se2.exp(twist)) @ right
    np.testing.assert_allclose(left, carried, rtol=0.0, atol=tolerance)
    np.testing.assert_allclose([left @ twist, right @ twist], [twist] * 2, rtol=0.0, atol=tolerance)


@pytest.mark.parametrize('turn', [1e-2, 1e-5, 1e-9, 1e-200, 0.0])
def test_the_jacobians_of_exp_lose_no_digits_near_zero(turn):
    """The series `J = sum of ad^n / (n + 1)!`, ad the matrix of the Lie bracket."""
    vx, vy = 2.0, -3.0
    ad = np.array([[0.0, -turn, vy], [turn, 0.0, -vx], [0.0, 0.0, 0.0]])
    series = sum(np.linalg.matrix_power(ad, n) / math.factorial(n + 1) for n in range(9))
    left = se2.left_jacobian([vx, vy, turn])
    np.testing.assert_allclose(left, series, rtol=1e-14, atol=1e-300)
