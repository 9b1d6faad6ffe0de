"""The smallest case of a finding as a bag and a picture."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from diffdrive_jacobian.bags import BagError, read_run
from diffdrive_jacobian.exploration.trial import Setting, Trial, run
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.plots.fault_marks import ViolationMark
from diffdrive_jacobian.plots.run_figure import draw
from diffdrive_jacobian.recording.recorder import Recorder, Selection
from diffdrive_jacobian.recording.recording import Recording, RecordingError

BAG, PICTURE = 'run', 'run.png'
"""Names of the bag and of the picture."""


def record(setting: Setting, trial: Trial, only: int, folder: str) -> list[str]:
    """Run a world, and write its bag and its picture into a folder.

    Returns:
        What could not be written, and why.
    """
    bag = Path(folder) / BAG

    @contextmanager
    def recording(world: Lockstep) -> Iterator[None]:
        writing = Recording(bag, 'mcap', lossless=True)
        recorder = Recorder(Selection(everything=True), writing)
        world.add(recorder, observer=True)
        world.on_new_topics(recorder.discover)
        recorder.discover()
        try:
            yield
        finally:
            ended.append(world.now)
            writing.finish()

    ended: list[int] = []
    try:
        outcome = run(setting, trial, only=only, during=recording)
    except (RecordingError, OSError) as error:
        return [f'no bag: {error}']
    # A violation ends the world.
    violations = [
        ViolationMark(ended[0], f'violated: {one.key}' if one.index >= 0 else one.key)
        for one in outcome.violations[:1]
    ]
    try:
        draw([read_run(bag)], Path(folder) / PICTURE, violations=violations)
    except (BagError, ModuleNotFoundError, OSError) as error:
        return [f'no picture: {error}']
    return []
