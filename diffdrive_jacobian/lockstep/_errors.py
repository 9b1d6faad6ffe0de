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

"""Errors of lockstep."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any

from rclpy.node import Node

from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.messages.names import type_name
from diffdrive_jacobian.ros.node import ParameterizedNode
from diffdrive_jacobian.ros.rclpy_internals import RCLError
from diffdrive_jacobian.text import error_text


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


def raised(error: Exception) -> str:
    """Return what a property has raised instead of an answer, and where, as text."""
    *_, last = traceback.extract_tb(error.__traceback__)
    name = type(error).__name__
    text = f': {error_text(error)}' if error_text(error) else ''
    return f'it raised {name}{text}, in {last.filename}:{last.lineno} ({last.name})'


def described(value: Any) -> str:
    """Return a description of an argument of a wrong kind."""
    if isinstance(value, type):
        return f'the class {value.__name__}'
    return f"'{value}'" if isinstance(value, str) else f'an object of the class {type(value).__name__}'


def one_type_per_topic(create: Callable[..., Any]) -> Callable[..., Any]:
    """Explain the error of rcl about a topic that has another type in this process.

    Args:
        create: `create_publisher` or `create_subscription` of nodes.
    """

    @wraps(create)
    def created(self: Node, message_type: Any, topic: str, *args: Any, **kwargs: Any) -> Any:
        try:
            return create(self, message_type, topic, *args, **kwargs)
        except RCLError as error:
            # Those of this package explain it themselves.
            if isinstance(self, ParameterizedNode):
                raise
            name, wanted = self.resolve_topic_name(topic), type_name(message_type)
            types = dict(self.get_topic_names_and_types()).get(name, [])
            others = [one for one in types if one != wanted]
            if not others:
                raise
            hint = ''
            if 'Twist' in wanted:
                hint = (
                    '. The nodes of this package take TwistStamped with enable_stamped_cmd_vel, for '
                    "example VirtualRobot(parameter_overrides=[Parameter('enable_stamped_cmd_vel', "
                    'value=True)])'
                )
            raise LockstepError(
                f'{name} cannot have the type {wanted}: another node of this world uses it as '
                f'{", ".join(others)}{hint}'
            ) from error

    return created
