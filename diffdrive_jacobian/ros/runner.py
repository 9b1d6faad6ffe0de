"""The runner of nodes in real time: context, executor, loop, shutdown.

Signals are counted by the handlers of `signals`. Those of rclpy would shut the context down before a
node can publish its last zero.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from itertools import pairwise
from typing import ClassVar

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.logging import get_logger_level, set_logger_level
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from diffdrive_jacobian.errors import UserError as UserError
from diffdrive_jacobian.ros.guarded_executor import GuardedExecutor, NodeExecutor
from diffdrive_jacobian.ros.input_guard import guard_inputs
from diffdrive_jacobian.ros.node import ParameterizedNode
from diffdrive_jacobian.ros.node_runner import MAX_NAME_LENGTH, NodeRunner
from diffdrive_jacobian.ros.parameters import use_files
from diffdrive_jacobian.ros.rclpy_internals import UnknownROSArgsError, events_executor, reason
from diffdrive_jacobian.text import printable

MAX_DOMAIN_ID = 232
"""Largest domain id. The ports of larger ones do not exist."""
CHECK_PERIOD = 0.1
"""Longest time between two checks of the condition of the loop (s)."""
RULES = {
    '-p': 'NAME:=VALUE',
    '--param': 'NAME:=VALUE',
    '-r': 'OLD:=NEW',
    '--remap': 'OLD:=NEW',
}
"""Form of the rule after each flag."""


DISCOVERY = (
    'ROS_AUTOMATIC_DISCOVERY_RANGE',
    'ROS_LOCALHOST_ONLY',
    'ROS_STATIC_PEERS',
    'ROS_DISCOVERY_SERVER',
)
"""Variables that choose what is discovered. The others take precedence over the first."""


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
        raise UserError(_rule_error(arguments) or f'ROS arguments: {reason(error)}') from error
    use_files(context, arguments)
    try:
        yield context
    finally:
        # Without an argument rclpy also replaces the default context by a new one.
        rclpy.try_shutdown(context=None if default else context)
        set_logger_level('', log_level)


def _rule_error(arguments: Sequence[str]) -> str:
    """Describe a rule without `:=`, or a namespace without its slash. Empty: there is none.

    The error of rcl gives numbers of its lexemes instead.
    """
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
    """Check the length of the new name in a remap rule. The error of rcl does not contain the name.

    Raises:
        UserError: The name is longer than that of a topic, service, node or namespace can be.
    """
    name = rule.rpartition(':=')[2]
    length = len(name) + (not name.startswith('/'))
    if length > MAX_NAME_LENGTH:
        raise UserError(
            f"ROS arguments: remap rule '{printable(rule)}' must give a name of at most "
            f'{MAX_NAME_LENGTH} characters with its leading slash, got {length}'
        )


def make_executor(context: Context, *, isolated: bool, with_info: bool = False) -> NodeExecutor:
    """Return an executor: the SingleThreadedExecutor if rclpy has no EventsExecutor, else as follows.

    Args:
        context: The context of its nodes.
        isolated: Whether the nodes are isolated from other processes. Then it is an EventsExecutor.
            Nodes that others can flood get a GuardedExecutor.
        with_info: Whether callbacks receive message info, with the time of receipt. Then it is a
            SingleThreadedExecutor.
    """
    events: NodeExecutor | None = None if with_info else events_executor(context)
    if events is None:
        single: NodeExecutor = SingleThreadedExecutor(context=context)
        return single
    return events if isolated else GuardedExecutor(context, events)


@contextmanager
def running(context: Context, *, isolated: bool, with_info: bool = False) -> Iterator[Runner]:
    """Create a runner. At the end stop and destroy its nodes.

    Args:
        context: The context of the nodes.
        isolated: As for `make_executor`.
        with_info: As for `make_executor`.
    """
    runner = Runner(context, make_executor(context, isolated=isolated, with_info=with_info))
    try:
        yield runner
    finally:
        runner.close()


class Runner(NodeRunner):
    """Nodes in real time: an executor with its nodes."""

    discovery: ClassVar[float] = 0.3
    """Participants of one machine discover each other in tens of ms, on a busy one in hundreds."""

    def __init__(self, context: Context, executor: NodeExecutor) -> None:
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
        self._executor.spin_once(timeout_sec=0.0)
        node.destroy_node()

    def _spin_once(self) -> None:
        self._executor.spin_once(timeout_sec=CHECK_PERIOD)

    def close(self) -> None:
        """Stop the nodes while they can still publish, then destroy them."""
        if self.context.ok():
            for node in self._nodes:
                if isinstance(node, ParameterizedNode):
                    node.stop('shutting down')
        self._executor.shutdown()
        for node in self._nodes:
            node.destroy_node()
