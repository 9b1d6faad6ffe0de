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

"""Resolved rate: tips along straight lines, inside what they can reach, at its edge and beyond; with
secondary tasks, weights and limits; arms and mobile manipulators."""

from __future__ import annotations

import math

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
ARM_3 = PlanarArm([0.6, 0.5, 0.4])
INSIDE = StraightLine([1.2, 0.3], [-0.4, 1.1], 1.0)
ROBOT = MobileManipulator(r=0.033, L=0.16, arm=PlanarArm([0.3, 0.25, 0.2]), mount=(0.05, 0.0))
Q0 = np.array([0.0, 0.0, 0.0, 0.3, -0.4, 0.2])


def ahead(by=(0.5, 0.25), q0=Q0, speed=0.4):
    start = ROBOT.forward_kinematics(q0)[..., :2]
    return StraightLine(start, start + by, speed)


def elbow(tip):
    """Joint angles of ARM that put its tip there."""
    return ARM.inverse_kinematics(tip)[..., 0, :]


def reshape_the_arm(q):
    """Gradient over x, y, theta and the joints: six entries, for five inputs."""
    return 10.0 * iv.manipulability_gradient(lambda q: ROBOT.arm.jacobian(q[..., 3:]), q)


# --- The law and the line


@pytest.mark.parametrize(('m', 'n'), [(2, 2), (3, 5)])
def test_the_law_is_the_inverse_of_velocity_and_feedback_with_a_motion_in_the_null_space(m, n):
    """What the inverse is, test_inverse_velocity.py shows."""
    rng = np.random.default_rng(1)
    J, wish = rng.normal(size=(100, m, n)), rng.normal(size=(100, n))
    x, x_desired, x_dot = rng.normal(size=(3, 100, m))
    K, damping = rng.uniform(0.0, 9.0, (2, 100))
    task = x_dot + K[:, np.newaxis] * (x_desired - x)
    for options, expected in (
        ((), iv.pseudoinverse(J) @ task[..., np.newaxis]),
        ((damping,), iv.damped_least_squares(J, task, damping)),
        ((damping, wish), iv.redundant(J, task, wish, damping)),
    ):
        found = resolved_rate(J, x, x_desired, x_dot, K, *options)
        np.testing.assert_allclose(found, expected.reshape(found.shape), rtol=1e-7, atol=1e-7)


def test_the_feedback_grows_to_its_limit_and_keeps_its_direction():
    rng = np.random.default_rng(2)
    distance, longest = 10.0 ** rng.uniform(-3.0, 2.0, (2, 200))
    bearing = rng.uniform(-np.pi, np.pi, 200)
    unit = np.stack([np.cos(bearing), np.sin(bearing)], -1)
    away = distance[:, np.newaxis] * unit
    found = resolved_rate(np.eye(2), np.zeros(2), away, [0.3, 0.0], 5.0, max_correction=longest)
    expected = np.minimum(5.0 * distance, longest)[:, np.newaxis] * unit + [0.3, 0.0]
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def test_a_line_is_driven_at_its_speed_and_then_rests():
    line = StraightLine([[0.0, 0.0], [1.0, 1.0]], [3.0, 4.0], [1.0, 2.0])
    np.testing.assert_allclose(line.duration, [5.0, math.sqrt(13.0) / 2.0])
    assert np.array_equal(line.position(-3.0), line.start)
    np.testing.assert_allclose(line.position(1.0)[0], [0.6, 0.8])
    assert np.array_equal(line.position(100.0), [[3.0, 4.0]] * 2)
    point = StraightLine([1.0, 2.0], [1.0, 2.0], 1.0)
    assert [point.position(t).tolist() for t in (-1.0, 0.0, 5)] == [[1.0, 2.0]] * 3
    with pytest.raises(ValueError, match='must give a finite duration, but it overflows'):
        StraightLine([0.0], [1.0], 1e-310)


# --- Inside


