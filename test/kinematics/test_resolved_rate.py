"""Resolved rate: tips along straight lines, inside what they can reach, at its edge and beyond; with
secondary tasks, weights and limits; arms and mobile manipulators."""

from __future__ import annotations

import itertools
import math
from functools import cache

import numpy as np
import pytest

from diffdrive_jacobian.control import resolved_rate
from diffdrive_jacobian.control.resolved_rate import StraightLine
from diffdrive_jacobian.kinematics import inverse_velocity as iv
from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.kinematics.mobile_manipulator import MobileManipulator
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm
from diffdrive_jacobian.simulation import track_line

ARM = PlanarArm([1.0, 0.8])
INTERIOR = ([1.2, 0.3], [-0.4, 1.1])
ARM_3 = PlanarArm([0.6, 0.5, 0.4])
NEARLY_STRETCHED = np.array([0.3, 0.4, 0.5])
ROBOT = MobileManipulator(r=0.033, L=0.16, arm=PlanarArm([0.3, 0.25, 0.2]), mount=(0.05, 0.0))
Q0 = np.array([0.0, 0.0, 0.0, 0.3, -0.4, 0.2])
DAMPED = {'threshold': 0.3, 'maximum_damping': 0.1, 'settling': 3.0}


def upwards(q):
    return 5.0 * iv.manipulability_gradient(ARM_3.jacobian, q)


def from_the_limits(q):
    return -5.0 * iv.joint_limit_gradient(q, [-2.0] * 3, [2.0] * 3)


def outwards(reach):
    """A radial line from the tip of the nearly stretched arm to a distance from its base."""
    start = ARM_3.forward_kinematics(NEARLY_STRETCHED)[:2]
    return StraightLine(start, start / np.linalg.norm(start) * reach, 0.1)


def ahead(robot=ROBOT, by=(1.0, 0.5)):
    start = robot.forward_kinematics(Q0)[:2]
    return StraightLine(start, start + by, 0.4)


def arms_manipulability(q):
    return iv.manipulability(ROBOT.arm.jacobian(q[..., 3:]))


def reshape_the_arm(q):
    """Gradient over x, y, theta and the joints: six entries, for five inputs."""
    return 10.0 * iv.manipulability_gradient(lambda q: ROBOT.arm.jacobian(q[..., 3:]), q)


@cache
def stretched(reach, secondary=None):
    """Track a line outwards, nearly to the edge of what the arm reaches or beyond."""
    return track_line(ARM_3, NEARLY_STRETCHED, outwards(reach), secondary=secondary, **DAMPED)


def elbow(tip):
    """Joint angles of ARM that put its tip there."""
    return ARM.inverse_kinematics(tip)[..., 0, :]


def tip_error(robot, line, gone):
    """How far the tips are from where they should be, by the samples' configurations."""
    wanted = np.array([line.position(t) for t in gone.times])
    return np.linalg.norm(robot.forward_kinematics(gone.q)[..., :2] - wanted, axis=-1)


# --- The law


@pytest.mark.parametrize(('m', 'n'), [(1, 2), (2, 2), (3, 5)])
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


def test_a_line_is_driven_at_its_speed_and_then_rests():
    line = StraightLine([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]], [3.0, 4.0], [1.0, 2.0, 0.5])
    np.testing.assert_allclose(line.duration, [5.0, math.sqrt(13.0) / 2.0, math.sqrt(5.0) / 0.5])
    assert np.array_equal(line.position(0.0), line.start)
    assert np.array_equal(line.position(-3.0), line.start)
    np.testing.assert_allclose(line.position(1.0)[0], [0.6, 0.8])
    assert np.array_equal(line.position(100.0), [[3.0, 4.0]] * 3)
    point = StraightLine([1.0, 2.0], [1.0, 2.0], 1.0)
    assert point.duration == 0.0
    assert [point.position(t).tolist() for t in (-1.0, 0.0, 5)] == [[1.0, 2.0]] * 3
    for array in (line.start, line.end, line.speed):
        with pytest.raises(ValueError, match='read-only'):
            array[...] = 2.0
    with pytest.raises(ValueError, match='must give a finite duration, but it overflows'):
        StraightLine([0.0], [1.0], 1e-310)


