"""Robots that are advanced together, each coordinate in one piece of memory.

The law of a robot and its arc both need cosine and sine of the heading, which take longer than all the
rest. They are carried along: turned with the robot, and computed anew every now and then. Laws of this
package also share the way to the goal with the look for who has arrived.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from diffdrive_jacobian.control.go_to_goal import go_to_goal
from diffdrive_jacobian.control.go_to_goal import steer as steer_to_goal
from diffdrive_jacobian.control.offset_point import offset_point
from diffdrive_jacobian.control.offset_point import steer as steer_offset_point
from diffdrive_jacobian.control.pose import go_to_pose
from diffdrive_jacobian.control.pose import steer as steer_to_pose
from diffdrive_jacobian.control.saturation import saturate
from diffdrive_jacobian.kinematics._checks import floats
from diffdrive_jacobian.kinematics._elementary import wrapped
from diffdrive_jacobian.simulation._batch import Array, Batch, Law, Mask, Outcomes, Rows

LOST = 1e6
"""A robot that is so much farther from its goal than at the start was driven away by its law (m)."""
ANEW = 32
"""After so many steps cosine and sine of the heading are computed anew."""
SHRINK = 0.94
"""When less than this share of the robots still drives, the others are let go of."""
STEERED: tuple[tuple[Law, Callable[..., tuple[Any, Any]]], ...] = (
    (go_to_goal, lambda ahead, aside, _, *gains: steer_to_goal(ahead, aside, *gains)),
    (offset_point, lambda ahead, aside, _, *gains: steer_offset_point(ahead, aside, *gains)),
    (go_to_pose, lambda ahead, aside, turn, *gains: steer_to_pose(ahead, aside, turn(), *gains)),
)
"""Laws of this package, and what they are for a goal that is given as seen from the robot."""


def steered(law: Law) -> Callable[..., tuple[Any, Any]] | None:
    """Give what a law of this package is for a goal as seen from the robot; None: not one of them."""
    return next((core for known, core in STEERED if known is law), None)


Keep = Callable[[int, Rows, Array, Any, Any], None]


class Block:
    """Some robots of a batch, on their way."""

    def __init__(self, batch: Batch, rows: Rows) -> None:
        """Place the robots, which are these of the whole batch, at their starts."""
        self.batch, self.rows, count = batch, rows, len(rows)
        self.steered = steered(batch.law)
        self.x, self.y, theta = batch.starts.T.copy()
        self.theta: Array = wrapped(theta)
        self.open: Mask = np.ones(count, dtype=np.bool_)
        self.turning: Mask = np.zeros(count, dtype=np.bool_)
        # Summed up: |v|, v^2, omega^2; the farthest way beyond the goal.
        self.sums: Array = np.zeros((3, count))
        self.beyond: Array = np.zeros(count)
        with np.errstate(over='ignore', invalid='ignore'):
            way = batch.goals[:, :2] - batch.starts[:, :2]
            length = np.hypot(*way.T)
            self.along: Array = np.array((way / np.where(length > 0.0, length, 1.0)[:, np.newaxis]).T)
            self.too_far: Array = (length + LOST) ** 2

    def drive(
        self, keep: Keep | None, on_step: Callable[[], object] | None = None
    ) -> Iterator[tuple[Rows, Outcomes]]:
        """Drive them to their ends; gives who is done, and what became of them.

        `on_step` is called at the beginning of every step.
        """
        batch = self.batch
        for step in range(batch.steps + 1):
            if on_step is not None:
                on_step()
            if step % ANEW == 0:
                # By the number of the step alone, so that the result does not depend on the company.
                self.c, self.s = np.cos(self.theta), np.sin(self.theta)
            arrived, lost = self._look()
            ended = arrived | lost
            ended &= self.open
            if step == batch.steps:
                ended = self.open
            if some := bool(ended.any()):
                yield self._outcomes(ended, arrived, step)
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

    def _look(self) -> tuple[Mask, Mask]:
        """Tell who has arrived, and whom the law has driven away."""
        batch, arrival = self.batch, self.batch.arrival
        goal = batch.goals.T
        with np.errstate(over='ignore', invalid='ignore'):
            self.dx, self.dy = goal[0] - self.x, goal[1] - self.y
            dx, dy, offset = self.dx, self.dy, arrival.offset
            beyond = self.along[0] * dx + self.along[1] * dy
            np.maximum(self.beyond, -beyond, out=self.beyond)
            if type(offset) is not float or offset != 0.0:
                dx, dy = dx - offset * self.c, dy - offset * self.s
            squared = dx * dx + dy * dy
        there = squared <= arrival.xy_tolerance * arrival.xy_tolerance
        if arrival.use_heading:
            self.turning |= there
            there = self.turning & arrival.faces(self.theta, goal[2])
        return there, squared > self.too_far

    def _command(self) -> tuple[Array, Array]:
        """Ask the law, and hold what it gives to the limits."""
        batch, shape = self.batch, (len(self.rows),)
        if self.steered is None:
            twist = batch.law(np.array([self.x, self.y, self.theta]).T, batch.goals, *batch.gains)
        else:
            # Without negative zeros the angle of (0, 0) is 0.
            ahead = self.c * self.dx + self.s * self.dy + 0.0
            aside = self.c * self.dy - self.s * self.dx + 0.0
            twist = self.steered(ahead, aside, self._turn, *batch.gains)
        try:
            v, omega = (np.broadcast_to(floats('law', part), shape) for part in twist)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f'law must give (v, omega), each of shape () or {shape}, got {twist!r:.80}'
            ) from error
        if batch.arrival.use_heading and self.turning.any():
            v = np.where(self.turning, 0.0, v)
            omega = np.where(self.turning, batch.turning_gain * wrapped(self._turn()), omega)
        if not self.open.all():
            # Who is done stays where it is, whatever its law makes of that.
            v, omega = np.where(self.open, v, 0.0), np.where(self.open, omega, 0.0)
        finite = np.isfinite(v) & np.isfinite(omega)
        if not finite.all():
            row = int(np.argmin(finite))
            pose = [float(one[row]) for one in (self.x, self.y, self.theta)]
            raise ValueError(
                f'law must give finite (v, omega), got ({v[row]}, {omega[row]}) at pose {pose}'
            )
        if not batch.limits.unlimited:
            v, omega = saturate(v, omega, batch.limits, batch.r, batch.L)
        return v, omega

    def _turn(self) -> Array:
        """Give how much further the goals look to the left, not wrapped (rad)."""
        turn: Array = self.batch.goals[:, 2] - self.theta
        return turn

    def _advance(self, v: Array, omega: Array) -> None:
        """Hold a twist until the next sample: the chord of the arc along its middle heading, as in
        `se2.integrate`, the heading turned by half the turn before it and half after it.
        """
        dt = 1.0 / self.batch.rate
        # What overflows is found at the end.
        with np.errstate(over='ignore', invalid='ignore'):
            self.sums[0] += np.abs(v)
            self.sums[1] += v * v
            self.sums[2] += omega * omega
            half = omega * (0.5 * dt)
            # A tiny angle in the place of zero gives a chord as long as the arc.
            hole = (half == 0.0) * 1e-20
            c_half, s_half = np.cos(half), np.sin(half)
            c, s = self.c * c_half - self.s * s_half, self.s * c_half + self.c * s_half
            chord = v * dt * ((s_half + hole) / (half + hole))
            self.x = self.x + chord * c
            self.y = self.y + chord * s
            self.c, self.s = c * c_half - s * s_half, s * c_half + c * s_half
            self.theta = self.theta + omega * dt
            if np.max(self.theta) > np.pi or np.min(self.theta) <= -np.pi:
                self.theta = wrapped(self.theta)

    def _poses(self, which: Mask) -> Array:
        return np.column_stack([self.x[which], self.y[which], self.theta[which]])

    def _outcomes(self, done: Mask, arrived: Mask, step: int) -> tuple[Rows, Outcomes]:
        """Sum up those who are done."""
        batch = self.batch
        which = np.flatnonzero(done)
        r, L = (
            np.float64(value) if isinstance(value, float) else value[which]
            for value in (batch.r, batch.L)
        )
        with np.errstate(all='ignore'):
            path, squares_v, squares_omega = self.sums[:, which] / batch.rate
            # Both wheels: (v + omega L/2)^2 + (v - omega L/2)^2, over r^2.
            effort = 2.0 * (squares_v + squares_omega * (L / 2.0) ** 2) / r**2
        outcomes = Outcomes(
            arrived[which],
            np.where(arrived[which], step / batch.rate, np.nan),
            path,
            effort,
            self.beyond[which],
            self._poses(done),
        )
        if not all(np.isfinite(values).all() for values in (path, effort, *outcomes[4:])):
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
        """Let go of those who are done; gives the twists of the others."""
        going = np.flatnonzero(self.open)
        self.batch, self.rows = self.batch.some(going), self.rows[going]
        for name in ('x', 'y', 'theta', 'c', 's', 'turning', 'open', 'beyond', 'too_far'):
            setattr(self, name, getattr(self, name)[going])
        self.sums, self.along = self.sums[:, going], self.along[:, going]
        return v[going], omega[going]
