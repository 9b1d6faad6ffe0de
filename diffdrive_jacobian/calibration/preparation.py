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

"""From recordings to continuous motions: overlap in time, gaps, glitches and jumps of the reference."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.calibration.encoders import located
from diffdrive_jacobian.calibration.initial_estimate import differences
from diffdrive_jacobian.calibration.model import Array, CalibrationDrive, CalibrationError, Segment
from diffdrive_jacobian.calibration.motion import Geometry
from diffdrive_jacobian.numerics.elementary import wrap

STILL = 1e-5
"""Distance that both wheels together travel while the robot counts as at rest (m)."""
MOST = 25
"""Largest weight of merged poses: the errors of a real reference at rest are not independent."""
GAP = 0.5
"""A shorter pause between samples is not a gap (s)."""
BLIND = 0.02
"""Distance that a wheel may travel between two of its samples around a gap (m)."""
FEWEST = 5
"""Fewest poses of a continuous motion that is used."""
FEWEST_IN_ALL = 10
MOST_SAMPLES, MOST_POSES = 400_000, 10_000
"""Most samples of a recording that are read, and most poses of all that are estimated: both bound time
and memory. Poses at a high rate have little more to say, because their errors depend on each other."""
STEPS = 20.0
"""Steps of the encoders by which the wheels turn between poses that are used. Between nearer ones much
of their turns is reading error, and the estimate would take it for motion that the reference lacks."""
SLOW = 0.15
"""Period of the wheels beyond which too little of the motion is known (s)."""
FLOORS = np.array([0.03, 0.03, 0.06])
"""Differences that are never taken for a jump (m, m, rad)."""
SIGMAS = 8.0
SHARES = np.array([0.1, 0.1, 0.5])
"""Allowed difference relative to the distance that the wheels travel (m/m, m/m, rad/m)."""
GLITCH = 3
"""Number of poses after which a pose that is off is no glitch but a jump."""
MOST_JUMPS = 0.25
"""Share of glitches and jumps beyond which the reference is refused."""


def poses_apart(segment: Segment) -> int:
    """Return after how many poses, at least 1, both wheels have usually turned by `STEPS`."""
    step = 12.0**0.5 * float(np.max(segment.wheel_errors, initial=0.0))
    angles = [np.interp(segment.time, segment.wheel_time, one) for one in segment.wheel_angles.T]
    slower = np.abs(np.diff(angles)).min(axis=0)
    turned = float(np.median(slower[slower > 0.0])) if slower.any() else 0.0
    return max(1, math.ceil(STEPS * step / turned)) if turned > 0.0 else 1


def merged(segment: Segment, nominal: Geometry, parameters: Array) -> Segment:
    """Return a segment in which poses without motion of the wheels between them are averaged."""
    at = segment.at(parameters)
    steps = np.abs(np.diff(segment.wheel_angles, axis=0)).sum(axis=1) * nominal.wheel_radius
    travel = np.concatenate([[0.0], np.cumsum(steps)])
    place = np.floor(np.interp(at, segment.wheel_time, travel) / STILL)
    starts = np.concatenate([[0], np.flatnonzero(np.diff(place)) + 1])
    counts = np.diff([*starts, len(at)])
    headings = segment.poses[np.repeat(starts, counts), 2]
    poses = segment.poses.copy()
    poses[:, 2] = wrap(poses[:, 2] - headings)
    means = np.add.reduceat(poses, starts) / counts[:, None]
    means[:, 2] += segment.poses[starts, 2]
    return replace(
        segment,
        time=np.add.reduceat(segment.time, starts) / counts,
        poses=means,
        samples=np.minimum(counts, MOST).astype(np.float64),
    )


def overlapping(
    recording: CalibrationDrive, index: int, parameters: Array, radius: float
) -> list[Segment]:
    """Return the continuous motions of a recording: its times in common, split at gaps of the wheels.

    `parameters` have the clock of each recording.
    """
    whole = Segment(
        recording=index,
        wheel_time=recording.wheel_time,
        wheel_angles=recording.wheel_angles,
        wheel_errors=np.zeros_like(recording.wheel_angles),
        epoch=float(recording.pose_time[[0, -1]].mean()),
        time=recording.pose_time,
        poses=recording.poses,
        samples=np.ones(len(recording.pose_time)),
    )
    wheels, at = whole.wheel_time, whole.at(parameters)
    inside = (at >= wheels[0]) & (at <= wheels[-1])
    if not inside.any():
        raise CalibrationError(
            f'{recording.name}: the wheels and the reference have no time in common: wheels from '
            f'{wheels[0]:.3f} to {wheels[-1]:.3f} s, reference from {at[0]:.3f} to {at[-1]:.3f} s'
        )
    steps = np.diff(wheels)
    blind = (steps > max(GAP, 10.0 * float(np.median(steps)))) & (
        np.abs(np.diff(whole.wheel_angles, axis=0)).max(axis=1) * radius > BLIND
    )
    found = []
    bounds = [0, *(np.flatnonzero(blind) + 1).tolist(), len(wheels)]
    for first, last in pairwise(bounds):
        here = inside & (at >= wheels[first]) & (at <= wheels[last - 1])
        if last - first > 1 and np.count_nonzero(here) >= FEWEST:
            time, angles, errors = located(wheels[first:last], whole.wheel_angles[first:last])
            part = whole.part(np.flatnonzero(here))
            found.append(replace(part, wheel_time=time, wheel_angles=angles, wheel_errors=errors))
    return found


def thinned_samples(recording: CalibrationDrive) -> CalibrationDrive:
    """Return a recording with at most `MOST_SAMPLES` samples of wheels and of the reference each."""
    wheels = slice(None, None, -(-len(recording.wheel_time) // MOST_SAMPLES) or 1)
    poses = slice(None, None, -(-len(recording.pose_time) // MOST_SAMPLES) or 1)
    return replace(
        recording,
        wheel_time=recording.wheel_time[wheels],
        wheel_angles=recording.wheel_angles[wheels],
        pose_time=recording.pose_time[poses],
        poses=recording.poses[poses],
    )


def thinned_poses(segments: Sequence[Segment]) -> tuple[list[Segment], str]:
    """Return motions with at most about `MOST_POSES` poses, and a note; '': all are kept.

    Poses between which the wheels turn by less than `STEPS` steps of their encoders are left out without
    a note: they share a reading error.
    """
    count = sum(len(one.time) for one in segments)
    every = -(-count // MOST_POSES)
    kept = []
    for one in segments:
        # Short motions keep enough poses.
        step = max(1, min(max(every, poses_apart(one)), len(one.time) // FEWEST))
        kept.append(one.part(slice(None, None, step)))
    used = sum(len(one.time) for one in kept)
    note = f'{used} of {count} poses of the reference are used, evenly spaced' if every > 1 else ''
    return kept, note


def sampling_notes(one: CalibrationDrive) -> list[str]:
    """Return descriptions of gaps, and of wheels that are recorded too rarely."""
    lines = []
    period = float(np.median(np.diff(one.wheel_time)))
    if period > SLOW:
        lines.append(
            f'{one.name}: the wheels are recorded every {period:.2g} s, so that the motion between is '
            'guessed: record them at 10 Hz or more'
        )
    for what, time in (('reference', one.pose_time), ('wheels', one.wheel_time)):
        steps = np.diff(time)
        # Much longer than usual.
        long = int(np.count_nonzero(steps > max(2.0 * GAP, 10.0 * float(np.median(steps)))))
        if long:
            at = int(np.argmax(steps))
            lines.append(
                f'{one.name}: {long} gap{"s" * (long > 1)} in the {what}, '
                f'the longest of {steps[at]:.1f} s at {time[at]:.3f} s'
            )
    return lines


def without(segments: Sequence[Segment], recording: int, begin: float, end: float) -> list[Segment]:
    """Return motions without the poses of a recording between two times, where they are split."""
    kept = []
    for one in segments:
        count = len(one.time)
        here = one.recording == recording
        first = int(np.searchsorted(one.time, begin, 'right')) if here else count
        last = int(np.searchsorted(one.time, end)) if here else count
        parts = (slice(0, first), slice(max(first, last), count))
        kept += [one.part(part) for part in parts if part.stop - part.start >= FEWEST]
    return kept


def without_jumps(
    segments: Sequence[Segment], nominal: Geometry, parameters: Array, names: Sequence[str]
) -> tuple[list[Segment], list[str]]:
    """Remove glitches of the reference, split motions at its jumps, and return notes of them."""
    kept: list[Segment] = []
    notes: list[str] = []
    poses = glitches = 0
    jumps: list[tuple[float, float, str]] = []
    found = [differences(one, nominal, parameters) for one in segments]
    everything = np.concatenate([difference for difference, _ in found])
    allowed = FLOORS + SIGMAS * 1.4826 * np.median(np.abs(everything), axis=0)
    for segment, (difference, travel) in zip(segments, found, strict=True):
        poses += len(segment.time)
        off = (np.abs(difference) > allowed + travel[:, None] * SHARES).any(axis=1)
        use, starts = _followed(segment, nominal, parameters, off, allowed)
        glitches += int(np.count_nonzero(~use))
        for start in starts:
            size = float(np.hypot(*difference[start - 1, :2]))
            jumps.append((float(segment.time[start]), size, names[segment.recording]))
        bounds = [0, *starts, len(segment.time)]
        for first, last in pairwise(bounds):
            here = np.flatnonzero(use[first:last]) + first
            if len(here) >= FEWEST:
                kept.append(segment.part(here))
    if glitches + len(jumps) > MOST_JUMPS * poses:
        raise CalibrationError(
            f'the poses of the reference do not follow the wheels: {glitches + len(jumps)} of {poses} '
            'are off; are they of this robot, in one frame, and by the same clock?'
        )
    if sum(len(one.time) for one in kept) < FEWEST_IN_ALL:
        raise CalibrationError(
            f'too short: the wheels and the reference have {poses} poses in common, at least '
            f'{FEWEST_IN_ALL} are needed'
        )
    if glitches:
        notes.append(f'{glitches} poses of the reference are glitches and were left out')
    notes += [
        f'{name}: the reference jumps by {size:.3f} m at {time:.3f} s; what follows is aligned anew'
        for time, size, name in jumps[:4]
    ]
    if len(jumps) > 4:
        notes.append(f'{len(jumps) - 4} further jumps of the reference')
    return kept, notes


def _followed(
    segment: Segment, nominal: Geometry, parameters: Array, off: NDArray[np.bool_], allowed: Array
) -> tuple[NDArray[np.bool_], list[int]]:
    """Return which poses are no glitches, and where the reference continues elsewhere after a jump."""
    use = np.ones(len(segment.time), dtype=bool)
    starts: list[int] = []
    index = 0
    marked = np.flatnonzero(off) + 1
    for mark in marked.tolist():
        if mark <= index:
            continue
        # Does one of the next poses continue the one before?
        last = mark - 1
        for back in range(mark + 1, min(mark + 1 + GLITCH, len(use))):
            pair = np.array([last, back])
            difference, travel = differences(segment.part(pair), nominal, parameters)
            if (np.abs(difference) <= allowed + travel[:, None] * SHARES).all():
                use[mark:back] = False
                index = back
                break
        else:
            starts.append(mark)
            index = mark
    return use, starts
