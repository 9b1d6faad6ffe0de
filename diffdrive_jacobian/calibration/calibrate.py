"""Calibration of wheel radii and wheel separation from recordings of the wheels and a reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from diffdrive_jacobian.calibration.clock import time_offset
from diffdrive_jacobian.calibration.consistency import judged
from diffdrive_jacobian.calibration.fit import SMALLEST, fit
from diffdrive_jacobian.calibration.hypotheses import UNKNOWN
from diffdrive_jacobian.calibration.initial_estimate import initial_estimate, unit
from diffdrive_jacobian.calibration.model import (
    CLOCKS,
    LEVER_ARM,
    YAW_OFFSET,
    Array,
    CalibrationDrive,
    CalibrationError,
    Estimate,
    Given,
    Noise,
    Segment,
    undetermined,
)
from diffdrive_jacobian.calibration.motion import Geometry, composed
from diffdrive_jacobian.calibration.preparation import (
    merged,
    overlapping,
    sampling_notes,
    thinned_poses,
    thinned_samples,
    without,
    without_jumps,
)
from diffdrive_jacobian.numerics.elementary import wrap

PARAMETERS = (
    'left_wheel_radius_multiplier',
    'right_wheel_radius_multiplier',
    'wheel_separation_multiplier',
)
"""Names of the multipliers in their order, as wheel_bridge and diff_drive_controller have them."""
BOUNDS = (0.1, 10.0)
"""Multipliers that `wheel_bridge` accepts."""
START = Noise(wheel=1e-5, position=0.01, heading=0.02)
LARGE_WHEEL_NOISE = 1e-2
"""Wheel travel variance beyond which the reference does not follow the wheels (m)."""
NOTABLE_WHEEL_NOISE = 5e-4
"""Wheel travel variance that is worth a note (m)."""
EXACT = 2e-5
"""Residual of the positions below which a reference is no observation of a real robot (m)."""
MOST_PARTS, MOST_LEFT_OUT = 8, 0.4
"""Most parts of the drives that are left out, and the largest share of the distance."""
ROUNDS = 3
LONG_DELAY, NOTABLE_DRIFT = 0.2, 2e-4
"""Time offset (s) and drift of a clock that are worth a note. Quartz clocks drift by less than 1e-4."""
ALIGNED = 0.05
"""Error of the times of poses with which jumps of the reference are recognized (s)."""
UNUSUAL = 1.15
"""Factor beyond which multipliers are not explained by manufacturing."""
CORRELATED, LEAST_ERRORS = 0.5, 60
"""Correlation of successive errors that is noted, and fewest errors that show it."""
BACKWARD = 0.6
"""Angle from straight back within which a sensor looks backwards (rad)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Calibration:
    """The result of a calibration."""

    nominal: Geometry
    estimate: Estimate
    recordings: tuple[CalibrationDrive, ...]
    segments: tuple[Segment, ...]
    """Continuous motions; poses at rest are not merged."""
    motions: tuple[Segment, ...]
    """Continuous motions, poses at rest merged; `estimate.states` are their poses."""
    notes: tuple[str, ...] = ()

    @property
    def geometry(self) -> Geometry:
        """The calibrated dimensions."""
        return self.estimate.geometry(self.nominal)

    @property
    def multipliers(self) -> Array:
        """Multipliers of the left radius, the right radius and the separation, shape (3,)."""
        return np.array(self.geometry.multipliers)

    @property
    def covariance(self) -> Array:
        """Covariance of the multipliers, shape (3, 3)."""
        scale = self.multipliers
        return np.asarray(self.estimate.covariance[:3, :3] * scale[:, None] * scale)

    @property
    def clocks(self) -> Array:
        """Offset (s) and drift (s/s) of the clock of each recording, shape (recordings, 2).

        To the times of the poses the offset is added in their middle, and from there on the drift times
        the time since.
        """
        return self.estimate.parameters[CLOCKS:].reshape(-1, 2)

    @property
    def clock_deviations(self) -> Array:
        """Standard deviations of the same, shape (recordings, 2)."""
        return np.sqrt(np.diag(self.estimate.covariance))[CLOCKS:].reshape(-1, 2)

    def residuals(self) -> list[Array]:
        """Return what remains between the reference and the most likely poses of the sensor.

        For each continuous motion the time since the first pose of all (s) and the residual in x, y (m)
        and heading (rad), shape (n, 4). Poses at rest are merged.
        """
        parts: list[Array] = []
        begin = before = 0.0
        recording = 0
        for motion, states in zip(self.motions, self.estimate.states, strict=True):
            if not parts:
                begin = -float(motion.time[0])
            elif motion.recording != recording:
                # Recordings follow each other, whenever they were made.
                begin = before - float(motion.time[0])
            recording = motion.recording
            difference = motion.poses - composed(states, self.estimate.sensor)
            difference[:, 2] = wrap(difference[:, 2])
            parts.append(np.column_stack([begin + motion.time, difference]))
            before = float(parts[-1][-1, 0])
        return parts

    @property
    def undetermined(self) -> list[tuple[str, str]]:
        """Combinations of the multipliers that the drives do not determine, and what determines them."""
        return undetermined(self.estimate.covariance[:3, :3])


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
    for one in recordings:
        _check(one)
    recordings = tuple(map(thinned_samples, recordings))
    names = [one.name for one in recordings]
    parameters, clock_notes = _clocks(recordings, nominal, given)
    while True:
        segments, parameters, notes = _prepared(recordings, nominal, parameters)
        start = _start(parameters, given)
        segments, motions, estimate, misfits = _consistent(segments, nominal, start, given, names)
        moved = max(
            float(np.abs(one.at(estimate.parameters) - one.at(parameters)).max()) for one in segments
        )
        if moved < ALIGNED:
            break
        # With a clock that drifts, the reference seems to jump where the robot starts and stops.
        parameters[CLOCKS:] = estimate.parameters[CLOCKS:]
    result = Calibration(
        nominal=nominal,
        estimate=estimate,
        recordings=recordings,
        segments=tuple(segments),
        motions=tuple(motions),
    )
    notes = [note for one in recordings for note in sampling_notes(one)] + clock_notes + notes
    notes += [*misfits, *_judged(result, given)]
    correlation = _correlation(result)
    if correlation > CORRELATED:
        notes.append(
            f'the errors of successive poses of the reference are correlated ({correlation:.2f}): the '
            'stated deviations are enlarged for that'
        )
        # As of the mean of an autoregressive process of first order.
        factor = (1.0 + correlation) / (1.0 - correlation)
        widened = replace(estimate, covariance=estimate.covariance * factor)
        result = replace(result, estimate=widened)
    if given.time_offset is None:
        notes += _clock_notes(result)
    return replace(result, notes=tuple(notes))


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
    return Estimate(parameters=parameters, noise=START, free=free, covariance=unknown)


