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

"""Mutation testing: which changes of the program do the tests notice?

    pip install coverage
    python test/mutants/mutants.py [--package NAME] [--tests FOLDER ...] [--write]

runs the mutants of `mutants.json`, see `mutation`, and compares the results with those stored there. A
mutant runs in a fork of this process, which has imported the libraries but nothing of the package. In
the fork one module is compiled from the changed source. The tests that execute the changed statement
run until one fails, those first that take little time and execute little else.

Which test executes which lines is measured once for each test file, with the unchanged program, and is
kept in `build/mutants`. Tests that do not pass then are left out. What runs in other processes is not
seen. Limits are CPU times, so that a busy machine does not change the results.
"""

from __future__ import annotations

import argparse
import ast
import faulthandler
import gc
import hashlib
import importlib
import itertools
import json
import os
import pickle
import resource
import shutil
import signal
import sys
import tempfile
import time
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields
from functools import partial
from importlib.machinery import SourceFileLoader
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from mutation import Mutant, Place, Statements, mutated

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT / 'diffdrive_jacobian'
STORED = Path(__file__).with_name('mutants.json')
CACHE = ROOT / 'build' / 'mutants'
PACKAGES = (
    *('kinematics', 'control', 'simulation', 'calibration'),
    *('messages', 'lockstep', 'bags', 'recording'),
    *('nodes', 'ros', 'parameters', 'numerics', 'properties', 'faults', 'exploration', 'testing'),
    'robot_testing',
    *('tools', 'live', 'plots', 'relations', 'diagnosis', 'drives'),
    *('grading', 'exercises'),
)
LEFT_OUT = {
    *('test_documents', 'test_explored_nodes', 'test_fastdds_profiles'),
    *('test_live_browser', 'test_mutants', 'test_pages', 'test_process_faults', 'test_processes'),
    *('test_real_time', 'test_recover_crash', 'test_signals', 'test_startup'),
}
"""Test files that mainly start processes or take minutes."""
IMPORTED = (
    *('numpy', 'hypothesis', 'rclpy.executors', 'rclpy.node', 'rclpy.experimental', 'rich.progress'),
    *('rosbags.rosbag2', 'rosbags.typesys.stores.ros2_jazzy', 'ruamel.yaml', 'apsw', 'lz4.frame'),
    *('geometry_msgs.msg', 'nav_msgs.msg', 'sensor_msgs.msg', 'action_msgs.msg', 'std_srvs.srv'),
)
"""What most tests import, apart from the package."""
FIRST_FILES, FIRST_CPU = 3, 3.0
"""Number of test files that run first, and CPU time of their tests (s). Most mutants fail there."""
CPU = 12.0
"""CPU time of the tests that follow (s)."""
SLOWER, GRACE = 10.0, 5.0
"""A test may take this many times the CPU time that it usually takes, and so many seconds more."""
HANGING, WALL = 120.0, 1200.0
"""Wall time that a test may take in addition, and that a fork may take (s)."""
MEMORY = 4 << 30
"""Memory that a fork may use (bytes)."""
RESULTS = ('killed', 'timeout', 'survived', 'untested', 'gone')
"""What becomes of a mutant. Untested: no test executes it."""
AT_IMPORT = ''
"""Stands for the tests of lines that are executed before any test."""


# --- Forks


class Done(NamedTuple):
    """What was called in a fork and has ended."""

    key: Any
    result: Any
    """What it returned. None: it was killed."""
    signal: int
    """The signal that killed it, negative, or the exit code."""
    under_way: str
    """Test that was under way."""
    cpu: float


