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

"""The commands that the page sends, checked before anything acts on them.

Each is a JSON object: `do` names the command, the other keys are its values. Every key must be there,
no other key may be, and numbers must be finite and plausible.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, fields
from typing import Annotated, Any, NoReturn

from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.messages.conversion import MAX_POSITION, MAX_SPEED
from diffdrive_jacobian.numerics.checks import Checked, between, optional, short

MAX_SIZE = 4096
"""Largest size of a command (bytes)."""
MAX_TEXT = 256
"""Largest length of a text in a command (characters)."""
MIN_WORLD_SPEED, MAX_WORLD_SPEED = 0.01, 1000.0
"""Speeds of simulated time or of a bag, relative to the clock on the wall."""


class CommandError(DiffdriveError, ValueError):
    """The page sent something that is no command. The message says what is wrong."""


def _text(name: str, value: Any) -> str:
    # Nodes cannot encode a lone surrogate, and cut a text at NUL.
    if not isinstance(value, str) or len(value) > MAX_TEXT or not value.isprintable():
        raise ValueError(
            f'{name} must be a text of at most {MAX_TEXT} printable characters, got {short(value, repr)}'
        )
    return value


def _setting(name: str, value: Any) -> float | str | bool | None:
    if value is None or isinstance(value, bool):
        return value
    return _text(name, value) if isinstance(value, str) else between(-1e6, 1e6)(name, value)


_angle = between(-math.tau, math.tau, unit='rad')
_Text = Annotated[str, _text]
_Position = Annotated[float, between(-MAX_POSITION, MAX_POSITION, unit='m')]
_Velocity = Annotated[float, between(-MAX_SPEED, MAX_SPEED)]


@dataclass(frozen=True, slots=True)
class Command(Checked):
    """A command of the page."""


@dataclass(frozen=True, slots=True)
class RobotCommand(Command):
    """A command for one robot."""

    robot: _Text
    """Its namespace."""


@dataclass(frozen=True, slots=True)
class SendGoal(RobotCommand):
    """Send a goal."""

    x: _Position
    y: _Position
    theta: Annotated[float | None, optional(_angle)]
    """Heading at the goal (rad). None: the direction from which the robot comes."""
    append: bool
    """Whether it is a further waypoint after the present goals."""


class CancelGoal(RobotCommand):
    """Cancel the goal."""


@dataclass(frozen=True, slots=True)
class DriveByHand(RobotCommand):
    """Drive by hand. It must be repeated, otherwise the robot stops."""

    v: _Velocity
    omega: _Velocity


class Release(RobotCommand):
    """End driving by hand: the robot stops."""


@dataclass(frozen=True, slots=True)
class Place(RobotCommand):
    """Set the pose of the robot."""

    x: _Position
    y: _Position
    theta: Annotated[float, _angle]


class Reset(RobotCommand):
    """Reset the odometry to the initial pose."""


class ClearPath(RobotCommand):
    """Forget the path that the page draws."""


@dataclass(frozen=True, slots=True)
class SetParameter(RobotCommand):
    """Set a parameter of a node."""

    parameter: _Text
    """Name of the parameter on the page, `ROLE/NAME`."""
    value: Annotated[float | str | bool | None, _setting]
    """None: no limit."""


@dataclass(frozen=True, slots=True)
class Pause(Command):
    """Stop or continue simulated time, or a bag."""

    paused: bool


class Step(Command):
    """Advance by one time step, and pause."""


@dataclass(frozen=True, slots=True)
class SetSpeed(Command):
    """Set the speed of simulated time, or of a bag."""

    speed: Annotated[float, between(MIN_WORLD_SPEED, MAX_WORLD_SPEED)]


@dataclass(frozen=True, slots=True)
class Seek(Command):
    """Go to a time of the bag (s)."""

    time: Annotated[float, between(0.0, 1e9, unit='s')]


_KINDS: dict[str, type[Command]] = {
    'goal': SendGoal,
    'cancel': CancelGoal,
    'drive': DriveByHand,
    'release': Release,
    'place': Place,
    'reset': Reset,
    'clear_path': ClearPath,
    'set': SetParameter,
    'pause': Pause,
    'step': Step,
    'speed': SetSpeed,
    'seek': Seek,
}


def parse(text: str | bytes) -> Command:
    """Return the command in a message of the page.

    Raises:
        CommandError: It is no command, or a value is invalid.
    """
    if not isinstance(text, str):
        raise CommandError('a command must be text, got bytes')
    try:
        content = json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise CommandError(f'a command must be JSON, got {short(text, repr)}') from error
    if not isinstance(content, dict):
        raise CommandError(f'a command must be a JSON object, got {short(content, repr)}')
    name = content.pop('do', None)
    kind = _KINDS.get(name) if isinstance(name, str) else None
    if kind is None:
        raise CommandError(f'do must be one of {", ".join(_KINDS)}, got {short(name, repr)}')
    names = [field.name for field in fields(kind)]
    if sorted(content) != sorted(names):
        keys = ', '.join(names) or 'of no value'
        raise CommandError(f'{name} must have the keys {keys}, got {short(list(content), repr)}')
    try:
        return kind(**content)
    except ValueError as error:
        raise CommandError(str(error)) from None


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f'{name} is no JSON')
