"""Lines followed with a secondary task, weights and limits, by arms and by mobile manipulators."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from diffdrive_jacobian.control import StraightLine, resolved_rate
from diffdrive_jacobian.kinematics import inverse_velocity as iv
from diffdrive_jacobian.kinematics.mobile_manipulator import MobileManipulator
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm
from diffdrive_jacobian.simulation import track_line

ARM = PlanarArm([0.6, 0.5, 0.4])
NEARLY_STRETCHED = np.array([0.3, 0.4, 0.5])
ROBOT = MobileManipulator(r=0.033, L=0.16, arm=PlanarArm([0.3, 0.25, 0.2]), mount=(0.05, 0.0))
Q0 = np.array([0.0, 0.0, 0.0, 0.3, -0.4, 0.2])
DAMPED = {'threshold': 0.3, 'maximum_damping': 0.1, 'settling': 3.0}


def constant(q):
    return np.array([1.0, 1.0, 1.0])


def upwards(q):
    return 5.0 * iv.manipulability_gradient(ARM.jacobian, q)


def from_the_limits(q):
    return -5.0 * iv.joint_limit_gradient(q, [-2.0] * 3, [2.0] * 3)


def outwards(reach):
    """A radial line from the tip of the nearly stretched arm to a distance from its base."""
    start = ARM.forward_kinematics(NEARLY_STRETCHED)[:2]
    return StraightLine(start, start / np.linalg.norm(start) * reach, 0.1)


def ahead(robot=ROBOT, by=(1.0, 0.5)):
    start = robot.forward_kinematics(Q0)[:2]
    return StraightLine(start, start + by, 0.2)


def arms_manipulability(q):
    return iv.manipulability(ROBOT.arm.jacobian(q[..., 3:]))


def reshape_the_arm(q):
    """Gradient over x, y, theta and the joints: six entries, for five inputs."""
    return 10.0 * iv.manipulability_gradient(lambda q: ROBOT.arm.jacobian(q[..., 3:]), q)


@cache
def stretched(reach, secondary=None):
    """Track a line outwards, nearly to the edge of what the arm reaches or beyond."""
    return track_line(ARM, NEARLY_STRETCHED, outwards(reach), secondary=secondary, **DAMPED)


# --- Damping


@pytest.mark.parametrize('secondary', [constant, upwards, from_the_limits])
def test_a_secondary_task_costs_a_damped_feasible_line_nothing(secondary):
    q0 = np.array([0.5, -0.4, 1.5])
    start = ARM.forward_kinematics(q0)[:2]
    line = StraightLine(start, start + np.array([-0.2, 0.2]), 0.1)
    options = {'threshold': 1.0, 'maximum_damping': 0.3, 'settling': 1.0}
    alone = track_line(ARM, q0, line, **options).error.max()
    assert track_line(ARM, q0, line, secondary=secondary, **options).error.max() < alone + 1e-5


@pytest.mark.parametrize('secondary', [constant, upwards, from_the_limits])
@pytest.mark.parametrize('reach', [1.45, 1.49, 1.499, 1.5, 1.6])
def test_near_the_edge_a_secondary_task_costs_fractions_of_a_millimetre(reach, secondary):
    assert stretched(reach, secondary).error.max() < stretched(reach).error.max() + 0.3e-3


@pytest.mark.parametrize('secondary', [constant, upwards, from_the_limits])
def test_beyond_the_edge_joints_come_to_rest_instead_of_jumping_at_each_sample(secondary):
    run = stretched(1.6, secondary)
    assert np.linalg.norm(np.diff(run.q_dot, axis=0), axis=-1).sum() < 4.0
    assert np.linalg.norm(run.q_dot[-1] - run.q_dot[-2]) < 1e-2


# --- Mobile manipulators


def test_a_mobile_manipulator_reshapes_its_arm_while_the_tip_stays_on_the_line():
    alone = track_line(ROBOT, Q0, ahead(), settling=2.0)
    besides = track_line(ROBOT, Q0, ahead(), secondary=reshape_the_arm, settling=2.0)
    assert besides.error.max() < alone.error.max() + 1e-4 < 1e-3
    assert besides.error[-1] < 1e-5
    w_alone, w = (arms_manipulability(run.q) for run in (alone, besides))
    # Without it the line stretches the arm.
    assert w_alone[-1] < 0.5 * w_alone[0]
    assert w[-1] > 1.5 * w[0]


def test_on_the_spot_the_secondary_task_only_goes_uphill():
    spot = ahead(by=(0.0, 0.0))
    for weights in (None, [0.1, 0.1, 1.0, 1.0, 1.0], [1.0, 3.0, 0.2, 1.0, 2.0]):
        run = track_line(ROBOT, Q0, spot, secondary=reshape_the_arm, settling=2.0, weights=weights)
        growth = np.diff(arms_manipulability(run.q))
        assert growth.min() > -1e-6 * growth.max()
        assert growth.sum() > 0.01
        assert run.error.max() < 1e-3


def test_a_gradient_over_the_configuration_becomes_one_over_the_inputs():
    G = ROBOT.configuration_jacobian(Q0)
    given = {'q': lambda q: reshape_the_arm(q), 'inputs': lambda q: G_transposed(q) @ reshape_the_arm(q)}

    def G_transposed(q):
        return ROBOT.configuration_jacobian(q).T

    runs = [
        track_line(ROBOT, Q0, ahead(by=(0.3, 0.1)), secondary=secondary) for secondary in given.values()
    ]
    np.testing.assert_allclose(runs[0].q, runs[1].q, atol=1e-9)
    # By hand: x_dot and y_dot of the axle centre, heading, joints.
    u = np.array([3.0, 1.0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(G @ u, [0.033 * 2.0, 0.0, 0.033 * 2.0 / 0.16, 0.1, 0.2, 0.3])


def test_batches_of_mobile_manipulators_have_secondary_tasks_as_each_alone():
    q0 = Q0 + np.random.default_rng(1).normal(scale=0.1, size=(4, 6))
    starts = ROBOT.forward_kinematics(q0)[:, :2]
    options = {'secondary': reshape_the_arm, 'weights': [0.1, 0.1, 1.0, 1.0, 1.0], 'rate': 50.0}
    line = StraightLine(starts, starts + np.array([0.3, 0.1]), 0.2)
    together = track_line(ROBOT, q0, line, **options)
    for i in range(4):
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
    free = track_line(ROBOT, Q0, ahead(), settling=2.0)
    limits = 0.6 * np.abs(free.q_dot).max(axis=0)
    run = track_line(ROBOT, Q0, ahead(), max_velocity=limits, settling=8.0)
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
    both = track_line(ROBOT, Q0, ahead(), max_velocity=limits)
    for index, limit in enumerate(limits):
        alone = track_line(ROBOT, Q0, ahead(), max_velocity=limit)
        np.testing.assert_allclose(both.q[:, index], alone.q, atol=1e-9)
        np.testing.assert_allclose(both.error[:, index], alone.error, atol=1e-9)


def test_the_law_takes_weights_and_limits():
    rng = np.random.default_rng(2)
    J, x_dot, wish = rng.normal(size=(2, 5)), rng.normal(size=2), rng.normal(size=5)
    weights = rng.uniform(0.1, 2.0, 5)
    zero = np.zeros(2)
    q_dot = resolved_rate(J, zero, zero, x_dot, 1.0, 0.1, wish, weights=weights)
    np.testing.assert_allclose(q_dot, iv.redundant(J, x_dot, wish, 0.1, weights=weights))
    slow = resolved_rate(J, zero, zero, x_dot, 1.0, weights=weights, max_velocity=0.01)
    expected = iv.pseudoinverse(J, weights=weights) @ x_dot
    np.testing.assert_allclose(slow, expected * (0.01 / np.abs(expected).max()))


# --- Bad input


class Rates(MobileManipulator):
    """A robot of somebody else: no map from its inputs to its configuration."""

    configuration_jacobian = None


BAD = [
    ({'secondary': lambda q: np.zeros(4)}, r'result of secondary must have shape \(\.\.\., 5\) or'),
    ({'secondary': lambda q: np.full(5, np.nan)}, r'result of secondary must be finite'),
    ({'secondary': lambda q: 'fast'}, r'result of secondary must be an array'),
    ({'secondary': np.zeros(5)}, r'^secondary must be a function .* got array'),
    ({'weights': [1.0, 1.0, 1.0, 1.0, 0.0]}, r'^weights must be positive .* got 0\.0'),
    ({'weights': [1.0, 1.0]}, r'^weights must have shape \(\.\.\., 5\), got \(2,\)'),
    ({'max_velocity': 0.0}, r'^max_velocity must be positive'),
    ({'max_velocity': [1.0, 2.0]}, r'^max_velocity must have shape'),
    ({'robot': None}, r'^robot must have the method forward_kinematics, got None'),
]


@pytest.mark.parametrize(('bad', 'message'), BAD, ids=[f'{next(iter(bad))} {m}' for bad, m in BAD])
def test_what_is_invalid_is_named(bad, message):
    with pytest.raises(ValueError, match=message):
        track_line(**{'robot': ROBOT, 'q0': Q0, 'line': ahead(), **bad})


def test_a_robot_without_the_map_takes_inputs_only():
    robot = Rates(r=0.033, L=0.16, arm=ROBOT.arm, mount=(0.05, 0.0))
    run = track_line(robot, Q0, ahead(by=(0.1, 0.0)), secondary=lambda q: np.ones(5))
    assert run.error.max() < 2e-3
    with pytest.raises(
        ValueError, match=r'result of secondary must have shape \(\.\.\., 5\), got \(6,\)'
    ):
        track_line(robot, Q0, ahead(), secondary=reshape_the_arm)


@pytest.mark.parametrize('t', [np.nan, np.inf, 'now', None, [0.0, 1.0]], ids=str)
def test_the_position_on_a_line_is_that_at_one_finite_time(t):
    with pytest.raises(ValueError, match=r'^t must be .*got'):
        StraightLine([0.0, 0.0], [1.0, 0.0], 0.5).position(t)


def test_a_line_rests_at_its_ends_and_cannot_be_changed():
    start = np.zeros(2)
    line = StraightLine(start, [1.0, 0.0], 0.5)
    start[0] = 7.0
    assert line.position(-3.0).tolist() == [0.0, 0.0]
    assert line.position(9).tolist() == [1.0, 0.0]
    point = StraightLine([1.0, 2.0], [1.0, 2.0], 1.0)
    assert point.position(-1.0).tolist() == point.position(0.0).tolist() == [1.0, 2.0]
    for array in (line.start, line.end, line.speed):
        with pytest.raises(ValueError, match='read-only'):
            array[...] = 2.0
    with pytest.raises(ValueError, match='must give a finite duration, but it overflows'):
        StraightLine([0.0], [1.0], 1e-310)
