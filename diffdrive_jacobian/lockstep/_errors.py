"""Errors of lockstep."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.ros.rclpy_internals import RCLError


class LockstepError(DiffdriveError):
    """A condition was not met in time, simulated time could not advance, or lockstep was misused.

    The first line of the message describes the error. The last messages of all topics may follow.
    """


class InitializedError(LockstepError, RuntimeError):
    """The user has called `rclpy.init`. A RuntimeError, as without lockstep."""


class IneffectiveFaultsError(LockstepError):
    """Injected faults met nothing that they could affect."""

    def __init__(self, faults: Sequence[str], reasons: Sequence[str]) -> None:
        """Describe the faults.

        Args:
            faults: Each fault with its reason.
            reasons: Only the reasons, such as `no node /x was seen`.
        """
        super().__init__(faults, reasons)
        self.faults = tuple(faults)
        """Each fault with its reason."""
        self.reasons = tuple(dict.fromkeys(reasons))
        """The different reasons."""

    def __str__(self) -> str:
        """Return the message."""
        return 'faults without effect: ' + '; '.join(self.faults)


class PropertyViolation(LockstepError):  # noqa: N818
    """A required property does not hold. Raised by the method that advanced time.

    The message begins with the property, the time, what was observed and what is allowed.
    """

    def __init__(self, violated: Any, seconds: float, text: str, report: str = '') -> None:
        """Describe a violation.

        Args:
            violated: The property.
            seconds: Time since the start of the `Lockstep` (s).
            text: What was observed, and what is allowed.
            report: The last messages of all topics.
        """
        super().__init__(violated, seconds, text, report)
        self.property = violated
        """The property that is violated."""
        self.seconds = seconds
        """World time since the start of the `Lockstep` (s)."""
        self.text = text
        """What was observed, and what is allowed."""
        self.report = report
        """The last messages of all topics."""

    def __str__(self) -> str:
        """Return the message."""
        first = f'{self.property} is violated at {self.seconds:g} s: {self.text}'
        return f'{first}\n{self.report}' if self.report else first


def described(value: Any) -> str:
    """Return a description of an argument of a wrong kind."""
    if isinstance(value, type):
        return f'the class {value.__name__}'
    return f"'{value}'" if isinstance(value, str) else f'an object of the class {type(value).__name__}'


_TWO_TYPES = re.compile(r'existing topic name rt(/\S+) with incompatible type (\w+)::msg::dds_::(\w+)_')


@contextmanager
def one_type_per_topic() -> Iterator[None]:
    """Explain the error of rcl about a topic that has another type in this process.

    Raises:
        LockstepError: There is one.
    """
    try:
        yield
    except RCLError as error:
        if (found := _TWO_TYPES.search(str(error))) is None:
            raise
        topic, package, kind = found.groups()
        hint = ''
        if kind.startswith('Twist'):
            hint = (
                '. The nodes of this package take TwistStamped with enable_stamped_cmd_vel, for example '
                "VirtualRobot(parameter_overrides=[Parameter('enable_stamped_cmd_vel', value=True)])"
            )
        raise LockstepError(
            f'{topic} cannot have the type {package}/msg/{kind}: another node of this world uses it '
            f'with another type{hint}'
        ) from error
