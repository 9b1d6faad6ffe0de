"""A client of the controller go_to_goal: it sends goals, and follows their status and the odometry."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Goals, Odometry
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger

from diffdrive_jacobian.control import Arrival
from diffdrive_jacobian.messages import conversion as messages
from diffdrive_jacobian.messages.codecs import (
    GOAL_STATUS,
    ODOMETRY,
    STAMP,
    Codec,
    Status,
    pose_fields,
)
from diffdrive_jacobian.messages.conversion import MessageError, from_pose, from_time
from diffdrive_jacobian.messages.goal_follower import GoalFollower
from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.messages.names import is_named, node_of
from diffdrive_jacobian.ros.node import THROTTLE
from diffdrive_jacobian.ros.serialization import ignoring_invalid
from diffdrive_jacobian.ros.topic_errors import explaining_failure

SILENCE = 3.0
"""A controller that has not answered for this long was killed or hangs (s)."""
DRIVEN_POINT_PARAMETERS = ('controller', 'offset')
"""Parameters of a controller that determine which point of the robot it drives."""
MESSAGES: dict[str, type] = {'goal_pose': PoseStamped, 'goals': Goals}
"""Topic of goals to its type."""


class RobotOdometry(NamedTuple):
    """What an odometry message says about the robot."""

    pose: NDArray[np.float64]
    """`[x, y, theta]`, shape (3,) (m, m, rad)."""
    moving: bool
    """Whether its twist is not zero."""
    stamp: int
    """Timestamp of the message (ns)."""


def _state(sec: int, nanosec: int, v: float, omega: float, *pose: float) -> RobotOdometry:
    return RobotOdometry(np.array(from_pose(*pose)), (v, omega) != (0.0, 0.0), from_time(sec, nanosec))


STATE = Codec(
    ODOMETRY.type_name,
    (
        *(*STAMP, 'twist.twist.linear.x', 'twist.twist.angular.z'),
        *pose_fields(ODOMETRY.type_name),
    ),
    _state,
)
"""What a client reads of odometry. The twist only tells whether the robot moves: it may be anything."""


class GoalClient(Node):  # type: ignore[misc]
    """Sends goals and follows their status and the odometry of the robot."""

    def __init__(
        self,
        name: str,
        goals: NDArray[np.float64],
        context: Context,
        *,
        topic: Literal['goal_pose', 'goals'] = 'goals',
        frame: str = '',
        readers: int = 1,
        monotonic: Callable[[], float] = time.monotonic,
        **kwargs: Any,
    ) -> None:
        """Create the publisher, the subscriptions and the client of cancel_goal.

        Args:
            name: Name of the node.
            goals: `[x, y, theta]` of each goal in order, shape (n, 3) (m, m, rad).
            context: Context of the node.
            topic: Where they are published. goal_pose takes one goal.
            frame: Frame of the goals. Empty: the frame of the odometry.
            readers: Number of subscriptions that the topic must have before the goals can be sent.
            monotonic: Returns a time that never goes back (s), in lockstep world time.
            kwargs: Passed on to `rclpy.node.Node`.

        Raises:
            ParameterError: A topic has another type in this process.
            ValueError: `goals` has another shape than the topic takes.
        """
        if goals.ndim != 2 or goals.shape[1] != 3 or not len(goals):
            raise ValueError(f'goals must have shape (n, 3) with n > 0, got {goals.shape}')
        if topic == 'goal_pose' and len(goals) != 1:
            raise ValueError(f'goal_pose takes one goal, got {len(goals)}')
        super().__init__(name, context=context, **kwargs)
        self.goals = goals
        self.index = 0
        """Index of the goal that is being driven to."""
        self.arrival = Arrival()
        """Determines which point of the robot is to arrive. The default is the axle centre."""
        self.robot: RobotOdometry | None = None
        """State in the last odometry. None: no odometry was received."""
        self._monotonic = monotonic
        self.seen = monotonic()
        """Time of the last odometry, or since when it is expected (s, monotonic)."""
        self._frame = frame
        self._readers = readers
        self._topic = topic
        self._send_on_odometry = False
        self._follower: GoalFollower[NDArray[np.float64]] = GoalFollower()
        with explaining_failure(self, MESSAGES[topic], topic):
            self._publisher = self.create_publisher(MESSAGES[topic], topic, 10)
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        with explaining_failure(self, GoalStatus, 'goal_status'):
            received = ignoring_invalid(GOAL_STATUS, GoalStatus, self._on_status)
            self.create_subscription(GoalStatus, 'goal_status', received, latched, raw=True)
        with explaining_failure(self, Odometry, 'odom'):
            moved = ignoring_invalid(STATE, Odometry, self._on_odometry, self._on_invalid_odometry)
            self.create_subscription(Odometry, 'odom', moved, 10, raw=True)
        # rclpy reports a name that is too long only here.
        self.resolve_service_name('cancel_goal')
        self._cancel = self.create_client(Trigger, 'cancel_goal')

    @property
    def distance(self) -> float:
        """Distance from the point that is to arrive to the current goal (m). Infinite before the first
        odometry.
        """
        if self.robot is None:
            return math.inf
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
    def ended(self) -> bool:
        """Whether the controller has finished with the goals, in whatever way."""
        return self.status.ended

    # --- Goals

    def send(self) -> None:
        """Publish the goals. Their stamp distinguishes them from older ones."""
        self._send_on_odometry = False
        message = self._goals()
        messages.set_time(message.header.stamp, self.get_clock().now().nanoseconds)
        message.header.frame_id = self._frame
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
        self._cancel.call_async(Trigger.Request())

    def confirmed(self, timeout: float) -> bool:
        """Wait until the goals are acknowledged by every subscription.

        Args:
            timeout: Longest wait (s).

        Returns:
            Whether they are.
        """
        acknowledged: bool = self._publisher.wait_for_all_acked(Duration(seconds=timeout))
        return acknowledged

    def _goals(self) -> PoseStamped | Goals:
        poses = [PoseStamped() for _ in self.goals]
        for pose, goal in zip(poses, self.goals, strict=True):
            messages.set_pose(pose.pose, goal)
        return Goals(goals=poses) if self._topic == 'goals' else poses[0]

    # --- Controllers

    def controllers(self) -> dict[bytes, str]:
        """Map the publishers of goal_status, by GID, to the fully qualified names of their nodes.

        Not every node that is subscribed to the goals is a controller. A name is empty while it is
        unknown.
        """
        topic = self.resolve_topic_name('goal_status')
        return {
            bytes(info.endpoint_gid): node_of(info) if is_named(info) else ''
            for info in self.get_publishers_info_by_topic(topic)
        }

    def set_controller_parameters(self, values: Mapping[str, Any]) -> None:
        """Set the point that is to arrive from the controller's `DRIVEN_POINT_PARAMETERS`."""
        self.arrival = Arrival(offset=driven_offset(values))

    def obstacle(self) -> str | None:
        """Describe what is missing before goals can be sent. None: nothing."""
        if self.get_clock().now().nanoseconds == 0:
            return 'use_sim_time is true, but nothing is published on /clock'
        topic, status = self.resolve_topic_name(self._topic), self.resolve_topic_name('goal_status')
        readers = [
            reader
            for reader in self.get_subscriptions_info_by_topic(topic)
            # A subscription with transient local durability is never matched with this publisher.
            if reader.qos_profile.durability != DurabilityPolicy.TRANSIENT_LOCAL
        ]
        matched = self.readers
        if readers and matched < self._readers:
            return f'{topic} has {matched} of {self._readers} subscriptions'
        publishers = self.get_publishers_info_by_topic(status)
        if matched < len(readers) or not _nodes(readers) & _nodes(publishers):
            return (
                f'no node is subscribed to {topic} and publishes {status}; is go_to_goal running, in '
                'the same namespace and the same ROS_DOMAIN_ID?'
            )
        return None

    # --- Messages

    def _on_status(self, one: Status) -> None:
        self._follower.reported(one.status, one.stamp)

    def _on_invalid_odometry(self, error: MessageError) -> None:
        # Other processes may publish, and anything.
        self.get_logger().warning(f'odometry dropped: {error}', throttle_duration_sec=THROTTLE)

    def _on_odometry(self, state: RobotOdometry) -> None:
        self.robot = state
        self.seen = self._monotonic()
        if self._send_on_odometry:
            self.send()


