"""Closed loops in batches: thousands of unicycles, each under a control law, at once.

Every robot is sampled at a rate. At each sample it either has arrived, or its law gives a body twist
`[v, omega]` (m/s, rad/s), which is held within the limits and driven along the exact arc until the next
one: the loop of go_to_goal and virtual_robot, without delay.

Starts, goals, gains, robots and limits broadcast with each other; the batch is their leading axes.

Source: MATH.md, "Motion of a virtual robot" and "Control laws".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.control.arrival import Arrival
from diffdrive_jacobian.control.go_to_goal import turn_in_place
from diffdrive_jacobian.control.saturation import VelocityLimits, saturate
from diffdrive_jacobian.kinematics._checks import array, floats, leading, number, positive
from diffdrive_jacobian.kinematics.se2 import integrate

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Law = Callable[..., tuple[Any, Any]]
"""`law(poses, goals, *gains)` with shapes (k, 3), (k, 2 or 3) and for each gain () or (k,); gives `(v,
omega)`. `go_to_goal`, `offset_point` and `go_to_pose` are such laws."""
BLOCK = 8192
"""Robots that are advanced together: as many as fit into the processor's cache."""
LOST = 1e6
"""A robot that is so much farther from its goal than at the start was driven away by its law (m)."""
MAX_STEPS = 1e12
NO_LIMITS = VelocityLimits()


class Outcomes(NamedTuple):
    """What became of each robot; every field has the shape of the batch."""

    arrived: Mask
    """Whether it arrived in time."""
    time: Array
    """When it arrived; NaN: it did not (s)."""
    path_length: Array
    """Way of the axle centre, backwards too (m)."""
    effort: Array
    """Integral of the squares of both wheel speeds (rad^2/s)."""
    overshoot: Array
    """How far it went beyond the goal, along the line from start to goal (m)."""
    pose: Array
    """Where it was at the end, shape (..., 3)."""


class Trajectories(NamedTuple):
    """Every sample of every robot, k + 1 of them; who has arrived stands still."""

    times: Array
    """Shape (k + 1,) (s)."""
    poses: Array
    """Shape (k + 1, ..., 3)."""
    twists: Array
    """`[v, omega]` held from each sample to the next, shape (k, ..., 2) (m/s, rad/s)."""
    outcomes: Outcomes


def closed_loops(
    law: Law,
    starts: ArrayLike,
    goals: ArrayLike,
    *gains: ArrayLike,
    rate: float = 50.0,
    duration: float = 60.0,
    arrival: Arrival | None = None,
    turning_gain: ArrayLike = 3.0,
    limits: VelocityLimits = NO_LIMITS,
    r: ArrayLike = 0.033,
    L: ArrayLike = 0.16,
    progress: Callable[[int], object] | None = None,
) -> Outcomes:
    """Drive every robot to its goal and tell what became of it; memory does not grow with the time.

    Args:
        law: The controller, `law(poses, goals, *gains)`.
        starts: Poses, shape (..., 3).
        goals: Positions or poses, shape (..., 2) or (..., 3), as the law wants them.
        gains: Whatever else the law takes, each of shape (...).
        rate: How often the law is asked (Hz).
        duration: After how long a robot is given up (s).
        arrival: What counts as having arrived; None: the defaults of `Arrival`. If the heading counts, a
            robot that has reached its position turns in place.
        turning_gain: Gain of that turn, shape (...) (1/s).
        limits: What the drives can do.
        r: Wheel radius, shape (...) (m).
        L: Wheel separation, shape (...) (m).
        progress: Called now and then with the number of robots that are done.

    Returns:
        The outcomes. A law that drives a robot away has not arrived; nothing is raised.

    Raises:
        ValueError: An argument has a wrong shape or value, or the law gives something that does not fit.
    """
    fleet = _Fleet.of(law, starts, goals, gains, rate, duration, arrival, turning_gain, limits, r, L)
    return fleet.drive(None, progress)


