"""The playing of a bag for replay_run: readers are waited for, then it is played and acknowledged."""

from __future__ import annotations

import math
import select
import sys
import time
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

from diffdrive_jacobian.reading.reader import open_bag
from diffdrive_jacobian.replay.replayer import Playback, Replayer
from diffdrive_jacobian.ros.heartbeats import fast_heartbeats
from diffdrive_jacobian.ros.runner import Runner, ros_context, running
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.time_units import seconds
from diffdrive_jacobian.tools import _cli
from diffdrive_jacobian.tools._progress import Playing
from diffdrive_jacobian.tools._waiting import Waiting

PROGRAM = 'replay_run'
MATCH_QUIET = 0.5
"""How long the numbers of readers must not have changed before playing starts (s)."""


def replay(
    bag: Path,
    playback: Playback,
    ros: Sequence[str],
    signals: Signals,
    *,
    patience: float,
    acked: float | None = None,
    readers: int | None = None,
    timeout: float = math.inf,
) -> int:
    """Play a bag; return the exit code.

    Args:
        bag: The bag.
        playback: What of it is played, and how.
        ros: ROS arguments.
        signals: Signals that were caught so far.
        patience: How long readers are waited for where no number is asked for (s).
        acked: How long to wait at the end until all readers have acknowledged everything (s; 0: for
            ever); None: not at all.
        readers: Number of readers that each topic must have before anything is played; None: whoever is
            discovered within `patience`.
        timeout: How long to wait for so many readers (s).

    Raises:
        UserError: The ROS arguments are invalid.
        BagError: The bag cannot be played.
        NothingToPlayError: It has no message to play.
    """
    with (
        open_bag(bag) as reader,
        nullcontext() if acked is None else fast_heartbeats(),
        ros_context([PROGRAM, *ros]) as context,
        running(context, closed_world=False) as runner,
    ):
        player = runner.add(lambda: Replayer(reader, playback, context=context))
        if readers is None:
            _wait_for_discovery(player, runner, signals, patience)
        elif not _wait_for_readers(player, runner, signals, readers, timeout):
            counts = _too_few(player, readers)
            if signals.count:
                print(f'interrupted: nothing was played, {counts}')
                return _cli.INTERRUPTED
            print(f'nothing was played: {counts} after --timeout {timeout:g} s')
            return _cli.FAILED
        for topic, others in player.rivals().items():
            player.get_logger().warning(f'{", ".join(others)} also publishes on {topic}')
        for topic in player.unheard:
            player.get_logger().warning(f'nobody listens on {topic} (-w 1 waits until somebody does)')
        played = _play(player, runner, signals)
        unacknowledged: list[str] = []
        if played and acked is not None:
            unacknowledged = _wait_for_acknowledgements(player, runner, signals, acked)
        print(f'{player.sent} messages played')
    if signals.count:
        return _cli.INTERRUPTED
    if unacknowledged:
        topics = ', '.join(unacknowledged)
        reason = f'the readers of {topics} have not acknowledged all messages within {acked:g} s'
        return _cli.complain(PROGRAM, reason, _cli.FAILED)
    return _cli.DONE if played else _cli.FAILED


def _wait_for_discovery(player: Replayer, runner: Runner, signals: Signals, patience: float) -> None:
    """Wait, at most so long (s), until each topic has a reader and no more are discovered."""
    started = quiet = time.monotonic()
    counts: dict[str, int] = {}

    def over() -> bool:
        nonlocal quiet, counts
        now, found = time.monotonic(), player.readers()
        if found != counts:
            quiet, counts = now, found
        complete = min(counts.values()) > 0 and now - quiet >= MATCH_QUIET
        return bool(complete or now - started >= patience or signals.count)

    runner.spin(over)


def _wait_for_readers(
    player: Replayer, runner: Runner, signals: Signals, readers: int, timeout: float
) -> bool:
    """Wait until each topic has so many readers; return False after the timeout (s) or a signal."""
    deadline = time.monotonic() + timeout
    waiting = Waiting()
    complete = False

    def over() -> bool:
        nonlocal complete
        complete = not (few := _too_few(player, readers))
        if not complete:
            waiting.show(few)
        return bool(complete or signals.count or time.monotonic() > deadline)

    return runner.spin(over) and complete


def _too_few(player: Replayer, readers: int) -> str:
    """List the topics that have fewer readers, with their numbers; empty: none has."""
    few = {topic: count for topic, count in player.readers().items() if count < readers}
    return ', '.join(f'{topic} has {count} of {readers} readers' for topic, count in few.items())


def _play(player: Replayer, runner: Runner, signals: Signals) -> bool:
    """Play until the end or a signal; return whether everything was played."""
    with Playing(seconds(player.end - player.start)) as progress:

        def over() -> bool:
            if _pressed_enter():
                player.toggle()
            progress.show(seconds(player.position - player.start), paused=player.paused)
            return bool(player.done or signals.count)

        player.begin()
        runner.spin(over)
    return player.done


def _wait_for_acknowledgements(
    player: Replayer, runner: Runner, signals: Signals, seconds: float
) -> list[str]:
    """Wait until all readers have acknowledged everything (s; 0: for ever).

    Returns:
        The topics with readers that have not.
    """
    deadline = time.monotonic() + (seconds or math.inf)
    waiting = Waiting()
    missing: list[str] = []

    def over() -> bool:
        nonlocal missing
        missing = player.unacknowledged()
        if missing:
            waiting.show(f'readers of {", ".join(missing)} have not acknowledged all messages')
        return bool(not missing or signals.count or time.monotonic() > deadline)

    runner.spin(over)
    return missing


def _pressed_enter() -> bool:
    if not sys.stdin or not sys.stdin.isatty():
        return False
    ready, _, _ = select.select([sys.stdin], [], [], 0.0)
    return bool(ready) and sys.stdin.readline() != ''
