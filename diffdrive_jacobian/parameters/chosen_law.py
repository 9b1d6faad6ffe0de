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

"""The control law that drives, by the parameters of a go_to_goal that were recorded or reported."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, NamedTuple

from diffdrive_jacobian.control.controller import ControlLaw, Gain
from diffdrive_jacobian.control.controllers import ALL_PATH_CONTROLLERS, CONTROLLERS
from diffdrive_jacobian.parameters.go_to_goal import GoToGoalParameters

_OWN = GoToGoalParameters().declared()


class ChosenLaw(NamedTuple):
    """A control law by its name, and its gains."""

    name: str
    """'': it is not known."""
    law: ControlLaw | None
    """None: it is no law of this package."""
    gains: tuple[Gain, ...]
    values: dict[str, float]
    """Values of the gains by name; NaN: not known."""


def chosen_law(parameters: Mapping[str, Any], *, path: bool = False) -> ChosenLaw:
    """Return the law of goals, or the law of paths, that parameters choose.

    A law of another package is not imported: it may be missing here, or another version. Its gains are
    then the parameters that are not those of every go_to_goal, without descriptions and ranges.
    """
    registry = ALL_PATH_CONTROLLERS if path else CONTROLLERS
    name = parameters.get(registry.parameter)
    if not isinstance(name, str):
        return ChosenLaw('', None, (), {})
    law = registry.built_in.get(name)
    gains = _unknown_gains(parameters) if law is None else law.gains
    values = {gain.name: _number(parameters.get(gain.name)) for gain in gains}
    return ChosenLaw(name[:64], law, gains, values)


def ignores_heading(values: Mapping[str, Any]) -> bool:
    """Return whether a controller with these parameters ignores the heading of goals.

    Other controllers than the built-in ones may take it.
    """
    controller = CONTROLLERS.built_in.get(str(values.get('controller')))
    return (
        values.get('use_goal_heading') is False
        and controller is not None
        and not controller.takes_heading
    )


def _number(value: object) -> float:
    # Other recorders may store 3 for 3.0.
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return float(value) if number else math.nan  # type: ignore[arg-type]


def _unknown_gains(parameters: Mapping[str, Any]) -> tuple[Gain, ...]:
    found = []
    for name, value in parameters.items():
        if name not in _OWN and isinstance(value, float):
            # Not every parameter could be a gain.
            with suppress(ValueError):
                found.append(Gain(name=name, default=value, unit='', description='Gain, as recorded'))
    return tuple(found)
