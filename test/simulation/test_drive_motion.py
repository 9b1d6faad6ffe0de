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

"""Motion with acceleration limits, lag and delay: exact, and a function of the commands alone."""

from __future__ import annotations

import math
from itertools import islice, pairwise

import numpy as np
import pytest

from diffdrive_jacobian.control import VelocityLimits
from diffdrive_jacobian.robot_testing.faults import ActuatorLag
from diffdrive_jacobian.simulation import Robot, RobotModel
from diffdrive_jacobian.simulation.actuators import AccelerationLimits, Actuators, AxisLimits
from diffdrive_jacobian.simulation.slip import Drift
from diffdrive_jacobian.simulation.speeds import Course, Piece, Profile

SECOND = 1_000_000_000
L = 0.16
RATES = (
    *('max_acceleration', 'max_deceleration'),
    *('max_acceleration_reverse', 'max_deceleration_reverse'),
)
V = dict(zip(RATES, (0.5, -0.8, -0.3, 0.6), strict=True))
OMEGA = dict(zip(RATES, (2.0, -3.0, -2.5, 3.5), strict=True))


def limits(**more):
    return AccelerationLimits(v=AxisLimits(**V), omega=AxisLimits(**OMEGA), **more)


def at_rest(**options):
    """Return a robot; acceleration limits, lag and delay are those of its actuators."""
    of_actuators = {'acceleration', 'lag', 'delay', 'max_right_speed'} & {*options}
    actuators = Actuators(**{name: options.pop(name) for name in of_actuators})
    model = RobotModel(**{'wheel_separation': L, **options}, actuators=actuators)
    return Robot(model=model, stamp=0, pose=(0.0, 0.0, 0.0))


def close(one, other, tolerance=1e-12):
    assert np.abs(np.subtract(one, other)).max() < tolerance


# --- A reference by quadrature

NODES, WEIGHTS = np.polynomial.legendre.leggauss(12)


def axis_rate(of, speed, change):
    """The rules of diff_drive_controller."""
    if speed > 0:
        return of['max_acceleration'] if change > 0 else -of['max_deceleration']
    if speed < 0:
        return of['max_deceleration_reverse'] if change > 0 else -of['max_acceleration_reverse']
    return of['max_acceleration'] if change > 0 else -of['max_acceleration_reverse']


def reference(commands, end, tau):
    """The pose after commands `(time, v, omega)` (s), with `limits()` and a lag."""
    u, y, pose = np.zeros(2), np.zeros(2), np.zeros(3)
    for (begin, *target), (until, *_) in pairwise([*commands, (end, 0.0, 0.0)]):
        left = until - begin
        while left > 0:
            change = target - u
            step, slope, zero = left, np.zeros(2), None
            if change.any():
                rates = [axis_rate(*one) for one in zip((V, OMEGA), u, change, strict=True)]
                whole = np.max(np.abs(change) / rates)
                slope = change / whole
                # The rates change where a speed changes its sign, and end at the target.
                times = [(whole, 2)]
                times += [(-u[axis] / slope[axis], axis) for axis in (0, 1) if u[axis] * slope[axis] < 0]
                time, knot = min(times)
                if time <= left:
                    step, zero = time, knot
            pose, y = driven(pose, u, slope, y, step, tau)
            u = np.array(target) if zero == 2 else u + slope * step
            if zero in (0, 1):
                u[zero] = 0.0
            left -= step
    return pose


def driven(pose, u, slope, y, seconds, tau):
    """Integrate speeds that follow `u + slope t` with a lag."""
    turn = (abs(u[1]) + abs(slope[1]) * seconds + abs(y[1] - u[1])) * seconds
    count = max(1, math.ceil(turn / 0.5), math.ceil(seconds / tau * 2.0) if tau else 1)
    h, rest = seconds / count, y - u + slope * tau

    def speeds(axis, t):
        fading = rest[axis] * np.exp(-t / tau) if tau else 0.0
        return u[axis] + slope[axis] * (t - tau) + fading

    def turned(t):
        fading = -rest[1] * tau * np.expm1(-t / tau) if tau else 0.0
        return (u[1] - slope[1] * tau) * t + slope[1] * t * t / 2 + fading

    t = (np.arange(count)[:, np.newaxis] + (1.0 + NODES) / 2.0) * h
    path = h / 2.0 * WEIGHTS * speeds(0, t)
    heading = pose[2] + turned(t)
    moved = np.sum(path * np.cos(heading)), np.sum(path * np.sin(heading)), turned(seconds)
    return pose + moved, speeds(np.array([0, 1]), seconds)


