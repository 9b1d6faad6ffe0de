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

"""Calibration of independently simulated robots: what is accepted, and how right the stated errors are.

    python test/benchmark/calibration_cases.py ['CASE' ...] [--robots 200] [--jobs 2] [--results FILE]

The cases are those of independent_robots.py. Prints a Markdown table, the errors of UMBmark over the
Cramer-Rao bound, and which values are off by more than four of their standard deviations without a note.
With `--results` what is done is stored, and not repeated the next time. A robot takes about a second.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
from independent_robots import CASES, cramer_rao_bound, simulate

from diffdrive_jacobian.calibration import CalibrationError, calibrate
from diffdrive_jacobian.calibration.description import explain_undetermined

BOUNDED = 'UMBmark'
"""Case of which the errors are compared with the Cramer-Rao bound."""
FAR, VERY_FAR = 4.0, 5.0
"""Standard deviations beyond which errors are counted. The latter need a note."""
HEADER = (
    'case',
    'accepted, noted, refused',
    'NEES (3)',
    'of each (1)',
    'within 1, 2, 3 σ (%)',
    'bias (%)',
    'stated σ (%)',
    'worst (σ)',
    'beyond 4 σ noted, not noted; 5 σ not noted',
)
"""Three numbers in one cell are of the left radius, the right radius and the separation."""

Row = dict[str, Any]


def one_robot(task: tuple[str, int]) -> Row:
    """Return what the calibration makes of a robot: errors and covariance of the logarithms."""
    case, seed = task
    recordings, nominal, true = simulate(case, seed)
    begin = time.process_time()
    row: Row = {'case': case, 'seed': seed}
    try:
        found = calibrate(recordings, nominal)
    except CalibrationError as error:
        return {**row, 'refused': str(error), 'seconds': time.process_time() - begin}
    seconds = time.process_time() - begin
    if found.undetermined:
        return {**row, 'refused': explain_undetermined(found), 'seconds': seconds}
    scale = np.outer(found.multipliers, found.multipliers)
    # Where the multipliers change, the error is that of the ones that are farther.
    errors = np.log(found.multipliers / true)
    error = errors[np.argmax(np.max(np.abs(errors) / np.sqrt(np.diag(found.covariance)), axis=1))]
    return {
        **row,
        'notes': list(found.notes),
        'error': error.tolist(),
        'covariance': (found.covariance / scale).tolist(),
        'bound': cramer_rao_bound(case, seed).tolist() if case == BOUNDED else None,
        'seconds': seconds,
    }


def table_row(case: str, rows: list[Row]) -> list[str]:
    """Return the cells of a case. Errors are of all robots that have a result, with or without note."""
    found = [row for row in rows if 'error' in row]
    noted = np.array([bool(row['notes']) for row in found], dtype=bool)
    cells = [case, f'{len(found) - noted.sum()}, {noted.sum()}, {len(rows) - len(found)}']
    if not found:
        return cells + [''] * (len(HEADER) - len(cells))
    error = np.array([row['error'] for row in found])
    covariance = np.array([row['covariance'] for row in found])
    nees = np.einsum('ni,nij,nj->n', error, np.linalg.inv(covariance), error)
    deviation = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    relative = np.abs(error) / deviation
    far, very_far = ((relative > limit).sum(axis=1) for limit in (FAR, VERY_FAR))
    chance = error.std(axis=0) / len(found) ** 0.5
    bias = zip(100 * error.mean(axis=0), 100 * chance, strict=True)
    return [
        *cells,
        f'{nees.mean():.3g} ± {nees.std() / len(found) ** 0.5:.2g}',
        ', '.join(f'{one:.3g}' for one in (relative**2).mean(axis=0)),
        ', '.join(f'{100 * (relative < limit).mean():.1f}' for limit in (1, 2, 3)),
        ', '.join(f'{one:+.3f} ± {other:.3f}' for one, other in bias),
        ', '.join(f'{100 * one:.3f}' for one in np.median(deviation, axis=0)),
        f'{relative.max():.1f}',
        f'{far[noted].sum()}, {far[~noted].sum()}; {very_far[~noted].sum()}',
    ]


def over_the_bound(rows: list[Row]) -> str:
    """Return the rms errors of the multipliers, and the same over the Cramer-Rao bound."""
    found = [row for row in rows if 'error' in row]
    squares = np.square([row['error'] for row in found])
    bounds = np.array([row['bound'] for row in found])
    errors = ', '.join(f'{100 * one:.3f}' for one in np.sqrt(squares.mean(axis=0)))
    ratios = ', '.join(f'{one:.3f}' for one in np.sqrt((squares / bounds).mean(axis=0)))
    chance = 0.5**0.5 / len(found) ** 0.5
    return f'{BOUNDED}: rms errors {errors} %, over the Cramer-Rao bound {ratios} ± {chance:.3f}'


def offenders(rows: list[Row]) -> list[str]:
    """Return lines about the robots with errors that are too large and have no note."""
    lines = []
    for row in rows:
        if 'error' in row and not row['notes']:
            relative = np.array(row['error']) / np.sqrt(np.diag(row['covariance']))
            if (np.abs(relative) > FAR).any():
                lines.append(f'{row["case"]}, seed {row["seed"]}: {relative.round(1).tolist()} σ')
    return lines


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('cases', nargs='*', metavar='CASE', help='default: all')
    parser.add_argument('--robots', type=int, default=200, help='of each case (default: 200)')
    parser.add_argument('--seed', type=int, default=0, help='of the first robot (default: 0)')
    parser.add_argument('--jobs', type=int, default=1, help='processes (default: 1)')
    parser.add_argument('--results', type=Path, help='file with what is done, one JSON row per robot')
    options = parser.parse_args()
    cases = options.cases or list(CASES)
    if unknown := set(cases) - set(CASES):
        parser.error(f'no such case: {", ".join(sorted(unknown))}; there are: {", ".join(CASES)}')
    seeds = range(options.seed, options.seed + options.robots)
    rows: dict[tuple[str, int], Row] = {}
    if options.results and options.results.exists():
        for line in options.results.read_text().splitlines():
            row = json.loads(line)
            rows[row['case'], row['seed']] = row
    tasks = [(case, seed) for seed in seeds for case in cases if (case, seed) not in rows]
    # Of the children: several threads for small matrices are slower than one.
    os.environ['OPENBLAS_NUM_THREADS'] = '1'
    context = multiprocessing.get_context('spawn')
    with context.Pool(options.jobs, initializer=os.nice, initargs=(5,)) as pool:
        for row in pool.imap_unordered(one_robot, tasks):
            rows[row['case'], row['seed']] = row
            if options.results:
                with options.results.open('a') as file:
                    file.write(json.dumps(row) + '\n')
    print('| ' + ' | '.join(HEADER) + ' |\n' + '|---' * len(HEADER) + '|')
    done = {case: [rows[case, seed] for seed in seeds] for case in cases}
    for case, own in done.items():
        print('| ' + ' | '.join(table_row(case, own)) + ' |')
    everything = [row for own in done.values() for row in own]
    seconds = [row['seconds'] for row in everything]
    print(
        f'\n{options.robots} robots of each case, {np.median(seconds):.2f} s of CPU time each (median)'
    )
    if BOUNDED in done:
        print(over_the_bound(done[BOUNDED]))
    print('\n'.join(offenders(everything)))


if __name__ == '__main__':
    main()
