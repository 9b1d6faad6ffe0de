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

"""The process that floods one input of a node: `python flooding.py NODE INPUT SECONDS`.

The messages are serialized before the flood begins, and published as bytes.
"""

from __future__ import annotations

import struct
import sys
import time
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist, TwistStamped
from nav_msgs.msg import Goals, Odometry
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from diffdrive_jacobian.ros.fastdds_profiles import announce_frequently
from diffdrive_jacobian.ros.runner import ros_context


def message(kind: str) -> Any:
    """Return the message of a flood. A robot that receives it moves; a goal is far away."""
    if kind == 'joint_command':
        return JointState(name=['left_wheel_joint', 'right_wheel_joint'], velocity=[1.0, 1.0])
    if kind == 'initialpose':
        placement = PoseWithCovarianceStamped()
        placement.header.frame_id = 'odom'
        placement.pose.pose.orientation.w = 1.0
        return placement
    if kind == 'odom':
        odometry = Odometry(child_frame_id='base_link')
        odometry.header.frame_id = 'odom'
        odometry.pose.pose.orientation.w = 1.0
        return odometry
    if kind in ('goal_pose', 'goals'):
        goal = PoseStamped()
        goal.header.frame_id = 'odom'
        goal.pose.position.x = 1e4
        goal.pose.orientation.w = 1.0
        return goal if kind == 'goal_pose' else Goals(header=goal.header, goals=[goal])
    twist = Twist()
    twist.linear.x = 0.2
    return TwistStamped(twist=twist) if kind == 'cmd_vel_stamped' else twist


def flood(node_name: str, kind: str, seconds: float) -> None:
    """Send as fast as it goes; print how many per second, and the time of the end (s, monotonic)."""
    with ros_context(['flood']) as context:
        node = Node('flood', context=context, start_parameter_services=False)
        send = sender(node, node_name, kind)
        end, count = time.monotonic() + seconds, 0
        while time.monotonic() < end:
            for _ in range(100):
                send()
            count += 100
        print(count / seconds, time.monotonic(), flush=True)
        node.destroy_node()


def sender(node: Node, node_name: str, kind: str) -> Callable[[], object]:
    """Return a function that sends one message or request."""
    if kind in ('set_parameters', 'reset_odometry', 'cancel_goal'):
        service, request, name = Trigger, Trigger.Request(), kind
        if kind == 'set_parameters':
            service, name = SetParameters, f'{node_name}/{kind}'
            request = SetParameters.Request(
                parameters=[
                    Parameter(name='wheel_radius', value=ParameterValue(type=3, double_value=0.05))
                ]
            )
        client = node.create_client(service, name)
        client.wait_for_service(10.0)
        return lambda: client.remove_pending_request(client.call_async(request))
    if kind == 'clock':
        publisher, buffer = node.create_publisher(Clock, '/clock', 10), bytearray(12)
        buffer[1] = 1

        def tick() -> None:
            struct.pack_into('<iI', buffer, 4, *divmod(time.time_ns(), 1_000_000_000))
            publisher.publish(bytes(buffer))

        return tick
    sample = message(kind)
    publisher = node.create_publisher(type(sample), kind.removesuffix('_stamped'), 10)
    data = serialize_message(sample)
    return lambda: publisher.publish(data)


if __name__ == '__main__':
    announce_frequently()
    flood(*sys.argv[1:3], float(sys.argv[3]))
