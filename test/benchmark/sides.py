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

"""The nodes that are compared: ours, driving to a goal far away, and bare rclpy nodes.

The bare nodes compute nothing. They make each message anew and stamp it, as rclpy's tutorials do;
`prepared` ones send messages made beforehand, which no real node could. Of the same traffic are those
that send every message ours send: odometry and joint states by a timer, a twist for each odometry, a
stamped twist for each command; the lean ones send odometry and twist only.
"""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from diffdrive_jacobian.messages.codecs import Route, State
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge

FAR = 5e5
"""Where the goal is: it is driven to for as long as a measurement lasts (m)."""
SPEED = 0.2
"""How fast our controller may drive (m/s)."""


class BareNode(Node):
    """A node that counts what it received."""

    def __init__(self, name: str, *, prepared: bool = False, **kwargs: Any) -> None:
        super().__init__(name, **kwargs)
        self.received = 0
        self._prepared: dict[str, Any] | None = {} if prepared else None

    def made(self, make: Any) -> Any:
        """Give a message, stamped if it can be."""
        if self._prepared is None:
            return self._stamped(make())
        return self._prepared.setdefault(make.__name__, make())

    def _stamped(self, message: Any) -> Any:
        if hasattr(message, 'header'):
            message.header.stamp = self.get_clock().now().to_msg()
        return message


class BareRobot(BareNode):
    """Publishes odometry by a timer and takes commands; counts the commands."""

    def __init__(self, *, rate: float = 50.0, lean: bool = False, wheels: bool = False, **kwargs: Any):
        super().__init__('robot', **kwargs)
        self._lean = lean
        self._odom = self.create_publisher(Odometry, 'odom', 10)
        if not lean:
            self._joint_states = self.create_publisher(JointState, 'joint_states', 10)
            self._applied = self.create_publisher(TwistStamped, 'cmd_vel_out', 10)
        source = (JointState, 'joint_command') if wheels else (Twist, 'cmd_vel')
        self.create_subscription(*source, self._on_command, 10)
        self.create_timer(1.0 / rate, self._on_tick)

    def _on_tick(self) -> None:
        self._odom.publish(self.made(Odometry))
        if not self._lean:
            self._joint_states.publish(self.made(wheel_state))

    def _on_command(self, _: Any) -> None:
        self.received += 1
        if not self._lean:
            self._applied.publish(self.made(TwistStamped))


class BareController(BareNode):
    """Answers each odometry message by a twist; counts them."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('controller', **kwargs)
        self._cmd_vel = self.create_publisher(Twist, 'cmd_vel', 10)
        self.create_subscription(Odometry, 'odom', self._on_odometry, 10)

    def _on_odometry(self, _: Odometry) -> None:
        self.received += 1
        self._cmd_vel.publish(self.made(Twist))


class BareBridge(BareNode):
    """Answers each twist by a joint command."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('bridge', **kwargs)
        self._joint_command = self.create_publisher(JointState, 'joint_command', 10)
        self.create_subscription(Twist, 'cmd_vel', self._on_twist, 10)

    def _on_twist(self, _: Twist) -> None:
        self._joint_command.publish(self.made(wheel_state))


def wheel_state() -> JointState:
    """Make a message for two wheels."""
    return JointState(name=['left', 'right'], position=[0.0, 0.0], velocity=[0.0, 0.0])


class CountedRobot(VirtualRobot):
    """Our robot, which counts the commands."""

    received = 0

    def _on_twist(self, *fields: float) -> None:
        self.received += 1
        super()._on_twist(*fields)


class CountedController(GoToGoal):
    """Our controller, which counts the odometry."""

    received = 0

    def _on_odometry(self, state: State) -> None:
        self.received += 1
        super()._on_odometry(state)


def our_controller(**kwargs: Any) -> CountedController:
    """Make our controller with a goal that it never reaches."""
    slow = Parameter('linear.x.max_velocity', value=SPEED)
    controller = CountedController(parameter_overrides=[slow], **kwargs)
    controller._on_pose(Route((0, 0), '', ((FAR, FAR, 0.0),)))
    return controller


def our_nodes(*, rate: float = 50.0, bridge: bool = False, **kwargs: Any) -> list[Any]:
    """Make robot and controller, and a bridge between them."""
    overrides = [
        Parameter('publish_rate', value=rate),
        Parameter('command_interface', value='wheels' if bridge else 'twist'),
    ]
    nodes = [CountedRobot(parameter_overrides=overrides, **kwargs), our_controller(**kwargs)]
    return [*nodes, WheelBridge(**kwargs)] if bridge else nodes


def bare_nodes(
    *, rate: float = 50.0, bridge: bool = False, lean: bool = False, **kwargs: Any
) -> list[Any]:
    """Make bare nodes in their place."""
    robot = BareRobot(rate=rate, lean=lean, wheels=bridge, **kwargs)
    nodes = [robot, BareController(**kwargs)]
    return [*nodes, BareBridge(**kwargs)] if bridge else nodes
