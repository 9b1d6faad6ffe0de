"""Base class of the nodes: its parameters are one value, and it reports silent failures.

ROS reports neither a topic whose publisher and subscription differ in type, nor simulated time for which
nobody publishes /clock. Nodes check for both once a second of wall time, and report each once.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from typing import Any, Generic, TypeVar
from weakref import WeakKeyDictionary

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.service import Service
from rclpy.subscription import Subscription

from diffdrive_jacobian.parameters.declaration import NodeParameters, ParameterError, changed
from diffdrive_jacobian.ros import parameters as ros_parameters
from diffdrive_jacobian.ros.input_guard import THROTTLE as THROTTLE
from diffdrive_jacobian.ros.input_guard import guard_inputs
from diffdrive_jacobian.ros.rate_limit import RateLimit
from diffdrive_jacobian.ros.rclpy_internals import log_info, time_reader
from diffdrive_jacobian.ros.topic_errors import explaining_failure, type_name
from diffdrive_jacobian.text import printable

P = TypeVar('P', bound=NodeParameters)

EVENT_BURST = 10
"""Number of log lines about one kind of event that are written without a delay."""
EVENT_PERIOD = 1.0
"""Shortest time between further log lines about that kind of event (s)."""
FLUSH_PATIENCE = Duration(seconds=0.1)
"""Longest wait for the acknowledgement of the last messages (s). They arrive long before."""
WATCH_PERIOD = 1.0
"""Period of the checks of the graph and of the clock (s)."""
CLOCK_PATIENCE = 5
"""Number of checks without a message on /clock before that is reported."""
NAME_PATIENCE = 3
"""Number of checks for the name of a node before it is reported without one."""
NO_CLOCK = 'simulated time has not started, nothing was received on /clock'
"""Why a node with `use_sim_time` drops a message."""


class ParameterizedNode(Node, Generic[P]):  # type: ignore[misc]
    """A node with a dataclass of parameters, and with reliable topics whose QoS users can override."""

    parameters: P

    def __init__(self, name: str, parameters: type[P], **kwargs: Any) -> None:
        """Declare the parameters with the values that the user gave.

        Args:
            name: Name of the node.
            parameters: The dataclass of its parameters.
            kwargs: Passed on to `rclpy.node.Node` (context, namespace, parameter_overrides, ...).

        Raises:
            ParameterError: The values are invalid. The node is destroyed.
        """
        super().__init__(name, **kwargs)
        try:
            self.parameters = ros_parameters.declare(self, parameters)
        except ParameterError:
            self.destroy_node()
            raise
        guard_inputs(self)
        self._read_time = time_reader(self.get_clock())
        self._event_limits: dict[str, RateLimit] = {}
        self.add_pre_set_parameters_callback(self._convert_parameters)
        self.add_on_set_parameters_callback(self._validate_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        self._topics: list[tuple[str, str, bool]] = []
        self._mismatches: dict[tuple[str, str, str], int] = {}
        self._reported: set[tuple[str, str, str]] = set()
        self._checks_without_clock = 0
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(WATCH_PERIOD, self._check_graph, clock=steady)

    def now(self) -> int:
        """Return the time of the node's clock (ns); 0: simulated time has not started."""
        return self._read_time()

    def advertise(self, message: type, topic: str, *, latched: bool = False) -> Publisher:
        """Create a publisher with reliable QoS, keep last 10.

        Args:
            message: Type of the messages.
            topic: Name of the topic.
            latched: Whether later subscriptions receive the last messages (transient local).

        Raises:
            ParameterError: The topic has another type in this process, or `qos_overrides` are invalid.
        """
        self._topics.append((topic, type_name(message), False))
        profile = QoSProfile(depth=10)
        if latched:
            profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
        with explaining_failure(self, message, topic):
            return self.create_publisher(
                message,
                topic,
                profile,
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )

    def subscribe(
        self, message: type, topic: str, callback: Callable[[Any], None], *, raw: bool = False
    ) -> Subscription:
        """Create a subscription with reliable QoS, keep last 10.

        Args:
            message: Type of the messages.
            topic: Name of the topic.
            callback: Called with each message.
            raw: Whether the callback receives the serialized bytes.

        Raises:
            ParameterError: As for `advertise`.
        """
        self._topics.append((topic, type_name(message), True))
        with explaining_failure(self, message, topic):
            return self.create_subscription(
                message,
                topic,
                callback,
                QoSProfile(depth=10),
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
                raw=raw,
            )

    def provide(self, service: Any, name: str, callback: Callable[[Any, Any], Any]) -> Service:
        """Create a service.

        Raises:
            RuntimeError: Its name is invalid.
        """
        # create_service raises UnboundLocalError for an invalid name.
        self.resolve_service_name(name)
        return self.create_service(service, name, callback)

    def log_event_info(self, event: str, text: str) -> None:
        """Log an event at level info, at a limited rate.

        Args:
            event: Kind of the event. Of each kind EVENT_BURST lines are written without a delay, then
                one per EVENT_PERIOD.
            text: The line.
        """
        if self._may_log(event):
            self.get_logger().info(text)

    def log_event_warning(self, event: str, text: str) -> None:
        """Log an event at level warning, at the rate of `log_event_info`."""
        if self._may_log(event):
            self.get_logger().warning(text)

    def _may_log(self, event: str) -> bool:
        limit = self._event_limits.setdefault(event, RateLimit(EVENT_BURST, EVENT_PERIOD))
        return limit.permits(time.monotonic())

    def parameters_changed(self, previous: P) -> None:
        """React to new values in `parameters`, which may equal the previous ones."""

    def stop(self, why: str) -> None:
        """Stop what this node commands. Called before it is destroyed, and while time does not advance.

        Args:
            why: The reason, for the log.
        """

    def announce(self, *, subscribed: Iterable[str], publishing: Iterable[str]) -> None:
        """Log that the node is ready, with its main topics."""
        received, sent = (
            ', '.join(self.resolve_topic_name(topic) for topic in topics)
            for topics in (subscribed, publishing)
        )
        log_info(self, f'subscribed to {received}, publishing {sent}')

    @staticmethod
    def flush(publisher: Publisher) -> None:
        """Wait until the last messages have arrived: destroying their publisher would drop them."""
        publisher.wait_for_all_acked(FLUSH_PATIENCE)

    def _convert_parameters(self, changes: list[Parameter]) -> list[Parameter]:
        return ros_parameters.accept_integers(type(self.parameters), changes)

    def _validate_parameters(self, changes: list[Parameter]) -> SetParametersResult:
        return ros_parameters.validate(self.parameters, changes)

    def _apply_parameters(self, changes: list[Parameter]) -> None:
        previous = self.parameters
        self.parameters = changed(previous, changes)
        if self.parameters is not previous:
            self.parameters_changed(previous)

    def _check_graph(self) -> None:
        self._check_clock()
        mismatches: dict[tuple[str, str, str], int] = {}
        types = _topic_types(self)
        for topic, wanted, subscribed in self._topics:
            name = self.resolve_topic_name(topic)
            if types.get(name) == [wanted]:
                continue
            endpoints = (
                self.get_publishers_info_by_topic if subscribed else self.get_subscriptions_info_by_topic
            )
            for other in endpoints(name):
                mismatch = (name, wanted, other.topic_type)
                if other.topic_type == wanted or mismatch in mismatches:
                    continue
                mismatches[mismatch] = self._mismatches.get(mismatch, 0) + 1
                # The name of a node may be discovered later than its topics.
                named = not other.node_name.startswith('_') or mismatches[mismatch] == NAME_PATIENCE
                if named and mismatch not in self._reported:
                    self._reported.add(mismatch)
                    self._report_mismatch(mismatch, other, subscribed)
        self._mismatches = mismatches
        self._reported &= mismatches.keys()

    def _report_mismatch(self, mismatch: tuple[str, str, str], other: Any, subscribed: bool) -> None:
        name, wanted, theirs = mismatch
        node = printable(f'{other.node_namespace.rstrip("/")}/{other.node_name}')
        they_do, this_does = (
            ('publishes', 'subscribes to') if subscribed else ('subscribes to', 'publishes')
        )
        hint = ''
        if 'Twist' in wanted and 'Twist' in theirs:
            hint = '; enable_stamped_cmd_vel selects Twist or TwistStamped'
        self.get_logger().error(
            f'{node} {they_do} {name} as {printable(theirs)}, but this node {this_does} it as {wanted}: '
            f'no message will arrive{hint}'
        )

    def _check_clock(self) -> None:
        if self.now() != 0:
            self._checks_without_clock = 0
            return
        # Timeouts do not expire while time does not advance.
        self.stop('time stands still')
        self._checks_without_clock += 1
        if self._checks_without_clock == CLOCK_PATIENCE:
            self.get_logger().warning(
                f'use_sim_time is true, but nothing came on /clock for {CLOCK_PATIENCE} s: this node '
                'does nothing until it does; publish /clock or set use_sim_time to false'
            )


def _topic_types(node: Node) -> dict[str, list[str]]:
    """Return the types of all topics in the graph, by name.

    The nodes of a context share the result. A query takes time proportional to the number of topics, so
    with many nodes in a process the queries would cost more than the nodes.
    """
    now = time.monotonic()
    queried, types = _topic_types_of.get(node.context, (-math.inf, {}))
    if now - queried > WATCH_PERIOD / 2:
        types = dict(node.get_topic_names_and_types())
        _topic_types_of[node.context] = now, types
    return types


_topic_types_of: WeakKeyDictionary[Context, tuple[float, dict[str, list[str]]]] = WeakKeyDictionary()