def test_position_and_heading_follow_a_line_also_across_pi_and_around():
    robot, q0 = MobileManipulator(0.5, 0.5, ARM_3), np.array([0.0, 0.0, 0.0, 0.3, 0.9, -0.8])
    x, y, heading = robot.forward_kinematics(q0)
    line = StraightLine([x, y, heading], [x, y, heading + 7.0], 2.0)
    gone = track_line(robot, q0, line, rate=50.0, settling=1.0)
    at_the_end = robot.forward_kinematics(gone.q[-1])
    np.testing.assert_allclose(se2.wrap_angle(at_the_end - line.end), 0.0, atol=1e-6)
    assert gone.error.max() < 0.1
    missing = np.array([line.position(t) for t in gone.times]) - robot.forward_kinematics(gone.q)
    missing[:, 2] = se2.wrap_angle(missing[:, 2])
    np.testing.assert_allclose(gone.error, np.linalg.norm(missing, axis=-1), atol=1e-12)


def test_the_error_is_that_of_the_tip_and_of_first_order_in_the_sampling_time():
    q0 = elbow(INSIDE.start)
    coarse, fine = (track_line(ARM, q0, INSIDE, rate=rate) for rate in (50.0, 100.0))
    assert coarse.error.max() < 1e-3
    assert coarse.error.max() / fine.error.max() == pytest.approx(2.0, abs=0.1)
    wanted = np.array([INSIDE.position(t) for t in coarse.times])
    missing = np.linalg.norm(ARM.forward_kinematics(coarse.q)[:, :2] - wanted, axis=-1)
    np.testing.assert_allclose(coarse.error, missing, atol=1e-12)
    np.testing.assert_allclose(np.diff(coarse.q, axis=0), coarse.q_dot / 50.0, atol=1e-12)
    np.testing.assert_allclose(coarse.times, np.arange(len(coarse.q)) / 50.0)
    assert coarse.times[-1] == pytest.approx(float(INSIDE.duration), abs=0.02)
    # A line without length is over at once.
    over = track_line(ARM, [0.2, 1.0], StraightLine([1.0, 1.0], [1.0, 1.0], 1.0))
    assert (over.times.shape, over.q.shape, over.error.shape) == ((1,), (1, 2), (1,))
    assert over.q_dot.shape == (0, 2)


# --- The edge of what can be reached


@pytest.mark.parametrize(
    ('start', 'end', 'beyond'),
    [
        ([1.3, 0.3], [2.4, 0.3], math.hypot(2.4, 0.3) - 1.8),
        ([0.6, 0.2], [0.05, 0.1], 0.2 - math.hypot(0.05, 0.1)),
    ],
    ids=['too far', 'hole'],
)
def test_beyond_the_edge_joints_stay_slow_and_the_error_is_reported(start, end, beyond):
    line = StraightLine(start, end, 0.4)
    how = {'threshold': 0.1, 'maximum_damping': 0.1, 'settling': 2.0, 'rate': 50.0}
    gone = track_line(ARM, elbow(start), line, **how)
    speed = np.linalg.norm(gone.q_dot, axis=-1)
    damping = 0.1 * np.maximum(1.0 - 0.8 * np.abs(np.sin(gone.q[:-1, 1])) / 0.1, 0.0)
    assert damping.max() > 0.08
    assert np.all(speed * damping <= 0.4 * (1.0 + 1e-9))
    # And where nothing is damped yet, for the Jacobian is far from singular there.
    assert speed.max() < 12.0
    assert gone.error[-1] == pytest.approx(beyond, abs=1e-3)


# --- Mobile manipulators: secondary tasks, weights, limits


def test_a_mobile_manipulator_reshapes_its_arm_while_the_tip_stays_on_the_line():
    how = {'settling': 1.0, 'rate': 50.0}
    alone = track_line(ROBOT, Q0, ahead(), **how)
    besides = track_line(ROBOT, Q0, ahead(), secondary=reshape_the_arm, **how)
    assert besides.error.max() < alone.error.max() + 0.02 < 0.1
    assert besides.error[-1] < 1e-3
    before, after = (iv.manipulability(ROBOT.arm.jacobian(run.q[-1, 3:])) for run in (alone, besides))
    assert after > 1.5 * before


