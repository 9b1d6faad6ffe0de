"""Jacobians and inverse velocities in batches: how many per second, beside NumPy alone.

Ours: `PlanarArm.jacobian`, damped least squares with the damping from the manipulability, and the
inverse by the adjugate, for a batch of random configurations. Beside them what one writes without the
library:

- the Jacobian in arrays without checks; and robot by robot on NumPy's scalars, as document A writes it;
- `np.linalg.solve` with `J J^T + lambda^2 I`, in a batch and robot by robot, with the same damping;
- `np.linalg.inv`.

Both sides give the same, which is looked at first. Speeds are those of one core: CPU time of the process
counts, so that other processes disturb little.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from table import Row, interleave

from diffdrive_jacobian.kinematics.inverse_velocity import (
    adjugate_inverse,
    damped_least_squares,
    damping,
    manipulability,
)
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm

Array = NDArray[np.float64]
BATCH = 8192
SINGLE = 200
"""How many are done robot by robot."""
TWO = np.array([1.0, 0.7])
SEVEN = np.linspace(0.5, 0.2, 7)
THRESHOLD, MOST = 0.2, 0.1
"""Of the damping: w_0 (m^2) and lambda_max (m)."""
WANTED = 2.0
"""Million per second, of Jacobians and of damped least squares for two links."""


class Side(NamedTuple):
    """One way to compute something for the first so many of the batch."""

    compute: Callable[[], Any]
    robots: int = BATCH

    def speed(self, seconds: float) -> float:
        """Measure million per second."""
        done, begun = 0, time.process_time()
        while (taken := time.process_time() - begun) < seconds:
            self.compute()
            done += self.robots
        return done / taken * 1e-6


class Comparison(NamedTuple):
    """Ours, and ways to the same result beside it."""

    ours: str
    quantity: str
    side: Side
    beside: dict[str, Side]


def jacobian_arrays(lengths: Array, q: Array) -> Array:
    """Jacobians of a batch, without checks."""
    angles = np.cumsum(q, axis=1)
    jacobian = np.empty((len(q), 2, len(lengths)))
    x = y = 0.0
    for joint in range(len(lengths) - 1, -1, -1):
        x = x + lengths[joint] * np.cos(angles[:, joint])
        y = y + lengths[joint] * np.sin(angles[:, joint])
        jacobian[:, 0, joint], jacobian[:, 1, joint] = -y, x
    return jacobian


def jacobian_scalars(q: Array) -> Array:
    """The Jacobian of one robot with two links, as document A writes it."""
    l_1, l_2 = TWO
    s_1, s_12 = np.sin(q[0]), np.sin(q[0] + q[1])
    c_1, c_12 = np.cos(q[0]), np.cos(q[0] + q[1])
    return np.array([[-l_1 * s_1 - l_2 * s_12, -l_2 * s_12], [l_1 * c_1 + l_2 * c_12, l_2 * c_12]])


def damped_ours(J: Array, x_dot: Array) -> Array:
    return damped_least_squares(J, x_dot, damping(manipulability(J), THRESHOLD, MOST))


def damped_solve(J: Array, x_dot: Array) -> Array:
    """Damped least squares of one robot or of a batch, by np.linalg."""
    transposed = np.swapaxes(J, -1, -2)
    squared = J @ transposed
    w = np.sqrt(np.maximum(np.linalg.det(squared), 0.0))
    factor = MOST * np.maximum(1.0 - w / THRESHOLD, 0.0)
    damped = squared + (factor * factor)[..., np.newaxis, np.newaxis] * np.eye(2)
    return (transposed @ np.linalg.solve(damped, x_dot[..., np.newaxis]))[..., 0]


def chain(jacobian: Callable[..., Array], damped: Callable[..., Array], q: Array, x_dot: Array) -> Array:
    """From joint angles to joint velocities."""
    return damped(jacobian(q), x_dot)


def single(compute: Callable[..., Array], *arguments: Array) -> Side:
    """Make a side that computes robot by robot."""
    robots = list(zip(*(argument[:SINGLE] for argument in arguments), strict=True))
    return Side(lambda: [compute(*robot) for robot in robots], SINGLE)


def comparisons() -> list[Comparison]:
    """Make all, from a fixed seed."""
    rng = np.random.default_rng(42)
    x_dot = rng.normal(size=(BATCH, 2))
    found: list[Comparison] = []
    for lengths in (TWO, SEVEN):
        arm, q = PlanarArm(lengths), rng.uniform(-np.pi, np.pi, (BATCH, len(lengths)))
        J = arm.jacobian(q)
        links = f'{len(lengths)} links'
        by_linalg = {
            'np.linalg.det and solve': Side(partial(damped_solve, J, x_dot)),
            'np.linalg.det and solve, robot by robot': single(damped_solve, J, x_dot),
        }
        found += [
            Comparison(
                f'our PlanarArm.jacobian, {links}',
                'million Jacobians per second',
                Side(partial(arm.jacobian, q)),
                {'bare arrays': Side(partial(jacobian_arrays, lengths, q))},
            ),
            Comparison(
                f'our damped_least_squares, {links}',
                'million damped inverse velocities per second, with their damping',
                Side(partial(damped_ours, J, x_dot)),
                by_linalg,
            ),
            Comparison(
                f'our Jacobian and damped_least_squares, {links}',
                'million joint velocities per second, from joint angles on',
                Side(partial(chain, arm.jacobian, damped_ours, q, x_dot)),
                {
                    'bare arrays, np.linalg.det and solve': Side(
                        partial(chain, partial(jacobian_arrays, lengths), damped_solve, q, x_dot)
                    )
                },
            ),
        ]
        if lengths is TWO:
            found[0].beside["document A's formula, robot by robot"] = single(jacobian_scalars, q)
            found.append(
                Comparison(
                    'our adjugate_inverse, 2x2',
                    'million inverses per second',
                    Side(partial(adjugate_inverse, J)),
                    {'np.linalg.inv': Side(partial(np.linalg.inv, J))},
                )
            )
    return found


def rows(quick: bool) -> list[Row]:
    """Measure all sides in turn."""
    rounds, seconds = (2, 0.02) if quick else (15, 0.05)
    found: list[Row] = []
    for comparison in comparisons():
        sides = {comparison.ours: comparison.side, **comparison.beside}
        _compare(sides)
        figures = interleave(sides, rounds, lambda side, sides=sides: sides[side].speed(seconds))
        ours = figures.pop(comparison.ours)
        notes = []
        if '2 links' in comparison.ours:
            notes.append(
                f'{comparison.ours}: {statistics.median(ours):.1f} {comparison.quantity}; '
                f'{WANTED:g} are wanted'
            )
        found += [
            Row(
                group=f'Jacobians and inverse velocities, batches of {BATCH}',
                ours=comparison.ours,
                beside=side,
                quantity=comparison.quantity,
                pairs=list(zip(ours, beside, strict=True)),
                digits=3 if sides[side].robots == SINGLE else 1,
                notes=notes,
            )
            for side, beside in figures.items()
        ]
    return found


def _compare(sides: dict[str, Side]) -> None:
    """Refuse to compare speeds of ways to different results."""
    first, *others = (np.asarray(side.compute()) for side in sides.values())
    for other in others:
        # Near a singularity the squares of np.linalg.solve have lost half of the digits.
        if not np.allclose(other, first[: len(other)], rtol=1e-6, atol=1e-6):
            raise RuntimeError(f'different results of {", ".join(sides)}')
