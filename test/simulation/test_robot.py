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

"""The virtual robot as a value: its motion depends on its commands and their timestamps alone."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from diffdrive_jacobian.control import VelocityLimits
from diffdrive_jacobian.kinematics.diff_drive import wheel_to_body
from diffdrive_jacobian.kinematics.se2 import integrate, wrap_angle
from diffdrive_jacobian.simulation import Robot, RobotModel
from diffdrive_jacobian.simulation.exact_moments import gaussian, propagate_moments
from diffdrive_jacobian.simulation.odometry_noise import twist_covariance

SECOND = 1_000_000_000
LIMITS = VelocityLimits(min_v=-0.1, max_v=0.22, min_omega=-2.0, max_omega=2.0, max_wheel_speed=10.0)
MODEL = RobotModel(limits=LIMITS, command_timeout=SECOND // 4)
HELD = replace(MODEL, command_timeout=0)
EPOCH = 1_999_999_999_123_456_789
START = np.array([0.3, -0.2, 2.9])
STANDING = ((0.0, 0.0), (0.0, 0.0), None)
COVARIANCE = np.array([[4e-4, 1e-4, 0.0], [1e-4, 2e-4, -1e-4], [0.0, -1e-4, 9e-4]])


def start(model=MODEL, stamp=0) -> Robot:
    return Robot(model=model, stamp=stamp, pose=START, covariance=COVARIANCE)


def random_commands(rng, count):
    """Draw commands at times up to 0.4 s apart: some outlive their timeout of 0.25 s, some do not."""
    times = np.cumsum(rng.integers(1, 2 * SECOND // 5, count)).tolist()
    twists = rng.normal(0.0, [0.3, 3.0], (count, 2))
    twists[rng.random(count) < 0.2] = 0.0
    return [(time, (v, omega)) for time, (v, omega) in zip(times, twists.tolist(), strict=True)]


def state(robot):
    """All that is known of a robot, to the last bit, but for its time."""
    arrays = (robot.pose, robot.covariance, robot.wheel_angles)
    known = robot.command, robot.twist, robot.commanded_at
    return (*(np.asarray(array).tobytes() for array in arrays), *known)


def drive(robot):
    return robot.command, robot.twist, robot.expiry


# --- A function of the commands alone


@pytest.mark.parametrize('model', [MODEL, HELD], ids=['timeout', 'held'])
def test_not_a_bit_depends_on_when_it_is_looked_at_or_on_the_epoch(model):
    rng = np.random.default_rng(0)
    commands = random_commands(rng, 100)
    unseen, seen, late = start(model), start(model), start(model, EPOCH)
    for (time, twist), (following, _) in pairwise([*commands, (commands[-1][0] + SECOND, None)]):
        unseen, seen = (robot.commanded(twist, time) for robot in (unseen, seen))
        late = late.commanded(twist, EPOCH + time)
        for look in rng.integers(time, following, 2).tolist():
            assert np.isfinite(seen.at(look).covariance).all()
        if seen.expiry is not None and seen.expiry < following:
            seen = seen.at(seen.expiry)
    unseen, seen = (robot.at(following) for robot in (unseen, seen))
    assert state(unseen) == state(seen)
    *but_the_time_of_the_command, _ = state(late.at(EPOCH + following))
    assert but_the_time_of_the_command == [*state(seen)[:-1]]
    assert np.hypot(*(unseen.pose - START)[:2]) > 1e-3


def test_between_events_the_state_is_one_exact_arc_with_its_covariance():
    robot = start(HELD).commanded((0.15, 1.1), 7)
    there = robot.at(7 + 2 * SECOND)
    assert np.array_equal(there.pose, integrate(START, (0.15, 1.1), 2.0))
    k, separation = HELD.wheel_travel_variance, HELD.wheel_separation
    expected = propagate_moments(gaussian(COVARIANCE), START, (0.15, 1.1), 2.0, separation, k)
    assert there.moments == expected
    assert np.array_equal(there.covariance, expected.second_moment)
    expected = twist_covariance((0.15, 1.1), separation, k, 0.02)
    assert np.array_equal(robot.twist_covariance(0.02), expected)


def test_the_driven_twist_keeps_the_commanded_curvature_and_the_wheels_turn_with_it():
    rng = np.random.default_rng(21)
    for v, omega in rng.normal(0.0, [0.5, 5.0], (20, 2)).tolist():
        robot = start(HELD).commanded((v, omega), 0)
        assert robot.command == (v, omega)
        assert robot.twist[0] * omega == pytest.approx(robot.twist[1] * v, rel=1e-12)
        assert np.abs(robot.wheel_speeds).max() <= LIMITS.max_wheel_speed * (1.0 + 1e-12)
        r, separation = HELD.wheel_radius, HELD.wheel_separation
        assert wheel_to_body(*robot.wheel_speeds, r, separation) == pytest.approx(robot.twist, rel=1e-12)
        there = robot.at(3 * SECOND // 2)
        assert np.array_equal(there.wheel_angles, np.multiply(robot.wheel_speeds, 1.5))
        # What the wheels turned is what the body moved.
        _, turn = wheel_to_body(*there.wheel_angles, r, separation)
        assert wrap_angle(there.pose[2] - START[2] - turn) == pytest.approx(0.0, abs=1e-12)


def test_times_are_integers_of_64_bits_that_do_not_go_back():
    robot, last = start().commanded((0.1, 0.0), 100), 2**63 - 1
    calls = (
        robot.at,
        lambda stamp: robot.commanded((0.1, 0.0), stamp),
        lambda stamp: robot.remodelled(HELD, stamp),
        lambda stamp: robot.placed(START, COVARIANCE, stamp),
    )
    for call in calls:
        assert call(np.int64(100)).stamp == 100
        assert call(last).stamp == last
        with pytest.raises(ValueError, match='cannot go back from 100 ns to 99 ns'):
            call(99)
    for call in (*calls, robot.restarted, lambda stamp: Robot(model=MODEL, stamp=stamp, pose=START)):
        for bad in (0.5, np.float64(2.0), '1', True, last + 1):
            with pytest.raises(ValueError, match=r'^stamp must'):
                call(bad)
    with pytest.raises(ValueError, match=r'^command_timeout must be an integer number of nanoseconds'):
        RobotModel(command_timeout=0.5)


def test_a_robot_is_immutable_and_does_not_change_with_the_arrays_it_was_given():
    pose, covariance = START.copy(), COVARIANCE.copy()
    robot = Robot(model=HELD, stamp=0, pose=pose, covariance=covariance)
    robots = robot, robot.commanded((0.2, 0.1), 0).at(SECOND), robot.placed(pose, covariance, 0)
    before = [state(one) for one in robots]
    pose[:], covariance[:] = 7.0, 7.0
    assert [state(one) for one in robots] == before
    for one in robots:
        assert not one.pose.flags.writeable
        assert not one.covariance.flags.writeable
        for name in ('model', 'stamp', 'pose', 'covariance', 'wheel_angles', 'twist', 'expiry'):
            with pytest.raises(AttributeError):
                setattr(one, name, getattr(robot, name))


def test_a_copy_is_the_same_robot():
    robot = start().commanded((0.2, 1.0), 0).at(1000).commanded((0.1, 1.0), 2000)
    for made in (copy.copy(robot), copy.deepcopy(robot), pickle.loads(pickle.dumps(robot))):
        assert state(made.at(SECOND // 5)) == state(robot.at(SECOND // 5))
        assert drive(made) == drive(robot)
        assert repr(made) == repr(robot)


# --- The timeout


@pytest.mark.parametrize('stamp', [0, EPOCH])
def test_the_timeout_expires_at_its_own_time(stamp):
    robot = start(stamp=stamp).commanded((0.2, 1.0), stamp)
    assert robot.expiry == stamp + 250_000_000
    before = robot.at(robot.expiry - 1)
    assert (before.twist, before.expiry) == ((0.2, 1.0), robot.expiry)
    for later in (250_000_000, 250_000_001, 3 * SECOND):
        after = robot.at(stamp + later)
        assert after.pose.tobytes() == integrate(START, (0.2, 1.0), 0.25).tobytes()
        assert drive(after) == STANDING
        assert after.stamp == stamp + later


def test_a_new_command_restarts_the_timeout_and_standing_still_needs_none():
    robot = start().commanded((0.2, 0.0), 0).commanded((0.2, 0.0), 200_000_000)
    assert (robot.commanded_at, robot.expiry) == (200_000_000, 450_000_000)
    assert robot.commanded((0.0, 0.0), 300_000_000).expiry is None
    assert start(HELD).commanded((0.2, 0.0), 0).expiry is None
    assert (start().commanded_at, start().expiry) == (None, None)
    with pytest.raises(ValueError, match='commanded_at must be at most the stamp, 3, got 4'):
        Robot(model=MODEL, pose=np.zeros(3), stamp=3, commanded_at=4)


def test_a_timeout_shortened_below_the_age_of_the_command_strikes_at_once():
    robot, now = start().commanded((0.2, 1.0), 0), 200_000_000
    for timeout, expiry in (
        (SECOND, SECOND),
        (220_000_000, 220_000_000),
        (100_000_000, now),
        (0, None),
    ):
        changed = robot.remodelled(replace(MODEL, command_timeout=timeout), now)
        assert changed.expiry == expiry
    stopped = robot.remodelled(replace(MODEL, command_timeout=100_000_000), now).at(now + SECOND)
    assert stopped.twist == (0.0, 0.0)
    assert stopped.pose.tobytes() == robot.at(now).pose.tobytes()


# --- Other models, other places


def test_new_limits_apply_at_once_and_raised_again_they_give_the_command_back():
    now, command = 50_000_000, (0.2, 1.5)
    robot = start().commanded(command, 0)
    slow = robot.remodelled(replace(MODEL, limits=VelocityLimits(max_v=0.05)), now)
    assert slow.twist == pytest.approx((0.05, 0.375), rel=1e-12)
    assert slow.command == command
    assert slow.pose.tobytes() == robot.at(now).pose.tobytes()
    restored = slow.remodelled(MODEL, 2 * now)
    # The command is no younger for it.
    assert drive(restored) == drive(robot) == (command, command, SECOND // 4)
    path = START
    for twist in (command, slow.twist, command):
        path = integrate(path, twist, 0.05)
    assert restored.at(3 * now).pose.tobytes() == path.tobytes()
    forbidden = robot.remodelled(replace(MODEL, limits=VelocityLimits(max_v=0.0, max_omega=0.0)), now)
    assert forbidden.twist == (0.0, 0.0)
    assert forbidden.remodelled(MODEL, SECOND).twist == (0.0, 0.0)


def test_new_wheels_turn_from_the_time_they_are_mounted():
    now = 100_000_000
    robot = start(HELD).commanded((0.15, 1.0), 0)
    here = robot.remodelled(replace(HELD, wheel_radius=2.0 * HELD.wheel_radius), now)
    assert here.wheel_speeds == pytest.approx(np.divide(robot.wheel_speeds, 2.0))
    expected = np.add(robot.at(now).wheel_angles, np.multiply(robot.wheel_speeds, 0.05))
    np.testing.assert_allclose(here.at(2 * now).wheel_angles, expected, rtol=1e-12)


def test_placed_restarts_and_drives_on():
    robot, place, now = start().commanded((0.2, 1.0), 0), np.array([5.0, 6.0, -3.0]), 100_000_000
    placed = robot.placed(place, np.zeros((3, 3)), now)
    assert placed.pose.tolist() == place.tolist()
    assert not placed.covariance.any()
    assert np.array_equal(placed.wheel_angles, robot.at(now).wheel_angles)
    assert np.any(placed.wheel_angles)
    assert drive(placed) == drive(robot) == ((0.2, 1.0), (0.2, 1.0), 250_000_000)
    assert placed.at(2 * now).pose.tobytes() == integrate(place, (0.2, 1.0), 0.1).tobytes()
    late = robot.placed(place, np.zeros((3, 3)), SECOND)
    assert drive(late) == STANDING
    assert late.at(9 * SECOND).pose.tolist() == place.tolist()


def test_restarted_stands_still_on_an_earlier_time_line():
    robot = start(stamp=EPOCH).commanded((0.2, 1.0), EPOCH).at(EPOCH + 100_000_000)
    restarted = robot.restarted(5)
    assert restarted.stamp == 5
    assert drive(restarted) == STANDING
    assert state(restarted.at(10 * SECOND)) == state(restarted)
    # It stays where it is, and keeps what it knows of it.
    assert state(restarted)[:3] == state(robot)[:3]


def test_a_covariance_that_overflows_raises_an_error_whenever_it_is_read():
    fast = Robot(model=RobotModel(), stamp=0, pose=np.zeros(3)).commanded((1e200, 0.0), 0).at(SECOND)
    later = fast
    for step in range(100):
        later = later.commanded((0.0, float(step)), (2 + step) * SECOND)
    for robot in (fast, later, fast):
        assert robot.pose_tuple[0] >= 1e200
        with pytest.raises(ValueError, match='overflows'):
            _ = robot.covariance
    assert not later.placed(START, np.zeros((3, 3)), later.stamp).covariance.any()