# --- Inside


@pytest.mark.parametrize(
    ('robot', 'turn'), [(ARM_3, 0.5), (MobileManipulator(0.5, 0.5, ARM_3), 7.0)], ids=['arm', 'robot']
)
def test_position_and_heading_follow_a_line_also_across_pi_and_around(robot, turn):
    q0 = np.array([0.3, 0.9, -0.8] if robot is ARM_3 else [0.0, 0.0, 0.0, 0.3, 0.9, -0.8])
    x, y, heading = robot.forward_kinematics(q0)
    for end in ([x - 0.2, y + 0.1, heading + 0.5], [x, y, heading + turn]):
        line = StraightLine([x, y, heading], end, 1.0)
        gone = track_line(robot, q0, line, rate=50.0, settling=1.0)
        reached = robot.forward_kinematics(gone.q[-1])
        np.testing.assert_allclose(se2.wrap_angle(reached - end), 0.0, atol=1e-6)
        assert gone.error.max() < 0.05
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
    rates = np.array([50.0, 100.0, 200.0])
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
        gone = track_line(ARM, q0, line, rate=200.0, gain=K, settling=0.5)
        np.testing.assert_allclose(gone.error, 0.02 * np.exp(-K * gone.times), atol=4e-4)
    # Without feedback it stays.
    assert track_line(ARM, q0, moving, gain=0.0).error[-1] == pytest.approx(0.02, rel=0.02)


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
    how = {'threshold': threshold, 'maximum_damping': most, 'settling': 3.0, 'rate': 50.0}
    gone = track_line(ARM, elbow(start), line, **how)
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


# --- With more joints than the task needs


def test_a_mobile_manipulator_follows_a_line_far_beyond_the_reach_of_its_arm():
    arm = PlanarArm([0.3, 0.25])
    robot = MobileManipulator(0.033, 0.16, arm, (0.05, 0.0))
    q0 = np.array([0.0, 0.0, 0.0, 0.6, -1.2])
    line = StraightLine(robot.forward_kinematics(q0)[:2], [-1.5, 2.0], 0.4)
    gone = track_line(robot, q0, line)
    assert gone.q_dot.shape == (len(gone.times) - 1, 4)
    assert gone.error.max() < 3e-3
    assert gone.error[-1] < 1e-4
    assert math.dist(gone.q[-1, :2], q0[:2]) > 1.8
    assert np.abs(gone.q_dot).max() < 40.0
    np.testing.assert_allclose(gone.error, tip_error(robot, line, gone), atol=1e-12)
    # The base only rolls.
    sideways = (
        np.diff(gone.q[:, :2], axis=0) @ [1.0, 1j] * np.exp(-0.5j * (gone.q[1:, 2] + gone.q[:-1, 2]))
    )
    turned = np.abs(np.diff(gone.q[:, 2])) > 1.0  # where the heading is wrapped
    assert np.abs(sideways.imag[~turned]).max() < 1e-12


# --- Batches


def test_batches_of_arms_and_lines_are_followed_as_each_alone():
    rng = np.random.default_rng(4)
    starts = rng.uniform(0.4, 0.8, (3, 2))
    ends, speed = -starts + rng.uniform(0.0, 2.0, (3, 2)), rng.uniform(0.4, 0.8, 3)
    q0 = elbow(starts) + rng.uniform(-0.05, 0.05, (3, 2))
    options = {'threshold': 0.3, 'rate': 50.0, 'settling': 1.0}
    gone = track_line(ARM, q0, StraightLine(starts, ends, speed), **options)
    assert gone.q.shape == (len(gone.times), 3, 2)
    for i in range(3):
        one = track_line(ARM, q0[i], StraightLine(starts[i], ends[i], speed[i]), **options)
        count = len(one.times)
        np.testing.assert_allclose(gone.q[:count, i], one.q, atol=1e-9)
        np.testing.assert_allclose(gone.q_dot[: count - 1, i], one.q_dot, atol=1e-8)
        np.testing.assert_allclose(gone.error[:count, i], one.error, atol=1e-9)