def forked(calls: Iterable[tuple[Any, Callable[[Path], Any]]], workers: int) -> Iterator[Done]:
    """Call functions in forks of this process, with a directory each; some run at the same time."""
    waiting = iter(calls)
    running: dict[int, tuple[Any, Path, float]] = {}
    while True:
        while len(running) < workers and (call := next(waiting, None)):
            directory = Path(tempfile.mkdtemp(prefix='mutant-'))
            (directory / 'under_way').touch()
            sys.stdout.flush()
            with warnings.catch_warnings():
                # A library of rclpy runs threads, which a fork does not need.
                warnings.simplefilter('ignore', DeprecationWarning)
                pid = os.fork()
            if pid == 0:
                _in_fork(call[1], directory)
            running[pid] = (call[0], directory, time.monotonic() + WALL)
        if not running:
            return
        for pid, (key, directory, deadline) in list(running.items()):
            ended, status, usage = os.wait4(pid, os.WNOHANG)
            if ended:
                del running[pid]
                with suppress(ProcessLookupError):
                    # Processes that the tests have left.
                    os.killpg(pid, signal.SIGKILL)
                result = directory / 'result'
                value = pickle.loads(result.read_bytes()) if result.exists() else None
                code = os.waitstatus_to_exitcode(status)
                under_way = (directory / 'under_way').read_text()
                shutil.rmtree(directory, ignore_errors=True)
                yield Done(key, value, code, under_way, usage.ru_utime + usage.ru_stime)
            elif time.monotonic() > deadline:
                os.kill(pid, signal.SIGKILL)
        time.sleep(0.02)


def _in_fork(call: Callable[[Path], Any], directory: Path) -> None:
    try:
        os.setsid()
        log = os.open(directory / 'log', os.O_WRONLY | os.O_CREAT)
        os.dup2(log, 1)
        os.dup2(log, 2)
        os.chdir(ROOT)
        os.environ['TMPDIR'] = tempfile.tempdir = str(directory)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
        result = pickle.dumps(call(directory))
        (directory / 'result').write_bytes(result)
    finally:
        # Without the exit handlers of this process.
        os._exit(0)


# --- Tests


