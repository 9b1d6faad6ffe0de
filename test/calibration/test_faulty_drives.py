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

"""Recordings with faults: what does no harm is noted, the rest is refused, and each fault is named."""

from __future__ import annotations

import re
from dataclasses import replace

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

pytestmark = pytest.mark.slow
RECORDING = ROBOT.recording(np.random.default_rng(13))


# --- The recording


def test_jumps_glitches_and_gaps_are_noted_and_do_no_harm():
    recording = replace(ROBOT, rate=10).recording(np.random.default_rng(13))
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


def noise(size):
    return size * np.random.default_rng(14).standard_normal(RECORDING.poses.shape)


# Of six laps in alternating directions each turns as the lap before with its wheels swapped.
LAPS = [one for number in range(6) for one in square(0.5, bool(number % 2), speed=0.5, turn=2.0)]
ALTERNATING = replace(ROBOT, drive=Drive.of(LAPS)).recording(np.random.default_rng(13))
ANGLES, POSES = RECORDING.wheel_angles, RECORDING.poses


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'wheel_angles': np.zeros_like(ANGLES)}, 'the wheels never turn'),
        ({'wheel_angles': ANGLES * [0.0, 1.0]}, 'the right wheel never turns'),
        ({'wheel_angles': ANGLES[:, ::-1]}, 'swapped'),
        ({'poses': POSES * [1.0, 1.0, 0.0]}, 'observes positions only'),
        ({'poses': POSES * [1.0, -1.0, -1.0]}, 'mirrored'),
        ({'poses': np.cumsum(noise(0.02), axis=0)}, 'reference'),
        ({'poses': noise(1e-3)}, 'times as far as the wheels'),
        ({'poses': POSES * np.nan}, 'must be finite'),
        ({'pose_time': RECORDING.pose_time[::-1]}, 'must increase'),
        ({'pose_time': RECORDING.pose_time[:9], 'poses': POSES[:9]}, 'too short'),
    ],
    ids=lambda value: value if isinstance(value, str) else '',
)
def test_faults_are_named(changes, words):
    with pytest.raises(CalibrationError, match=words):
        calibrate([replace(RECORDING, **changes)], NOMINAL)


def test_swapped_wheels_are_not_taken_for_an_offset():
    with pytest.raises(CalibrationError, match='swapped'):
        calibrate([replace(ALTERNATING, wheel_angles=ALTERNATING.wheel_angles[:, ::-1])], NOMINAL)


def test_recordings_without_a_time_in_common_are_refused():
    late = replace(RECORDING, pose_time=RECORDING.pose_time - 1e4)
    with pytest.raises(CalibrationError, match='no time in common'):
        calibrate([late], NOMINAL, Given(time_offset=0.0))


def test_a_reference_in_another_unit_is_noted_or_refused():
    for scale, name in ((3.2808, 'feet'), (1.4, 'another unit')):
        (note,) = other_notes(
            calibrate([replace(RECORDING, poses=POSES * [scale, scale, 1.0])], NOMINAL)
        )
        assert f'in {name} instead of metres' in note
    with pytest.raises(CalibrationError, match='in millimetres instead of metres'):
        calibrate([replace(RECORDING, poses=POSES * [1e3, 1e3, 1.0])], NOMINAL)


def test_wheels_that_may_be_swapped_and_negated_are_noted():
    turned = replace(RECORDING, wheel_angles=-ANGLES[:, ::-1])
    (note,) = other_notes(calibrate([turned], NOMINAL))
    assert 'the sensor looks backwards' in note
    assert other_notes(calibrate([turned], NOMINAL, Given(yaw_offset=np.pi))) == []


def test_wheels_at_a_low_rate_and_slip_are_noted():
    recording = replace(ROBOT, drive=Drive.of(umbmark())).recording(np.random.default_rng(13))
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


def test_outliers_of_the_reference_are_left_out():
    random = np.random.default_rng(26)
    recording = replace(ROBOT, drive=BOTH_TURNS, rate=10).recording(random)
    poses = recording.poses.copy()
    off = random.uniform(size=len(poses)) < 0.08
    poses[off, :2] += random.choice([-0.15, 0.15], (np.count_nonzero(off), 2))
    result = calibrate([replace(recording, poses=poses)], NOMINAL)
    assert_true(result)
    note = f'{np.count_nonzero(off)} poses of the reference are glitches'
    assert any(note in one for one in result.notes)


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


# --- Wheels that travel less than they turn


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


def slipping(drive, *slips, random=22, rate=10, name='bag'):
    """Return a recording of a robot of which wheels travel less in some steps of a drive.

    Args:
        drive: The motion of the wheels.
        slips: Whether wheels slip, given the times of the steps and the sum and the difference of the
            turns of the wheels in each, and by how much the right and the left one do (%).
        random: Source of the noise, or its seed.
        rate: Samples of the wheels for each pose.
        name: Of the recording.
    """
    steps = np.diff(drive.angles, axis=0)
    right, left = steps.T
    for when, percent in slips:
        now = when(drive.time[1:], right + left, right - left)
        steps = steps * (1.0 - np.outer(now, percent) / 100.0)
    travelled = replace(drive, angles=np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]))
    robot = replace(ROBOT, drive=travelled, rate=rate)
    recording = robot.recording(np.random.default_rng(random), name)
    return replace(recording, wheel_angles=drive.angles)


def in_place(_, s, d):
    return (abs(s) < 1e-9) & (abs(d) > 1e-9)


