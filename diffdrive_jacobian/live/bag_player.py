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

"""A bag as a source of the page: time that plays, pauses and jumps. No ROS is needed."""

from __future__ import annotations

import time
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from contextlib import closing
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.bags.bag_reader import BagError, open_bag
from diffdrive_jacobian.bags.run import Run, Series, read_run
from diffdrive_jacobian.bags.timeline import jumps, seconds, timeline
from diffdrive_jacobian.live.commands import Command, Pause, Seek, SetSpeed, Step
from diffdrive_jacobian.live.quantities import rounded
from diffdrive_jacobian.live.robot_state import MAX_POINTS, TRUTH_LIFE, RobotState, Trail
from diffdrive_jacobian.live.server import LiveServer, Ready
from diffdrive_jacobian.live.session import Session, Share, Snapshot
from diffdrive_jacobian.messages.conversion import MessageError, from_covariance
from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.messages.names import base_name, namespace_of
from diffdrive_jacobian.messages.topics import TOPICS
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.time_units import NANOSECONDS

Array = NDArray[np.float64]
PERIOD = 1.0 / 30.0
"""Time between two states (s)."""
STEP = 0.02
"""Duration of a step, unless the odometry says otherwise (s)."""
COMMAND_LIFE, WHEELS_LIFE = 0.5, 1.0
"""Time for which a recorded cmd_vel and joint_states count (s)."""
STRIP_POINTS = 1500
"""Largest number of points of a curve over time."""
MAX_ROBOTS = 16
"""Largest number of robots that are shown."""


def watch_bag(
    path: Path, *, port: int, speed: float, signals: Signals, ready: Ready, share: Share | None = None
) -> None:
    """Play a bag on the page.

    Args:
        path: The bag.
        port: TCP port. 0: any free one.
        speed: Speed at the start.
        signals: Counter of the signals that end it.
        ready: Receives the server when it answers.
        share: With whom the page is shared. None: with nobody.

    Raises:
        BagError: It is not a bag, is damaged, or has no odometry.
        OSError: The port is in use.
    """
    session = Session()
    player = BagPlayer(session, path, read_robots(path), speed=speed)
    with closing(LiveServer(session, port, share)) as server:
        ready(server)
        while not signals.count:
            player.work()
            time.sleep(PERIOD)


class BagPlayer:
    """Plays the robots of a bag."""

    def __init__(
        self, session: Session, path: Path, robots: Sequence[RecordedRobot], *, speed: float = 1.0
    ) -> None:
        """Start at the beginning of a bag, at a speed relative to the clock on the wall."""
        self._session, self._robots = session, robots
        self._end = max(float(robot.time[-1]) for robot in robots)
        self.time, self.speed, self.paused = 0.0, speed, False
        """Present time (s), speed, and whether it stands."""
        self._last = time.monotonic()
        self._shown: object = None
        self._fixed = {
            'bag': path.name,
            'strips': {robot.name: robot.strips() for robot in robots},
            'notes': [note for robot in robots for note in robot.run.notes][:5],
        }

    def work(self) -> None:
        """Obey the page, advance, and store the state; to be called every PERIOD."""
        for _, command in self._session.take_commands():
            self._obey(command)
        now = time.monotonic()
        self.advance(now - self._last)
        self._last = now

    def advance(self, elapsed: float) -> None:
        """Advance by a time on the wall (s), and store the state if it is new."""
        if not self.paused:
            self.time = min(self._end, self.time + elapsed * self.speed)
            self.paused = self.time >= self._end
        state = self.time, self.speed, self.paused
        if state == self._shown:
            return
        self._shown = state
        shown = [robot.shown(self.time) for robot in self._robots]
        settings = {robot.name: robot.state.settings(imported=False) for robot in self._robots}
        self._session.store(
            Snapshot(
                robots=shown,
                trails={robot.name: robot.trail for robot in self._robots},
                true_trails={robot.name: robot.true_trail for robot in self._robots},
                world={
                    'kind': 'bag',
                    'time': round(self.time, 3),
                    'duration': round(self._end, 3),
                    'paused': self.paused,
                    'speed': self.speed,
                },
                fixed={**self._fixed, 'settings': settings},
            )
        )

    def _obey(self, command: Command) -> None:
        if isinstance(command, Pause):
            self.paused = command.paused
            if not self.paused and self.time >= self._end:
                self.time = 0.0
        elif isinstance(command, Step):
            self.paused = True
            self.time = min([robot.next(self.time) for robot in self._robots] + [self._end])
        elif isinstance(command, SetSpeed):
            self.speed = command.speed
        elif isinstance(command, Seek):
            self.time = min(command.time, self._end)
        else:
            self._session.notify('this is a recording: it cannot be steered', 'warning')


