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

"""Runners of nodes: context, executor, loop, shutdown. `lockstep.runner` has the one of simulated time.

Signals are counted by the handlers of `signals`. Those of rclpy would shut the context down before a
node can publish its last zero.
"""

from __future__ import annotations

import math
import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from itertools import pairwise
from typing import ClassVar, TypeVar

import rclpy
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.logging import get_logger_level, set_logger_level
from rclpy.node import Node
from rclpy.qos_overriding_options import InvalidQosOverridesError
from rclpy.signals import SignalHandlerOptions

from diffdrive_jacobian.errors import UserError as UserError
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.ros.fastdds_profiles import withdraw
from diffdrive_jacobian.ros.guarded_executor import GuardedExecutor
from diffdrive_jacobian.ros.input_guard import guard_inputs
from diffdrive_jacobian.ros.node import ParameterizedNode
from diffdrive_jacobian.ros.parameters import report_unknown, use_arguments
from diffdrive_jacobian.ros.rclpy_internals import RCLError, UnknownROSArgsError, events_executor, reason
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import printable

N = TypeVar('N', bound=Node)

MAX_NAME_LENGTH = 247
"""Longest name of a topic or service, with its leading slash, that Fast DDS can have (characters)."""
MAX_DOMAIN_ID = 232
"""Largest domain id. The ports of larger ones do not exist."""
CHECK_PERIOD = 0.1
"""Longest time between two checks of the condition of the loop (s)."""
PATIENCE = 0.5
"""Longest wait for acknowledgements at the end (s)."""
_A_MOMENT = Duration(seconds=0.01)
RULES = {'-p': 'NAME:=VALUE', '--param': 'NAME:=VALUE', '-r': 'OLD:=NEW', '--remap': 'OLD:=NEW'}
"""Form of the rule after each flag."""
DISCOVERY = (
    'ROS_AUTOMATIC_DISCOVERY_RANGE',
    'ROS_LOCALHOST_ONLY',
    'ROS_STATIC_PEERS',
    'ROS_DISCOVERY_SERVER',
)
"""Variables that choose what is discovered. The others take precedence over the first."""


# --- Contexts


@contextmanager
def environment(values: Mapping[str, str | None]) -> Iterator[None]:
    """Set environment variables (None: remove them) for contexts that are created."""
    before = {name: os.environ.pop(name, None) for name in values}
    os.environ.update({name: value for name, value in values.items() if value is not None})
    try:
        yield
    finally:
        for name in values:
            os.environ.pop(name, None)
        os.environ.update({name: value for name, value in before.items() if value is not None})


def discovery_off() -> AbstractContextManager[None]:
    """Isolate contexts that are created: no other context, in whatever process, can reach them."""
    return environment({**dict.fromkeys(DISCOVERY), DISCOVERY[0]: 'OFF'})


@contextmanager
def ros_context(arguments: Sequence[str], *, default: bool = False) -> Iterator[Context]:
    """Create a ROS context without the signal handlers of rclpy, and shut it down at the end.

    Args:
        arguments: The command line with the name of the program. What follows `--ros-args` is used.
        default: Whether to initialize the default context of rclpy, which nodes use by default.

    Raises:
        UserError: The arguments or the environment are invalid.
    """
    domain = os.environ.get('ROS_DOMAIN_ID', '')
    if domain and not (domain.isascii() and domain.isdecimal() and int(domain) <= MAX_DOMAIN_ID):
        raise UserError(f'ROS_DOMAIN_ID must be in 0 to {MAX_DOMAIN_ID}, got {domain!r}')
    for flag, value in pairwise(arguments):
        if flag in ('-r', '--remap'):
            _check_name_length(value)
        if flag == '--params-file' and not os.access(value, os.R_OK):
            raise UserError(f'--params-file must name a file that can be read, got {value!r}')
    context = rclpy.get_default_context() if default else Context()
    # `--log-level` applies to the process, so it is restored with the context.
    log_level = get_logger_level('')
    try:
        _init(context, arguments)
        yield context
    finally:
        # Also after an init that has failed half way.
        # Without an argument rclpy also replaces the default context by a new one.
        rclpy.try_shutdown(context=None if default else context)
        set_logger_level('', log_level)


