"""The one way in which every entry point runs its nodes: context, executor, loop, orderly end.

Signals are counted by our own handlers (`signals`), not by rclpy's, which end the context before a
node could send its last zero.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import TypeVar

import rclpy
from rclpy.context import Context
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.logging import get_logger_level, set_logger_level
from rclpy.node import Node
from rclpy.qos_overriding_options import InvalidQosOverridesError
from rclpy.signals import SignalHandlerOptions

from diffdrive_jacobian.errors import UserError as UserError
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.ros.input_guard import guard_inputs
from diffdrive_jacobian.ros.node import ParameterizedNode
from diffdrive_jacobian.ros.parameters import report_unknown
from diffdrive_jacobian.ros.rclpy_internals import (
    RCLError,
    UnknownROSArgsError,
    events_executor,
    reason,
)
from diffdrive_jacobian.text import printable

N = TypeVar('N', bound=Node)

MAX_DOMAIN_ID = 232
"""Beyond it a domain's ports do not exist."""
MAX_NAME_LENGTH = 247
"""Longest name of a topic or service, with its leading slash, that Fast DDS can have (characters)."""
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
    except UnknownROSArgsError as error:
        raise UserError(
            f'unknown ROS arguments: {error}; other arguments come before --ros-args, or after the -- '
            'that ends the ROS arguments'
        ) from error
    except (RuntimeError, UnicodeError) as error:
        raise UserError(f'ROS arguments: {reason(error)}') from error
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


@contextmanager
def running(context: Context, *, closed_world: bool) -> Iterator[Runner]:
    """Hold an executor and the nodes that are added to it; at the end each is stopped and destroyed."""
    runner = Runner(context, make_executor(context, closed_world=closed_world))
    try:
        yield runner
    finally:
        runner.close()


def made(make: Callable[[], N]) -> N:
    """Make a node.

    Raises:
        UserError: The name, the parameters or the QoS that its user gave cannot be.
    """
    try:
        return make()
    except NameValidationException as error:
        # Its lines: the kind of name and the rule, the name, a mark under the place.
        rule, name, *_ = str(error).splitlines()
        raise UserError(f'{rule} {printable(name.strip())}') from error
    except (ParameterError, ParameterException, InvalidQosOverridesError) as error:
        raise UserError(str(error)) from error
    except RCLError as error:
        why = reason(error)
        if 'length should not exceed' in why:
            # Each part was short enough, see _check_name_length.
            why += f'; a name with its namespace must have at most {MAX_NAME_LENGTH} characters'
        raise UserError(why) from error


class Runner:
    """An executor with its nodes."""

    def __init__(self, context: Context, executor: Executor) -> None:
        """Begin without nodes."""
        self.context = context
        self._executor = executor
        self._nodes: list[Node] = []
        self._begun = False

    def seconds(self) -> float:
        """Give the time by which the nodes live, from an arbitrary beginning (s)."""
        return time.monotonic()

    def add(self, make: Callable[[], N]) -> N:
        """Make a node and add it.

        Raises:
            UserError: The name, the parameters or the QoS that its user gave cannot be.
        """
        node = made(make)
        if not isinstance(node, ParameterizedNode):
            guard_inputs(node)
        self._nodes.append(node)
        self._executor.add_node(node)
        return node

    def spin(self, until: Callable[[], bool]) -> bool:
        """Serve the nodes until a condition holds; False if the context was shut down before.

        The condition is looked at after every callback and at least every LOOK_PERIOD.
        """
        if not self._begun:
            self._begun = True
            report_unknown([node for node in self._nodes if isinstance(node, ParameterizedNode)])
        try:
            while not until():
                if not self.context.ok():
                    return False
                self._executor.spin_once(timeout_sec=LOOK_PERIOD)
        except ExternalShutdownException:
            return False
        return True

    def close(self) -> None:
        """Stop the nodes while they can still speak, then take everything down."""
        if self.context.ok():
            for node in self._nodes:
                if isinstance(node, ParameterizedNode):
                    node.stop('shutting down')
        self._executor.shutdown()
        for node in self._nodes:
            node.destroy_node()
