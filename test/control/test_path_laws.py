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

"""The laws of paths: what their papers prove, and robots that follow paths by them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from diffdrive_jacobian.control import (
    ControllerError,
    Path,
    PathController,
    VelocityLimits,
    find_controller,
    line_path,
)
from diffdrive_jacobian.control.path_following import PathFollower, PathSettings
from diffdrive_jacobian.control.path_laws import (
    DYNAMIC_FEEDBACK,
    KANAYAMA,
    LEAST_SPEED,
    PATH_CONTROLLERS,
    PURE_PURSUIT,
    dynamic_feedback_linearization,
    kanayama,
    offset_point_tracking,
    pure_pursuit,
)
from diffdrive_jacobian.kinematics import diff_drive, se2
from diffdrive_jacobian.simulation import Drift, RobotModel, follow_path

RNG = np.random.default_rng(33)
COUNT = 100
V_R, OMEGA_R = 0.3, 0.4
"""A reference on a circle."""


def poses(count=COUNT):
    return RNG.uniform([-1.0, -1.0, -math.pi], [1.0, 1.0, math.pi], (count, 3))


def references(pose, v=V_R, omega=OMEGA_R):
    """References at poses, shape (..., 3), on circles."""
    x, y, theta = np.moveaxis(pose, -1, 0)
    one = np.ones_like(x)
    acceleration = [-v * omega * np.sin(theta), v * omega * np.cos(theta)]
    return np.stack([x, y, theta, v * one, omega * one, *acceleration, 0.0 * one], axis=-1)


def driven(pose, v, omega, dt):
    return se2.integrate(pose, np.stack([v + 0.0 * omega, omega], axis=-1), dt)


def circling(pose, dt):
    return se2.integrate(pose, [V_R, OMEGA_R], dt)


# --- What the papers prove


def test_kanayama_s_function_decreases_as_it_was_proved():
    """V_dot = -K_x e_x^2 - v_r K_theta / K_y sin^2(e_theta) <= 0."""
    k_x, k_y, k_theta = 2.0, 9.0, 5.0
    robot, reference = poses(), poses()
    e_x, e_y, e_theta = np.moveaxis(se2.compose(se2.inverse(robot), reference), -1, 0)
    v, omega = kanayama(robot, references(reference), k_x, k_y, k_theta)
    # The errors are in the frame of the robot, which moves.
    e_x_dot = omega * e_y - v + V_R * np.cos(e_theta)
    e_y_dot = -omega * e_x + V_R * np.sin(e_theta)
    e_theta_dot = OMEGA_R - omega
    V_dot = e_x * e_x_dot + e_y * e_y_dot + np.sin(e_theta) * e_theta_dot / k_y
    proved = -k_x * e_x**2 - V_R * k_theta / k_y * np.sin(e_theta) ** 2
    np.testing.assert_allclose(V_dot, proved, atol=1e-12)
    np.testing.assert_allclose(v, V_R * np.cos(e_theta) + k_x * e_x)


def test_the_error_of_the_offset_point_decays_exponentially():
    d = np.where(np.arange(COUNT) % 2, 0.1, -0.2)
    k, robot, reference = 2.0, poses(), poses()

    def error(robot, reference):
        return diff_drive.offset_point(reference, d) - diff_drive.offset_point(robot, d)

    first, dt = error(robot, reference), 2e-3
    for _ in range(250):
        v, omega = offset_point_tracking(robot, references(reference), k, d)
        robot, reference = driven(robot, v, omega, dt), circling(reference, dt)
    assert np.allclose(error(robot, reference), math.exp(-k * 0.5) * first, atol=0.02)


def test_dynamic_feedback_makes_the_error_linear():
    """e_ddot + K_d e_dot + K_p e = 0, critically damped with the rate 2."""
    k_p, k_d, dt, steps = 4.0, 4.0, 2e-3, 250
    reference = poses(20)
    # Near enough that the speed stays positive.
    robot = se2.compose(reference, RNG.uniform(-0.05, 0.05, (20, 3)))
    xi = np.full((20, 1), V_R)

    def velocity(pose, v):
        return np.stack([v * np.cos(pose[..., 2]), v * np.sin(pose[..., 2])], axis=-1)

    e = (reference - robot)[:, :2]
    e_dot = velocity(reference, V_R) - velocity(robot, V_R)
    for _ in range(steps):
        v, omega, xi = dynamic_feedback_linearization(
            robot, references(reference), k_p, k_d, state=xi, dt=dt
        )
        robot, reference = driven(robot, v, omega, dt), circling(reference, dt)
    t = steps * dt
    expected = math.exp(-2.0 * t) * (e * (1.0 + 2.0 * t) + e_dot * t)
    assert abs((reference - robot)[:, :2] - expected).max() < 2e-3
    assert abs(e).max() > 0.04


def test_dynamic_feedback_is_reset_where_it_is_singular_and_never_backs_up():
    reference, gains = references(np.zeros(3)), (2.0, 3.0)
    for xi in (0.0, LEAST_SPEED / 2.0):
        v, omega, state = dynamic_feedback_linearization(
            np.array([0.0, 0.1, 0.0]), reference, *gains, state=[xi], dt=0.0
        )
        assert (v, state.tolist()) == (V_R, [V_R])
        assert abs(omega) < 2.0
    ahead, state = np.array([5.0, 0.0, 0.0]), [V_R]
    for _ in range(20):
        v, _, state = dynamic_feedback_linearization(ahead, reference, *gains, state=state, dt=0.02)
        assert v >= LEAST_SPEED


def test_pure_pursuit_drives_along_the_circle_through_the_point():
    robot, target = poses(), poses()
    v, omega = pure_pursuit(robot, references(target), 1e-3)
    # The chord of an arc that turns by 2 alpha points alpha beside the heading.
    left = se2.compose(se2.inverse(robot), target)
    alpha = np.arctan2(left[:, 1], left[:, 0])
    assert np.allclose(driven(robot, v, omega, 2.0 * alpha / omega)[:, :2], target[:, :2])
    at_distance = pure_pursuit([0.0, 0.0, 0.0], references(np.array([0.3, 0.4, 0.0])), 0.5)
    assert at_distance == pytest.approx((V_R, 2.0 * V_R * 0.4 / 0.5**2))


# --- Robots that follow


def eight(count=60):
    angles = np.linspace(0.0, math.tau, count + 1)
    return Path(0.5 * np.stack([np.sin(angles), np.sin(angles) * np.cos(angles)], axis=-1))


@pytest.mark.parametrize('controller', PATH_CONTROLLERS, ids=lambda one: one.name)
def test_follows_a_figure_eight(controller):
    path = eight()
    gains = {'lookahead_distance': 0.1} if controller is PURE_PURSUIT else {}
    result = follow_path(controller, path, rate=20.0, gains=gains)
    assert result.finished
    # It drives the whole of it, through the crossing, not from one branch to the other.
    assert result.times[-1] == pytest.approx(path.length / 0.2, rel=0.02)
    # Pure pursuit cuts corners.
    most = 0.015 if controller is PURE_PURSUIT else 6e-3
    assert abs(result.errors[:, 1]).max() < most


def test_a_robot_that_is_too_slow_for_a_trajectory_is_late_and_drives_on_to_its_end():
    model, line = RobotModel(limits=VelocityLimits(max_v=0.2)), line_path(3.0).timed(1.0)
    result = follow_path(KANAYAMA, line, model=model, timeout=30.0)
    assert result.finished
    assert result.poses[-1, 0] == pytest.approx(2.98, abs=0.01)
    # 3 m at 0.2 m/s, instead of in 3 s.
    assert result.late[-1] == pytest.approx(result.times[-1] - 3.0) == pytest.approx(15.9, abs=0.2)
    # The times wait: the error along counts from where they stand.
    assert abs(result.errors[:, 0]).max() < 0.35
    assert not follow_path(KANAYAMA, line, model=model, timeout=16.0).finished
    assert follow_path(KANAYAMA, line).late == pytest.approx(0.0, abs=1e-9)
    assert np.isnan(follow_path(KANAYAMA, line_path(0.3)).late).all()


def test_recovers_from_slip_when_it_is_localised():
    path = Path(eight().poses, eight().arc_lengths / 0.4)
    slips = {'model': RobotModel(wheel_travel_variance=1e-4, drift=Drift(seed=1))}
    localised = follow_path(DYNAMIC_FEEDBACK, path, **slips, localised=True).errors
    assert 1e-3 < abs(localised[:, :2]).max() < 0.05
    assert not np.array_equal(localised, follow_path(DYNAMIC_FEEDBACK, path, **slips).errors)


def test_the_look_ahead_point_is_beyond_the_end_of_an_open_path():
    path = Path(np.array([[0.0, 0.0], [1.0, 0.0]]))
    law = PURE_PURSUIT.bind(PURE_PURSUIT.defaults)
    follower = PathFollower(path, s=0.9)
    _, command = follower.follow((0.95, 0.05, 0.0), 0.02, law, law, PathSettings())
    v, omega = command
    assert omega == pytest.approx(2.0 * v * -0.05 / 0.2**2, rel=1e-2)


def test_settings_do_not_change_the_look_ahead_of_the_law():
    alone = follow_path('pure_pursuit', eight(), start=(0.0, 0.1, 0.0))
    same = follow_path('pure_pursuit', eight(), start=(0.0, 0.1, 0.0), settings=PathSettings())
    np.testing.assert_array_equal(same.poses, alone.poses)


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        ({'controller': find_controller('pose')}, 'must be of class PathController'),
        ({'controller': 'pose'}, "must be one of .* got 'pose', a law of goals"),
        ({'path': [[0, 0], [1, 0]]}, 'path must be of class Path'),
        ({'rate': 0.0}, r'rate must be in \(0, 1000000000\] Hz'),
        ({'gains': {'k_y': math.nan}}, 'k_y must be in'),
        ({'gains': {'kp': 1.0}}, 'gains must be among k_x, k_y, k_theta, got kp'),
    ],
)
def test_invalid_arguments_are_named(arguments, words):
    with pytest.raises(ValueError, match=words):
        follow_path(**{'controller': KANAYAMA, 'path': eight(), **arguments})


def test_laws_of_paths_are_no_laws_of_goals_and_look_ahead_by_a_gain():
    with pytest.raises(ControllerError, match="got 'kanayama', a law of paths"):
        find_controller('kanayama')
    with pytest.raises(ValueError, match="lookahead must be '' or one of kp, kv, got 'l'"):
        PathController(name='mine', law=lambda *_: (0.0, 0.0), lookahead='l')


@pytest.mark.parametrize('turn', [math.pi, -3.0, 3.0 * math.pi])
def test_a_path_is_followed_across_a_heading_of_pi(turn):
    """The robot has the heading 3.1, and so drives, and does not turn in place first."""
    ahead = [[0.0, 0.0, turn], [-2.0, 2.0 * -math.tan(turn), turn]]
    for law in PATH_CONTROLLERS:
        driven = follow_path(law, Path(np.array(ahead)), start=[0.0, 0.02, 3.1], timeout=30.0)
        assert driven.finished, law
        assert driven.times[-1] < 13.0, law