class Plugin:
    """Runs chosen tests in their order, within limits, and keeps which did not pass."""

    def __init__(self, directory: Path, chosen: Mapping[str, float] | None) -> None:
        """Create it, with the names of tests and their CPU times (s), or with None for all tests."""
        self.not_passed: list[str] = []
        self.cpu: dict[str, float] = {}
        self.before = lambda name: None
        self._chosen = chosen
        self._order = {name: place for place, name in enumerate(chosen or ())}
        self._under_way = directory / 'under_way'
        self._limit('collection', GRACE)

    def _limit(self, name: str, cpu: float) -> None:
        self._under_way.write_text(name)
        if self._chosen is not None:
            signal.setitimer(signal.ITIMER_PROF, SLOWER * cpu + GRACE)
            faulthandler.dump_traceback_later(SLOWER * cpu + HANGING, exit=True)

    @pytest.hookimpl(hookwrapper=True, tryfirst=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> Iterator[None]:
        yield
        if self._chosen is not None:
            items[:] = [item for item in items if item.nodeid in self._order]
            items.sort(key=lambda item: self._order[item.nodeid])

    @pytest.hookimpl(hookwrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        self._limit(item.nodeid, (self._chosen or {}).get(item.nodeid, 0.0))
        self.before(item.nodeid)
        begin = time.process_time()
        yield
        self.cpu[item.nodeid] = time.process_time() - begin

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if not report.passed:
            self.not_passed.append(report.nodeid)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.failed:
            self.not_passed.append(f'collection of {report.nodeid}')


def run_tests(files: Iterable[str], plugin: Plugin, directory: Path) -> int:
    """Run the tests of some files in this process, until one fails if they were chosen."""
    from hypothesis import settings

    settings.register_profile('mutants', derandomize=True, database=None, deadline=None)
    settings.load_profile('mutants')
    # What the tests of this process have left behind cannot always be freed in a fork.
    gc.freeze()
    os.environ.pop('PYTEST_ADDOPTS', None)
    # Assertions are not rewritten: for that pytest would load the modules itself.
    options = ['-q', '--tb=no', '--assert=plain', '-p', 'no:cacheprovider', '-p', 'no:xdist']
    places = [f'--rootdir={ROOT}', f'--basetemp={directory / "tests"}']
    return pytest.main([*options, *places, *files], plugins=[plugin])


def _file(test: str) -> str:
    return test.partition('::')[0]


# --- Which test executes which lines


class Measured(NamedTuple):
    """What is known of a test file."""

    cpu: dict[str, float]
    """CPU time of each test (s)."""
    not_passed: list[str]
    lines: dict[str, dict[int, list[str]]]
    """The tests that execute each line of each file, or AT_IMPORT."""


@dataclass
class Coverage:
    """What is known of all test files."""

    cpu: dict[str, float] = field(default_factory=dict)
    size: Counter[str] = field(default_factory=Counter)
    """Number of lines that each test executes."""
    lines: dict[str, dict[int, list[str]]] = field(default_factory=lambda: defaultdict(dict))

    def add(self, measured: Measured) -> None:
        """Add what is known of one test file."""
        self.cpu.update(measured.cpu)
        for file, lines in measured.lines.items():
            for line, tests in lines.items():
                passed = [test for test in tests if test not in measured.not_passed]
                self.lines[file].setdefault(line, []).extend(passed)
                self.size.update(passed)

    def tests(self, place: Place) -> list[str]:
        """Return the tests that execute a statement, then those that use what it does at the import."""
        lines = self.lines[place.file]
        found = {test for line in place.lines for test in lines.get(line, ())}
        groups = [found - {AT_IMPORT}]
        if place.at_import:
            # A test that is the first to import the module may have nothing else to do with it.
            groups = [*self._of_users(place.file), *groups]
        elif AT_IMPORT in found:
            groups = [*groups, *self._of_users(place.file)]
        return list(dict.fromkeys(test for group in groups for test in self._ordered(group)))

    def _ordered(self, tests: set[str]) -> list[str]:
        """Return short and specific tests first, and some cases of each test before the others."""
        cost = {test: (self.cpu[test] * self.size[test], test) for test in tests}
        cases: dict[str, list[str]] = defaultdict(list)
        for test in sorted(tests, key=cost.__getitem__):
            cases[test.partition('[')[0]].append(test)
        rank = {test: i.bit_length() for same in cases.values() for i, test in enumerate(same)}
        return sorted(tests, key=lambda test: (rank[test], cost[test]))

    def _of_users(self, file: str) -> tuple[set[str], set[str]]:
        """Return the tests in files that import a module, and those that execute its importers."""
        module = f'{SOURCE.name}/{file}'.removesuffix('.py').replace('/', '.')
        files = {
            str(path.relative_to(ROOT))
            for path in (ROOT / 'test').rglob('*.py')
            if module in path.read_text()
        }
        users = {file, *(user for user in self.lines if module in (SOURCE / user).read_text())}
        lines = (tests for user in users for tests in self.lines[user].values())
        executing = set(itertools.chain.from_iterable(lines)) - {AT_IMPORT}
        return {test for test in self.cpu if _file(test) in files}, executing

    def rounds(self, tests: list[str], cpu: float) -> Iterator[dict[str, float]]:
        """Return which tests to run first, of few files, and which afterwards, with their CPU times."""
        files = list(dict.fromkeys(map(_file, tests)))[:FIRST_FILES]
        first = self._within(FIRST_CPU, [test for test in tests if _file(test) in files])
        yield first
        yield self._within(cpu, [test for test in tests if test not in first])

    def _within(self, limit: float, tests: list[str]) -> dict[str, float]:
        begin = itertools.accumulate((self.cpu[test] for test in tests), initial=0.0)
        return {
            test: self.cpu[test] for test, so_far in zip(tests, begin, strict=False) if so_far < limit
        }


def measure(file: str, directory: Path) -> Measured:
    """Run the tests of a file in this process, and find out which lines they execute."""
    from coverage import Coverage as Tracer

    include = [f'{SOURCE}/{package}/*' for package in PACKAGES]
    tracer = Tracer(data_file=None, config_file=False, include=include)
    plugin = Plugin(directory, None)
    plugin.before = tracer.switch_context
    tracer.start()
    run_tests([file], plugin, directory)
    tracer.stop()
    data = tracer.get_data()
    lines = {
        os.path.relpath(path, SOURCE): data.contexts_by_lineno(path) for path in data.measured_files()
    }
    return Measured(plugin.cpu, plugin.not_passed, lines)


def measured_coverage(workers: int, folders: Iterable[str] = ('test',)) -> Coverage:
    """Measure test files that have changed, or all if the program has; returns what is known of all."""
    folder = CACHE / _digest(
        path
        for path in (*SOURCE.rglob('*.py'), *(ROOT / 'test').rglob('*.py'))
        if not path.name.startswith(('test_', 'mutants', 'mutation'))
    )
    folder.mkdir(parents=True, exist_ok=True)
    found = {path for name in folders for path in (ROOT / name).rglob('test_*.py')}
    tests = [path for path in sorted(found) if path.stem not in LEFT_OUT]
    kept = {str(path.relative_to(ROOT)): folder / f'{path.stem}.{_digest([path])}' for path in tests}
    calls = [(file, partial(measure, file)) for file, path in kept.items() if not path.exists()]
    for number, done in enumerate(forked(calls, workers), 1):
        result = done.result or Measured({}, [done.under_way], {})
        kept[done.key].write_bytes(pickle.dumps(tuple(result)))
        print(f'{number}/{len(calls)} {done.key}: {len(result.cpu)} tests, {done.cpu:.0f} s', flush=True)
        for test in result.not_passed:
            print(f'    left out: {test}')
    coverage = Coverage()
    for path in kept.values():
        coverage.add(Measured(*pickle.loads(path.read_bytes())))
    return coverage


def _digest(files: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for file in sorted(files):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


# --- Mutants


class Outcome(NamedTuple):
    """What became of a mutant."""

    result: str
    by: str = ''
    """The test that failed, or that was under way when the time was over."""
    cpu: float = 0.0
    capped: bool = False
    """Whether it survived some tests, and there was no time for the others."""


def run_mutant(mutant: Mutant, place: Place, rounds: list[Mapping[str, float]], directory: Path) -> str:
    """Run tests in this process with a changed module, until one fails; returns its name, or nothing."""
    path = SOURCE / place.file
    tree = ast.parse(path.read_text())
    here = Statements({place.file: tree}).find(mutant)
    assert here is not None
    changed = compile(mutated(tree, here, mutant), path, 'exec', dont_inherit=True)
    get_code = SourceFileLoader.get_code

    def get_changed_code(loader: SourceFileLoader, name: str) -> Any:
        return changed if Path(loader.path) == path else get_code(loader, name)

    SourceFileLoader.get_code = get_changed_code  # type: ignore[method-assign]
    for chosen in rounds:
        plugin = Plugin(directory, chosen)
        try:
            code = run_tests(['-x', *dict.fromkeys(map(_file, chosen))], plugin, directory)
        except BaseException as error:
            return f'import: {error!r}'
        if plugin.not_passed or code not in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED):
            return next(iter(plugin.not_passed), f'pytest: {code!r}')
    return ''


def run_mutants(
    mutants: list[Mutant], coverage: Coverage, workers: int, cpu: float = CPU
) -> Iterator[tuple[Mutant, Outcome]]:
    """Run mutants and return what became of each, in the order in which they end."""
    without: dict[Mutant, Outcome] = {}
    capped = set()

    def calls() -> Iterator[tuple[Mutant, Callable[[Path], str]]]:
        for package, group in itertools.groupby(mutants, key=lambda mutant: mutant.package):
            statements = Statements(parsed(package))
            for mutant in group:
                place = statements.find(mutant)
                tests = coverage.tests(place) if place else []
                if place and tests:
                    rounds = [chosen for chosen in coverage.rounds(tests, cpu) if chosen]
                    if sum(map(len, rounds)) < len(tests):
                        capped.add(mutant)
                    yield mutant, partial(run_mutant, mutant, place, rounds)
                else:
                    without[mutant] = Outcome('untested' if place else 'gone')

    for done in forked(calls(), workers):
        if done.result is not None:
            result = 'killed' if done.result else 'survived'
            yield (
                done.key,
                Outcome(result, done.result, done.cpu, not done.result and done.key in capped),
            )
        else:
            timeout = done.signal in (1, -signal.SIGPROF, -signal.SIGKILL)
            yield done.key, Outcome('timeout' if timeout else 'killed', done.under_way, done.cpu)
    yield from without.items()


def parsed(package: str) -> dict[str, ast.Module]:
    """Return the modules of a package by their files."""
    files = sorted((SOURCE / package).rglob('*.py'))
    return {str(file.relative_to(SOURCE)): ast.parse(file.read_text()) for file in files}


# --- The command


def read(path: Path) -> dict[Mutant, dict[str, str]]:
    """Return the mutants of a file, and what is stored of each."""
    rows = json.loads(path.read_text()) if path.exists() else []
    return {Mutant(*(row.pop(name.name) for name in fields(Mutant))): row for row in rows}


def write(path: Path, stored: Mapping[Mutant, Mapping[str, str]]) -> None:
    """Write mutants and what is known of each, one in a line."""
    rows = [json.dumps({**asdict(mutant), **stored[mutant]}) for mutant in sorted(stored)]
    path.write_text('[\n' + ',\n'.join(rows) + '\n]\n')


def summary(
    stored: Mapping[Mutant, Mapping[str, str]], outcomes: Mapping[Mutant, Outcome]
) -> Iterator[str]:
    """Return the lines of a table of results, the stored ones in parentheses, and what got worse."""
    yield 'package'.ljust(12) + ''.join(result.rjust(14) for result in RESULTS)
    for package in (*PACKAGES, 'all'):
        mutants = [mutant for mutant in outcomes if package in (mutant.package, 'all')]
        now = Counter(outcomes[mutant].result for mutant in mutants)
        before = Counter(stored[mutant].get('result') for mutant in mutants)
        if mutants:
            cells = (f'{now[result]} ({before[result]})' for result in RESULTS)
            yield package.ljust(12) + ''.join(cell.rjust(14) for cell in cells)
    for mutant, outcome in sorted(outcomes.items()):
        noticed = stored[mutant].get('result') in ('killed', 'timeout')
        if noticed and outcome.result in ('survived', 'untested'):
            yield f'no longer noticed: {mutant}'


def positive(text: str) -> int:
    """Return a number of the command line."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f'must be a whole number from 1 on, got {text}')
    return int(text)


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description='Change the program and see whether the tests notice.')
    parser.add_argument('--package', action='append', choices=PACKAGES, help='only this package')
    parser.add_argument(
        '--result', action='append', choices=RESULTS, help='only with this stored result'
    )
    parser.add_argument(
        '--sample', type=positive, metavar='N', help='N random mutants; with --write they replace those'
    )
    parser.add_argument(
        '--tests', nargs='+', default=['test'], metavar='FOLDER', help='only the tests of these folders'
    )
    parser.add_argument('--seed', type=int, default=1, help='of the random ones (default: 1)')
    parser.add_argument('--workers', type=positive, default=os.cpu_count(), help='number of processes')
    parser.add_argument('--cpu', type=float, default=CPU, help='CPU time of the tests of a mutant (s)')
    parser.add_argument('--write', action='store_true', help='store the results')
    options = parser.parse_args()
    if not options.cpu > 0.0:
        parser.error(f'argument --cpu: must be positive, got {options.cpu:g}')
    packages = options.package or PACKAGES
    stored = read(STORED)
    if options.sample:
        stored = {mutant: row for mutant, row in stored.items() if mutant.package not in packages}
        for package in packages:
            drawn = Statements(parsed(package)).sample(package, options.sample, options.seed)
            stored.update((mutant, {}) for mutant in drawn)
        if options.write:
            write(STORED, stored)
    results = options.result or [*RESULTS, None]
    mutants = [
        mutant
        for package in packages
        for mutant in sorted(stored)
        if mutant.package == package and stored[mutant].get('result') in results
    ]
    # As conftest.py does before rclpy is loaded.
    os.environ.update(ROS_AUTOMATIC_DISCOVERY_RANGE='OFF', ROS_PYTHON_CHECK_FIELDS='1')
    for name in IMPORTED:
        importlib.import_module(name)
    coverage = measured_coverage(options.workers, options.tests)
    outcomes: dict[Mutant, Outcome] = {}
    begin = time.monotonic()
    try:
        for mutant, outcome in run_mutants(mutants, coverage, options.workers, options.cpu):
            outcomes[mutant] = outcome
            change = f'{mutant.function}: {mutant.statement} -> {mutant.mutant}'
            print(f'{outcome.result} ({outcome.cpu:.1f} s) {mutant.file} {change}', flush=True)
    finally:
        print('\n'.join(summary(stored, outcomes)))
        cpu = sum(outcome.cpu for outcome in outcomes.values())
        capped = sum(outcome.capped for outcome in outcomes.values())
        print(f'{cpu:.0f} s of CPU, {time.monotonic() - begin:.0f} s; {capped} survivors capped')
        if options.write:
            for mutant, outcome in outcomes.items():
                stored[mutant].update(result=outcome.result, by=outcome.by)
            write(STORED, stored)


if __name__ == '__main__':
    main()
