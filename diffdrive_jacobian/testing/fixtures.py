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

"""The plugin of pytest. It is loaded by its entry point, wherever this package is installed.

`lockstep` is a new `Lockstep` for each test. `recorded_run` records the test as a bag and a figure that
are kept if it fails. `golden_run` compares the test with a recorded run. The marker `lockstep(args=...,
start=..., patience=...)` passes arguments to `Lockstep`. The report of a failed test ends with the last
messages of all topics.

pytest loads this module in every project. Until a fixture is used it imports neither rclpy nor NumPy and
leaves the environment as it is.
"""

from __future__ import annotations

import hashlib
import importlib
import re
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from diffdrive_jacobian.lockstep.world import Lockstep
    from diffdrive_jacobian.testing.recorded_run import GoldenRun, RecordedRun

MAX_LENGTH = 120
"""Length of the longest name. A name in a directory can have 255 bytes."""


def artifact_name(nodeid: str) -> str:
    """Return a name for the files of a test: `dir/test_a.py::Test::test_b[1.0-x]` is
    `dir.test_a.Test.test_b-1.0-x`.

    It has only letters, digits and `_ . + -`, so that shells and archives accept it. Different tests
    have different names: where something else had to be replaced, a part of a hash follows.
    """
    place, _, tests = nodeid.partition('::')
    path = re.sub(r'\.py$', '', place).replace('/', '.')
    function, bracket, parameters = tests.partition('[')
    name = path + (f'.{function.replace("::", ".")}' if function else '')
    if bracket:
        name += f'-{parameters.removesuffix("]")}'
    safe = re.sub(r'[^A-Za-z0-9_.+-]+', '_', name).lstrip('.-')
    if safe == name and len(safe) <= MAX_LENGTH:
        return safe
    digest = hashlib.sha256(nodeid.encode(errors='surrogateescape')).hexdigest()[:8]
    return f'{safe[: MAX_LENGTH - 9]}-{digest}'


def name_beside_the_file(nodeid: str) -> str:
    """Return a name for the files of a test in the directory of its module, without the directories."""
    place, separator, tests = nodeid.partition('::')
    return artifact_name(place.rpartition('/')[2] + separator + tests)


CHECK_FIELDS = 'ROS_PYTHON_CHECK_FIELDS'
"""Environment variable that each message module reads when it is imported."""
GOLDEN = 'golden'
"""Directory of the golden runs, beside the module of a test."""
WRITTEN = 'golden run written'
"""Property of the report of a test that wrote its golden run."""
_CHECKS_FIELDS = pytest.StashKey[bool]()
_CONTAINED = pytest.StashKey[bool]()
"""Whether the error of a test contains the last messages."""
_FIXTURES = pytest.StashKey[dict[str, Any]]()
"""Fixtures of a test that exist now. Its `funcargs` lack those of a setup that fails."""


