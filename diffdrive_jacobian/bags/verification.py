"""Verification of a recorded run: a simulation from its commands is compared with its odometry.

The commands are applied to `simulation.Robot`, as in the node `virtual_robot`, and each odometry message
is compared with the pose of that robot at the message's stamp. `cmd_vel_out` has each command as it was
applied, after limits and timeout, with the time it took effect. So no parameter is needed, but for
robots with limits of the acceleration, a lag or a delay. Those are taken from the parameters, their
changes, and the faults of the motors in a lockstep world. Such a robot publishes its command again when
they change, so `cmd_vel_out` also has the times of the changes. Without `cmd_vel_out` the commands take
effect when they were recorded, with the limits and the timeout of the parameters.
"""

from __future__ import annotations

import math
import re
from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.bags.bag_reader import BagError, ReadingInterruptedError
from diffdrive_jacobian.bags.run import Run, Series
from diffdrive_jacobian.kinematics.saturation import VelocityLimits
from diffdrive_jacobian.messages.conversion import MessageError, plausible_twist
from diffdrive_jacobian.numerics.elementary import wrap
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.parameters.virtual_robot import MULTIPLIERS, VirtualRobotParameters
from diffdrive_jacobian.simulation.actuators import Actuators
from diffdrive_jacobian.simulation.odometry_noise import covariance_of_pose
from diffdrive_jacobian.simulation.robot import Robot, RobotModel
from diffdrive_jacobian.time_units import NANOSECONDS

ROBOT = 'virtual_robot'
EXACT, BY_RECORDING_TIME = 1e-9, 0.02
"""Default tolerances, with `cmd_vel_out` and with commands by their time of recording (m, rad)."""
COVARIANCE_TOLERANCE = 1e-9
"""Largest allowed difference of a covariance, relative to the standard deviations."""
_MAX_CANDIDATES = 32
"""Largest number of commands among which the last one that preceded an odometry message is sought."""
_MAX_DELAY = 1.0
"""Beyond this delay of the odometry (median) its stamps and the recorder are of different clocks (s)."""
_NOISE_PARAMETERS = ('wheel_separation', 'wheel_travel_variance')
_NUMBER = r'(\d+(?:\.\d+)?(?:e[+-]?\d+)?)'
_MOTOR_FAULTS: tuple[tuple[re.Pattern[str], Callable[..., Actuators]], ...] = (
    (
        re.compile(rf'ActuatorLag\({_NUMBER}'),
        lambda actuators, seconds: actuators.lagging(float(seconds)),
    ),
    (
        re.compile(r"DeadWheel\('(left|right)'"),
        lambda actuators, wheel: actuators.weakened(wheel, 0.0),
    ),
    (
        re.compile(rf"SaturatedWheel\('(left|right)', {_NUMBER}"),
        lambda actuators, wheel, speed: actuators.weakened(wheel, float(speed)),
    ),
)
"""Faults that change how a robot follows commands, and how its actuators change."""
_FAULTY_ROBOT = re.compile(r"robot='([^']*)'")
_NEVER = int(np.iinfo(np.int64).max)


class TruthDifferences(NamedTuple):
    """Differences of ground truth and simulated robot at each of n messages of ground_truth."""

    distances: NDArray[np.float64]
    """Differences of the position, shape (n,) (m)."""
    headings: NDArray[np.float64]
    """Differences of the heading, not negative, shape (n,) (rad)."""


def truth_differences(run: Run, robots: Iterable[Robot]) -> TruthDifferences | None:
    """Compare the ground truth of a run with simulated robots at the same stamps.

    None: no message has the stamp of a robot, or the robots have no drift.
    """
    at = {robot.stamp: robot for robot in robots if robot.model.drift is not None}
    truth = run.ground_truth
    rows = [index for index, stamp in enumerate(truth.stamps.tolist()) if stamp in at]
    if not rows:
        return None
    simulated = np.array([at[stamp].true_pose_tuple for stamp in truth.stamps[rows].tolist()])
    difference: NDArray[np.float64] = truth.values[rows, :3] - simulated
    return TruthDifferences(np.hypot(difference[:, 0], difference[:, 1]), np.abs(wrap(difference[:, 2])))


