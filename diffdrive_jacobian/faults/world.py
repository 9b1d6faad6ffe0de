"""Faults of the world around the nodes: its clock, its services, and who changes parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from diffdrive_jacobian.faults.fault import Fault
from diffdrive_jacobian.faults.nodes import NodeFault
from diffdrive_jacobian.lockstep import Injection
from diffdrive_jacobian.time_units import nanoseconds


@dataclass(frozen=True, repr=False)
class TimeJump(Fault):
    """The clock of all nodes jumps, forward or back, as when a simulator is reset.

    After `duration` it jumps back by as much. The new time is between 1 ns and 2147483647 s, as a
    stamp can represent, where it stays if it should go further. rcl determines how timers react: one
    whose time lies before the new time ticks once.

    Attributes:
        seconds: Length of the jump (s), negative: back.
    """

    seconds: float

    def __post_init__(self) -> None:
        """Check the fields."""
        super().__post_init__()
        self._number('seconds')
        if nanoseconds(self.seconds) == 0:
            raise ValueError(f'TimeJump: seconds must not be zero, got {self.seconds!r}')

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

    service: str
    seconds: float

    def __post_init__(self) -> None:
        """Check the fields."""
        super().__post_init__()
        self._text('service')
        self._number('seconds', low=0.0, above=True, infinite=True)

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

    name: str
    value: Any

    def __post_init__(self) -> None:
        """Check the fields."""
        super().__post_init__()
        self._text('name')
        value = self.value
        if isinstance(value, list):
            object.__setattr__(self, 'value', tuple(value))
        for kind in (bool, int, float, str):
            elements = value if isinstance(value, (list, tuple)) else [value]
            if all(type(element) is kind for element in elements):
                return
        raise ValueError(
            'ParameterChange: value must be a bool, int, float, str, or a list of one of them, '
            f'got {value!r}'
        )

    def install(self, injection: Injection) -> None:
        """Schedule the change of the parameter."""
        injection.change_parameter(self.node, self.name, self.value)
