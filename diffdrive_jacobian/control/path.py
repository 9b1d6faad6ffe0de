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

"""A planned path: poses to drive through without stopping, and where a robot is along them.

Model: the positions are connected by circular arcs, two for each pair (a biarc), which meet with the
same tangent. The tangent at a position is that of the circle through it and its neighbours, corrected by
the change of the curvature, so the positions of a circle give that circle. The arcs are what a unicycle
drives at constant speeds: the path at arc length s is `exp` of SE(2), exact, of curvature omega / v.

- Headings of the poses are not used, because planners often leave them at 0. A robot drives along the
  path forwards.
- Where the direction changes by more than `CORNER` between two poses, the path has a corner: the tangent
  jumps, and a robot rounds it as its law does.
- Of two neighbours with very different lengths the longer one is a straight line.
- A position that is repeated is skipped. In a trajectory (poses with times) it is a pause.

Source: Bolton 1975, "Biarc curves"; Fritsch and Carlson 1980 for the times.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import cos, floor, hypot, inf, isnan, nan, pi, sin
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.numerics.checks import array, finite, floats, number, positive, read_only
from diffdrive_jacobian.numerics.elementary import wrap

Floats = NDArray[np.float64]

CORNER = np.radians(35.0)
"""Largest change of direction between two poses that is a curve rather than a corner (rad). A circle of
twelve poses or more is a circle."""
STRAIGHT = 4.0
"""A distance between poses that is this many times the next one is a straight line."""
REPEATED = 1e-6
"""Distance below which a position is the one before (m)."""
CLOSED = 1e-3
"""Largest distance between the ends of a closed path (m)."""
WINDOW = 0.5
"""Arc length that `nearest` searches to either side, but at most a quarter of the path (m)."""


class Reference(NamedTuple):
    """A path at one place: where a robot should be, and how it should move there."""

    x: float
    """Position (m)."""
    y: float
    theta: float
    """Direction of the tangent (rad)."""
    v: float
    """Speed along the path (m/s)."""
    omega: float
    """Yaw rate, curvature times speed (rad/s)."""
    ax: float
    """Acceleration of the point (m/s^2)."""
    ay: float
    s: float
    """Arc length from the first pose (m)."""


class Errors(NamedTuple):
    """Tracking errors of a robot, in the frame of the reference. Each of shape (...)."""

    along: Any
    """Positive ahead of the reference (m)."""
    across: Any
    """Positive to the left of the path (m)."""
    heading: Any
    """Heading of the robot minus that of the path (rad)."""


class _Arcs(NamedTuple):
    """Arcs of constant curvature, each array of shape (m)."""

    start: Floats
    """Arc length at which each begins (m)."""
    pose: Floats
    """Pose in which each begins, shape (m, 3)."""
    curvature: Floats
    """Left positive (1/m)."""
    length: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """Poses to drive through in order, with times a trajectory. Immutable.

    Poses of another shape than (n, 3) or (n, 2) or that are not finite, fewer than two different
    positions, and times that are not of shape (n) or do not increase raise ValueError.
    """

    poses: Floats
    """`[x, y, theta]` each, shape (n, 3), read-only (m, m, rad). Given as (n, 2), theta is 0."""
    times: Floats | None = None
    """Time of each pose since the first, shape (n), read-only (s); None: a path without times."""
    length: float = field(init=False)
    """Arc length (m)."""
    closed: bool = field(init=False)
    """Whether the path ends where it begins, in the same direction."""
    arc_lengths: Floats = field(init=False, repr=False)
    """Arc length of each pose, shape (n), read-only (m)."""
    _arcs: _Arcs = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Check the poses and connect them."""
        poses = floats('poses', self.poses)
        poses = array('poses', poses, 'n', 2 if poses.shape[-1:] == (2,) else 3)
        if poses.ndim != 2:
            raise ValueError(f'poses must have shape (n, 3) or (n, 2), got {poses.shape}')
        if poses.shape[-1] == 2:
            poses = np.column_stack([poses, np.zeros(len(poses))])
        with np.errstate(over='ignore'):
            new = _new(poses[:, :2])
        if not new.any():
            raise ValueError(f'poses must have two different positions, got {len(poses)} in one place')
        distinct = poses[np.concatenate([[True], new]), :2]
        with np.errstate(over='ignore', invalid='ignore'):
            arcs, closed = _connected(distinct)
            ends = np.concatenate([[0.0], np.cumsum(arcs.length)])
        if not np.isfinite(ends[-1]):
            raise ValueError('poses must give a path of finite length, but it overflows')
        at_pose = ends[::2][np.concatenate([[0], np.cumsum(new)])]
        times = None if self.times is None else _times(self.times, len(poses))
        values = {
            'poses': read_only(poses),
            'times': times,
            'length': float(ends[-1]),
            'closed': closed,
            'arc_lengths': read_only(at_pose),
            '_arcs': arcs,
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @property
    def duration(self) -> float:
        """Time from the first pose to the last (s); NaN for a path without times."""
        return float('nan') if self.times is None else float(self.times[-1])

    def timed(self, speed: float) -> Path:
        """Return the trajectory along this path with a constant speed (m/s).

        Poses that repeat the position before are left out. A speed that is not positive raises
        ValueError.
        """
        speed = number('speed', speed, positive)
        new = np.concatenate([[True], np.diff(self.arc_lengths) > 0.0])
        return Path(self.poses[new], self.arc_lengths[new] / speed)

    def at(self, s: float, speed: float) -> Reference:
        """Return the path at an arc length.

        Before the start of an open path s (m) is the start, after the end the end. A closed path is
        repeated. The speed along the path is constant (m/s). Arguments that are not finite raise
        ValueError.
        """
        return self._reference(number('s', s, finite), number('speed', speed, finite), 0.0)

    def at_time(self, t: float) -> Reference:
        """Return a trajectory at a time: between its poses the speed is continuous.

        Before t = 0 (s) the robot rests at the first pose, after the duration at the last one. A t that
        is not finite, and a path without times, raise ValueError.
        """
        t = number('t', t, finite)
        if self.times is None:
            raise ValueError('path must have times, got a path without')
        if not 0.0 <= t < self.times[-1]:
            return self._reference(0.0 if t < 0.0 else self.length, 0.0, 0.0)
        return self._reference(*_interpolated(self.times, self.arc_lengths, t))

    def time_after(self, t: float, pose: Any, dt: float, approach: float) -> float:
        """Return the time of a trajectory (s) after a step from the time t, as go_to_goal has it.

        It waits while the robot at `pose` is farther than `approach` (m) from where it should be, or
        turned away from it. `dt` is the length of the step (s).
        """
        x, y, theta = pose
        there = self.at_time(t)
        turned = abs(wrap(there.theta - theta)) > pi / 2.0
        return t if turned or hypot(there.x - x, there.y - y) > approach else t + dt

    def poses_at(self, s: ArrayLike) -> Floats:
        """Return the poses of the path, with the direction of the tangent, at arc lengths as in `at`.

        Arc lengths s of shape (...) (m) give `[x, y, theta]` of shape (..., 3) (m, m, rad). An arc
        length that is not finite raises ValueError.
        """
        inside: Floats = self._inside(array('s', s, *np.shape(s)))
        index = self._arcs.start.searchsorted(inside, 'right') - 1
        beyond = inside - self._arcs.start[index]
        turn = self._arcs.curvature[index] * beyond
        return se2.compose(
            self._arcs.pose[index], se2.exp(np.stack([beyond, np.zeros_like(turn), turn], axis=-1))
        )

    def nearest(self, x: float, y: float, near: float | None = None, *, forward: bool = False) -> float:
        """Return the arc length of the nearest point, in a window about a place.

        The window keeps a robot on its branch where a path crosses itself or passes close to itself. On
        a closed path the result may be below 0 or beyond the length, so that progress does not jump.

        Args:
            x: Position of the robot (m).
            y: Likewise.
            near: Arc length of the place, such as the result for the position before (m). None: the
                whole path is searched.
            forward: Whether only what follows the place is searched. So a robot gets past a place where
                the path turns back.
        """
        x, y = number('x', x, finite), number('y', y, finite)
        low, high = 0.0, self.length
        if near is not None:
            window = min(WINDOW, self.length / 4.0)
            near = number('near', near, finite)
            near = near if self.closed else min(max(near, 0.0), high)
            low, high = near - (0.0 if forward else window), near + window
            if not self.closed:
                low, high = max(low, 0.0), min(high, self.length)
        arcs, count = self._arcs, len(self._arcs.start)
        first, last = self._arc(low), self._arc(high)
        unwrapped = np.arange(first, last + 1)
        index = unwrapped % count
        start = arcs.start[index] + self.length * (unwrapped // count)
        # The position in the frame in which each arc begins, and the angle that it has passed there.
        theta, curvature = arcs.pose[index, 2], arcs.curvature[index]
        dx, dy = x - arcs.pose[index, 0], y - arcs.pose[index, 1]
        along = np.cos(theta) * dx + np.sin(theta) * dy
        across = np.cos(theta) * dy - np.sin(theta) * dx
        straight = curvature == 0.0
        passed = np.where(
            straight,
            along,
            np.arctan2(curvature * along, 1.0 - curvature * across) / np.where(straight, 1.0, curvature),
        )
        s = np.clip(start + np.clip(passed, 0.0, arcs.length[index]), low, high)
        turn = curvature * (s - start) / 2.0
        chord = (s - start) * np.sinc(turn / np.pi)
        return float(s[np.argmin(np.hypot(along - chord * np.cos(turn), across - chord * np.sin(turn)))])

    def project(self, positions: ArrayLike, near: float | None = 0.0) -> Floats:
        """Return the arc length of the nearest point for each of the positions of a drive in order.

        Args:
            positions: Shape (n, 2) or (n, 3) (m); an entry that is not finite raises ValueError.
            near: Arc length about which the first is searched (m). None: on the whole path.

        Returns arc lengths, shape (n) (m), as of `nearest`.
        """
        positions = array('positions', positions, *np.shape(positions))
        result = np.empty(len(positions))
        for index, (x, y) in enumerate(positions[:, :2].tolist()):
            near = result[index] = self.nearest(x, y, near)
        return result

    @staticmethod
    def errors(pose: Any, reference: Any) -> Errors:
        """Compute the tracking errors of a robot in the frame of a reference.

        Of `[x, y, theta]` of the robot, shape (..., 3) (m, m, rad), and a Reference, or `[x, y, theta]`
        of the path, shape (..., 3): the errors along and across the path and of the heading, each of
        shape (...). A wrong shape and an entry that is not finite raise ValueError.
        """
        placed = se2.compose(se2.inverse(np.asarray(reference)[..., :3]), pose)
        return Errors(*(one[()] for one in np.moveaxis(placed, -1, 0)))

    def _inside(self, s: Any) -> Any:
        """Return arc lengths from 0 to the length."""
        return np.mod(s, self.length) if self.closed else np.clip(s, 0.0, self.length)

    def _arc(self, s: float) -> int:
        """Return the number of the arc at an arc length; a closed path goes on counting."""
        turns = floor(s / self.length) if self.closed else 0
        start = self._arcs.start
        return turns * len(start) + int(start.searchsorted(s - turns * self.length, 'right')) - 1

    def _reference(self, s: float, v: float, v_dot: float) -> Reference:
        inside = float(self._inside(s))
        index = int(self._arcs.start.searchsorted(inside, 'right')) - 1
        beyond = inside - float(self._arcs.start[index])
        curvature = float(self._arcs.curvature[index])
        passed = se2.exp.formula([beyond, 0.0, curvature * beyond])
        x, y, theta = se2.compose.formula(self._arcs.pose[index].tolist(), passed)
        a_n = curvature * v * v
        ax, ay = v_dot * cos(theta) - a_n * sin(theta), v_dot * sin(theta) + a_n * cos(theta)
        return Reference(x, y, theta, v, curvature * v, ax, ay, s if self.closed else inside)


@dataclass(slots=True)
class PathProgress:
    """How far a robot is along a path and from it, as seen by somebody who does not drive it."""

    path: Path
    s: float = 0.0
    """Arc length of the point nearest to the robot (m)."""
    across: float = 0.0
    """Distance from that point, positive to the left of the path (m)."""
    heading: float = 0.0
    """Heading of the robot minus that of the path there (rad)."""
    greatest: float = nan
    """Greatest absolute distance so far (m); NaN: no pose was taken."""
    elapsed: float = nan
    """Time of a trajectory, which waits for the robot (s); NaN: there are no times."""
    along: float = nan
    """How far the robot is ahead of where it should be by then, along the path (m); NaN likewise."""
    late: float = nan
    """How long the times have waited so far (s); NaN likewise."""
    _begun: float = nan
    _last: float = nan

    def moved(self, pose: Any, time: float = 0.0, approach: float = inf, longest: float = inf) -> None:
        """Take a pose of the robot.

        Args:
            pose: `[x, y, theta]` (m, m, rad).
            time: Its time (s), from any beginning. The first one is when the robot begins.
            approach: As for `Path.time_after` (m).
            longest: Longest step by which the times of a trajectory advance (s).
        """
        self.s = self.path.nearest(pose[0], pose[1], self.s)
        errors = Path.errors(pose, self.path.at(self.s, 0.0))
        self.across, self.heading = float(errors.across), float(errors.heading)
        self.greatest = float(np.fmax(self.greatest, abs(self.across)))
        if self.path.times is None:
            return
        if isnan(self._begun):
            self._begun, self._last, self.elapsed = time, time, 0.0
        step = min(max(time - self._last, 0.0), longest)
        self.elapsed = self.path.time_after(self.elapsed, pose, step, approach)
        self._last = time
        self.along = self.s - self.path.at_time(self.elapsed).s
        self.late = time - self._begun - min(self.elapsed, self.path.duration)

    @property
    def remaining(self) -> float:
        """Arc length to the end and distance from the path together, as in a right triangle (m)."""
        return hypot(self.path.length - self.s, self.across)


def _new(positions: Floats) -> NDArray[np.bool_]:
    """Return whether each position after the first is another one than the last that was."""
    new: NDArray[np.bool_] = np.hypot(*np.diff(positions, axis=0).T) > REPEATED
    if not new.all():
        # Those that are left out may creep away.
        x, y = positions[0].tolist()
        for index, (next_x, next_y) in enumerate(positions[1:].tolist()):
            new[index] = hypot(next_x - x, next_y - y) > REPEATED
            if new[index]:
                x, y = next_x, next_y
    return new


def _times(times: ArrayLike, count: int) -> Floats:
    result = array('times', times, 'n')
    if result.shape != (count,):
        raise ValueError(f'times must have shape ({count},), as many as poses, got {result.shape}')
    back = np.flatnonzero(np.diff(result) <= 0.0)
    if back.size:
        one, two = result[back[0] : back[0] + 2].tolist()
        raise ValueError(f'times must increase, got {two:g} s after {one:g} s at index {back[0] + 1}')
    return read_only(result - result[0])


def _connected(positions: Floats) -> tuple[_Arcs, bool]:
    """Return two arcs for each pair of positions, shape (n, 2), and whether the path is closed."""
    chords = np.diff(positions, axis=0)
    lengths, directions = np.hypot(*chords.T), np.arctan2(chords[:, 1], chords[:, 0])
    # At the join of a closed path the last chord precedes the first.
    turns = wrap(directions - np.roll(directions, 1))
    before = np.roll(lengths, 1)
    ends_meet = bool(np.hypot(*(positions[-1] - positions[0])) <= CLOSED)
    closed = ends_meet and bool(abs(turns[0]) <= CORNER)
    # Angle from the chord before a position to its tangent: the angle between chord and tangent of a
    # circle is half of the arc, so the sines of both angles are in proportion to the chords.
    ahead = np.arctan2(before * np.sin(turns), lengths + before * np.cos(turns))
    smooth = abs(turns) <= CORNER
    smooth[0] = closed
    ahead -= _excess(turns, before, lengths, smooth)
    ahead = np.where(before > STRAIGHT * lengths, 0.0, ahead)
    ahead = np.where(lengths > STRAIGHT * before, turns, ahead)
    begin = np.where(smooth, ahead - turns, np.nan)
    end = np.where(np.roll(smooth, -1), np.roll(ahead, -1), np.nan)
    # An end without a tangent has that of the circle which has the other end's.
    begin, end = _known(begin, -end), _known(end, -begin)
    return _biarcs(positions[:-1], directions, lengths, begin, end), closed


def _excess(turns: Floats, before: Floats, after: Floats, smooth: Any) -> Floats:
    """Return by how much the tangent of the circle through three positions leads (rad).

    Where the curvature changes with the arc length by k', it leads by `k' before after / 6`. Without
    this correction the curvature of the arcs zigzags.
    """
    chord = np.hypot(after + before * np.cos(turns), before * np.sin(turns))
    curvature = 2.0 * np.sin(turns) / np.where(smooth, chord, np.inf)
    # A circle through three positions has the curvature in their middle. Its slope is taken from both
    # sides, next to an end or a corner from one.
    middle = (after - before) / 3.0
    ahead = np.roll(smooth, -1) & smooth
    behind = np.roll(smooth, 1) & smooth
    last = np.where(ahead, after + np.roll(middle, -1), middle)
    first = np.where(behind, np.roll(middle, 1) - before, middle)
    change = np.where(ahead, np.roll(curvature, -1), curvature)
    change -= np.where(behind, np.roll(curvature, 1), curvature)
    slope: Floats = np.divide(change, last - first, out=np.zeros_like(change), where=last > first)
    return slope * before * after / 6.0


def _known(angle: Floats, other: Floats) -> Floats:
    return np.where(np.isfinite(angle), angle, np.where(np.isfinite(other), other, 0.0))


def _biarcs(positions: Floats, directions: Floats, lengths: Floats, begin: Floats, end: Floats) -> _Arcs:
    """Return the arcs over chords whose tangents at both ends have given angles to the chord."""
    both = np.cos(begin) + np.cos(end)
    d = lengths / (both + np.sqrt(both**2 + 4.0 * np.sin((end - begin) / 2.0) ** 2))
    # Where the two arcs meet, in the frame of the chord.
    x = (lengths + d * (np.cos(begin) - np.cos(end))) / 2.0
    y = d * (np.sin(begin) - np.sin(end)) / 2.0
    to_joint, from_joint = np.arctan2(y, x), np.arctan2(-y, lengths - x)
    half_turns = np.column_stack([to_joint - begin, end - from_joint]).ravel()
    chords = np.column_stack([np.hypot(x, y), np.hypot(lengths - x, y)]).ravel()
    arcs = chords / np.sinc(half_turns / np.pi)
    headings = np.column_stack([directions + begin, directions + 2.0 * to_joint - begin]).ravel()
    offset_x = x * np.cos(directions) - y * np.sin(directions)
    offset_y = x * np.sin(directions) + y * np.cos(directions)
    joints = positions + np.column_stack([offset_x, offset_y])
    starts = np.stack([positions, joints], axis=1).reshape(-1, 2)
    return _Arcs(
        start=read_only(np.concatenate([[0.0], np.cumsum(arcs)[:-1]])),
        pose=read_only(np.column_stack([starts, wrap(headings)])),
        curvature=read_only(2.0 * half_turns / arcs),
        length=read_only(arcs),
    )


def _interpolated(times: Floats, s: Floats, t: float) -> tuple[float, float, float]:
    """Return arc length, speed and its derivative: the monotone cubic of Fritsch and Carlson.

    Monotone, so that a robot pauses where it should, and never drives backwards.
    """
    index = int(times.searchsorted(t, 'right')) - 1
    first = max(index - 1, 0)
    intervals = np.diff(times[first : index + 3])
    means = (np.diff(s[first : index + 3]) / intervals).tolist()
    here = index - first
    h, mean = float(intervals[here]), means[here]
    v_0 = mean if here == 0 else _slope(intervals[here - 1], h, means[here - 1], mean)
    v_1 = mean if here + 1 == len(means) else _slope(h, intervals[here + 1], mean, means[here + 1])
    u = (t - float(times[index])) / h
    quadratic, cubic = 3.0 * mean - 2.0 * v_0 - v_1, v_0 + v_1 - 2.0 * mean
    return (
        float(s[index]) + h * u * (v_0 + u * (quadratic + u * cubic)),
        v_0 + u * (2.0 * quadratic + 3.0 * u * cubic),
        (2.0 * quadratic + 6.0 * u * cubic) / h,
    )


def _slope(h_0: Any, h_1: Any, mean_0: float, mean_1: float) -> float:
    """Return the weighted harmonic mean of two speeds, 0 at a pause."""
    if min(mean_0, mean_1) <= 0.0:
        return 0.0
    w_0, w_1 = 2.0 * float(h_1) + float(h_0), float(h_1) + 2.0 * float(h_0)
    return (w_0 + w_1) / (w_0 / mean_0 + w_1 / mean_1)