def placed_as_recorded(run: Run, placed: tuple[Robot, Robot]) -> Robot:
    """Return which robot the ground truth fits: the one that was placed, or with its odometry reset."""
    truth = run.ground_truth
    later = np.flatnonzero(truth.stamps > placed[0].stamp)
    if placed[0].model.drift is None or not len(later):
        return placed[0]
    stamp, place = int(truth.stamps[later[0]]), truth.values[later[0], :2]

    def apart(robot: Robot) -> float:
        return float(np.hypot(*(robot.at(stamp).true_pose[:2] - place)))

    return min(placed, key=apart)


@dataclass(frozen=True, kw_only=True, slots=True)
class Verification:
    """Differences of odometry and simulated robot at each of n odometry messages."""

    source: str
    """The topic from which the commands were taken."""
    start: str
    """The topic from which the start of the simulated robot was taken: `start_pose` or `odometry`."""
    seconds: NDArray[np.float64]
    """Stamps of the odometry messages, since the first one of the run, shape (n,) (s)."""
    distances: NDArray[np.float64]
    """Differences of the position, shape (n,) (m)."""
    headings: NDArray[np.float64]
    """Differences of the heading, not negative, shape (n,) (rad)."""
    notes: tuple[str, ...] = ()
    """Faults of the bag that did not prevent reading it, such as messages that were skipped, and how
    many odometry messages were not compared."""
    covariance_difference: float | None = None
    """Largest difference of a covariance of the pose from the exact moments of the noise model, relative
    to the standard deviations. None: the parameters of the robot or its start were not recorded."""
    truth: TruthDifferences | None = None
    """Differences of the ground truth. None: it, the parameters of the robot or its start were not
    recorded."""

    @property
    def allowed(self) -> float:
        """The default tolerance (m, rad)."""
        return EXACT if self.source == 'cmd_vel_out' else BY_RECORDING_TIME

    def holds(self, tolerance: float, yaw_tolerance: float) -> bool:
        """Return whether no difference exceeds the tolerances (m, rad).

        The covariances, if they were compared, must be the exact moments.
        """
        near = np.all(self.distances <= tolerance) and np.all(self.headings <= yaw_tolerance)
        if self.truth is not None:
            near &= np.all(self.truth.distances <= tolerance)
            near &= np.all(self.truth.headings <= yaw_tolerance)
        return bool(near) and (self.covariance_difference or 0.0) <= COVARIANCE_TOLERANCE


@dataclass(frozen=True, slots=True)
class _Anchor:
    """The robot after an event, and when the event was recorded (ns)."""

    robot: Robot
    received: int
    is_command: bool = False
    """Whether its twist is that of a recorded command."""


