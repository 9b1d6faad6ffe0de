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

"""The messages of a drive without ROS in a bag, as a recorder writes those of the nodes."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)

from diffdrive_jacobian.bags.journal import PARAMETERS, Channel, Message, Text
from diffdrive_jacobian.bags.message_definitions import known_definition, known_structure
from diffdrive_jacobian.messages.cdr import Writer
from diffdrive_jacobian.messages.codecs import Changes, Route, Status
from diffdrive_jacobian.messages.conversion import set_time
from diffdrive_jacobian.messages.names import full_name
from diffdrive_jacobian.messages.structure import blank
from diffdrive_jacobian.messages.topics import TOPICS
from diffdrive_jacobian.time_units import NANOSECONDS, nanoseconds

if TYPE_CHECKING:
    from diffdrive_jacobian.recording.recording import Recording

LATCHED = ('start_pose', 'goal_status')
_FOREVER = QosTime(9223372036, 854775807)


class ValueRecorder:
    """Records messages that are given as their values."""

    def __init__(
        self,
        recording: Recording,
        parameters: Mapping[str, Mapping[str, Any]],
        namespace: str,
        numbers: Iterator[int],
    ) -> None:
        """Record the parameters of the nodes, by their full names.

        Args:
            recording: The recording.
            parameters: Values of the parameters by name, of each node.
            namespace: Namespace of the topics.
            numbers: Of the topics; each is used once in a recording.
        """
        for node, values in parameters.items():
            recording.add(Text(PARAMETERS + node, json.dumps(values)))
        self._recording = recording
        self._namespace, self._numbers = namespace, numbers
        self._of_robot, self._of_bridge = (
            parameters[full_name(namespace, name)] for name in ('virtual_robot', 'wheel_bridge')
        )
        self._topics: dict[str, tuple[int, Callable[[Any], bytes]]] = {}

    def add(self, now: int, topic: str, value: Any) -> None:
        """Record a message that was published at a time (ns)."""
        if topic not in self._topics:
            number = next(self._numbers)
            self._topics[topic] = number, self._open(topic, number)
        number, write = self._topics[topic]
        self._recording.add(Message(number, now, write(value)))

    def _open(self, name: str, number: int) -> Callable[[Any], bytes]:
        """Record that there is a topic; return what serializes its messages."""
        known = TOPICS.get(name) or TOPICS[f'/{name}']
        codec = known.codecs[0]
        described = known_definition(codec.type_name)
        self._recording.add(
            Channel(
                id=number,
                topic=full_name('/' if known.shared else self._namespace, name),
                type_name=codec.type_name,
                definition=described.text,
                type_hash=described.type_hash,
                qos=(_profile(latched=name in LATCHED),),
            )
        )
        if not codec.written:
            return _WRITERS[name]
        kind = known_structure(codec.type_name)
        return codec.writer(self._template(name, blank(kind)), kind)

    def _template(self, name: str, message: Any) -> Any:
        """Fill in the strings of a message, and the lengths of its sequences."""
        robot = self._of_robot
        frames = {'ground_truth': 'ground_truth_frame_id', 'cmd_vel_out': 'base_frame_id'}
        if name in ('odom', 'ground_truth', 'start_pose', 'initialpose', 'cmd_vel_out'):
            message.header.frame_id = robot[frames.get(name, 'odom_frame_id')]
        if name in ('odom', 'ground_truth'):
            message.child_frame_id = robot['base_frame_id']
        if name in ('joint_states', 'joint_command'):
            of_node = robot if name == 'joint_states' else self._of_bridge
            message.name = [of_node['left_wheel_name'], of_node['right_wheel_name']]
            message.velocity = [0.0, 0.0]
            message.position = [0.0, 0.0] if name == 'joint_states' else []
        return message


def _profile(*, latched: bool) -> Qos:
    """Return the profile of a topic, as ROS reports that of the nodes."""
    return Qos(
        history=QosHistory.UNKNOWN,
        depth=0,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=_FOREVER,
        lifespan=_FOREVER,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_FOREVER,
        avoid_ros_namespace_conventions=False,
    )


def _goals(route: Route) -> bytes:
    return _serialized('nav_msgs/msg/Goals', route, 'goals')


def _path(route: Route) -> bytes:
    return _serialized('nav_msgs/msg/Path', route, 'poses')


def _serialized(type_name: str, route: Route, field: str) -> bytes:
    """Return a message with poses in a field."""
    kind = known_structure(type_name)
    message = blank(kind)
    message.header.stamp.sec, message.header.stamp.nanosec = route.stamp
    for number, (x, y, theta) in enumerate(route.poses):
        pose = blank(known_structure('geometry_msgs/msg/PoseStamped'))
        pose.pose.position.x, pose.pose.position.y = x, y
        pose.pose.orientation.z = math.sin(theta / 2.0)
        pose.pose.orientation.w = math.cos(theta / 2.0)
        if route.times is not None:
            set_time(pose.header.stamp, route.time + nanoseconds(route.times[number]))
        getattr(message, field).append(pose)
    return Writer(message, (), kind=kind)(())


def _status(status: Status) -> bytes:
    kind = known_structure('action_msgs/msg/GoalStatus')
    message = blank(kind)
    message.status = status.status
    message.goal_info.stamp.sec, message.goal_info.stamp.nanosec = status.stamp
    return Writer(message, (), kind=kind)(())


def _changes(changes: Changes) -> bytes:
    kind = known_structure('rcl_interfaces/msg/ParameterEvent')
    message = blank(kind)
    message.stamp.sec, message.stamp.nanosec = divmod(changes.stamp, NANOSECONDS)
    message.node = changes.node
    for name, value in changes.values.items():
        parameter = blank(known_structure('rcl_interfaces/msg/Parameter'))
        field, parameter.value.type = _FIELDS[type(value)]
        parameter.name = name
        setattr(parameter.value, field, value)
        message.changed_parameters.append(parameter)
    return Writer(message, (), kind=kind)(())


_FIELDS: dict[type, tuple[str, int]] = {
    bool: ('bool_value', 1),
    int: ('integer_value', 2),
    float: ('double_value', 3),
    str: ('string_value', 4),
}
"""Fields of a ParameterValue, and the constants of their types in rcl_interfaces/msg/ParameterType."""
_WRITERS: dict[str, Callable[[Any], bytes]] = {
    'goals': _goals,
    'path': _path,
    'goal_status': _status,
    'parameter_events': _changes,
}