def in_arcs(_, s, d):
    return (abs(s) > 1e-9) & (abs(d) > 1e-9)


def in_turns(_, s, d):
    return abs(d) > 1e-9


def in_left_turns(_, s, d):
    return d > 1e-9


def backwards(_, s, d):
    return s < -1e-9


def named_slip(note):
    """Return the motion and the wheel that slips, and by how much (%)."""
    found = re.fullmatch(
        r'where the robot (.*), (.*) travels? (\S+) % less than elsewhere: a wheel slips there, and .*',
        note,
    )
    return found[1], found[2], float(found[3])


def assert_radii(result):
    """Check that the multipliers are right, those of the radii within 0.3 %."""
    error = np.abs(result.multipliers - TRUE)
    assert (error < 3.0 * deviations(result)).all()
    assert (error[:2] < 0.003).all()


@pytest.mark.parametrize(
    ('drive', 'slip', 'motion', 'wheel'),
    [
        (SQUARES, (in_place, [4.0, 0.0]), 'turns in place', 'the right wheel'),
        (SQUARES, (in_arcs, [4.0, 4.0]), 'drives arcs', 'both wheels'),
        (SQUARES, (in_left_turns, [4.0, 0.0]), 'turns left', 'the right wheel'),
        (SQUARES, (in_turns, [4.0, 4.0]), 'turns', 'both wheels'),
        (BACK_AND_FORTH, (backwards, [4.0, 4.0]), 'drives backwards', 'both wheels'),
    ],
    ids=['in place', 'arcs', 'left', 'turns', 'backwards'],
)
def test_slip_in_a_kind_of_motion_is_estimated_and_named(drive, slip, motion, wheel):
    result = calibrate([slipping(Drive.of(drive), slip)], NOMINAL)
    (note,) = result.notes
    assert named_slip(note) == (motion, wheel, pytest.approx(4.0, abs=1.0))
    assert_radii(result)


def test_slip_in_two_kinds_of_motion_is_named_one_after_the_other():
    drive = Drive.of([*SQUARES, *BACK_AND_FORTH])
    result = calibrate([slipping(drive, (in_place, [6.0, 0.0]), (backwards, [3.0, 3.0]))], NOMINAL)
    found = {named_slip(note)[:2] for note in result.notes}
    assert found == {('turns in place', 'the right wheel'), ('drives backwards', 'both wheels')}
    assert_radii(result)


def test_a_skid_is_named_and_left_out():
    random = np.random.default_rng(20)
    good = ROBOT.recording(random, 'good')
    skid = (lambda time, s, d: (time > 9.0) & (time < 15.0)), [6.0, 0.0]
    result = calibrate([good, slipping(SHORT, skid, random=random, rate=12, name='skid')], NOMINAL)
    assert_true(result)
    (note,) = other_notes(result)
    assert re.match(r'skid: from .* the right wheel travels [567](\.\d)? % less than in the rest', note)
    times = [float(word) for word in re.search(r'from (\d+) to (\d+) s', note).groups()]
    np.testing.assert_allclose(times, [9.0, 15.0], atol=2.0)


def test_recordings_that_disagree_are_refused():
    random = np.random.default_rng(16)
    one, other = ROBOT.recording(random, 'one'), replace(ROBOT, multipliers=(1.0, 1.0, 1.0))
    with pytest.raises(CalibrationError, match=r'disagree.*: (one|other): the left wheel travels .* %'):
        calibrate([one, other.recording(random, 'other')], NOMINAL)


def test_a_change_that_may_be_chance_makes_the_radii_less_certain():
    """Of 0.4 % in the middle of the drive."""
    sound = calibrate([slipping(BOTH_TURNS)], NOMINAL)
    later = (lambda time, s, d: time > BOTH_TURNS.time[-1] / 2.0), [0.4, 0.4]
    widths = []
    for seed in range(20, 23):
        result = calibrate([slipping(BOTH_TURNS, later, random=seed)], NOMINAL)
        widths.append(deviations(result)[:2] / deviations(sound)[:2])
        for true in (np.array(TRUE), np.array(TRUE) * [0.996, 0.996, 1.0]):
            assert (np.abs(result.multipliers - true) < 4.0 * deviations(result)).all()
    assert np.mean(widths) > 1.3


def test_slip_that_the_drive_cannot_show_is_said():
    """In place alone it is the same as another separation."""
    shown = replace(ROBOT, drive=BOTH_TURNS).recording(np.random.default_rng(24))
    assert not calibrate([shown], NOMINAL).notes
    (note,) = calibrate([ROBOT.recording(np.random.default_rng(24))], NOMINAL).notes
    assert re.fullmatch(
        r'where the robot turns in place, it may go unnoticed that both wheels travel up to \S+ % '
        r'less: the separation multiplier would be wrong by up to \S+ %\. To see slip, drive more arcs',
        note,
    )


def test_slip_in_arcs_alone_leaves_the_separation_undetermined():
    """Either both wheels slip, or the outer one, which turns the robot less."""
    left, right = ((np.pi / 2.0 / 0.4, 0.2, omega) for omega in (0.4, -0.4))
    drive = Drive.of([*[*LINE, left] * 8, *[*LINE, right] * 8])
    result = calibrate([slipping(drive, (in_turns, [2.0, 2.0]), rate=25)], NOMINAL)
    assert [name for name, _ in result.undetermined] == ['the wheel separation']
    np.testing.assert_array_less(np.abs(result.multipliers - TRUE)[:2], 3.0 * deviations(result)[:2])
