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

"""Calibration from wheels and a reference: Jacobian, efficiency, clocks, what a drive determines."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from calibration_data import (
    NOISE,
    NOMINAL,
    ROBOT,
    TRUE,
    Drive,
    assert_true,
    deviations,
    other_notes,
    square,
    stepped,
    umbmark,
    with_stops,
)

from diffdrive_jacobian.calibration import CalibrationError, Given, Noise, calibrate
from diffdrive_jacobian.calibration.clock import time_offset
from diffdrive_jacobian.calibration.description import explain_undetermined
from diffdrive_jacobian.calibration.determined import undetermined
from diffdrive_jacobian.calibration.fit import fit
from diffdrive_jacobian.calibration.linear_model import linearized
from diffdrive_jacobian.calibration.model import Estimate
from diffdrive_jacobian.calibration.motion import composed, increments, inverted, relative
from diffdrive_jacobian.calibration.preparation import overlapping
from diffdrive_jacobian.kinematics.se2 import adjoint

pytestmark = pytest.mark.slow


# --- Estimate


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
    at = motion.at(estimate.parameters)
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
    normal = sum(w * (J @ one).T @ weight @ (J @ one) for w, one in zip(motion.samples, by, strict=True))
    for i in range(1, n):
        block = slice(3 * i, 3 * i + 3)
        normal[block, block] += np.linalg.inv(found.covariance[i - 1] * noise.wheel)
    readings = np.arange(3 * n, 5 * n)
    normal[readings, readings] += 1.0
    reduced = linearized([motion], NOMINAL, truth).reduced(noise.variances)
    bound = np.linalg.inv(reduced.information[:3, :3])
    np.testing.assert_allclose(bound, np.linalg.inv(normal)[-3:, -3:], rtol=1e-6)


def test_umbmark_recovers_the_multipliers_the_noise_and_the_place_of_the_sensor():
    """Errors are as large as stated: mean squares of 8 robots."""
    nees, noises, places, count = [], [], [], 8
    for seed in range(count):
        result = calibrate([ROBOT.recording(np.random.default_rng(100 + seed))], NOMINAL)
        assert_true(result)
        assert other_notes(result) == []
        assert result.undetermined == []
        error = result.multipliers - TRUE
        nees.append(error @ np.linalg.solve(result.covariance, error))
        noises.append(result.estimate.noise.variances)
        # The true one is zero.
        places.append(result.estimate.sensor / np.sqrt(np.diag(result.estimate.covariance)[3:6]))
    # The mean of squares of n numbers of variance 1 has the deviation sqrt(2 / n).
    assert abs(np.mean(nees) - 3.0) < 3.5 * np.sqrt(6.0 / count)
    assert (np.abs(np.mean(np.square(places), axis=0) - 1.0) < 3.5 * np.sqrt(2.0 / count)).all(), places
    np.testing.assert_allclose(np.mean(noises, axis=0), NOISE.variances, rtol=0.3)


def test_the_place_of_the_sensor_is_estimated_or_given():
    sensor = (-0.2, 0.3, 3.1)
    recording = replace(ROBOT, sensor=sensor).recording(np.random.default_rng(6))
    free = calibrate([recording], NOMINAL)
    assert_true(free)
    np.testing.assert_allclose(free.estimate.sensor, sensor, atol=0.01)
    given = Given(lever_arm=sensor[:2], yaw_offset=3.1, time_offset=0.0)
    known = calibrate([recording], NOMINAL, given)
    assert_true(known)
    np.testing.assert_array_equal(known.estimate.sensor, sensor)
    wrong = calibrate([recording], NOMINAL, replace(given, lever_arm=(-0.1, 0.3)))
    assert wrong.estimate.noise.position > 1.5 * known.estimate.noise.position


def test_a_perfect_robot_far_from_nominal_is_reproduced_exactly():
    true = (1.5, 1.4, 0.8)
    still = Noise(wheel=0.0, position=0.0, heading=0.0)
    robot = replace(ROBOT, noise=still, multipliers=true)
    result = calibrate([robot.recording(np.random.default_rng(9))], NOMINAL)
    np.testing.assert_allclose(result.multipliers, true, rtol=1e-7)
    exact, far = other_notes(result)
    assert exact.startswith('the reference follows the wheels without error')
    assert 'the multipliers 1.5, 1.4, 0.8' in far


def test_several_recordings_count_together_and_their_residuals_follow_each_other():
    random = np.random.default_rng(11)
    one = calibrate([ROBOT.recording(random, 'a')], NOMINAL)
    delays = (0.0, 0.08, 1.0)
    three = [replace(ROBOT, delay=delay).recording(random, str(delay)) for delay in delays]
    result = calibrate(three, NOMINAL)
    assert_true(result)
    assert (deviations(result) < 0.75 * deviations(one)).all()
    np.testing.assert_allclose(result.clocks[:, 0], delays, atol=0.02)
    (note,) = other_notes(result)
    assert re.match(r'1\.0: the clock of the reference differs by (0\.9|1\.0)', note)
    residuals = result.residuals()
    assert residuals[0][0, 0] == 0.0
    assert residuals[1][0, 0] == residuals[0][-1, 0]
    for part, motion in zip(residuals, result.motions, strict=True):
        np.testing.assert_allclose(np.diff(part[:, 0]), np.diff(motion.time), atol=1e-9)
        # Poses at rest are means of several.
        squares = motion.samples[:, np.newaxis] * np.square(part[:, 1:])
        spread = np.sqrt(squares.mean(axis=0)) / [NOISE.position, NOISE.position, NOISE.heading]
        assert ((spread > 0.5) & (spread < 1.3)).all(), spread


# --- Clocks


LAPS = replace(ROBOT, drive=Drive.of(square(speed=0.5, turn=2.0) * 4))
SIDE = 2.0 + np.pi / 4.0
"""Time after which these laps repeat themselves (s)."""
ALL = slice(None)


@pytest.mark.parametrize(
    ('robot', 'delay', 'wheels', 'poses'),
    [
        (ROBOT, -1.7, ALL, ALL),
        (ROBOT, 1e4, ALL, ALL),
        # The reference began later and ended earlier than the wheels.
        (ROBOT, -40.0, ALL, slice(18, -11)),
        # They overlap little. Offsets near zero are searched at any overlap.
        (ROBOT, 1.0, slice(0, 1000), slice(25, None)),
        # Of equal laps the offset that is nearest to zero is meant.
        (LAPS, -0.8, ALL, ALL),
    ],
    ids=['near', 'far', 'part', 'little overlap', 'laps'],
)
def test_the_offset_between_the_clocks_is_estimated(robot, delay, wheels, poses):
    recording = replace(robot, delay=delay).recording(np.random.default_rng(7))
    parts = replace(
        recording,
        wheel_time=recording.wheel_time[wheels],
        wheel_angles=recording.wheel_angles[wheels],
        pose_time=recording.pose_time[poses],
        poses=recording.poses[poses],
    )
    result = calibrate([parts], NOMINAL)
    assert result.clocks[0, 0] == pytest.approx(delay, abs=0.05)
    assert any('clock of the reference' in note for note in result.notes)
    if wheels == poses == ALL:
        assert_true(result)


@pytest.mark.parametrize('sign', [-1.0, 1.0])
def test_a_clock_that_drifts_is_estimated_and_named(sign):
    robot = replace(ROBOT, drive=Drive.of([*umbmark(), *umbmark()]))
    recording = robot.recording(np.random.default_rng(25))
    drifts = replace(recording, pose_time=recording.pose_time / (1.0 + sign * 2e-3))
    result = calibrate([drifts], NOMINAL)
    assert_true(result)
    assert result.clocks[0, 1] == pytest.approx(sign * 2e-3, abs=2e-4)
    speed = 'slow' if sign > 0.0 else 'fast'
    assert any(
        note.endswith(f'% {speed} by that of the wheels, which is corrected') for note in result.notes
    )


def test_an_offset_is_refused_where_the_motion_agrees_with_a_nearer_one():
    delay = 4.2 * SIDE
    recording = replace(LAPS, delay=delay).recording(np.random.default_rng(7))
    with pytest.raises(CalibrationError, match=r'several time offsets.*--time-offset') as refused:
        calibrate([recording], NOMINAL)
    named = [float(one) for one in re.findall(r'(-?[\d.]+) s \(overlap', str(refused.value))]
    assert named[0] == pytest.approx(math.remainder(delay, SIDE), abs=0.1)
    assert_true(calibrate([recording], NOMINAL, Given(time_offset=delay)))


@pytest.mark.parametrize('seed', range(4))
def test_drives_that_have_nothing_to_do_with_each_other_do_not_agree(seed):
    random = np.random.default_rng(seed)
    drives = [
        [(random.uniform(1, 4), random.uniform(0, 0.3), random.uniform(-1, 1)) for _ in range(40)]
        for _ in range(2)
    ]
    one, other = (replace(ROBOT, drive=Drive.of(commands)).recording(random) for commands in drives)
    assert time_offset(replace(one, pose_time=other.pose_time, poses=other.poses), NOMINAL) is None


# --- Encoders with few steps


def test_few_steps_make_the_multipliers_uncertain_and_not_wrong():
    random = np.random.default_rng(21)
    drive = Drive.of(with_stops(umbmark(speed=0.4, turn=2.0)))
    exact = replace(ROBOT, drive=drive, rate=20).recording(random)
    coarse = replace(exact, wheel_angles=stepped(exact.wheel_angles, 16, random))
    known, found = (calibrate([one], NOMINAL) for one in (exact, coarse))
    assert deviations(found)[2] > 1.02 * deviations(known)[2]
    assert (np.abs(found.multipliers - known.multipliers) < deviations(found)).all()
    assert_true(found, most=3.0)


# --- What a drive does not determine


def test_what_is_not_determined_stays_where_the_prior_is():
    drive = Drive.of([(1.0, 0.0, 0.0), (8.0, 0.2, 0.0), (1.0, 0.0, 0.0)])
    recording = replace(ROBOT, drive=drive, rate=10).recording(np.random.default_rng(12))
    zeros = np.zeros(8)
    segments = overlapping(recording, 0, zeros, NOMINAL.wheel_radius)
    prior = np.array([0.0, 0.0, 0.1, *zeros[3:]])
    free = np.arange(8) < 3
    start = Estimate(parameters=zeros, prior=prior, noise=NOISE, free=free, covariance=np.zeros((8, 8)))
    found = fit(segments, NOMINAL, start, Given())
    assert found.parameters[2] == pytest.approx(0.1, abs=0.01)
    assert found.covariance[2, 2] ** 0.5 == pytest.approx(0.2, rel=0.1)
    np.testing.assert_allclose(found.parameters[:2], np.log(TRUE[:2]), atol=0.02)


@pytest.mark.parametrize(
    ('commands', 'second'),
    [
        ([(6.0, 0.0, 1.0), (1.0, 0.0, 0.0), (6.0, 0.0, -1.0)], 'the difference of the wheel radii'),
        # Nor does one circle show the offset between the clocks.
        ([(40.0, 0.2, 0.5)], 'the mean of the wheel radii'),
    ],
    ids=['in place', 'circle'],
)
def test_what_is_not_determined_is_named(commands, second):
    recording = replace(ROBOT, drive=Drive.of(commands), rate=10).recording(np.random.default_rng(12))
    result = calibrate([recording], NOMINAL)
    scale, other = (name for name, _ in result.undetermined)
    assert scale.startswith('the common scale')
    assert other.startswith(second)
    unknown = 'do not show the offset between their clocks' in result.notes[0]
    assert unknown == (len(commands) == 1)
    assert abs(result.clocks[0, 0]) < 1.0


def test_a_drive_that_determines_nothing_is_explained():
    nothing = SimpleNamespace(undetermined=undetermined(np.eye(3)))
    assert 'does not determine any of the multipliers: drive straight' in explain_undetermined(nothing)
