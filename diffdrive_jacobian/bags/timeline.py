"""A run as numbers over time.

Times are seconds since the first odometry, by its own stamps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.bags.run import Run, Series
from diffdrive_jacobian.control.controllers import BUILT_IN
from diffdrive_jacobian.messages.conversion import MAX_WAYPOINTS
from diffdrive_jacobian.messages.goal_follower import Fate, FollowedGoal, GoalFollower, Stamp
from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.numerics.elementary import wrap
from diffdrive_jacobian.parameters.go_to_goal import GoToGoalParameters
from diffdrive_jacobian.time_units import NANOSECONDS

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

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
    distance: Array
    """To that goal, of the point that the controller drives (m); NaN: none."""
    bearing_error: Array
    """From the heading to the direction of that goal (rad); NaN: none, or it is reached."""
    goal_heading_error: Array
    """From the heading to that of the goal (rad); NaN: none, or its heading does not count."""


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

    Raises:
        BagError: There is no odometry.
    """
    odometry = run.odometry
    if not len(odometry):
        raise run.lacking('odometry: no valid message on a topic odom of nav_msgs/msg/Odometry')
    breaks = _breaks(run)
    goal, reached = _progress(run, breaks)
    x, y, theta = odometry.values[:, :3].T
    targets = np.full((len(odometry), 3), np.nan)
    targets[goal >= 0] = run.goals.values[goal[goal >= 0]]
    dx, dy = targets[:, 0] - x, targets[:, 1] - y
    to_goal = targets[:, :2] - _driven_points(run)
    last = [route[-1] for _, route, _ in _routes(run) if route]
    counts = _over_time(run, lambda now: heading_counts(now.of_node('go_to_goal')))
    return Timeline(
        run=run,
        time=seconds(run, odometry),
        breaks=breaks,
        goal=goal,
        distance=np.hypot(*to_goal.T),
        bearing_error=np.where(reached, np.nan, wrap(np.arctan2(dy, dx) - theta)),
        goal_heading_error=np.where(
            np.isin(goal, last) & (counts > 0.0), wrap(targets[:, 2] - theta), np.nan
        ),
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


def _breaks(run: Run) -> Indices:
    """Return where the odometry is reset: after a start_pose, back in time, or by a teleport."""
    stamps, values = run.odometry.stamps, run.odometry.values
    reset = np.zeros(len(stamps) - 1, dtype=np.bool_)
    reset[jumps(run.odometry) - 1] = True
    received, starts = run.odometry.received, run.start_pose
    # Time goes back before these messages. Between them stamps do not decrease.
    back = np.flatnonzero(np.diff(stamps) < 0) + 1
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
    changes = [(since, value(now)) for since, now in run.configurations()]
    since, values = np.array([one for one, _ in changes]), np.array([one for _, one in changes])
    latest = np.searchsorted(since, run.odometry.received, side='right') - 1
    return np.asarray(values[np.maximum(latest, 0)], dtype=np.float64)


def _progress(run: Run, breaks: Indices) -> tuple[Indices, NDArray[np.bool_]]:
    """Return for each odometry which goal is driven to, -1 for none, and whether it is reached."""
    seen = run.odometry.received
    places = np.column_stack([_driven_points(run), _over_time(run, tolerance)])
    goal, reached = np.full(len(seen), -1), np.zeros(len(seen), dtype=bool)
    known = len(run.goal_status) > 0 or bool(run.of_node('go_to_goal'))
    routes = _routes(run)
    begins = [begun for begun, *_ in routes]
    for (begun, route, followed), until in zip(routes, [*begins, _NEVER][1:], strict=True):
        if not route:
            continue
        state = followed.state
        here, end = np.searchsorted(seen, [begun, until]).tolist()
        stop = end
        if state in (GoalState.CANCELED, GoalState.ABORTED):
            stop = min(stop, int(np.searchsorted(seen, followed.since, side='right')))
        succeeded = state is GoalState.SUCCEEDED
        for target in route[:-1]:
            next_here = _first_within(run, places, target, here, stop)
            if next_here is None and here < stop and (succeeded or not known):
                next_here = here + int(np.argmin(_distances(run, places[here:stop], target)))
            goal[here : stop if next_here is None else next_here] = target
            if next_here is None:
                break
            here = next_here
        else:
            last, begin = route[-1], here
            goal[begin:stop] = last
            within = _within(run, places[begin:stop], last)
            if succeeded:
                here += _arrival(within, int(np.searchsorted(seen, followed.since)) - begin)
            elif within.any() and followed.fate is Fate.WAITING:
                here += int(np.argmax(within))
            else:
                # The node still drives to it, even if the robot was near it once.
                continue
            over = breaks[(breaks > here) & (breaks <= stop)]
            if not succeeded:
                # A robot that had left the goal again only passed it.
                over = over[within[over - 1 - begin]]
            stop = min([stop, *over.tolist()])
            goal[stop:end], reached[here:stop] = -1, True
    return goal, reached


def _distances(run: Run, places: Array, target: int) -> Array:
    """Return the distance of each place from a goal, shape (n,) (m)."""
    return np.asarray(np.hypot(*(places[:, :2] - run.goals.values[target, :2]).T), dtype=np.float64)


def _within(run: Run, places: Array, target: int) -> Mask:
    """Return for each place whether it counts as arrived at a goal, shape (n,).

    Args:
        run: The run.
        places: `[x, y, tolerance]` of each, shape (n, 3) (m).
        target: The goal.
    """
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


def _arrival(within: Mask, success: int) -> int:
    """Return since which place the robot was at the goal when the node reported success there."""
    outside = np.flatnonzero(~within[: success + 1])
    return min(int(outside[-1]) + 1 if len(outside) else 0, success)


def _routes(run: Run) -> list[tuple[int, range, FollowedGoal[range]]]:
    """Find which goals came in one message, and follow them; those that were refused are left out.

    Returns:
        When each message was recorded (ns), the indices of its goals, and what became of them. Of a
        message that was not recorded: when its goal was accepted, and no indices.
    """
    goals, statuses = run.goals, run.goal_status
    together = (np.diff(goals.received) == 0) & (np.diff(goals.stamps) == 0)
    edges = [0, *(np.flatnonzero(~together) + 1).tolist(), len(goals)]
    # Too many came in several messages at the same time, of which the last one counts.
    routes = [range(*pair)[-MAX_WAYPOINTS:] for pair in pairwise(edges) if len(range(*pair))]
    received = goals.received[[route.start for route in routes]]
    reports = [
        *zip(
            statuses.values[:, 0].astype(int).tolist(),
            _stamps(run, statuses),
            statuses.received.tolist(),
            strict=True,
        )
    ]
    follower: GoalFollower[range] = GoalFollower()
    answered: list[int] = np.searchsorted(statuses.received, received).tolist()
    answered.append(len(reports))
    for report in reports[: answered[0]]:
        follower.reported(*report)
    stamps, found = _stamps(run, goals), []
    for route, begun, (begin, end) in zip(routes, received.tolist(), pairwise(answered), strict=True):
        found.append((begun, route, follower.sent(route, stamps[route.start])))
        for report in reports[begin:end]:
            before = follower.driving
            follower.reported(*report)
            driving = follower.driving
            if driving is not None and driving is not before and driving.goal is None:
                found.append((report[2], range(0), driving))
    return [one for one in found if one[2].fate is not Fate.REFUSED]


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
    """Return the point that the controller drives to the goal, shape (n, 2).

    It is the axle centre if the controller is not built in. Its package may not be installed here, and
    reading a bag must not import it.
    """
    x, y, theta = run.odometry.values[:, :3].T
    d = _over_time(run, _driven_offset)
    return np.column_stack([x + d * np.cos(theta), y + d * np.sin(theta)])


def _driven_offset(run: Run) -> float:
    """Return how far the driven point is ahead of the axle centre (m)."""
    name = run.of_node('go_to_goal').get('controller')
    controller = BUILT_IN.get(name) if isinstance(name, str) else None
    if controller is None or not controller.offset:
        return 0.0
    default = controller.driven_offset(controller.defaults)
    return run.number_of_node('go_to_goal', controller.offset, default)


def heading_counts(parameters: Mapping[str, Any]) -> bool:
    """Return whether a controller with these parameters turns to the heading of its last goal."""
    controller = BUILT_IN.get(str(parameters.get('controller')))
    takes_heading = controller is not None and controller.takes_heading
    return parameters.get('use_goal_heading') is True or takes_heading


def tolerance(run: Run) -> float:
    """Return the distance from a goal that counts as arrived at the beginning (m)."""
    default = GoToGoalParameters().xy_goal_tolerance
    return run.number_of_node('go_to_goal', 'xy_goal_tolerance', default)