def _init(context: Context, arguments: Sequence[str]) -> None:
    try:
        rclpy.init(
            args=list(arguments),
            context=context,
            signal_handler_options=SignalHandlerOptions.NO,
        )
    except UnknownROSArgsError as error:
        raise UserError(
            f'unknown ROS arguments: {error}; other arguments come before --ros-args, or after the -- '
            'that ends the ROS arguments'
        ) from error
    except (RuntimeError, UnicodeError) as error:
        why = reason(error)
        if 'initialize logging' in why:
            raise UserError(f'{why}: set ROS_LOG_DIR to a folder that can be written') from error
        raise UserError(_rule_error(arguments) or f'ROS arguments: {why}') from error
    use_arguments(context, arguments)


def _rule_error(arguments: Sequence[str]) -> str:
    """Describe a rule without `:=`, or a namespace without its slash: rcl gives numbers of lexemes."""
    for flag, rule in pairwise(arguments):
        if flag not in RULES:
            continue
        left, separator, right = rule.partition(':=')
        if not separator:
            left, equals, right = rule.partition('=')
            meant = f"; did you mean '{printable(f'{left}:={right}')}'?" if equals else ''
            return f"ROS arguments: {flag} must be {RULES[flag]}, got '{printable(rule)}'{meant}"
        if flag in ('-r', '--remap') and left.endswith('__ns') and not right.startswith('/'):
            return (
                f"ROS arguments: a namespace must begin with a slash, got '{printable(rule)}'; "
                f"did you mean '{printable(f'{left}:=/{right}')}'?"
            )
    return ''


def _check_name_length(rule: str) -> None:
    """Check the length of the new name in a remap rule. The error of rcl does not contain the name."""
    name = rule.rpartition(':=')[2]
    length = len(name) + (not name.startswith('/'))
    if length > MAX_NAME_LENGTH:
        raise UserError(
            f"ROS arguments: remap rule '{printable(rule)}' must give a name of at most "
            f'{MAX_NAME_LENGTH} characters with its leading slash, got {length}'
        )


# --- Runners


class NodeRunner(ABC):
    """Nodes of one context, and the loop that executes their callbacks."""

    discovery: ClassVar[float] = 0.0
    """Time without a newly discovered subscription after which further ones are unlikely (s)."""

    def __init__(self, context: Context) -> None:
        """Start without nodes. They must be created in `context`."""
        self.context = context
        self._nodes: list[Node] = []
        self._unknown_reported = False

    @abstractmethod
    def seconds(self) -> float:
        """Return the time of the nodes, from an arbitrary zero (s)."""

    @abstractmethod
    def settle(self) -> None:
        """Execute the callbacks that are due in lockstep. No time passes."""

    @abstractmethod
    def _add(self, node: Node) -> None:
        """Execute the callbacks of a node from now on."""

    @abstractmethod
    def _remove(self, node: Node) -> None:
        """Execute no more callbacks of a node, and destroy it."""

    @abstractmethod
    def _spin_once(self) -> None:
        """Wait for a callback for a short time and execute it, or let simulated time advance once."""

    def add(self, create: Callable[[], N]) -> N:
        """Create a node in `context` and add it.

        Raises:
            UserError: The user gave an invalid name, parameter or quality of service.
        """
        try:
            node = create()
        except NameValidationException as error:
            # Its lines: the kind of name and the rule, the name, a mark under the place.
            rule, name, *_ = str(error).splitlines()
            raise UserError(f'{rule} {printable(name.strip())}') from error
        except (ParameterError, ParameterException, InvalidQosOverridesError) as error:
            # What was given was wrong, and the message says it all.
            raise UserError(str(error)) from None
        except RCLError as error:
            why = reason(error)
            if 'length should not exceed' in why:
                # Each part was short enough, see `ros_context`.
                why += f'; a name with its namespace must have at most {MAX_NAME_LENGTH} characters'
            raise UserError(why) from error
        withdraw()
        self._nodes.append(node)
        self._add(node)
        return node

    def remove(self, node: Node) -> None:
        """Remove and destroy a node that was added."""
        self._nodes.remove(node)
        self._remove(node)

    def turns(
        self, *, timeout: float = math.inf, signals: Signals | None = None, handled: int = 0
    ) -> Iterator[float]:
        """Execute callbacks, and yield the time of the nodes (s) often, for a time or until a signal.

        It yields before the first callback, in real time after each one and several times a second, in
        lockstep at each simulated time. It also ends when the context is shut down.

        Args:
            timeout: Longest time (s).
            signals: Counter of the signals that end it. None: no signal does.
            handled: Number of these signals that were caught before and do not end it.
        """
        if not self._unknown_reported:
            self._unknown_reported = True
            ours = [node for node in self._nodes if isinstance(node, ParameterizedNode)]
            try:
                report_unknown(ours, self._nodes)
            except ParameterError as error:
                raise UserError(str(error)) from error
        deadline = self.seconds() + timeout
        self.settle()
        while True:
            yield self.seconds()
            if signals is not None and signals.count > handled:
                return
            if deadline < math.inf and self.seconds() > deadline:
                return
            try:
                self._spin_once()
            except ExternalShutdownException:
                return

    def spin(
        self,
        until: Callable[[], bool],
        *,
        timeout: float = math.inf,
        signals: Signals | None = None,
        handled: int = 0,
    ) -> bool:
        """Execute callbacks until a condition is true, or as `turns` ends. Return whether it is true."""
        return any(until() for _ in self.turns(timeout=timeout, signals=signals, handled=handled))


