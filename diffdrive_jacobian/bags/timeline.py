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

"""A run followed over time: goals, paths, and errors at each odometry message.

Times are seconds since the first odometry, by its own stamps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from operator import attrgetter
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.bags.run import Run, Series
from diffdrive_jacobian.control import Path
from diffdrive_jacobian.control.controllers import CONTROLLERS
from diffdrive_jacobian.messages.conversion import MAX_PATH_POSES, MAX_WAYPOINTS
from diffdrive_jacobian.messages.goal_status import Fate, FollowedGoal, GoalFollower, GoalState, Stamp
from diffdrive_jacobian.numerics.elementary import wrap
from diffdrive_jacobian.parameters.go_to_goal import GoToGoalParameters
from diffdrive_jacobian.time_units import NANOSECONDS

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]
Times = NDArray[np.int64]

_NEVER = int(np.iinfo(np.int64).max)
TELEPORT = 0.1
"""A shorter step of the odometry is taken for a motion, however sudden (m)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Timeline:
    """Quantities of a run, one value for each odometry message; arrays of shape (n,)."""

    run: Run
    time: Array
    """Since the first of them (s)."""
    breaks: Indices
    """Where the odometry is reset: no path leads there from the message before."""
    goal: Indices
    """Which of `run.goals` is driven to; -1: none."""
    goals: Indices
    """Which of `run.goals` were not refused, shape (k,)."""
    start: float
    """When the first goal or path was sent (s); NaN: none was, or it was refused."""
    outcome: GoalState
    """What became of the last goal or path; UNKNOWN: there was none, or nothing is known of it."""
    end: float
    """When the last goal or path ended (s); NaN: it did not."""
    distance: Array
    """To that goal, of the point that the controller drives (m); NaN: none."""
    bearing_error: Array
    """From the heading to the direction of that goal (rad); NaN: none, or it is reached."""
    goal_heading_error: Array
    """From the heading to that of the goal (rad); NaN: none, or its heading does not count."""
    paths: tuple[Path, ...]
    """The paths that were sent and not refused."""
    path: Indices
    """Which of `paths` is driven along; -1: none."""
    progress: Array
    """Arc length of the point of it that is nearest to the axle centre (m); NaN: none."""
    along: Array
    """How far that is ahead of where a trajectory is by its times, which wait for one that is far away
    (m); NaN: no trajectory."""
    late: Array
    """How long the times of a trajectory have waited so far (s); NaN: no trajectory."""
    elapsed: Array
    """Time of the trajectory (s); NaN: no trajectory."""
    across: Array
    """Distance from the path, positive to its left (m); NaN: none."""
    path_heading_error: Array
    """From the direction of the path to the heading (rad); NaN: none."""

    def travelled(self) -> Array:
        """Return the length of the path up to each odometry message, shape (n,) (m)."""
        steps = np.hypot(*np.diff(self.run.odometry.values[:, :2], axis=0).T)
        steps[self.breaks - 1] = 0.0
        return np.concatenate([[0.0], np.cumsum(steps)])


