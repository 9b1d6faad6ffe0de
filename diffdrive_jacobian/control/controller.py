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

"""A controller: a control law and everything that nodes, sweeps and batches need to know about it.

A law is a function `law(poses, goals, *gains) -> (v, omega)` of NumPy arrays:

    poses   shape (..., 3), `[x, y, theta]` (m, m, rad)
    goals   shape (..., 2), or (..., 3) if the controller takes the goal's heading
    gains   each of shape (...), in the order of `Controller.gains`
    v       forward speed, shape (...) (m/s)
    omega   yaw rate, shape (...) (rad/s)

The node go_to_goal calls it with one pose at a time. Batches and sweeps call it with many.
"""

from __future__ import annotations

import re
import traceback
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from keyword import iskeyword
from math import isfinite
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any

import numpy as np

from diffdrive_jacobian.control.path import Reference
from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.kinematics.saturation import VelocityLimits
from diffdrive_jacobian.numerics.checks import (
    Checked,
    Finite,
    Range,
    function,
    numbers,
    optional,
    short,
)
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.time_units import NANOSECONDS

Law = Callable[..., tuple[Any, ...]]
"""`law(poses, goals, *gains) -> (v, omega)`, as described above."""
GainValues = Any
"""An object with an attribute for each gain, such as the parameters of the node go_to_goal."""
_NAME = re.compile(r'[A-Za-z][A-Za-z0-9_.-]{0,63}')
_GAIN = re.compile(r'[a-z][a-z0-9_]{0,31}')
LARGEST_GAIN = 100.0
LONGEST_TEXT = 500
"""Longest text of a law that is passed on (characters)."""


