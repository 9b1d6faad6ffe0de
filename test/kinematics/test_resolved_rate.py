"""Resolved rate: tips along straight lines, inside what they can reach, at its edge and beyond."""

from __future__ import annotations

import math

import numpy as np
import pytest

from diffdrive_jacobian.control import resolved_rate
from diffdrive_jacobian.control.resolved_rate import StraightLine
from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.kinematics.inverse_velocity import (
    joint_limit_cost,
    joint_limit_gradient,
    manipulability,
    manipulability_gradient,
)
from diffdrive_jacobian.kinematics.mobile_manipulator import MobileManipulator
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm
from diffdrive_jacobian.simulation import track_line

ARM = PlanarArm([1.0, 0.8])
INTERIOR = ([1.2, 0.3], [-0.4, 1.1])
REDUNDANT = PlanarArm([0.6, 0.5, 0.4])


def elbow(tip):
    """Joint angles of ARM that put its tip there."""
    return ARM.inverse_kinematics(tip)[..., 0, :]


def tip_error(robot, line, gone):
    """How far the tips are from where they should be, by the samples' configurations."""
    wanted = np.array([line.position(t) for t in gone.times])
    return np.linalg.norm(robot.forward_kinematics(gone.q)[..., :2] - wanted, axis=-1)


# --- The law


@pytest.mark.parametrize(('m', 'n'), [(1, 2), (2, 2), (2, 4), (3, 3), (3, 5)])
def test_the_law_is_the_pseudoinverse_of_velocity_and_feedback_with_a_motion_in_the_null_space(m, n):
    rng = np.random.default_rng(1)
    J, wish = rng.normal(size=(100, m, n)), rng.normal(size=(100, n))
    x, x_desired, x_dot = rng.normal(size=(3, 100, m))
    K, damping = rng.uniform(0.0, 9.0, (2, 100))
    task = x_dot + K[:, np.newaxis] * (x_desired - x)
    inverse = np.linalg.pinv(J)
    q_dot = resolved_rate(J, x, x_desired, x_dot, K)
    np.testing.assert_allclose(q_dot, (inverse @ task[..., np.newaxis])[..., 0], rtol=1e-8, atol=1e-8)
    besides = ((np.eye(n) - inverse @ J) @ wish[..., np.newaxis])[..., 0]
    moved = resolved_rate(J, x, x_desired, x_dot, K, 0.0, wish)
    np.testing.assert_allclose(moved, q_dot + besides, rtol=1e-7, atol=1e-7)
    square = J @ np.swapaxes(J, -1, -2) + damping[:, np.newaxis, np.newaxis] ** 2 * np.eye(m)
    damped = np.swapaxes(J, -1, -2) @ np.linalg.solve(square, task[..., np.newaxis])
    found = resolved_rate(J, x, x_desired, x_dot, K, damping)
    np.testing.assert_allclose(found, damped[..., 0], rtol=1e-7, atol=1e-7)


def test_the_feedback_grows_to_its_limit_and_keeps_its_direction():
    rng = np.random.default_rng(2)
    ahead, longest = 10.0 ** rng.uniform(-3.0, 2.0, (2, 200))
    bearing = rng.uniform(-np.pi, np.pi, 200)
    unit = np.stack([np.cos(bearing), np.sin(bearing)], -1)
    away = ahead[:, np.newaxis] * unit
    found = resolved_rate(np.eye(2), np.zeros(2), away, [0.3, 0.0], 5.0, max_correction=longest)
    expected = np.minimum(5.0 * ahead, longest)[:, np.newaxis] * unit + [0.3, 0.0]
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def test_arguments_of_the_law_broadcast():
    rng = np.random.default_rng(3)
    J, x, K = rng.normal(size=(4, 1, 2, 3)), rng.normal(size=(5, 2)), rng.uniform(0.0, 5.0, (4, 1))
    damping, wish = rng.uniform(0.0, 1.0, 5), rng.normal(size=(4, 1, 3))
    found = resolved_rate(J, x, [1.0, 2.0], [0.1, 0.2], K, damping, wish, max_correction=3.0)
    assert found.shape == (4, 5, 3)
    for i, j in np.ndindex(4, 5):
        one = (J[i, 0], x[j], [1.0, 2.0], [0.1, 0.2], K[i, 0], damping[j], wish[i, 0])
        np.testing.assert_allclose(found[i, j], resolved_rate(*one, max_correction=3.0), atol=1e-12)


def test_a_line_is_driven_at_its_speed_and_then_rests():
    line = StraightLine([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]], [3.0, 4.0], [1.0, 2.0, 0.5])
    np.testing.assert_allclose(line.duration, [5.0, math.sqrt(13.0) / 2.0, math.sqrt(5.0) / 0.5])
    assert np.array_equal(line.position(0.0), line.start)
    np.testing.assert_allclose(line.position(1.0)[0], [0.6, 0.8])
    assert np.array_equal(line.position(100.0), [[3.0, 4.0]] * 3)
    point = StraightLine([1.0, 2.0], [1.0, 2.0], 1.0)
    assert point.duration == 0.0
    assert point.position(0.0).tolist() == point.position(5.0).tolist() == [1.0, 2.0]


