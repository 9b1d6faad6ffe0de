"""What this package promises, how often that was tried, and what came out: the table of doc/promises.md.

    python test/promises/promises.py  write the page from the results in promises.json
    python test/promises/promises.py run [NAME ...]  try again, store the results, and write the page
    python test/promises/promises.py run [NAME ...] --quick  the same, with few cases each
    python test/promises/promises.py run soak --count 60  for another number of cases or minutes

All takes about three hours, with `--quick` a few minutes. To add a row, add a `Promise` to PROMISES. Its
function takes the number of cases and returns an `Outcome`: how many were tried, and what broke it.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import NamedTuple

TEST = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(TEST), str(TEST / 'exploration')]

from process_faults.outcome import Outcome, spread  # noqa: E402

RESULTS = Path(__file__).with_name('promises.json')
PAGE = TEST.parent / 'doc' / 'promises.md'
NICE = 10
"""Priority of the processes: others come first."""
BAG_TESTS = (
    *('bags/test_damage_fuzz.py', 'bags/test_hostile_bags.py'),
    *('bags/test_damaged_bags.py', 'bags/test_recover.py'),
)
MOST_LISTED = 10
"""Violations that are listed of each promise."""
HEAD = """# Promises

What the package promises, and how often that was tried: in explored worlds, and where a simulation
cannot tell, with real processes under signals, crashes, hostile messages, failing disks. Each row is
tried by a program that counts. `python test/promises/promises.py run` tries
all of them again and writes this page. It takes about three hours, and root, who may mount small file
systems. `python test/promises/promises.py run ends soak --quick` tries two of them with few cases. A
short form is part of the tests (`test/promises/test_process_faults.py`).