def trajectories(
    law: Law,
    starts: ArrayLike,
    goals: ArrayLike,
    *gains: ArrayLike,
    rate: float = 50.0,
    duration: float = 60.0,
    arrival: Arrival | None = None,
    turning_gain: ArrayLike = 3.0,
    limits: VelocityLimits = NO_LIMITS,
    r: ArrayLike = 0.033,
    L: ArrayLike = 0.16,
) -> Trajectories:
    """Drive every robot to its goal and keep every sample, until the last one is done.

    Arguments and errors are those of `closed_loops`.
    """
    fleet = _Fleet.of(law, starts, goals, gains, rate, duration, arrival, turning_gain, limits, r, L)
    poses = np.empty((fleet.steps + 1, fleet.size, 3))
    twists = np.zeros((fleet.steps, fleet.size, 2))
    last = np.zeros(fleet.size, dtype=np.intp)

    def keep(step: int, rows: NDArray[np.intp], at: Array, v: Any, omega: Any) -> None:
        poses[step, rows], last[rows] = at, step
        if v is not None:
            twists[step, rows, 0], twists[step, rows, 1] = v, omega

    outcomes = fleet.drive(keep, None)
    steps = int(max(last, default=0))
    held = np.minimum(np.arange(steps + 1)[:, np.newaxis], last)
    poses = poses[held, np.arange(fleet.size)]
    return Trajectories(
        np.arange(steps + 1) / rate,
        poses.reshape(steps + 1, *fleet.shape, 3),
        twists[:steps].reshape(steps, *fleet.shape, 2),
        outcomes,
    )


Keep = Callable[[int, NDArray[np.intp], Array, Any, Any], None]


