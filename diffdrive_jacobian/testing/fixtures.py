"""Fixtures of pytest: `pytest_plugins = ['diffdrive_jacobian.testing.fixtures']` in a conftest.py.

`lockstep` is a world of its own for each test, `robot_at(x, y, theta)` puts the virtual robot into it,
`recorded_run` records it, as a bag and a picture that are kept where the test fails.
The marker `lockstep(args=..., start=..., patience=...)` makes the world with these arguments. The report
of a test that fails ends with the last messages of every topic.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from rclpy.parameter import Parameter

from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.parameters.declaration import specifications
from diffdrive_jacobian.parameters.nodes import VirtualRobotParameters
from diffdrive_jacobian.plots.run_figure import draw
from diffdrive_jacobian.reading import BagError, read_run
from diffdrive_jacobian.recording.recorder import Recorder, Selection
from diffdrive_jacobian.recording.recording import Recording, RecordingError
from diffdrive_jacobian.testing import Lockstep, LockstepError


def pytest_configure(config: pytest.Config) -> None:
    """Register the marker."""
    config.addinivalue_line(
        'markers', 'lockstep(args, start, patience): make the world of this test so (see Lockstep)'
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
    """Return a text, or the error that prevents it: what a hook raises ends the whole session."""
    try:
        return describe()
    except Exception as error:
        return str(error) if isinstance(error, RecordingError) else f'not available: {error!r}'


@pytest.fixture
def lockstep(request: pytest.FixtureRequest) -> Iterator[Lockstep]:
    """A world without nodes."""
    marker = request.node.get_closest_marker('lockstep')
    with Lockstep(**(marker.kwargs if marker else {})) as world:
        yield world


@pytest.fixture
def robot_at(lockstep: Lockstep) -> Callable[..., VirtualRobot]:
    """Put virtual robots into the world: `robot_at(x, y, theta, namespace='', **parameters)`."""

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
        """Record all topics of a world from here on, into a directory."""
        self._recording = Recording(directory / 'run', 'mcap', lossless=True)
        self._finished = False
        self._error: RecordingError | None = None
        self._kept: str | None = None
        recorder = Recorder(Selection(everything=True), self._recording)
        world.add(recorder)
        world.on_new_topics(recorder.discover)
        recorder.discover()

    def keep(self) -> str:
        """End the recording and keep it; return where it is, in two lines.

        That makes the bag and, where there is odometry and matplotlib, the picture. What is published
        after the first call is not recorded; later calls return or raise the same.

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
        """Remove it, unless it was kept."""
        if not self._finished:
            self._finished = True
            self._recording.discard()


@pytest.fixture
def recorded_run(lockstep: Lockstep, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RecordedRun]:
    """Record the test; `keep()` makes the bag, a failure does so by itself."""
    run = RecordedRun(lockstep, tmp_path_factory.mktemp('recorded'))
    yield run
    run.close()
