"""Base class of the nodes: its parameters are one value, and it reports silent failures.

ROS reports neither a topic whose publisher and subscription differ in type, nor simulated time for which
nobody publishes /clock, nor a node that was forgotten. Nodes check for that once a second of wall time,
and report each once.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.service import Service
from rclpy.subscription import Subscription

from diffdrive_jacobian.messages.cdr import DecodingError
from diffdrive_jacobian.messages.codecs import Codec
from diffdrive_jacobian.messages.integers import integer_warning
from diffdrive_jacobian.parameters.declaration import NodeParameters, ParameterError, changed
from diffdrive_jacobian.ros import parameters as ros_parameters
from diffdrive_jacobian.ros.input_guard import THROTTLE as THROTTLE
from diffdrive_jacobian.ros.input_guard import guard_inputs
from diffdrive_jacobian.ros.lasting import Interleaving, LastingFault
from diffdrive_jacobian.ros.rate_limit import RateLimit
from diffdrive_jacobian.ros.rclpy_internals import declare_qos, log_info, time_reader
from diffdrive_jacobian.ros.serialization import decoding
from diffdrive_jacobian.ros.shared_graph import MAX_AGE, SharedGraph
from diffdrive_jacobian.ros.topic_errors import explaining_failure, type_name
from diffdrive_jacobian.ros.type_mismatches import TypeMismatches

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
FAULT_PATIENCE = 5
"""Number of checks with a fault of the graph before it is reported: nodes may start in any order."""
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
        self.now: Callable[[], int] = time_reader(self.get_clock())
        """Return the time of the node's clock (ns); 0: simulated time has not started."""
        self._event_limits: dict[str, RateLimit] = {}
        self.add_pre_set_parameters_callback(self._convert_parameters)
        self.add_on_set_parameters_callback(self._validate_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        self._graph = SharedGraph(self)
        self._types = TypeMismatches(self)
        self._checks_without_clock = 0
        self._faults: list[tuple[LastingFault, Callable[[], str | None]]] = []
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(WATCH_PERIOD, lambda: self._check_graph(MAX_AGE), clock=steady)

    def advertise(self, message: type, topic: str, *, latched: bool = False) -> Publisher:
        """Create a publisher with reliable QoS, keep last 10.

        Args:
            message: Type of the messages.
            topic: Name of the topic.
            latched: Whether later subscriptions receive the last messages (transient local).

        Raises:
            ParameterError: The topic has another type in this process, or `qos_overrides` are invalid.
        """
        self._types.add(topic, type_name(message), subscribed=False)
        profile = QoSProfile(depth=10)
        if latched:
            profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
        with explaining_failure(self, message, topic):
            return self.create_publisher(
                message,
                topic,
                profile,
                qos_overriding_options=self._qos_options('publisher', topic, profile),
            )

    def subscribe(
        self,
        message: type,
        topic: str,
        callback: Callable[..., None],
        *,
        codec: Codec[Any] | None = None,
        numbers: Interleaving | None = None,
    ) -> Subscription:
        """Create a subscription with reliable QoS, keep last 10.

        Bytes that are not a message of the type are logged and dropped.

        Args:
            message: Type of the messages.
            topic: Name of the topic.
            callback: Called with the fields of each message that the codec reads, one argument each. Its
                `value` checks them.
            codec: What is read of the messages. None: the callback receives the serialized bytes.
            numbers: Receives the sequence number of each message before the callback is called. It
                needs a codec.

        Raises:
            ParameterError: As for `advertise`.
        """

        def dropped(error: DecodingError) -> None:
            self.get_logger().warning(f'{topic} dropped: {error}', throttle_duration_sec=THROTTLE)

        self._types.add(topic, type_name(message), subscribed=True)
        profile = QoSProfile(depth=10)
        if codec is not None:
            callback = decoding(message, codec.fields, callback, dropped, numbers)
        with explaining_failure(self, message, topic):
            return self.create_subscription(
                message,
                topic,
                callback,
                profile,
                qos_overriding_options=self._qos_options('subscription', topic, profile),
                raw=True,
            )

    def _qos_options(self, kind: str, topic: str, profile: QoSProfile) -> QoSOverridingOptions | None:
        """Return the options with which users override the QoS of a topic. None: nobody does."""
        if declare_qos(self, self.resolve_topic_name(topic), kind, profile):
            return None
        return QoSOverridingOptions.with_default_policies()

    def provide(self, service: Any, name: str, callback: Callable[[Any, Any], Any]) -> Service:
        """Create a service.

        Raises:
            RuntimeError: Its name is invalid.
        """
        # create_service raises UnboundLocalError for an invalid name.
        self.resolve_service_name(name)
        return self.create_service(service, name, callback)

    def watch(self, check: Callable[[], str | None], patience: int = FAULT_PATIENCE) -> None:
        """Check for a fault once a second of wall time, and warn when it has lasted.

        Args:
            check: Returns a description of the fault with its remedy. None: there is none.
            patience: Number of consecutive checks with the same fault before it is reported.
        """
        self._faults.append((LastingFault(patience), check))

    def warn_of_integers(self, what: str, *values: float) -> None:
        """Warn, throttled, if a value is an integer that was assigned to a field of floats.

        Args:
            what: What has the values.
            values: The values of the fields.
        """
        if warning := integer_warning(what, *values):
            self.get_logger().warning(warning, throttle_duration_sec=THROTTLE)

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
        if self.parameters is previous:
            return
        if type(self.parameters) is not type(previous):
            self.parameters = ros_parameters.declare_new(self, previous, self.parameters)
        self.parameters_changed(previous)

    def _check_graph(self, max_age: float = 0.0) -> None:
        self._check_clock()
        snapshot = self._graph.refresh(max_age)
        for fault, check in self._faults:
            if report := fault.check(check()):
                self.get_logger().warning(report)
        self._types.check(snapshot)

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