def verify(
    run: Run,
    parameters: Mapping[str, Any] | None = None,
    *,
    interrupted: Callable[[], bool] = lambda: False,
) -> Verification:
    """Simulate a run again and return its differences from the odometry.

    Args:
        run: The recorded run.
        parameters: Parameters of the robot, by their ROS names. By default those recorded with the run.
            They are used only if `cmd_vel_out` was not recorded.
        interrupted: Is called for each odometry message; once it returns True, the simulation ends.

    Raises:
        ReadingInterruptedError: `interrupted` returned True.
        BagError: There is no odometry, there are no commands, no odometry is later than a command, or
            the times of the commands and of the odometry are of different clocks.
        ParameterError: The parameters are not valid parameters of the robot.
    """
    if not len(run.odometry):
        raise run.lacking('odometry: record the topic odom')
    if len(run.odometry) > 1 and not np.ptp(run.odometry.received):
        raise BagError(
            f'{run.path} was recorded while the clock of the recorder stood still, so that the order of '
            'its messages is lost (use_sim_time without /clock?)'
        )
    if len(run.cmd_vel_out):
        source, start, anchors = 'cmd_vel_out', *_applied(run)
    else:
        source, start, anchors = _commanded(run, parameters)
    stamps, values = run.odometry.stamps, run.odometry.values
    # How often time went back before each message.
    epochs: list[int] = [0, *np.cumsum(np.diff(stamps) < 0).tolist()]
    if epochs[-1] >= len(anchors):
        raise BagError(
            f'{run.path} cannot be followed: time goes back {epochs[-1]} times in the odometry, but the '
            f'robot was restarted {len(anchors) - 1} times. Where /clock goes back, '
            'record without use_sim_time'
        )
    first_commands = [
        next((anchor.robot.stamp for anchor in epoch if anchor.is_command), _NEVER) for epoch in anchors
    ]
    simulated: dict[int, Robot] = {}
    followed = False
    for index, epoch in enumerate(epochs):
        if interrupted():
            raise ReadingInterruptedError
        found = _nearest(anchors[epoch], run.odometry, index)
        if found is not None:
            simulated[index] = found
            followed |= int(stamps[index]) > first_commands[epoch]
    if not followed:
        raise BagError(
            f'{run.path} has no odometry after the first command on {source}, so that no motion can be '
            'verified (are their stamps of different clocks?)'
        )
    compared = list(simulated)
    poses = np.array([robot.pose for robot in simulated.values()])
    difference: NDArray[np.float64] = values[compared, :3] - poses
    distances = np.hypot(difference[:, 0], difference[:, 1])
    covariance_difference = truth = None
    if start == 'start_pose':
        # Later placements may have other covariances and truths.
        first = {index: robot for index, robot in simulated.items() if not epochs[index]}
        truth = truth_differences(run, first.values())
        if recorded_model(run) and len(run.odometry_covariances) == len(stamps):
            recorded = run.odometry_covariances[list(first), :6]
            covariance_difference = largest_covariance_difference(first.values(), recorded)
    notes = list(run.notes)
    if source == 'cmd_vel_out' and start == 'odometry' and recorded_dynamics(run):
        notes.append(
            'the robot follows commands with acceleration limits, a lag or a delay, and its start is '
            'not recorded: what it was commanded before is missing'
        )
    if source == 'cmd_vel_out' and _known_since(run):
        notes.append(
            'the robot moved before the first command that was recorded: what it was commanded before '
            'is missing'
        )
    if omitted := len(stamps) - len(simulated):
        notes.append(
            f'{omitted} of {len(stamps)} odometry messages precede the start of the simulated robot and '
            'were not compared'
        )
    if truth is None and len(run.ground_truth):
        notes.append(
            'ground_truth was not compared: it needs the parameters of virtual_robot, cmd_vel_out and '
            'the first start_pose'
        )
    differs = source == 'cmd_vel_out' and bool(np.any(distances > EXACT))
    if differs and not run.of_node(ROBOT):
        notes.append(
            'the parameters of virtual_robot were not recorded: the motion of a robot with limits of '
            'the acceleration, a lag or a delay cannot be reproduced without them'
        )
    elif differs and not run.fault_events:
        notes.append(
            'no faults are recorded: if this was a lockstep world with a fault of the motors, record '
            '/fault_events'
        )
    return Verification(
        source=source,
        start=start,
        seconds=(stamps[compared] - stamps[0]) / NANOSECONDS,
        distances=distances,
        headings=np.abs(wrap(difference[:, 2])),
        notes=tuple(notes),
        covariance_difference=covariance_difference,
        truth=truth,
    )


def _nearest(anchors: list[_Anchor], odometry: Series, index: int) -> Robot | None:
    """Return the robot at the stamp of an odometry message; None: it starts later.

    A command that took effect before that stamp, but was recorded no sooner than the message, may have
    reached the robot after it sent the message, or only the recorder late. Which was published first is
    unknown then, and the robot that is nearer to the odometry counts. Of many such commands only the
    latest ones are considered, so that the time of a verification is linear in the number of messages.
    """
    stamp, received = int(odometry.stamps[index]), int(odometry.received[index])
    last = bisect_right(anchors, stamp, key=lambda anchor: anchor.robot.stamp) - 1
    if last < 0:
        return None
    robot = anchors[last].robot.at(stamp)
    # The first one is the start of the robot, the others are in the order of their recording.
    known = bisect_left(anchors, received, 1, last + 1, key=lambda anchor: anchor.received) - 1
    if known == last:
        return robot
    earlier = range(max(known, last + 1 - _MAX_CANDIDATES), last)
    candidates = [robot, *(anchors[one].robot.at(stamp) for one in earlier)]

    def apart(candidate: Robot) -> float:
        dx, dy, turn = (odometry.values[index, :3] - candidate.pose).tolist()
        return math.hypot(dx, dy) + abs(float(wrap(turn)))

    return min(candidates, key=apart)


