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

"""Rollouts: closed loops of many robots, which are advanced together as arrays of their coordinates."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import InitVar, dataclass, field
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.control.controller import Controller
from diffdrive_jacobian.control.controllers import ControllerError, find_controller
from diffdrive_jacobian.control.goal_laws import LARGEST_TURN, by_shorter_turn
from diffdrive_jacobian.control.waypoints import Arrival, distance_to_goal
from diffdrive_jacobian.kinematics.diff_drive import body_to_wheel
from diffdrive_jacobian.kinematics.saturation import VelocityLimits, scaled_to_limits
from diffdrive_jacobian.kinematics.se2 import compose, integrate
from diffdrive_jacobian.numerics.checks import (
    Checked,
    Positive,
    array,
    floats,
    function,
    instance,
    leading,
    positive,
)
from diffdrive_jacobian.numerics.elementary import dot, hypot, wrap
from diffdrive_jacobian.simulation.actuators import IDEAL, Actuators
from diffdrive_jacobian.simulation.batch_actuators import Follower

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]

MAX_STEPS = 1e12
"""Largest number of samples of a loop."""
LOST = 1e6
"""A robot is given up when its distance to the goal has grown by this much (m)."""
NO_LIMITS = VelocityLimits()
SHRINK = 0.94
"""When less than this share of the robots still drives, the others are removed from the arrays [-]."""


class Outcomes(NamedTuple):
    """Outcome of each robot; every field has the shape of the batch.

    Attributes:
        arrived: Whether it arrived in time.
        time: Time of arrival; NaN: it did not arrive (s). Robots that take time to stop roll on.
        path_length: Length of the path of the axle centre, forwards and backwards (m).
        control_cost: Integral of the squares of both wheel speeds over time (rad^2/s).
        overshoot: Largest distance beyond the goal, along the line from start to goal (m).
        pose: Last pose, shape (..., 3): at rest if it arrived, or where the duration ended before that.
    """

    arrived: Mask
    time: Array
    path_length: Array
    control_cost: Array
    overshoot: Array
    pose: Array


def _controller(name: str, value: Any) -> Controller:
    """Return the controller that is given, or named, or that of a law."""
    if isinstance(value, str):
        try:
            return find_controller(value)
        except ControllerError as error:
            raise ValueError(f'{name}: {error}') from None
    if isinstance(value, Controller):
        return value
    law = function(name, value, 'a function, a Controller, or the name of one')
    return Controller(name='law', law=law, gains=())


def _actuators(name: str, value: Any) -> Actuators:
    """Require actuators whose motors are fast enough."""
    actuators: Actuators = instance(name, value, Actuators)
    if actuators.weak:
        raise ValueError(
            f'{name} must have no max_right_speed or max_left_speed: in batches no motor saturates'
        )
    return actuators


class Columns(NamedTuple):
    """What may differ between robots: arrays with the robots in the last axis, or numbers for all."""

    starts: Array
    """Shape (3, n)."""
    goals: Array
    """Shape (2, n) or (3, n)."""
    gains: tuple[Any, ...]
    turning_gain: Any
    offset: Any
    """Of the point that is to arrive."""
    limits: tuple[Any, ...]
    """In the order of `VelocityLimits.all`."""
    r: Any
    L: Any

    def some(self, rows: Any) -> Columns:
        """Return those of some of the robots, each coordinate contiguous in memory."""

        def of(value: Any) -> Any:
            if isinstance(value, tuple):
                return tuple(map(of, value))
            return value if isinstance(value, float) else value[..., rows].copy()

        return Columns._make(map(of, self))


@dataclass(frozen=True, kw_only=True, eq=False)
class Loops(Checked):
    """The arguments of `closed_loops`, checked."""

    law: Annotated[Controller, _controller]
    starts: InitVar[Any]
    goals: InitVar[Any]
    gains: InitVar[tuple[Any, ...]]
    rate: Positive = 50.0
    duration: Positive = 60.0
    arrival: Arrival | None = None
    turning_gain: InitVar[Any] = 3.0
    limits: VelocityLimits = NO_LIMITS
    r: InitVar[Any] = 0.033
    L: InitVar[Any] = 0.16
    actuators: Annotated[Actuators, _actuators] = IDEAL
    criterion: Arrival = field(init=False)
    """When a robot has arrived, but for the offset."""
    shape: tuple[int, ...] = field(init=False)
    """Shape of the batch."""
    columns: Columns = field(init=False)
    """What may differ between robots, with the robots of the batch in one axis."""

    def __post_init__(
        self, starts: Any, goals: Any, gains: tuple[Any, ...], turning_gain: Any, r: Any, L: Any
    ) -> None:
        """Check every value."""
        super().__post_init__()
        starts, goals = array('starts', starts, 3), array('goals', goals, 'm')
        gains = gains or tuple(gain.default for gain in self.law.gains)
        arrival = self._arrival(gains)
        size = goals.shape[-1]
        if size not in (2, 3) or (arrival.use_heading and size != 3):
            wanted = '(..., 3)' if arrival.use_heading else '(..., 2) or (..., 3)'
            raise ValueError(f'goals must have shape {wanted}, got {goals.shape}')
        if not self.duration * self.rate < MAX_STEPS:
            raise ValueError(
                f'duration must be below {MAX_STEPS / self.rate:g} s at that rate, got {self.duration:g}'
            )
        named = {
            **{f'gain {index}': array(f'gain {index}', one) for index, one in enumerate(gains)},
            'turning_gain': array('turning_gain', turning_gain),
            'offset': floats('offset', arrival.offset),
            **{
                name: floats(name, limit)
                for name, limit in zip(self.limits.names(), self.limits.all(), strict=True)
            },
            'r': positive('r', floats('r', r)),
            'L': positive('L', floats('L', L)),
        }
        shapes = {name: value.shape for name, value in named.items()}
        shape = leading(starts=starts.shape[:-1], goals=goals.shape[:-1], **shapes)
        flat = [
            np.broadcast_to(value, shape).reshape(-1) if value.ndim else float(value)
            for value in named.values()
        ]
        *of_law, turning_gain, offset, min_v, max_v, min_omega, max_omega, wheels, r, L = flat
        columns = Columns(
            starts=np.broadcast_to(starts, (*shape, 3)).reshape(-1, 3).T,
            goals=np.broadcast_to(goals, (*shape, size)).reshape(-1, size).T,
            gains=tuple(of_law),
            turning_gain=turning_gain,
            offset=offset,
            limits=(min_v, max_v, min_omega, max_omega, wheels),
            r=r,
            L=L,
        )
        for name, value in (('shape', shape), ('columns', columns), ('criterion', arrival)):
            object.__setattr__(self, name, value)

    def _arrival(self, gains: tuple[Any, ...]) -> Arrival:
        """Return the arrival criterion; where none is given that which suits the controller."""
        if self.arrival is not None:
            return self.arrival
        names, offset = self.law.gain_names, 0.0
        if self.law.offset and len(gains) == len(names):
            offset = gains[names.index(self.law.offset)]
        return Arrival(use_heading=self.law.takes_heading, offset=offset)

    @property
    def steps(self) -> int:
        """Number of samples after the first."""
        return math.ceil(self.duration * self.rate - 1e-9)


Keep = Callable[[int, Rows, Array, Any, Any], None]
"""Receives step, rows, poses (k, 3), v (k,) and omega (k,); the last two are None at the end."""


@dataclass
class Robots:
    """The robots that still drive: what is known of each, in arrays whose last axis is the robots."""

    rows: Rows
    """Their indices in the batch."""
    pose: Array
    """`[x, y, theta]`, shape (3, n)."""
    twist: Array
    """v and omega of the odometry, shape (2, n)."""
    memory: Array
    """What the law remembers, shape (m, n)."""
    open: Mask
    """Which are not finished."""
    turning: Mask
    """Which turn in place at their goals."""
    stopping: Mask
    """Which stop at their goals before they may count as arrived."""
    time: Array
    """Times of arrival; NaN before (s)."""
    sums: Array
    """Sums of |v|, v^2 and omega^2 over the samples, shape (3, n)."""
    beyond: Array
    """Largest distance beyond the goal (m)."""
    along: Array
    """Unit vectors from start to goal, shape (2, n)."""
    too_far: Array
    """Distance from the goal at which a robot is given up (m)."""

    @classmethod
    def at_starts(cls, rows: Rows, columns: Columns, memory: tuple[float, ...]) -> Robots:
        """Return robots at rest at their starts, with what a law remembers then."""
        count, starts = len(rows), columns.starts
        with np.errstate(over='ignore', invalid='ignore'):
            line = columns.goals[:2] - starts[:2]
            length = hypot(*line)
            along = line / np.where(length > 0.0, length, 1.0)
        return cls(
            rows=rows,
            pose=np.array([*starts[:2], wrap(starts[2])]),
            twist=np.zeros((2, count)),
            memory=np.repeat(np.array(memory)[:, np.newaxis], count, axis=1),
            open=np.ones(count, dtype=np.bool_),
            turning=np.zeros(count, dtype=np.bool_),
            stopping=np.zeros(count, dtype=np.bool_),
            time=np.full(count, np.nan),
            sums=np.zeros((3, count)),
            beyond=np.zeros(count),
            along=along,
            too_far=length + LOST,
        )

    def some(self, rows: Rows) -> Robots:
        """Return some of the robots."""
        return Robots(**{name: values[..., rows] for name, values in vars(self).items()})


class Rollout:
    """Some of the loops of a batch, advanced from sample to sample."""

    def __init__(self, loops: Loops, rows: Rows) -> None:
        """Place the robots of these rows of the batch at their starts."""
        self.loops, self.columns = loops, loops.columns.some(rows)
        self.robots = Robots.at_starts(rows, self.columns, loops.law.state)
        self.follower: Follower | None = None
        if not loops.actuators.immediate:
            self.follower = Follower(loops.actuators, len(rows), loops.rate, loops.steps)

    def drive(
        self, keep: Keep | None, on_step: Callable[[], object] | None = None
    ) -> Iterator[tuple[Rows, Outcomes]]:
        """Drive the robots until each has arrived or is given up; yield finished rows and outcomes.

        `keep` is called with every sample of every robot, `on_step` at the beginning of every step.
        """
        loops = self.loops
        for step in range(loops.steps + 1):
            if on_step is not None:
                on_step()
            robots = self.robots
            arrived, lost = self._check_ends()
            if arrived.any():
                robots.time = np.where(arrived & np.isnan(robots.time), step / loops.rate, robots.time)
            if self.follower is not None:
                arrived = np.isfinite(robots.time) & self.follower.at_rest()
            ended = (arrived | lost) & robots.open if step < loops.steps else robots.open
            if ended.any():
                yield self._outcomes(ended)
                robots.open = robots.open & ~ended
            left = np.count_nonzero(robots.open)
            if keep is not None:
                keep(step, robots.rows[ended], robots.pose[:, ended].T, None, None)
            if not left:
                return
            v, omega = self._command(step)
            if keep is not None:
                going = robots.open
                keep(step, robots.rows[going], robots.pose[:, going].T, v[going], omega[going])
            if left < SHRINK * len(robots.rows):
                still = np.flatnonzero(robots.open)
                self.columns, self.robots = self.columns.some(still), robots.some(still)
                v, omega = v[still], omega[still]
                if self.follower is not None:
                    self.follower.shrink(still)
            # Overflow is detected in the outcomes.
            with np.errstate(over='ignore', invalid='ignore'):
                self._advance(v, omega)

    def _check_ends(self) -> tuple[Mask, Mask]:
        """Return which robots have arrived, and which were driven away by their law."""
        robots, arrival = self.robots, self.loops.criterion
        goal, offset = self.columns.goals, self.columns.offset
        x, y, theta = robots.pose
        with np.errstate(over='ignore', invalid='ignore'):
            dx, dy = goal[0] - x, goal[1] - y
            robots.beyond = np.maximum(robots.beyond, -dot(robots.along, (dx, dy)))
            distance = hypot(dx, dy)
            if np.any(offset):
                distance = distance_to_goal.formula(x, y, theta, *goal[:2], offset)
        near = distance <= arrival.xy_tolerance
        heading = goal[2] if arrival.use_heading else 0.0
        robots.turning, turns, arrived = arrival.progress(
            near, robots.turning, robots.twist, theta, heading
        )
        robots.stopping = (near | robots.turning) & ~turns & ~arrived
        return arrived, distance > robots.too_far

    def _command(self, step: int) -> tuple[Array, Array]:
        """Evaluate the law, and limit its twists."""
        loops, columns, robots = self.loops, self.columns, self.robots
        (count,) = robots.rows.shape
        twist, memory = self._evaluate(step), len(robots.memory)
        try:
            if memory:
                *twist, state = twist
                robots.memory = np.broadcast_to(floats('law', state), (count, memory)).T
            v, omega = (np.broadcast_to(floats('law', part), count) for part in twist)
        except (TypeError, ValueError) as error:
            state_too = f' and the state of shape {(count, memory)}' if memory else ''
            raise ValueError(
                f'law must return (v, omega), each of shape () or {(count,)}{state_too}, '
                f'got {twist!r:.80}'
            ) from error
        if robots.turning.any():
            turn = wrap(columns.goals[2] - robots.pose[2])
            v = np.where(robots.turning, 0.0, v)
            omega = np.where(robots.turning, columns.turning_gain * turn, omega)
        driven = robots.open & np.isnan(robots.time) & ~robots.stopping
        if not driven.all():
            # Finished robots stand still, whatever their law returns.
            v, omega = np.where(driven, v, 0.0), np.where(driven, omega, 0.0)
        finite = np.isfinite(v) & np.isfinite(omega)
        if not finite.all():
            row = int(np.argmin(finite))
            raise ValueError(
                f'law must return finite (v, omega), got ({v[row]}, {omega[row]}) '
                f'at pose {robots.pose[:, row].tolist()}'
            )
        v, omega = self._limited(v, omega)
        if np.abs(omega).max() > LARGEST_TURN * loops.rate:
            # The other direction may be forbidden.
            v, omega = self._limited(v, by_shorter_turn(omega, loops.rate))
        return v, omega

    def _evaluate(self, step: int) -> Any:
        """Return what the law returns: an equation of components, or a function of arrays of poses."""
        loops, columns, robots = self.loops, self.columns, self.robots
        law, more = loops.law.law, dict[str, Any]()
        equation = getattr(law, 'formula', None)
        if len(robots.memory):
            more = {'state': list(robots.memory) if equation else np.array(robots.memory.T)}
            more['dt'] = 1.0 / loops.rate if step else 0.0
        try:
            if equation is None:
                # A copy, which the law may keep or change.
                return law(np.array(robots.pose).T, columns.goals.T, *columns.gains, **more)
            found = equation(robots.pose, columns.goals, *columns.gains, **more)
        except Exception as error:
            raise ValueError(
                f'the law of controller {loops.law.name!r} must accept poses of shape '
                f'{robots.pose.T.shape}, but failed: {type(error).__name__}: {error}'
            ) from error
        if not more:
            return found
        v, omega, state = found
        return v, omega, np.array(np.broadcast_arrays(robots.pose[0], *state)[1:]).T

    def _limited(self, v: Array, omega: Array) -> tuple[Array, Array]:
        """Scale twists to the velocity limits."""
        if self.loops.limits.unlimited:
            return v, omega
        with np.errstate(all='ignore'):
            limited: tuple[Array, Array] = scaled_to_limits.formula(
                v, omega, *self.columns.limits, self.columns.r, self.columns.L
            )
        return limited

    def _advance(self, v: Array, omega: Array) -> None:
        """Apply a constant twist until the next sample, or let robots that take time follow it."""
        loops, robots = self.loops, self.robots
        if self.follower is None:
            robots.twist = np.array([v, omega])
            robots.sums += np.abs(v), v * v, omega * omega
            robots.pose = np.array(integrate.formula(robots.pose, (v, omega), 1.0 / loops.rate))
            return

        def wheel_speeds(v: Array, omega: Array) -> Any:
            return body_to_wheel.formula(v, omega, self.columns.r, self.columns.L)

        for rows, displacement, sums in self.follower.advance(wheel_speeds, np.array([v, omega])):
            robots.pose[:, rows] = compose.formula(robots.pose[:, rows], displacement)
            robots.sums[:, rows] += sums * loops.rate
        robots.twist = self.follower.twist

    def _outcomes(self, done: Mask) -> tuple[Rows, Outcomes]:
        """Return the rows and the outcomes of the robots that are finished."""
        columns, robots = self.columns.some(done), self.robots.some(np.flatnonzero(done))
        with np.errstate(all='ignore'):
            path, squares_v, squares_omega = robots.sums / self.loops.rate
            # Both wheels: (v + omega L/2)^2 + (v - omega L/2)^2, over r^2.
            r, L = np.asarray(columns.r), np.asarray(columns.L)
            control_cost = 2.0 * (squares_v + squares_omega * (L / 2.0) ** 2) / r**2
        arrived = np.isfinite(robots.time)
        outcomes = Outcomes(arrived, robots.time, path, control_cost, robots.beyond, robots.pose.T)
        if not all(np.isfinite(values).all() for values in outcomes[2:]):
            raise ValueError(
                'starts, goals, gains, rate, limits, r and L must give finite outcomes, '
                'but they overflow'
            )
        return robots.rows, outcomes