# --- Inside


@pytest.mark.parametrize('robot', [REDUNDANT, MobileManipulator(0.5, 0.5, REDUNDANT)])
def test_position_and_heading_follow_a_line_also_across_pi_and_around(robot):
    q0 = np.array([0.3, 0.9, -0.8]) if robot is REDUNDANT else np.array([0, 0, 0, 0.3, 0.9, -0.8])
    x, y, heading = robot.forward_kinematics(q0)
    turn = 0.3 if robot is REDUNDANT else 7.0
    for end in ([x - 0.2, y + 0.1, heading + 0.5], [x, y, heading + turn]):
        line = StraightLine([x, y, heading], end, 0.3)
        gone = track_line(robot, q0, line, rate=400.0, settling=1.0)
        reached = robot.forward_kinematics(gone.q[-1])
        np.testing.assert_allclose(se2.wrap_angle(reached - end), 0.0, atol=1e-6)
        assert gone.error.max() < 2e-3
        wanted = np.array([line.position(t) for t in gone.times])
        missing = wanted - robot.forward_kinematics(gone.q)
        missing[:, 2] = se2.wrap_angle(missing[:, 2])
        np.testing.assert_allclose(gone.error, np.linalg.norm(missing, axis=-1), atol=1e-12)


def test_an_arm_follows_a_line_through_the_interior_to_a_tenth_of_a_millimetre():
    line = StraightLine(*INTERIOR, 0.2)
    gone = track_line(ARM, elbow(INTERIOR[0]), line)
    assert gone.times[-1] == pytest.approx(float(line.duration), abs=0.01)
    assert gone.error.max() < 1e-4
    # What is said is what was driven.
    np.testing.assert_allclose(gone.error, tip_error(ARM, line, gone), atol=1e-12)
    np.testing.assert_allclose(np.diff(gone.q, axis=0), gone.q_dot / 100.0, atol=1e-12)
    np.testing.assert_allclose(gone.times, np.arange(len(gone.q)) / 100.0)


@pytest.mark.parametrize('gain', [0.0, 20.0])
def test_the_error_is_of_first_order_in_the_sampling_time(gain):
    rates = np.array([50.0, 100.0, 200.0, 400.0])
    line = StraightLine(*INTERIOR, 1.0)
    errors = [
        track_line(ARM, elbow(INTERIOR[0]), line, rate=rate, gain=gain).error.max() for rate in rates
    ]
    assert np.polyfit(np.log(1.0 / rates), np.log(errors), 1)[0] == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize('K', [2.0, 10.0])
def test_feedback_removes_an_error_at_the_start_like_an_exponential(K):
    q0 = elbow([1.0, 0.5])
    moving = StraightLine([1.02, 0.5], [0.8, 0.7], 0.5)
    resting = StraightLine([1.02, 0.5], [1.02, 0.5], 10.0)
    for line in (moving, resting):
        gone = track_line(ARM, q0, line, rate=400.0, gain=K, settling=1.0)
        np.testing.assert_allclose(gone.error, 0.02 * np.exp(-K * gone.times), atol=2e-4)
    # Without feedback it stays.
    assert track_line(ARM, q0, moving, rate=400.0, gain=0.0).error[-1] == pytest.approx(0.02, rel=0.02)


# --- The edge of what can be reached


@pytest.mark.parametrize(
    ('start', 'end', 'beyond', 'threshold', 'most'),
    [
        ([1.3, 0.3], [2.4, 0.3], math.hypot(2.4, 0.3) - 1.8, 0.1, 0.1),
        ([1.0, -1.0], [1.5, -1.5], 1.5 * math.sqrt(2.0) - 1.8, 0.3, 0.2),
        ([0.6, 0.2], [0.05, 0.1], 0.2 - math.hypot(0.05, 0.1), 0.1, 0.1),
    ],
    ids=['aslant', 'radial', 'hole'],
)
def test_beyond_the_edge_joints_stay_slow_and_the_error_is_told(start, end, beyond, threshold, most):
    line = StraightLine(start, end, 0.2)
    gone = track_line(ARM, elbow(start), line, threshold=threshold, maximum_damping=most, settling=3.0)
    speed = np.linalg.norm(gone.q_dot, axis=-1)
    w = 0.8 * np.abs(np.sin(gone.q[:-1, 1]))
    damping = most * np.maximum(1.0 - w / threshold, 0.0)
    assert damping.max() > 0.8 * most
    assert np.all(speed * damping <= 0.2 * (1.0 + 1e-9))
    # And where nothing is damped yet, for the Jacobian is far from singular there.
    assert speed.max() < 6.0
    assert gone.error[-1] == pytest.approx(beyond, abs=1e-4)
    np.testing.assert_allclose(gone.error, tip_error(ARM, line, gone), atol=1e-12)
    undamped = track_line(ARM, elbow(start), line)
    assert np.linalg.norm(undamped.q_dot, axis=-1).max() > 10.0 * speed.max()