def _applied(run: Run) -> tuple[str, list[list[_Anchor]]]:
    """Return the robot after each event of `cmd_vel_out` and `start_pose`, one list for each restart."""
    begins = _known_since(run)
    first, begun = _beginning(run, begins), int(run.odometry.received[begins])
    starts = run.start_pose
    skipped = _starts_before_recording(run)
    whole = not skipped and len(starts) > 0
    if skipped and _stood_since(run, skipped - 1):
        whole, skipped = True, skipped - 1
    if begins:
        whole, skipped = False, int(np.count_nonzero(starts.received <= begun))
    placed = start_covariances(run)
    model = recorded_model(run) or RobotModel()
    first_model, *models = recorded_dynamics(run) or [model] * (len(run.cmd_vel_out) + 1)
    # With the model from a command on; None: a start.
    events: list[tuple[int, int, RobotModel | None, NDArray[np.float64]]] = []
    for series, begin in ((starts, skipped), (run.cmd_vel_out, 0)):
        is_start = series is starts
        values = np.hstack([series.values, placed]) if is_start else series.values
        changed = [None] * len(series) if is_start else models
        rows = zip(series.received.tolist(), series.stamps.tolist(), changed, values, strict=True)
        events += list(rows)[begin:]
    # A placement comes after the timeout that it noticed, which took effect before.
    events.sort(key=lambda event: event[:2])
    model = first_model
    # The command that was recorded before the odometry is in effect in its first message.
    driven = (run.cmd_vel_out.stamps <= first.stamp) & (
        run.cmd_vel_out.received <= begun + _MAX_DELAY * NANOSECONDS
    )
    epochs: list[list[_Anchor]] = [
        [] if whole else [_Anchor(first, begun, is_command=bool(driven.any()))]
    ]
    for received, stamp, changed_model, row in events:
        latest = epochs[-1][-1].robot if epochs[-1] else None
        is_start, model = changed_model is None, changed_model or model
        if is_start and (latest is None or stamp < latest.stamp):
            if latest is not None:
                epochs.append([])
            robot = Robot(model=model, stamp=stamp, pose=row[:3], covariance=row[3:].reshape(3, 3))
        elif latest is None or stamp < latest.stamp:
            # From before the recording, or from before time went back.
            continue
        elif is_start:
            pose, covariance = row[:3], row[3:].reshape(3, 3)
            moved = latest.placed(pose, covariance, stamp)
            reset = latest.placed(pose, covariance, stamp, odometry_only=True)
            robot = placed_as_recorded(run, (moved, reset))
        else:
            if model != latest.model:
                latest = latest.remodelled(model, stamp)
            robot = latest.commanded((float(row[0]), float(row[1])), stamp)
        epochs[-1].append(_Anchor(robot, received, is_command=not is_start))
    return ('start_pose' if whole else 'odometry'), epochs


def _known_since(run: Run) -> int:
    """Return the odometry message from which on the commands are known, usually the first.

    Where the twist changes before the first recorded command, the recorder has missed one, because it
    was discovered late.
    """
    odometry, first = run.odometry, run.cmd_vel_out.stamps[0]
    # At the time of the command the odometry is from before it, unless it has its twist.
    applied = (odometry.values[:, 3:5] == run.cmd_vel_out.values[0]).all(axis=1)
    later = (odometry.stamps > first) | ((odometry.stamps == first) & applied)
    later |= np.diff(odometry.stamps, prepend=odometry.stamps[0]) < 0
    before = odometry.values[: int(np.argmax(later)) if later.any() else 0, 3:5]
    changes = np.flatnonzero(np.diff(before, axis=0).any(axis=1))
    return int(changes[-1]) + 1 if len(changes) else 0


def _beginning(run: Run, index: int) -> Robot:
    """Return the robot with the pose and the twist of an odometry message."""
    stamp, values = int(run.odometry.stamps[index]), run.odometry.values[index]
    robot = Robot(model=RobotModel(), stamp=stamp, pose=values[:3].copy())
    return robot.commanded((float(values[3]), float(values[4])), stamp)


def _starts_before_recording(run: Run) -> int:
    """Return how many messages of `start_pose` are latched, from before the recording."""
    starts, gaps = run.start_pose, np.diff(run.odometry.stamps)
    # Half a period allows for a late timer.
    begun = int(run.odometry.stamps[0]) - (int(np.median(gaps) * 1.5) if len(gaps) else 0)
    count = 0
    for stamp, received in zip(starts.stamps.tolist(), starts.received.tolist(), strict=True):
        late = received - int(starts.received[0])
        if stamp >= begun or not 0 <= late <= _MAX_DELAY * NANOSECONDS:
            break
        count += 1
    return count


