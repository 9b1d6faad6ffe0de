"""The interface of the two runners of nodes, in real time (`ros.runner`) and in simulated time
(`lockstep.runner`), and the code that they share.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import ClassVar, TypeVar

from rclpy.context import Context
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos_overriding_options import InvalidQosOverridesError

from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.ros.fastdds_profiles import withdraw
from diffdrive_jacobian.ros.node import ParameterizedNode
from diffdrive_jacobian.ros.parameters import report_unknown
from diffdrive_jacobian.ros.rclpy_internals import RCLError, reason
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import printable

N = TypeVar('N', bound=Node)

MAX_NAME_LENGTH = 247
"""Longest name of a topic or service, with its leading slash, that Fast DDS can have (characters)."""


class NodeRunner(ABC):
    """Nodes of one context, and the loop that executes their callbacks."""

    discovery: ClassVar[float] = 0.0
    """Time without a newly discovered subscription after which further ones are unlikely (s)."""

    def __init__(self, context: Context) -> None:
        """Start without nodes.

        Args:
            context: The context in which the nodes must be created.
        """
        self.context = context
        self._nodes: list[Node] = []
        self._unknown_reported = False

    @abstractmethod
    def seconds(self) -> float:
        """Return the time of the nodes, from an arbitrary zero (s)."""

    def add(self, create: Callable[[], N]) -> N:
        """Create a node and add it.

        Args:
            create: Creates the node in `context`.

        Raises:
            UserError: The user gave an invalid name, parameter or quality of service.
        """
        node = created(create)
        withdraw()
        self._nodes.append(node)
        self._add(node)
        return node

    def remove(self, node: Node) -> None:
        """Remove and destroy a node that was added."""
        self._nodes.remove(node)
        self._remove(node)

    def turns(
        self,
        *,
        timeout: float = math.inf,
        signals: Signals | None = None,
        handled: int = 0,
    ) -> Iterator[float]:
        """Execute callbacks, and yield often, for a time or until a signal is caught.

        It yields before the first callback, in real time after each one and several times a second, in
        lockstep at each simulated time. It also ends when the context is shut down.

        Args:
            timeout: Longest time (s).
            signals: Counter of the signals that end it. None: no signal does.
            handled: Number of these signals that were caught before and do not end it.

        Yields:
            The time of the nodes, as `seconds` (s).
        """
        if not self._unknown_reported:
            self._unknown_reported = True
            report_unknown([node for node in self._nodes if isinstance(node, ParameterizedNode)])
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
        """Execute callbacks until a condition is true, or as `turns` ends.

        Args:
            until: The condition. It is called often: as often as `turns` yields.
            timeout: As for `turns`, as the other arguments.
            signals: Counter of the signals that end it.
            handled: Number of these signals that do not end it.

        Returns:
            Whether the condition became true.
        """
        turns = self.turns(timeout=timeout, signals=signals, handled=handled)
        return any(until() for _ in turns)

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
        """Wait for a callback for a short time and execute it, or let the simulated time advance once.

        Raises:
            ExternalShutdownException: The context was shut down.
        """


def created(create: Callable[[], N]) -> N:
    """Create a node.

    Raises:
        UserError: The user gave an invalid name, parameter or quality of service.
    """
    try:
        return create()
    except NameValidationException as error:
        # Its lines: the kind of name and the rule, the name, a mark under the place.
        rule, name, *_ = str(error).splitlines()
        raise UserError(f'{rule} {printable(name.strip())}') from error
    except (ParameterError, ParameterException, InvalidQosOverridesError) as error:
        raise UserError(str(error)) from error
    except RCLError as error:
        why = reason(error)
        if 'length should not exceed' in why:
            # Each part was short enough, see `ros_context`.
            why += f'; a name with its namespace must have at most {MAX_NAME_LENGTH} characters'
        raise UserError(why) from error
