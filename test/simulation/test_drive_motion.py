"""Motion with acceleration limits, lag and delay: exact, and a function of the commands alone."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from diffdrive_jacobian.control import VelocityLimits
from diffdrive_jacobian.simulation import Robot, RobotModel
from diffdrive_jacobian.simulation.actuators import AccelerationLimits, Actuators, AxisLimits
from diffdrive_jacobian.simulation.slip import Drift

SECOND = 1_000_000_000
REAL = np.longdouble
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
    """A robot; acceleration limits, lag and delay are those of its actuators."""
    of_actuators = {'acceleration', 'lag', 'delay', 'max_right_speed'} & {*options}
    actuators = Actuators(**{name: options.pop(name) for name in of_actuators})
    model = RobotModel(wheel_separation=L, actuators=actuators, **options)
    return Robot(model=model, stamp=0, pose=(0.0, 0.0, 0.0))


def close(one, other, tolerance=1e-12):
    assert np.abs(np.asarray(one, dtype=REAL) - np.asarray(other, dtype=REAL)).max() < tolerance


# --- A reference in extended precision


def gauss_legendre(count):
    """Nodes and weights on [0, 1] in extended precision."""
    x = np.polynomial.legendre.leggauss(count)[0].astype(REAL)
    for _ in range(3):
        p, before = x, np.ones_like(x)
        for k in range(1, count):
            p, before = ((2 * k + 1) * x * p - k * before) / REAL(k + 1), p
        slope = count * (x * p - before) / (x * x - 1)
        x = x - p / slope
    return (1 + x) / 2, 1 / ((1 - x * x) * slope * slope)


NODES, WEIGHTS = gauss_legendre(12)


def axis_rate(of, speed, change):
    """The rules of diff_drive_controller."""
    if speed > 0:
        return of['max_acceleration'] if change > 0 else -of['max_deceleration']
    if speed < 0:
        return of['max_deceleration_reverse'] if change > 0 else -of['max_acceleration_reverse']
    return of['max_acceleration'] if change > 0 else -of['max_acceleration_reverse']


def reference(commands, end, tau):
    """The pose after commands `(time, v, omega)` (s), with `limits()` and a lag."""
    u, y, pose = np.zeros(2, REAL), np.zeros(2, REAL), np.zeros(3, REAL)
    for (begin, *target), (until, *_) in pairwise([*commands, (end, 0.0, 0.0)]):
        left, target = REAL(until) - REAL(begin), np.array(target, REAL)
        while left > 0:
            change = target - u
            step, slope, knot = left, np.zeros(2, REAL), None
            if change.any():
                rates = [
                    REAL(axis_rate(of, speed, by))
                    for of, speed, by in zip((V, OMEGA), u, change, strict=True)
                ]
                whole = max(abs(by) / rate for by, rate in zip(change, rates, strict=True))
                slope, times = change / whole, [(whole, None)]
                times += [(-u[axis] / slope[axis], axis) for axis in (0, 1) if u[axis] * slope[axis] < 0]
                time, at = min(times, key=lambda one: one[0])
                if time <= left:
                    step, knot = time, (at,)
            pose, y = driven(pose, u, slope, y, step, tau)
            u = u + slope * step
            if knot == (None,):
                u = target.copy()
            elif knot is not None:
                u[knot[0]] = 0
            left -= step
    return pose


def driven(pose, u, slope, y, seconds, tau):
    """Integrate speeds that follow `u + slope t` with a lag."""
    turn = abs(u[1]) * seconds + abs(slope[1]) * seconds**2 + abs(y[1] - u[1]) * seconds
    count = max(1, math.ceil(float(turn) / 0.5), math.ceil(float(seconds) / tau * 2.0) if tau else 1)
    h = seconds / count

    def speeds(t):
        demanded = u[:, None] + slope[:, None] * t
        if not tau:
            return demanded
        lagging = demanded - slope[:, None] * REAL(tau)
        return lagging + (y - u + slope * REAL(tau))[:, None] * np.exp(-t / REAL(tau))

    def turned(t):
        if not tau:
            return u[1] * t + slope[1] * t * t / 2
        rest = y[1] - u[1] + slope[1] * REAL(tau)
        lagging = (u[1] - slope[1] * REAL(tau)) * t + slope[1] * t * t / 2
        return lagging - rest * REAL(tau) * np.expm1(-t / REAL(tau))

    x, at_y, theta = pose
    for number in range(count):
        t = (number + NODES) * h
        v, heading = speeds(t)[0], theta + turned(t)
        x = x + h * np.sum(WEIGHTS * v * np.cos(heading))
        at_y = at_y + h * np.sum(WEIGHTS * v * np.sin(heading))
    end = speeds(np.array([seconds], REAL))[:, 0]
    return np.array([x, at_y, theta + turned(seconds)]), end


@pytest.mark.parametrize('tau', [0.0, 0.05, 0.3])
def test_the_pose_is_that_of_an_integration_in_extended_precision(tau):
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
        found = robot.at(end).pose_tuple
        commands = [(stamp / SECOND, *twist) for stamp, twist in zip(times, twists, strict=True)]
        expected = reference(commands, end / SECOND, tau)
        close(found[:2], expected[:2])
        assert abs(math.remainder(found[2] - float(expected[2]), math.tau)) < 1e-12


def test_a_speed_that_changes_by_its_rounding_takes_no_time():
    axis = AccelerationLimits(v=AxisLimits(max_acceleration=0.5, max_deceleration=-0.5))
    robot = at_rest(acceleration=axis, lag=0.1).commanded((0.3, 0.0), 0).at(SECOND)
    for change in (0.0, 1e-16, 1e-12, 3e-9):
        # omega has no limit of its own, and changes while v does.
        turned = robot.commanded((0.3 + change, 1.0), SECOND).at(2 * SECOND)
        assert turned.pose[2] == pytest.approx(1.0 - 0.1 * (1.0 - math.exp(-10.0)), abs=2e-8)


def test_from_rest_and_to_rest_the_path_is_one_circle():
    radius = 0.4 / 1.5
    robot = at_rest(acceleration=limits()).commanded((0.4, 1.5), 0)
    robot = robot.commanded((0.2, 0.75), SECOND // 2).commanded((0.0, 0.0), 2 * SECOND)
    for stamp in range(SECOND // 10, 3 * SECOND, SECOND // 10):
        if stamp > robot.stamp:
            x, y, _ = robot.at(stamp).pose
            assert math.hypot(x, y - radius) == pytest.approx(radius, rel=1e-14)
            v, omega = robot.at(stamp).twist
            assert v * 1.5 == pytest.approx(omega * 0.4, abs=1e-15)


def test_no_acceleration_exceeds_its_limit_nor_does_that_of_a_wheel():
    rng = np.random.default_rng(5)
    model = {'acceleration': limits(max_wheel_acceleration=12.0)}
    robot, stamp = at_rest(**model), 0
    at_limit = 0
    for _ in range(50):
        robot = robot.commanded(rng.uniform((-0.5, -2.0), (0.5, 2.0)), stamp)
        stamp += int(rng.integers(1, SECOND))
        times = np.linspace(robot.stamp, stamp, 15).astype(int).tolist()
        for one, other in pairwise(robot.at(time) for time in times):
            dt = (other.stamp - one.stamp) / SECOND
            if not dt:
                continue
            shares = []
            for of, before, after in zip((V, OMEGA), one.twist, other.twist, strict=True):
                if before * after >= 0.0:
                    middle = (before + after) / 2.0
                    shares.append(abs(after - before) / dt / axis_rate(of, middle, after - before))
            for before, after in zip(one.wheel_speeds, other.wheel_speeds, strict=True):
                shares.append(abs(after - before) / dt / 12.0)
            assert max(shares) < 1.0 + 1e-6
            at_limit += max(shares) > 0.999
    # As fast as the limits allow.
    assert at_limit > 75


def test_a_delay_shifts_the_motion_of_the_motors_and_nothing_else():
    delay = 137_000_001
    plain = at_rest(acceleration=limits(), lag=0.1)
    late = at_rest(acceleration=limits(), lag=0.1, delay=delay)
    # Commands come faster than the delay.
    for number in range(12):
        twist = (0.4 * math.sin(number), math.cos(number))
        stamp = SECOND + number * 50_000_000
        plain, late = plain.commanded(twist, stamp + delay), late.commanded(twist, stamp)
        assert late.target == twist
        if number > 5:
            seen = late.at(stamp + 20_000_000)
            ago = at_rest(acceleration=limits(), lag=0.1)
            for back in range(number + 1):
                time = SECOND + back * 50_000_000 + delay
                if time <= seen.stamp:
                    ago = ago.commanded((0.4 * math.sin(back), math.cos(back)), time)
            close(seen.pose, ago.at(seen.stamp).pose)
            assert seen.twist == pytest.approx(ago.at(seen.stamp).twist, abs=1e-13)
    close(late.at(9 * SECOND).pose, plain.at(9 * SECOND).pose)


@pytest.mark.parametrize('slips', [False, True])
def test_the_motion_does_not_depend_on_when_it_is_looked_at(slips):
    drift = Drift(seed=4, wheel_separation_multiplier=1.1) if slips else None

    def drive(looks):
        robot = at_rest(
            acceleration=limits(), lag=0.2, delay=30_000_000, drift=drift, command_timeout=SECOND // 2
        )
        time = 11
        for v, omega, seconds in ((0.2, 0.0, 0.11), (0.1, -1.0, 0.234567), (-0.2, 0.5, 2.9)):
            robot = robot.commanded((v, omega), time)
            end = time + round(seconds * SECOND)
            for look in looks:
                robot.at(time + round(look * (end - time)))
            time = end
        return robot.at(time)

    one, other = drive([]), drive([0.1, 0.11, 0.5, 0.77, 0.7701])
    assert one.pose_tuple == other.pose_tuple
    assert one.true_pose_tuple == other.true_pose_tuple
    assert (one.wheel_angles, one.twist) == (other.wheel_angles, other.twist)
    assert one.covariance_tuple == other.covariance_tuple
    assert slips == (one.pose_tuple != one.true_pose_tuple)


def test_the_moments_are_those_of_many_short_arcs():
    """The error of arcs of constant speeds is of second order in their duration."""
    commands = ((0, (0.3, 1.2)), (600_000_000, (-0.25, -0.9)), (2 * SECOND, (0.1, 2.0)))
    end, k = 3 * SECOND, 1e-3
    robot = at_rest(acceleration=limits(), lag=0.1, wheel_travel_variance=k)
    robots = []
    for stamp, twist in commands:
        robot = robot.commanded(twist, stamp)
        robots.append(robot)

    def by_arcs(step):
        short = Robot(
            model=RobotModel(wheel_separation=L, wheel_travel_variance=k), stamp=0, pose=(0.0, 0.0, 0.0)
        )
        for time in range(0, end, step):
            latest = [one for one in robots if one.stamp <= time][-1]
            twist = latest.at(time + step // 2).twist
            short = short.commanded(twist, time)
        return np.array(short.at(end).covariance_tuple)

    coarse, fine = by_arcs(20_000_000), by_arcs(10_000_000)
    extrapolated = fine + (fine - coarse) / 3.0
    found = np.array(robot.at(end).covariance_tuple)
    scale = np.sqrt(np.outer(*[found[[0, 4, 8]]] * 2)).ravel()
    assert (np.abs(found - fine) / scale).max() < 5e-4
    assert (np.abs(found - extrapolated) / scale).max() < 5e-5


def test_the_moments_of_a_part_and_the_rest_are_those_of_the_whole():
    robot = at_rest(acceleration=limits(), lag=0.1, wheel_travel_variance=1e-3)
    robot = robot.commanded((0.4, 1.5), 0)
    parts = robot
    for stamp in range(7_000_000, 2 * SECOND, 77_000_000):
        parts = parts.at(stamp)
    whole = np.array(robot.at(2 * SECOND).moments)
    close(np.array(parts.at(2 * SECOND).moments), whole, 1e-13)
    assert whole[0] > 1e-5


def test_true_wheels_without_slip_drive_the_same_motion_with_their_geometry():
    drift = Drift(right_wheel_radius_multiplier=1.02, wheel_separation_multiplier=0.95)
    robot = at_rest(acceleration=limits(), lag=0.1, drift=drift).commanded((0.3, 1.0), 0).at(2 * SECOND)
    angles = np.array(robot.wheel_angles) * 0.033 * (1.02, 1.0)
    close(robot.true_pose[2], (angles[0] - angles[1]) / (0.95 * L))


def test_slip_with_varying_speeds_has_the_variance_of_the_distance():
    k, distances = 1e-4, []
    for seed in range(80):
        robot = at_rest(acceleration=limits(), drift=Drift(seed=seed), wheel_travel_variance=k)
        end = robot.commanded((0.4, 0.0), 0).at(3 * SECOND)
        distances.append(end.true_pose[0] - end.pose[0])
        rolled = end.wheel_angles[0] * 0.033
    # Two wheels with k rolled each, their mean; less what the heading takes.
    assert np.var(distances) == pytest.approx(k * rolled / 2.0, rel=0.5)


def test_a_timeout_stops_by_deceleration():
    robot = at_rest(acceleration=limits(), command_timeout=SECOND).commanded((0.4, 0.0), 0)
    assert robot.at(SECOND + SECOND // 4).twist == pytest.approx((0.4 - 0.8 * 0.25, 0.0))
    end = robot.at(3 * SECOND)
    assert (end.twist, end.target, end.expiry) == ((0.0, 0.0), (0.0, 0.0), None)


def test_velocity_limits_apply_to_the_target():
    robot = at_rest(acceleration=limits(), limits=VelocityLimits(max_v=0.2)).commanded((0.4, 1.0), 0)
    assert robot.target == (0.2, 0.5)
    assert robot.at(5 * SECOND).twist == (0.2, 0.5)


def test_a_weak_motor_clips_what_the_limits_demand():
    robot = at_rest(acceleration=limits(), max_right_speed=4.0).commanded((0.4, 0.0), 0)
    for stamp in range(0, 2 * SECOND, SECOND // 10):
        right, left = robot.at(stamp).wheel_speeds
        assert left == pytest.approx(min(0.5 * stamp / SECOND, 0.4) / 0.033)
        assert right == pytest.approx(min(4.0, left))


def test_limits_with_the_wrong_sign_are_refused():
    for name, value in (
        *(('max_acceleration', bad) for bad in (-0.1, 0.0)),
        *(('max_deceleration', bad) for bad in (0.1, math.nan)),
        *(('max_acceleration_reverse', 0.0), ('max_deceleration_reverse', 'x')),
    ):
        with pytest.raises(ValueError, match=name):
            AxisLimits(**{name: value})