def _stood_since(run: Run, index: int) -> bool:
    """Return whether the first odometry is still that of a `start_pose`: nothing has moved since.

    In a process that creates its nodes before it spins them, the first odometry follows late.
    """
    start, first, truth = run.start_pose, run.odometry.values[0], run.ground_truth
    covariances = run.odometry_covariances
    if len(covariances) != len(run.odometry) or len(run.start_covariances) != len(start):
        return False
    return bool(
        # Commands that were recorded before it could not be applied to it.
        not (run.cmd_vel_out.received < start.received[index]).any()
        and not first[3:5].any()
        and np.array_equal(first[:3], start.values[index])
        # Not after a reset of the odometry alone.
        and (not len(truth) or np.array_equal(truth.values[0, :3], start.values[index]))
        and np.array_equal(covariances[0, :6], run.start_covariances[index])
    )


def _commanded(run: Run, given: Mapping[str, Any] | None) -> tuple[str, str, list[list[_Anchor]]]:
    """Return the robot after each `cmd_vel`, or `joint_command` if it is driven by its wheels."""
    values = dict(given if given is not None else run.of_node(ROBOT))
    parameters = VirtualRobotParameters().changed(values)
    source, series = 'cmd_vel', run.cmd_vel
    if parameters.command_interface == 'wheels':
        source, series = 'joint_command', run.wheel_commands
    if not len(series):
        raise run.lacking(f'commands: record cmd_vel_out, or {source}')
    delay = float(np.median(run.odometry.received - run.odometry.stamps)) / NANOSECONDS
    if abs(delay) > _MAX_DELAY:
        raise BagError(
            f'{run.path} cannot be verified by the recording times of {source}: they are of another '
            f'clock than the stamps of the odometry (median difference {delay:.6g} s, allowed '
            f'{_MAX_DELAY:g} s). Record cmd_vel_out, or record with the use_sim_time of the robot'
        )
    events: list[tuple[int, Any]] = list(zip(series.received.tolist(), series.values, strict=True))
    events += [
        (received, changes)
        for received, node, changes in run.parameter_events
        if node.split('/')[-1] == ROBOT
    ]
    events.sort(key=lambda event: event[0])
    before = max(int(np.searchsorted(run.odometry.stamps, int(series.received[0]))) - 1, 0)
    robot = Robot(
        model=parameters.model(),
        stamp=int(run.odometry.stamps[before]),
        pose=run.odometry.values[before, :3].copy(),
    )
    anchors = [_Anchor(robot, int(run.odometry.received[before]))]
    for received, event in events:
        if received < robot.stamp:
            continue
        if isinstance(event, dict):
            values.update(event)
            parameters = VirtualRobotParameters().changed(values)
            robot = robot.remodelled(
                parameters.model(), received, wheels_commanded=source == 'joint_command'
            )
        else:
            try:
                first, second = event.tolist()
                wheels = source == 'joint_command'
                twist = plausible_twist(*robot.model.twist(first, second)) if wheels else (first, second)
            except MessageError:
                # The node drops it as well.
                continue
            robot = robot.commanded(twist, received)
        anchors.append(_Anchor(robot, received, is_command=not isinstance(event, dict)))
    return source, 'odometry', [anchors]


# --- The covariances


def recorded_model(run: Run) -> RobotModel | None:
    """Return the model of the robot; None: it was not recorded, or it changed."""
    recorded = run.of_node(ROBOT)
    # A robot that starts later than the recorder reports its first values as changes.
    changed = {
        name
        for _, node, values in run.parameter_events
        if node.split('/')[-1] == ROBOT
        for name, value in values.items()
        if value != recorded.get(name)
    }
    separation, variance = (run.number_of_node(ROBOT, name, math.nan) for name in _NOISE_PARAMETERS)
    separation *= run.number_of_node(ROBOT, 'wheel_separation_multiplier', 1.0)
    if changed & {*_NOISE_PARAMETERS, *MULTIPLIERS} or not (separation > 0.0 and variance >= 0.0):
        return None
    try:
        drift = VirtualRobotParameters().changed(recorded).drift()
    except ParameterError:
        drift = None
    return RobotModel(wheel_separation=separation, wheel_travel_variance=variance, drift=drift)