def timeline(run: Run) -> Timeline:
    """Follow a run.

    A goal counts from when it was recorded until the next one, unless it was refused, canceled or
    aborted (`goal_status`). Of several waypoints the next one counts from the first odometry within
    xy_goal_tolerance of go_to_goal (0.02 m if that was not recorded), as the node has it; if none is,
    though the node says that it succeeded or nothing is known of it, from the closest approach.
    The heading of the last goal counts if the controller takes one, or by `use_goal_heading`. All
    parameters are those of the time, as far as their changes were recorded.
    The last goal is reached when the node reports success, or, if `goal_status` was not recorded, at
    the first odometry within the tolerance. A reached goal has no direction. Its distance continues
    until the odometry is reset, or, without `goal_status`, reset while the robot is at the goal.
    A path counts until the next goal or path, or until it has ended. The times of a trajectory advance
    as in go_to_goal: not while the robot is farther from it than path_approach_distance, or turned away.

    Raises:
        BagError: There is no odometry.
    """
    odometry = run.odometry
    if not len(odometry):
        raise run.lacking('odometry: no valid message on a topic odom of nav_msgs/msg/Odometry')
    breaks = _breaks(run)
    routes = _routes(run)
    goal, reached, driven = _progress(run, breaks, routes)
    x, y, theta = odometry.values[:, :3].T
    targets = np.full((len(odometry), 3), np.nan)
    targets[goal >= 0] = run.goals.values[goal[goal >= 0]]
    dx, dy = targets[:, 0] - x, targets[:, 1] - y
    to_goal = targets[:, :2] - _driven_points(run)
    last = [sent.rows[-1] for sent, _ in routes if sent.rows and not sent.is_path]
    paths, ends, errors = _along_paths(run, routes, driven)
    counts = _over_time(run, lambda now: heading_counts(now.of_node('go_to_goal')))
    outcome, ended = _outcome(routes, odometry.received[reached], ends)
    sent = [sent for sent, _ in routes if sent.rows]
    goals = [row for one in sent if not one.is_path for row in one.rows]
    return Timeline(
        run=run,
        time=seconds(run, odometry),
        breaks=breaks,
        goal=goal,
        goals=np.array(goals, dtype=np.intp),
        start=float(on_axis(run, [sent[0].received])[0]) if sent else np.nan,
        outcome=outcome,
        end=float(on_axis(run, [ended])[0]) if ended else np.nan,
        distance=np.hypot(*to_goal.T),
        bearing_error=np.where(reached, np.nan, wrap(np.arctan2(dy, dx) - theta)),
        goal_heading_error=np.where(
            np.isin(goal, last) & (counts > 0.0), wrap(targets[:, 2] - theta), np.nan
        ),
        paths=paths,
        path=np.asarray(errors.pop('path'), dtype=np.intp),
        **errors,
    )


def seconds(run: Run, series: Series) -> Array:
    """Place messages on the time axis, shape (n,) (s).

    Those without a stamp of their own count from when they were recorded, less the delay of the
    odometry then: the recorder's clock may be another one than the robot's.
    """
    odometry = run.odometry
    delay = np.interp(series.received, odometry.received, odometry.received - odometry.stamps)
    stamps = np.where(
        series.stamps == series.received,
        series.received - np.rint(delay).astype(np.int64),
        series.stamps,
    )
    return np.asarray((stamps - odometry.stamps[0]) / NANOSECONDS, dtype=np.float64)


def on_axis(run: Run, recorded: Sequence[int]) -> Array:
    """Place times of the recorder's clock (ns) on the time axis, shape (n,) (s)."""
    received = np.array(recorded, dtype=np.int64)
    return seconds(run, Series(received=received, stamps=received, values=np.empty((len(received), 0))))


def jumps(series: Series) -> Indices:
    """Return before which messages of odometry time goes back, or the robot is elsewhere at once."""
    stamps, values = series.stamps, series.values
    dt, step = np.diff(stamps) / NANOSECONDS, np.hypot(*np.diff(values[:, :2], axis=0).T)
    moving = (dt > 0.0) & (step > 0.0)
    usual = np.median(step[moving] / dt[moving]) if moving.any() else 0.0
    speed = np.abs(values[:, 3])
    fastest = np.maximum(np.fmax(speed[:-1], speed[1:]), usual)
    reset = (dt < 0.0) | (step > np.fmax(TELEPORT, 3.0 * fastest * dt))
    return np.flatnonzero(reset) + 1


def _outcome(routes: list[Followed], reached: Times, ends: Mapping[int, int]) -> tuple[GoalState, int]:
    """Return what became of the last goals or path, and when they ended (ns); 0: they did not.

    Args:
        routes: All of them.
        reached: When each odometry was recorded at which the last of some goals was reached (ns).
        ends: When the odometry was recorded at which the end of a path of unknown state was reached
            (ns), by its number.
    """
    if not routes:
        return GoalState.UNKNOWN, 0
    sent, followed = routes[-1]
    if followed.state is not GoalState.UNKNOWN:
        return followed.state, int(followed.since) if followed.state.ended else 0
    arrived = reached[reached >= sent.received]
    ended = ends.get(len(routes) - 1, int(arrived[0]) if len(arrived) else 0)
    return (GoalState.SUCCEEDED if ended else GoalState.UNKNOWN), ended


