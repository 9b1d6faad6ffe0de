"""The recording of a test, which is kept if the test fails."""

from __future__ import annotations

import shutil
from contextlib import suppress
from pathlib import Path

from diffdrive_jacobian.bags import BagError, read_run
from diffdrive_jacobian.bags.files import journal_of
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.messages.topics import Selection
from diffdrive_jacobian.plots.run_figure import draw
from diffdrive_jacobian.recording.recorder import Recorder
from diffdrive_jacobian.recording.recording import Recording, RecordingError

BAG = 'run'
"""Name of the bag in the directory of a test."""


class RecordedRun:
    """The recording of a test."""

    def __init__(self, world: Lockstep, directory: Path) -> None:
        """Start to record all topics, as the bag `run` in a directory.

        What an earlier run of the test left in the directory is replaced. Messages are recorded with
        world time, so that their order remains where the clock of the nodes jumps back.

        Raises:
            OSError: It cannot be written there.
        """
        self._directory = directory
        bag = directory / BAG
        directory.mkdir(parents=True, exist_ok=True)
        for old in (journal_of(bag), _figure_of(bag)):
            old.unlink(missing_ok=True)
        self._recording = Recording(bag, 'mcap', lossless=True, replace=True)
        if bag.exists():
            # A bag, as the recording has checked.
            shutil.rmtree(bag)
        self._finished = False
        self._error: RecordingError | None = None
        self._kept: str | None = None
        offset = world.now - world.world_time
        recorder = Recorder(
            Selection(everything=True), self._recording, now=lambda: offset + world.world_time
        )
        world.add(recorder, observer=True)
        world.on_new_topics(recorder.discover)
        recorder.discover()

    @property
    def bag(self) -> Path:
        """The directory of the bag. It exists after `finish`."""
        return self._recording.bag

    def finish(self) -> Path:
        """End the recording and write the bag. Return its directory.

        It is deleted at the end of the test, unless it is kept. Messages after the first call are not
        recorded. Later calls return or raise the same.

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
        return self.bag

    def keep(self) -> str:
        """End the recording and keep it. Return the paths of the bag and of the figure, in two lines.

        The figure needs odometry and matplotlib. Messages after the first call are not recorded. Later
        calls return or raise the same.

        Raises:
            RecordingError: The recording is not complete.
        """
        self.finish()
        if self._kept is None:
            self._kept = self._draw()
        return self._kept

    def _draw(self) -> str:
        picture = _figure_of(self.bag)
        try:
            draw([read_run(self.bag)], picture)
        except (BagError, ModuleNotFoundError, OSError) as error:
            return f'{self.bag}\nnot drawn: {error}'
        return f'{self.bag}\n{picture}'

    def close(self) -> None:
        """Delete the recording, unless it was kept or is not complete."""
        if not self._finished:
            self._finished = True
            self._recording.discard()
        elif self._kept is None and self._error is None:
            shutil.rmtree(self.bag, ignore_errors=True)
        with suppress(OSError):
            # Only if it is empty.
            self._directory.rmdir()


def _figure_of(bag: Path) -> Path:
    return bag.with_name(bag.name + '.png')
