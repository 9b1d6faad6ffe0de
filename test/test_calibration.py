"""Calibration from wheels and a reference: Jacobian, efficiency, what is determined, bad input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibration_data import NOISE, NOMINAL, TRUE, Drive, Simulation, umbmark

from diffdrive_jacobian.calibration import CalibrationError, Given, Noise, calibrate, preparation
from diffdrive_jacobian.calibration.errors import compared_distance, rms, tracks
from diffdrive_jacobian.calibration.estimate import Estimate
from diffdrive_jacobian.calibration.fit import information
from diffdrive_jacobian.calibration.motion import adjoint, composed, increments, inverted, relative

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
    ends = np.array([relative(*robot.truth(random)[[0, -1]]) for _ in range(2000)])
    found = increments(drive.time, drive.angles, drive.time[[0, -1]], NOMINAL)
    off = relative(np.broadcast_to(found.steps[0], ends.shape), ends)
    nees = np.einsum('ni,ij,nj->n', off, np.linalg.inv(found.covariance[0] * noise.wheel), off)
    assert 2.8 < nees.mean() < 3.2


# --- Estimate


def test_information_equals_that_of_a_dense_model():
    """Of the increments of the whole drive, without the poses as unknowns."""
    random = np.random.default_rng(4)
    robot = replace(ROBOT, drive=Drive.of([(3.0, 0.2, 0.0), (2.0, 0.0, 0.8), (2.0, 0.2, -0.4)]))
    result = calibrate([robot.recording(random)], NOMINAL)
    motion, estimate = result.motions[0], result.estimate
    at = motion.time + result.time_offsets[0]
    found = increments(motion.wheel_time, motion.wheel_angles, at, result.geometry)
    n = len(at)
    # Each pose of the body, as the start (3 unknowns), the multipliers and the noise of the steps.
    truth = replace(estimate, states=(composed(estimate.states[0][0], found.poses),))
    states = truth.states[0]
    by = np.zeros((n, 3, 3 * n + 3))
    by[0, :, :3] = np.eye(3)
    for i in range(1, n):
        back = adjoint(inverted(relative(states[i - 1], states[i])))
        by[i] = back @ by[i - 1]
        by[i, :, 3 * i : 3 * i + 3] += np.eye(3)
        by[i, :, 3 * n :] += found.jacobian[i - 1]
    x, y, _ = estimate.sensor
    J = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
    noise = estimate.noise
    weight = np.diag([noise.position**-2.0] * 2 + [noise.heading**-2.0])
    normal = sum(w * (J @ one).T @ weight @ (J @ one) for w, one in zip(motion.weights, by, strict=True))
    for i in range(1, n):
        block = slice(3 * i, 3 * i + 3)
        normal[block, block] += np.linalg.inv(found.covariance[i - 1] * noise.wheel)
    free = np.zeros(7, dtype=bool)
    free[:3] = True
    expected = np.linalg.inv(normal)[-3:, -3:]
    bound = np.linalg.inv(information([motion], NOMINAL, replace(truth, free=free)))
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


def test_errors_are_those_of_the_cramer_rao_bound_and_of_the_stated_covariance():
    """A small form of `benchmark/calibration.py`: mean squares of 16 robots, within 3.5 deviations."""
    errors, nees, bounds, places = [], [], [], []
    count = 16
    for seed in range(count):
        random = np.random.default_rng(100 + seed)
        result = calibrate([ROBOT.recording(random)], NOMINAL)
        error = result.multipliers - TRUE
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
        bounds.append(np.diag(np.linalg.inv(information([motion], NOMINAL, known)))[:3])
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


@pytest.mark.parametrize('sensor', [(0.1, -0.05, 1.5), (-0.2, 0.0, 3.1), (0.0, 0.3, -0.4)])
def test_the_place_of_the_sensor_is_estimated(sensor):
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


@pytest.mark.parametrize('delay', [0.08, -1.7, 12.3])
def test_the_offset_between_the_clocks_is_estimated(delay):
    recording = replace(ROBOT, delay=delay).recording(np.random.default_rng(7))
    result = calibrate([recording], NOMINAL)
    assert_true(result)
    assert result.time_offsets[0] == pytest.approx(delay, abs=0.02)
    assert any('clock of the reference' in note for note in result.notes) == (abs(delay) > 1.0)


def test_nominal_dimensions_may_be_far_off():
    robot = replace(ROBOT, multipliers=(1.5, 1.4, 0.8))
    assert_true(calibrate([robot.recording(np.random.default_rng(8))], NOMINAL), (1.5, 1.4, 0.8))


def test_a_perfect_robot_is_reproduced_exactly():
    robot = replace(ROBOT, noise=Noise(wheel=0.0, position=0.0, heading=0.0))
    result = calibrate([robot.recording(np.random.default_rng(9))], NOMINAL)
    np.testing.assert_allclose(result.multipliers, TRUE, rtol=1e-7)
    assert result.notes[0].startswith('the reference follows the wheels without error')


def test_the_odometry_is_better_afterwards():
    result = calibrate([ROBOT.recording(np.random.default_rng(10))], NOMINAL)
    distance = compared_distance(result)
    before, after = (
        rms([one.position_error for one in tracks(result, geometry, distance)])
        for geometry in (result.nominal, result.geometry)
    )
    assert after < before / 4.0


def test_several_recordings_count_together():
    random = np.random.default_rng(11)
    one = calibrate([ROBOT.recording(random, 'a')], NOMINAL)
    three = [replace(ROBOT, delay=delay).recording(random, str(delay)) for delay in (0.0, 0.5, 1.0)]
    all_of_them = calibrate(three, NOMINAL)
    assert_true(all_of_them)
    assert (deviations(all_of_them) < 0.75 * deviations(one)).all()
    np.testing.assert_allclose(all_of_them.time_offsets, [0.0, 0.5, 1.0], atol=0.02)


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


# --- Bad input


def base(seed=13):
    return replace(ROBOT, rate=10).recording(np.random.default_rng(seed))


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
    elif what == 'no overlap':
        time = time + 1e4
    elif what == 'NaN':
        poses[3] = np.nan
    elif what == 'backward':
        time = time[::-1]
    return replace(recording, poses=poses, wheel_angles=angles, pose_time=time)


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
        ('no overlap', 'no time in common'),
        ('NaN', 'must be finite'),
        ('backward', 'must increase'),
    ],
)
def test_faults_are_named(what, words):
    with pytest.raises(CalibrationError, match=words):
        calibrate([spoiled(base(), what)], NOMINAL)


def test_wheels_at_a_low_rate_and_slip_are_noted():
    recording = base()
    rare = replace(
        recording,
        wheel_time=recording.wheel_time[::50],
        wheel_angles=recording.wheel_angles[::50],
    )
    notes = calibrate([rare], NOMINAL).notes
    assert any('every 1 s' in note for note in notes)
    assert any('m after 1 m: they slip' in note for note in notes)


@pytest.mark.parametrize('overlap', ['reference first', 'wheels first'])
def test_only_the_time_in_common_counts(overlap):
    recording = base()
    if overlap == 'wheels first':
        late = recording.pose_time > 15.0
        one = replace(recording, pose_time=recording.pose_time[late], poses=recording.poses[late])
    else:
        late = recording.wheel_time > 15.0
        one = replace(
            recording,
            wheel_time=recording.wheel_time[late],
            wheel_angles=recording.wheel_angles[late],
        )
    result = calibrate([one], NOMINAL)
    assert_true(result)
    assert result.motions[0].time[0] == pytest.approx(15.0, abs=0.5)


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


def test_recordings_that_disagree_are_refused():
    random = np.random.default_rng(16)
    one, other = ROBOT.recording(random, 'one'), replace(ROBOT, multipliers=(1.0, 1.0, 1.0))
    with pytest.raises(CalibrationError, match=r'disagree.* one: 0\.9.* other: 1\.0'):
        calibrate([one, other.recording(random, 'other')], NOMINAL)