# --- Robots


def read_robots(path: Path) -> list[RecordedRobot]:
    """Read all robots of a bag.

    Raises:
        BagError: It is not a bag, is damaged, or has no odometry.
    """
    with open_bag(path) as reader:
        topics = {one.topic for one in reader.connections if one.msgtype in TOPICS['odom'].types}
    namespaces = sorted({namespace_of(topic) for topic in topics if base_name(topic) == 'odom'})
    if len(namespaces) > MAX_ROBOTS:
        raise BagError(f'{path} has {len(namespaces)} robots, at most {MAX_ROBOTS} can be shown')
    runs, notes = {}, list[str]()
    for namespace in namespaces:
        # The other topics of a single robot may have another namespace.
        run = read_run(path, namespace=namespace if len(namespaces) > 1 else None)
        if len(run.odometry):
            runs[namespace] = run
        notes += run.notes
    if not runs:
        why = f'no valid message on a topic odom of {TOPICS["odom"].types[0]}'
        raise BagError('; '.join([f'{path} has no odometry: {why}', *notes]))
    first = min(run.odometry.stamps[0] for run in runs.values())
    return [
        RecordedRobot(namespace, run, float(run.odometry.stamps[0] - first) / NANOSECONDS)
        for namespace, run in runs.items()
    ]


