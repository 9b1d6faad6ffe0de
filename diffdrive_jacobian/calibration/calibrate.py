"""Calibration of wheel radii and wheel separation from recordings of the wheels and a reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from diffdrive_jacobian.calibration.clock import time_offset
from diffdrive_jacobian.calibration.consistency import misfit
from diffdrive_jacobian.calibration.fit import fit
from diffdrive_jacobian.calibration.initial_estimate import initial_estimate, unit
from diffdrive_jacobian.calibration.model import (
    LEVER_ARM,
    TIME_OFFSETS,
    UNDETERMINED,
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
EXACT = Noise(wheel=1e-7, position=2e-5, heading=2e-5)
"""Noise below which a reference is no observation of a real robot."""
DISAGREEMENT = 5.5
"""Deviations by which a recording must differ from the others to be refused; one in a million does."""
SAME = 0.005
"""Multipliers that differ by less agree in any case [-]."""
MOST_PARTS, MOST_LEFT_OUT = 8, 0.4
"""Most parts of the drives that are left out, and the largest share of the distance."""
ROUNDS = 3
LONG_DELAY = 0.2
"""Time offset that is worth a note (s)."""
UNUSUAL = 1.15
"""Factor beyond which multipliers are not explained by manufacturing."""
CORRELATED, LEAST_ERRORS = 0.5, 60
"""Correlation of successive errors that is noted, and fewest errors that show it."""
RARE = 0.04
"""Period of the wheels beyond which it matters how they move between their samples (s)."""
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
        return np.asarray(self.estimate.covariance()[:3, :3] * scale[:, None] * scale)

    @property
    def time_offsets(self) -> Array:
        """What is added to the times of the poses of each recording (s)."""
        return self.estimate.parameters[TIME_OFFSETS:]

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
        return undetermined(self.estimate.covariance()[:3, :3])


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
    period = max(float(np.median(np.diff(one.wheel_time))) for one in recordings)
    found, errors = [], []
    for smooth in (True, False) if period > RARE else (True,):
        try:
            found.append(_calibrated(recordings, nominal, given, smooth))
        except CalibrationError as error:
            errors.append(error)
    if not found:
        raise errors[0]
    return found[0] if len(found) == 1 else _compared(found, period)


def _compared(found: list[Calibration], period: float) -> Calibration:
    """Return the more likely one of two results, with their difference in its uncertainty."""
    first, second = sorted(found, key=_misfit)
    difference = second.estimate.parameters - first.estimate.parameters
    deviations = np.sqrt(np.diag(first.estimate.covariance())[:3])
    if (np.abs(difference[:3]) < deviations).all():
        return first
    note = (
        f'the wheels are recorded every {period:.2g} s, and the multipliers depend on how they move '
        'between their samples: record them more often'
    )
    widened = first.estimate.widened(difference[np.newaxis])
    return replace(first, estimate=widened, notes=(*first.notes, note))


def _misfit(result: Calibration) -> float:
    """Return what falls with the likelihood of the noise, of three residuals of wheels for each pose."""
    noise = result.estimate.noise
    return float(3.0 * np.log(noise.wheel) / 2.0 + 2.0 * np.log(noise.position) + np.log(noise.heading))


def _calibrated(
    recordings: tuple[CalibrationDrive, ...], nominal: Geometry, given: Given, smooth: bool
) -> Calibration:
    notes = [note for one in recordings for note in sampling_notes(one)]
    offsets = np.zeros(len(recordings))
    for index, one in enumerate(recordings):
        found = given.time_offset if given.time_offset is not None else time_offset(one, nominal)
        offsets[index] = 0.0 if found is None else found
        if found is None:
            notes.append(
                f'{one.name}: the speeds of the wheels and of the reference do not show the offset '
                'between their clocks, which is assumed to be about 0 s'
            )
    segments = [
        segment
        for index, one in enumerate(recordings)
        for segment in overlapping(one, index, offsets[index], nominal.wheel_radius, smooth)
    ]
    if not segments:
        raise CalibrationError(
            'too short: the wheels and the reference have less than 5 poses in common without a gap'
        )
    names = [one.name for one in recordings]
    first = initial_estimate(segments, nominal, offsets)
    segments, found_notes = without_jumps(segments, first, offsets, names)
    segments, thinned = thinned_poses(segments)
    notes += [*found_notes, thinned] if thinned else found_notes
    first = initial_estimate(segments, nominal, offsets)
    parameters = np.concatenate([np.log(first.geometry.multipliers), first.sensor, offsets])
    free = np.ones(len(parameters), dtype=bool)
    if given.lever_arm is not None:
        parameters[LEVER_ARM], free[LEVER_ARM] = given.lever_arm, False
    if given.yaw_offset is not None:
        parameters[YAW_OFFSET], free[YAW_OFFSET] = given.yaw_offset, False
    free[TIME_OFFSETS:] = given.time_offset is None
    start = Estimate(parameters=parameters, noise=START, free=free, information=np.zeros((0, 0)))
    segments, motions, estimate, misfits = _consistent(segments, nominal, start, given, names)
    result = Calibration(
        nominal=nominal,
        estimate=estimate,
        recordings=recordings,
        segments=tuple(segments),
        motions=tuple(motions),
    )
    notes += [*misfits, *_judged(result, given)]
    correlation = _correlation(result)
    if correlation > CORRELATED:
        notes.append(
            f'the errors of successive poses of the reference are correlated ({correlation:.2f}): the '
            'stated deviations are enlarged for that'
        )
        # As of the mean of an autoregressive process of first order.
        factor = (1.0 + correlation) / (1.0 - correlation)
        result = replace(result, estimate=replace(estimate, information=estimate.information / factor))
    for one, offset in zip(recordings, result.time_offsets.tolist(), strict=True):
        if given.time_offset is None and abs(offset) > LONG_DELAY:
            notes.append(
                f'{one.name}: the clock of the reference differs by {offset:.3f} s from that '
                'of the wheels'
            )
    return replace(result, notes=tuple(notes))


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
    if noise.wheel < EXACT.wheel and noise.position < EXACT.position and noise.heading < EXACT.heading:
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
    if len(a) < LEAST_ERRORS:
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
        before = estimate.parameters[TIME_OFFSETS:]
        motions = [merged(one, nominal, before[one.recording]) for one in segments]
        motions = [one for one in motions if len(one.time) > 1]
        if not motions:
            raise CalibrationError('the wheels never turn')
        estimate = fit(motions, nominal, estimate, given, start.parameters)
        if np.abs(estimate.parameters[TIME_OFFSETS:] - before).max() < 1e-3:
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
    estimate, motions = _estimated(segments, nominal, start, given)
    while (found := misfit(motions, nominal, estimate)) is not None:
        window = found.window
        where = found.words if window is None else f'{names[window.recording]}: {found.words}'
        if window is None or window.whole or len(notes) == MOST_PARTS:
            break
        left_out += window.share * (1.0 - left_out)
        if left_out > MOST_LEFT_OUT:
            break
        notes.append(f'{where}. A wheel skids or the reference is wrong: this part is left out')
        segments = without(segments, window.recording, window.begin, window.end)
        start = replace(start, parameters=estimate.parameters, noise=estimate.noise)
        estimate, motions = _estimated(segments, nominal, start, given)
    if found is None:
        return segments, motions, estimate, notes
    certain = found.deviations > DISAGREEMENT and abs(found.difference) > SAME
    if window is not None and window.whole and certain:
        raise CalibrationError(f'the recordings disagree about the multipliers: {where}')
    middle, half = found.shifts.mean(axis=0), (found.shifts[0] - found.shifts[1]) / 2.0
    widened = replace(estimate, parameters=estimate.parameters + middle).widened(
        np.stack([half, middle / found.deviations])
    )
    if undetermined(widened.covariance()[:3, :3]) != undetermined(estimate.covariance()[:3, :3]):
        raise CalibrationError(
            f'{where}. Which is right is unknown, and one of the multipliers is uncertain by more than '
            f'{100.0 * UNDETERMINED:g} %'
        )
    notes.append(
        f'{where}. Which is right is unknown: the estimate lies between, and its deviations include both'
    )
    return segments, motions, widened, notes
