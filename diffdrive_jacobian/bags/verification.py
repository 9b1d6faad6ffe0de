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

"""Verification of a recorded run: a simulation from its commands is compared with its odometry.

`driven_again` applies the commands to `simulation.Robot`, as in the node `virtual_robot`. Here each
odometry message is compared with that robot at the message's stamp, and what a recording lacks is named.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.bags.bag_reader import BagError
from diffdrive_jacobian.bags.driven_again import Driven, driven_again, robots_at_odometry
from diffdrive_jacobian.bags.recorded_robot import MARGIN, ROBOT, recorded_model
from diffdrive_jacobian.bags.run import Run
from diffdrive_jacobian.messages.names import base_name
from diffdrive_jacobian.numerics.elementary import wrap
from diffdrive_jacobian.simulation.robot import Robot
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.time_units import NANOSECONDS, seconds

Array = NDArray[np.float64]
EXACT, BY_RECORDING_TIME = 1e-9, 0.02
"""Default tolerances, with `cmd_vel_out` and with commands by their time of recording (m, rad)."""
COVARIANCE_TOLERANCE = 1e-9
"""Largest allowed difference of a covariance, relative to the standard deviations."""
_NEEDED = ('odom', 'cmd_vel_out', 'start_pose', 'ground_truth')
"""Topics by which a `virtual_robot` is verified."""
_MAX_NAMED = 3
"""Largest number of missing messages that are named."""


class TruthDifferences(NamedTuple):
    """Differences of ground truth and simulated robot at each of n messages of ground_truth."""

    distances: Array
    """Differences of the position, shape (n,) (m)."""
    headings: Array
    """Differences of the heading, not negative, shape (n,) (rad)."""
    speeds: Array
    """Differences of v, not negative, shape (n,) (m/s)."""
    turn_rates: Array
    """Differences of omega, not negative, shape (n,) (rad/s)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Verification:
    """Differences of odometry and simulated robot at each of n odometry messages."""

    source: str
    """The topic from which the commands were taken."""
    start: str
    """The topic from which the start of the simulated robot was taken: `start_pose` or `odometry`."""
    seconds: Array
    """Stamps of the odometry messages, since the first one of the run, shape (n,) (s)."""
    distances: Array
    """Differences of the position, shape (n,) (m)."""
    headings: Array
    """Differences of the heading, not negative, shape (n,) (rad)."""
    speeds: Array | None = None
    """Differences of v, not negative, shape (n,) (m/s). None, as `turn_rates`: when the commands took
    effect was not recorded (`cmd_vel_out`), so that the velocities cannot be compared."""
    turn_rates: Array | None = None
    """Differences of omega, not negative, shape (n,) (rad/s)."""
    notes: tuple[str, ...] = ()
    """Faults of the bag that did not prevent reading it, such as messages that were skipped, what was
    not compared, and what may be the cause of differences."""
    missing: tuple[str, ...] = ()
    """What a whole recording of a `virtual_robot` has and this one lacks. With anything missing the
    verification does not hold."""
    covariance_difference: float | None = None
    """Largest difference of a covariance of the pose from the exact moments of the noise model, relative
    to the standard deviations. None: the parameters of the robot or its start were not recorded."""
    truth: TruthDifferences | None = None
    """Differences of the ground truth. None: it, the parameters of the robot or its start were not
    recorded."""

    @property
    def allowed(self) -> float:
        """The default tolerance (m and m/s, rad and rad/s)."""
        return EXACT if self.source == 'cmd_vel_out' else BY_RECORDING_TIME

    def agrees(self, tolerance: float, yaw_tolerance: float) -> bool:
        """Return whether no difference exceeds the tolerances (m and m/s, rad and rad/s).

        The covariances, if they were compared, must be the exact moments.
        """
        linear = [self.distances, self.speeds]
        angular = [self.headings, self.turn_rates]
        if self.truth is not None:
            linear += [self.truth.distances, self.truth.speeds]
            angular += [self.truth.headings, self.truth.turn_rates]
        near = all(np.all(one <= tolerance) for one in linear if one is not None)
        near &= all(np.all(one <= yaw_tolerance) for one in angular if one is not None)
        return near and (self.covariance_difference or 0.0) <= COVARIANCE_TOLERANCE

    def holds(self, tolerance: float, yaw_tolerance: float) -> bool:
        """Return whether the robot `agrees`, and nothing is missing."""
        return not self.missing and self.agrees(tolerance, yaw_tolerance)


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
        InterruptionError: `interrupted` returned True.
        BagError: There is no odometry, there are no commands, no odometry is later than a command, the
            state of a robot that takes time is never known, or the times of the commands and of the
            odometry are of different clocks.
        ParameterError: The parameters are not valid parameters of the robot.
    """
    odometry = run.odometry
    if not len(odometry):
        raise run.lacking('odometry: record the topic odom')
    if len(odometry) > 1 and not np.ptp(odometry.received):
        raise BagError(
            f'{run.path} was recorded while the clock of the recorder stood still, so that the order of '
            'its messages is lost (use_sim_time without /clock?)'
        )
    driven = driven_again(run, parameters)
    exact = driven.source == 'cmd_vel_out'
    rows, epochs, robots = zip(*robots_at_odometry(run, driven, interrupted), strict=True)
    compared = list(rows)
    distances, headings, speeds, turn_rates = _differences(
        odometry.values[compared], [(*robot.pose_tuple, *robot.twist) for robot in robots]
    )
    covariance_difference = truth = None
    if driven.start == 'start_pose':
        # Later placements may have other covariances and truths.
        first = epochs.count(0)
        truth = _truth_differences(run, robots[:first])
        if recorded_model(run) and len(run.odometry_covariances) == len(odometry):
            recorded = run.odometry_covariances[compared[:first], :6]
            covariance_difference = largest_covariance_difference(robots[:first], recorded)
    found = Verification(
        source=driven.source,
        start=driven.start,
        seconds=(odometry.stamps[compared] - odometry.stamps[0]) / NANOSECONDS,
        distances=distances,
        headings=headings,
        speeds=speeds if exact else None,
        turn_rates=turn_rates if exact else None,
        missing=tuple(_missing(run)) if exact else (),
        covariance_difference=covariance_difference,
        truth=truth,
    )
    return replace(found, notes=(*run.notes, *_notes(run, driven, found)))


def _differences(recorded: Array, simulated: Any) -> tuple[Array, Array, Array, Array]:
    """Compare rows `[x, y, theta, v, omega]`: distances, headings, speeds, turn rates."""
    difference = recorded - np.array(simulated)
    return (
        np.hypot(difference[:, 0], difference[:, 1]),
        np.abs(wrap(difference[:, 2])),
        np.abs(difference[:, 3]),
        np.abs(difference[:, 4]),
    )


def _truth_differences(run: Run, robots: Iterable[Robot]) -> TruthDifferences | None:
    """Compare the ground truth of a run with simulated robots at the same stamps.

    None: no message has the stamp of a robot, or the robots have no drift.
    """
    at = {robot.stamp: robot for robot in robots if robot.model.drift is not None}
    truth = run.ground_truth
    rows = [index for index, stamp in enumerate(truth.stamps.tolist()) if stamp in at]
    if not rows:
        return None
    truths = [at[stamp] for stamp in truth.stamps[rows].tolist()]
    simulated = [(*robot.true_pose_tuple, *robot.true_twist) for robot in truths]
    return TruthDifferences(*_differences(truth.values[rows], simulated))


def largest_covariance_difference(robots: Iterable[Robot], recorded: Array) -> float:
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


# --- What is missing


def _missing(run: Run) -> Iterator[str]:
    """Name what a whole recording of a `virtual_robot` has and this one lacks."""
    for topic, count in (Counter(run.skipped) + Counter(run.missing)).items():
        if base_name(topic) in _NEEDED:
            yield f'{count} messages on {printable(topic)} (see the notes)'
    # Without its parameters the robot may be any other.
    if run.of_node(ROBOT) and not len(run.start_pose):
        yield 'start_pose: where the odometry began is not verified'
    # The robot publishes one of each at the same stamp.
    together = {'odom': run.odometry, 'joint_states': run.wheels, 'ground_truth': run.ground_truth}
    lost = _topics_with_faults(run)
    for name, series in together.items():
        there = [one.stamps for other, one in together.items() if other not in lost | {name}]
        if not len(series) or name in lost or not there:
            continue
        others = np.concatenate(there)
        stamps = np.setdiff1d(others, series.stamps)
        begins, ends = series.stamps.min(), others.max(initial=0)
        # Of the last time a recording may have the first message only, which is that of the odometry.
        gaps = stamps[(stamps > begins) & ((stamps < ends) | (name == 'odom'))]
        # A recorder finds topics one after the other, but within a second.
        if len(stamps) and stamps.min() < begins - MARGIN:
            gaps = np.union1d(stamps[stamps < begins], gaps)
        if len(gaps):
            when = [f'{seconds(stamp - run.odometry.stamps[0]):.3f} s' for stamp in gaps.tolist()]
            more = f' and {len(when) - _MAX_NAMED} more' if len(when) > _MAX_NAMED else ''
            yield f'{name} at {", ".join(when[:_MAX_NAMED])}{more}, when the robot published the others'


def _topics_with_faults(run: Run) -> set[str]:
    """Return the topics of which faults of a lockstep world may lose what the recorder would get."""
    return {base_name(str(event.arguments.get('topic', ''))) for _, event in run.fault_events}


def _notes(run: Run, driven: Driven, found: Verification) -> Iterator[str]:
    """Describe what was not compared, and what may be the cause of differences."""
    exact = driven.source == 'cmd_vel_out'
    if not exact:
        yield 'the velocities were not compared: when each command took effect is in cmd_vel_out'
    if driven.missed:
        begun = found.seconds[0]
        yield (
            'the robot moved before the first command that was recorded: what it was commanded before '
            f'is missing, and it was verified from {begun:.3f} s on'
        )
    if omitted := len(run.odometry) - len(found.seconds):
        yield (
            f'{omitted} of {len(run.odometry)} odometry messages precede the start of the simulated '
            'robot and were not compared'
        )
    if exact and (lost := _topics_with_faults(run) & {*_NEEDED}):
        yield f'missing messages of {", ".join(sorted(lost))} were not looked for: faults may lose them'
    if found.truth is None and len(run.ground_truth):
        yield (
            'ground_truth was not compared: it needs the parameters of virtual_robot, cmd_vel_out and '
            'the first start_pose'
        )
    robot = run.of_node(ROBOT)
    if exact and robot and found.covariance_difference is None:
        yield (
            'the covariances were not compared: they need the first start_pose, and valid parameters of '
            'virtual_robot that do not change its wheels'
        )
    if not exact or found.agrees(EXACT, EXACT):
        return
    if not robot:
        yield (
            'the parameters of virtual_robot were not recorded: the motion of a robot with limits of '
            'the acceleration, a lag or a delay cannot be reproduced without them'
        )
    elif not run.parameter_events or not run.fault_events:
        yield (
            'if parameters of the robot changed, or a fault of a lockstep world acted on its motors, '
            '/parameter_events and /fault_events must be recorded'
        )
