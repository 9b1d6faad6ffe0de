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

"""Calibration of wheel radii and wheel separation from recordings of the wheels and a reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np

from diffdrive_jacobian.calibration.clock import time_offset
from diffdrive_jacobian.calibration.consistency import judged
from diffdrive_jacobian.calibration.fit import fit
from diffdrive_jacobian.calibration.hypotheses import UNKNOWN
from diffdrive_jacobian.calibration.initial_estimate import initial_estimate
from diffdrive_jacobian.calibration.model import (
    CLOCKS,
    GIVEN_NOISE,
    LEVER_ARM,
    YAW_OFFSET,
    Array,
    CalibrationDrive,
    CalibrationError,
    Estimate,
    Given,
    Noise,
    Segment,
)
from diffdrive_jacobian.calibration.motion import Geometry
from diffdrive_jacobian.calibration.preparation import (
    merged,
    overlapping,
    sampling_notes,
    thinned_poses,
    thinned_samples,
    without,
    without_jumps,
)
from diffdrive_jacobian.calibration.remarks import remarked
from diffdrive_jacobian.calibration.result import Calibration

START = Noise(wheel=1e-5, position=0.01, heading=0.02)
MOST_PARTS, MOST_LEFT_OUT = 8, 0.4
"""Most parts of the drives that are left out, and the largest share of the distance."""
ROUNDS = 3
SYNCHRONOUS, ALIGNED = 1e-3, 0.05
"""Errors of the times of poses with which rest and jumps of the reference are recognized (s)."""


def calibrate(
    recordings: Sequence[CalibrationDrive], nominal: Geometry, given: Given | None = None
) -> Calibration:
    """Estimate the multipliers of the wheel radii and of the wheel separation.

    Args:
        recordings: At least one. The sensor has the same place on the robot in all of them.
        nominal: Nominal dimensions of the robot.
        given: Quantities that are known.

    Raises:
        CalibrationError: The recordings contradict the model, or each other.
    """
    given = given or Given()
    if not recordings:
        raise CalibrationError('no recordings')
    for one in recordings:
        _check(one)
    _check_noise(given)
    recordings = tuple(map(thinned_samples, recordings))
    try:
        return _calibrated(recordings, nominal, given)
    except CalibrationError as error:
        known = ', '.join(
            f'{field.name} {value}'
            for field in fields(given)
            if (value := getattr(given, field.name)) is not None
        )
        if not known:
            raise
        raise CalibrationError(f'{error} (given: {known})') from None


def _calibrated(
    recordings: tuple[CalibrationDrive, ...], nominal: Geometry, given: Given
) -> Calibration:
    notes = [note for one in recordings for note in sampling_notes(one)]
    parameters, unknown_clocks = _clocks(recordings, nominal, given)
    for _ in range(ROUNDS):
        segments, parameters, jumps = _prepared(recordings, nominal, parameters)
        result = _consistent(recordings, segments, nominal, _start(parameters, given), given)
        before, parameters = parameters, result.estimate.parameters
        moved = [np.abs(one.at(parameters) - one.at(before)).max() for one in segments]
        if max(moved) < ALIGNED:
            break
        # With a wrong clock the reference seems to jump where the robot starts and stops.
    notes += [*unknown_clocks, *jumps, *result.notes]
    return remarked(replace(result, notes=tuple(notes)), given)


def _check(one: CalibrationDrive) -> None:
    for what, has, time, values in (
        ('the wheels', 'have', one.wheel_time, one.wheel_angles),
        ('the reference', 'has', one.pose_time, one.poses),
    ):
        if len(time) < 2:
            raise CalibrationError(f'{one.name}: too short: {what} {has} less than two samples')
        if not (np.isfinite(time).all() and np.isfinite(values).all()):
            raise CalibrationError(f'{one.name}: {what} must be finite')
        if (np.diff(time) <= 0.0).any():
            raise CalibrationError(f'{one.name}: the times of {what} must increase')


def _check_noise(given: Given) -> None:
    for name, (least, most) in GIVEN_NOISE.items():
        value = getattr(given, name)
        if value is not None and not least <= value <= most:
            raise CalibrationError(f'{name} must be from {least:g} to {most:g}, got {value:g}')


def _clocks(
    recordings: Sequence[CalibrationDrive], nominal: Geometry, given: Given
) -> tuple[Array, list[str]]:
    """Return parameters with the offset of each clock, the others 0, and notes."""
    parameters, notes = np.zeros(CLOCKS + 2 * len(recordings)), []
    for index, one in enumerate(recordings):
        found = given.time_offset if given.time_offset is not None else time_offset(one, nominal)
        if found is None:
            notes.append(
                f'{one.name}: the speeds of the wheels and of the reference do not show the offset '
                'between their clocks, which is assumed to be about 0 s'
            )
        parameters[CLOCKS + 2 * index] = found or 0.0
    return parameters, notes


def _prepared(
    recordings: Sequence[CalibrationDrive], nominal: Geometry, parameters: Array
) -> tuple[list[Segment], Array, list[str]]:
    """Return continuous motions, approximate parameters, and notes, given the clocks."""
    segments = [
        segment
        for index, one in enumerate(recordings)
        for segment in overlapping(one, index, parameters, nominal.wheel_radius)
    ]
    if not segments:
        raise CalibrationError(
            'too short: the wheels and the reference have less than 5 poses in common without a gap'
        )
    first = initial_estimate(segments, nominal, parameters)
    names = [one.name for one in recordings]
    segments, notes = without_jumps(segments, nominal, first, names)
    segments, thinned = thinned_poses(segments)
    notes += [thinned] if thinned else []
    return segments, initial_estimate(segments, nominal, parameters), notes


def _start(parameters: Array, given: Given) -> Estimate:
    """Return what the estimate starts from, with the parameters that are known."""
    parameters, free = parameters.copy(), np.ones(len(parameters), dtype=bool)
    if given.lever_arm is not None:
        parameters[LEVER_ARM], free[LEVER_ARM] = given.lever_arm, False
    if given.yaw_offset is not None:
        parameters[YAW_OFFSET], free[YAW_OFFSET] = given.yaw_offset, False
    free[CLOCKS:] = given.time_offset is None
    unknown = np.zeros((len(parameters),) * 2)
    return Estimate(parameters=parameters, prior=parameters, noise=START, free=free, covariance=unknown)


def _estimated(
    segments: Sequence[Segment], nominal: Geometry, start: Estimate, given: Given
) -> tuple[Estimate, list[Segment]]:
    """Return the estimate and the motions with merged poses.

    Which poses are at rest depends on the time offset, so it is repeated.
    """
    estimate, motions = start, list(segments)
    for _ in range(ROUNDS):
        before = estimate.parameters
        motions = [merged(one, nominal, before) for one in segments]
        motions = [one for one in motions if len(one.time) > 1]
        if not motions:
            raise CalibrationError('the wheels never turn')
        estimate = fit(motions, nominal, estimate, given)
        if np.abs(estimate.parameters - before)[CLOCKS::2].max() < SYNCHRONOUS:
            break
    return estimate, motions


def _consistent(
    recordings: tuple[CalibrationDrive, ...],
    segments: list[Segment],
    nominal: Geometry,
    start: Estimate,
    given: Given,
) -> Calibration:
    """Return the result without the parts that do not fit, with notes about these."""
    left_out = 0.0
    notes: list[str] = []
    while True:
        estimate, motions = _estimated(segments, nominal, start, given)
        verdict = judged(motions, nominal, estimate)
        part = verdict.part
        if part is None:
            break
        words = f'{recordings[part.recording].name}: {verdict.words}'
        if part.whole and verdict.sure:
            raise CalibrationError(f'the recordings disagree about the multipliers: {words}')
        left_out += part.share * (1.0 - left_out)
        if not verdict.sure or left_out > MOST_LEFT_OUT or len(notes) == MOST_PARTS:
            notes.append(f'{words}: {UNKNOWN}')
            break
        notes.append(f'{words}. A wheel skids or the reference is wrong: this part is left out')
        segments = without(segments, part.recording, part.begin, part.end)
        start = replace(start, parameters=estimate.parameters, noise=estimate.noise)
    return Calibration(
        nominal=nominal,
        estimate=verdict.estimate,
        recordings=recordings,
        segments=tuple(segments),
        motions=tuple(motions),
        notes=(*notes, *verdict.slips, *verdict.unnoticed),
    )
