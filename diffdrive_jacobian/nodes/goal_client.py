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

"""A client of the controller go_to_goal: it sends goals, and follows their status and the odometry."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Goals, Odometry
from nav_msgs.msg import Path as PathMessage
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger

from diffdrive_jacobian.control import Arrival, Path
from diffdrive_jacobian.control.controllers import CONTROLLERS
from diffdrive_jacobian.control.path import PathProgress
from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.messages.codecs import GOAL_STATUS, ODOMETRY_STATE, State, Status
from diffdrive_jacobian.messages.conversion import MessageError, from_time, set_pose, set_time
from diffdrive_jacobian.messages.goal_status import GoalFollower, GoalState
from diffdrive_jacobian.messages.names import is_named, node_of
from diffdrive_jacobian.ros.node import THROTTLE
from diffdrive_jacobian.ros.serialization import ignoring_invalid
from diffdrive_jacobian.ros.topic_errors import explaining_failure, whole_or_nothing
from diffdrive_jacobian.time_units import NANOSECONDS, nanoseconds

DRIVEN_POINT_PARAMETERS = ('controller', 'offset')
"""Parameters of a controller that determine which point of the robot it drives."""
MESSAGES: dict[str, type] = {'goal_pose': PoseStamped, 'goals': Goals, 'path': PathMessage}
"""Topic of goals to its type."""


def goals_message(
    topic: str,
    goals: NDArray[np.float64],
    now: int,
    times: NDArray[np.float64] | None = None,
    frame: str = '',
) -> Any:
    """Return the message for a topic of `MESSAGES` with goals, shape (n, 3) (m, m, rad).

    `now` is its stamp (ns). `times`, shape (n) (s), are those of the poses of a trajectory since then.
    """
    poses = [PoseStamped() for _ in goals]
    for pose, goal in zip(poses, goals, strict=True):
        set_pose(pose.pose, goal)
    for pose, time_ in zip(poses, times.tolist(), strict=True) if times is not None else ():
        set_time(pose.header.stamp, now + nanoseconds(time_))
    message = poses[0]
    if topic != 'goal_pose':
        message = Goals(goals=poses) if topic == 'goals' else PathMessage(poses=poses)
    set_time(message.header.stamp, now)
    message.header.frame_id = frame
    return message


def path_message(path: Path, stamp: int = 0, frame: str = '') -> PathMessage:
    """Return the message with a path.

    Args:
        path: The path. The poses of a trajectory have stamps.
        stamp: Stamp of the message (ns).
        frame: Frame of the path.
    """
    return goals_message('path', path.poses, stamp, path.times, frame)


class GoalClient(Node):  # type: ignore[misc]
    """Sends goals and follows their status and the odometry of the robot."""

    def __init__(
        self,
        name: str,
        goals: NDArray[np.float64] | Path,
        context: Context,
        *,
        topic: Literal['goal_pose', 'goals'] = 'goals',
        relative: bool = False,
        frame: str = '',
        readers: int = 1,
        monotonic: Callable[[], float] = time.monotonic,
        **kwargs: Any,
    ) -> None:
        """Create the publisher, the subscriptions and the client of cancel_goal.

        Args:
            name: Name of the node.
            goals: `[x, y, theta]` of each goal in order, shape (n, 3) (m, m, rad), or a path.
            context: Context of the node.
            topic: Where goals are published. goal_pose takes one goal. A path is published on path.
            relative: Whether the coordinates are in the body frame of the robot when they are sent.
            frame: Frame of the goals. Empty: the frame of the odometry.
            readers: Number of subscriptions that the topic must have before the goals can be sent.
            monotonic: Returns a time that never goes back (s), in lockstep world time.
            kwargs: Passed on to `rclpy.node.Node`.

        Raises:
            ParameterError: A topic has another type in this process.
            ValueError: `goals` has another shape than the topic takes.
        """
        poses, used = (goals.poses, 'path') if isinstance(goals, Path) else (goals, topic)
        if poses.ndim != 2 or poses.shape[1] != 3 or not len(poses):
            raise ValueError(f'goals must have shape (n, 3) with n > 0, got {poses.shape}')
        if used == 'goal_pose' and len(poses) != 1:
            raise ValueError(f'goal_pose takes one goal, got {len(poses)}')
        super().__init__(name, context=context, **kwargs)
        self.goals = poses
        self.index = 0
        """Index of the goal that is being driven to."""
        self.path = PathProgress(goals) if isinstance(goals, Path) else None
        """The path and the progress along it. None: goals are sent."""
        # Times of the first and the last odometry while it was driven along (ns).
        self._begun = self._latest = 0
        self.arrival = Arrival()
        """Determines which point of the robot is to arrive. The default is the axle centre."""
        self.robot: State | None = None
        """The robot by the last odometry. None: no odometry was received."""
        self.stamp = 0
        """Stamp of the last odometry (ns)."""
        self._monotonic = monotonic
        self.seen = monotonic()
        """Time of the last odometry, or since when it is expected (s, monotonic)."""
        self._frame = frame
        self._readers = readers
        self.topic: str = used
        """Where the goals are published."""
        self._relative = relative
        self._send_on_odometry = False
        self._follower: GoalFollower[NDArray[np.float64]] = GoalFollower()
        with whole_or_nothing(self):
            self._create()
        self._canceling: Any = None

    def _create(self) -> None:
        """Create the publisher, the subscriptions and the client."""
        with explaining_failure(self, MESSAGES[self.topic], self.topic):
            self._publisher = self.create_publisher(MESSAGES[self.topic], self.topic, 10)
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        with explaining_failure(self, GoalStatus, 'goal_status'):
            received = ignoring_invalid(GOAL_STATUS, GoalStatus, self._on_status)
            self.create_subscription(GoalStatus, 'goal_status', received, latched, raw=True)
        with explaining_failure(self, Odometry, 'odom'):
            moved = ignoring_invalid(
                ODOMETRY_STATE, Odometry, self._on_odometry, self._on_invalid_odometry
            )
            self.create_subscription(Odometry, 'odom', moved, 10, raw=True)
        # rclpy reports a name that is too long only here.
        self.resolve_service_name('cancel_goal')
        self._cancel = self.create_client(Trigger, 'cancel_goal')

    @property
    def distance(self) -> float:
        """Distance from the point that is to arrive to the current goal (m).

        Of a path what remains of it, and after the arrival the distance from its end. Infinite before
        the first odometry.
        """
        if self.robot is None:
            return math.inf
        if self.path is not None:
            if self.status is not GoalState.SUCCEEDED:
                return self.path.remaining
            return float(self.arrival.distance(*self.robot.pose, *self.goals[-1, :2]))
        return float(self.arrival.distance(*self.robot.pose, *self.goals[self.index, :2]))

    @property
    def sent(self) -> bool:
        """Whether the goals were published."""
        return self._follower.newest is not None

    @property
    def readers(self) -> int:
        """Number of the discovered subscriptions that receive the goals."""
        return int(self._publisher.get_subscription_count())

    @property
    def status(self) -> GoalState:
        """Last status of the goals."""
        sent = self._follower.newest
        return GoalState.UNKNOWN if sent is None else sent.state

    @property
    def late(self) -> float:
        """How much later than by its times the end of a trajectory was reached (s).

        NaN: it was not, or the goals have no times.
        """
        if self.path is None or self.path.path.times is None or self.status is not GoalState.SUCCEEDED:
            return math.nan
        seconds = (self._latest - self._begun) / NANOSECONDS
        return max(seconds - self.path.path.duration, 0.0)

    @property
    def ended(self) -> bool:
        """Whether the controller has finished with the goals, in whatever way."""
        return self.status.ended

    # --- Goals

    def send(self) -> None:
        """Publish the goals. Their stamp distinguishes them from older ones."""
        self._send_on_odometry = False
        if self._relative and self.robot is not None:
            self._relative, self.goals = False, se2.compose(self.robot.pose, self.goals)
            if self.path is not None:
                self.path = PathProgress(Path(self.goals, self.path.path.times))
        times = None if self.path is None else self.path.path.times
        now = self.get_clock().now().nanoseconds
        message = goals_message(self.topic, self.goals, now, times, self._frame)
        # The latched status of an older goal with this stamp is none of these.
        self._follower = GoalFollower()
        self._follower.sent(self.goals, (message.header.stamp.sec, message.header.stamp.nanosec))
        self._publisher.publish(message)
        self.seen = self._monotonic()

    def send_on_odometry(self) -> None:
        """Publish the goals when the next odometry is received."""
        self._send_on_odometry = True

    def withdraw(self) -> None:
        """Do not send goals that wait for odometry."""
        self._send_on_odometry = False

    def cancel(self) -> None:
        """Request the controller to cancel its goal."""
        self._canceling = self._cancel.call_async(Trigger.Request())

    @property
    def cancel_answer(self) -> str:
        """What the controller answered to the request to cancel; '': nothing yet."""
        future = self._canceling
        if future is None or not future.done() or future.exception() is not None:
            return ''
        return str(future.result().message)

    def confirmed(self, timeout: float) -> bool:
        """Wait for a time (s) until the goals are acknowledged by all; return whether they are."""
        acknowledged: bool = self._publisher.wait_for_all_acked(Duration(seconds=timeout))
        return acknowledged

    # --- Controllers

    def controllers(self) -> dict[bytes, str]:
        """Map the controllers to the fully qualified names of their nodes.

        A controller is a node that is subscribed to the goals and publishes goal_status. It is known by
        the GID of that publisher.
        """
        readers = {node_of(reader) for reader in self._reachable()}
        return {
            bytes(info.endpoint_gid): node_of(info)
            for info in self.get_publishers_info_by_topic(self.resolve_topic_name('goal_status'))
            if is_named(info) and node_of(info) in readers
        }

    def _reachable(self) -> list[Any]:
        """Return the subscriptions to the goals.

        One with transient local durability is never matched with this publisher.
        """
        topic = self.resolve_topic_name(self.topic)
        return [
            reader
            for reader in self.get_subscriptions_info_by_topic(topic)
            if reader.qos_profile.durability != DurabilityPolicy.TRANSIENT_LOCAL
        ]

    def obstacle(self) -> str | None:
        """Describe what is missing before goals can be sent. None: nothing."""
        if self.get_clock().now().nanoseconds == 0:
            return 'use_sim_time is true, but nothing is published on /clock'
        topic, status = self.resolve_topic_name(self.topic), self.resolve_topic_name('goal_status')
        readers, matched = self._reachable(), self.readers
        if not readers or not self.controllers():
            return (
                f'no node is subscribed to {topic} and publishes {status}; is go_to_goal running, in '
                'the same namespace and the same ROS_DOMAIN_ID?'
            )
        if matched < (wanted := max(self._readers, len(readers))):
            return f'{topic} has {matched} of {wanted} subscriptions'
        if self._relative and self.robot is None:
            return f'no odometry on {self.resolve_topic_name("odom")}, where the path is to begin'
        return None

    # --- Messages

    def _on_status(self, one: Status) -> None:
        self._follower.reported(one.status, one.stamp)

    def _on_invalid_odometry(self, error: MessageError) -> None:
        # Other processes may publish, and anything.
        self.get_logger().warning(f'odometry dropped: {error}', throttle_duration_sec=THROTTLE)

    def _on_odometry(self, state: State) -> None:
        self.stamp = from_time(*state.stamp)
        self.robot = state
        self.seen = self._monotonic()
        if self._send_on_odometry:
            self.send()
        if self.path is not None and self.status is GoalState.EXECUTING:
            self.path.moved(np.array(state.pose))
            self._begun, self._latest = self._begun or self.stamp, self.stamp


def driven_offset(values: Mapping[str, Any]) -> float:
    """Return x of the point that a controller with these `DRIVEN_POINT_PARAMETERS` drives (m).

    It is in the body frame; 0: the axle centre. Invalid values, of any node, count as missing.
    """
    controller = CONTROLLERS.built_in.get(str(values.get('controller')))
    offset = None if controller is None else values.get(controller.offset)
    return offset if isinstance(offset, float) and math.isfinite(offset) else 0.0
