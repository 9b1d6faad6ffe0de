"""A bag as a source of the page: time that plays, pauses and jumps."""

from __future__ import annotations

import time
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.bags.timeline import jumps
from diffdrive_jacobian.control.controllers import BUILT_IN
from diffdrive_jacobian.live import settings
from diffdrive_jacobian.live.commands import Command, Pause, Seek, SetSpeed, Step
from diffdrive_jacobian.live.quantities import rounded
from diffdrive_jacobian.live.recorded_runs import RecordedRobot
from diffdrive_jacobian.live.robot_state import TRUTH_LIFE, RobotState
from diffdrive_jacobian.live.session import Session, Snapshot
from diffdrive_jacobian.live.trail import MAX_POINTS, Trail
from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.messages.topics import SENSORS

Array = NDArray[np.float64]
PERIOD = 1.0 / 30.0
"""Time between two states (s)."""
STEP = 0.02
"""Duration of a step, unless the odometry says otherwise (s)."""
COMMAND_LIFE, WHEELS_LIFE = 0.5, 1.0
"""Time for which a recorded cmd_vel and joint_states count (s)."""
STRIP_POINTS = 1500
"""Largest number of points of a curve over time."""


class BagPlayer:
    """Plays the robots of a bag."""

    def __init__(
        self, session: Session, path: Path, robots: Sequence[RecordedRobot], *, speed: float = 1.0
    ) -> None:
        """Start at the beginning, playing.

        Args:
            session: What the page shows, and where its commands come from.
            path: The bag, for its name.
            robots: Its robots, at least one.
            speed: Speed relative to the clock on the wall.
        """
        self._session = session
        self._films = [_Film(robot) for robot in robots]
        self._end = max(float(robot.time[-1]) for robot in robots)
        self.time, self.speed, self.paused = 0.0, speed, False
        """Present time (s), speed, and whether it stands."""
        self._last = time.monotonic()
        self._shown: object = None
        self._fixed = {
            'bag': path.name,
            'strips': {film.robot.name: film.strips() for film in self._films},
            'settings': {film.robot.name: film.settings() for film in self._films},
            'notes': [note for film in self._films for note in film.robot.run.notes][:5],
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
        self._session.store(
            Snapshot(
                robots=[film.shown(self.time) for film in self._films],
                trails={film.robot.name: film.trail for film in self._films},
                true_trails={film.robot.name: film.true_trail for film in self._films},
                world={
                    'kind': 'bag',
                    'time': round(self.time, 3),
                    'duration': round(self._end, 3),
                    'paused': self.paused,
                    'speed': self.speed,
                },
                fixed=self._fixed,
            )
        )

    def _obey(self, command: Command) -> None:
        if isinstance(command, Pause):
            self.paused = command.paused
            if not self.paused and self.time >= self._end:
                self.time = 0.0
        elif isinstance(command, Step):
            self.paused = True
            self.time = min([film.next(self.time) for film in self._films] + [self._end])
        elif isinstance(command, SetSpeed):
            self.speed = command.speed
        elif isinstance(command, Seek):
            self.time = min(command.time, self._end)
        else:
            self._session.notify('this is a recording: it cannot be steered', 'warning')


def _trail(times: Array, poses: Array, breaks: NDArray[np.intp]) -> tuple[Trail, list[float]]:
    """Return a path with a bounded number of points, and the time of each (s).

    Args:
        times: Time of each pose, shape (n,) (s).
        poses: `[x, y, ...]`, shape (n, k) (m).
        breaks: Indices of the poses before which the path is interrupted.
    """
    trail, at = Trail(), []
    step = max(1, len(times) // MAX_POINTS)
    broken = set(breaks.tolist())
    for index in range(0, len(times), step):
        if any(one in broken for one in range(index - step + 1, index + 1)) and trail.points:
            trail.points.append(None)
            at.append(float(times[index]))
        x, y = poses[index, :2].tolist()
        trail.points.append((round(x, 4), round(y, 4)))
        at.append(float(times[index]))
    return trail, at


class _Film:
    """One robot of a bag, at any time."""

    def __init__(self, robot: RecordedRobot) -> None:
        self.robot, run = robot, robot.run
        self._state = RobotState(robot.name)
        self._configurations = list(run.configurations())
        self._configure(0)
        self._commands, self._wheels = robot.times(run.cmd_vel), robot.times(run.wheels)
        self._statuses = robot.run.goal_status.received
        self._sensors = {topic: robot.times(getattr(run, topic.series)) for topic in SENSORS}
        self._truths = np.maximum.accumulate(robot.times(run.ground_truth))
        self.trail, self._trail_times = _trail(robot.time, run.odometry.values, robot.trace.breaks)
        self.true_trail, self._true_times = _trail(
            self._truths, run.ground_truth.values, jumps(run.ground_truth)
        )

    def next(self, time: float) -> float:
        """Return the time of the next odometry (s)."""
        index = int(np.searchsorted(self.robot.time, time + 1e-9, side='right'))
        return float(self.robot.time[index]) if index < len(self.robot.time) else time + STEP

    def shown(self, time: float) -> dict[str, Any]:
        """Return the JSON object of the robot at a time (s)."""
        robot, run, state = self.robot, self.robot.run, self._state
        index = robot.index(time)
        self._configure(int(run.odometry.received[index]))
        values = run.odometry.values[index]
        state.time = float(robot.time[index])
        state.pose, state.twist = values[:3], (float(values[3]), float(values[4]))
        state.covariance = robot.covariance[index]
        state.command = robot.latest(self._commands, run.cmd_vel, time, COMMAND_LIFE)
        state.wheels = robot.latest(self._wheels, run.wheels, time, WHEELS_LIFE)
        for topic, times in self._sensors.items():
            latest = int(np.searchsorted(times, time, side='right')) - 1
            values = getattr(run, topic.series).values[latest].tolist() if latest >= 0 else []
            state.readings.update(zip(topic.columns, values, strict=False))
        self._set_goal(index)
        latest = int(np.searchsorted(self._truths, time, side='right')) - 1
        known = latest >= 0 and time - self._truths[latest] < TRUTH_LIFE
        state.truth = run.ground_truth.values[latest, :3] if known else None
        travelled, truly = (
            int(np.searchsorted(times, time, side='right'))
            for times in (self._trail_times, self._true_times)
        )
        age = max(0.0, time - state.time)
        shown = state.shown(age=age, by_hand=False, travelled=travelled, truly_travelled=truly)
        assert shown is not None
        return shown

    def _configure(self, received: int) -> None:
        """Take the parameters as of a time of recording (ns)."""
        latest = bisect_right(self._configurations, received, key=itemgetter(0)) - 1
        _, run = self._configurations[max(latest, 0)]
        self._state.controller_values = run.of_node('go_to_goal')
        self._state.robot_values = run.of_node('virtual_robot')

    def _set_goal(self, index: int) -> None:
        run, trace, goal = self.robot.run, self.robot.trace, self._state.goal
        number = int(trace.goal[index])
        if number < 0:
            goal.goals, goal.index, goal.state = None, 0, GoalState.UNKNOWN
            return
        stamp = run.goals.received[number]
        route = np.flatnonzero(run.goals.received == stamp)
        goal.goals = run.goals.values[route]
        goal.index = int(np.searchsorted(route, number))
        reached = bool(np.isnan(trace.bearing_error[index]))
        goal.state = GoalState.SUCCEEDED if reached else GoalState.EXECUTING

    def settings(self) -> list[dict[str, Any]]:
        """Return the recorded parameters that the page shows."""
        state = self._state
        # Of another package it may be missing here, or a later one.
        controller = BUILT_IN.get(str(state.controller_values.get('controller', '')))
        values = state.controller_values
        return settings.shown(
            {'controller': values, 'robot': state.robot_values},
            controller.gains if controller else settings.recorded_gains(values),
        )

    def strips(self) -> Mapping[str, Any]:
        """Return the curves over the whole bag."""
        robot, run, trace = self.robot, self.robot.run, self.robot.trace
        chosen = np.unique(np.linspace(0, len(robot.time) - 1, STRIP_POINTS).astype(np.intp))
        at = robot.time[chosen]
        curves: dict[str, Array] = {
            'time': at,
            'v': run.odometry.values[chosen, 3],
            'omega': run.odometry.values[chosen, 4],
            'distance': trace.distance[chosen],
            'bearing_error': trace.bearing_error[chosen],
            'goal_heading_error': trace.goal_heading_error[chosen],
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