# --- Options


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options."""
    group = parser.getgroup('lockstep', 'ROS nodes in lockstep (diffdrive_jacobian)')
    group.addoption(
        '--lockstep-artifacts',
        metavar='DIR',
        help='directory of what recorded_run keeps, DIR/TEST/run and DIR/TEST/run.png '
        '(default: lockstep_artifacts of the configuration file, else --basetemp)',
    )
    group.addoption(
        '--update-golden-runs',
        action='store_true',
        help='make runs the golden ones of golden_run, where there is none or they differ',
    )
    parser.addini('lockstep_artifacts', 'directory of what recorded_run keeps', default='')
    parser.addini(
        'lockstep_check_fields',
        f'whether rclpy checks the types of message fields, as with {CHECK_FIELDS}=1',
        type='bool',
        default=False,
    )


def pytest_load_initial_conftests(early_config: pytest.Config) -> None:
    """Apply `lockstep_check_fields`, before a conftest.py imports messages."""
    _check_fields(early_config)


def pytest_configure(config: pytest.Config) -> None:
    """Register the marker."""
    config.addinivalue_line(
        'markers',
        'lockstep(args, start, patience): arguments of the Lockstep of this test',
    )
    # The hook before is not called for a plugin that a conftest.py loads.
    _check_fields(config)


def _check_fields(config: pytest.Config) -> None:
    """Enable the field checks of message modules until the end of the session, if the option is set."""
    if not config.getini('lockstep_check_fields') or config.stash.get(_CHECKS_FIELDS, False):
        return
    config.stash[_CHECKS_FIELDS] = True
    environment = pytest.MonkeyPatch()
    environment.setenv(CHECK_FIELDS, '1')
    config.add_cleanup(environment.undo)
    unchecked = sorted(
        {
            name.partition('.')[0]
            for name, module in list(sys.modules.items())
            # Not getattr, which may import something.
            if getattr(module, '__dict__', {}).get('ros_python_check_fields', '1') != '1'
        }
    )
    if unchecked:
        config.issue_config_time_warning(
            pytest.PytestConfigWarning(
                'lockstep_check_fields has no effect on message types that were imported before, of '
                f'{", ".join(unchecked)}: set {CHECK_FIELDS}=1 in the environment of pytest instead'
            ),
            stacklevel=2,
        )


# --- Reports


@pytest.hookimpl(trylast=True)
def pytest_runtest_call(item: pytest.Item) -> None:
    """Check the required properties and the golden run of a test that has passed."""
    world, golden = _argument(item, 'lockstep'), _argument(item, 'golden_run')
    if world is None:
        return
    from diffdrive_jacobian.lockstep._errors import LockstepError
    from diffdrive_jacobian.lockstep._report import REPORT
    from diffdrive_jacobian.lockstep.world import Lockstep
    from diffdrive_jacobian.recording.recording import RecordingError
    from diffdrive_jacobian.testing.recorded_run import GoldenRun, GoldenRunError

    try:
        if isinstance(world, Lockstep) and world.is_open:
            world.finish()
        if isinstance(golden, GoldenRun) and not golden.checked:
            golden.check()
        return
    except LockstepError as error:
        item.stash[_CONTAINED] = REPORT in str(error)
        problem = str(error)
    except (GoldenRunError, RecordingError) as error:
        problem = str(error)
    # Without a traceback, which would show pytest only.
    pytest.fail(problem, pytrace=False)


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    """Add the last messages to the report of a failure that does not contain them itself."""
    outcome: Any = yield
    report = outcome.get_result()
    if call.when == 'teardown':
        return
    golden, world = _argument(item, 'golden_run'), _argument(item, 'lockstep')
    if getattr(golden, 'written', False):
        report.user_properties.append((WRITTEN, str(golden.path)))
    if not report.failed or world is None:
        return
    from diffdrive_jacobian.lockstep._errors import LockstepError
    from diffdrive_jacobian.lockstep._report import REPORT
    from diffdrive_jacobian.lockstep.world import Lockstep
    from diffdrive_jacobian.testing.recorded_run import RecordedRun

    error = call.excinfo.value if call.excinfo is not None else None
    contained = isinstance(error, LockstepError) and REPORT in str(error)
    contained = item.stash.get(_CONTAINED, contained)
    if isinstance(world, Lockstep) and not contained:
        report.sections.append(('lockstep', _or_error(world.report)))
    recorded = _argument(item, 'recorded_run')
    if isinstance(recorded, RecordedRun):
        report.sections.append(('recorded run', _or_error(recorded.keep)))


def _argument(item: pytest.Item, name: str) -> Any:
    """Return a fixture of a test, which it may have through another one; None: it has none."""
    existing = item.stash.get(_FIXTURES, None) or {}
    return existing.get(name, getattr(item, 'funcargs', {}).get(name))


def _or_error(describe: Callable[[], str]) -> str:
    """Return a text, or the error instead: an exception in a hook would end the whole session."""
    try:
        return describe()
    except (KeyboardInterrupt, pytest.exit.Exception):
        raise
    except BaseException as error:
        # Also of pytest.fail and pytest.skip, which a timeout of a plugin may raise here.
        complete = type(error).__name__ == 'RecordingError'
        from diffdrive_jacobian.text import error_text

        text = error_text(error)
        return text if complete else f'not available: {type(error).__name__}: {text}'


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """List the golden runs that were written."""
    reports = [one for group in ('passed', 'failed') for one in terminalreporter.stats.get(group, [])]
    written = [
        value
        for report in reports
        for name, value in getattr(report, 'user_properties', ())
        if name == WRITTEN and report.when == 'call'
    ]
    if written:
        terminalreporter.section('golden runs')
        for path in written:
            terminalreporter.write_line(f'written: {path}')


# --- Fixtures


@pytest.fixture
def lockstep(request: pytest.FixtureRequest) -> Iterator[Lockstep]:
    """Return a Lockstep without nodes."""
    marker = request.node.get_closest_marker('lockstep')
    if marker and marker.args:
        raise TypeError(
            f'the marker lockstep takes keyword arguments only, as Lockstep does, got {marker.args!r}'
        )
    try:
        # First, so that the error names it.
        importlib.import_module('rclpy')
        from diffdrive_jacobian.lockstep.world import Lockstep

        with warnings.catch_warnings():
            # Of lark. rclpy imports it with the first message type, within the test.
            warnings.simplefilter('ignore', DeprecationWarning)
            importlib.import_module('rosidl_generator_py')
    except ImportError as error:
        pytest.fail(_remedy(error), pytrace=False)
    with Lockstep(**(marker.kwargs if marker else {})) as world:
        request.node.stash[_FIXTURES] = {'lockstep': world}
        yield world
        del request.node.stash[_FIXTURES]


def _remedy(error: ImportError) -> str:
    return (
        f'the fixture lockstep needs ROS 2, which cannot be imported: {error}\n'
        'source the setup file of a ROS 2 Jazzy installation (. /opt/ros/jazzy/setup.bash), or call '
        "pip install '.[jazzy]' in a clone of diffdrive_jacobian"
    )


@pytest.fixture
def recorded_run(
    lockstep: Lockstep, request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[RecordedRun]:
    """Record the test. `keep()` writes the bag and a figure. A failure of the test does so, too."""
    from diffdrive_jacobian.testing.recorded_run import RecordedRun

    name = artifact_name(request.node.nodeid)
    run = RecordedRun(lockstep, _artifacts(request.config, tmp_path_factory) / name)
    # Nothing if another fixture replaces `lockstep`.
    request.node.stash.get(_FIXTURES, {})['recorded_run'] = run
    yield run
    run.close()


def _artifacts(config: pytest.Config, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the directory of what recorded_run keeps."""
    if given := config.getoption('lockstep_artifacts'):
        return config.invocation_params.dir / str(given)
    if configured := config.getini('lockstep_artifacts'):
        return config.rootpath / str(configured)
    return tmp_path_factory.getbasetemp()


@pytest.fixture
def golden_run(recorded_run: RecordedRun, request: pytest.FixtureRequest) -> GoldenRun:
    """Compare the test with its golden run, when it has passed. `check()` does so with a tolerance."""
    from diffdrive_jacobian.testing.recorded_run import GoldenRun

    test = request.node.nodeid
    path = request.path.parent / GOLDEN / name_beside_the_file(test)
    return GoldenRun(recorded_run, path, test, bool(request.config.getoption('update_golden_runs')))