def _breaks(run: Run) -> Indices:
    """Return where the odometry is reset: after a start_pose, back in time, or by a teleport."""
    stamps, values = run.odometry.stamps, run.odometry.values
    reset = np.zeros(len(stamps) - 1, dtype=np.bool_)
    reset[jumps(run.odometry) - 1] = True
    received, starts = run.odometry.received, run.start_pose
    # Time goes back before these messages. Between them stamps do not decrease.
    back = run.odometry.back
    edges = [0, *back.tolist(), len(stamps)]
    passes = np.searchsorted(received[back - 1], starts.received).tolist()
    for which, at, stamp, pose in zip(
        passes, starts.received, starts.stamps, starts.values, strict=True
    ):
        begin, end = edges[which], edges[which + 1]
        if which and at < received[begin] and stamp >= stamps[begin - 1]:
            # It was published before time went back.
            begin, end = edges[which - 1], begin
        first = begin + int(np.searchsorted(stamps[begin:end], stamp))
        if first < end and stamps[first] == stamp:
            # A message with the same stamp may be from before the reset.
            first += not np.allclose(values[first, :2], pose[:2], rtol=0.0, atol=1e-9)
        if 0 < first < len(stamps):
            reset[first - 1] = True
    return np.flatnonzero(reset) + 1


def _over_time(run: Run, value: Callable[[Run], float]) -> Array:
    """Return what a function of the parameters is at each odometry, shape (n,)."""
    since, configurations = zip(*run.configurations(), strict=True)
    values = np.array([value(now) for now in configurations], dtype=np.float64)
    latest = np.searchsorted(since, run.odometry.received, side='right') - 1
    return np.asarray(values[np.maximum(latest, 0)])


def _progress(
    run: Run, breaks: Indices, routes: list[Followed]
) -> tuple[Indices, NDArray[np.bool_], Indices]:
    """Return for each odometry the goal driven to, whether it is reached, and the path driven along."""
    seen = run.odometry.received
    places = np.column_stack([_driven_points(run), _over_time(run, tolerance)])
    goal, reached = np.full(len(seen), -1), np.zeros(len(seen), dtype=bool)
    driven = np.full(len(seen), -1)
    known = len(run.goal_status) > 0 or bool(run.of_node('go_to_goal'))
    begins = [sent.received for sent, _ in routes]
    for which, ((sent, followed), begun, until) in enumerate(
        zip(routes, begins, [*begins, _NEVER][1:], strict=True)
    ):
        route, state = sent.rows, followed.state
        if not route:
            continue
        here, end = np.searchsorted(seen, [begun, until]).tolist()
        succeeded = state is GoalState.SUCCEEDED
        ended = state in (GoalState.CANCELED, GoalState.ABORTED) or (succeeded and sent.is_path)
        stop = min(end, int(np.searchsorted(seen, followed.since, side='right'))) if ended else end
        if sent.is_path:
            driven[here:stop] = which
            continue
        for target in route[:-1]:
            passed = _first_within(run, places, target, here, stop)
            if passed is None and here < stop and (succeeded or not known):
                passed = here + int(np.argmin(_distances(run, places[here:stop], target)))
            goal[here : stop if passed is None else passed] = target
            if passed is None:
                break
            here = passed
        else:
            goal[here:stop] = route[-1]
            within = _within(run, places[here:stop], route[-1])
            if (arrived := _arrival(within, followed, seen[here:stop])) is None:
                # The node still drives to it, even if the robot was near it once.
                continue
            over = breaks[(breaks > here + arrived) & (breaks <= stop)]
            if not succeeded:
                # A robot that had left the goal again only passed it.
                over = over[within[over - 1 - here]]
            left = min([stop, *over.tolist()])
            goal[left:end], reached[here + arrived : left] = -1, True
    return goal, reached, driven