class LawError(DiffdriveError, ValueError):
    """A law raised an exception or returned something other than two finite numbers."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Gain(Checked):
    """A gain of a law: a parameter of the node go_to_goal, a slider of the page, an axis of sweeps.

    An invalid field, and a default out of range, raise ValueError.
    """

    name: str
    """Name of the parameter: a lower-case letter, then letters, digits or `_`, at most 32. Laws with a
    gain of the same name share the parameter, and must give it the same unit and bounds."""
    default: Finite
    unit: str = '1/s'
    description: str = 'Gain'
    """What it acts on, for help texts."""
    bounds: tuple[float, float] = (-LARGEST_GAIN, LARGEST_GAIN)
    """Smallest and largest value."""
    above: Finite | None = None
    """Lower bound that is itself not allowed, besides `bounds`."""
    label: str = ''
    """Label on the page; `_{xyz}`, and `_x` at the end of a word, are subscripts. Default: the name."""
    usual: tuple[float, ...] = ()
    """First and last value of the slider and of sweeps; default: a tenth and three times the default."""

    def __post_init__(self) -> None:
        """Check every field."""
        Checked.__post_init__(self)
        if not _GAIN.fullmatch(self.name) or iskeyword(self.name):
            raise ValueError(
                'name of a gain must be a lower-case letter, then lower-case letters, digits or _, at '
                f'most 32, got {short(repr(self.name))}'
            )
        low, high = numbers('bounds', self.bounds, 2)
        object.__setattr__(self, 'bounds', (low, high))
        self.check(self.default)
        if isinstance(self.usual, tuple) and not self.usual:
            about = sorted((self.default / 10.0, 3.0 * self.default)) if self.default else [low, high]
            first, last = max(low, about[0]), min(high, about[1])
            if self.above is not None and first <= self.above:
                first = self.default
            object.__setattr__(self, 'usual', (first, last))
        first, last = numbers('usual', self.usual, 2)
        if not first < last:
            raise ValueError(f'usual must be (first, last) with first < last, got {self.usual}')
        self.check(first)
        self.check(last)
        object.__setattr__(self, 'usual', (first, last))

    @property
    def range(self) -> Range:
        """The values allowed."""
        return Range(*self.bounds, self.above)

    def shares_range(self, other: Gain) -> bool:
        """Return whether a gain of the same name allows the same values, so that it can be shared."""
        return (self.unit, self.bounds, self.above) == (other.unit, other.bounds, other.above)

    def check(self, value: float) -> None:
        """Raise ValueError if a value is not allowed."""
        self.range(self.name, value)


KP = Gain(
    name='kp',
    default=3.0,
    description='Gain on the heading error; should be larger than kv',
    bounds=(0.0, LARGEST_GAIN),
    above=0.0,
    label='K_p',
    usual=(0.2, 6.0),
)
KV = Gain(
    name='kv',
    default=0.5,
    description='Gain on the distance',
    bounds=(0.0, LARGEST_GAIN),
    above=0.0,
    label='K_v',
    usual=(0.1, 3.0),
)
OFFSET = Gain(
    name='offset',
    default=0.1,
    unit='m',
    description='X coordinate in the body frame of the point that offset_point drives; not 0',
    label='Offset d',
    usual=(0.02, 0.4),
)


@dataclass(frozen=True)
class Boundary:
    """A line `kp = ratio kv` in the picture of a sweep of these gains."""

    ratio: float
    """kp on the line divided by kv [-]."""
    beyond: str
    """What happens where kv is larger than on the line."""

    @property
    def equation(self) -> str:
        """The equation of the line, such as `kp = 2 kv`."""
        return 'kp = kv' if self.ratio == 1.0 else f'kp = {self.ratio:g} kv'


def no_advice(gains: GainValues, limits: VelocityLimits) -> Iterable[str]:
    """Return no warnings."""
    return ()


@dataclass(frozen=True, kw_only=True, slots=True)
class ControlLaw(Checked):
    """What controllers of goals and of paths have in common. An invalid field raises ValueError."""

    name: str
    """Name by which it is chosen: a letter, then letters, digits, `_`, `.` or `-`, at most 64."""
    law: Annotated[Law, function]
    """The law, `law(poses, goals, *gains) -> (v, omega)`."""
    summary: str = ''
    """One sentence for help texts."""
    gains: tuple[Gain, ...] = (KP, KV)
    """Gains that are passed to the law, in this order."""
    state: tuple[float, ...] = ()
    """What the law remembers when a goal begins, such as `(0.0,)` for an integral. Such a law is called
    with `state`, shape (..., n), and with the time dt since the call before (s), at first and where the
    clock goes back 0, by keyword.
    It returns `(v, omega, state)`."""
    advice: Annotated[Callable[[GainValues, VelocityLimits], Iterable[str]], function] = no_advice
    """Return warnings about gains or limits that do not suit the law."""

    def __post_init__(self) -> None:
        """Check every field."""
        Checked.__post_init__(self)
        if not _NAME.fullmatch(self.name):
            raise ValueError(
                "name of a controller must be a letter, then letters, digits, '_', '.' or '-', "
                f'at most 64, got {short(repr(self.name))}'
            )
        if not isinstance(self.gains, tuple) or not all(isinstance(one, Gain) for one in self.gains):
            raise ValueError(f'gains must be a tuple of Gain, got {short(self.gains)}')
        names = self.gain_names
        if len(set(names)) < len(names):
            raise ValueError(f'gains must have different names, got {", ".join(names)}')
        object.__setattr__(self, 'state', numbers('state', self.state, np.size(self.state)))

    @property
    def gain_names(self) -> tuple[str, ...]:
        """Names of the gains, in the order of the law."""
        return tuple(gain.name for gain in self.gains)

    @property
    def defaults(self) -> SimpleNamespace:
        """The default value of each gain."""
        return SimpleNamespace(**{gain.name: gain.default for gain in self.gains})

    def values(self, gains: GainValues) -> tuple[float, ...]:
        """Return the values that are passed to the law, in its order."""
        return tuple(getattr(gains, name) for name in self.gain_names)

    def warnings(self, gains: GainValues, limits: VelocityLimits) -> list[str]:
        """Return the warnings about gains or limits; a failure of `advice` is one of them."""
        try:
            return [printable(str(text), LONGEST_TEXT) for text in self.advice(gains, limits)]
        except Exception as error:
            return [f'the advice of controller {self.name!r} failed: {_reason(error)}']

    def _check_gain(self, field: str) -> None:
        """Require a field to be empty or the name of a gain."""
        name, names = getattr(self, field), self.gain_names
        if name not in ('', *names):
            raise ValueError(f"{field} must be '' or one of {', '.join(names)}, got {short(repr(name))}")


@dataclass(frozen=True, kw_only=True, slots=True)
class Controller(ControlLaw):
    """A control law that drives a unicycle to a goal.

    The node go_to_goal, sweeps, their pictures and batches of closed loops read this object. Only `name`
    and `law` are required. An invalid field raises ValueError.
    """

    takes_heading: bool = False
    """Whether the law takes the heading of the goal. The robot then always turns to it at the end."""
    offset: str = ''
    """Name of the gain that is the x coordinate of the driven point in the body frame; empty: the law
    drives the axle centre."""
    slope: Annotated[Callable[[GainValues], float] | None, optional(function)] = None
    """Return the largest slope of the yaw rate over the heading (1/s). The sampling rate limits it."""
    boundary: Boundary | None = None
    """Line that is drawn in the picture of a sweep."""

    def __post_init__(self) -> None:
        """Check every field."""
        ControlLaw.__post_init__(self)
        self._check_gain('offset')

    def bind(self, gains: GainValues) -> BoundLaw:
        """Return the law with its gains, for single poses."""
        return BoundLaw(self, self.values(gains), 3 if self.takes_heading else 2)

    def driven_offset(self, gains: GainValues) -> float:
        """Return the x coordinate of the driven point in the body frame (m)."""
        return float(getattr(gains, self.offset)) if self.offset else 0.0

    def rate_warnings(self, gains: GainValues, rate: float, *, turns: bool) -> list[str]:
        """Return the warnings about gains that are too large for the rate of the odometry.

        A law whose yaw rate has the slope K over the heading multiplies an error of the heading by `1 -
        K / rate` from one sample to the next. So the robot arrives with a slope below twice the rate of
        the odometry (Hz), and if its commands take effect up to one sample late, below the rate.
        `turns`: whether the robot turns in place at the end, with the gain kp.
        """
        try:
            slope = 0.0 if self.slope is None else float(self.slope(gains))
            slope = max(slope, gains.kp if turns else 0.0)
        except Exception as error:
            return [f'the slope of controller {self.name!r} failed: {_reason(error)}']
        if slope < rate:
            return []
        return [
            f'the law turns by up to {slope:.3g} rad/s per rad of heading, which is not below the '
            f'odometry rate of {rate:.3g} Hz: if commands take effect up to one sample late, the robot '
            'may never arrive; choose a smaller kp or kv, or a higher rate'
        ]


@dataclass(frozen=True, kw_only=True, slots=True)
class PathController(ControlLaw):
    """A control law that drives a unicycle along a path: `law(poses, references, *gains)`.

    A reference is a `path.Reference`, shape (..., 8): where the robot should be, and how it should move
    there. Otherwise the law is as that of a `Controller`.
    """

    lookahead: str = ''
    """Name of the gain that is the look-ahead distance (m): the reference is the first point of the path
    that is so far from the robot. Empty: it is the nearest point, and of a trajectory that of the
    time."""

    def __post_init__(self) -> None:
        """Check every field."""
        ControlLaw.__post_init__(self)
        self._check_gain('lookahead')

    def bind(self, gains: GainValues) -> BoundLaw:
        """Return the law with its gains, for single poses."""
        lookahead = float(getattr(gains, self.lookahead)) if self.lookahead else 0.0
        return BoundLaw(self, self.values(gains), len(Reference._fields), lookahead)


class BoundLaw:
    """A law with its gains, for single poses, and what it remembers.

    It is called with a pose, shape (3,), and a goal, shape (3,), or a reference, shape (8,), and returns
    `(v, omega)`. It raises LawError if the law fails or returns something else.
    """

    def __init__(
        self, controller: ControlLaw, values: tuple[float, ...], size: int, lookahead: float = 0.0
    ) -> None:
        """Take the gains in the order of the law, and the number of entries of its goals."""
        self.controller = controller
        self.lookahead = lookahead
        """Look-ahead distance (m); 0: the law has none."""
        self._values = values
        self._size = size
        # An equation takes any numbers, which were checked before; another law may index arrays.
        self._is_equation = hasattr(controller.law, 'floats')
        self.now = 0
        """Time of the next pose (ns). Needed by laws with a state."""
        self._before: int | None = None
        self._state = controller.state

    def reset(self) -> None:
        """Begin a new goal."""
        self._before, self._state = None, self.controller.state

    def continue_from(self, other: BoundLaw) -> None:
        """Remember what the same law with other gains does."""
        if other.controller == self.controller:
            self.now, self._before, self._state = other.now, other._before, other._state

    def __call__(self, pose: Any, goal: Any) -> tuple[float, float]:
        """Return the twist."""
        controller, goal, state = self.controller, goal[: self._size], self._state
        more: dict[str, Any] = {}
        if state:
            # The clock may go back.
            dt = 0.0 if self._before is None else max(0, self.now - self._before) / NANOSECONDS
            more = {'state': list(state) if self._is_equation else np.array(state), 'dt': dt}
        try:
            if self._is_equation:
                found = controller.law.floats(pose, goal, *self._values, **more)  # type: ignore[attr-defined]
            else:
                found = controller.law(np.asarray(pose), np.asarray(goal), *self._values, **more)
        except Exception as error:
            raise LawError(
                f'the law of controller {controller.name!r} failed: {_reason(error)}'
            ) from error
        try:
            if state:
                v, omega, after = found
                state = tuple(map(_number, after))
                if len(state) != len(self._state):
                    raise ValueError(f'{len(state)} entries')
            else:
                v, omega = found
            if not (type(v) is type(omega) is float and isfinite(v) and isfinite(omega)):
                v, omega = _number(v), _number(omega)
        except Exception as error:
            also = f', and the state, shape ({len(self._state)},)' if self._state else ''
            raise LawError(
                f'the law of controller {controller.name!r} must return (v, omega), two finite '
                f'numbers{also}, got {short(found)}'
            ) from error
        self._before, self._state = self.now, state
        return v, omega


def _number(value: Any) -> float:
    """Return what a law returns as a float: a finite number of any kind, also of other libraries."""
    if isinstance(value, str) or np.shape(value) or not isfinite(value):
        raise ValueError('not a finite number')
    return float(value)


def _reason(error: Exception) -> str:
    """Return kind, message and place of an exception in one line."""
    text = printable(traceback.format_exception_only(type(error), error)[-1].strip(), LONGEST_TEXT)
    *_, last = traceback.extract_tb(error.__traceback__)
    return f'{text} ({Path(last.filename).name}, line {last.lineno})'