def test_far_from_singular_damping_changes_nothing():
    line, q0 = StraightLine(*INTERIOR, 0.8), elbow(INTERIOR[0])
    free, damped = (track_line(ARM, q0, line, threshold=threshold) for threshold in (None, 0.2))
    assert manipulability(ARM.jacobian(free.q)).min() > 0.2
    assert np.array_equal(free.q, damped.q)


# --- With more joints than the task needs


@pytest.mark.parametrize('end', [[2.5, 0.0], [-1.5, 2.0]], ids=str)
def test_a_mobile_manipulator_follows_a_line_far_beyond_the_reach_of_its_arm(end):
    arm = PlanarArm([0.3, 0.25])
    robot = MobileManipulator(0.033, 0.16, arm, (0.05, 0.0))
    q0 = np.array([0.0, 0.0, 0.0, 0.6, -1.2])
    line = StraightLine(robot.forward_kinematics(q0)[:2], end, 0.2)
    gone = track_line(robot, q0, line)
    assert gone.q_dot.shape == (len(gone.times) - 1, 4)
    assert gone.error.max() < 1e-3
    assert gone.error[-1] < 1e-6
    assert math.dist(gone.q[-1, :2], q0[:2]) > 1.8
    assert np.abs(gone.q_dot).max() < 20.0
    np.testing.assert_allclose(gone.error, tip_error(robot, line, gone), atol=1e-12)
    # The base only rolls.
    sideways = (
        np.diff(gone.q[:, :2], axis=0) @ [1.0, 1j] * np.exp(-0.5j * (gone.q[1:, 2] + gone.q[:-1, 2]))
    )
    turned = np.abs(np.diff(gone.q[:, 2])) > 1.0  # where the heading is wrapped
    assert np.abs(sideways.imag[~turned]).max() < 1e-12


def test_a_motion_besides_leaves_the_tip_on_its_line_and_raises_manipulability():
    q0, limits = np.array([0.5, -0.4, 1.5]), ([-2.0] * 3, [2.0] * 3)
    start = REDUNDANT.forward_kinematics(q0)[:2]
    line, resting = StraightLine(start, np.add(start, [-0.2, 0.2]), 0.1), StraightLine(start, start, 1.0)

    def upwards(q):
        return 5.0 * manipulability_gradient(REDUNDANT.jacobian, q)

    def from_the_limits(q):
        return -5.0 * joint_limit_gradient(q, *limits)

    def driven(secondary, line=line):
        gone = track_line(REDUNDANT, q0, line, secondary=secondary, settling=1.0)
        assert gone.error.max() < 1e-4
        return manipulability(REDUNDANT.jacobian(gone.q)), joint_limit_cost(gone.q, *limits)

    alone, besides, inside = driven(None), driven(upwards), driven(from_the_limits)
    assert besides[0][-1] > 1.15 * alone[0][-1]
    assert inside[1][-1] < 0.85 * alone[1][-1]
    # On the spot nothing else moves, and one only grows, the other only shrinks.
    growth, shrinkage = (
        np.diff(driven(upwards, resting)[0]),
        -np.diff(driven(from_the_limits, resting)[1]),
    )
    for gain in (growth, shrinkage):
        assert gain.min() > -1e-5 * gain.max()
        assert gain.sum() > 10.0 * gain.max()


# --- Batches


def test_batches_of_arms_and_lines_are_followed_as_each_alone():
    rng = np.random.default_rng(4)
    starts = rng.uniform(0.4, 0.8, (5, 2))
    ends, speed = -starts + rng.uniform(0.0, 2.0, (5, 2)), rng.uniform(0.4, 0.8, 5)
    q0 = elbow(starts) + rng.uniform(-0.05, 0.05, (5, 2))
    options = {'threshold': 0.3, 'rate': 50.0, 'settling': 1.0}
    gone = track_line(ARM, q0, StraightLine(starts, ends, speed), **options)
    assert gone.q.shape == (len(gone.times), 5, 2)
    for i in range(5):
        one = track_line(ARM, q0[i], StraightLine(starts[i], ends[i], speed[i]), **options)
        count = len(one.times)
        np.testing.assert_allclose(gone.q[:count, i], one.q, atol=1e-9)
        np.testing.assert_allclose(gone.q_dot[: count - 1, i], one.q_dot, atol=1e-8)
        np.testing.assert_allclose(gone.error[:count, i], one.error, atol=1e-9)


