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

"""Inverse kinematics from random starts: `python test/benchmark/inverse_kinematics.py [--quick]`.

Planar arms of 2, 3 and 7 links, and one whose middle link is a thousandth as long as the others: every
method, 20,000 targets each (with --quick 100), the same in every run. Reachable targets are what random
joints, uniform in (-pi, pi], reach: as points, and with the heading where there are joints enough.
Starts are drawn likewise. Unreachable ones are points up to a whole reach too far out, and points in
the hole that an arm with one long link leaves. The nearest reachable point of these is known in closed
form; it counts as reached if the error is within a thousandth of the arm's reach of the least one.
The tolerance is 1e-6; all searches of a target have 500 steps together, and up to 20 restarts.
Times are CPU times.

--peers compares `levenberg_marquardt` with scipy.optimize.least_squares, Pinocchio and roboticstoolbox
on the same reachable targets, with up to 20 restarts from random joints, too; each search of a peer has
500 steps. What is not installed is left out (pip install scipy pin; pip install roboticstoolbox-python,
which may need an environment of its own). Nothing else should run meanwhile.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import ik_peers
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from table import WIDTH

from diffdrive_jacobian.kinematics import inverse_kinematics
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm

ARMS = ([1.0, 0.7], [1.0, 0.7, 0.4], [0.5, 0.45, 0.4, 0.35, 0.3, 0.25, 0.2])
LONG_FIRST = ([1.0, 0.7], [1.0, 0.3, 0.2], [1.0, 0.2, 0.15, 0.1, 0.1, 0.05, 0.05])
SHORT_MIDDLE = [1.0, 1e-3, 1.0]
TOLERANCE, RESTARTS = 1e-6, 20
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

    @property
    def name(self) -> str:
        """The number of links, or their lengths."""
        return str(len(self.lengths)) if self.lengths is not SHORT_MIDDLE else '1, 0.001, 1'

    def solve(
        self, method: str, restarts: int, rows: slice = slice(None)
    ) -> inverse_kinematics.IKResult:
        """Solve for all targets, or for some."""
        arm = PlanarArm(self.lengths)
        options: dict[str, Any] = {'method': method, 'restarts': restarts, 'tolerance': TOLERANCE}
        if self.heading:
            return inverse_kinematics.solve(
                arm.forward_kinematics,
                lambda q: arm.jacobian(q, heading=True),
                self.targets[rows],
                self.q0[rows],
                difference=inverse_kinematics.pose_difference,
                **options,
            )
        return inverse_kinematics.solve(
            lambda q: arm.forward_kinematics(q)[:, :2],
            arm.jacobian,
            self.targets[rows, :2],
            self.q0[rows],
            **options,
        )

    def good(self, result: inverse_kinematics.IKResult) -> NDArray[np.bool_]:
        """Return which targets are reached, or the nearest point to them."""
        if self.least is None:
            return result.converged
        assert not result.converged.any()
        return np.asarray(np.abs(result.error - self.least) <= NEAR * sum(self.lengths))

    def cells(self, method: str) -> list[str]:
        """Return what the table shows."""
        alone = self.solve(method, 0)
        began = time.process_time()
        result = self.solve(method, RESTARTS)
        took = (time.process_time() - began) / len(self.q0)
        # Iterations of those that converged; where none can, of all.
        iterations = result.iterations[result.converged if self.least is None else slice(None)]
        return [
            method,
            percent(self.good(alone)),
            percent(self.good(result)),
            f'{np.median(alone.iterations[self.good(alone)]):.0f}',
            f'{np.median(iterations):.0f}',
            f'{np.percentile(iterations, 95):.0f}',
            f'{1e6 * took:.0f}',
        ]

    def peers(self, peers: list[ik_peers.Peer]) -> Iterator[list[str]]:
        """Return the rows of the comparison: ours as a batch and one by one, then the peers."""
        began = time.process_time()
        result = self.solve('levenberg_marquardt', RESTARTS)
        batch = (time.process_time() - began) / len(self.q0)
        some = min(len(self.q0), 1000)
        began = time.process_time()
        for row in range(some):
            self.solve('levenberg_marquardt', RESTARTS, slice(row, row + 1))
        single = (time.process_time() - began) / some
        first = result.converged & (result.start == 0)
        ours = ik_peers.Measured(result.converged, first, result.iterations, single)
        yield ['ours', *comparison_cells(ours), f'{1e6 * batch:.0f}']
        for peer in peers:
            measured = ik_peers.measure(
                peer, self.lengths, self.heading, self.targets, self.q0, RESTARTS, TOLERANCE
            )
            yield [peer.name, *comparison_cells(measured), '-']


def comparison_cells(measured: ik_peers.Measured) -> list[str]:
    found, steps = measured.found, measured.steps
    return [
        percent(measured.first),
        percent(found),
        f'{(~found).sum()}',
        f'{np.median(steps):.0f}',
        f'{np.percentile(steps, 95):.0f}',
        f'{steps.max()}',
        f'{1e6 * measured.seconds:.0f}',
    ]


def percent(flags: NDArray[np.bool_]) -> str:
    """Return the share of true flags, 100 only if all are."""
    text = f'{100.0 * flags.mean():.2f}'
    return '<100.00' if text == '100.00' and not flags.all() else text


def problems(count: int) -> list[Problem]:
    """Make all of them, from a fixed seed."""
    rng = np.random.default_rng(42)
    made = []
    for lengths in (*ARMS, SHORT_MIDDLE):
        q, q0 = rng.uniform(-np.pi, np.pi, (2, count, len(lengths)))
        targets = PlanarArm(lengths).forward_kinematics(q)
        made.append(Problem(lengths, 'reachable points', q0, targets))
        if len(lengths) > 2 and lengths is not SHORT_MIDDLE:
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


def table(title: str, left: list[str], right: list[str]) -> Table:
    made = Table(title=title)
    for name in left:
        made.add_column(name)
    for name in right:
        made.add_column(name, justify='right')
    return made


def methods(console: Console, count: int) -> None:
    """Print the table of methods."""
    good = 'reached, or nearest\npoint reached (%)'
    columns = [good, 'with restarts\n(%)', 'iterations\nmedian', 'with restarts\nmedian', '95 %']
    made = table(
        f'Inverse kinematics of planar arms, {count} targets from random starts each',
        ['links', 'targets', 'method'],
        [*columns, 'us per\ntarget'],
    )
    with console.status('') as status:
        for problem in problems(count):
            for method in inverse_kinematics.METHODS:
                status.update(f'{problem.name}, {problem.kind}, {method}')
                last = method == inverse_kinematics.METHODS[-1]
                made.add_row(problem.name, problem.kind, *problem.cells(method), end_section=last)
    console.print(made)
    console.print('- Iterations of reachable targets are those of the targets that converged.')


def comparison(console: Console, count: int, packages: list[str]) -> None:
    """Print the comparison with other packages."""
    peers, notes = ik_peers.available(packages)
    made = table(
        f'levenberg_marquardt compared with other packages, {count} reachable targets each',
        ['links', 'targets', 'package'],
        [
            'first\nsearch (%)',
            f'{RESTARTS} restarts\n(%)',
            'not\nfound',
            'steps\nmedian',
            '95 %',
            'most',
            'us per\ntarget',
            'in a\nbatch',
        ],
    )
    with console.status('') as status:
        for problem in problems(count):
            if problem.least is not None:
                continue
            status.update(f'{problem.name}, {problem.kind}')
            for cells in problem.peers(peers):
                made.add_row(problem.name, problem.kind, *cells)
            made.add_section()
    console.print(made)
    for note in notes:
        console.print(f'- {note}', highlight=False)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--quick', action='store_true', help='100 targets each, to try it')
    names = [peer.package for peer in ik_peers.PEERS]
    parser.add_argument(
        '--peers',
        nargs='*',
        choices=names,
        metavar='PACKAGE',
        help=f'compare with other packages instead: {", ".join(names)} (default: all)',
    )
    options = parser.parse_args()
    count = 100 if options.quick else 20_000
    console = Console()
    if not console.is_terminal:
        console.width = WIDTH
    if options.peers is None:
        methods(console, count)
    else:
        comparison(console, count, options.peers or names)
    console.print(
        f'- Python {platform.python_version()}, NumPy {np.__version__}, {os.cpu_count()} cores, '
        f'load of the last five minutes {os.getloadavg()[1]:.2f}',
        highlight=False,
    )


if __name__ == '__main__':
    main()