def _along_paths(
    run: Run, routes: list[Followed], driven: Indices
) -> tuple[tuple[Path, ...], dict[int, int], dict[str, Array]]:
    """Return the paths, and the errors on them.

    Returns:
        The paths; when the end of those was reached of whose state nothing is known (ns), by the number
        of their route; and by the names of `Timeline` which is driven along, progress, errors and times.
    """
    paths: list[Path] = []
    ends: dict[int, int] = {}
    names = ('progress', 'along', 'across', 'path_heading_error', 'late', 'elapsed')
    errors = {name: np.full(len(driven), np.nan) for name in names}
    errors['path'] = np.full(len(driven), -1.0)
    poses, stamps = run.odometry.values[:, :3], run.odometry.stamps
    defaults = GoToGoalParameters()
    approach, longest = (
        run.number_of_node('go_to_goal', name, getattr(defaults, name))
        for name in ('path_approach_distance', 'odom_timeout')
    )
    before: tuple[Array, Indices] | None = None
    for which_route, (sent, followed) in enumerate(routes):
        if not sent.is_path:
            before = None
            continue
        rows = run.planned_path.values[sent.rows.start : sent.rows.stop]
        try:
            path = Path(rows[:, :3], None if np.isnan(rows[:, 3]).any() else rows[:, 3])
        except ValueError:
            # The node refuses it, too.
            continue
        here = np.flatnonzero(driven == which_route)
        if before is not None and np.array_equal(before[0], rows, equal_nan=True):
            # On the same path the node goes on where it is.
            here = np.concatenate([before[1], here])
            paths.pop()
        before = rows, here
        s = path.project(poses[here])
        if followed.state is GoalState.UNKNOWN:
            left = np.hypot(*(poses[here, :2] - path.poses[-1, :2]).T)
            at_end = (s >= path.length - tolerance(run)) & (left <= tolerance(run))
            if at_end.any():
                last = int(np.argmax(at_end))
                here, s = here[: last + 1], s[: last + 1]
                ends[which_route] = int(run.odometry.received[here[-1]])
        errors['path'][here] = len(paths)
        paths.append(path)
        placed = Path.errors(poses[here], path.poses_at(s))
        errors['progress'][here], errors['across'][here] = s, placed.across
        errors['path_heading_error'][here] = placed.heading
        if path.times is not None:
            dt = np.clip(np.diff(stamps[here], prepend=stamps[here][:1]) / NANOSECONDS, 0.0, None)
            elapsed = [0.0]
            for pose, step in zip(
                poses[here].tolist(), np.minimum(dt, longest or np.inf).tolist(), strict=True
            ):
                elapsed.append(path.time_after(elapsed[-1], pose, step, approach))
            errors['elapsed'][here] = elapsed[1:]
            errors['along'][here] = s - np.array([path.at_time(time).s for time in elapsed[1:]])
            errors['late'][here] = np.cumsum(dt) - np.minimum(elapsed[1:], path.duration)
    return tuple(paths), ends, errors


def _distances(run: Run, places: Array, target: int) -> Array:
    """Return the distance of each place from a goal, shape (n,) (m)."""
    return np.asarray(np.hypot(*(places[:, :2] - run.goals.values[target, :2]).T), dtype=np.float64)


def _within(run: Run, places: Array, target: int) -> Mask:
    """Return which places `[x, y, tolerance]` (m) count as arrived at a goal, shape (n,)."""
    return np.asarray(_distances(run, places, target) <= places[:, 2] + 1e-12)


def _first_within(run: Run, places: Array, target: int, begin: int, end: int) -> int | None:
    """Return the first place from `begin` until before `end` that counts as arrived; None: no place.

    The places are searched in blocks of growing size, so that the time is that of the places searched:
    a route whose waypoints are reached one after another takes one pass over the odometry.
    """
    size = 64
    while begin < end:
        within = _within(run, places[begin : min(begin + size, end)], target)
        if within.any():
            return begin + int(np.argmax(within))
        begin, size = begin + size, 2 * size
    return None


def _arrival(within: Mask, followed: FollowedGoal[Any], seen: Times) -> int | None:
    """Return since which place the robot was at its last goal, for good as far as is known; None: never.

    Args:
        within: Which places count as arrived.
        followed: What is known of the goal.
        seen: When each place was recorded (ns).
    """
    if followed.state is GoalState.SUCCEEDED:
        success = int(np.searchsorted(seen, followed.since))
        outside = np.flatnonzero(~within[: success + 1])
        return min(int(outside[-1]) + 1 if len(outside) else 0, success)
    if followed.fate is Fate.WAITING and within.any():
        return int(np.argmax(within))
    return None


