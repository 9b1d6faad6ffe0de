"""The one way in which every entry point runs its nodes: context, executor, loop, orderly end.

Signals are counted by our own handlers (`signals`), not by rclpy's, which end the context before a
node could send its last zero.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from itertools import pairwise

import rclpy
from rclpy.context import Context
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.logging import get_logger_level, set_logger_level
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from diffdrive_jacobian.errors import UserError as UserError
from diffdrive_jacobian.ros.input_guard import guard_inputs
from diffdrive_jacobian.ros.node import ParameterizedNode
from diffdrive_jacobian.ros.node_runner import MAX_NAME_LENGTH, NodeRunner
from diffdrive_jacobian.text import printable

MAX_DOMAIN_ID = 232
"""Beyond it a domain's ports do not exist."""
LOOK_PERIOD = 0.1
"""How long the loop may wait before it looks at its condition again (s)."""


@contextmanager
def closed_world() -> Iterator[None]:
    """Make contexts that no other process can reach, nor another context of this one."""
    # The first is what counts; the others would be obeyed before it.
    names = (
        'ROS_AUTOMATIC_DISCOVERY_RANGE',
        'ROS_LOCALHOST_ONLY',
        'ROS_STATIC_PEERS',
        'ROS_DISCOVERY_SERVER',
    )
    before = {name: os.environ.pop(name, None) for name in names}
    os.environ[names[0]] = 'OFF'
    try:
        yield
    finally:
        del os.environ[names[0]]
        os.environ.update({name: value for name, value in before.items() if value is not None})


@contextmanager
def ros_context(arguments: Sequence[str], *, default: bool = False) -> Iterator[Context]:
    """Hold a ROS context without signal handlers of rclpy.

    Args:
        arguments: The command line with the program's name; what follows `--ros-args` counts.
        default: Whether it is rclpy's default context, which nodes take that name none.

    Raises:
        UserError: rcl does not understand the arguments or the environment.
    """
    domain = os.environ.get('ROS_DOMAIN_ID', '')
    if domain and not (domain.isdecimal() and int(domain) <= MAX_DOMAIN_ID):
        raise UserError(f'ROS_DOMAIN_ID must be in 0 to {MAX_DOMAIN_ID}, got {domain!r}')
    for flag, value in pairwise(arguments):
        if flag in ('-r', '--remap'):
            _check_name_length(value)
        if flag == '--params-file' and not os.access(value, os.R_OK):
            raise UserError(f'--params-file must name a file that can be read, got {value!r}')
    context = rclpy.get_default_context() if default else Context()
    # `--log-level` is for the whole process, and would outlast the context.
    log_level = get_logger_level('')
    try:
        rclpy.init(
            args=list(arguments),
            context=context,
            signal_handler_options=SignalHandlerOptions.NO,
        )
    except rclpy_implementation.UnknownROSArgsError as error:
        raise UserError(
            f'unknown ROS arguments: {error}; other arguments come before --ros-args, or after the -- '
            'that ends the ROS arguments'
        ) from error
    except (RuntimeError, UnicodeError) as error:
        # rcl appends where in its sources it gave up.
        raise UserError(f'ROS arguments: {str(error).split(", at /")[0].strip()}') from error
    try:
        yield context
    finally:
        # Of the default context rclpy makes a new one then.
        rclpy.try_shutdown(context=None if default else context)
        set_logger_level('', log_level)


def _check_name_length(rule: str) -> None:
    """Check the new name of a remap rule; rcl reports one that is too long without naming it.

    Raises:
        UserError: It is longer than a topic, a service, a node or a namespace can be.
    """
    name = rule.rpartition(':=')[2]
    length = len(name) + (not name.startswith('/'))
    if length > MAX_NAME_LENGTH:
        raise UserError(
            f"ROS arguments: remap rule '{printable(rule)}' must give a name of at most "
            f'{MAX_NAME_LENGTH} characters with its leading slash, got {length}'
        )


def make_executor(context: Context, *, closed_world: bool) -> Executor:
    """Choose the executor.

    Args:
        context: The context of its nodes.
        closed_world: No stranger can reach the nodes. Then the EventsExecutor, which takes a third of
            the time per message, is safe; its queue knows no bound and no fairness, so a node that
            strangers can flood needs the SingleThreadedExecutor. Older Jazzy has only that one.
    """
    executor = events_executor(context) if closed_world else None
    return executor or SingleThreadedExecutor(context=context)


def events_executor(context: Context) -> Executor | None:
    """Make an EventsExecutor; None if this rclpy has none."""
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        return None
    # It has the faulthandler write to sys.stderr, which then must be a file; in some tests it is none.
    with redirect_stderr(sys.__stderr__):
        return EventsExecutor(context=context)


@contextmanager
def running(context: Context, *, closed_world: bool) -> Iterator[Runner]:
    """Hold an executor and the nodes that are added to it; at the end each is stopped and destroyed."""
    runner = Runner(context, make_executor(context, closed_world=closed_world))
    try:
        yield runner
    finally:
        runner.close()


class Runner(NodeRunner):
    """Nodes in real time: an executor with its nodes."""

    def __init__(self, context: Context, executor: Executor) -> None:
        """Start without nodes."""
        super().__init__(context)
        self._executor = executor

    def seconds(self) -> float:
        """Return the monotonic time (s)."""
        return time.monotonic()

    def _add(self, node: Node) -> None:
        if not isinstance(node, ParameterizedNode):
            guard_inputs(node)
        self._executor.add_node(node)

    def _spin(self, until: Callable[[], bool]) -> bool:
        # The condition is checked after every callback and at least every LOOK_PERIOD.
        try:
            while not until():
                if not self.context.ok():
                    return False
                self._executor.spin_once(timeout_sec=LOOK_PERIOD)
        except ExternalShutdownException:
            return False
        return True

    def close(self) -> None:
        """Stop the nodes while they can still publish, then destroy them."""
        if self.context.ok():
            for node in self._nodes:
                if isinstance(node, ParameterizedNode):
                    node.stop('shutting down')
        self._executor.shutdown()
        for node in self._nodes:
            node.destroy_node()
