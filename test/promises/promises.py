"""What this package promises, how often that was tried, and what came out: doc/promises.md.

    python test/promises/promises.py  list the promises
    python test/promises/promises.py run [NAME ...]  try them, and write counts and results into the page
    python test/promises/promises.py run [NAME ...] --quick  the same, with few cases each
    python test/promises/promises.py run soak --count 60  for another number of cases or minutes

All takes about three hours, with `--quick` a few minutes. The text of a promise is its row of the page.
To add one, add a row, and a `Promise` at the same place of PROMISES. Its function takes the number of
cases and returns an `Outcome`: how many were tried, and what broke it.
"""

from __future__ import annotations

import argparse
import importlib
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import redirect_stdout
from datetime import date
from io import StringIO
from pathlib import Path
from typing import NamedTuple

TEST = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(TEST), str(TEST / 'benchmark')]

from process_faults.outcome import Outcome, spread  # noqa: E402

PAGE = TEST.parent / 'doc' / 'promises.md'
NICE = 10
"""Priority of the processes: others come first."""
MOST_LISTED = 10
"""Violations that are listed of each promise."""


class Promise(NamedTuple):
    """A row of the table."""

    name: str
    """For the command line."""
    unit: str
    """What is counted, in the plural."""
    run: Callable[[int], Outcome]
    """Tries it with a number of cases."""
    full: int = 1
    """Number of cases, as `run` counts them: of each program or input, or minutes of soaking."""
    quick: int = 1
    """Number of cases of a quick run."""


def campaign(module):
    """Return the function `run` of a module, which is imported when it is called."""
    return lambda count: importlib.import_module(module).run(count)


def tests(*files):
    """Return a function that runs test files, and counts the tests."""

    def run(_):
        command = [sys.executable, '-m', 'pytest', '-q', '-n', '0', *files]
        said = subprocess.run(command, cwd=TEST, capture_output=True, text=True).stdout
        numbers = [int(count) for count in re.findall(r'(\d+) (?:passed|failed|error)', said)]
        failed = re.findall(r'^(?:FAILED|ERROR) (\S+)', said, re.MULTILINE)
        return Outcome(sum(numbers), failed if numbers else [said[-300:]])

    return run


def crashes(count):
    """Kill so many recordings."""
    from crash import ALLOWED_LOSS, measure

    with tempfile.TemporaryDirectory() as folder, redirect_stdout(StringIO()):
        losses = [loss for _, loss, _ in measure(count, Path(folder))]
    violations = [f'{loss:.2f} s are lost' for loss in losses if loss > ALLOWED_LOSS]
    return Outcome(len(losses), violations, f'lost: {spread(losses, "s")}')


BAG_TESTS = (
    *('bags/test_damage_fuzz.py', 'bags/test_hostile_bags.py'),
    *('bags/test_damaged_bags.py', 'bags/test_recover.py'),
)
TEXT_TESTS = ('tools/test_text.py', 'bags/test_csv_cells.py', 'nodes/test_bounded_logs.py')
PROMISES = (
    Promise('explored', 'worlds', campaign('explored_nodes'), 5000, 50),
    Promise('ends', 'ends', campaign('process_faults.ends'), 50, 2),
    Promise('stopped', 'faults', campaign('process_faults.stopped'), 120, 6),
    Promise('hostile', 'messages', campaign('process_faults.hostile'), 100000, 1000),
    Promise('parameters', 'settings', campaign('process_faults.fuzzed_parameters'), 30000, 300),
    Promise('clocks', 'events', campaign('process_faults.clocks'), 210, 7),
    Promise('recording', 'recordings', campaign('process_faults.recording'), 12, 1),
    Promise('crashes', 'kills', crashes, 20, 2),
    Promise('soak', 'faults', campaign('process_faults.soak'), 60, 1),
    Promise('bags', 'tests', tests(*BAG_TESTS)),
    Promise('texts', 'tests', tests(*TEXT_TESTS)),
)
"""In the order of the rows of the page."""


def rows(page):
    """Return the numbers of the lines of a page that are rows of promises."""
    table = [number for number, line in enumerate(page) if line.startswith('|')]
    return table[2:]


def updated(page, name, outcome, today):
    """Return the page with the outcome for a promise: its row, and a section with what broke it."""
    head, *sections = page.split('\n## ')
    index = [promise.name for promise in PROMISES].index(name)
    title = f'What broke {name}\n'
    sections = [section for section in sections if not section.startswith(title)]
    found = [str(one).replace('`', "'") for one in outcome.violations]
    lines = head.rstrip('\n').split('\n')
    row = rows(lines)[index]
    text, how, _, _ = lines[row].strip('| ').split(' | ')
    result = f'**{len(found)} broke it**' if found else 'kept'
    result += f'; {outcome.measured}' if outcome.measured else ''
    tried = f'{outcome.count:,} {PROMISES[index].unit}, {today}'
    lines[row] = f'| {text} | {how} | {tried} | {result} |'
    if found:
        listed = [f'- `{one}`' for one in found[:MOST_LISTED]]
        more = [f'- and {len(found) - MOST_LISTED} more'] if len(found) > MOST_LISTED else []
        sections.append('\n'.join([title, *listed, *more]))
    return '\n\n## '.join(part.rstrip('\n') for part in ['\n'.join(lines), *sections]) + '\n'


def main():
    names = [promise.name for promise in PROMISES]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument('what', nargs='?', choices=['run'])
    parser.add_argument('names', nargs='*', metavar='NAME', help=f'some of {", ".join(names)}')
    parser.add_argument('--quick', action='store_true', help='few cases each')
    parser.add_argument('--count', type=int, help='number of cases of each (default: as for the table)')
    options = parser.parse_args()
    if unknown := sorted(set(options.names) - set(names)):
        parser.error(f'NAME must be one of {", ".join(names)}, got {unknown[0]!r}')
    if options.what != 'run':
        print(*names, sep='\n')
        return 0
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    os.nice(NICE)
    broken = 0
    for promise in PROMISES:
        if options.names and promise.name not in options.names:
            continue
        print(promise.name, flush=True)
        outcome = promise.run(options.count or (promise.quick if options.quick else promise.full))
        broken += len(outcome.violations)
        print(f'  {outcome}', flush=True)
        # Another one may run at the same time.
        PAGE.write_text(updated(PAGE.read_text(), promise.name, outcome, date.today().isoformat()))
    return 1 if broken else 0


if __name__ == '__main__':
    sys.exit(main())
