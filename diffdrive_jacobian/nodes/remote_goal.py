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

"""A goal or a path that is sent to a controller in another process, and followed until it has ended."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.control import Arrival, Path
from diffdrive_jacobian.messages.conversion import MAX_PATH_POSES
from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.nodes.goal_client import DRIVEN_POINT_PARAMETERS, GoalClient, driven_offset
from diffdrive_jacobian.numerics.checks import number, positive_or_infinite
from diffdrive_jacobian.parameters.chosen_law import ignores_heading
from diffdrive_jacobian.ros.fastdds_profiles import fast_heartbeats
from diffdrive_jacobian.ros.runner import NodeRunner, ros_context, running
from diffdrive_jacobian.ros.service_client import Liveness
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import listed, printable

NAME, PATH_NAME = 'send_goal', 'send_path'
"""Names of the node that sends a goal and of the one that sends a path."""
PATIENCE = 10.0
"""Default of the longest wait for a controller (s)."""
ANSWER_PATIENCE = 5.0
"""Longest time in which a controller may accept a goal, or confirm that it canceled (s)."""
CONFIRMATION_PERIOD = 0.1
"""Time between two checks whether the goal was acknowledged (s)."""
PARAMETER_PATIENCE = 1.0
"""Longest time in which a controller may report its parameters (s)."""
DISCOVERY_PERIOD = 1.0
"""Time between two queries of the publishers of goal_status (s)."""
SILENCE = 3.0
"""A controller that has not answered for this long was killed or hangs (s)."""
STANDSTILL_PATIENCE = 5.0
"""Time without motion after which a robot stands still (s)."""
MIN_DISTANCE = 0.005
"""Smallest displacement that is motion (m): more than the noise of odometry at rest."""
MIN_ROTATION = 0.01
"""Smallest rotation that is motion (rad)."""
Pose = tuple[float, float, float]
HEADING_PARAMETERS = (*DRIVEN_POINT_PARAMETERS, 'use_goal_heading')
"""Parameters of a controller that also determine whether it takes the heading of a goal."""


class Result(Enum):
    """The end of a goal, as its client sees it."""

    NOT_SENT = auto()
    """No controller was discovered in time."""
    SEVERAL = auto()
    """Several controllers answered: it was not sent."""
    UNCONFIRMED = auto()
    """It was sent, but not acknowledged by every subscription."""
    SENT = auto()
    """It was sent and acknowledged. It was not followed."""
    NO_ANSWER = auto()
    """The controller did not report whether it accepts the goal."""
    ENDED = auto()
    """The controller reported the end; `GoalResult.status` says which."""
    LOST = auto()
    """The controller was killed, was restarted or hangs."""
    TIMEOUT = auto()
    """It did not end in time, and was canceled."""
    INTERRUPTED = auto()
    """A signal came: it was not sent, or was canceled."""


@dataclass(frozen=True, kw_only=True, slots=True)
class GoalResult:
    """What became of a goal."""

    result: Result
    topic: str
    """Fully qualified name of the topic on which the goal is published."""
    status: GoalState = GoalState.UNKNOWN
    """Last status that the controller reported."""
    distance: float | None = None
    """Distance from the driven point to the goal at the end, of a path what remained of it (m). None: no
    odometry was received."""
    across: float | None = None
    """Greatest distance of the robot from the path (m). None: it was a goal, or was not driven along."""
    late: float | None = None
    """How much later than by the trajectory the robot arrived (s). None: it did not, or there were no
    times."""
    reason: str = ''
    """For NOT_SENT what is missing, for SEVERAL the controllers, for LOST what happened to the
    controller; where it canceled, its answer, which may say how far the robot rolls on."""
    canceled: bool | None = None
    """Whether the controller confirmed that it canceled the goal. None: it was not asked to."""

    @property
    def arrived(self) -> bool:
        """Whether the robot arrived at the goal."""
        return self.result is Result.ENDED and self.status is GoalState.SUCCEEDED

    @property
    def acknowledged(self) -> bool:
        """Whether the goal was sent and acknowledged, and not followed."""
        return self.result is Result.SENT

    @property
    def interrupted(self) -> bool:
        """Whether a signal ended the wait."""
        return self.result is Result.INTERRUPTED


class RemoteProgress:
    """Receives the progress of a goal. This one ignores it."""

    def waiting(self, reason: str) -> None:
        """Receive what is waited for, many times a second."""

    def heading_ignored(self, controller: str) -> None:
        """Receive the name of a controller that ignores the heading of the goal, once."""

    def driving(self, distance: float) -> None:
        """Receive the distance from the driven point to the goal (m), many times a second."""

    def no_odometry(self, topic: str, seconds: float) -> None:
        """Receive that no odometry was received on a topic for so long (s), once for each gap."""

    def standing(self, seconds: float) -> None:
        """Receive that the robot has not moved for so long (s) with the goal, once per standstill."""


def send_goal(
    goal: ArrayLike | Path,
    *,
    relative: bool = False,
    runner: NodeRunner | None = None,
    frame: str = '',
    readers: int = 1,
    patience: float = PATIENCE,
    timeout: float = math.inf,
    follow: bool = True,
    heading_matters: bool = False,
    ros_arguments: Sequence[str] = (),
    signals: Signals | None = None,
    progress: RemoteProgress | None = None,
) -> GoalResult:
    """Send a goal or a path to a controller in another process, and follow it until it has ended.

    Args:
        goal: `[x, y, theta]`, shape (3,) (m, m, rad), or a path; with times a trajectory.
        relative: Whether the coordinates are those in the body frame of the robot where it is now.
            Otherwise they are in `frame`.
        runner: Runs the node until the goal has ended, in real time (`drives.in_real_time`) or in
            lockstep (`drives.in_lockstep`), and may run others. None: a new one does.
        frame: Frame of the goal. Empty: the frame of the odometry.
        readers: Number of subscriptions that the topic must have before the goal is sent.
        patience: Longest wait for the controller and for the subscriptions (s).
        timeout: Time after which the goal is canceled (s).
        follow: Whether to wait for the end. Otherwise for the acknowledgement only.
        heading_matters: Whether to report a controller that ignores the heading of the goal.
        ros_arguments: ROS arguments of the node; those of `runner`, if it is given.
        signals: Counter of the signals that cancel the goal. None: no signal does.
        progress: Receives the progress. An error that it raises cancels the goal, and is passed on.

    Raises:
        UserError: The ROS arguments are invalid, or the node cannot be created.
        ValueError: `goal` has another shape, a path more than 10,000 poses, a time is not positive, or
            `ros_arguments` are given with `runner`.
    """
    goals: NDArray[np.float64] | Path
    if isinstance(goal, Path):
        if len(goal.poses) > MAX_PATH_POSES:
            raise ValueError(f'path must have at most {MAX_PATH_POSES} poses, got {len(goal.poses)}')
        name, goals = PATH_NAME, goal
    else:
        name, goals = NAME, np.asarray(goal, dtype=np.float64)[np.newaxis]
    number('patience', patience, positive_or_infinite)
    number('timeout', timeout, positive_or_infinite)
    if runner is not None and ros_arguments:
        raise ValueError('ros_arguments are those of the runner, if one is given')
    created = runner is None
    with ExitStack() as stack:
        if runner is None:
            if not follow:
                # The acknowledgement is what is waited for.
                stack.enter_context(fast_heartbeats())
            context = stack.enter_context(ros_context([name, *ros_arguments]))
            runner = stack.enter_context(running(context, isolated=False))
        used = runner
        client = used.add(
            lambda: GoalClient(
                name,
                goals,
                used.context,
                topic='goal_pose',
                relative=relative,
                frame=frame,
                readers=readers,
                monotonic=used.seconds,
                start_parameter_services=False,
            )
        )
        if not created:
            stack.callback(used.remove, client)
        session = _Session(client, used, signals or Signals(), progress or RemoteProgress())
        try:
            return session.run(patience, timeout, follow=follow, heading_matters=heading_matters)
        except BaseException:
            session.abandon()
            raise


class _Session:
    """The exchange with a controller about one goal."""

    def __init__(
        self, client: GoalClient, runner: NodeRunner, signals: Signals, progress: RemoteProgress
    ) -> None:
        self._client = client
        self._runner = runner
        self._signals = signals
        self._progress = progress

    def run(self, patience: float, timeout: float, *, follow: bool, heading_matters: bool) -> GoalResult:
        """Find the controller, send the goal, and follow it."""
        obstacle = self._wait(patience, self._client.obstacle)
        if obstacle is not None:
            return self._not_sent(Result.NOT_SENT, obstacle)
        self._await_readers()
        controllers = self._client.controllers()
        parameters = HEADING_PARAMETERS if heading_matters else DRIVEN_POINT_PARAMETERS
        liveness = Liveness(self._client, set(controllers.values()), parameters, self._runner.seconds)
        if several := self._await_parameters(liveness, len(controllers)):
            return self._not_sent(Result.SEVERAL, several)
        if self._signals.count:
            return self._result(Result.INTERRUPTED)
        self._use(liveness)
        self._client.send()
        for name, values in liveness.values.items():
            if heading_matters and ignores_heading(values):
                self._progress.heading_ignored(name)
        if not follow:
            acknowledged = self._await_acknowledgement()
            return self._result(Result.SENT if acknowledged else Result.UNCONFIRMED)
        return self._pursue(liveness, controllers, timeout)

    def _not_sent(self, result: Result, reason: str) -> GoalResult:
        """Return why the goal was not sent."""
        if self._signals.count:
            return self._result(Result.INTERRUPTED)
        return self._result(result, reason=reason)

    def _await_parameters(self, liveness: Liveness, controllers: int) -> str:
        """Wait for the parameters of so many controllers. Return the error if several answer."""
        silent = 'the controller is asked for its parameters'
        self._wait(
            PARAMETER_PATIENCE,
            lambda: None if liveness.answering.total() >= controllers else silent,
            liveness,
        )
        # DDS lists one that was killed for up to 20 s: only those that answer count.
        answering = list(liveness.answering.elements())
        if len(answering) < 2:
            return ''
        return (
            f'several controllers answer, {printable(listed(answering))}: each would drive the robot; '
            'stop all but one, or give each a namespace'
        )

    def _pursue(
        self, liveness: Liveness, controllers: Mapping[bytes, str], timeout: float
    ) -> GoalResult:
        """Follow the goal to its end, or cancel it after a time (s) or on a signal."""
        client, signals = self._client, self._signals
        missing = f'no answer on {client.resolve_topic_name("goal_status")}'
        if self._wait(ANSWER_PATIENCE, lambda: None if client.status else missing, liveness):
            if signals.count:
                return self._cancel(Result.INTERRUPTED)
            # It may accept the goal later, when nobody follows it.
            client.cancel()
            return self._result(Result.NO_ANSWER)
        lost = self._follow(liveness, controllers, timeout)
        if client.ended:
            return self._result(Result.ENDED)
        if lost is not None:
            # A controller that only hangs may receive it when it resumes: nobody follows the goal then.
            client.cancel()
            return self._result(Result.LOST, reason=lost)
        return self._cancel(Result.INTERRUPTED if signals.count else Result.TIMEOUT)

    def abandon(self) -> None:
        """Cancel the goal if it may be active: an error, as of a closed output, ends its pursuit."""
        if self._client.sent and not self._client.ended:
            self._client.cancel()
            self._runner.spin(lambda: self._client.ended, timeout=ANSWER_PATIENCE, signals=self._signals)

    def _turns(self, seconds: float) -> Iterator[float]:
        """Execute callbacks, and yield the time (s) often, for a time (s) or until a signal."""
        return self._runner.turns(timeout=seconds, signals=self._signals)

    def _wait(
        self,
        seconds: float,
        missing: Callable[[], str | None],
        liveness: Liveness | None = None,
    ) -> str | None:
        """Wait until nothing is missing, for a time (s) or until a signal, and report what is.

        Return what is missing at the end; None: nothing. `liveness` sends requests meanwhile.
        """
        reason = None
        for _ in self._turns(seconds):
            if liveness is not None:
                liveness.silence()
            reason = missing()
            if reason is None:
                break
            self._progress.waiting(reason)
        return reason

    def _await_readers(self) -> None:
        """Wait until no more subscriptions are discovered: a recorder needs the goal, too."""
        readers, since = 0, -math.inf
        for now in self._turns(ANSWER_PATIENCE):
            if self._client.readers != readers:
                readers, since = self._client.readers, now
            if now - since >= self._runner.discovery:
                break

    def _await_acknowledgement(self) -> bool:
        """Wait until the goal is acknowledged by every subscription; return whether it is."""
        deadline = self._runner.seconds() + ANSWER_PATIENCE
        while not self._client.confirmed(CONFIRMATION_PERIOD):
            if self._signals.count or self._runner.seconds() > deadline:
                return False
            topic = self._client.resolve_topic_name(self._client.topic)
            self._progress.waiting(f'not every subscription to {topic} has acknowledged the goal')
        return True

    def _use(self, liveness: Liveness) -> None:
        """Use the parameters that the controller has reported last."""
        for values in liveness.values.values():
            self._client.arrival = Arrival(offset=driven_offset(values))

    def _follow(
        self, liveness: Liveness, controllers: Mapping[bytes, str], timeout: float
    ) -> str | None:
        """Wait until the goal has ended, for a time (s) or until a signal.

        Return why the controller is lost; None: it is not.
        """
        client = self._client
        topic = client.resolve_topic_name('odom')
        queried, present = self._runner.seconds(), controllers
        motion = Standstill()
        silent_robot = False
        for now in self._turns(timeout):
            missing = now - client.seen > ANSWER_PATIENCE
            if missing and not silent_robot:
                self._progress.no_odometry(topic, ANSWER_PATIENCE)
            silent_robot = missing
            silence = liveness.silence()
            # They may change while the robot drives.
            self._use(liveness)
            if client.robot is None:
                self._progress.waiting(f'no odometry on {topic}')
            elif not missing:
                self._progress.driving(client.distance)
                if client.status is not GoalState.EXECUTING:
                    motion.reset()
                elif motion.update(client.robot.pose, now):
                    self._progress.standing(STANDSTILL_PATIENCE)
            if client.ended:
                break
            if now - queried >= DISCOVERY_PERIOD:
                queried, present = now, client.controllers()
            lost = loss(controllers, present, silence)
            if lost is not None:
                return lost
        return None

    def _cancel(self, result: Result) -> GoalResult:
        """Cancel the goal, and wait until that is confirmed, or for another signal."""
        client, signals = self._client, self._signals
        distance = self._distance()
        client.cancel()
        for _ in self._runner.turns(timeout=ANSWER_PATIENCE, signals=signals, handled=signals.count):
            if client.ended:
                break
            self._progress.waiting('the controller has not confirmed that it canceled')
        if client.status is GoalState.SUCCEEDED:
            # It arrived meanwhile.
            return self._result(Result.ENDED)
        # The status may be received first.
        self._runner.spin(lambda: bool(client.cancel_answer), timeout=CONFIRMATION_PERIOD)
        answer = client.cancel_answer
        return self._result(result, distance=distance, canceled=client.ended, reason=answer)

    def _distance(self) -> float | None:
        return None if self._client.robot is None else self._client.distance

    def _result(
        self,
        result: Result,
        *,
        reason: str = '',
        distance: float | None = None,
        canceled: bool | None = None,
    ) -> GoalResult:
        client = self._client
        across = math.nan if client.path is None else client.path.greatest
        return GoalResult(
            result=result,
            topic=client.resolve_topic_name(client.topic),
            status=client.status,
            distance=self._distance() if distance is None else distance,
            across=None if math.isnan(across) else across,
            late=None if math.isnan(client.late) else client.late,
            reason=reason,
            canceled=canceled,
        )


def loss(sent_to: Mapping[bytes, str], present: Mapping[bytes, str], silence: float) -> str | None:
    """Describe why the controller of a goal is lost. None: it is not.

    Args:
        sent_to: The controllers to which the goal was sent, as from `GoalClient.controllers`.
        present: The controllers that are present now.
        silence: As of `Liveness` (s).
    """
    later = {name for gid, name in present.items() if gid not in sent_to}
    for name in sorted(later & set(sent_to.values())):
        return (
            f'another controller {printable(name)} has started: the one with the goal was restarted, or '
            'two drive the robot'
        )
    if not sent_to.keys() & present.keys():
        return 'the controller is gone'
    if silence >= SILENCE:
        names = ', '.join(sorted(set(sent_to.values())))
        return f'the controller {names} has not answered for {SILENCE:g} s: it was killed or hangs'
    return None


class Standstill:
    """Detects, from the poses of a robot, that it has not moved for `STANDSTILL_PATIENCE`."""

    def __init__(self) -> None:
        """Start without a pose."""
        self._reference: Pose | None = None
        self._since = 0.0
        self._detected = False

    def reset(self) -> None:
        """Forget the poses: the robot is not expected to move."""
        self._reference = None

    def update(self, pose: Pose, now: float) -> bool:
        """Return whether a robot with a pose at a time (s) stands still, once for each standstill."""
        if self._reference is None or _moved(self._reference, pose):
            self._reference, self._since, self._detected = pose, now, False
            return False
        if self._detected or now - self._since < STANDSTILL_PATIENCE:
            return False
        self._detected = True
        return True


def _moved(before: Pose, after: Pose) -> bool:
    turn = math.remainder(after[2] - before[2], math.tau)
    return math.dist(before[:2], after[:2]) > MIN_DISTANCE or abs(turn) > MIN_ROTATION