def driven_offset(values: Mapping[str, Any]) -> float:
    """Return x of the point that a controller drives, in the body frame (m). 0: the axle centre.

    Args:
        values: Values of `DRIVEN_POINT_PARAMETERS`, of any node. Invalid values count as missing.
    """
    offset = values.get('offset')
    if values.get('controller') != 'offset_point' or not isinstance(offset, float):
        return 0.0
    return offset if math.isfinite(offset) else 0.0


def _nodes(endpoints: Iterable[Any]) -> set[str]:
    """Return the names of the nodes of endpoints, as far as they are known."""
    return {node_of(endpoint) for endpoint in endpoints if is_named(endpoint)}


def loss(
    sent_to: Mapping[bytes, str],
    present: Mapping[bytes, str],
    silence: float,
    partial_silence: Mapping[str, float],
) -> str | None:
    """Describe why the controller of a goal is lost. None: it is not.

    Args:
        sent_to: The controllers to which the goal was sent, as from `GoalClient.controllers`.
        present: The controllers that are present now.
        silence: Time since any of them answered (s).
        partial_silence: For how long fewer nodes of each name have answered than the graph lists (s).
    """
    namesakes = _namesakes(sent_to, present)
    if not sent_to.keys() & present.keys():
        if namesakes:
            return f'the controller {namesakes[0]} was restarted'
        return 'the controller is gone'
    if silence >= SILENCE:
        names = ', '.join(sorted(set(sent_to.values()) - {''}))
        return f'the controller {names} has not answered for {SILENCE:g} s: it was killed or hangs'
    # DDS may list one that was killed for 20 s more, beside its successor, which answers alone.
    for name in namesakes:
        if partial_silence.get(name, 0.0) >= SILENCE:
            return f'the controller {name} was restarted'
    return None


def duplicates(sent_to: Mapping[bytes, str], present: Mapping[bytes, str]) -> list[str]:
    """Return the names of controllers of a goal that other nodes have as well, sorted.

    Args:
        sent_to: The controllers to which the goal was sent, as from `GoalClient.controllers`.
        present: The controllers that are present now.
    """
    remaining = {gid: name for gid, name in sent_to.items() if gid in present}
    return [name for name in _namesakes(sent_to, present) if name in remaining.values()]


def _namesakes(sent_to: Mapping[bytes, str], present: Mapping[bytes, str]) -> list[str]:
    """Return the names that later controllers share with those of the goal, sorted."""
    later = {present[gid] for gid in present.keys() - sent_to.keys()}
    return sorted(later & set(sent_to.values()) - {''})
