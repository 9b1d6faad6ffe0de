"""Inverse kinematics from random starts: `python test/benchmark/inverse_kinematics.py [--quick]`.

Planar arms of 2, 3 and 7 links, every method, 10,000 targets each (with --quick 500), always the same.
Reachable targets are what random joints reach: as points, and with the heading where there are joints
enough. Unreachable ones are points up to a whole reach too far out, and points in the hole that an arm
with one long link leaves. The nearest reachable point of these is known in closed form; it counts as
reached if the error is within a thousandth of the arm's reach of the least one. Nothing else should run
meanwhile.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from table import WIDTH

from diffdrive_jacobian.kinematics import inverse_kinematics
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm

ARMS = ([1.0, 0.7], [1.0, 0.7, 0.4], [0.5, 0.45, 0.4, 0.35, 0.3, 0.25, 0.2])
LONG_FIRST = ([1.0, 0.7], [1.0, 0.3, 0.2], [1.0, 0.2, 0.15, 0.1, 0.1, 0.05, 0.05])
NEAR = 1e-3
"""How far from the nearest reachable point is near, relative to the arm's reach."""


class Problem(NamedTuple):
    """Targets for an arm, with starts."""

    lengths: list[float]
    kind: str
    q0: NDArray[np.float64]
    targets: NDArray[np.float64]
    """[x, y, heading]; the heading counts if there is no least error."""
    heading: bool = False
    least: NDArray[np.float64] | None = None
    """The distance to the nearest reachable point, if that is not zero."""

    def solve(self, method: str) -> inverse_kinematics.IKResult:
        arm = PlanarArm(self.lengths)
        if self.heading:
            return inverse_kinematics.solve(
                arm.forward_kinematics,
                lambda q: arm.jacobian(q, heading=True),
                self.targets,
                self.q0,
                method=method,
                difference=inverse_kinematics.pose_difference,
            )
        return inverse_kinematics.solve(
            lambda q: arm.forward_kinematics(q)[:, :2],
            arm.jacobian,
            self.targets[:, :2],
            self.q0,
            method=method,
        )

    def cells(self, method: str) -> list[str]:
        """Give what the table shows."""
        begun = time.perf_counter()
        result = self.solve(method)
        took = (time.perf_counter() - begun) / len(self.q0)
        counted = good = result.converged
        if self.least is not None:
            assert not result.converged.any()
            good = np.abs(result.error - self.least) <= NEAR * sum(self.lengths)
            counted = np.ones_like(good)
        # Iterations of those that converged; where none can, of all.
        iterations = result.iterations[counted]
        return [
            method,
            f'{100.0 * good.mean():.2f}',
            f'{np.median(iterations):.0f}',
            f'{np.percentile(iterations, 95):.0f}',
            f'{1e6 * took:.0f}',
        ]


def problems(count: int) -> list[Problem]:
    """Make all of them, from a fixed seed."""
    rng = np.random.default_rng(42)
    made = []
    for lengths in ARMS:
        q, q0 = rng.uniform(-np.pi, np.pi, (2, count, len(lengths)))
        targets = PlanarArm(lengths).forward_kinematics(q)
        made.append(Problem(lengths, 'reachable points', q0, targets))
        if len(lengths) > 2:
            made.append(Problem(lengths, 'reachable, with heading', q0, targets, heading=True))
    for lengths in ARMS:
        reach = sum(lengths)
        distance = reach * rng.uniform(1.0 + NEAR, 2.0, count)
        made.append(_unreachable('points too far', lengths, distance, distance - reach, rng))
    for lengths in LONG_FIRST:
        hole = 2.0 * lengths[0] - sum(lengths)
        distance = hole * rng.uniform(0.0, 1.0 - NEAR, count)
        made.append(_unreachable('points in the hole', lengths, distance, hole - distance, rng))
    return made


def _unreachable(
    kind: str, lengths: list[float], distance: Any, least: Any, rng: np.random.Generator
) -> Problem:
    count = len(distance)
    angle = rng.uniform(-np.pi, np.pi, count)
    targets = np.stack([distance * np.cos(angle), distance * np.sin(angle), angle], axis=-1)
    return Problem(
        lengths, kind, rng.uniform(-np.pi, np.pi, (count, len(lengths))), targets, least=least
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--quick', action='store_true', help='500 targets each, to try it')
    count = 500 if parser.parse_args().quick else 10_000
    console = Console()
    if not console.is_terminal:
        console.width = WIDTH
    table = Table(title=f'Inverse kinematics of planar arms, {count} targets from random starts each')
    for name in ('links', 'targets', 'method'):
        table.add_column(name)
    for name in (
        'reached, or nearest\npoint reached (%)',
        'iterations\nmedian',
        '95 %',
        'us per\ntarget',
    ):
        table.add_column(name, justify='right')
    with console.status('') as status:
        for problem in problems(count):
            for method in inverse_kinematics.METHODS:
                status.update(f'{len(problem.lengths)} links, {problem.kind}, {method}')
                last = method == inverse_kinematics.METHODS[-1]
                cells = [str(len(problem.lengths)), problem.kind, *problem.cells(method)]
                table.add_row(*cells, end_section=last)
    console.print(table)
    console.print(
        '- Iterations of reachable targets are those of the targets that converged.\n'
        f'- Python {platform.python_version()}, NumPy {np.__version__}, {os.cpu_count()} cores, '
        f'load of the last five minutes {os.getloadavg()[1]:.2f}',
        highlight=False,
    )


if __name__ == '__main__':
    main()