def _clock_notes(result: Calibration) -> list[str]:
    """Return notes about clocks that differ."""
    notes = []
    clocks = np.column_stack([result.clocks, result.clock_deviations]).tolist()
    for one, (offset, drift, _, deviation) in zip(result.recordings, clocks, strict=True):
        if abs(offset) > LONG_DELAY:
            notes.append(
                f'{one.name}: the clock of the reference differs by {offset:.3f} s from that '
                'of the wheels'
            )
        if abs(drift) > max(NOTABLE_DRIFT, 4.0 * deviation):
            notes.append(
                f'{one.name}: the clock of the reference runs {100.0 * abs(drift):.2g} % '
                f'{"slow" if drift > 0.0 else "fast"} by that of the wheels, which is corrected'
            )
    return notes


def _check(one: CalibrationDrive) -> None:
    for what, time, values in (
        ('the wheels', one.wheel_time, one.wheel_angles),
        ('the reference', one.pose_time, one.poses),
    ):
        if len(time) < 2:
            raise CalibrationError(f'{one.name}: too short: {what} have {len(time)} samples')
        if not (np.isfinite(time).all() and np.isfinite(values).all()):
            raise CalibrationError(f'{one.name}: {what} must be finite')
        if (np.diff(time) <= 0.0).any():
            raise CalibrationError(f'{one.name}: the times of {what} must increase')


