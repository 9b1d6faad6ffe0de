"""A client of go_to_goal: it sends a goal, and detects that its controller was lost."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger

from diffdrive_jacobian.messages import conversion as messages
from diffdrive_jacobian.messages.conversion import MessageError

SILENCE = 3.0
"""A controller that has not answered for this long was killed, or hangs (s)."""


class GoalSender(Node):  # type: ignore[misc]
    """Sends one goal and follows its status and the odometry of the robot."""

    def __init__(
        self, goal: NDArray[np.float64], frame: str, context: Context, readers: int = 1
    ) -> None:
        """Create the publisher, the subscriptions and the client.

        Args:
            goal: `[x, y, theta]`, shape (3,) (m, m, rad).
            frame: Frame of the goal; empty: the odometry's.
            context: Context of the node.
            readers: Number of readers that goal_pose must have before the goal can be sent.
        """
        super().__init__('send_goal', context=context, start_parameter_services=False)
        self.goal = goal
        self.status = GoalStatus.STATUS_UNKNOWN
        self.pose: NDArray[np.float64] | None = None
        self.seen = time.monotonic()
        """Time of the last odometry, or since when it is waited for (s, monotonic)."""
        self._frame = frame
        self._readers = readers
        self._message: PoseStamped | None = None
        self._publisher = self.create_publisher(PoseStamped, 'goal_pose', 10)
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(GoalStatus, 'goal_status', self._on_status, latched)
        self.create_subscription(Odometry, 'odom', self._on_odometry, 10)
        # rclpy reports a name that is too long only here.
        self.resolve_service_name('cancel_goal')
        self._cancel = self.create_client(Trigger, 'cancel_goal')

    @property
    def distance(self) -> float:
        """Distance to the goal (m); infinite before the first odometry."""
        if self.pose is None:
            return math.inf
        return math.hypot(self.goal[0] - self.pose[0], self.goal[1] - self.pose[1])

    def controllers(self) -> dict[bytes, str]:
        """Map the publishers of goal_status, by GID, to the fully qualified names of their nodes.

        The readers of goal_pose are not only controllers. The name is empty while it is unknown.
        """
        topic = self.resolve_topic_name('goal_status')
        return {
            bytes(info.endpoint_gid): ''.join(map(_full_name, _nodes([info])))
            for info in self.get_publishers_info_by_topic(topic)
        }

    def obstacle(self) -> str | None:
        """Return what is missing before a goal can be sent; None: nothing."""
        if self.get_clock().now().nanoseconds == 0:
            return 'use_sim_time is true, but nothing came on /clock'
        readers = [
            reader
            for reader in self.get_subscriptions_info_by_topic(self.resolve_topic_name('goal_pose'))
            # One that requests transient local durability is never matched with this publisher.
            if reader.qos_profile.durability != DurabilityPolicy.TRANSIENT_LOCAL
        ]
        publishers = self.get_publishers_info_by_topic(self.resolve_topic_name('goal_status'))
        found = self._publisher.get_subscription_count()
        if readers and found < self._readers:
            topic = self.resolve_topic_name('goal_pose')
            return f'{topic} has {found} of {self._readers} readers'
        matched = found >= len(readers)
        if not (matched and _nodes(readers) & _nodes(publishers)):
            return (
                f'nobody reads {self.resolve_topic_name("goal_pose")} and publishes '
                f'{self.resolve_topic_name("goal_status")}; is go_to_goal running, in the same '
                'namespace and the same ROS_DOMAIN_ID?'
            )
        return None

    def confirmed(self, timeout: float) -> bool:
        """Wait (s) until the readers have acknowledged the goal; return whether they have."""
        acknowledged: bool = self._publisher.wait_for_all_acked(Duration(seconds=timeout))
        return acknowledged

    def send(self) -> None:
        """Publish the goal; its stamp distinguishes it from older ones."""
        message = PoseStamped()
        message.header.stamp, message.header.frame_id = (
            self.get_clock().now().to_msg(),
            self._frame,
        )
        messages.set_pose(message.pose, self.goal)
        self._message = message
        self._publisher.publish(message)
        self.seen = time.monotonic()

    def cancel(self) -> None:
        """Ask the controller to cancel the goal."""
        self._cancel.call_async(Trigger.Request())

    def _on_status(self, message: GoalStatus) -> None:
        # The status of an older goal is latched and comes first.
        if self._message is not None and message.goal_info.stamp == self._message.header.stamp:
            self.status = message.status

    def _on_odometry(self, message: Odometry) -> None:
        try:
            self.pose = messages.from_pose(message.pose.pose)
            self.seen = time.monotonic()
        except MessageError as error:
            self.get_logger().warning(f'odometry dropped: {error}', throttle_duration_sec=2.0)


def _nodes(endpoints: Iterable[Any]) -> set[tuple[str, str]]:
    """Return the nodes of endpoints; the name of a node may be discovered later than its topics."""
    return {
        (endpoint.node_namespace, endpoint.node_name)
        for endpoint in endpoints
        if not endpoint.node_name.startswith('_')
    }


def _full_name(node: tuple[str, str]) -> str:
    namespace, name = node
    return f'{namespace.rstrip("/")}/{name}'


def loss(sent_to: Mapping[bytes, str], present: Mapping[bytes, str], silence: float) -> str | None:
    """Return why a goal is lost; None: it is not.

    Args:
        sent_to: The controllers to which the goal was sent, as `GoalSender.controllers` returns them.
        present: The controllers of now.
        silence: The time since any of them answered (s).
    """
    if not sent_to.keys() & present.keys():
        return 'the controller is gone'
    # DDS may list one that was killed for 20 s more, beside its successor.
    successors = {present[gid] for gid in present.keys() - sent_to.keys()}
    if restarted := sorted(successors & set(sent_to.values()) - {''}):
        return f'the controller {restarted[0]} was restarted'
    if silence >= SILENCE:
        names = ', '.join(sorted(set(sent_to.values()) - {''}))
        return f'the controller {names} has not answered for {SILENCE:g} s: it was killed, or hangs'
    return None
