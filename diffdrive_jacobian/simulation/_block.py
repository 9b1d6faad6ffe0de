"""Robots of a batch that are advanced together, each coordinate contiguous in memory.

Cosine and sine of the heading take longer to compute than the rest of an arc. They are updated by
rotation in every step, and computed exactly every few steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.control.controller import Controller, Law
from diffdrive_jacobian.control.controllers import ControllerError, find_controller
from diffdrive_jacobian.control.goal_laws import LARGEST_TURN, without_whole_turns
from diffdrive_jacobian.control.waypoints import Arrival
from diffdrive_jacobian.kinematics.saturation import VelocityLimits, scaled_to_limits
from diffdrive_jacobian.numerics.checks import (
    array,
    floats,
    function,
    instance,
    leading,
    number,
    optional,
    positive,
)
from diffdrive_jacobian.numerics.elementary import wrap
from diffdrive_jacobian.simulation._following import Follower
from diffdrive_jacobian.simulation.actuators import Actuators

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]
MAX_STEPS = 1e12
"""Largest number of samples of a loop."""


class Outcomes(NamedTuple):
    """Outcome of each robot; every field has the shape of the batch.

    Attributes:
        arrived: Whether it arrived in time.
        time: Time of arrival; NaN: it did not arrive (s). Robots that take time to stop roll on.
        path_length: Length of the path of the axle centre, forwards and backwards (m).
        control_cost: Integral of the squares of both wheel speeds over time (rad^2/s).
        overshoot: Largest distance beyond the goal, along the line from start to goal (m).
        pose: Last pose, at rest if it arrived, shape (..., 3).
    """

    arrived: Mask
    time: Array
    path_length: Array
    control_cost: Array
    overshoot: Array
    pose: Array


class Batch:
    """The checked arguments. Those equal for all robots are numbers, others have an axis of robots."""

    def __init__(
        self,
        law: Law | Controller | str,
        starts: ArrayLike,
        goals: ArrayLike,
        gains: tuple[ArrayLike, ...],
        rate: float,
        duration: float,
        arrival: Arrival | None,
        turning_gain: ArrayLike,
        limits: VelocityLimits,
        r: ArrayLike,
        L: ArrayLike,
        actuators: Actuators | None,
    ) -> None:
        # What the law remembers at the start.
        self.state: tuple[float, ...] = ()
        if isinstance(law, str):
            try:
                law = find_controller(law)
            except ControllerError as error:
                raise ValueError(f'law: {error}') from None
        if isinstance(law, Controller):
            self.state, law = law.state, law.law
        self.law: Law = function('law', law, 'a function, a Controller, or the name of one')
        # The law of components without checks, where it is a `formula`.
        self.equation: Law | None = getattr(law, 'formula', None)
        self.arrival: Arrival = instance('arrival', Arrival() if arrival is None else arrival, Arrival)
        self.limits: VelocityLimits = instance('limits', limits, VelocityLimits)
        self.actuators = _checked(actuators)
        starts, goals = array('starts', starts, 3), array('goals', goals, 'm')
        size = goals.shape[-1]
        if size not in (2, 3) or (self.arrival.use_heading and size != 3):
            wanted = '(..., 3)' if self.arrival.use_heading else '(..., 2) or (..., 3)'
            raise ValueError(f'goals must have shape {wanted}, got {goals.shape}')
        self.rate = rate = number('rate', rate, positive)
        duration = number('duration', duration, positive)
        if not duration * rate < MAX_STEPS:
            raise ValueError(
                f'duration must be below {MAX_STEPS / rate:g} s at that rate, got {duration:g}'
            )
        self.steps = math.ceil(duration * rate - 1e-9)
        columns = {f'gain {index}': array(f'gain {index}', gain) for index, gain in enumerate(gains)}
        columns['turning_gain'] = array('turning_gain', turning_gain)
        columns['offset'] = floats('offset', self.arrival.offset)
        for name, value in (('r', r), ('L', L)):
            columns[name] = floats(name, value)
            positive(name, columns[name])
        for name, limit in zip(limits.names(), limits.all(), strict=True):
            columns[name] = floats('limits', limit)
        # Of the batch before it was flattened.
        self.shape = shape = leading(
            starts=starts.shape[:-1],
            goals=goals.shape[:-1],
            **{name: value.shape for name, value in columns.items()},
        )
        self.starts: Array = np.broadcast_to(starts, (*shape, 3)).reshape(-1, 3)
        self.goals: Array = np.broadcast_to(goals, (*shape, size)).reshape(-1, size)
        self._take(
            {
                name: float(value) if value.ndim == 0 else np.broadcast_to(value, shape).reshape(-1)
                for name, value in columns.items()
            }
        )

    def _take(self, columns: dict[str, Any]) -> None:
        """Set the values that may differ between robots."""
        self._columns = columns
        self.gains = [value for name, value in columns.items() if name.startswith('gain ')]
        self.turning_gain, self.r, self.L = (columns[name] for name in ('turning_gain', 'r', 'L'))
        self.arrival = replace(self.arrival, offset=columns['offset'])
        self.limits = VelocityLimits(**{name: columns[name] for name in self.limits.names()})

    def some(self, rows: Any) -> Batch:
        """Return the batch of some of the robots, each coordinate contiguous in memory."""
        batch = copy(self)
        batch.starts, batch.goals = (np.array(one[rows].T).T for one in (self.starts, self.goals))
        batch._take(
            {
                name: value if isinstance(value, float) else value[rows]
                for name, value in self._columns.items()
            }
        )
        return batch


def _checked(actuators: Actuators | None) -> Actuators | None:
    """Require actuators whose motors are fast enough; None: commands are followed at once."""
    optional(partial(instance, wanted=Actuators))('actuators', actuators)
    if actuators is None:
        return None
    if min(actuators.max_right_speed, actuators.max_left_speed) < math.inf:
        raise ValueError(
            'actuators must have no max_right_speed or max_left_speed: in batches no motor saturates'
        )
    return None if actuators.immediate else actuators


LOST = 1e6
"""A robot is given up when its distance to the goal has grown by this much (m)."""
EXACT_PERIOD = 32
"""Number of steps after which cosine and sine of the heading are computed exactly."""
SHRINK = 0.94
"""When less than this share of the robots still drives, the others are removed from the arrays [-]."""

_OF_ROBOTS = 'x', 'y', 'theta', 'c', 's', 'turning', 'stopping', 'open', 'time', 'beyond', 'too_far'
"""Attributes of a block with one value for each robot."""

Keep = Callable[[int, Rows, Array, Any, Any], None]
"""Receives step, rows, poses (k, 3), v (k,) and omega (k,); the last two are None at the end."""


class Block:
    """Some robots of a batch and their current states."""

    def __init__(self, batch: Batch, rows: Rows) -> None:
        """Place the robots of a batch at their starts. `rows` are their indices in the whole one."""
        self.batch, self.rows, count = batch, rows, len(rows)
        self.x, self.y, theta = batch.starts.T.copy()
        self.theta: Array = wrap(theta)
        self.open: Mask = np.ones(count, dtype=np.bool_)
        self.turning: Mask = np.zeros(count, dtype=np.bool_)
        # One array for each number that the law remembers.
        self.state: list[Array] = [np.full(count, value) for value in batch.state]
        self.dt = 0.0
        self.follower: Follower | None = None
        if batch.actuators is not None:
            self.follower = Follower(batch.actuators, count, batch.rate)
        # v and omega of the odometry.
        self.twist: tuple[Array, ...] = (np.zeros(count), np.zeros(count))
        # Times of arrival, and which robots stop at their goals before they may count as arrived.
        self.time: Array = np.full(count, np.nan)
        self.stopping: Mask = np.zeros(count, dtype=np.bool_)
        # Integrals of |v|, v^2 and omega^2, and the largest distance beyond the goal.
        self.sums: Array = np.zeros((3, count))
        self.beyond: Array = np.zeros(count)
        with np.errstate(over='ignore', invalid='ignore'):
            line = batch.goals[:, :2] - batch.starts[:, :2]
            length = np.hypot(*line.T)
            self.along: Array = np.array((line / np.where(length > 0.0, length, 1.0)[:, np.newaxis]).T)
            self.too_far: Array = (length + LOST) ** 2

    def drive(
        self, keep: Keep | None, on_step: Callable[[], object] | None = None
    ) -> Iterator[tuple[Rows, Outcomes]]:
        """Drive the robots until each has arrived or is given up; yield finished rows and outcomes.

        `keep` is called with every sample of every robot, `on_step` at the beginning of every step.
        """
        batch = self.batch
        for step in range(batch.steps + 1):
            if on_step is not None:
                on_step()
            if step % EXACT_PERIOD == 0:
                # Depends on the step alone, so that results do not depend on the other robots.
                self.c, self.s = np.cos(self.theta), np.sin(self.theta)
            arrived, lost = self._check_ends()
            if arrived.any():
                self.time = np.where(arrived & np.isnan(self.time), step / batch.rate, self.time)
            if self.follower is not None:
                arrived = np.isfinite(self.time) & self.follower.at_rest()
            ended = arrived | lost
            ended &= self.open
            if step == batch.steps:
                ended = self.open
            if some := bool(ended.any()):
                yield self._outcomes(ended)
                self.open = self.open & ~ended
            left = np.count_nonzero(self.open) if some else 1
            v, omega = self._command() if left else (None, None)
            if keep is not None:
                self._keep(keep, step, ended, v, omega)
            if v is None or omega is None:
                return
            if some and left < SHRINK * len(self.rows):
                v, omega = self._shrink(v, omega)
            self._advance(v, omega)

    def _check_ends(self) -> tuple[Mask, Mask]:
        """Return which robots have arrived, and which were driven away by their law."""
        batch, arrival = self.batch, self.batch.arrival
        goal = batch.goals.T
        with np.errstate(over='ignore', invalid='ignore'):
            dx, dy, offset = goal[0] - self.x, goal[1] - self.y, arrival.offset
            beyond = self.along[0] * dx + self.along[1] * dy
            np.maximum(self.beyond, -beyond, out=self.beyond)
            if type(offset) is not float or offset != 0.0:
                dx, dy = dx - offset * self.c, dy - offset * self.s
            squared = dx * dx + dy * dy
        there = near = squared <= arrival.xy_tolerance * arrival.xy_tolerance
        stopped = arrival.stopped(*self.twist) if arrival.must_stop else np.True_
        if arrival.use_heading:
            self.turning |= near & stopped
            there = self.turning & arrival.faces(self.theta, goal[2])
        if arrival.must_stop:
            self.stopping = (there | near & ~self.turning) & ~stopped
            there = there & stopped
        return there, squared > self.too_far

    def _command(self) -> tuple[Array, Array]:
        """Evaluate the law and saturate its twists."""
        batch, shape = self.batch, (len(self.rows),)
        twist = self._law_result()
        try:
            if batch.state:
                *twist, state = twist
                state = np.broadcast_to(floats('law', state), (*shape, len(batch.state)))
                self.state = list(state.T)
            v, omega = (np.broadcast_to(floats('law', part), shape) for part in twist)
        except (TypeError, ValueError) as error:
            state_too = f' and the state of shape {(*shape, len(batch.state))}' if batch.state else ''
            raise ValueError(
                f'law must return (v, omega), each of shape () or {shape}{state_too}, got {twist!r:.80}'
            ) from error
        if batch.arrival.use_heading and self.turning.any():
            v = np.where(self.turning, 0.0, v)
            turn = wrap(batch.goals[:, 2] - self.theta)
            omega = np.where(self.turning, batch.turning_gain * turn, omega)
        driven = self.open & np.isnan(self.time) & ~self.stopping
        if not driven.all():
            # Finished robots stand still, whatever their law returns.
            v, omega = np.where(driven, v, 0.0), np.where(driven, omega, 0.0)
        finite = np.isfinite(v) & np.isfinite(omega)
        if not finite.all():
            row = int(np.argmin(finite))
            pose = [float(one[row]) for one in (self.x, self.y, self.theta)]
            raise ValueError(
                f'law must return finite (v, omega), got ({v[row]}, {omega[row]}) at pose {pose}'
            )
        v, omega = self._limited(v, omega)
        if np.abs(omega).max() > LARGEST_TURN * batch.rate:
            # The other direction may be forbidden.
            v, omega = self._limited(v, without_whole_turns(omega, batch.rate))
        return v, omega

    def _law_result(self) -> Any:
        """Evaluate the law: an equation of components, or a function of arrays of poses and goals."""
        batch, pose = self.batch, [self.x, self.y, self.theta]
        more: dict[str, Any] = {}
        if batch.state:
            state = np.array(self.state).T if batch.equation is None else self.state
            more = {'state': state, 'dt': self.dt}
            self.dt = 1.0 / batch.rate
        if batch.equation is None:
            return batch.law(np.array(pose).T, batch.goals, *batch.gains, **more)
        result = batch.equation(pose, batch.goals.T, *batch.gains, **more)
        if not batch.state:
            return result
        v, omega, state = result
        return v, omega, np.array(np.broadcast_arrays(self.x, *state)[1:]).T

    def _limited(self, v: Array, omega: Array) -> tuple[Array, Array]:
        """Scale twists to the velocity limits."""
        batch = self.batch
        if batch.limits.unlimited:
            return v, omega
        with np.errstate(all='ignore'):
            limited: tuple[Array, Array] = scaled_to_limits.formula(
                v, omega, *batch.limits.all(), batch.r, batch.L
            )
        return limited

    def _advance(self, v: Array, omega: Array) -> None:
        """Apply a constant twist until the next sample.

        As in `se2.integrate`, the position moves by the chord of the arc, in the direction of the
        heading at the middle of the step.
        """
        if self.follower is not None:
            self._follow(self.follower, np.array([v, omega]))
            return
        self.twist = v, omega
        dt = 1.0 / self.batch.rate
        # Overflow is detected in the outcomes.
        with np.errstate(over='ignore', invalid='ignore'):
            self.sums[0] += np.abs(v)
            self.sums[1] += v * v
            self.sums[2] += omega * omega
            half = omega * (0.5 * dt)
            # One sine instead of two functions: `cos 2a = 1 - 2 sin^2 a`, `sin 2a = 2 sin a cos a`.
            s_quarter = np.sin(0.5 * half)
            squared = s_quarter * s_quarter
            c_half, s_half = 1.0 - 2.0 * squared, 2.0 * s_quarter * np.sqrt(1.0 - squared)
            c, s = self.c * c_half - self.s * s_half, self.s * c_half + self.c * s_half
            chord = v * dt * np.divide(s_half, half, out=np.ones_like(half), where=half != 0.0)
            self.x = self.x + chord * c
            self.y = self.y + chord * s
            self.c, self.s = c * c_half - s * s_half, s * c_half + c * s_half
            self.theta = self.theta + omega * dt
            if np.max(self.theta) > np.pi or np.min(self.theta) <= -np.pi:
                self.theta = wrap(self.theta)

    def _follow(self, follower: Follower, command: Array) -> None:
        """Let robots that take time follow a command until the next sample."""
        # Overflow is detected in the outcomes.
        with np.errstate(over='ignore', invalid='ignore'):
            for rows, (dx, dy, turn), sums in follower.steps(self.batch.r, self.batch.L, command):
                c, s = self.c[rows], self.s[rows]
                c_turn, s_turn = np.cos(turn), np.sin(turn)
                self.x[rows] += c * dx - s * dy
                self.y[rows] += s * dx + c * dy
                self.theta[rows] += turn
                self.c[rows], self.s[rows] = c * c_turn - s * s_turn, s * c_turn + c * s_turn
                self.sums[:, rows] += sums * self.batch.rate
        self.theta = wrap(self.theta)
        self.twist = tuple(follower.twist)

    def _poses(self, which: Mask) -> Array:
        return np.column_stack([self.x[which], self.y[which], self.theta[which]])

    def _outcomes(self, done: Mask) -> tuple[Rows, Outcomes]:
        """Return the rows and the outcomes of the robots that are finished."""
        batch = self.batch
        which = np.flatnonzero(done)
        r, L = (
            np.float64(value) if isinstance(value, float) else value[which]
            for value in (batch.r, batch.L)
        )
        with np.errstate(all='ignore'):
            path, squares_v, squares_omega = self.sums[:, which] / batch.rate
            # Both wheels: (v + omega L/2)^2 + (v - omega L/2)^2, over r^2.
            control_cost = 2.0 * (squares_v + squares_omega * (L / 2.0) ** 2) / r**2
        outcomes = Outcomes(
            np.isfinite(self.time[which]),
            self.time[which],
            path,
            control_cost,
            self.beyond[which],
            self._poses(done),
        )
        if not all(np.isfinite(values).all() for values in (path, control_cost, *outcomes[4:])):
            raise ValueError(
                'starts, goals, gains, rate, limits, r and L must give finite outcomes, '
                'but they overflow'
            )
        return self.rows[which], outcomes

    def _keep(self, keep: Keep, step: int, ended: Mask, v: Array | None, omega: Array | None) -> None:
        keep(step, self.rows[ended], self._poses(ended), None, None)
        if v is not None and omega is not None:
            going = self.open
            keep(step, self.rows[going], self._poses(going), v[going], omega[going])

    def _shrink(self, v: Array, omega: Array) -> tuple[Array, Array]:
        """Remove the robots that are finished, and return the twists of the others."""
        going = np.flatnonzero(self.open)
        self.batch, self.rows = self.batch.some(going), self.rows[going]
        for name in _OF_ROBOTS:
            setattr(self, name, getattr(self, name)[going])
        self.sums, self.along = self.sums[:, going], self.along[:, going]
        if self.follower is not None:
            self.follower.shrink(going)
        self.state = [one[going] for one in self.state]
        return v[going], omega[going]
