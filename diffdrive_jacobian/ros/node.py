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
from diffdrive_jacobian.messages.conversion import MessageError, integer_warning
from diffdrive_jacobian.parameters.declaration import NodeParameters, ParameterError
from diffdrive_jacobian.ros.graph_faults import (
    ALTERNATION_PATIENCE,
    TYPE_PATIENCE,
    Interleaving,
    LastingFault,
    alternating_commands,
    wrong_type,
)
from diffdrive_jacobian.ros.input_guard import THROTTLE as THROTTLE
from diffdrive_jacobian.ros.input_guard import guard_inputs
from diffdrive_jacobian.ros.parameters import declare, declare_new, with_overrides
from diffdrive_jacobian.ros.rate_limit import TokenBucket
from diffdrive_jacobian.ros.rclpy_internals import log_info, time_reader
from diffdrive_jacobian.ros.serialization import receiver
from diffdrive_jacobian.ros.topic_errors import explaining_failure, whole_or_nothing

P = TypeVar('P', bound=NodeParameters)
V = TypeVar('V')

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

    def __init__(self, name: str, defaults: P, **kwargs: Any) -> None:
        """Declare the parameters with the values that the user gave.

        Args:
            name: Name of the node.
            defaults: Its parameters with their defaults.
            kwargs: Passed on to `rclpy.node.Node` (context, namespace, parameter_overrides, ...).

        Raises:
            ParameterError: The values are invalid. The node is destroyed.
        """
        super().__init__(name, **kwargs)
        try:
            self.parameters = declare(self, defaults)
        except ParameterError:
            self.destroy_node()
            raise
        guard_inputs(self)
        self.now: Callable[[], int] = time_reader(self.get_clock())
        """Return the time of the node's clock (ns); 0: simulated time has not started."""
        self._event_limits: dict[str, TokenBucket] = {}
        self.add_pre_set_parameters_callback(self._accept_integers)
        self.add_on_set_parameters_callback(self._validate_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        self._checks_without_clock = 0
        self._faults: list[tuple[LastingFault, Callable[[], str | None], bool]] = []
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(WATCH_PERIOD, self._check_graph, clock=steady)

    # --- For subclasses

    def parameters_changed(self, previous: P) -> None:
        """React to new values in `parameters`."""

    def stop(self, why: str) -> None:
        """Stop what this node commands, and log why: it is destroyed, or time does not advance."""

    # --- Topics and services

    def advertise(self, message: type, topic: str, *, latched: bool = False) -> Publisher:
        """Create a publisher with reliable QoS, keep last 10, with `latched` transient local.

        Raises:
            ParameterError: The topic has another type in this process, or `qos_overrides` are invalid.
                The node is destroyed.
        """
        profile = QoSProfile(depth=10)
        if latched:
            profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
        with whole_or_nothing(self), explaining_failure(self, message, topic):
            self.watch(wrong_type(self, topic, message, subscribed=False), TYPE_PATIENCE, error=True)
            return self.create_publisher(
                message,
                topic,
                profile,
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )

    def subscribe(
        self,
        message: type,
        topic: str,
        callback: Callable[[V], None],
        *,
        codec: Codec[V],
        called: str = '',
        refused: Callable[[MessageError], None] | None = None,
        numbers: Interleaving | None = None,
    ) -> Subscription:
        """Create a subscription with reliable QoS, keep last 10.

        What is no message of the type, and what is refused, is logged and dropped.

        Args:
            message: Type of the messages.
            topic: Name of the topic.
            callback: Called with the value of each message. It refuses one by a MessageError.
            codec: What is read of the messages.
            called: What the log calls a message that is refused; '': as the topic.
            refused: Receives why a message is refused, instead of the log.
            numbers: Receives the sequence number of each message before the callback is called, which
                counts those that must not alternate with those of others.

        Raises:
            ParameterError: As for `advertise`.
        """
        # That of rclpy is one for all topics.
        throttle = TokenBucket(1, THROTTLE)

        def dropped(error: MessageError) -> None:
            if refused is not None and not isinstance(error, DecodingError):
                refused(error)
            elif throttle.permits(time.monotonic()):
                what = topic if isinstance(error, DecodingError) else called or topic
                self.get_logger().warning(f'{what} dropped: {error}')

        with whole_or_nothing(self), explaining_failure(self, message, topic):
            self.watch(wrong_type(self, topic, message, subscribed=True), TYPE_PATIENCE, error=True)
            if numbers is not None:
                self.watch(alternating_commands(self, topic, numbers), ALTERNATION_PATIENCE)
            return self.create_subscription(
                message,
                topic,
                receiver(codec, message, callback, dropped, numbers),
                QoSProfile(depth=10),
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
                raw=True,
            )

    def provide(self, service: Any, name: str, callback: Callable[[Any, Any], Any]) -> Service:
        """Create a service. Raise RuntimeError if its name is invalid; the node is destroyed."""
        with whole_or_nothing(self):
            # create_service raises UnboundLocalError for an invalid name.
            self.resolve_service_name(name)
            return self.create_service(service, name, callback)

    @staticmethod
    def flush(publisher: Publisher) -> None:
        """Wait until the last messages have arrived: destroying their publisher would drop them."""
        publisher.wait_for_all_acked(FLUSH_PATIENCE)

    # --- Log

    def announce(self, *, subscribed: Iterable[str], publishing: Iterable[str]) -> None:
        """Log that the node is ready, with its main topics."""
        received, sent = (
            ', '.join(self.resolve_topic_name(topic) for topic in topics)
            for topics in (subscribed, publishing)
        )
        log_info(self, f'subscribed to {received}, publishing {sent}')

    def warn_of_integers(self, what: str, *values: float) -> None:
        """Warn, throttled, if a value of what is named is an integer assigned to a field of floats."""
        if warning := integer_warning(what, *values):
            self.get_logger().warning(warning, throttle_duration_sec=THROTTLE)

    def log_event_info(self, event: str, text: str) -> None:
        """Log a line at level info, of each kind of event EVENT_BURST, then one per EVENT_PERIOD."""
        if self._may_log(event):
            self.get_logger().info(text)

    def log_event_warning(self, event: str, text: str) -> None:
        """Log a line at level warning, at the rate of `log_event_info`."""
        if self._may_log(event):
            self.get_logger().warning(text)

    def _may_log(self, event: str) -> bool:
        limit = self._event_limits.setdefault(event, TokenBucket(EVENT_BURST, EVENT_PERIOD))
        return limit.permits(time.monotonic())

    # --- Parameters

    def _accept_integers(self, changes: list[Parameter]) -> list[Parameter]:
        """Convert integers to doubles where doubles are declared."""
        known = self.parameters.declared()
        return [
            Parameter(change.name, value=known[change.name].converted(change.value))
            if change.type_ == Parameter.Type.INTEGER and change.name in known
            else change
            for change in changes
        ]

    def _validate_parameters(self, changes: list[Parameter]) -> SetParametersResult:
        try:
            self.parameters.changed({one.name: one.value for one in changes})
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply_parameters(self, changes: list[Parameter]) -> None:
        previous = self.parameters
        self.parameters = new = previous.changed({one.name: one.value for one in changes})
        # By their values: since Python 3.13 a dataclass with a NaN does not equal a copy of itself.
        if new.by_name() == previous.by_name():
            return
        self.parameters = with_overrides(self, previous, new)
        # For each that a controller has added rclpy calls this again, with the value that it has.
        declare_new(self, previous, self.parameters)
        self.parameters_changed(previous)

    # --- Checks

    def watch(
        self, check: Callable[[], str | None], patience: int = FAULT_PATIENCE, *, error: bool = False
    ) -> None:
        """Check for a fault once a second of wall time, and log it when it has lasted.

        Args:
            check: Returns a description of the fault with its remedy. None: there is none.
            patience: Number of consecutive checks with the same fault before it is reported.
            error: Whether it is an error. Otherwise it is a warning.
        """
        self._faults.append((LastingFault(patience), check, error))

    def _check_graph(self) -> None:
        self._check_clock()
        for fault, check, error in self._faults:
            report = fault.check(check())
            # The level of a line of code cannot change in rclpy.
            if report and error:
                self.get_logger().error(report)
            elif report:
                self.get_logger().warning(report)

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
