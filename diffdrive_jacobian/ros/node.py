"""The base of the nodes: parameters as one value, and eyes for what goes wrong in silence.

Two things are silent in ROS and cost newcomers hours: a topic that carries another type than its
reader wants, and simulated time without anybody who publishes /clock. Both are looked for once a
second, on the wall clock, and said once.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
from diffdrive_jacobian.text import printable

P = TypeVar('P', bound=NodeParameters)

EVENT_BURST = 10
"""Number of log lines about one kind of event that are written at once."""
EVENT_PERIOD = 1.0
"""Shortest time between further log lines about that kind of event (s)."""
FLUSH_PATIENCE = Duration(seconds=0.1)
"""How long the last message may take to be acknowledged; it arrives long before (s)."""
WATCH_PERIOD = 1.0
"""How often the graph and the clock are looked at (s)."""
CLOCK_PATIENCE = 5
"""How many looks find no /clock before that is said."""
NAME_PATIENCE = 3
"""How many looks may find a node without a name before it is reported without one."""


class ParameterizedNode(Node, Generic[P]):  # type: ignore[misc]
    """A node with a dataclass of parameters and reliable, overridable topics."""

    parameters: P

    def __init__(self, name: str, parameters: type[P], **kwargs: Any) -> None:
        """Declare the parameters with the values their user gave.

        Args:
            name: Name of the node.
            parameters: The dataclass of its parameters.
            kwargs: Passed on to `rclpy.node.Node` (context, namespace, parameter_overrides, ...).

        Raises:
            ParameterError: The values given are not a valid set; the node is destroyed.
        """
        super().__init__(name, **kwargs)
        try:
            self.parameters = ros_parameters.declare(self, parameters)
        except ParameterError:
            self.destroy_node()
            raise
        guard_inputs(self)
        self._event_limits: dict[str, RateLimit] = {}
        self.add_pre_set_parameters_callback(self._before_parameters)
        self.add_on_set_parameters_callback(self._judge_parameters)
        self.add_post_set_parameters_callback(self._after_parameters)
        self._watched: list[tuple[str, str, bool]] = []
        self._looks: dict[tuple[str, str, str], int] = {}
        self._said: set[tuple[str, str, str]] = set()
        self._looks_without_clock = 0
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(WATCH_PERIOD, self._watch, clock=steady)

    def now(self) -> int:
        """Give the time of the node's clock (ns); 0 while simulated time has not begun."""
        return int(self.get_clock().handle.get_now().nanoseconds)

    def advertise(self, message: type, topic: str, *, latched: bool = False) -> Publisher:
        """Create a publisher: reliable, keep last 10; latched: for those who come later, too."""
        self._watched.append((topic, _type_name(message), False))
        profile = QoSProfile(depth=10)
        if latched:
            profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
        with self._naming_the_reason(message, topic):
            return self.create_publisher(
                message,
                topic,
                profile,
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )

    def subscribe(
        self, message: type, topic: str, callback: Callable[[Any], None], *, raw: bool = False
    ) -> Subscription:
        """Create a subscription: reliable, keep last 10; raw: the callback gets the serialized bytes."""
        self._watched.append((topic, _type_name(message), True))
        with self._naming_the_reason(message, topic):
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
        # rclpy resolves the name only after it failed, and then raises UnboundLocalError.
        self.resolve_service_name(name)
        return self.create_service(service, name, callback)

    def log_event_info(self, event: str, text: str) -> None:
        """Log what a message caused: of one kind EVENT_BURST lines, then one per EVENT_PERIOD."""
        if self._may_log(event):
            self.get_logger().info(text)

    def log_event_warning(self, event: str, text: str) -> None:
        """Log a problem that a message caused, as often as `log_event_info` does."""
        if self._may_log(event):
            self.get_logger().warning(text)

    def _may_log(self, event: str) -> bool:
        limit = self._event_limits.setdefault(event, RateLimit(EVENT_BURST, EVENT_PERIOD))
        return limit.permits(time.monotonic())

    @contextmanager
    def _naming_the_reason(self, message: type, topic: str) -> Iterator[None]:
        """Say why a topic cannot be had; rclpy says "invalid allocator".

        Within one process Fast DDS refuses a topic of two types; and users may ask for a quality of
        service that does not exist.
        """
        try:
            yield
        except RuntimeError as error:
            name, wanted = self.resolve_topic_name(topic), _type_name(message)
            types = dict(self.get_topic_names_and_types()).get(name, [])
            others = ', '.join(other for other in types if other != wanted)
            overridden = any(
                key.startswith(f'qos_overrides.{name}.') for key in self._parameter_overrides
            )
            if overridden and not others:
                raise ParameterError(
                    f'the quality of service of {name} cannot be what qos_overrides say: '
                    f'{str(error).split(", at /")[0]}'
                ) from error
            if not others:
                raise
            raise ParameterError(
                f'{name} cannot be {wanted} in this node, it is {others} in another node of this '
                'process (is enable_stamped_cmd_vel the same for all of them?)'
            ) from error

    def parameters_changed(self, previous: P) -> None:
        """Act on new parameters, which may equal the old; `parameters` was replaced before."""

    def stop(self, why: str) -> None:
        """Leave what this node commands standing still: it is destroyed next, or time stands still."""

    def announce(self, what: str, *topics: str) -> None:
        """Say that the node is ready, and on which topics."""
        names = ', '.join(self.resolve_topic_name(topic) for topic in topics)
        self.get_logger().info(f'ready: {what} {names}')

    @staticmethod
    def flush(publisher: Publisher) -> None:
        """Give the last message time to arrive: a publisher that is destroyed takes it along."""
        publisher.wait_for_all_acked(FLUSH_PATIENCE)

    def _before_parameters(self, changes: list[Parameter]) -> list[Parameter]:
        return ros_parameters.accept_integers(type(self.parameters), changes)

    def _judge_parameters(self, changes: list[Parameter]) -> SetParametersResult:
        return ros_parameters.judge(self.parameters, changes)

    def _after_parameters(self, changes: list[Parameter]) -> None:
        previous = self.parameters
        self.parameters = changed(previous, changes)
        if self.parameters is not previous:
            self.parameters_changed(previous)

    def _watch(self) -> None:
        self._watch_clock()
        looks: dict[tuple[str, str, str], int] = {}
        types = _topic_types(self)
        for topic, wanted, reading in self._watched:
            name = self.resolve_topic_name(topic)
            if types.get(name) == [wanted]:
                continue
            look = self.get_publishers_info_by_topic if reading else self.get_subscriptions_info_by_topic
            for other in look(name):
                mismatch = (name, wanted, other.topic_type)
                if other.topic_type == wanted or mismatch in looks:
                    continue
                looks[mismatch] = self._looks.get(mismatch, 0) + 1
                # The name of a node is found out later than its topics.
                named = not other.node_name.startswith('_') or looks[mismatch] == NAME_PATIENCE
                if named and mismatch not in self._said:
                    self._said.add(mismatch)
                    self._report_mismatch(mismatch, other, reading)
        self._looks = looks
        self._said &= looks.keys()

    def _report_mismatch(self, mismatch: tuple[str, str, str], other: Any, reading: bool) -> None:
        name, wanted, theirs = mismatch
        who = printable(f'{other.node_namespace.rstrip("/")}/{other.node_name}')
        they_do, we_do = ('publishes', 'reads') if reading else ('reads', 'publishes')
        hint = ''
        if 'Twist' in wanted and 'Twist' in theirs:
            hint = '; enable_stamped_cmd_vel chooses between Twist and TwistStamped'
        self.get_logger().error(
            f'{who} {they_do} {printable(theirs)} on {name}, but this node {we_do} {wanted}: '
            f'nothing will arrive{hint}'
        )

    def _watch_clock(self) -> None:
        if self.now() != 0:
            self._looks_without_clock = 0
            return
        # No timeout strikes while time stands still, so nothing may be left moving.
        self.stop('time stands still')
        self._looks_without_clock += 1
        if self._looks_without_clock == CLOCK_PATIENCE:
            self.get_logger().warning(
                f'use_sim_time is true, but nothing came on /clock for {CLOCK_PATIENCE} s: '
                'time stands still, and so does this node; publish /clock or set use_sim_time to false'
            )


def _topic_types(node: Node) -> dict[str, list[str]]:
    """Give the types of all topics in the graph.

    The nodes of a context share a look: with many of them in one process each would see the topics of
    all, and the looks would cost more than the robots.
    """
    now = time.monotonic()
    looked_at, types = _topic_types_seen.get(node.context, (-math.inf, {}))
    if now - looked_at > WATCH_PERIOD / 2:
        types = dict(node.get_topic_names_and_types())
        _topic_types_seen[node.context] = now, types
    return types


_topic_types_seen: WeakKeyDictionary[Context, tuple[float, dict[str, list[str]]]] = WeakKeyDictionary()


def _type_name(message: type) -> str:
    """Name a message type as the graph does: package/msg/Name."""
    package = message.__module__.split('.')[0]
    return f'{package}/msg/{message.__name__}'