def test_a_line_without_length_is_over_at_once():
    gone = track_line(ARM, [0.2, 1.0], StraightLine([1.0, 1.0], [1.0, 1.0], 1.0))
    assert (gone.times.shape, gone.q.shape, gone.error.shape) == ((1,), (1, 2), (1,))
    assert gone.q_dot.shape == (0, 2)


# --- Secondary tasks


@pytest.mark.parametrize('secondary', [upwards, from_the_limits])
@pytest.mark.parametrize('reach', [1.49, 1.6])
def test_near_the_edge_a_secondary_task_costs_fractions_of_a_millimetre(reach, secondary):
    assert stretched(reach, secondary).error.max() < stretched(reach).error.max() + 0.3e-3


@pytest.mark.parametrize('secondary', [upwards, from_the_limits])
def test_beyond_the_edge_joints_come_to_rest_instead_of_jumping_at_each_sample(secondary):
    run = stretched(1.6, secondary)
    assert np.linalg.norm(np.diff(run.q_dot, axis=0), axis=-1).sum() < 4.0
    assert np.linalg.norm(run.q_dot[-1] - run.q_dot[-2]) < 1e-2


# --- Mobile manipulators


def test_a_mobile_manipulator_reshapes_its_arm_while_the_tip_stays_on_the_line():
    alone = track_line(ROBOT, Q0, ahead(), settling=3.0, rate=50.0)
    besides = track_line(ROBOT, Q0, ahead(), secondary=reshape_the_arm, settling=3.0, rate=50.0)
    assert besides.error.max() < alone.error.max() + 0.02 < 0.1
    assert besides.error[-1] < 1e-5
    w_alone, w = (arms_manipulability(run.q) for run in (alone, besides))
    # Without it the line stretches the arm.
    assert w_alone[-1] < 0.5 * w_alone[0]
    assert w[-1] > 1.5 * w[0]


def test_on_the_spot_the_secondary_task_only_goes_uphill():
    spot = ahead(by=(0.0, 0.0))
    for weights in (None, [1.0, 3.0, 0.2, 1.0, 2.0]):
        how = {'settling': 1.0, 'weights': weights, 'rate': 50.0}
        run = track_line(ROBOT, Q0, spot, secondary=reshape_the_arm, **how)
        growth = np.diff(arms_manipulability(run.q))
        assert growth.min() > -1e-6 * growth.max()
        assert growth.sum() > 0.01
        assert run.error.max() < 1e-3


def test_batches_of_mobile_manipulators_have_secondary_tasks_as_each_alone():
    q0 = Q0 + np.random.default_rng(1).normal(scale=0.1, size=(2, 6))
    starts = ROBOT.forward_kinematics(q0)[:, :2]
    options = {'secondary': reshape_the_arm, 'weights': [0.1, 0.1, 1.0, 1.0, 1.0], 'rate': 50.0}
    line = StraightLine(starts, starts + np.array([0.3, 0.1]), 0.2)
    together = track_line(ROBOT, q0, line, **options)
    for i in range(2):
        alone = track_line(ROBOT, q0[i], StraightLine(starts[i], starts[i] + [0.3, 0.1], 0.2), **options)
        np.testing.assert_allclose(together.q[: len(alone.q), i], alone.q, atol=1e-9)


# --- Weights and limits


def test_weights_choose_between_wheels_and_joints():
    by = (-0.15, 0.1)
    joints, wheels = (
        track_line(ROBOT, Q0, ahead(by=by), weights=weights)
        for weights in ([1.0, 1.0, 1e-3, 1e-3, 1e-3], [1e-3, 1e-3, 1.0, 1.0, 1.0])
    )
    for run in (joints, wheels):
        assert run.error.max() < 2e-3
    turned = [np.abs(run.q_dot[:, :2]).sum() / 100.0 for run in (joints, wheels)]
    bent = [np.abs(run.q_dot[:, 2:]).sum() / 100.0 for run in (joints, wheels)]
    assert turned[0] < 0.2 * turned[1]
    assert bent[1] < 0.2 * bent[0]


