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

"""Observation of the graph for a while: nodes, endpoints, clocks, and what they publish."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import GetParameters
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.validate_full_topic_name import validate_full_topic_name
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, JointState, LaserScan

from diffdrive_jacobian.diagnosis.graph import (
    ClockMessages,
    Endpoint,
    Graph,
    Participant,
    Quality,
    Stream,
)
from diffdrive_jacobian.messages.cdr import DecodingError, Reader
from diffdrive_jacobian.messages.codecs import CLOCK as CLOCK_TIME
from diffdrive_jacobian.messages.codecs import STAMP
from diffdrive_jacobian.messages.names import full_name, node_of, type_name
from diffdrive_jacobian.messages.topics import CLOCK
from diffdrive_jacobian.nodes.same_wheels import wheels_of
from diffdrive_jacobian.parameters.wheels import WHEELS, Dimensions
from diffdrive_jacobian.ros.runner import ros_context, running
from diffdrive_jacobian.ros.service_client import ServiceClient, ignore, is_possible
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.time_units import NANOSECONDS

PERIOD = 0.25
"""Time between two looks at the graph (s)."""
MAX_NODES = 200
"""Number of nodes that are asked for their clock."""
MAX_TOPICS = 50
"""Number of topics that are received."""
STAMPED = (Odometry, TwistStamped, JointState, LaserScan, Imu)
"""Types of messages with a stamp that are received."""
RECEIVED = {type_name(one): one for one in (*STAMPED, Twist, Clock)}


def observe(
    seconds: float, *, ros_arguments: Sequence[str] = (), signals: Signals | None = None
) -> Graph:
    """Observe the graph and return its description.

    Args:
        seconds: Duration (s). An older process is discovered within 3 s.
        ros_arguments: ROS arguments of the node.
        signals: Counter of the signals that end the observation. None: no signal does.

    Raises:
        UserError: The ROS arguments or the environment are invalid.
    """
    # Names of nodes that begin with _ are hidden.
    name = f'_doctor_{os.getpid()}'
    with (
        ros_context([name, *ros_arguments]) as context,
        running(context, isolated=False) as runner,
    ):
        observer = runner.add(lambda: Observer(name, context=context))
        start = time.monotonic()
        runner.spin(lambda: False, timeout=seconds, signals=signals)
        return observer.describe(time.monotonic() - start)


class Observer(Node):  # type: ignore[misc]
    """A node that receives what others publish, and asks them for their clock."""

    def __init__(self, name: str, **kwargs: Any) -> None:
        """Start to observe. `kwargs` as for `rclpy.node.Node`."""
        super().__init__(name, enable_rosout=False, start_parameter_services=False, **kwargs)
        self._received: dict[str, _Received] = {}
        self._simulated = _ClockReceived()
        self._use_sim_time: dict[str, bool] = {}
        self._wheels: dict[str, Dimensions] = {}
        self._parameter_clients: dict[str, ServiceClient] = {}
        self._asked: set[str] = set()
        self.create_timer(PERIOD, self._look)

    def _look(self) -> None:
        """Subscribe to new topics, and ask new nodes."""
        for topic, kinds in self._topics():
            known = next((kind for kind in kinds if kind in RECEIVED), None)
            if known is None or topic in self._received or len(self._received) >= MAX_TOPICS:
                continue
            if any(
                info.node_name != self.get_name() for info in self.get_publishers_info_by_topic(topic)
            ):
                self._subscribe(topic, RECEIVED[known])
        for name in self._names()[:MAX_NODES]:
            service = f'{name}/get_parameters'
            if name not in self._parameter_clients and '/_' not in name and is_possible(service):
                self._parameter_clients[name] = ServiceClient(
                    self, GetParameters, service, patience=math.inf
                )
        for name, client in self._parameter_clients.items():
            if name not in self._asked and client.ready:
                self._asked.add(name)
                request = GetParameters.Request(names=['use_sim_time'])
                client.call(request, partial(self._on_answer, name), ignore)
                # Alone: rclcpp answers with nothing if one of several is not declared.
                request = GetParameters.Request(names=[*WHEELS])
                client.call(request, partial(self._on_wheels, name), ignore)

    def _subscribe(self, topic: str, kind: type) -> None:
        stamp = _stamp_reader(kind, STAMP) if kind in STAMPED else None
        received = self._received[topic] = _Received(stamp)
        # It matches every publisher.
        profile = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
        callback: Callable[[bytes], None] = partial(received.add, self._simulated)
        if topic == CLOCK:
            callback = self._simulated.add
        self.create_subscription(kind, topic, callback, profile, raw=True)

    def _on_answer(self, name: str, response: Any) -> None:
        values = response.values
        # 1: PARAMETER_BOOL
        if len(values) == 1 and values[0].type == 1:
            self._use_sim_time[name] = values[0].bool_value

    def _on_wheels(self, name: str, response: Any) -> None:
        wheels = wheels_of(response)
        if wheels is not None:
            self._wheels[name] = wheels

    def _topics(self) -> list[tuple[str, list[str]]]:
        """Return the names and types of the topics.

        Programs that use DDS without ROS may have others, which cannot be queried.
        """
        return [one for one in self.get_topic_names_and_types() if _is_valid(one[0])]

    def _names(self) -> list[str]:
        """Return the fully qualified names of the other nodes, repeated if several have one."""
        names = [full_name(namespace, name) for name, namespace in self.get_node_names_and_namespaces()]
        return sorted(name for name in names if name != self.get_fully_qualified_name())

    def describe(self, seconds: float) -> Graph:
        """Return the graph as it is now, with what was received in the time before (s)."""
        endpoints = [
            Endpoint(
                node=printable(node_of(info)),
                topic=printable(topic),
                kind=printable(info.topic_type),
                publishes=publishes,
                quality=Quality.of(info.qos_profile),
            )
            for topic, _ in self._topics()
            for publishes, query in (
                (True, self.get_publishers_info_by_topic),
                (False, self.get_subscriptions_info_by_topic),
            )
            for info in query(topic)
            if info.node_name != self.get_name()
        ]
        return Graph(
            nodes=tuple(
                Participant(printable(name), self._use_sim_time.get(name), self._wheels.get(name))
                for name in self._names()
                if '/_' not in name
            ),
            endpoints=tuple(sorted(endpoints, key=lambda one: (one.topic, not one.publishes, one.node))),
            streams=tuple(
                received.describe(printable(topic), seconds)
                for topic, received in sorted(self._received.items())
                if topic != CLOCK
            ),
            clock=self._simulated.describe(),
            seconds=seconds,
        )


class _ClockReceived:
    """What was received on /clock."""

    def __init__(self) -> None:
        self._messages = self._went_back = self._first = 0
        self.last = 0
        """The last time (ns); 0: none was received."""
        self._time = _stamp_reader(Clock, CLOCK_TIME.fields)

    def add(self, data: bytes) -> None:
        """Receive a serialized message."""
        now = self._time(data)
        if self._messages:
            self._went_back += now < self.last
        else:
            self._first = now
        self._messages += 1
        self.last = now

    def describe(self) -> ClockMessages:
        advanced = (self.last - self._first) / NANOSECONDS
        return ClockMessages(messages=self._messages, advanced=advanced, went_back=self._went_back)


class _Received:
    """What was received on a topic."""

    def __init__(self, stamp: Callable[[bytes], int] | None) -> None:
        self._stamp = stamp
        self._messages = 0
        self._first = self._last = 0.0
        self._age: float | None = None
        self._simulated_age: float | None = None

    def add(self, clock: _ClockReceived, data: bytes) -> None:
        """Receive a serialized message."""
        self._last = time.monotonic()
        self._first = self._first or self._last
        self._messages += 1
        stamp = 0 if self._stamp is None else self._stamp(data)
        if stamp == 0:
            return
        # The youngest one: this process may be late, and others may be.
        self._age = _nearer(self._age, (time.time_ns() - stamp) / NANOSECONDS)
        if clock.last:
            self._simulated_age = _nearer(self._simulated_age, (clock.last - stamp) / NANOSECONDS)

    def describe(self, topic: str, seconds: float) -> Stream:
        duration = self._last - self._first
        return Stream(
            topic=topic,
            messages=self._messages,
            rate=(self._messages - 1) / duration if duration > 0.0 else self._messages / seconds,
            age=self._age,
            simulated_age=self._simulated_age,
        )


def _is_valid(name: str) -> bool:
    """Return whether a topic can have this fully qualified name."""
    try:
        validate_full_topic_name(name)
    except InvalidTopicNameException:
        return False
    return True


def _nearer(one: float | None, other: float) -> float:
    return other if one is None else min(one, other, key=abs)


def _stamp_reader(kind: type, fields: tuple[str, ...]) -> Callable[[bytes], int]:
    """Return a function that returns a time in a serialized message (ns); 0: it is none."""
    read = Reader(kind, fields, whole=False, deserialize=deserialize_message)

    def stamp(data: bytes) -> int:
        try:
            seconds, nanoseconds = read(data)
        except DecodingError:
            return 0
        return int(seconds) * NANOSECONDS + int(nanoseconds)

    return stamp