class RecordedRobot:
    """One robot of a bag, at any time. Times are seconds since the first odometry of the bag."""

    def __init__(self, name: str, run: Run, start: float) -> None:
        """Take a run of a namespace whose first odometry has the time `start` (s)."""
        self.name, self.run, self.start = name, run, start
        self._line = timeline(run)
        self.time = np.maximum.accumulate(self._line.time + start)
        """Of each odometry, shape (n,) (s), never decreasing."""
        self._covariance = _covariances(run)
        self.state = RobotState(name)
        self._configurations = list(run.configurations())
        self._configure(0)
        self._commands, self._wheels = self._times(run.cmd_vel), self._times(run.wheels)
        self._truths = np.maximum.accumulate(self._times(run.ground_truth))
        self.trail, self._trail_times = _trail(self.time, run.odometry.values, self._line.breaks)
        self.true_trail, self._true_times = _trail(
            self._truths, run.ground_truth.values, jumps(run.ground_truth)
        )

    def _times(self, series: Series) -> Array:
        """Return the times of messages, shape (n,) (s)."""
        return seconds(self.run, series) + self.start

    def next(self, time: float) -> float:
        """Return the time of the next odometry (s)."""
        index = _count(self.time, time + 1e-9)
        return float(self.time[index]) if index < len(self.time) else time + STEP

    def shown(self, time: float) -> dict[str, Any]:
        """Return the JSON object of the robot at a time (s)."""
        run, state = self.run, self.state
        index = max(0, _count(self.time, time) - 1)
        self._configure(int(run.odometry.received[index]))
        *pose, v, omega = run.odometry.values[index].tolist()
        state.time = float(self.time[index])
        state.pose, state.twist = np.array(pose), (v, omega)
        state.covariance = self._covariance[index]
        state.command = _latest(self._commands, run.cmd_vel, time, COMMAND_LIFE)
        state.wheels = _latest(self._wheels, run.wheels, time, WHEELS_LIFE)
        self._set_goal(index)
        latest = _count(self._truths, time) - 1
        known = latest >= 0 and time - self._truths[latest] < TRUTH_LIFE
        state.truth = run.ground_truth.values[latest, :3] if known else None
        shown = state.shown(age=max(0.0, time - state.time), by_hand=False)
        assert shown is not None
        shown['travelled'] = _count(self._trail_times, time)
        shown['truly_travelled'] = _count(self._true_times, time)
        return shown

    def _configure(self, received: int) -> None:
        """Take the parameters as of a time of recording (ns)."""
        latest = bisect_right(self._configurations, received, key=itemgetter(0)) - 1
        _, run = self._configurations[max(latest, 0)]
        self.state.controller_values = run.of_node('go_to_goal')
        self.state.robot_values = run.of_node('virtual_robot')

    def _set_goal(self, index: int) -> None:
        run, line, goal = self.run, self._line, self.state.goal
        on_path = np.flatnonzero(line.path[: index + 1] >= 0)
        goals = np.flatnonzero(line.goal[: index + 1] >= 0)
        if len(on_path) and not (len(goals) and goals[-1] > on_path[-1]):
            # Also after its end: it has succeeded, or not.
            last, state = int(on_path[-1]), GoalState.EXECUTING
            if last < index:
                now, known = run.odometry.received[index], run.goal_status
                seen = int(np.searchsorted(known.received, now, side='right'))
                state = GoalState(int(known.values[seen - 1, 0])) if seen else line.outcome
            goal.replay(line.paths[line.path[last]], 0, state)
            path = goal.path
            assert path is not None
            path.s, path.across = float(line.progress[last]), float(line.across[last])
            path.heading = float(line.path_heading_error[last])
            path.elapsed = float(line.elapsed[last])
            path.along, path.late = float(line.along[last]), float(line.late[last])
            return
        number = int(line.goal[index])
        if number < 0:
            goal.replay(None, 0, GoalState.UNKNOWN)
            return
        route = np.flatnonzero(run.goals.received == run.goals.received[number])
        reached = bool(np.isnan(line.bearing_error[index]))
        state = GoalState.SUCCEEDED if reached else GoalState.EXECUTING
        goal.replay(run.goals.values[route], int(np.searchsorted(route, number)), state)

    def strips(self) -> Mapping[str, Any]:
        """Return the curves over the whole bag."""
        run, line = self.run, self._line
        chosen = np.unique(np.linspace(0, len(self.time) - 1, STRIP_POINTS).astype(np.intp))
        at = self.time[chosen]
        curves: dict[str, Array] = {
            'time': at,
            'v': run.odometry.values[chosen, 3],
            'omega': run.odometry.values[chosen, 4],
            'distance': line.distance[chosen],
            'bearing_error': line.bearing_error[chosen],
            'goal_heading_error': line.goal_heading_error[chosen],
            'across': line.across[chosen],
            'along': line.along[chosen],
            'late': line.late[chosen],
            'path_heading_error': line.path_heading_error[chosen],
        }
        for names, times, series in (
            (('command_v', 'command_omega'), self._commands, run.cmd_vel),
            (('right', 'left'), self._wheels, run.wheels),
        ):
            if not len(series):
                continue
            index = np.searchsorted(times, at, side='right') - 1
            for column, name in enumerate(names):
                curve = series.values[np.maximum(index, 0), column].copy()
                curve[(index < 0) | (at - times[np.maximum(index, 0)] > COMMAND_LIFE)] = np.nan
                curves[name] = curve
        return {name: rounded(curve) for name, curve in curves.items()}


def _count(times: Array, time: float) -> int:
    """Return how many of ascending times are not later than a time."""
    return int(np.searchsorted(times, time, side='right'))


def _latest(times: Array, series: Series, time: float, life: float) -> tuple[float, float] | None:
    """Return the last values of a series of pairs at a time (s). None: older than `life` (s)."""
    index = _count(times, time) - 1
    if index < 0 or time - times[index] > life:
        return None
    first, second = series.values[index, :2].tolist()
    return first, second


def _covariances(run: Run) -> Array:
    """Return the covariance of the pose at each odometry, shape (n, 3, 3); zero where it is invalid."""
    matrices = run.odometry_covariances[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    for matrix in matrices:
        try:
            matrix[:] = from_covariance(matrix)
        except MessageError:
            matrix[:] = 0.0
    return matrices


def _trail(times: Array, poses: Array, breaks: NDArray[np.intp]) -> tuple[Trail, Array]:
    """Return a path with a bounded number of points, interrupted before some, and their times (s)."""
    trail, at = Trail(), list[float]()
    step = max(1, len(times) // MAX_POINTS)
    broken = set(breaks.tolist())
    for index in range(0, len(times), step):
        if trail.points and not broken.isdisjoint(range(index - step + 1, index + 1)):
            trail.points.append(None)
            at.append(float(times[index]))
        x, y = poses[index, :2].tolist()
        trail.points.append((round(x, 4), round(y, 4)))
        at.append(float(times[index]))
    return trail, np.array(at)
