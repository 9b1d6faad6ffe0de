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

"""A recorded run, driven again: the robot at each of its odometry messages, simulated from the commands.

`cmd_vel_out` has each command as it was applied, after limits and timeout, with the time it took effect.
So no parameter is needed, but for robots with limits of the acceleration, a lag or a delay. Those are
taken from the parameters, their changes, and the faults of the motors in a lockstep world. Without
`cmd_vel_out` the commands take effect when they were recorded, with the limits and the timeout of the
parameters.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.bags.bag_reader import BagError
from diffdrive_jacobian.bags.recorded_robot import (
    MARGIN,
    ROBOT,
    recorded_dynamics,
    recorded_model,
    start_covariances,
)
from diffdrive_jacobian.bags.run import Run, Series
from diffdrive_jacobian.errors import InterruptionError
from diffdrive_jacobian.messages.conversion import MessageError, plausible_twist
from diffdrive_jacobian.messages.names import base_name
from diffdrive_jacobian.numerics.elementary import wrap
from diffdrive_jacobian.parameters.virtual_robot import VirtualRobotParameters
from diffdrive_jacobian.simulation.robot import Robot, RobotModel
from diffdrive_jacobian.time_units import NANOSECONDS

FIRST = NANOSECONDS // 2
"""Within this time after its start a robot that stands has not been driven elsewhere (ns)."""
_MAX_CANDIDATES = 32
"""Largest number of commands among which the last one that preceded an odometry message is sought."""
_NEVER = int(np.iinfo(np.int64).max)


class Event(NamedTuple):
    """The robot after a command or a placement, and when that was recorded (ns)."""

    robot: Robot
    received: int
    is_command: bool = False
    """Whether its twist is that of a recorded command."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Driven:
    """What moves a recorded robot."""

    source: str
    """The topic of the commands."""
    start: str
    """The topic of the start: `start_pose` or `odometry`."""
    epochs: list[list[Event]]
    """The events from the start on, and anew from each time at which time went back."""
    missed: bool = False
    """Whether the recorder has missed commands, so that the start is later than the recording's."""


def driven_again(run: Run, parameters: Mapping[str, Any] | None) -> Driven:
    """Return what moved a robot, by `cmd_vel_out` if that was recorded, else by its commands.

    Raises:
        BagError, ParameterError: As of `verification.verify`.
    """
    return _applied(run) if len(run.cmd_vel_out) else _commanded(run, parameters)


def robots_at_odometry(
    run: Run, driven: Driven, interrupted: Callable[[], bool]
) -> Iterator[tuple[int, int, Robot]]:
    """Yield, for each odometry message since the start, its index, its epoch, and the robot then.

    Raises:
        InterruptionError: `interrupted` returned True.
        BagError: The odometry has other epochs, or none of its messages is later than a command.
    """
    stamps, epochs = run.odometry.stamps, driven.epochs
    # How often time went back before each message.
    of_message = np.searchsorted(run.odometry.back, range(len(stamps)), side='right').tolist()
    if of_message[-1] >= len(epochs):
        raise BagError(
            f'{run.path} cannot be followed: time goes back {of_message[-1]} times in the odometry, but '
            f'the robot was restarted {len(epochs) - 1} times. Where /clock goes back, '
            'record without use_sim_time'
        )
    first_commands = [
        next((event.robot.stamp for event in events if event.is_command), _NEVER) for events in epochs
    ]
    followed = False
    for index, epoch in enumerate(of_message):
        if interrupted():
            raise InterruptionError
        robot = _nearest(epochs[epoch], run.odometry, index)
        if robot is not None:
            followed |= int(stamps[index]) > first_commands[epoch]
            yield index, epoch, robot
    if not followed:
        raise BagError(
            f'{run.path} has no odometry after the first command on {driven.source}, so that no motion '
            'can be verified (are their stamps of different clocks?)'
        )


def _nearest(events: list[Event], odometry: Series, index: int) -> Robot | None:
    """Return the robot at the stamp of an odometry message; None: it starts later.

    A command that took effect before that stamp, but was recorded no sooner than the message, may have
    reached the robot after it sent the message, or only the recorder late. Which was published first is
    unknown then, and the robot that is nearer to the odometry counts. Of many such commands only the
    latest ones are considered, so that the time of a verification is linear in the number of messages.
    """
    stamp, received = int(odometry.stamps[index]), int(odometry.received[index])
    last = bisect_right(events, stamp, key=lambda event: event.robot.stamp) - 1
    if last < 0:
        return None
    latest = events[last].robot
    robot = latest.at(stamp)
    candidates = [robot]
    # The first one is the start of the robot, the others are in the order of their recording.
    known = bisect_left(events, received, 1, last + 1, key=lambda event: event.received) - 1
    if known < last:
        earlier = range(max(known, last + 1 - _MAX_CANDIDATES), last)
        candidates += [events[one].robot.at(stamp) for one in earlier]
    if robot.model.takes_time and robot.twist != tuple(odometry.values[index, 3:5]):
        # At the very time of a jump, the last bit of a time decides which speed is reported.
        candidates += [latest.at(one) for one in (stamp - 1, stamp + 1) if one >= latest.stamp]
    if len(candidates) == 1:
        return robot

    def apart(candidate: Robot) -> float:
        state = np.array([*candidate.pose_tuple, *candidate.twist])
        difference = odometry.values[index] - state
        difference[2] = wrap(difference[2])
        return float(np.hypot(difference[0], difference[1]) + np.abs(difference[2:]).sum())

    return min(candidates, key=apart)


