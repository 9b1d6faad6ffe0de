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

"""Relations of whole worlds: all nodes run again, at another time or under other names."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar

from rclpy.exceptions import InvalidNamespaceException
from rclpy.validate_namespace import validate_namespace

from diffdrive_jacobian.faults import Fault
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.messages.conversion import set_time
from diffdrive_jacobian.messages.names import namespace_of, without_namespace
from diffdrive_jacobian.messages.structure import Array, Sequence, Text, parts
from diffdrive_jacobian.numerics.checks import Positive, between, nonempty
from diffdrive_jacobian.relations.base import Relation
from diffdrive_jacobian.relations.imaging import Imaging
from diffdrive_jacobian.relations.worlds import Ran
from diffdrive_jacobian.time_units import NANOSECONDS, nanoseconds

GLOBAL = ('/tf', '/tf_static')
"""Topics that all robots share, whose names stay."""
LITTLE = 1, 2, 3, 5, 7, 11
"""Multiples of the periods by which worlds are later that show whether rounding decides."""
COARSE = 100.0
"""Their tolerance, relative to that of the relation."""
LATEST = 1e9
"""Latest start: clocks end 68 years after they begin (s)."""
TIME = 'builtin_interfaces/Time'


@dataclass(frozen=True, repr=False)
class WholeWorld(Relation):
    """All nodes are under test, with the world in which they are. Base class."""

    whole_world: ClassVar[bool] = True

    def _at_topic(self, first: Ran) -> set[str]:
        """Return all nodes."""
        return {*first.nodes}


@dataclass(frozen=True, repr=False)
class Shifted(WholeWorld):
    """At another time all nodes do the same.

    Their clocks show other times from the start on. All stamps must be shifted. Rounding of times may
    move events by one `period`. It is compared without faults that let the clock jump, because it
    cannot jump to a time before 0.

    Attributes:
        seconds: How much later it is at least (s). The next multiple of the periods of all timers is
            taken, because these tick when the clock shows multiples of their periods.
        period: The longest period of the timers (s). From the first event on that is moved by up to this
            time, nothing is compared.
    """

    seconds: Annotated[float, between(0.0, LATEST, unit='s')] = 1000.0
    period: Positive = field(default=0.1, kw_only=True)

    @property
    def longest_move(self) -> float:
        """How far an event may be moved (s). What comes after it is not compared."""
        return self.period

    @property
    def start(self) -> float:
        """How much later the clock of the nodes shows at the start (s)."""
        return self.seconds

    def fitted(self, first: Ran) -> Shifted:
        """Return it with the next time that is a multiple of the periods of all timers."""
        step = first.period()
        seconds = math.ceil(nanoseconds(self.seconds) / step) * step / NANOSECONDS
        if seconds > LATEST:
            raise LockstepError(
                f'{self!r}: the periods of the timers have no common multiple below '
                f'{step / NANOSECONDS:g} s; at most {LATEST:g} s is possible'
            )
        return replace(self, seconds=seconds)

    def nearby(self, first: Ran) -> list[Imaging]:
        """Return worlds that are a few periods later. Their times are rounded otherwise, as finely."""
        step = first.period()
        # About seconds, so that times are no coarser.
        step *= math.ceil(NANOSECONDS / step)
        # What rounding decides moves by more than rounding itself.
        coarse = COARSE * self.tolerance
        return [
            replace(self, seconds=count * step / NANOSECONDS, tolerance=coarse)
            for count in LITTLE
            if count * step <= LATEST * NANOSECONDS
        ]

    def is_disturbed_by(self, fault: Fault) -> bool:
        """Return whether the clock jumps."""
        return bool(fault.clock_jumps)

    def image(self, topic: str, message: Any) -> Any:
        """Return the message with later stamps. A stamp of zero means that there is none."""
        for kind, part in parts(message):
            if kind.name == TIME and (part.sec or part.nanosec):
                set_time(part, part.sec * NANOSECONDS + part.nanosec + nanoseconds(self.seconds))
        return message


def _namespace(name: str, value: Any) -> str:
    """Require a namespace, such as /robot1."""
    full = f'/{str(nonempty(name, value)).strip("/")}'
    try:
        if full == '/':
            raise ValueError(f"{name} must be a namespace such as '/robot1', got {value!r}")
        validate_namespace(full)
    except InvalidNamespaceException as error:
        why = str(error).splitlines()[0].rstrip(':')
        raise ValueError(f"{name} must be a namespace such as '/robot1', got {value!r}: {why}") from None
    return full


@dataclass(frozen=True, repr=False)
class Renamed(WholeWorld):
    """In another namespace all nodes do the same.

    All nodes run in the namespace. Their topics must be in it, except /tf and /tf_static. Names of
    frames and other texts may begin with it. A node in another process is in a namespace only if its
    command says so.

    Attributes:
        namespace: The namespace.
    """

    namespace: str = '/renamed'

    def __post_init__(self) -> None:
        """Check the fields."""
        super().__post_init__()
        try:
            object.__setattr__(self, 'namespace', _namespace('namespace', self.namespace))
        except ValueError as error:
            raise ValueError(f'Renamed: {error}') from None

    @property
    def args(self) -> tuple[str, ...]:
        """ROS arguments of all nodes, before those of the world."""
        return '--ros-args', '-r', f'__ns:={self.namespace}'

    def image(self, topic: str, message: Any) -> Any:
        """Return the message."""
        return message

    def fitted(self, first: Ran) -> Renamed:
        """Check that all nodes are in the namespace of the world, which is replaced."""
        for name in first.nodes:
            if namespace_of(name) != first.namespace:
                raise LockstepError(
                    f'{self!r} replaces the namespace of the world, {first.namespace}; node {name} is '
                    'in another one'
                )
        return self

    def nearby(self, first: Ran) -> list[Imaging]:
        """Return none: nothing is rounded otherwise."""
        return []

    def renamed(self, name: str, namespace: str) -> str:
        """Return the full name of a node or a topic in the image."""
        return name if name in GLOBAL else self.namespace + without_namespace(name, namespace)

    def compared(self, message: Any, namespace: str) -> Any:
        """Return a message without the namespace in its texts, and without the slash before a name."""
        prefixes = (f'{namespace.rstrip("/")}/', f'{namespace.strip("/")}/', '/')

        def without(text: str) -> str:
            return next((text.removeprefix(one) for one in prefixes if text.startswith(one)), text)

        for kind, part in parts(message):
            for name, one in kind.fields:
                match one:
                    case Text():
                        setattr(part, name, without(getattr(part, name)))
                    case Array(Text()) | Sequence(Text()):
                        setattr(part, name, [without(text) for text in getattr(part, name)])
        return message