def _judged(result: Calibration, given: Given) -> list[str]:
    """Return notes about multipliers, noise and sensor; CalibrationError if they are impossible."""
    values, noise = result.multipliers, result.estimate.noise
    other_unit = unit(float(np.exp(np.log(values).mean())))
    if (values < BOUNDS[0]).any() or (values > BOUNDS[1]).any():
        found = ', '.join(f'{value:.3g}' for value in values.tolist())
        raise CalibrationError(
            f'multipliers must be from {BOUNDS[0]:g} to {BOUNDS[1]:g}, got {found} (left, right, '
            'separation): are the nominal dimensions wrong, or is the reference of another robot, or in '
            f'{other_unit} instead of metres?'
        )
    apart = f'{noise.wheel**0.5:.2g} m'
    if noise.wheel > LARGE_WHEEL_NOISE:
        raise CalibrationError(
            f'the reference does not follow the wheels: after 1 m they differ by {apart}; is it of this '
            'robot, and do the wheels slip?'
        )
    notes = []
    residuals = np.concatenate(result.residuals())[:, 1:3]
    if np.sqrt(np.mean(residuals**2)) < EXACT:
        notes.append(
            'the reference follows the wheels without error: it is simulated without slip, or odometry '
            'that was computed from these wheels, which does not show their true dimensions'
        )
    if noise.wheel > NOTABLE_WHEEL_NOISE:
        notes.append(
            f'the wheels differ from the reference by {apart} after 1 m: they slip, a clock drifts, or '
            'the reference is of another body'
        )
    if (np.abs(np.log(values)) > np.log(UNUSUAL)).any():
        listed = ', '.join(f'{value:.4g}' for value in values.tolist())
        notes.append(
            f'the multipliers {listed} (left, right, separation) are beyond what manufacturing '
            f'explains: are the nominal dimensions wrong, or is the reference in {other_unit} instead '
            'of metres?'
        )
    if given.yaw_offset is None and np.cos(result.estimate.sensor[2]) < -np.cos(BACKWARD):
        notes.append(
            'the sensor looks backwards. If it is not mounted so, the left and the right wheel are '
            'swapped and both turn in the wrong sense: the multipliers of the radii are exchanged then'
        )
    return notes


def _correlation(result: Calibration) -> float:
    """Return the correlation of the position errors of successive poses in motion; 0: there are few."""
    first, second = [], []
    for motion, states in zip(result.motions, result.estimate.states, strict=True):
        errors = (motion.poses - composed(states, result.estimate.sensor))[:, :2]
        single = (motion.weights[1:] == 1.0) & (motion.weights[:-1] == 1.0)
        first.append(errors[:-1][single].ravel())
        second.append(errors[1:][single].ravel())
    a, b = np.concatenate(first), np.concatenate(second)
    if len(a) < LEAST_ERRORS or result.estimate.noise.position <= 1.01 * SMALLEST.position:
        return 0.0
    return float(np.clip(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)), 0.0, 0.99))


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
        estimate = fit(motions, nominal, estimate, given, start.parameters)
        if np.abs(estimate.parameters - before)[CLOCKS::2].max() < 1e-3:
            break
    return estimate, motions


def _consistent(
    segments: Sequence[Segment], nominal: Geometry, start: Estimate, given: Given, names: Sequence[str]
) -> tuple[list[Segment], list[Segment], Estimate, list[str]]:
    """Return the segments, motions and estimate without parts that do not fit, and notes about these.

    Where it is unknown which part is right, either may be: the estimate is the mean of both.
    """
    segments, left_out = list(segments), 0.0
    notes: list[str] = []
    while True:
        estimate, motions = _estimated(segments, nominal, start, given)
        verdict = judged(motions, nominal, estimate)
        part = verdict.interval
        if part is None:
            break
        words = f'{names[part.recording]}: {verdict.words}'
        if part.whole and verdict.sure:
            raise CalibrationError(f'the recordings disagree about the multipliers: {words}')
        left_out += part.share * (1.0 - left_out)
        if not verdict.sure or left_out > MOST_LEFT_OUT or len(notes) == MOST_PARTS:
            notes.append(f'{words}: {UNKNOWN}')
            break
        notes.append(f'{words}. A wheel skids or the reference is wrong: this part is left out')
        segments = without(segments, part.recording, part.begin, part.end)
        start = replace(start, parameters=estimate.parameters, noise=estimate.noise)
    notes += [*verdict.slips, *([verdict.unnoticed] if verdict.unnoticed else [])]
    return segments, motions, verdict.estimate, notes