def test_a_batch_of_robots_and_lines_is_followed_as_each_alone():
    q0 = Q0 + np.random.default_rng(1).normal(scale=0.1, size=(2, 6))
    by, speeds = np.array([[0.1, 0.05], [0.2, -0.1]]), np.array([0.3, 0.5])
    how = {'secondary': reshape_the_arm, 'weights': [0.1, 0.1, 1.0, 1.0, 1.0]}
    how |= {'rate': 50.0, 'threshold': 0.05, 'settling': 0.2}
    together = track_line(ROBOT, q0, ahead(by, q0, speeds), **how)
    assert together.q.shape == (len(together.times), 2, 6)
    for i in range(2):
        alone = track_line(ROBOT, q0[i], ahead(by[i], q0[i], speeds[i]), **how)
        count = len(alone.times)
        np.testing.assert_allclose(together.q[:count, i], alone.q, atol=1e-9)
        np.testing.assert_allclose(together.error[:count, i], alone.error, atol=1e-9)


def test_weights_choose_between_wheels_and_joints():
    joints, wheels = (
        track_line(ROBOT, Q0, ahead(by=(-0.15, 0.1)), weights=weights, rate=50.0).q_dot
        for weights in ([1.0, 1.0, 1e-3, 1e-3, 1e-3], [1e-3, 1e-3, 1.0, 1.0, 1.0])
    )
    for used, spared, inputs in ((wheels, joints, np.s_[:, :2]), (joints, wheels, np.s_[:, 2:])):
        assert np.abs(spared[inputs]).sum() < 0.2 * np.abs(used[inputs]).sum()


def test_limits_hold_at_each_sample_and_the_tip_falls_behind_on_its_line():
    line = ahead()
    free = track_line(ROBOT, Q0, line, rate=50.0)
    limits = 0.6 * np.abs(free.q_dot).max(axis=0)
    run = track_line(ROBOT, Q0, line, max_velocity=limits, settling=2.0, rate=50.0)
    assert np.all(np.abs(run.q_dot) <= limits)
    assert run.error.max() > 0.05
    assert run.error[-1] < 1e-4
    along = (line.end - line.start) / np.linalg.norm(line.end - line.start)
    off = (ROBOT.forward_kinematics(run.q)[:, :2] - line.start) @ [-along[1], along[0]]
    assert np.abs(off).max() < 0.02


# --- Bad input


class Rates(MobileManipulator):
    """A robot of somebody else: no map from its inputs to its configuration."""

    configuration_jacobian = None


def test_a_robot_without_the_map_takes_inputs_only():
    robot, line = Rates(r=0.033, L=0.16, arm=ROBOT.arm, mount=(0.05, 0.0)), ahead(by=(0.1, 0.0))
    track_line(robot, Q0, line, secondary=lambda q: np.ones(5), rate=50.0)
    with pytest.raises(ValueError, match=r'must have shape \(\.\.\., 5\), got \(6,\)'):
        track_line(robot, Q0, line, secondary=reshape_the_arm)


@pytest.mark.parametrize(
    ('argument', 'named', 'values'),
    [
        ('robot', 'robot', [None]),
        ('q0', 'q', [np.zeros(3), [np.nan] * 6]),
        ('q0', 'q0', [np.zeros((5, 6))]),
        ('line', 'line', [None, StraightLine([1.0], [1.1], 1.0), StraightLine([1.0] * 4, [2.0] * 4, 1)]),
        ('rate', 'rate', [0.0, np.inf, 1e300]),
        ('gain', 'gain', [-1.0, 100.0]),
        ('threshold', 'threshold', [0.0]),
        ('maximum_damping', 'maximum_damping', [-1.0]),
        ('settling', 'settling', [-1.0, np.inf]),
        ('weights', 'weights', [[1.0, 1.0, 1.0, 1.0, 0.0], [1.0, 1.0]]),
        ('max_velocity', 'max_velocity', [0.0, [1.0, 2.0]]),
        ('secondary', 'secondary', [np.zeros(5), lambda q: np.zeros(4), lambda q: 'fast']),
    ],
)
def test_what_is_invalid_is_named(argument, named, values):
    """The robot names its own argument q."""
    several = StraightLine([1.0, 0.5], np.array([[0.9, 0.6]] * 4), 0.5)
    for bad in values:
        with pytest.raises(ValueError, match=rf'\b{named}0?\b.*must.*got'):
            track_line(**{'robot': ROBOT, 'q0': Q0, 'line': several, argument: bad})