@pytest.mark.parametrize('tau', [0.0, 0.05, 0.3])
def test_the_pose_is_that_of_an_integration(tau):
    rng = np.random.default_rng(31)
    for _ in range(8):
        times = np.sort(rng.integers(0, 8 * SECOND, 6))
        times[0] = 0
        twists = np.round(rng.uniform((-0.5, -2.0), (0.5, 2.0), (6, 2)), 3)
        twists[rng.uniform(size=6) < 0.2] = 0.0
        robot = at_rest(acceleration=limits(), lag=tau)
        for stamp, twist in zip(times.tolist(), twists.tolist(), strict=True):
            robot = robot.commanded(twist, stamp)
        end = 9 * SECOND + 7
        commands = [(stamp / SECOND, *twist) for stamp, twist in zip(times, twists, strict=True)]
        x, y, theta = robot.at(end).pose - reference(commands, end / SECOND, tau)
        close((x, y, math.remainder(theta, math.tau)), 0.0)


# --- Limits, lag and delay


def test_no_wheel_accelerates_beyond_its_limit_and_one_is_often_at_it():
    rng = np.random.default_rng(5)
    robot, stamp, shares = at_rest(acceleration=limits(max_wheel_acceleration=9.0)), 0, []
    for _ in range(30):
        robot = robot.commanded(rng.uniform((-0.5, -2.0), (0.5, 2.0)), stamp)
        stamp += int(rng.integers(SECOND // 100, SECOND))
        times = np.linspace(robot.stamp, stamp, 15).astype(int)
        speeds = [robot.at(time).wheel_speeds for time in times.tolist()]
        accelerations = np.diff(speeds, axis=0) / np.diff(times)[:, np.newaxis] * SECOND
        shares += (np.abs(accelerations) / 9.0).max(axis=1).tolist()
    assert max(shares) < 1.0 + 1e-6
    assert np.count_nonzero(np.array(shares) > 0.999) > 45


def test_a_speed_that_changes_by_its_rounding_takes_no_time():
    axis = AccelerationLimits(v=AxisLimits(max_acceleration=0.5, max_deceleration=-0.5))
    robot = at_rest(acceleration=axis, lag=0.1).commanded((0.3, 0.0), 0).at(SECOND)
    for change in (0.0, 1e-16, 1e-12, 3e-9):
        # omega has no limit of its own, and changes while v does.
        turned = robot.commanded((0.3 + change, 1.0), SECOND).at(2 * SECOND)
        assert turned.pose[2] == pytest.approx(1.0 - 0.1 * (1.0 - math.exp(-10.0)), abs=2e-8)


def test_a_delay_shifts_the_motion_of_the_motors_and_nothing_else():
    delay, period = 137_000_001, 50_000_000
    commands = [((0.4 * math.sin(one), math.cos(one)), SECOND + one * period) for one in range(12)]
    plain = [at_rest(acceleration=limits(), lag=0.1)]
    late = at_rest(acceleration=limits(), lag=0.1, delay=delay)
    for twist, stamp in commands:
        plain.append(plain[-1].commanded(twist, stamp + delay))
        late = late.commanded(twist, stamp)
        assert late.target == twist
        # Commands come faster than the delay: the last one that the motors know is an older one.
        for now in range(stamp, stamp + period, 20_000_000):
            known = [one for one in plain if one.stamp <= now][-1].at(now)
            close(late.at(now).pose, known.pose)
            assert late.at(now).twist == pytest.approx(known.twist, abs=1e-13)
    close(late.at(9 * SECOND).pose, plain[-1].at(9 * SECOND).pose)


def test_a_timeout_stops_by_deceleration():
    robot = at_rest(acceleration=limits(), command_timeout=SECOND).commanded((0.4, 0.0), 0)
    assert robot.at(SECOND + SECOND // 4).twist == pytest.approx((0.4 - 0.8 * 0.25, 0.0))
    end = robot.at(3 * SECOND)
    assert (end.twist, end.target, end.expiry) == ((0.0, 0.0), (0.0, 0.0), None)


def test_velocity_limits_apply_to_the_target_and_a_weak_motor_clips_what_is_demanded():
    robot = at_rest(acceleration=limits(), limits=VelocityLimits(max_v=0.2)).commanded((0.4, 1.0), 0)
    assert robot.target == robot.at(5 * SECOND).twist == (0.2, 0.5)
    robot = at_rest(acceleration=limits(), max_right_speed=4.0).commanded((0.4, 0.0), 0)
    for stamp in range(0, 2 * SECOND, SECOND // 10):
        right, left = robot.at(stamp).wheel_speeds
        assert left == pytest.approx(min(0.5 * stamp / SECOND, 0.4) / 0.033)
        assert right == pytest.approx(min(4.0, left))


@pytest.mark.parametrize('drift', [None, Drift(seed=4), Drift(wheel_separation_multiplier=1.1)], ids=str)
def test_the_motion_does_not_depend_on_when_it_is_looked_at(drift):
    options = {'lag': 0.2, 'delay': 30_000_000, 'drift': drift, 'command_timeout': SECOND // 2}

    def drive(looks):
        robot, time = at_rest(acceleration=limits(), **options), 11
        for v, omega, seconds in ((0.2, 0.0, 0.11), (0.1, -1.0, 0.234567), (-0.2, 0.5, 2.9)):
            robot = robot.commanded((v, omega), time)
            for look in looks:
                robot.at(time + round(look * seconds * SECOND))
            time += round(seconds * SECOND)
        return robot.at(time)

    one, other = drive([]), drive([0.1, 0.11, 0.5, 0.77, 0.7701])
    assert one.pose_tuple == other.pose_tuple
    assert one.true_pose_tuple == other.true_pose_tuple
    assert (one.wheel_angles, one.twist) == (other.wheel_angles, other.twist)
    assert one.covariance_tuple == other.covariance_tuple
    assert (drift is None) == (one.pose_tuple == one.true_pose_tuple)


# --- Moments and slip


def test_the_moments_are_those_of_many_short_arcs():
    """The error of arcs of constant speeds is of second order in their duration."""
    commands = ((0, (0.3, 1.2)), (600_000_000, (-0.25, -0.9)), (2 * SECOND, (0.1, 2.0)))
    end, k = 3 * SECOND, 1e-3
    robots = [at_rest(acceleration=limits(), lag=0.1, wheel_travel_variance=k)]
    for stamp, twist in commands:
        robots.append(robots[-1].commanded(twist, stamp))

    def by_arcs(step):
        short = at_rest(wheel_travel_variance=k)
        for time in range(0, end, step):
            latest = [one for one in robots if one.stamp <= time][-1]
            short = short.commanded(latest.at(time + step // 2).twist, time)
        return np.array(short.at(end).covariance_tuple)

    coarse, fine = by_arcs(20_000_000), by_arcs(10_000_000)
    found = np.array(robots[-1].at(end).covariance_tuple)
    scale = np.sqrt(np.outer(*[found[[0, 4, 8]]] * 2)).ravel()
    close((found - fine) / scale, 0.0, 5e-4)
    close((found - fine - (fine - coarse) / 3.0) / scale, 0.0, 5e-5)


def test_the_moments_of_a_part_and_the_rest_are_those_of_the_whole():
    robot = at_rest(acceleration=limits(), lag=0.1, wheel_travel_variance=1e-3)
    robot = robot.commanded((0.4, 1.5), 0)
    parts = robot
    for stamp in range(7_000_000, 2 * SECOND, 77_000_000):
        parts = parts.at(stamp)
    whole = np.array(robot.at(2 * SECOND).moments)
    close(np.array(parts.at(2 * SECOND).moments), whole, 1e-13)
    assert whole[0] > 1e-5


@pytest.mark.parametrize('lag', [0.1, 0.3])
@pytest.mark.parametrize('acceleration', [0.3, 1.0])
def test_at_the_very_beginning_no_variance_is_negative_and_no_speed_goes_back(acceleration, lag):
    axis = AxisLimits(max_acceleration=acceleration)
    limited = AccelerationLimits(v=axis, omega=axis)
    robot = at_rest(lag=lag, delay=SECOND // 10, acceleration=limited).commanded((0.2, 0.7), 0)
    for after in range(20):
        here = robot.at(SECOND // 10 + after)
        assert np.diag(here.covariance).min() >= 0.0
        assert min(here.twist) >= 0.0


def test_a_heading_that_is_lost_at_once_takes_few_steps():
    """The noise of wheels that are a tenth of a millimetre apart would need 8 million in a second."""
    robot = at_rest(wheel_separation=1e-4, wheel_travel_variance=1.0, lag=0.1)
    robot = robot.commanded((0.2, 0.0), 0).at(SECOND)
    x = robot.pose_tuple[0]
    assert np.isfinite(robot.covariance).all()
    # The true heading is anything: the true position is about the start, k x / 4 for each axis.
    assert robot.covariance[0, 0] == pytest.approx(x * x + x / 4.0, rel=1e-3)


def test_true_wheels_without_slip_drive_the_same_motion_with_their_geometry():
    drift = Drift(right_wheel_radius_multiplier=1.02, wheel_separation_multiplier=0.95)
    robot = at_rest(acceleration=limits(), lag=0.1, drift=drift).commanded((0.3, 1.0), 0).at(2 * SECOND)
    right, left = np.array(robot.wheel_angles) * 0.033 * (1.02, 1.0)
    close(robot.true_pose[2], (right - left) / (0.95 * L))


def test_slip_with_varying_speeds_has_the_variance_of_the_distance():
    k, distances = 1e-4, []
    for seed in range(60):
        robot = at_rest(acceleration=limits(), drift=Drift(seed=seed), wheel_travel_variance=k)
        end = robot.commanded((0.4, 0.0), 0).at(3 * SECOND // 2)
        distances.append(end.true_pose[0] - end.pose[0])
    rolled = end.wheel_angles[0] * 0.033
    # Two wheels with k rolled each, their mean; less what the heading takes.
    assert np.var(distances) == pytest.approx(k * rolled / 2.0, rel=0.5)


# --- Bad input, extreme times


def test_invalid_limits_and_lags_are_refused():
    for name, value in (
        *(('max_acceleration', bad) for bad in (-0.1, 0.0)),
        *(('max_deceleration', bad) for bad in (0.1, math.nan)),
        *(('max_acceleration_reverse', 0.0), ('max_deceleration_reverse', 'x')),
    ):
        with pytest.raises(ValueError, match=name):
            AxisLimits(**{name: value})
    # Below the resolution of times the steps of the motion would not progress.
    with pytest.raises(ValueError, match='lag must be 0 or at least 1e-09 s, got 9e-10'):
        Actuators(lag=9e-10)
    with pytest.raises(ValueError, match='seconds must be at least 1e-09 s, got 9e-10'):
        ActuatorLag(9e-10)
    close(at_rest(lag=1e-9).commanded((0.2, 0.7), 0).at(SECOND).twist, (0.2, 0.7))
    # This command would never be reached.
    slow = AccelerationLimits(v=AxisLimits(max_acceleration=5e-324))
    with pytest.raises(ValueError, match='limits of the acceleration must be larger'):
        at_rest(acceleration=slow, lag=1.0).commanded((1e10, 0.0), 0)


def test_steps_progress_also_where_they_are_shorter_than_the_resolution_of_times():
    """After a ramp of 30 years that is 1e-7 s."""
    ramp = Piece(1e9, Course(0.0, 1e-9), Course(0.0))
    lagging = Piece(36e-8, Course(1.0, 0.0, -1.0, 1e-8), Course(0.0, tau=1e-8))
    profile = Profile(0, [ramp, lagging, Piece(math.inf, Course(1.0), Course(0.0))])
    ends = [end for _, end in islice(profile.steps(1e9 - 1.0, 1e9 + 1.0), 1000)]
    assert ends[-1] == 1e9 + 1.0
    assert all(first < second for first, second in pairwise(ends))
