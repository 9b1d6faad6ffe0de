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

"""Gains of given or installed controllers: they become parameters when their controller is chosen."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from diffdrive_jacobian.control.controller import ControlLaw, Gain
from diffdrive_jacobian.parameters.declaration import Parameter, ParameterError


def description(gain: Gain) -> str:
    """Return the description of the parameter with a gain."""
    return f'{gain.description} [{gain.unit}].' if gain.unit else f'{gain.description}.'


@dataclass(frozen=True, slots=True)
class MoreGains:
    """Gains beyond those of the built-in controllers, in the order of the choice. Immutable."""

    gains: tuple[Gain, ...] = ()
    """Also those that share a parameter of a built-in controller, but have another default."""
    values: Mapping[str, float] = field(default_factory=dict, hash=False)
    """The values of those that are parameters of their own, by name."""

    def declared(self) -> dict[str, Parameter]:
        """Return their parameters by name."""
        return {
            gain.name: Parameter(
                name=gain.name,
                field=gain.name,
                default=gain.default,
                description=description(gain),
                within=gain.range,
            )
            for gain in self.gains
        }

    def with_gains_of(
        self, controller: ControlLaw, what: str, built_in: Mapping[str, Gain], used: Collection[str]
    ) -> MoreGains:
        """Return these and the gains of a controller, with their defaults.

        Args:
            controller: The controller.
            what: What it is, for the error.
            built_in: The gains of the built-in controllers, by name.
            used: Names that the node uses otherwise.

        Raises:
            ParameterError: A gain has a name that is used otherwise, or another range than the gain of
                that name.
        """
        more = {gain.name: gain for gain in self.gains}
        for gain in controller.gains:
            known = more.get(gain.name) or built_in.get(gain.name)
            if known is None and gain.name in used:
                raise ParameterError(
                    f'{what} has a gain {gain.name!r}, a name that go_to_goal uses otherwise: choose '
                    'another one'
                )
            if known is not None and not gain.shares_range(known):
                raise ParameterError(
                    f'{what} has a gain {gain.name!r} with another unit or other bounds than the '
                    'parameter of that name: choose another name'
                )
            if built_in.get(gain.name) != gain:
                more[gain.name] = gain
        new = {gain.name: gain.default for gain in more.values() if gain.name not in built_in}
        return MoreGains(tuple(more.values()), {**new, **self.values})

    def changed(self, values: Mapping[str, Any]) -> MoreGains:
        """Return these with new values; others are ignored."""
        own = {name: value for name, value in values.items() if name in self.values}
        return MoreGains(self.gains, {**self.values, **own})
