"""Faults of the world around the nodes: its clock, its services, and who changes parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

from diffdrive_jacobian.faults.fault import Fault
from diffdrive_jacobian.faults.nodes import NodeFault
from diffdrive_jacobian.lockstep._injection import Injection
from diffdrive_jacobian.numerics.checks import PositiveOrInfinite, finite, number
from diffdrive_jacobian.numerics.fields import Name
from diffdrive_jacobian.time_units import nanoseconds


def _jump(name: str, value: Any) -> float:
    """Require a number of seconds that is not zero in nanoseconds."""
    seconds = number(name, value, finite)
    if nanoseconds(seconds) == 0:
        raise ValueError(f'{name} must not be zero, got {seconds!r}')
    return seconds


def _parameter_value(name: str, value: Any) -> Any:
    """Require a value that a parameter of ROS can have. Returns a list as a tuple."""
    elements = value if isinstance(value, (list, tuple)) else [value]
    if not any(all(type(element) is kind for element in elements) for kind in (bool, int, float, str)):
        raise ValueError(
            f'{name} must be a bool, int, float, str, or a list of one of them, got {value!r}'
        )
    return tuple(value) if isinstance(value, list) else value


@dataclass(frozen=True, repr=False)
class TimeJump(Fault):
    """The clock of all nodes jumps, forward or back, as when a simulator is reset.

    After `duration` it jumps back by as much. The new time is between 1 ns and 2147483647 s, as a
    stamp can represent, where it stays if it should go further. rcl determines how timers react: one
    whose time lies before the new time ticks once.

    Attributes:
        seconds: Length of the jump (s), negative: back.
    """

    seconds: Annotated[float, _jump]

    def install(self, injection: Injection) -> None:
        """Schedule the jump of the clock."""
        injection.jump(nanoseconds(self.seconds))


@dataclass(frozen=True, repr=False)
class ClockPause(Fault):
    """The clock of all nodes stands still, as when a simulator is paused, then goes on from there.

    No timer expires. Messages that are under way still arrive.
    """

    def install(self, injection: Injection) -> None:
        """Schedule the pause of the clock."""
        injection.pause_clock()


@dataclass(frozen=True, repr=False)
class LateService(Fault):
    """A service responds late, or never. Its callback is executed in time.

    Attributes:
        service: Name of the service, resolved as by `Lockstep.call`.
        seconds: Delay of each response (s); infinite: it is never sent.
    """

    service: Name
    seconds: PositiveOrInfinite

    def install(self, injection: Injection) -> None:
        """Delay the responses of the service."""
        late = nanoseconds(self.seconds) if math.isfinite(self.seconds) else None
        injection.delay_responses(self.service, late)


@dataclass(frozen=True, repr=False)
class ParameterChange(NodeFault):
    """Somebody changes a parameter of a node, and changes it back after `duration`.

    If another change of it began meanwhile and still lasts, that one remains until its own end.

    The node may refuse the value, which is noted in the events. It is an error if it has no such
    parameter.

    Attributes:
        name: Name of the parameter.
        value: The new value: bool, int, float, str, or a list of one of them.
    """

    name: Name
    value: Annotated[Any, _parameter_value]

    def install(self, injection: Injection) -> None:
        """Schedule the change of the parameter."""
        injection.change_parameter(self.node, self.name, self.value)
