"""Calibration from wheels and a reference: Jacobian, efficiency, what is determined, bad input."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from calibration_data import NOISE, NOMINAL, TRUE, Drive, Simulation, square, umbmark

from diffdrive_jacobian.calibration import CalibrationError, Given, Noise, calibrate, preparation
from diffdrive_jacobian.calibration.consistency import misfit
from diffdrive_jacobian.calibration.description import explain_undetermined
from diffdrive_jacobian.calibration.fit import fit, score, solve_block_tridiagonal
from diffdrive_jacobian.calibration.model import Estimate, undetermined
from diffdrive_jacobian.calibration.motion import composed, increments, inverted, relative
from diffdrive_jacobian.calibration.preparation import PERIOD, densified, located, overlapping, without
from diffdrive_jacobian.kinematics.se2 import adjoint

SHORT = Drive.of(umbmark(side=1.0, runs=1))
ROBOT = Simulation(drive=SHORT, rate=25)
SENSOR = Given(lever_arm=(0.0, 0.0), yaw_offset=0.0, time_offset=0.0)


def deviations(result):
    return np.sqrt(np.diag(result.covariance))


def assert_true(result, multipliers=TRUE, most=4.5):
    """Check that the multipliers are the true ones, within some standard deviations that are small."""
    assert (deviations(result) < 0.01).all()
    assert (np.abs(result.multipliers - multipliers) < most * deviations(result)).all()


# --- Motion


def random_wheels(random, count=40):
    time = np.cumsum(random.uniform(0.01, 0.1, count))
    return time, np.cumsum(random.uniform(-1.0, 2.0, (count, 2)), axis=0)


def test_jacobian_of_the_motion_equals_finite_differences():
    random = np.random.default_rng(1)
    time, angles = random_wheels(random)
    at = np.sort(random.uniform(time[0], time[-1], 9))
    geometry = replace(NOMINAL, multipliers=TRUE)
    found = increments(time, angles, at, geometry)
    for index in range(3):
        h = 1e-6
        ends = []
        for sign in (1.0, -1.0):
            factors = np.array(TRUE)
            factors[index] *= np.exp(sign * h)
            changed = replace(NOMINAL, multipliers=tuple(factors))
            ends.append(increments(time, angles, at, changed).steps)
        change = (relative(found.steps, ends[0]) - relative(found.steps, ends[1])) / (2.0 * h)
        np.testing.assert_allclose(found.jacobian[:, :, index], change, atol=1e-8)


def test_steps_do_not_depend_on_where_they_are_divided():
    random = np.random.default_rng(2)
    time, angles = random_wheels(random)
    at = np.linspace(time[0], time[-1], 7)
    once = increments(time, angles, at[[0, -1]], NOMINAL)
    many = increments(time, angles, at, NOMINAL)
    pose, jacobian, covariance = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
    for step, own, noise in zip(many.steps, many.jacobian, many.covariance, strict=True):
        back = adjoint(inverted(step))
        pose = composed(pose, step)
        jacobian = back @ jacobian + own
        covariance = back @ covariance @ back.T + noise
    np.testing.assert_allclose(pose, once.steps[0], atol=1e-12)
    np.testing.assert_allclose(jacobian, once.jacobian[0], atol=1e-12)
    np.testing.assert_allclose(covariance, once.covariance[0], rtol=1e-2, atol=1e-3)


def test_covariance_of_the_motion_is_that_of_simulated_wheels():
    random = np.random.default_rng(3)
    drive = Drive.of([(4.0, 0.2, 0.6)])
    noise = Noise(wheel=1e-6, position=0.0, heading=0.0)
    robot = Simulation(drive=drive, noise=noise, multipliers=(1.0, 1.0, 1.0))
    ends = np.array([relative(*robot.truth(random)[[0, -1]]) for _ in range(1000)])
    found = increments(drive.time, drive.angles, drive.time[[0, -1]], NOMINAL)
    off = relative(np.broadcast_to(found.steps[0], ends.shape), ends)
    nees = np.einsum('ni,ij,nj->n', off, np.linalg.inv(found.covariance[0] * noise.wheel), off)
    assert 2.8 < nees.mean() < 3.2


# --- Estimate


@pytest.mark.parametrize('count', [1, 2, 3, 8, 13])
def test_cyclic_reduction_equals_dense_linear_algebra(count):
    random = np.random.default_rng(count)
    diagonal, upper = random.standard_normal((count, 3, 3)), random.standard_normal((count - 1, 3, 3))
    diagonal = diagonal @ np.swapaxes(diagonal, 1, 2) + 12.0 * np.eye(3)
    right = random.standard_normal((count, 3, 4))
    dense = np.zeros((3 * count, 3 * count))
    for i in range(count):
        dense[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = diagonal[i]
    for i in range(count - 1):
        dense[3 * i : 3 * i + 3, 3 * i + 3 : 3 * i + 6] = upper[i]
        dense[3 * i + 3 : 3 * i + 6, 3 * i : 3 * i + 3] = upper[i].T
    np.linalg.cholesky(dense)  # raises unless it is positive definite
    solution, logarithm = solve_block_tridiagonal(diagonal, upper, right)
    np.testing.assert_allclose(solution.reshape(-1, 4), np.linalg.solve(dense, right.reshape(-1, 4)))
    assert logarithm == pytest.approx(np.linalg.slogdet(dense)[1])


@pytest.mark.parametrize('steps', [None, 16])
def test_information_equals_that_of_a_dense_model(steps):
    """Of the increments of the whole drive and the reading errors, without the poses as unknowns."""
    random = np.random.default_rng(4)
    robot = replace(ROBOT, drive=Drive.of([(3.0, 0.2, 0.0), (2.0, 0.0, 0.8), (2.0, 0.2, -0.4)]))
    recording = robot.recording(random)
    if steps:
        recording = replace(recording, wheel_angles=stepped(recording.wheel_angles, steps, random))
    result = calibrate([recording], NOMINAL)
    motion, estimate = result.motions[0], result.estimate
    at = motion.time + result.time_offsets[0]
    found = increments(motion.wheel_time, motion.wheel_angles, at, result.geometry)
    n = len(at)
    # Each pose of the body, as the start (3 unknowns), the multipliers and the noise of the steps.
    truth = replace(estimate, states=(composed(estimate.states[0][0], found.poses),))
    states = truth.states[0]
    by = np.zeros((n, 3, 5 * n + 3))
    by[0, :, :3] = np.eye(3)
    for i in range(1, n):
        back = adjoint(inverted(relative(states[i - 1], states[i])))
        by[i] = back @ by[i - 1]
        by[i, :, 3 * i : 3 * i + 3] += np.eye(3)
        by[i, :, 5 * n :] += found.jacobian[i - 1]
    errors = np.column_stack([np.interp(at, motion.wheel_time, one) for one in motion.wheel_errors.T])
    assert errors.any() == (steps is not None)
    right, left = result.geometry.radii
    L = result.geometry.separation
    for i, (of_right, of_left) in enumerate(errors * [right, left]):
        by[i, :, 3 * n + 2 * i] = [of_right / 2.0, 0.0, of_right / L]
        by[i, :, 3 * n + 2 * i + 1] = [of_left / 2.0, 0.0, -of_left / L]
    x, y, _ = estimate.sensor
    J = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
    noise = estimate.noise
    weight = np.diag([noise.position**-2.0] * 2 + [noise.heading**-2.0])
    normal = sum(w * (J @ one).T @ weight @ (J @ one) for w, one in zip(motion.weights, by, strict=True))
    for i in range(1, n):
        block = slice(3 * i, 3 * i + 3)
        normal[block, block] += np.linalg.inv(found.covariance[i - 1] * noise.wheel)
    readings = np.arange(3 * n, 5 * n)
    normal[readings, readings] += 1.0
    expected = np.linalg.inv(normal)[-3:, -3:]
    bound = np.linalg.inv(score([motion], NOMINAL, truth)[0][:3, :3])
    np.testing.assert_allclose(bound, expected, rtol=1e-6)


@pytest.mark.parametrize('given', [None, SENSOR])
def test_umbmark_recovers_the_true_multipliers(given):
    result = calibrate([ROBOT.recording(np.random.default_rng(5))], NOMINAL, given)
    assert_true(result)
    assert result.undetermined == []
    assert result.notes == ()
    assert result.estimate.noise.wheel == pytest.approx(NOISE.wheel, rel=0.5)
    assert result.estimate.noise.position == pytest.approx(NOISE.position, rel=0.1)
    assert result.estimate.noise.heading == pytest.approx(NOISE.heading, rel=0.15)


@pytest.mark.slow
def test_errors_are_those_of_the_cramer_rao_bound_and_of_the_stated_covariance():
    """A small form of `benchmark/calibration_cases.py`: mean squares of 16 robots."""
    errors, nees, bounds, places = [], [], [], []
    count = 16
    for seed in range(count):
        random = np.random.default_rng(100 + seed)
        result = calibrate([ROBOT.recording(random)], NOMINAL)
        error = result.multipliers - TRUE
        assert result.notes == ()
        nees.append(error @ np.linalg.solve(result.covariance, error))
        errors.append(error)
        # The true one is zero.
        places.append(result.estimate.sensor / np.sqrt(np.diag(result.estimate.covariance())[3:6]))
        motion = result.motions[0]
        truth = ROBOT.truth(np.random.default_rng(100 + seed))
        states = np.column_stack([np.interp(motion.time, SHORT.time, one) for one in truth.T])
        known = Estimate(
            parameters=np.array([*np.log(TRUE), 0.0, 0.0, 0.0, 0.0]),
            noise=NOISE,
            free=np.ones(7, dtype=bool),
            states=(states,),
            information=np.zeros((0, 0)),
        )
        bounds.append(np.diag(np.linalg.inv(score([motion], NOMINAL, known)[0]))[:3])
    ratio = np.mean(np.square(errors) / np.array(TRUE) ** 2 / bounds, axis=0)
    # The mean of squares of 16 numbers of variance 1 has the deviation sqrt(2 / 16).
    assert (np.abs(ratio - 1.0) < 3.5 * np.sqrt(2.0 / count)).all(), ratio
    assert abs(np.mean(nees) - 3.0) < 3.5 * np.sqrt(6.0 / count)
    assert (np.abs(np.mean(np.square(places), axis=0) - 1.0) < 3.5 * np.sqrt(2.0 / count)).all(), places


def test_wheel_noise_that_is_not_known_makes_the_multipliers_less_certain():
    """The more so, the less of it a coarse reference shows."""
    ratios = []
    for coarse in (1.0, 10.0):
        noise = replace(NOISE, position=coarse * NOISE.position, heading=coarse * NOISE.heading)
        recording = replace(ROBOT, noise=noise).recording(np.random.default_rng(17))
        unknown = calibrate([recording], NOMINAL)
        found = unknown.estimate.noise
        given = Given(
            wheel_noise=found.wheel, position_noise=found.position, heading_noise=found.heading
        )
        known = calibrate([recording], NOMINAL, given)
        np.testing.assert_allclose(unknown.multipliers, known.multipliers, atol=1e-4)
        ratios.append(float((deviations(unknown) / deviations(known)).mean()))
    assert 1.001 < ratios[0] < ratios[1] < 1.2


def test_the_place_of_the_sensor_is_estimated():
    sensor = (-0.2, 0.3, 3.1)
    result = calibrate([replace(ROBOT, sensor=sensor).recording(np.random.default_rng(6))], NOMINAL)
    assert_true(result)
    np.testing.assert_allclose(result.estimate.sensor, sensor, atol=0.01)


def test_a_sensor_that_is_wrongly_given_makes_worse_estimates():
    recording = replace(ROBOT, sensor=(0.1, 0.0, 0.0)).recording(np.random.default_rng(6))
    result = calibrate([recording], NOMINAL, replace(SENSOR, lever_arm=(0.1, 0.0)))
    assert_true(result)
    np.testing.assert_array_equal(result.estimate.sensor, [0.1, 0.0, 0.0])
    wrong = calibrate([recording], NOMINAL, SENSOR)
    assert wrong.estimate.noise.position > 1.5 * result.estimate.noise.position


@pytest.mark.parametrize('delay', [0.08, -1.7, 1e4])
def test_the_offset_between_the_clocks_is_estimated(delay):
    recording = replace(ROBOT, delay=delay).recording(np.random.default_rng(7))
    result = calibrate([recording], NOMINAL)
    assert_true(result)
    assert result.time_offsets[0] == pytest.approx(delay, abs=0.02)
    assert any('clock of the reference' in note for note in result.notes) == (abs(delay) > 1.0)


LAPS = replace(ROBOT, drive=Drive.of(square(side=1.0) * 5))
SIDE = 5.0 + np.pi / 2.0
"""Time after which these laps repeat themselves (s)."""


def test_equal_laps_have_the_offset_that_is_nearest_to_zero():
    result = calibrate([replace(LAPS, delay=-2.0).recording(np.random.default_rng(7))], NOMINAL)
    assert_true(result)
    assert result.time_offsets[0] == pytest.approx(-2.0, abs=0.05)


def test_an_offset_is_refused_where_the_motion_agrees_with_a_nearer_one():
    delay = 4.2 * SIDE
    recording = replace(LAPS, delay=delay).recording(np.random.default_rng(7))
    with pytest.raises(CalibrationError, match=r'several time offsets.*--time-offset') as refused:
        calibrate([recording], NOMINAL)
    named = [float(one) for one in re.findall(r'(-?[\d.]+) s \(overlap', str(refused.value))]
    assert named[0] == pytest.approx(math.remainder(delay, SIDE), abs=0.1)
    result = calibrate([recording], NOMINAL, Given(time_offset=delay))
    assert_true(result)


def test_a_part_of_the_drive_is_placed_by_its_motion():
    """The reference has another clock, and began later and ended earlier than the wheels."""
    recording = replace(ROBOT, delay=-40.0).recording(np.random.default_rng(7))
    kept = slice(40, -25)
    part = replace(recording, pose_time=recording.pose_time[kept], poses=recording.poses[kept])
    assert calibrate([part], NOMINAL).time_offsets[0] == pytest.approx(-40.0, abs=0.02)


def test_recordings_that_overlap_little_are_compared_by_their_stamps():
    """Offsets near zero are searched at any overlap."""
    recording = ROBOT.recording(np.random.default_rng(7))
    wheels, poses = recording.wheel_time < 45.0, recording.pose_time > 28.0
    parts = replace(
        recording,
        wheel_time=recording.wheel_time[wheels],
        wheel_angles=recording.wheel_angles[wheels],
        pose_time=recording.pose_time[poses] - 1.0,
        poses=recording.poses[poses],
    )
    assert calibrate([parts], NOMINAL).time_offsets[0] == pytest.approx(1.0, abs=0.05)


def test_a_drive_at_constant_speed_does_not_show_the_offset():
    recording = replace(ROBOT, drive=Drive.of([(40.0, 0.2, 0.5)])).recording(np.random.default_rng(7))
    result = calibrate([recording], NOMINAL)
    assert 'do not show the offset between their clocks' in result.notes[0]
    assert abs(result.time_offsets[0]) < 1.0


def test_nominal_dimensions_may_be_far_off():
    robot = replace(ROBOT, multipliers=(1.5, 1.4, 0.8))
    assert_true(calibrate([robot.recording(np.random.default_rng(8))], NOMINAL), (1.5, 1.4, 0.8))


def test_a_perfect_robot_is_reproduced_exactly():
    robot = replace(ROBOT, noise=Noise(wheel=0.0, position=0.0, heading=0.0))
    result = calibrate([robot.recording(np.random.default_rng(9))], NOMINAL)
    np.testing.assert_allclose(result.multipliers, TRUE, rtol=1e-7)
    assert result.notes[0].startswith('the reference follows the wheels without error')


def test_several_recordings_count_together():
    random = np.random.default_rng(11)
    one = calibrate([ROBOT.recording(random, 'a')], NOMINAL)
    three = [replace(ROBOT, delay=delay).recording(random, str(delay)) for delay in (0.0, 0.5, 1.0)]
    all_of_them = calibrate(three, NOMINAL)
    assert_true(all_of_them)
    assert (deviations(all_of_them) < 0.75 * deviations(one)).all()
    np.testing.assert_allclose(all_of_them.time_offsets, [0.0, 0.5, 1.0], atol=0.02)


# --- Encoders with few steps, and wheels that are recorded rarely


def with_stops(commands, pause=0.6):
    return [one for command in commands for one in (command, (pause, 0.0, 0.0))]


def stepped(readings, steps, random):
    """Return readings of encoders with some steps per turn, from random angles."""
    step = 2.0 * np.pi / steps
    return np.floor(readings / step + random.uniform(0.0, 1.0, 2)) * step


def test_angles_that_change_with_each_sample_are_taken_as_they_are():
    drive = Drive.of(with_stops(umbmark(runs=1)))
    for angles in drive.angles.T:
        found, deviations = located(drive.time, angles)
        np.testing.assert_allclose(found, angles, atol=1e-12)
        assert not deviations.any()


def test_wheels_are_located_between_the_steps_of_their_encoders():
    steps, random = 16, np.random.default_rng(20)
    drive = Drive.of(with_stops(umbmark(runs=2)))
    errors, deviations = [], []
    for readings, angles in zip(stepped(drive.angles, steps, random).T, drive.angles.T, strict=True):
        found, deviation = located(drive.time, readings)
        assert deviation.max() == pytest.approx(2.0 * np.pi / steps / 12.0**0.5)
        moves = deviation == 0.0
        errors.append(found - angles - np.mean((found - angles)[moves]))
        deviations.append(deviation)
    error, deviation = np.concatenate(errors), np.concatenate(deviations)
    rest = deviation == deviation.max()
    # Wheels that pass a step with each sample are located better than stated.
    assert 0.5 < (error[rest] / deviation[rest]).std() < 1.2
    assert error[deviation == 0.0].std() < 0.5 * deviation.max()


@pytest.mark.slow
def test_few_steps_make_the_multipliers_uncertain_and_not_wrong():
    random = np.random.default_rng(21)
    robot = replace(ROBOT, drive=Drive.of(with_stops(umbmark(side=1.0, runs=1))), rate=10)
    errors, nees, widths = [], [], []
    count = 3
    for _ in range(count):
        exact = robot.recording(random)
        coarse = replace(exact, wheel_angles=stepped(exact.wheel_angles, 16, random))
        known, found = (calibrate([one], NOMINAL) for one in (exact, coarse))
        widths.append(deviations(found) / deviations(known))
        errors.append((found.multipliers - known.multipliers) / deviations(found))
        error = found.multipliers - TRUE
        nees.append(error @ np.linalg.solve(found.covariance, error))
    assert np.mean(widths, axis=0)[2] > 1.02
    assert (np.abs(np.mean(errors, axis=0)) < 0.8).all()
    assert np.mean(nees) < 3.0 + 3.5 * np.sqrt(6.0 / count)


def test_wheels_at_4_hz_are_interpolated():
    """The rates of a robot with finite accelerations change little between the samples."""
    time = np.arange(0.0, 20.0, 0.25)
    angles = np.column_stack([-np.cos(time), np.sin(0.7 * time) / 0.7])
    dense, found = densified(time, angles)
    assert np.diff(dense).max() <= PERIOD * (1.0 + 1e-9)
    true = np.column_stack([-np.cos(dense), np.sin(0.7 * dense) / 0.7])
    linear = np.column_stack([np.interp(dense, time, one) for one in angles.T])
    assert np.std(found - true) < 0.3 * np.std(linear - true)


def test_residuals_follow_each_other_in_time_and_show_the_noise_of_the_reference():
    random = np.random.default_rng(18)
    result = calibrate([ROBOT.recording(random, name) for name in 'ab'], NOMINAL)
    first, second = result.residuals()
    assert first[0, 0] == 0.0
    assert second[0, 0] == first[-1, 0]
    for part, motion in zip((first, second), result.motions, strict=True):
        np.testing.assert_allclose(np.diff(part[:, 0]), np.diff(motion.time), atol=1e-9)
        # Poses at rest are means of several.
        squares = motion.weights[:, np.newaxis] * np.square(part[:, 1:])
        spread = np.sqrt(squares.mean(axis=0)) / [NOISE.position, NOISE.position, NOISE.heading]
        assert ((spread > 0.5) & (spread < 1.2)).all(), spread


# --- What a drive does not determine


@pytest.mark.parametrize(
    ('commands', 'names'),
    [
        ([(1.0, 0.0, 0.0), (40.0, 0.2, 0.0), (1.0, 0.0, 0.0)], ['the wheel separation']),
        (
            [(1.0, 0.0, 0.0), (20.0, 0.0, 0.5), (1.0, 0.0, 0.0), (20.0, 0.0, -0.5)],
            ['the common scale', 'the difference of the wheel radii'],
        ),
        ([(40.0, 0.2, 0.5)], ['the common scale', 'the mean of the wheel radii']),
    ],
    ids=['straight', 'in place', 'one circle'],
)
def test_what_is_not_determined_is_named(commands, names):
    robot = replace(ROBOT, drive=Drive.of(commands), rate=10)
    result = calibrate([robot.recording(np.random.default_rng(12))], NOMINAL)
    found = [name for name, _ in result.undetermined]
    assert len(found) == len(names)
    assert all(one.startswith(name) for one, name in zip(found, names, strict=True))


def test_a_drive_that_determines_nothing_is_described():
    nothing = SimpleNamespace(undetermined=undetermined(np.eye(3)))
    assert 'does not determine any of the multipliers: drive straight' in explain_undetermined(nothing)


# --- Bad input


@cache
def base():
    return replace(ROBOT, rate=10).recording(np.random.default_rng(13))


def test_a_jump_of_the_reference_is_noted_and_does_no_harm():
    recording = base()
    poses = recording.poses.copy()
    poses[200:, :2] += [0.4, -0.3]
    result = calibrate([replace(recording, poses=poses)], NOMINAL)
    assert_true(result)
    (note,) = result.notes
    assert 'jumps by 0.5' in note
    assert f'at {recording.pose_time[200]:.3f} s' in note


def test_glitches_are_left_out():
    recording = base()
    poses = recording.poses.copy()
    poses[[50, 120, 121, 250]] += [2.0, -1.0, 0.5]
    result = calibrate([replace(recording, poses=poses)], NOMINAL)
    assert_true(result)
    assert result.notes == ('4 poses of the reference are glitches and were left out',)


def test_gaps_are_noted_and_do_no_harm():
    recording = base()
    time = recording.pose_time
    keep = (time < 20.0) | (time > 26.0)
    gap = calibrate([replace(recording, pose_time=time[keep], poses=recording.poses[keep])], NOMINAL)
    assert_true(gap)
    assert 'gap in the reference, the longest of 6.2 s' in gap.notes[0]
    time = recording.wheel_time
    keep = (time < 20.0) | (time > 26.0)
    cut = replace(recording, wheel_time=time[keep], wheel_angles=recording.wheel_angles[keep])
    gap = calibrate([cut], NOMINAL)
    assert_true(gap)
    assert 'gap in the wheels' in gap.notes[0]
    assert len(gap.segments) == 2


def spoiled(recording, what):
    """Return a recording with a fault."""
    random = np.random.default_rng(14)
    poses = recording.poses.copy()
    angles, time = recording.wheel_angles, recording.pose_time
    if what == 'rest':
        angles = 0.0 * angles
    elif what == 'swapped':
        angles = angles[:, ::-1]
    elif what == 'mirrored':
        poses[:, 1:] *= -1.0
    elif what == 'other robot':
        poses = np.cumsum(0.02 * random.standard_normal(poses.shape), axis=0)
    elif what == 'still':
        poses = 1e-3 * random.standard_normal(poses.shape)
    elif what == 'one wheel':
        angles = angles * [0.0, 1.0]
    elif what == 'positions only':
        poses[:, 2] = 0.0
    elif what == 'NaN':
        poses[3] = np.nan
    elif what == 'backward':
        time = time[::-1]
    return replace(recording, poses=poses, wheel_angles=angles, pose_time=time)


def test_recordings_without_a_time_in_common_are_refused():
    with pytest.raises(CalibrationError, match='no time in common'):
        calibrate([replace(ROBOT, delay=1e4).recording(np.random.default_rng(13))], NOMINAL, SENSOR)


def test_swapped_wheels_are_not_taken_for_an_offset():
    """On laps in alternating directions they turn as the lap before."""
    laps = [square(side=1.0, clockwise=bool(number % 2)) for number in range(6)]
    robot = replace(ROBOT, drive=Drive.of([one for lap in laps for one in lap]))
    with pytest.raises(CalibrationError, match='swapped'):
        calibrate([spoiled(robot.recording(np.random.default_rng(13)), 'swapped')], NOMINAL)


@pytest.mark.parametrize(
    ('scale', 'name'), [(3.2808, 'feet'), (1.4, 'another unit'), (1e3, 'millimetres')]
)
def test_a_reference_in_another_unit_is_noted_or_refused(scale, name):
    recording = base()
    scaled = replace(recording, poses=recording.poses * [scale, scale, 1.0])
    try:
        notes = calibrate([scaled], NOMINAL).notes
    except CalibrationError as error:
        notes = (str(error),)
    (note,) = notes
    assert f'in {name} instead of metres' in note


def test_wheels_that_may_be_swapped_and_negated_are_noted():
    recording = base()
    angles = -recording.wheel_angles[:, ::-1]
    (note,) = calibrate([replace(recording, wheel_angles=angles)], NOMINAL).notes
    assert 'the sensor looks backwards' in note
    backward = Given(yaw_offset=np.pi)
    assert calibrate([replace(recording, wheel_angles=angles)], NOMINAL, backward).notes == ()


@pytest.mark.parametrize(
    ('what', 'words'),
    [
        ('rest', 'the wheels never turn'),
        ('one wheel', 'the right wheel never turns'),
        ('positions only', 'observes positions only'),
        ('swapped', 'swapped'),
        ('mirrored', 'mirrored'),
        ('other robot', 'reference'),
        ('still', 'times as far as the wheels'),
        ('NaN', 'must be finite'),
        ('backward', 'must increase'),
    ],
)
def test_faults_are_named(what, words):
    with pytest.raises(CalibrationError, match=words):
        calibrate([spoiled(base(), what)], NOMINAL)


@pytest.mark.slow
def test_wheels_at_a_low_rate_and_slip_are_noted():
    recording = base()
    rare = replace(
        recording, wheel_time=recording.wheel_time[::50], wheel_angles=recording.wheel_angles[::50]
    )
    assert any('every 1 s' in note for note in calibrate([rare], NOMINAL).notes)
    slips = replace(ROBOT, noise=replace(NOISE, wheel=2e-3)).recording(np.random.default_rng(13))
    assert any('m after 1 m: they slip' in note for note in calibrate([slips], NOMINAL).notes)


def test_long_recordings_are_thinned(monkeypatch):
    """The bounds that keep an hour at 100 Hz cheap, with smaller numbers."""
    recording = replace(ROBOT, rate=1).recording(np.random.default_rng(19))
    monkeypatch.setattr(preparation, 'MOST_SAMPLES', 1500)
    monkeypatch.setattr(preparation, 'MOST_POSES', 150)
    result = calibrate([recording], NOMINAL)
    assert_true(result)
    assert len(result.recordings[0].wheel_time) <= 1500 < len(recording.wheel_time)
    assert sum(len(one.time) for one in result.segments) <= 150
    (note,) = result.notes
    assert 'poses of the reference are used, evenly spaced' in note


def test_too_short_a_drive_is_refused():
    robot = replace(ROBOT, drive=Drive.of([(1.0, 0.2, 0.5)]), rate=10)
    with pytest.raises(CalibrationError, match='too short'):
        calibrate([robot.recording(np.random.default_rng(15))], NOMINAL)


# --- Parts that do not fit


def skidding(drive, random, wheels, when, name='bag'):
    """Return a recording of a robot of which some wheels travel 4 % less than they turn, for some time.

    Args:
        drive: The motion.
        random: Source of the noise.
        wheels: Factors of that for the right and the left wheel.
        when: Whether it is so in each step of the drive.
        name: Of the recording.
    """
    steps = np.diff(drive.angles, axis=0) * (1.0 - 0.04 * np.outer(when, wheels))
    travelled = replace(drive, angles=np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]))
    recording = replace(ROBOT, drive=travelled).recording(random, name)
    return replace(recording, wheel_angles=drive.angles)


SKID = (SHORT.time[1:] > 20.0) & (SHORT.time[1:] < 32.0)


def named_times(note):
    return [float(word) for word in re.search(r'from (\d+) to (\d+) s', note).groups()]


@pytest.mark.parametrize('bags', [1, 2])
def test_a_skid_is_named_and_left_out(bags):
    random = np.random.default_rng(20)
    good = [ROBOT.recording(random, 'good')] * (bags - 1)
    result = calibrate([*good, skidding(SHORT, random, [1.5, 0.0], SKID, 'skid')], NOMINAL)
    assert_true(result)
    (note,) = result.notes
    assert re.match(r'skid: from .* the right wheel travels [567](\.\d)? % less than in the rest', note)
    np.testing.assert_allclose(named_times(note), [20.0, 32.0], atol=4.0)


def test_the_most_likely_parameters_of_the_rest_are_predicted():
    """By the score at the estimate, without a new one."""
    recording = skidding(SHORT, np.random.default_rng(21), [1.5, 0.0], SKID)
    wheels = {'wheel_noise': 1e-5, 'position_noise': 0.005, 'heading_noise': 0.01}
    given = replace(SENSOR, **wheels)
    segments = overlapping(recording, 0, 0.0, NOMINAL.wheel_radius)
    start = Estimate(
        parameters=np.array([*np.log(TRUE), 0.0, 0.0, 0.0, 0.0]),
        noise=NOISE,
        free=np.arange(7) < 3,
        information=np.zeros((0, 0)),
    )
    together = fit(segments, NOMINAL, start, given)
    found = misfit(segments, NOMINAL, together)
    rest = fit(without(segments, 0, found.window.begin, found.window.end), NOMINAL, start, given)
    predicted = together.parameters + found.shifts[0]
    deviation = np.sqrt(np.diag(rest.covariance())[:3])
    np.testing.assert_array_less(np.abs(predicted - rest.parameters)[:3], 0.5 * deviation)
    assert np.abs(found.shifts[0, 1]) > 3.0 * deviation[1]


def slip_in_arcs(percent):
    """Return a recording of lines and arcs of which the robot travels less in the arcs."""
    line, angle = (4.0, 0.2, 0.0), np.pi / 2.0
    arcs = [[line, (angle / 0.4, 0.2, sign * 0.4)] * 4 for sign in (1.0, -1.0)]
    drive = Drive.of([(1.0, 0.0, 0.0), *arcs[0], *arcs[1]])
    turning = np.abs(np.diff(drive.angles @ [1.0, -1.0])) > 1e-6
    return skidding(drive, np.random.default_rng(22), np.full(2, percent / 4.0), turning)


def test_slip_in_arcs_is_named_and_makes_the_multipliers_less_certain():
    result = calibrate([slip_in_arcs(2.0)], NOMINAL)
    (note,) = result.notes
    assert re.match(r'where the robot (drives arcs|drives straight), both wheels travel', note)
    assert 'Which is right is unknown' in note
    error = result.multipliers - TRUE
    assert (np.abs(error[:2]) > 0.005).all()
    assert (np.abs(error) < 2.5 * deviations(result)).all()


def test_much_slip_in_arcs_is_refused():
    with pytest.raises(CalibrationError, match=r'both wheels travel [34].* less .* more than 2 %'):
        calibrate([slip_in_arcs(4.0)], NOMINAL)


def test_recordings_that_disagree_are_refused():
    random = np.random.default_rng(16)
    one, other = ROBOT.recording(random, 'one'), replace(ROBOT, multipliers=(1.0, 1.0, 1.0))
    with pytest.raises(CalibrationError, match=r'disagree.*: (one|other): the left wheel travels .* %'):
        calibrate([one, other.recording(random, 'other')], NOMINAL)


def test_correlated_errors_of_the_reference_are_noted_and_enlarge_the_deviations():
    """Errors of an autoregressive process of first order, as of SLAM, with a time constant of 1 s."""
    random = np.random.default_rng(23)
    recording = replace(ROBOT, rate=5).recording(random)
    white = calibrate([recording], NOMINAL)
    assert not any('correlated' in note for note in white.notes)
    keep = np.exp(-np.diff(recording.pose_time))
    errors = np.zeros((len(recording.poses), 3))
    for index, share in enumerate(keep.tolist(), 1):
        drawn = random.standard_normal(3) * [0.02, 0.02, 0.005]
        errors[index] = share * errors[index - 1] + np.sqrt(1.0 - share**2) * drawn
    wavy = calibrate([replace(recording, poses=recording.poses + errors)], NOMINAL)
    assert any('are correlated (0.' in note for note in wavy.notes)
    assert (deviations(wavy) > 2.0 * deviations(white)).all()
    assert (np.abs(wavy.multipliers - TRUE) < 4.0 * deviations(wavy)).all()