# --- By the commands as they were applied


class _Row(NamedTuple):
    """A message of `cmd_vel_out` or `start_pose`, in the order of recording."""

    received: int
    stamp: int
    values: NDArray[np.float64]
    """`[v, omega]`, or `[x, y, theta]` and the covariance by rows."""
    model: RobotModel | None
    """How the robot follows commands from this one on. None: it is a start."""


def _applied(run: Run) -> Driven:
    """Return the robot after each event of `cmd_vel_out` and `start_pose`."""
    dynamics = recorded_dynamics(run)
    nominal = recorded_model(run) or RobotModel()
    first_model, *models = dynamics or [nominal] * (len(run.cmd_vel_out) + 1)
    first, whole, missed = _beginning(run, first_model, dynamics)
    epochs, model = [[first]], first_model
    for row in _rows(run, models, first, whole=whole):
        robot = epochs[-1][-1].robot
        if row.model is not None:
            if row.stamp < robot.stamp:
                # From before the start, or from before time went back.
                continue
            model = row.model
            if model != robot.model:
                robot = robot.remodelled(model, row.stamp)
            robot = robot.commanded(tuple(row.values.tolist()), row.stamp)
        else:
            pose, covariance = row.values[:3], row.values[3:].reshape(3, 3)
            back = row.stamp < robot.stamp
            if back or _restarted(run, robot, row):
                epochs += [[]] if back else []
                robot = Robot(model=model, stamp=row.stamp, pose=pose, covariance=covariance)
            else:
                moved = robot.placed(pose, covariance, row.stamp)
                reset = robot.placed(pose, covariance, row.stamp, odometry_only=True)
                robot = _placed_as_recorded(run, moved, reset)
        epochs[-1].append(Event(robot, row.received, is_command=row.model is not None))
    start = 'start_pose' if whole else 'odometry'
    return Driven(source='cmd_vel_out', start=start, epochs=epochs, missed=missed)


def _rows(run: Run, models: list[RobotModel], first: Event, *, whole: bool) -> list[_Row]:
    """Return the messages that come after the start of the robot."""
    starts, commands = run.start_pose, run.cmd_vel_out
    if whole:
        skipped = int(np.flatnonzero(starts.stamps == first.robot.stamp)[0]) + 1
    else:
        # Latched ones: where time goes back, a start with an earlier stamp comes, too.
        earlier = int(np.count_nonzero(starts.stamps < first.robot.stamp))
        skipped = max(earlier - len(run.odometry.back), 0)
    placed = np.hstack([starts.values, start_covariances(run)])
    none = [None] * len(starts)
    rows = [*map(_Row, starts.received.tolist(), starts.stamps.tolist(), placed, none)][skipped:]
    rows += map(_Row, commands.received.tolist(), commands.stamps.tolist(), commands.values, models)
    # A placement comes after the timeout that it noticed, which took effect before.
    return sorted(rows, key=lambda row: row[:2])


def _beginning(run: Run, model: RobotModel, dynamics: list[RobotModel]) -> tuple[Event, bool, bool]:
    """Return the start of the robot, whether it is a `start_pose`, and whether commands were missed."""
    starts, commands = run.start_pose, run.cmd_vel_out
    delay = model.actuators.delay
    index = _known_since(run, delay)
    latched = _starts_before_recording(run)
    stood = latched > 0 and _stood_since(run, latched - 1)
    if not index and (stood or (len(starts) and not latched)):
        which = latched - 1 if stood else 0
        covariance = start_covariances(run)[which].reshape(3, 3)
        stamp, pose = int(starts.stamps[which]), starts.values[which]
        robot = Robot(model=model, stamp=stamp, pose=pose, covariance=covariance)
        # As it is latched, it may have been received later than what followed it.
        return Event(robot, 0), True, False
    if not dynamics or (not index and _rests(run, delay)):
        robot = _moving(run, index)
    else:
        index = _settled_since(run, dynamics)
        robot = _following(_moving(run, index), run, dynamics)
    # The command that was recorded before the odometry is in effect in its first message.
    received = int(run.odometry.received[index])
    driven = (commands.stamps <= robot.stamp) & (commands.received <= received + MARGIN)
    return Event(robot, received, is_command=bool(driven.any())), False, index > 0


