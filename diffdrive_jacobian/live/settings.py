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

"""The parameters that the page offers, and their values."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType
from typing import Any, Literal

from diffdrive_jacobian.control import ControllerError, Gain
from diffdrive_jacobian.control.controllers import ALL_PATH_CONTROLLERS, CONTROLLERS, Controllers
from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.live.quantities import rounded
from diffdrive_jacobian.parameters.chosen_law import chosen_law
from diffdrive_jacobian.parameters.go_to_goal import GoToGoalParameters
from diffdrive_jacobian.parameters.virtual_robot import VirtualRobotParameters
from diffdrive_jacobian.text import printable

Role = Literal['controller', 'robot']
Range = tuple[float, float]
"""Smallest and largest value."""
MAX_CHOICES = 32
"""Largest number of controllers that are offered."""
TYPES: dict[str, type[float | str | bool]] = {
    'number': float,
    'limit': float,
    'choice': str,
    'flag': bool,
}
"""Type of the values of each kind of setting."""
TAKES_TIME = 'Time to follow'
GROUPS = {'goal': 'For goals', 'path': 'Along a path'}
"""Headings of what concerns the one while the other is driven."""
Values = Mapping[str, Any]
"""Parameters by name."""


class SettingError(DiffdriveError, ValueError):
    """The page wants to set what it cannot."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Setting:
    """A parameter of a node as the page offers it."""

    of: Literal['goal', 'path', ''] = ''
    """What it concerns: goals or paths; '': both."""

    role: Role
    """The node: the one that publishes goal_status, or the one that publishes odom."""
    name: str
    label: str
    hint: str
    """What happens when it changes."""
    low: float = 0.0
    """Usual range, for the slider. The field beside it takes other values, too; the node decides."""
    high: float = 1.0
    declared: Range | None = None
    """Range that a node of this package serves, which is too wide for a slider. None: it serves none."""
    unit: str = ''
    kind: Literal['number', 'limit', 'choice', 'flag'] = 'number'
    """`limit`: a number, or NaN for none."""
    group: str = ''
    """Heading below which it is folded away; '': always shown."""

    def slider(self, served: Range | None) -> Range:
        """Return the range of the slider for a node that serves a range in its descriptor."""
        # A node of this package serves all valid values, of which the usual ones are shown.
        return (self.low, self.high) if served is None or served == self.declared else served

    @property
    def key(self) -> str:
        """Name on the page."""
        return f'{self.role}/{self.name}'

    def checked(self, value: object) -> float | str | bool:
        """Return a value of the page as the parameter takes it.

        Raises:
            SettingError: It is of another type.
        """
        value = math.nan if self.kind == 'limit' and value is None else value
        if isinstance(value, TYPES[self.kind]):
            return value
        raise SettingError(f'{self.name} cannot be {printable(repr(value), 40)}')


_OFFERED = (
    Setting(of='goal', role='controller', name='controller', label='Control law', kind='choice',
            hint='How goal and pose become v and ω'),
    Setting(of='path', role='controller', name='path_controller', label='Path law', kind='choice',
            hint='How the pose and the point of the path become v and ω'),
    Setting(of='path', role='controller', name='path_speed', label='Speed', unit='m/s', low=0.02,
            high=1.0, hint='Speed along a path without times'),
    Setting(of='goal', role='controller', name='use_goal_heading', label='Goal heading', kind='flag',
            hint='Turn in place to the heading of the last goal'),
    Setting(role='controller', name='xy_goal_tolerance', label='Tolerance', unit='m', low=0.005,
            high=0.5, hint='Distance that counts as arrived: the circle around the goal'),
    Setting(role='controller', name='linear.x.max_velocity', label='Limit of v', unit='m/s', low=0.02,
            high=2.0, kind='limit', hint='Both speeds are scaled alike, so the path stays the same'),
    Setting(role='controller', name='angular.z.max_velocity', label='Limit of ω', unit='rad/s', low=0.1,
            high=6.0, kind='limit', hint='Both speeds are scaled alike, so the path stays the same'),
    Setting(role='robot', name='max_wheel_velocity', label='Wheel limit', unit='rad/s', low=1.0,
            high=40.0, kind='limit', hint='Both wheels are scaled alike'),
    Setting(role='robot', name='wheel_travel_variance', label='Wheel noise', unit='m', low=0.0,
            high=0.002, hint='Variance per distance: how fast the uncertainty region grows'),
    Setting(role='robot', group=TAKES_TIME, name='linear.x.max_acceleration',
            label='Limit of dv/dt', unit='m/s²',
            low=0.05, high=3.0, kind='limit', hint='The path stays a circle from and to rest'),
    Setting(role='robot', group=TAKES_TIME, name='angular.z.max_acceleration',
            label='Limit of dω/dt', unit='rad/s²',
            low=0.1, high=10.0, kind='limit', hint='The path stays a circle from and to rest'),
    Setting(role='robot', group=TAKES_TIME, name='wheel_lag',
            label='Wheel lag', unit='s', low=0.0, high=1.0,
            hint='Time constant with which the wheels follow'),
    Setting(role='robot', group=TAKES_TIME, name='command_delay',
            label='Delay', unit='s', low=0.0, high=1.0,
            hint='Time from a command to its effect'),
)  # fmt: skip
_DECLARED = {
    'controller': GoToGoalParameters().declared(),
    'robot': VirtualRobotParameters().declared(),
}
SETTINGS = [replace(one, declared=_DECLARED[one.role][one.name].limits) for one in _OFFERED]
"""What the page offers besides the gains. A node is asked for those that it has."""