def recorded_dynamics(run: Run) -> list[RobotModel]:
    """Return models that follow commands as the recorded robot did, without limits of the velocity.

    Returns:
        The model at the start, and that from each message of `cmd_vel_out` on. []: the robot follows
        commands at once, or its parameters were not recorded.
    """
    received, stamps = run.cmd_vel_out.received.tolist(), run.cmd_vel_out.stamps
    changes: dict[int, list[tuple[Any, ...]]] = defaultdict(list)
    times = run.parameter_stamps
    if len(times) != len(run.parameter_events):
        times = tuple(recorded for recorded, *_ in run.parameter_events)
    margin = int(_MAX_DELAY * NANOSECONDS)
    for (recorded, node, values), stamp in zip(run.parameter_events, times, strict=True):
        if node.split('/')[-1] == ROBOT:
            # The robot publishes its command again after the event.
            first = bisect_left(received, recorded - margin)
            last = bisect_right(received, recorded + margin)
            later = first + np.flatnonzero(stamps[first:last] >= stamp)
            # Of several changes at one time each has a message of its own.
            earliest = stamps[later] == np.min(stamps[later], initial=_NEVER)
            together = later[earliest].tolist() or [last]
            free = [index for index in together if index not in changes]
            changes[int((free or together)[0 if free else -1])].append((values,))
    for recorded, fault, what in run.fault_events:
        robot = _FAULTY_ROBOT.search(fault)
        if robot is not None and robot[1].split('/')[-1] != ROBOT:
            continue
        if not any(pattern.match(fault) for pattern, _ in _MOTOR_FAULTS):
            continue
        # As above. Where one fault ends and another begins, the robot is without both in between.
        index = bisect_left(received, recorded)
        while index in changes and received[index + 1 : index + 2] == [recorded]:
            index += 1
        changes[index].append((fault, what))
    values = dict(run.of_node(ROBOT))
    faults: list[str] = []
    model = _dynamics(values, faults)
    found = [model]
    for number in range(len(received)):
        for change in changes.get(number, ()):
            if isinstance(change[0], dict):
                values.update(change[0])
            elif change[1] == 'begins':
                faults.append(change[0])
            elif change[1].startswith('ends') and change[0] in faults:
                faults.remove(change[0])
        if number in changes:
            model = _dynamics(values, faults)
        found.append(model)
    return found if any(model.takes_time for model in found) else []


def _dynamics(values: Mapping[str, Any], faults: Iterable[str]) -> RobotModel:
    """Return a model from the parameters of a robot and the faults of its motors."""
    try:
        model = VirtualRobotParameters().changed(values).model()
        actuators = model.actuators
        for fault in faults:
            for pattern, change in _MOTOR_FAULTS:
                if (match := pattern.match(fault)) is not None:
                    actuators = change(actuators, *match.groups())
    except (ParameterError, ValueError):
        return RobotModel()
    return replace(model, limits=VelocityLimits(), command_timeout=0, actuators=actuators)


def start_covariances(run: Run) -> NDArray[np.float64]:
    """Return the covariance in each `start_pose`, by rows, shape (n, 9); zero where it is invalid."""
    entries = run.start_covariances
    if len(entries) != len(run.start_pose):
        return np.zeros((len(run.start_pose), 9))
    matrices: NDArray[np.float64] = entries[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].copy()
    for row in matrices:
        try:
            covariance_of_pose('covariance', row.reshape(3, 3))
        except ValueError:
            row[:] = 0.0
    return matrices


def largest_covariance_difference(robots: Iterable[Robot], recorded: NDArray[np.float64]) -> float:
    """Return the largest difference of recorded covariances from the exact moments of the noise model.

    It is relative to the standard deviations; infinity: a covariance is not comparable. `recorded` has
    the entries xx, xy, xt, yy, yt, tt at each robot, shape (n, 6).
    """
    computed = np.array([robot.moments[:6] for robot in robots]).reshape(-1, 6)
    position = np.sqrt(computed[:, 0] + computed[:, 3])
    heading = np.sqrt(computed[:, 5])
    scales = np.stack([position, position, position, position, position, heading], axis=-1)
    scales *= np.stack([position, position, heading, position, heading, heading], axis=-1)
    difference = np.abs(recorded - computed)
    with np.errstate(all='ignore'):
        relative = np.where(difference == 0.0, 0.0, difference / scales)
    return float(np.max(relative, initial=0.0)) if not np.isnan(relative).any() else math.inf