def _moving(run: Run, index: int) -> Robot:
    """Return the robot with the pose and the twist of an odometry message."""
    stamp, values = int(run.odometry.stamps[index]), run.odometry.values[index]
    robot = Robot(model=RobotModel(), stamp=stamp, pose=values[:3].copy())
    return robot.commanded((float(values[3]), float(values[4])), stamp)


def _following(robot: Robot, run: Run, dynamics: list[RobotModel]) -> Robot:
    """Return a robot that follows the last command in effect, and then those that were given later."""
    stamps, now = run.cmd_vel_out.stamps, robot.stamp
    given = int(np.searchsorted(stamps, now, side='right'))
    model = dynamics[given]
    delay = model.actuators.delay
    acting = int(np.searchsorted(stamps, now - delay, side='right'))
    for number in range(acting - 1, given):
        left = max(int(stamps[number]) + delay - now, 0)
        robot = robot.remodelled(replace(model, actuators=replace(model.actuators, delay=left)), now)
        v, omega = run.cmd_vel_out.values[number].tolist()
        robot = robot.commanded((v, omega), now)
    return robot.remodelled(model, now)


def _restarted(run: Run, robot: Robot, start: _Row) -> bool:
    """Return whether a start is that of a new process: the robot stands although it was commanded."""
    odometry, commands = run.odometry, run.cmd_vel_out.stamps
    soon = np.abs(odometry.received - start.received) <= MARGIN
    later = np.flatnonzero(soon & (odometry.stamps >= start.stamp))
    if not len(later):
        return False
    first = later[0]
    now = int(odometry.stamps[first])
    if ((commands >= start.stamp) & (commands <= now)).any():
        return False
    return not odometry.values[first, 3:5].any() and robot.at(now).twist != (0.0, 0.0)


def _placed_as_recorded(run: Run, moved: Robot, reset: Robot) -> Robot:
    """Return which robot the ground truth fits: the one that was placed, or with its odometry reset."""
    truth = run.ground_truth
    later = np.flatnonzero(truth.stamps > moved.stamp)
    if moved.model.drift is None or not len(later):
        return moved
    stamp, place = int(truth.stamps[later[0]]), truth.values[later[0], :2]

    def apart(robot: Robot) -> float:
        return float(np.hypot(*(robot.at(stamp).true_pose[:2] - place)))

    return min(moved, reset, key=apart)


# --- Where it can be begun


def _before_commands(run: Run, delay: int) -> int:
    """Return how many odometry messages precede the effect of the first command, with a delay (ns)."""
    odometry, first = run.odometry, run.cmd_vel_out.stamps[0] + delay
    # At the time of the command the odometry is from before it, unless it has its twist.
    applied = (odometry.values[:, 3:5] == run.cmd_vel_out.values[0]).all(axis=1)
    later = (odometry.stamps > first) | ((odometry.stamps == first) & applied)
    later |= np.diff(odometry.stamps, prepend=odometry.stamps[0]) < 0
    return int(np.argmax(later)) if later.any() else 0


def _known_since(run: Run, delay: int) -> int:
    """Return the odometry message from which on the commands are known, usually the first.

    Where the twist changes before the first recorded command, the recorder has missed one, because it
    was discovered late.
    """
    before = run.odometry.values[: _before_commands(run, delay), 3:5]
    changes = np.flatnonzero(np.diff(before, axis=0).any(axis=1))
    return int(changes[-1]) + 1 if len(changes) else 0


def _rests(run: Run, delay: int) -> bool:
    """Return whether odometry of before the first command shows that no earlier one still acts."""
    before = int(run.cmd_vel_out.stamps[0] - run.odometry.stamps[0])
    return _before_commands(run, 0) > 1 and before >= delay


def _settled_since(run: Run, dynamics: list[RobotModel]) -> int:
    """Return the odometry message from which on the state of a robot that takes time is known.

    That needs all commands that may act. Behind the limits of the acceleration, a lag hides where these
    are: the twist must have settled, too.

    Raises:
        BagError: There is no such message.
    """
    commands, odometry = run.cmd_vel_out.stamps, run.odometry
    changes: NDArray[np.bool_] = np.any(np.diff(odometry.values[:, 3:5], axis=0, prepend=np.nan), axis=1)
    for index, stamp in enumerate(odometry.stamps.tolist()):
        actuators = dynamics[int(np.searchsorted(commands, stamp, side='right'))].actuators
        hidden = actuators.lag > 0.0 and not actuators.acceleration.unlimited
        # At the very time the message may be from before the command.
        if stamp - commands[0] > actuators.delay and not (hidden and changes[index]):
            return index
    lacking = 'commands' if len(run.start_pose) else 'start_pose'
    raise BagError(
        f'{run.path} cannot be followed: it lacks {lacking} of before the first message on cmd_vel_out, '
        'and the robot, which follows commands with acceleration limits, a lag or a delay, does not '
        'come to a known state: record from before it moves'
    )