class Sent(NamedTuple):
    """Goals or a path that came in one message."""

    received: int
    """When they were recorded (ns)."""
    rows: range
    """Rows of `run.goals` or of `run.planned_path`."""
    is_path: bool
    stamp: Stamp


Followed: TypeAlias = tuple[Sent, FollowedGoal[Sent]]


def _sent(run: Run, series: Series, most: int, *, is_path: bool) -> Iterator[Sent]:
    """Find which goals came in one message."""
    together = (np.diff(series.received) == 0) & (np.diff(series.stamps) == 0)
    edges = [0, *(np.flatnonzero(~together) + 1).tolist(), len(series)]
    stamps = _stamps(run, series)
    for pair in pairwise(edges):
        # Too many came in several messages at the same time, of which the last one counts.
        if rows := range(*pair)[-most:]:
            yield Sent(int(series.received[rows.start]), rows, is_path, stamps[rows.start])


def _routes(run: Run) -> list[Followed]:
    """Follow goals and paths in the order in which they came; those that were refused are left out.

    A message that was not recorded was sent when its goal was accepted, and has no rows.
    """
    statuses = run.goal_status
    routes = [
        *_sent(run, run.goals, MAX_WAYPOINTS, is_path=False),
        *_sent(run, run.planned_path, MAX_PATH_POSES, is_path=True),
    ]
    routes.sort(key=attrgetter('received'))
    values = statuses.values[:, 0].astype(int).tolist()
    reports = [*zip(values, _stamps(run, statuses), statuses.received.tolist(), strict=True)]
    follower: GoalFollower[Sent] = GoalFollower()
    received = [route.received for route in routes]
    answered = [*np.searchsorted(statuses.received, received).tolist(), len(reports)]
    for report in reports[: answered[0]]:
        follower.reported(*report)
    followed = []
    for route, (begin, end) in zip(routes, pairwise(answered), strict=True):
        followed.append((route, follower.sent(route, route.stamp)))
        for report in reports[begin:end]:
            before = follower.driving
            follower.reported(*report)
            driving = follower.driving
            if driving is not None and driving is not before and driving.goal is None:
                unrecorded = Sent(report[2], range(0), is_path=False, stamp=driving.stamp)
                followed.append((unrecorded, driving))
    return [one for one in followed if one[1].fate is not Fate.REFUSED]


def _stamps(run: Run, series: Series) -> list[Stamp]:
    """Return the stamps of goals or of their statuses; UNSTAMPED for those that are no stamps."""
    stamped = run.goal_status.stamps != run.goal_status.received
    known = (series.stamps != series.received) | np.isin(
        # They may have been received at the time of their stamp.
        series.stamps,
        run.goal_status.stamps[stamped],
    )
    return [divmod(stamp, NANOSECONDS) for stamp in np.where(known, series.stamps, 0).tolist()]


def _driven_points(run: Run) -> Array:
    """Return the point that the controller drives to the goal, shape (n, 2)."""
    x, y, theta = run.odometry.values[:, :3].T
    d = _over_time(run, _driven_offset)
    return np.column_stack([x + d * np.cos(theta), y + d * np.sin(theta)])


def _driven_offset(run: Run) -> float:
    """Return how far the driven point is ahead of the axle centre (m), 0 of a law of other packages.

    Reading a bag must not import these.
    """
    name = run.of_node('go_to_goal').get('controller')
    controller = CONTROLLERS.built_in.get(name) if isinstance(name, str) else None
    if controller is None or not controller.offset:
        return 0.0
    default = controller.driven_offset(controller.defaults)
    return run.number_of_node('go_to_goal', controller.offset, default)


def heading_counts(parameters: Mapping[str, Any]) -> bool:
    """Return whether a controller with these parameters turns to the heading of its last goal."""
    controller = CONTROLLERS.built_in.get(str(parameters.get('controller')))
    takes_heading = controller is not None and controller.takes_heading
    return parameters.get('use_goal_heading') is True or takes_heading


def tolerance(run: Run) -> float:
    """Return the distance from a goal that counts as arrived at the beginning (m)."""
    default = GoToGoalParameters().xy_goal_tolerance
    return run.number_of_node('go_to_goal', 'xy_goal_tolerance', default)
