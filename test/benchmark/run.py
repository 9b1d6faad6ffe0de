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

"""The tables of doc/performance.md: `python test/benchmark/run.py [--quick] [ROW ...]`.

ROW is one or more of odometry, three_processes, lockstep, many_robots, start_up, discovery; without any
all are measured (about forty minutes; with --quick, to see whether it works, two). Nothing else should
run meanwhile. --page writes what was measured into doc/performance.md. The other programs in this folder
are benchmarks of their own.
"""

from __future__ import annotations

import argparse
import importlib
import os
import platform
import re
import time
from pathlib import Path

from rich.console import Console
from table import WIDTH, Row, sections, show

PAGE = Path(__file__).parents[2] / 'doc' / 'performance.md'
BEGIN, END = '<!-- measured -->', '<!-- end -->'
ROWS = (
    'lockstep',
    'start_up',
    'many_robots',
    'odometry',
    'three_processes',
    'discovery',
)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        '--quick', action='store_true', help='short and noisy, to try it; judges nothing'
    )
    parser.add_argument('--page', action='store_true', help='write the table into doc/performance.md')
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
    machine = (
        f'Python {platform.python_version()}, {os.cpu_count()} cores, '
        f'load of the last five minutes {os.getloadavg()[1]:.2f}'
    )
    console.print(machine)
    if options.page:
        write(found, machine)


def write(rows: list[Row], machine: str) -> None:
    """Write rows into the page, in the place of those of the same groups, and what machine it was."""
    before, _, rest = PAGE.read_text().partition(BEGIN)
    measured, _, after = rest.partition(END)
    _, *parts = re.split('^(### .*)$', measured, flags=re.MULTILINE)
    groups = {heading: text.strip() for heading, text in zip(parts[::2], parts[1::2], strict=True)}
    new = sections(rows, f'Measured on {time.strftime("%Y-%m-%d")}: {machine}.')
    groups.update((heading, '\n'.join(lines)) for heading, lines in new.items())
    text = '\n\n'.join(f'{heading}\n\n{lines}' for heading, lines in groups.items())
    PAGE.write_text(f'{before}{BEGIN}\n{text}\n\n{END}{after}')


if __name__ == '__main__':
    main()