def _starts_before_recording(run: Run) -> int:
    """Return how many messages of `start_pose` are latched, from before the recording."""
    starts, gaps = run.start_pose, np.diff(run.odometry.stamps)
    # Half a period allows for a late timer.
    begun = int(run.odometry.stamps[0]) - (int(np.median(gaps) * 1.5) if len(gaps) else 0)
    count = 0
    for stamp, received in zip(starts.stamps.tolist(), starts.received.tolist(), strict=True):
        late = received - int(starts.received[0])
        if stamp >= begun or not 0 <= late <= MARGIN:
            break
        count += 1
    return count


def _stood_since(run: Run, index: int) -> bool:
    """Return whether the robot still stands at a `start_pose` in the first odometry.

    In a process that creates its nodes before it spins them, the first odometry follows late. After more
    than `FIRST` it must be that of the start: the robot may have been driven elsewhere meanwhile.
    """
    start, first, truth = run.start_pose, run.odometry.values[0], run.ground_truth
    # Commands that were recorded before it could not be applied to it.
    if first[3:5].any() or (run.cmd_vel_out.received < start.received[index]).any():
        return False
    # Not after a reset of the odometry alone.
    if len(truth) and not np.array_equal(truth.values[0, :3], start.values[index]):
        return False
    if run.odometry.stamps[0] - start.stamps[index] <= FIRST:
        return True
    covariances = run.odometry_covariances
    if len(covariances) != len(run.odometry) or len(run.start_covariances) != len(start):
        return False
    return bool(
        np.array_equal(first[:3], start.values[index])
        and np.array_equal(covariances[0, :6], run.start_covariances[index])
    )


# --- By the commands as they were recorded


def _commanded(run: Run, given: Mapping[str, Any] | None) -> Driven:
    """Return the robot after each `cmd_vel`, or `joint_command` if it is driven by its wheels."""
    values = dict(given if given is not None else run.of_node(ROBOT))
    first = min(
        (int(one.received[0]) for one in (run.cmd_vel, run.wheel_commands) if len(one)), default=0
    )
    for received, change in run.parameter_events:
        # A robot that starts later than the recorder reports its first values as changes.
        if given is None and base_name(change.node) == ROBOT and received < first:
            values.update(change.values)
    parameters = VirtualRobotParameters().changed(values)
    source, series = 'cmd_vel', run.cmd_vel
    if parameters.command_interface == 'wheels':
        source, series = 'joint_command', run.wheel_commands
    if not len(series):
        raise run.lacking(f'commands: record cmd_vel_out, or {source}')
    delay = float(np.median(run.odometry.received - run.odometry.stamps))
    if abs(delay) > MARGIN:
        raise BagError(
            f'{run.path} cannot be verified by the recording times of {source}: they are of another '
            f'clock than the stamps of the odometry (median difference {delay / NANOSECONDS:.6g} s, '
            f'allowed {MARGIN / NANOSECONDS:g} s). Record cmd_vel_out, or record with the use_sim_time '
            'of the robot'
        )
    rows: list[tuple[int, Any]] = list(zip(series.received.tolist(), series.values, strict=True))
    rows += [
        (received, change.values)
        for received, change in run.parameter_events
        if base_name(change.node) == ROBOT
    ]
    before = max(int(np.searchsorted(run.odometry.stamps, int(series.received[0]))) - 1, 0)
    robot = _moving(run, before)
    robot = robot.remodelled(parameters.model(), robot.stamp)
    rows += [
        (stamp, pose)
        for stamp, pose in zip(run.start_pose.stamps.tolist(), run.start_pose.values, strict=True)
        if stamp > robot.stamp
    ]
    rows.sort(key=lambda row: row[0])
    events = [Event(robot, int(run.odometry.received[before]))]
    wheels = source == 'joint_command'
    for received, row in rows:
        if received < robot.stamp:
            continue
        if isinstance(row, dict):
            values.update(row)
            parameters = VirtualRobotParameters().changed(values)
            robot = robot.remodelled(parameters.model(), received, wheels_commanded=wheels)
        elif len(row) == 3:
            robot = robot.placed(row, np.zeros((3, 3)), received)
        else:
            try:
                first, second = row.tolist()
                twist = plausible_twist(*robot.model.twist(first, second)) if wheels else (first, second)
            except MessageError:
                # The node drops it as well.
                continue
            robot = robot.commanded(twist, received)
        events.append(Event(robot, received, is_command=not isinstance(row, dict) and len(row) == 2))
    return Driven(source=source, start='odometry', epochs=[events])