@dataclass(frozen=True, kw_only=True)
class _Fleet:
    """The whole batch: what is the same for all as a number, the rest with a first axis of robots."""

    law: Law
    starts: Array
    goals: Array
    gains: tuple[Any, ...]
    rate: float
    steps: int
    arrival: Arrival
    turning_gain: Any
    limits: VelocityLimits
    r: Any
    L: Any
    shape: tuple[int, ...]
    """Of the batch, before it was flattened."""

    @classmethod
    def of(
        cls,
        law: Law,
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
    ) -> _Fleet:
        """Check the arguments and flatten the batch."""
        arrival = Arrival() if arrival is None else arrival
        starts, goals = array('starts', starts, 3), array('goals', goals, 'm')
        if goals.shape[-1] not in (2, 3) or (arrival.use_heading and goals.shape[-1] != 3):
            wanted = '(..., 3)' if arrival.use_heading else '(..., 2) or (..., 3)'
            raise ValueError(f'goals must have shape {wanted}, got {goals.shape}')
        rate = number('rate', rate, positive)
        duration = number('duration', duration, positive)
        if not duration * rate < MAX_STEPS:
            raise ValueError(
                f'duration must be below {MAX_STEPS / rate:g} s at that rate, got {duration:g}'
            )
        if not isinstance(limits, VelocityLimits):
            raise ValueError(f'limits must be VelocityLimits, got {limits!r:.60}')
        columns = {f'gain {index}': array(f'gain {index}', gain) for index, gain in enumerate(gains)}
        columns['turning_gain'] = array('turning_gain', turning_gain)
        columns['offset'] = floats('offset', arrival.offset)
        columns.update(r=floats('r', r), L=floats('L', L))
        positive('r', columns['r'])
        positive('L', columns['L'])
        columns.update(
            zip(limits.names(), (floats('limits', limit) for limit in limits.all()), strict=True)
        )
        shape = leading(
            starts=starts.shape[:-1],
            goals=goals.shape[:-1],
            **{name: value.shape for name, value in columns.items()},
        )
        flat = {
            name: float(value) if value.ndim == 0 else np.broadcast_to(value, shape).reshape(-1)
            for name, value in columns.items()
        }
        return cls(
            law=law,
            starts=np.broadcast_to(starts, (*shape, 3)).reshape(-1, 3),
            goals=np.broadcast_to(goals, (*shape, goals.shape[-1])).reshape(-1, goals.shape[-1]),
            gains=tuple(flat[f'gain {index}'] for index in range(len(gains))),
            rate=rate,
            steps=math.ceil(duration * rate - 1e-9),
            arrival=replace(arrival, offset=flat['offset']),
            turning_gain=flat['turning_gain'],
            limits=VelocityLimits(**{name: flat[name] for name in limits.names()}),
            r=flat['r'],
            L=flat['L'],
            shape=shape,
        )

    @property
    def size(self) -> int:
        """How many robots there are."""
        return len(self.starts)

    def some(self, rows: Any) -> _Fleet:
        """Give some of the robots, their coordinates each in one piece of memory."""

        def pick(value: Any) -> Any:
            return value if isinstance(value, float) else value[rows]

        return replace(
            self,
            starts=np.array(self.starts[rows].T).T,
            goals=np.array(self.goals[rows].T).T,
            gains=tuple(map(pick, self.gains)),
            arrival=replace(self.arrival, offset=pick(self.arrival.offset)),
            turning_gain=pick(self.turning_gain),
            limits=VelocityLimits(
                **dict(zip(self.limits.names(), map(pick, self.limits.all()), strict=True))
            ),
            r=pick(self.r),
            L=pick(self.L),
        )

    def drive(self, keep: Keep | None, progress: Callable[[int], object] | None) -> Outcomes:
        """Drive all robots, block by block."""
        count = self.size
        found = Outcomes(
            np.zeros(count, dtype=np.bool_),
            np.full(count, np.nan),
            np.zeros(count),
            np.zeros(count),
            np.zeros(count),
            np.empty((count, 3)),
        )
        done = 0
        for begin in range(0, count, BLOCK):
            rows = np.arange(begin, min(begin + BLOCK, count))
            for finished, values in _Block(self.some(rows), rows).drive(keep):
                for field, value in zip(found, values, strict=True):
                    field[finished] = value
                done += len(finished)
                if progress is not None:
                    progress(done)
        made = [field.reshape((*self.shape, *field.shape[1:])) for field in found]
        return Outcomes._make(made)


