"""Fixtures for pytest: `pytest_plugins = ['diffdrive_jacobian.testing.fixtures']` in a conftest.py.

`lockstep` is a new `Lockstep` for each test. `robot_at(x, y, theta)` adds a virtual robot to it.
`recorded_run` records the test as a bag and a figure, which are kept if it fails. The marker
`lockstep(args=..., start=..., patience=...)` passes arguments to `Lockstep`. The report of a failed test
ends with the last messages of all topics.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from rclpy.parameter import Parameter

from diffdrive_jacobian.lockstep import Lockstep, LockstepError
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.parameters.declaration import specifications
from diffdrive_jacobian.parameters.nodes import VirtualRobotParameters
from diffdrive_jacobian.plots.run_figure import draw
from diffdrive_jacobian.reading import BagError, read_run
from diffdrive_jacobian.recording.recorder import Recorder, Selection
from diffdrive_jacobian.recording.recording import Recording, RecordingError


def pytest_configure(config: pytest.Config) -> None:
    """Register the marker."""
    config.addinivalue_line(
        'markers', 'lockstep(args, start, patience): arguments of the Lockstep of this test'
    )


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    """Add the last messages to the report of a failure that does not contain them itself."""
    outcome: Any = yield
    report = outcome.get_result()
    world = getattr(item, 'funcargs', {}).get('lockstep')
    contained = call.excinfo is not None and call.excinfo.errisinstance(LockstepError)
    if call.when != 'call' or not report.failed:
        return
    if isinstance(world, Lockstep) and not contained:
        report.sections.append(('lockstep', _or_error(world.report)))
    recorded = getattr(item, 'funcargs', {}).get('recorded_run')
    if isinstance(recorded, RecordedRun):
        report.sections.append(('recorded run', _or_error(recorded.keep)))


def _or_error(describe: Callable[[], str]) -> str:
    """Return a text, or the error instead: an exception in a hook would end the whole session."""
    try:
        return describe()
    except (KeyboardInterrupt, pytest.exit.Exception):
        raise
    except BaseException as error:
        # Also of pytest.fail and pytest.skip, which a timeout of a plugin may raise here.
        return str(error) if isinstance(error, RecordingError) else f'not available: {error!r}'


@pytest.fixture
def lockstep(request: pytest.FixtureRequest) -> Iterator[Lockstep]:
    """Return a Lockstep without nodes."""
    marker = request.node.get_closest_marker('lockstep')
    if marker and marker.args:
        raise TypeError(
            f'the marker lockstep takes args=, start= and patience= only, got {marker.args!r}'
        )
    with Lockstep(**(marker.kwargs if marker else {})) as world:
        yield world


@pytest.fixture
def robot_at(lockstep: Lockstep) -> Callable[..., VirtualRobot]:
    """Return a function that adds a virtual robot with a pose, a namespace and parameters."""

    def place(
        x: float = 0.0, y: float = 0.0, theta: float = 0.0, *, namespace: str = '', **parameters: Any
    ) -> VirtualRobot:
        pose = {'x': float(x), 'y': float(y), 'theta': float(theta)}
        values = {name.replace('__', '.'): value for name, value in {**pose, **parameters}.items()}
        known = specifications(VirtualRobotParameters)
        if unknown := sorted(set(values) - set(known)):
            raise TypeError(f'virtual_robot has no parameter {unknown[0]!r}; it has {", ".join(known)}')
        overrides = [Parameter(name, value=value) for name, value in values.items()]
        return lockstep.add(VirtualRobot(namespace=namespace, parameter_overrides=overrides))

    return place


class RecordedRun:
    """The recording of a test."""

    def __init__(self, world: Lockstep, directory: Path) -> None:
        """Start to record all topics, into a directory."""
        self._recording = Recording(directory / 'run', 'mcap', lossless=True)
        self._finished = False
        self._error: RecordingError | None = None
        self._kept: str | None = None
        recorder = Recorder(Selection(everything=True), self._recording)
        world.add(recorder)
        world.on_new_topics(recorder.discover)
        recorder.discover()

    def keep(self) -> str:
        """End the recording and keep it. Return the paths of the bag and of the figure, in two lines.

        The figure needs odometry and matplotlib. Messages after the first call are not recorded. Later
        calls return or raise the same.

        Raises:
            RecordingError: The recording is not complete.
        """
        if not self._finished:
            self._finished = True
            try:
                self._recording.finish()
            except RecordingError as error:
                self._error = error
        if self._error is not None:
            raise self._error
        if self._kept is None:
            self._kept = self._draw()
        return self._kept

    def _draw(self) -> str:
        bag = self._recording.bag
        picture = bag.with_suffix('.png')
        try:
            draw([read_run(bag)], picture)
        except (BagError, ModuleNotFoundError, OSError) as error:
            return f'{bag}\nnot drawn: {error}'
        return f'{bag}\n{picture}'

    def close(self) -> None:
        """Delete the recording, unless it was kept."""
        if not self._finished:
            self._finished = True
            self._recording.discard()


@pytest.fixture
def recorded_run(lockstep: Lockstep, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RecordedRun]:
    """Record the test. `keep()` writes the bag. A failure of the test does so, too."""
    run = RecordedRun(lockstep, tmp_path_factory.mktemp('recorded'))
    yield run
    run.close()