| promise | how it is tested | tried | result |
|---|---|---|---|
"""


class Promise(NamedTuple):
    """A row of the table."""

    name: str
    """For the command line and the results."""
    text: str
    """What is promised; lines are joined."""
    how: str
    """How that is tested."""
    unit: str
    """What is counted, in the plural."""
    run: Callable[[int], Outcome]
    """Tries it with a number of cases."""
    full: int
    """Number of cases, as `run` counts them: of each program or input, or minutes of soaking."""
    quick: int
    """Number of cases of a quick run."""


def campaign(module: str) -> Callable[[int], Outcome]:
    """Return the function `run` of a module, which is imported when it is called."""

    def run(count: int) -> Outcome:
        found: Outcome = importlib.import_module(module).run(count)
        return found

    return run


def tests(*files: str) -> Callable[[int], Outcome]:
    """Return a function that runs test files, and counts the tests."""

    def run(_: int) -> Outcome:
        command = [sys.executable, '-m', 'pytest', '-q', '-n', '0', *files]
        said = subprocess.run(command, cwd=TEST, capture_output=True, text=True).stdout
        numbers = {kind: int(count) for count, kind in re.findall(r'(\d+) (passed|failed|error)', said)}
        failed = re.findall(r'^(?:FAILED|ERROR) (\S+)', said, re.MULTILINE)
        if not numbers:
            failed = [said[-300:]]
        return Outcome(sum(numbers.values()), failed)

    return run


def crashes(count: int) -> Outcome:
    """Kill so many recordings with each storage."""
    import tempfile
    from contextlib import redirect_stdout
    from io import StringIO

    sys.path.insert(0, str(TEST / 'benchmark'))
    from crash import ALLOWED_LOSS, STORAGES, measure

    losses: list[float] = []
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(StringIO()):
        for storage in STORAGES:
            losses += [loss for _, loss, _ in measure(count, storage, Path(folder))]
    violations = [f'{loss:.2f} s are lost' for loss in losses if loss > ALLOWED_LOSS]
    return Outcome(len(losses), violations, f'lost: {spread(losses, "s")}')


PROMISES = (
    Promise(
        'explored',
        """Whatever is lost, late, repeated, corrupted or killed: the robot stops when odometry or
        commands are missing, within the limits of speed, with finite poses; the protocol of goals
        holds, no command follows a cancellation, send_goal reports what is true, and once the faults
        have ended the next goal is reached.""",
        """Exploration in lockstep: robot, bridge, controller and send_goal under up to four random
        faults, two scenarios (`test/exploration/explored_nodes.py`).""",
        'worlds',
        campaign('explored_nodes'),
        5000,
        50,
    ),
    Promise(
        'ends',
        """Every program exits within 1 s of SIGINT, SIGTERM or SIGHUP, with the documented exit code,
        and without a traceback or temporary files. Nodes publish a last zero. Only record_run may wait
        longer: after a burst, for late messages (doc/bags.md).""",
        """Each program: at a random time of its start, while it runs, flooded, with callbacks
        of 50 ms, by two signals. The time in which its main thread waits for a core does not count.
        Before its first line only Python's own handlers are there. `drive_to` is tried with `--no-plot`:
        otherwise it first draws what was driven, for about 1.6 s of CPU.""",
        'ends',
        campaign('process_faults.ends'),
        50,
        2,
    ),
    Promise(
        'stopped',
        """If robot, bridge or controller is killed or stopped while they drive, the others command and
        drive nothing after their timeout of 0.5 s. When it is back, the robot arrives.""",
        """SIGKILL and a new start, or SIGSTOP and SIGCONT, at random times, three processes. 0.3 s are
        allowed for what other processes delay.""",
        'faults',
        campaign('process_faults.stopped'),
        120,
        6,
    ),
    Promise(
        'hostile',
        """No message makes a program end, publish a number that is not finite, grow by more than 5 MB,
        or log control characters or without bound. Afterwards it works.""",
        """Damaged messages at each input: NaN, infinity, lengths up to 2^32, bits flipped, cut off,
        other encapsulations, random bytes, long texts.""",
        'messages',
        campaign('process_faults.hostile'),
        100000,
        1000,
    ),
    Promise(
        'parameters',
        """Each value of each parameter is either accepted and in use, or refused with a clear reason.
        The node stays alive, and what it publishes finite.""",
        """Values from the declaration: limits, their neighbours, beyond, other types; singly and
        together; at run time through the services, and at the start.""",
        'settings',
        campaign('process_faults.fuzzed_parameters'),
        30000,
        300,
    ),
    Promise(
        'clocks',
        """Whatever happens to a simulated clock: nodes stay alive, publish finite numbers, and once it
        runs evenly the robot arrives.""",
        """It jumps, goes back, begins at 0, stands still, is silent, runs fast, two of them disagree,
        implausible times.""",
        'events',
        campaign('process_faults.clocks'),
        210,
        7,
    ),
    Promise(
        'recording',
        """record_run saves all that it has recorded, in order and without a gap, or says why not with
        exit code 1.""",
        """A disk that is full, slow, fails, becomes read-only; folders that are removed or renamed;
        limits of quota, file size, descriptors and memory; MCAP and SQLite.""",
        'recordings',
        campaign('process_faults.recording'),
        12,
        1,
    ),
    Promise(
        'crashes',
        """A recorder that is killed loses at most 1 s, and nothing that is recovered is wrong.""",
        """SIGKILL at random times, compared byte by byte with what another subscriber received.""",
        'kills',
        crashes,
        20,
        2,
    ),
    Promise(
        'soak',
        """Nodes that run for long under faults stay alive, their memory within 5 MB of that after a
        minute, with no unexpected line in the log, and reach a goal at the end.""",
        """Two teams and the live page, a fault every 3 s: stopped, killed, restarted, flooded, hostile
        messages, parameters, goals, placements, driving by hand.""",
        'faults',
        campaign('process_faults.soak'),
        60,
        1,
    ),
    Promise(
        'bags',
        """A bag of unknown origin gives a clear error or is read, in bounded memory, and nothing in it
        is executed or written elsewhere.""",
        """Tests with bags that are truncated, mutated, compressed bombs, with endless YAML, paths that
        leave the folder, lengths of 2^63, hostile SQLite schemas.""",
        'tests',
        tests(*BAG_TESTS),
        1,
        1,
    ),
    Promise(
        'texts',
        """Texts of others are printed with their control characters escaped, and are no formulas in CSV
        files.""",
        """Tests of all that prints or writes such texts.""",
        'tests',
        tests('tools/test_text.py', 'bags/test_csv_cells.py', 'nodes/test_bounded_logs.py'),
        1,
        1,
    ),
)
"""The rows in their order."""


def run(promise: Promise, count: int) -> dict[str, object]:
    """Try a promise; return the result for the file."""
    begun = time.monotonic()
    outcome = promise.run(count)
    return {
        'count': outcome.count,
        'violations': outcome.violations,
        'measured': outcome.measured,
        'seconds': round(time.monotonic() - begun),
        'date': date.today().isoformat(),
    }


def page(results: dict[str, dict[str, object]]) -> str:
    """Return the page with the results."""
    lines, details = [HEAD.rstrip('\n')], []
    for promise in PROMISES:
        found = results.get(promise.name)
        if found is None:
            continue
        violations = [str(one) for one in found['violations']]  # type: ignore[attr-defined]
        result = f'**{len(violations)} broke it**' if violations else 'kept'
        measured = f'; {found["measured"]}' if found['measured'] else ''
        count = f'{found["count"]:,} {promise.unit}, {found["date"]}'
        text, how = (' '.join(one.split()) for one in (promise.text, promise.how))
        lines.append(f'| {text} | {how} | {count} | {result}{measured} |')
        if violations:
            details += ['', f'## What broke {promise.name}', '']
            details += [f'- `{one.replace("`", chr(39))}`' for one in violations[:MOST_LISTED]]
            if len(violations) > MOST_LISTED:
                details.append(f'- and {len(violations) - MOST_LISTED} more')
    return '\n'.join([*lines, *details]) + '\n'


def stored() -> dict[str, dict[str, object]]:
    found: dict[str, dict[str, object]] = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    return found


def main() -> int:
    names = [promise.name for promise in PROMISES]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument('what', nargs='?', choices=['run'])
    parser.add_argument('names', nargs='*', metavar='NAME', help=f'some of {", ".join(names)}')
    parser.add_argument('--quick', action='store_true', help='few cases each')
    parser.add_argument('--count', type=int, help='number of cases of each (default: as for the table)')
    options = parser.parse_args()
    if unknown := sorted(set(options.names) - set(names)):
        parser.error(f'NAME must be one of {", ".join(names)}, got {unknown[0]!r}')
    broken = 0
    if options.what == 'run':
        os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
        os.nice(NICE)
        for promise in PROMISES:
            if options.names and promise.name not in options.names:
                continue
            count = options.count or (promise.quick if options.quick else promise.full)
            print(f'{promise.name}: {" ".join(promise.text.split())}', flush=True)
            found = run(promise, count)
            broken += len(found['violations'])  # type: ignore[arg-type]
            print(f'  {found}', flush=True)
            # Another one may run at the same time.
            RESULTS.write_text(json.dumps({**stored(), promise.name: found}, indent=2) + '\n')
    PAGE.write_text(page(stored()))
    return 1 if broken else 0


if __name__ == '__main__':
    sys.exit(main())
