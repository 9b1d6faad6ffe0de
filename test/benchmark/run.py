"""All benchmarks in one table: `python test/benchmark/run.py [--quick] [ROW ...]`.

ROW is one or more of odometry, lockstep, identity, many_robots, start_up, closed_loops, jacobians,
single_calls; without any all are measured (about half an hour; with --quick, to see whether it works, a
minute and a half). Nothing else should run meanwhile. closed_loops also measures packages that pip
installs, if they are there (pip install ir-sim roboticstoolbox-python). flood.py and
inverse_kinematics.py in this folder are benchmarks of their own.
"""

from __future__ import annotations

import argparse
import importlib
import os
import platform
import time

from rich.console import Console
from table import WIDTH, show

ROWS = (
    'lockstep',
    'identity',
    'start_up',
    'many_robots',
    'odometry',
    'closed_loops',
    'jacobians',
    'single_calls',
)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        '--quick', action='store_true', help='short and noisy, to try it; judges nothing'
    )
    parser.add_argument('rows', metavar='ROW', nargs='*', help=', '.join(ROWS))
    options = parser.parse_args()
    if unknown := set(options.rows) - set(ROWS):
        parser.error(f'ROW must be one of {", ".join(ROWS)}, got {", ".join(sorted(unknown))}')
    console = Console()
    if not console.is_terminal:
        console.width = WIDTH
    found = []
    for name in options.rows or ROWS:
        begun = time.monotonic()
        found += importlib.import_module(name).rows(options.quick)
        console.print(f'{name}: measured in {time.monotonic() - begun:.0f} s', style='dim')
    show(found, console, judged=not options.quick)
    console.print(
        f'Python {platform.python_version()}, {os.cpu_count()} cores, '
        f'load of the last five minutes {os.getloadavg()[1]:.2f}'
    )


if __name__ == '__main__':
    main()