class Runner(NodeRunner):
    """Nodes in real time: an executor with its nodes."""

    discovery: ClassVar[float] = 0.3
    """Participants of one machine discover each other in tens of ms, on a busy one in hundreds."""

    def __init__(self, context: Context, executor: Executor | GuardedExecutor) -> None:
        """Start without nodes."""
        super().__init__(context)
        self._executor = executor

    def seconds(self) -> float:
        """Return the monotonic time (s)."""
        return time.monotonic()

    def settle(self) -> None:
        """Do nothing: in real time callbacks are executed when they are due."""

    def _add(self, node: Node) -> None:
        if not isinstance(node, ParameterizedNode):
            guard_inputs(node)
        self._executor.add_node(node)

    def _remove(self, node: Node) -> None:
        self._executor.remove_node(node)
        # The EventsExecutor lets go of it only then.
        with suppress(ExternalShutdownException):
            self._executor.spin_once(timeout_sec=0.0)
        node.destroy_node()

    def _spin_once(self) -> None:
        self._executor.spin_once(timeout_sec=CHECK_PERIOD)

    def close(self) -> None:
        """Stop the nodes while they can still publish, let that be received, then destroy them."""
        if self.context.ok():
            for node in self._nodes:
                if isinstance(node, ParameterizedNode):
                    node.stop('shutting down')
            self._wait_for_acknowledgements()
        self._executor.shutdown()
        for node in self._nodes:
            node.destroy_node()

    def _wait_for_acknowledgements(self) -> None:
        """Wait until reliable subscriptions have what was published, but no longer than `PATIENCE`."""
        deadline = time.monotonic() + PATIENCE
        waiting = [one for node in self._nodes for one in node.publishers]
        while waiting and time.monotonic() < deadline:
            waiting = [one for one in waiting if not one.wait_for_all_acked(_A_MOMENT)]


def make_executor(
    context: Context, *, isolated: bool, with_info: bool = False
) -> Executor | GuardedExecutor:
    """Return an executor: the SingleThreadedExecutor if rclpy has no EventsExecutor, else as follows.

    Args:
        context: The context of its nodes.
        isolated: Whether the nodes are isolated from other processes. Then it is an EventsExecutor.
            Nodes that others can flood get a GuardedExecutor.
        with_info: Whether callbacks receive message info, with the time of receipt. Then it is a
            SingleThreadedExecutor.
    """
    events = None if with_info else events_executor(context)
    if events is None:
        return SingleThreadedExecutor(context=context)
    return events if isolated else GuardedExecutor(context, events)


@contextmanager
def running(context: Context, *, isolated: bool, with_info: bool = False) -> Iterator[Runner]:
    """Create a runner with the executor of `make_executor`. At the end stop and destroy its nodes."""
    runner = Runner(context, make_executor(context, isolated=isolated, with_info=with_info))
    try:
        yield runner
    finally:
        runner.close()
