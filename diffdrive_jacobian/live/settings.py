"""The parameters that the page offers, and their values."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType
from typing import Any, Literal

from diffdrive_jacobian.control import ControllerError, Gain, controller_names, find_controller
from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.live.quantities import rounded
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
TAKES_TIME = 'Time to follow commands'


class SettingError(DiffdriveError, ValueError):
    """The page wants to set what it cannot."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Setting:
    """A parameter of a node as the page offers it."""

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
    """Heading below which it is folded away while none of the group is in use; '': always shown."""

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
    Setting(role='controller', name='controller', label='Control law', kind='choice',
            hint='How goal and pose become v and ω'),
    Setting(role='controller', name='use_goal_heading', label='Goal heading', kind='flag',
            hint='Turn in place to the heading of the last goal'),
    Setting(role='controller', name='xy_goal_tolerance', label='Tolerance', unit='m', low=0.005,
            high=0.5, hint='Distance that counts as arrived: the circle around the goal'),
    Setting(role='controller', name='linear.x.max_velocity', label='Limit of v', unit='m/s', low=0.02,
            high=2.0, kind='limit', hint='Both speeds are scaled alike, so the path stays the same'),
    Setting(role='controller', name='angular.z.max_velocity', label='Limit of ω', unit='rad/s', low=0.1,
            high=6.0, kind='limit', hint='Both speeds are scaled alike, so the path stays the same'),
    Setting(role='robot', name='max_wheel_velocity', label='Wheel limit', unit='rad/s', low=1.0,
            high=40.0, kind='limit', hint='Both wheels are scaled alike'),
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
    Setting(role='robot', name='wheel_travel_variance', label='Wheel noise', unit='m', low=0.0,
            high=0.002, hint='Variance per distance: how fast the uncertainty region grows'),
)  # fmt: skip
_DECLARED = {
    'controller': GoToGoalParameters().declared(),
    'robot': VirtualRobotParameters().declared(),
}
SETTINGS = [replace(one, declared=_DECLARED[one.role][one.name].limits) for one in _OFFERED]
"""What the page offers besides the gains. A node is asked for those that it has."""


@lru_cache(maxsize=16)
def gains(controller: str) -> tuple[Gain, ...]:
    """Return the gains of a controller; of one that is not installed here they are unknown."""
    try:
        return find_controller(controller).gains
    except ControllerError:
        return ()


def recorded_gains(values: Mapping[str, Any]) -> tuple[Gain, ...]:
    """Return the gains among the recorded parameters of a go_to_goal: those that are not its own.

    Their descriptions and ranges are in the package of the controller, which may be missing here.
    """
    own = _DECLARED['controller']
    found = []
    for name, value in values.items():
        if name not in own and isinstance(value, float):
            with suppress(ValueError):
                found.append(Gain(name=name, default=value, unit='', description='Gain, as recorded'))
    return tuple(found)


def offered(gains: Iterable[Gain]) -> list[Setting]:
    """Return what the page offers for a controller with some gains."""
    sliders = [
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
    return [*sliders, *SETTINGS]


def find(key: str, gains: Iterable[Gain]) -> Setting:
    """Return a setting by its name on the page.

    Raises:
        SettingError: There is none.
    """
    for setting in offered(gains):
        if setting.key == key:
            return setting
    raise SettingError(f'there is no setting {printable(key, 40)}')


def shown(
    values: Mapping[str, Mapping[str, Any]],
    gains: Iterable[Gain],
    ranges: Mapping[str, Mapping[str, Range]] = MappingProxyType({}),
) -> list[dict[str, Any]]:
    """Return the settings that nodes have, with their values, for the page.

    `values` and `ranges` are the parameters by role, and the ranges that the nodes serve.
    """
    found = []
    for setting in offered(gains):
        value = values.get(setting.role, {}).get(setting.name)
        if not isinstance(value, TYPES[setting.kind]):
            continue
        low, high = setting.slider(ranges.get(setting.role, {}).get(setting.name))
        row = {
            'key': setting.key,
            'label': setting.label,
            'hint': setting.hint,
            'group': setting.group,
            'unit': setting.unit,
            'kind': setting.kind,
            'low': low,
            'high': high,
            'value': value[:64] if isinstance(value, str) else rounded(value),
        }
        if setting.kind == 'choice':
            row['choices'] = list(dict.fromkeys([*_controllers()[:MAX_CHOICES], row['value']]))
        found.append(row)
    return found


@lru_cache(maxsize=1)
def _controllers() -> tuple[str, ...]:
    # To find the installed ones takes many milliseconds.
    return tuple(controller_names())