class _Block:
    """Robots that are advanced together; who is done leaves when a quarter of them is."""

    def __init__(self, fleet: _Fleet, rows: NDArray[np.intp]) -> None:
        self.fleet, self.rows, count = fleet, rows, len(rows)
        self.pose: Array = fleet.starts
        self.open: Mask = np.ones(count, dtype=np.bool_)
        self.turning: Mask = np.zeros(count, dtype=np.bool_)
        # Summed up: |v|, v^2, omega^2; the farthest way beyond the goal.
        self.sums: Array = np.zeros((3, count))
        self.beyond: Array = np.zeros(count)
        way = fleet.goals[:, :2] - fleet.starts[:, :2]
        length = np.hypot(*way.T)
        self.along: Array = np.array((way / np.where(length > 0.0, length, 1.0)[:, np.newaxis]).T)
        self.too_far: Array = length + LOST

    def drive(self, keep: Keep | None) -> Iterator[tuple[NDArray[np.intp], Outcomes]]:
        """Drive them to their ends; gives who is done, and what became of them."""
        for step in range(self.fleet.steps + 1):
            arrived, lost = self._look()
            v: Any = None
            omega: Any = None
            last = step == self.fleet.steps
            done = self.open & (arrived | lost | last)
            ended = bool(done.any())
            if ended:
                yield self._outcomes(done, arrived, step)
            going = self.open = self.open & ~done if ended else self.open
            if not last and going.any():
                v, omega = self._command()
            if keep is not None:
                self._keep(keep, step, done, going, v, omega)
            if v is None:
                return
            if ended and np.count_nonzero(going) < 0.75 * len(going):
                self._shrink(going)
                v, omega = v[going], omega[going]
            self._advance(v, omega)

    def _look(self) -> tuple[Mask, Mask]:
        """Tell who has arrived, and whom the law has driven away."""
        fleet, arrival = self.fleet, self.fleet.arrival
        (x, y, theta), goal = self.pose.T, fleet.goals.T
        with np.errstate(over='ignore'):
            distance = arrival.distance(x, y, theta, goal[0], goal[1])
        dx, dy = x - goal[0], y - goal[1]
        np.maximum(self.beyond, self.along[0] * dx + self.along[1] * dy, out=self.beyond)
        there = distance <= arrival.xy_tolerance
        if arrival.use_heading:
            self.turning |= there
            there = self.turning & arrival.faces(theta, goal[2])
        return there, distance > self.too_far

    def _command(self) -> tuple[Array, Array]:
        """Ask the law, and hold what it gives to the limits."""
        fleet = self.fleet
        twist = fleet.law(self.pose, fleet.goals, *fleet.gains)
        shape = (len(self.rows),)
        try:
            v, omega = (np.broadcast_to(floats('law', part), shape) for part in twist)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f'law must give (v, omega), each of shape () or {shape}, got {twist!r:.80}'
            ) from error
        if not self.open.all():
            # Who is done stays where it is, whatever its law makes of that.
            v, omega = np.where(self.open, (v, omega), 0.0)
        if self.turning.any():
            turn = turn_in_place(self.pose[:, 2], fleet.goals[:, 2], fleet.turning_gain)
            v, omega = np.where(self.turning & self.open, turn, (v, omega))
        finite = np.isfinite(v) & np.isfinite(omega)
        if not finite.all():
            row = int(np.argmin(finite))
            raise ValueError(
                f'law must give finite (v, omega), got ({v[row]}, {omega[row]}) at pose {self.pose[row]}'
            )
        if not fleet.limits.unlimited:
            v, omega = saturate(v, omega, fleet.limits, fleet.r, fleet.L)
        return v, omega

    def _advance(self, v: Array, omega: Array) -> None:
        """Hold a twist until the next sample."""
        twist = np.array([v, omega])
        self.sums[0] += np.abs(v)
        self.sums[1:] += twist * twist
        self.pose = integrate(self.pose, twist.T, 1.0 / self.fleet.rate)

    def _outcomes(self, done: Mask, arrived: Mask, step: int) -> tuple[NDArray[np.intp], Outcomes]:
        """Sum up those who are done."""
        fleet, rows = self.fleet, self.rows[done]
        dt = 1.0 / fleet.rate
        path, squares_v, squares_omega = self.sums[:, done] * dt
        r, L = (value if isinstance(value, float) else value[done] for value in (fleet.r, fleet.L))
        return rows, Outcomes(
            arrived[done],
            np.where(arrived[done], step * dt, np.nan),
            path,
            # Both wheels: (v + omega L/2)^2 + (v - omega L/2)^2, over r^2.
            2.0 * (squares_v + squares_omega * (L / 2.0) ** 2) / r**2,
            self.beyond[done],
            self.pose[done],
        )

    def _keep(self, keep: Keep, step: int, done: Mask, going: Mask, v: Any, omega: Any) -> None:
        keep(step, self.rows[done], self.pose[done], None, None)
        if v is not None:
            keep(step, self.rows[going], self.pose[going], v[going], omega[going])

    def _shrink(self, going: Mask) -> None:
        """Let go of those who are done."""
        self.fleet, self.rows = self.fleet.some(going), self.rows[going]
        self.pose, self.turning = np.array(self.pose[going].T).T, self.turning[going]
        self.sums, self.beyond = self.sums[:, going], self.beyond[going]
        self.along, self.open = self.along[:, going], self.open[going]
        self.too_far = self.too_far[going]
