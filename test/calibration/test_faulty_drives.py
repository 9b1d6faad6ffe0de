"""Recordings with faults: what does no harm is noted, the rest is refused, and each fault is named."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from calibration_data import (
    NOISE,
    NOMINAL,
    ROBOT,
    SHORT,
    TRUE,
    Drive,
    assert_true,
    deviations,
    other_notes,
    square,
    umbmark,
)

from diffdrive_jacobian.calibration import CalibrationError, Given, calibrate, preparation
from diffdrive_jacobian.calibration.consistency import judged, local_changes
from diffdrive_jacobian.calibration.fit import fit
from diffdrive_jacobian.calibration.hypotheses import divided, hypotheses
from diffdrive_jacobian.calibration.model import Estimate
from diffdrive_jacobian.calibration.preparation import overlapping, without

SLOW = Drive.of(umbmark(side=1.0, runs=1))
"""55 seconds."""


@cache
def base(rate=25):
    return replace(ROBOT, rate=rate).recording(np.random.default_rng(13))


def test_jumps_glitches_and_gaps_are_noted_and_do_no_harm():
    recording = base(rate=10)
    poses, time = recording.poses.copy(), recording.pose_time
    poses[[20, 50, 51, 90]] += [2.0, -1.0, 0.5]
    poses[70:, :2] += [0.4, -0.3]
    seen = (time < 5.0) | (time > 8.2)
    wheels = (recording.wheel_time < 19.0) | (recording.wheel_time > 20.2)
    spoiled = replace(
        recording,
        wheel_time=recording.wheel_time[wheels],
        wheel_angles=recording.wheel_angles[wheels],
        pose_time=time[seen],
        poses=poses[seen],
    )
    result = calibrate([spoiled], NOMINAL)
    assert_true(result)
    reference, blind, glitches, jump = other_notes(result)
    assert '1 gap in the reference, the longest of 3.4 s' in reference
    assert 'gap in the wheels' in blind
    assert glitches == '4 poses of the reference are glitches and were left out'
    assert re.search(rf'jumps by 0\.(49|5).* at {time[70]:.3f} s', jump)
    assert len(result.segments) == 3


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
    elif what == 'too short':
        time, poses = time[:9], poses[:9]
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
        ('NaN', 'must be finite'),
        ('backward', 'must increase'),
        ('too short', 'too short'),
    ],
)
def test_faults_are_named(what, words):
    with pytest.raises(CalibrationError, match=words):
        calibrate([spoiled(base(), what)], NOMINAL)


def test_recordings_without_a_time_in_common_are_refused():
    late = replace(ROBOT, delay=1e4).recording(np.random.default_rng(13))
    with pytest.raises(CalibrationError, match='no time in common'):
        calibrate([late], NOMINAL, Given(time_offset=0.0))


def test_swapped_wheels_are_not_taken_for_an_offset():
    """On laps in alternating directions they turn as the lap before."""
    laps = [square(side=0.5, clockwise=bool(number % 2), speed=0.5, turn=2.0) for number in range(6)]
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
        notes = other_notes(calibrate([scaled], NOMINAL))
    except CalibrationError as error:
        notes = (str(error),)
    (note,) = notes
    assert f'in {name} instead of metres' in note


def test_wheels_that_may_be_swapped_and_negated_are_noted():
    recording = base()
    turned = replace(recording, wheel_angles=-recording.wheel_angles[:, ::-1])
    (note,) = other_notes(calibrate([turned], NOMINAL))
    assert 'the sensor looks backwards' in note
    assert other_notes(calibrate([turned], NOMINAL, Given(yaw_offset=np.pi))) == []


def test_wheels_at_a_low_rate_and_slip_are_noted():
    recording = replace(ROBOT, drive=SLOW).recording(np.random.default_rng(13))
    rare = replace(
        recording, wheel_time=recording.wheel_time[::50], wheel_angles=recording.wheel_angles[::50]
    )
    assert any('every 1 s, so that' in note for note in calibrate([rare], NOMINAL).notes)
    slips = replace(ROBOT, noise=replace(NOISE, wheel=2e-3)).recording(np.random.default_rng(13))
    assert any('m after 1 m: they slip' in note for note in calibrate([slips], NOMINAL).notes)


def test_long_recordings_are_thinned(monkeypatch):
    """The bounds that keep an hour at 100 Hz cheap, with smaller numbers."""
    recording = replace(ROBOT, rate=1).recording(np.random.default_rng(19))
    monkeypatch.setattr(preparation, 'MOST_SAMPLES', 700)
    monkeypatch.setattr(preparation, 'MOST_POSES', 70)
    result = calibrate([recording], NOMINAL)
    assert_true(result)
    assert len(result.recordings[0].wheel_time) <= 700 < len(recording.wheel_time)
    assert sum(len(one.time) for one in result.segments) <= 70
    (note,) = other_notes(result)
    assert 'poses of the reference are used, evenly spaced' in note


# --- Parts that do not fit


def skidding(drive, random, wheels, when, name='bag', rate=25):
    """Return a recording of a robot of which some wheels travel 4 % less than they turn, for some time.

    Args:
        drive: The motion.
        random: Source of the noise.
        wheels: Factors of that for the right and the left wheel.
        when: Whether it is so in each step of the drive.
        name: Of the recording.
        rate: Samples of the wheels for each pose.
    """
    steps = np.diff(drive.angles, axis=0) * (1.0 - 0.04 * np.outer(when, wheels))
    travelled = replace(drive, angles=np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]))
    recording = replace(ROBOT, drive=travelled, rate=rate).recording(random, name)
    return replace(recording, wheel_angles=drive.angles)


def during(drive, begin, end):
    """Return which steps of a drive are between two times (s)."""
    return (drive.time[1:] > begin) & (drive.time[1:] < end)


def test_a_skid_is_named_and_left_out():
    random = np.random.default_rng(20)
    skid = skidding(SHORT, random, [1.5, 0.0], during(SHORT, 9.0, 15.0), 'skid', rate=12)
    result = calibrate([ROBOT.recording(random, 'good'), skid], NOMINAL)
    assert_true(result)
    (note,) = other_notes(result)
    assert re.match(r'skid: from .* the right wheel travels [567](\.\d)? % less than in the rest', note)
    times = [float(word) for word in re.search(r'from (\d+) to (\d+) s', note).groups()]
    np.testing.assert_allclose(times, [9.0, 15.0], atol=2.0)


def test_the_most_likely_parameters_of_the_rest_are_predicted():
    """By the score at the estimate, without a new one."""
    recording = skidding(SLOW, np.random.default_rng(21), [1.5, 0.0], during(SLOW, 20.0, 32.0))
    given = Given(lever_arm=(0.0, 0.0), yaw_offset=0.0, time_offset=0.0)
    given = replace(given, wheel_noise=1e-5, position_noise=0.005, heading_noise=0.01)
    parameters = np.array([*np.log(TRUE), *np.zeros(5)])
    segments = overlapping(recording, 0, parameters, NOMINAL.wheel_radius)
    start = Estimate(
        parameters=parameters,
        prior=parameters,
        noise=NOISE,
        free=np.arange(8) < 3,
        covariance=np.zeros((8, 8)),
    )
    together = fit(segments, NOMINAL, start, given)
    found = judged(segments, NOMINAL, together).part
    rest = fit(without(segments, 0, found.begin, found.end), NOMINAL, start, given)
    cells = divided(segments, NOMINAL, together.parameters)
    local = local_changes(segments, NOMINAL, together, cells)
    skid = next(
        one
        for one in hypotheses(cells)
        if (one.part.begin, one.part.end) == (found.begin, found.end)
        and one.change.words == 'the right wheel travels'
    )
    direction = skid.direction(cells.count)
    (size,), _ = local.sizes(direction[None], np.array([skid.spread]))
    predicted = together.parameters + local.moves @ direction * size
    deviation = np.sqrt(np.diag(rest.covariance)[:3])
    np.testing.assert_array_less(np.abs(predicted - rest.parameters)[:3], 0.5 * deviation)
    assert np.abs(predicted - together.parameters)[1] > 3.0 * deviation[1]


LINE = [(1.0, 0.0, 0.0), (5.0, 0.2, 0.0)]


def turned(sign):
    """Return the commands of a square with one turn in place and three arcs, to one side."""
    quarter = np.pi / 2.0
    place = [(1.0, 0.0, 0.0), (quarter, 0.0, sign), (1.0, 0.0, 0.0)]
    return [*LINE, *place, *[*LINE, (quarter / 0.8, 0.2, sign * 0.8)] * 3]


SQUARES = [*turned(1.0) * 2, *turned(-1.0) * 2]
BOTH_TURNS = Drive.of(SQUARES)
"""Two minutes: turns in place and arcs of 0.25 m, to both sides."""
BACK_AND_FORTH = [
    (duration, sign * v, sign * omega)
    for v, omega in ((0.2, 0.0), (0.2, 0.8), (0.2, 0.0), (0.2, -0.8)) * 3
    for duration, sign in ((4.0, 1.0), (1.0, 0.0), (4.0, -1.0), (1.0, 0.0))
]
"""Lines and arcs, each forth and back."""


def slipping(drive, *slips, seed=22):
    """Return a recording of a robot of which wheels travel less in some motion.

    Args:
        drive: The motion of the wheels.
        slips: Whether wheels slip, given the sum and the difference of their steps (rad), and by how
            much the right and the left one do (%).
        seed: Of the noise.
    """
    steps = np.diff(drive.angles, axis=0)
    right, left = steps.T
    for when, percent in slips:
        steps = steps * (1.0 - np.outer(when(right + left, right - left), percent) / 100.0)
    travelled = replace(drive, angles=np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]))
    robot = replace(ROBOT, drive=travelled, rate=10)
    return replace(robot.recording(np.random.default_rng(seed)), wheel_angles=drive.angles)


def in_place(s, d):
    return (abs(s) < 1e-9) & (abs(d) > 1e-9)


def in_arcs(s, d):
    return (abs(s) > 1e-9) & (abs(d) > 1e-9)


def backwards(s, _):
    return s < -1e-9


def named_slip(note):
    """Return the motion and the wheel that slips, and by how much (%)."""
    found = re.fullmatch(
        r'where the robot (.*), (.*) travels? (\S+) % less than elsewhere: a wheel slips there, and .*',
        note,
    )
    return found[1], found[2], float(found[3])


@pytest.mark.parametrize(
    ('slip', 'expected'),
    [
        ((in_place, [4.0, 0.0]), ('turns in place', 'the right wheel')),
        ((in_arcs, [4.0, 4.0]), ('drives arcs', 'both wheels')),
        ((lambda _, d: d > 1e-9, [4.0, 0.0]), ('turns left', 'the right wheel')),
        ((lambda _, d: abs(d) > 1e-9, [4.0, 4.0]), ('turns', 'both wheels')),
        ((backwards, [4.0, 4.0]), ('drives backwards', 'both wheels')),
    ],
    ids=['in place', 'arcs', 'left', 'turns', 'backwards'],
)
def test_slip_in_a_kind_of_motion_is_estimated_and_named(slip, expected):
    drive = Drive.of(BACK_AND_FORTH) if expected[0] == 'drives backwards' else BOTH_TURNS
    result = calibrate([slipping(drive, slip)], NOMINAL)
    (note,) = result.notes
    *where, percent = named_slip(note)
    assert (*where,) == expected
    assert percent == pytest.approx(4.0, abs=1.0)
    error = np.abs(result.multipliers - TRUE)
    assert (error < 3.0 * deviations(result)).all()
    assert (error[:2] < 0.003).all()


def test_slip_in_two_kinds_of_motion_is_named_one_after_the_other():
    drive = Drive.of([*SQUARES, *BACK_AND_FORTH])
    result = calibrate([slipping(drive, (in_place, [6.0, 0.0]), (backwards, [3.0, 3.0]))], NOMINAL)
    found = {named_slip(note)[:2] for note in result.notes}
    assert found == {('turns in place', 'the right wheel'), ('drives backwards', 'both wheels')}
    error = np.abs(result.multipliers - TRUE)
    assert (error < 3.0 * deviations(result)).all()
    assert (error[:2] < 0.003).all()


def test_a_change_that_may_be_chance_makes_the_radii_less_certain():
    """Of 0.4 % in the middle of the drive."""
    sound = calibrate([slipping(BOTH_TURNS)], NOMINAL)
    half = len(BOTH_TURNS.time) // 2

    def later(s, _):
        return np.arange(len(s)) > half

    widths = []
    for seed in range(20, 24):
        result = calibrate([slipping(BOTH_TURNS, (later, [0.4, 0.4]), seed=seed)], NOMINAL)
        widths.append(deviations(result)[:2] / deviations(sound)[:2])
        for true in (np.array(TRUE), np.array(TRUE) * [0.996, 0.996, 1.0]):
            assert (np.abs(result.multipliers - true) < 4.0 * deviations(result)).all()
    assert np.mean(widths) > 1.3


def test_slip_that_the_drive_cannot_show_is_said():
    """In place alone it is the same as another separation."""
    assert not calibrate(
        [replace(ROBOT, drive=BOTH_TURNS).recording(np.random.default_rng(24))], NOMINAL
    ).notes
    (note,) = calibrate([ROBOT.recording(np.random.default_rng(24))], NOMINAL).notes
    assert re.fullmatch(
        r'where the robot turns in place, it may go unnoticed that both wheels travel up to \S+ % '
        r'less: the separation multiplier would be wrong by up to \S+ %\. To see slip, drive more arcs',
        note,
    )


def test_slip_in_arcs_alone_leaves_the_separation_undetermined():
    """Either both wheels slip, or the outer one, which turns the robot less."""
    arc = (np.pi / 2.0 / 0.4, 0.2, 0.4)
    back = (*arc[:2], -0.4)
    drive = Drive.of([*[*LINE, arc] * 8, *[*LINE, back] * 8])
    turning = np.abs(np.diff(drive.angles @ [1.0, -1.0])) > 1e-6
    result = calibrate([skidding(drive, np.random.default_rng(22), [0.5, 0.5], turning)], NOMINAL)
    assert [name for name, _ in result.undetermined] == ['the wheel separation']
    np.testing.assert_array_less(np.abs(result.multipliers - TRUE)[:2], 3.0 * deviations(result)[:2])


@pytest.mark.parametrize('sign', [-1.0, 1.0])
def test_a_clock_that_drifts_is_estimated_and_named(sign):
    recording = replace(ROBOT, drive=BOTH_TURNS).recording(np.random.default_rng(25))
    drifts = replace(recording, pose_time=recording.pose_time / (1.0 + sign * 2e-3))
    result = calibrate([drifts], NOMINAL)
    assert_true(result)
    assert result.clocks[0, 1] == pytest.approx(sign * 2e-3, abs=2e-4)
    assert result.notes[-1].endswith(
        f'% {"slow" if sign > 0.0 else "fast"} by that of the wheels, which is corrected'
    )


def test_outliers_of_the_reference_are_left_out():
    recording = replace(ROBOT, drive=BOTH_TURNS, rate=10).recording(random := np.random.default_rng(26))
    poses = recording.poses.copy()
    off = random.uniform(size=len(poses)) < 0.08
    poses[off, :2] += random.choice([-0.15, 0.15], (np.count_nonzero(off), 2))
    result = calibrate([replace(recording, poses=poses)], NOMINAL)
    assert_true(result)
    assert any(
        f'{np.count_nonzero(off)} poses of the reference are glitches' in one for one in result.notes
    )


def test_recordings_that_disagree_are_refused():
    random = np.random.default_rng(16)
    one, other = ROBOT.recording(random, 'one'), replace(ROBOT, multipliers=(1.0, 1.0, 1.0))
    with pytest.raises(CalibrationError, match=r'disagree.*: (one|other): the left wheel travels .* %'):
        calibrate([one, other.recording(random, 'other')], NOMINAL)


def test_correlated_errors_of_the_reference_are_noted_and_enlarge_the_deviations():
    """Errors of an autoregressive process of first order, as of SLAM, with a time constant of 1 s."""
    random = np.random.default_rng(23)
    recording = replace(ROBOT, rate=8).recording(random)
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