def test_limits_hold_at_each_sample_and_the_tip_falls_behind_on_its_line():
    free = track_line(ROBOT, Q0, ahead(), rate=50.0)
    limits = 0.6 * np.abs(free.q_dot).max(axis=0)
    run = track_line(ROBOT, Q0, ahead(), max_velocity=limits, settling=3.0)
    assert np.all(np.abs(run.q_dot) <= limits)
    assert run.error.max() > 0.05
    assert run.error[-1] < 1e-4
    # It falls behind along the line, not off it.
    line = ahead()
    way = (line.end - line.start) / np.linalg.norm(line.end - line.start)
    off = (ROBOT.forward_kinematics(run.q)[:, :2] - line.start) @ [-way[1], way[0]]
    assert np.abs(off).max() < 0.01


def test_one_robot_may_have_many_limits():
    limits = np.array([[np.inf], [1.0]]) * np.ones(5)
    line = ahead(by=(0.2, 0.1))
    both = track_line(ROBOT, Q0, line, max_velocity=limits)
    for index, limit in enumerate(limits):
        alone = track_line(ROBOT, Q0, line, max_velocity=limit)
        np.testing.assert_allclose(both.q[:, index], alone.q, atol=1e-9)
        np.testing.assert_allclose(both.error[:, index], alone.error, atol=1e-9)


# --- Bad input


class Rates(MobileManipulator):
    """A robot of somebody else: no map from its inputs to its configuration."""

    configuration_jacobian = None


def test_a_robot_without_the_map_takes_inputs_only():
    robot, line = Rates(r=0.033, L=0.16, arm=ROBOT.arm, mount=(0.05, 0.0)), ahead(by=(0.1, 0.0))
    run = track_line(robot, Q0, line, secondary=lambda q: np.ones(5))
    assert run.error.max() < 5e-3
    with pytest.raises(ValueError, match=r'must have shape \(\.\.\., 5\), got \(6,\)'):
        track_line(robot, Q0, line, secondary=reshape_the_arm)


def test_what_is_invalid_is_named():
    several = StraightLine([1.0, 0.5], np.array([[0.9, 0.6]] * 4), 0.5)
    for name, values in {
        'robot': [None, 10**5000],
        'q0': [np.zeros(3), [np.nan] * 6, np.zeros((5, 6)), 'ab'],
        'line': [
            None,
            'line',
            1.0,
            StraightLine([1.0], [1.1], 1.0),
            StraightLine([1.0] * 4, 4 * [2.0], 1),
        ],
        'rate': [0.0, -1.0, np.nan, np.inf, 'a', None],
        'gain': [-1.0, 100.0, np.nan, 'a', None],
        'threshold': [0.0, -1.0, np.nan, np.inf],
        'maximum_damping': [-1.0, np.nan, 'a'],
        'settling': [-1.0, np.nan, np.inf, 'a'],
        'weights': [[1.0, 1.0, 1.0, 1.0, 0.0], [1.0, 1.0]],
        'max_velocity': [0.0, [1.0, 2.0]],
        'secondary': [
            np.zeros(5),
            lambda q: np.zeros(4),
            lambda q: np.full(5, np.nan),
            lambda q: 'fast',
        ],
    }.items():
        for damped, bad in itertools.product((False, True), values):
            arguments = {
                'robot': ROBOT,
                'q0': Q0,
                'line': several,
                **({'threshold': 0.1} if damped else {}),
            }
            # The robot names its own argument q, the law the desired task x_desired.
            allowed = {'q0': 'q0?', 'line': '(line|x_desired)'}.get(name, name)
            with pytest.raises(ValueError, match=rf'\b{allowed}\b.*must.*got'):
                track_line(**arguments | {name: bad})