@lru_cache(maxsize=16)
def _installed(registry: Controllers[Any], name: str) -> tuple[Gain, ...]:
    """Return the gains of a law that is installed here; of another one they are unknown."""
    try:
        return tuple(registry.find(name).gains)
    except ControllerError:
        return ()


def gains(values: Values, *, path: bool, imported: bool) -> tuple[Gain, ...]:
    """Return the gains of the law of goals or of paths that the parameters of a controller choose.

    A law of another package is imported only if that is wanted, for its descriptions and ranges.
    """
    registry = ALL_PATH_CONTROLLERS if path else CONTROLLERS
    chosen = chosen_law(values, path=path)
    if chosen.law is None and chosen.name and imported:
        return _installed(registry, chosen.name)
    return chosen.gains


def offered(values: Values, *, path: bool, imported: bool) -> list[Setting]:
    """Return what the page offers for a controller with these parameters.

    What concerns what it drives now, goals or a path, comes first, the other is folded away.
    """
    now, other = ('path', 'goal') if path else ('goal', 'path')
    found: dict[str, Setting] = {}
    for of in (now, '', other):
        of_law = gains(values, path=of == 'path', imported=imported) if of else ()
        for one in (*_sliders(of_law), *(one for one in SETTINGS if one.of == of)):
            group = GROUPS[other] if of == other else one.group
            found.setdefault(one.key, replace(one, group=group))
    return list(found.values())


def _sliders(gains: Iterable[Gain]) -> list[Setting]:
    return [
        Setting(
            role='controller',
            name=gain.name,
            label=gain.label or gain.name,
            hint=gain.description,
            unit=gain.unit,
            low=gain.usual[0],
            high=gain.usual[1],
            declared=(gain.bounds[0] if gain.above is None else gain.above, gain.bounds[1]),
        )
        for gain in gains
    ]


def find(key: str, values: Values) -> Setting:
    """Return a setting by its name on the page, for a controller with these parameters.

    Raises:
        SettingError: There is none.
    """
    for setting in offered(values, path=False, imported=True):
        if setting.key == key:
            return setting
    raise SettingError(f'there is no setting {printable(key, 40)}')


def shown(
    values: Mapping[str, Values],
    ranges: Mapping[str, Mapping[str, Range]] = MappingProxyType({}),
    *,
    path: bool,
    imported: bool,
) -> list[dict[str, Any]]:
    """Return the settings that nodes have, with their values, for the page.

    Args:
        values: Parameters of the nodes by role.
        ranges: Ranges that the nodes serve, by role.
        path: Whether a path is driven along.
        imported: As for `gains`.
    """
    found = []
    for setting in offered(values.get('controller', {}), path=path, imported=imported):
        value = values.get(setting.role, {}).get(setting.name)
        if not isinstance(value, TYPES[setting.kind]):
            continue
        low, high = setting.slider(ranges.get(setting.role, {}).get(setting.name))
        row = {
            'key': setting.key,
            'label': setting.label,
            'hint': setting.hint,
            'group': setting.group,
            # Its group is folded away otherwise.
            'used': setting.group == TAKES_TIME and bool(rounded(value)),
            'unit': setting.unit,
            'kind': setting.kind,
            'low': low,
            'high': high,
            'value': value[:64] if isinstance(value, str) else rounded(value),
        }
        if setting.kind == 'choice':
            names = _names(setting.name)[:MAX_CHOICES]
            row['choices'] = list(dict.fromkeys([*names, row['value']]))
        found.append(row)
    return found


@lru_cache(maxsize=2)
def _names(parameter: str) -> tuple[str, ...]:
    # To find the installed ones takes many milliseconds.
    return tuple(ALL_PATH_CONTROLLERS if parameter == 'path_controller' else CONTROLLERS)
