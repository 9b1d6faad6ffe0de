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
from math import isfinite
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_jacobian.control.sampling import rate_warning
from diffdrive_jacobian.kinematics.saturation import VelocityLimits
from diffdrive_jacobian.numerics.checks import boolean, function, instance, number, positive, short

Law = Callable[..., tuple[Any, Any]]
"""`law(poses, goals, *gains) -> (v, omega)`, as described above."""
BoundLaw = Callable[[ArrayLike, ArrayLike], tuple[float, float]]
"""A law with its gains: one pose, shape (3,), and one goal, shape (3,), to `(v, omega)`."""
GAINS = ('kp', 'kv', 'offset')
"""Parameters that a law can take."""
_NAME = re.compile(r'[A-Za-z][A-Za-z0-9_.-]{0,63}')


class GainValues(Protocol):
    """Values of the gains, such as the parameters of the node go_to_goal."""

    @property
    def kp(self) -> float:
        """Gain on the heading error (1/s)."""

    @property
    def kv(self) -> float:
        """Gain on the distance (1/s)."""

    @property
    def offset(self) -> float:
        """X coordinate of the driven point in the body frame (m)."""


class LawError(ValueError):
    """A law raised an exception or returned something other than two finite numbers."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Boundary:
    """A straight line `kp = ratio * kv` in the plane of gains.

    Raises:
        ValueError: The ratio is not positive and finite, or `beyond` is not a string.
    """

    ratio: float
    """Positive, kp on the line divided by kv [-]."""
    beyond: str
    """What happens where kv is larger than on the line."""

    def __post_init__(self) -> None:
        """Check every value."""
        object.__setattr__(self, 'ratio', number('ratio', self.ratio, positive))
        instance('beyond', self.beyond, str)

    @property
    def equation(self) -> str:
        """The equation of the line, such as `kp = 2 kv`."""
        return 'kp = kv' if self.ratio == 1.0 else f'kp = {self.ratio:g} kv'


@dataclass(frozen=True, kw_only=True, slots=True)
class ReferenceGains:
    """A pair of gains that is marked in the picture of a sweep.

    Raises:
        ValueError: A gain is not positive and finite, or `source` is not a string.
    """

    kp: float
    """Gain on the heading error (1/s)."""
    kv: float
    """Gain on the distance (1/s)."""
    source: str
    """Where they come from."""

    def __post_init__(self) -> None:
        """Check every value."""
        for name in ('kp', 'kv'):
            object.__setattr__(self, name, number(name, getattr(self, name), positive))
        instance('source', self.source, str)


def no_advice(gains: GainValues, limits: VelocityLimits) -> Iterable[str]:
    """Return no warnings."""
    return ()


@dataclass(frozen=True, kw_only=True, slots=True)
class Controller:
    """A control law that drives a unicycle to a goal.

    The node go_to_goal, sweeps, their pictures and batches of closed loops read this object. Only `name`
    and `law` are required.

    Raises:
        ValueError: A field is invalid.
    """

    name: str
    """Name by which it is chosen: a letter, then letters, digits, `_`, `.` or `-`, at most 64."""
    law: Law
    """The law, `law(poses, goals, *gains) -> (v, omega)`."""
    summary: str = ''
    """One sentence for help texts."""
    gains: tuple[str, ...] = ('kp', 'kv')
    """Parameters that are passed to the law, in this order; of `kp`, `kv` and `offset`."""
    takes_heading: bool = False
    """Whether the law takes the heading of the goal. The robot then always turns to it at the end."""
    offset: str = ''
    """Parameter that holds the x coordinate of the driven point in the body frame, `offset`; empty: the
    law drives the axle centre."""
    advice: Callable[[GainValues, VelocityLimits], Iterable[str]] = no_advice
    """Return warnings about gains or limits that do not suit the law."""
    slope: Callable[[GainValues], float] | None = None
    """Return the largest slope of the yaw rate over the heading (1/s). The sampling rate limits it."""
    boundary: Boundary | None = None
    """Line that is drawn in the picture of a sweep."""
    reference_gains: ReferenceGains | None = None
    """Gains that are marked in the picture of a sweep."""

    def __post_init__(self) -> None:
        """Check every field."""
        if not isinstance(self.name, str) or not _NAME.fullmatch(self.name):
            raise ValueError(
                "name of a controller must be a letter, then letters, digits, '_', '.' or '-', "
                f'at most 64, got {short(repr(self.name))}'
            )
        function('law', self.law)
        function('advice', self.advice)
        if self.slope is not None:
            function('slope', self.slope)
        instance('summary', self.summary, str)
        boolean('takes_heading', self.takes_heading)
        if not isinstance(self.gains, tuple) or not all(gain in GAINS for gain in self.gains):
            raise ValueError(f'gains must be a tuple of {", ".join(GAINS)}, got {short(self.gains)}')
        if self.offset not in ('', 'offset'):
            raise ValueError(f"offset must be 'offset' or '', got {short(repr(self.offset))}")
        for name, kind in (('boundary', Boundary), ('reference_gains', ReferenceGains)):
            if getattr(self, name) is not None:
                instance(name, getattr(self, name), kind)

    def values(self, gains: GainValues) -> tuple[float, ...]:
        """Return the values that are passed to the law, in its order."""
        return tuple(getattr(gains, name) for name in self.gains)

    def driven_offset(self, gains: GainValues) -> float:
        """Return the x coordinate of the driven point in the body frame (m)."""
        return float(getattr(gains, self.offset)) if self.offset else 0.0

    def warnings(self, gains: GainValues, limits: VelocityLimits) -> list[str]:
        """Return the warnings about gains or limits; a failure of `advice` is one of them."""
        try:
            return [str(text) for text in self.advice(gains, limits)]
        except Exception as error:
            return [f'the advice of controller {self.name!r} failed: {_reason(error)}']

    def rate_warnings(self, gains: GainValues, rate: float, *, turns: bool) -> list[str]:
        """Return the warnings about gains that are too large for the rate of the odometry.

        Args:
            gains: The gains.
            rate: Rate of the odometry, at which the law is evaluated (Hz).
            turns: Whether the robot turns in place at the end, with the gain kp.
        """
        try:
            slope = 0.0 if self.slope is None else float(self.slope(gains))
            warning = rate_warning(max(slope, gains.kp if turns else 0.0), rate)
        except Exception as error:
            warning = f'the slope of controller {self.name!r} failed: {_reason(error)}'
        return [warning] if warning else []

    def bind(self, gains: GainValues) -> BoundLaw:
        """Return the law with its gains, for single poses.

        Args:
            gains: The gains, such as the parameters of go_to_goal.

        Returns:
            A function of a pose, shape (3,), and a goal, shape (3,), that returns `(v, omega)`. They
            are arrays or tuples of floats. It raises LawError if the law raises an exception or does
            not return two finite numbers.
        """
        # An equation is given floats that are checked already; another law may index arrays.
        equation = getattr(self.law, 'formula', None)
        values, size = self.values(gains), 3 if self.takes_heading else 2

        def bound(pose: Any, goal: Any) -> tuple[float, float]:
            try:
                if equation is None:
                    twist = self.law(np.asarray(pose), np.asarray(goal[:size]), *values)
                else:
                    twist = equation(pose, np.asarray(goal)[:size].tolist(), *values)
            except Exception as error:
                raise LawError(
                    f'the law of controller {self.name!r} failed: {_reason(error)}'
                ) from error
            try:
                v, omega = map(_number, twist)
            except (TypeError, ValueError) as error:
                raise LawError(
                    f'the law of controller {self.name!r} must return (v, omega), two numbers, '
                    f'got {short(twist)}'
                ) from error
            if not (isfinite(v) and isfinite(omega)):
                raise LawError(
                    f'the law of controller {self.name!r} must return finite (v, omega), '
                    f'got ({v:g}, {omega:g})'
                )
            return v, omega

        return bound


def _number(value: Any) -> float:
    if type(value) is float:
        return value
    if np.shape(value) != ():
        raise ValueError('an array')
    return float(value)


def _reason(error: Exception) -> str:
    """Return kind, message and place of an exception in one line."""
    text = traceback.format_exception_only(type(error), error)[-1].strip()
    *_, last = traceback.extract_tb(error.__traceback__)
    return f'{text} ({Path(last.filename).name}, line {last.lineno})'