def test_one_arm_may_have_many_lines_and_one_line_many_arms():
    q0, ends = elbow([1.0, 0.5]), np.array([[0.5, 1.0], [1.2, 0.4], [1.0, 0.5]])
    lines = track_line(ARM, q0, StraightLine([1.0, 0.5], ends, 0.5))
    assert (lines.q.shape[1:], lines.q_dot.shape[1:], lines.error.shape[1:]) == ((3, 2), (3, 2), (3,))
    arms = track_line(ARM, np.stack([q0, q0 * [1.0, 0.9]]), StraightLine([1.0, 0.5], ends[0], 0.5))
    assert arms.error[-1].max() < 1e-4
    for gone in (lines, arms):
        one = track_line(ARM, q0, StraightLine([1.0, 0.5], ends[0], 0.5))
        np.testing.assert_allclose(gone.q[: len(one.q), 0], one.q, atol=1e-12)


def test_a_line_without_length_is_over_at_once():
    gone = track_line(ARM, [0.2, 1.0], StraightLine([1.0, 1.0], [1.0, 1.0], 1.0))
    assert (gone.times.shape, gone.q.shape, gone.error.shape) == ((1,), (1, 2), (1,))
    assert gone.q_dot.shape == (0, 2)


# --- Bad input

LAW = {
    **{'J': np.eye(2), 'x': np.zeros((4, 2)), 'x_desired': np.ones((4, 2))},
    **{'x_dot_desired': [0.0, 0.0], 'gain': 1.0},
}
BAD_OF_LAW = {
    'J': [np.ones(2), np.full((2, 2), np.nan), np.ones((5, 2, 2)), 'J'],
    'x': [[0.0], [0.0, np.nan], np.zeros((5, 2)), 0.0],
    'x_desired': [[0.0] * 3, [np.inf, 0.0], np.zeros((5, 2))],
    'x_dot_desired': [[0.0] * 3, [np.inf, 0.0], np.zeros((5, 2))],
    'gain': [-1.0, np.nan, np.inf, np.ones(5), 'a', None],
    'damping': [-1.0, np.nan, np.inf, np.ones(5), 'a'],
    'q_dot_0': [[1.0], [np.nan, 0.0], np.ones((5, 2))],
    'max_correction': [0.0, -1.0, np.nan, np.ones(5), 'a'],
}
BAD_LINES = {
    'start': [1.0, [], [np.nan, 1.0], 'a', np.zeros((3, 2))],
    'end': [[1.0], [np.inf, 1.0], None],
    'speed': [0.0, -1.0, np.nan, np.inf, 'a', np.ones(3)],
}
BAD_OF_TRACKING = {
    'rate': [0.0, -1.0, np.nan, np.inf, 'a', None],
    'gain': [-1.0, 100.0, np.nan, 'a', None],
    'threshold': [0.0, -1.0, np.nan, np.inf],
    'maximum_damping': [-1.0, np.nan, 'a'],
    'settling': [-1.0, np.nan, np.inf, 'a'],
    'q0': [np.zeros(3), [0.0, np.nan], np.zeros((5, 2)), 'ab'],
    'line': [StraightLine([1.0], [1.1], 1.0), StraightLine([1.0] * 4, [1.1] * 4, 1.0)],
}


def each(table):
    return [(name, bad) for name, row in table.items() for bad in row]


@pytest.mark.parametrize(('name', 'bad'), each(BAD_OF_LAW), ids=str)
def test_what_the_law_cannot_take_is_named(name, bad):
    with pytest.raises(ValueError, match=rf'\b{name}\b.*must.*got'):
        resolved_rate(**{**LAW, name: bad})


@pytest.mark.parametrize(('name', 'bad'), each(BAD_LINES), ids=str)
def test_what_is_no_line_is_named(name, bad):
    with pytest.raises(ValueError, match=rf'\b{name}\b.*must.*got'):
        StraightLine(**{'start': [1.0, 1.0], 'end': np.zeros((4, 2)), 'speed': 1.0, name: bad})


@pytest.mark.parametrize('damped', [False, True], ids=['undamped', 'damped'])
@pytest.mark.parametrize(('name', 'bad'), each(BAD_OF_TRACKING), ids=str)
def test_what_cannot_be_tracked_is_named(name, bad, damped):
    line = StraightLine([1.0, 0.5], np.array([[0.9, 0.6]] * 4), 0.5)
    arguments = {'q0': [0.2, 1.0], 'line': line, **({'threshold': 0.1} if damped else {}), name: bad}
    # The arm names its own argument.
    told = {'q0': 'q0?', 'line': '(line|x_desired)'}.get(name, name)
    with pytest.raises(ValueError, match=rf'\b{told}\b.*must.*got'):
        track_line(ARM, **arguments)
