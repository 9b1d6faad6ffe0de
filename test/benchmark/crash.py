"""How much a killed record_run loses: `python test/benchmark/crash.py [RUNS]`.

Each of RUNS (20) runs is killed by SIGKILL at a random instant of its first three
seconds and recovered. The loss is the time between the last message that a subscriber beside the
recorder had heard at the kill and the last one in the recovered bag (50 Hz odometry); the messages
of that bag are compared byte by byte with those heard, without a gap.
"""

from __future__ import annotations

import random
import statistics
import sys
import tempfile
from contextlib import ExitStack, redirect_stdout
from io import StringIO
from pathlib import Path

from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1]))

from support.crashes import ALLOWED_LOSS, Control, crash
from support.processes import open_world

from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools.recover_run import main as recover_run

A_WORLD = 4
"""Runs for each start of a robot, which may live for half a minute only."""
LONGEST = 3.0
"""Of a run (s)."""


def measure(runs: int, folder: Path) -> list[tuple[float, float, int]]:
    """Give for each run how long it was recorded (s), what was lost (s), and the messages saved."""
    chance = random.Random()
    found = []

    def run(bag: Path) -> int:
        return recover_run([str(bag)], Signals())

    with ExitStack() as world:
        for number in range(runs):
            if number % A_WORLD == 0:
                world.close()
                place = folder / f'world_{number}'
                place.mkdir()
                control = Control(world.enter_context(open_world(place)))
            seconds = chance.uniform(0.0, LONGEST)
            loss, saved = crash(control, folder / f'run_{number}', seconds, run)
            found.append((seconds, loss, saved))
    return found


def main() -> None:
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    table = Table('runs', 'lost: median (s)', 'most (s)', 'allowed (s)', 'saved messages')
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(StringIO()):
        found = measure(runs, Path(folder))
    losses = [loss for _, loss, _ in found]
    saved = [count for _, _, count in found]
    table.add_row(
        str(len(found)),
        f'{statistics.median(losses):.3f}',
        f'{max(losses):.3f}',
        f'{ALLOWED_LOSS:g}',
        f'{min(saved)}-{max(saved)}',
    )
    details = ' '.join(f'{loss:.2f}' for loss in losses)
    console = Console(width=110)
    console.print(table, details, sep='\n', highlight=False)


if __name__ == '__main__':
    main()
