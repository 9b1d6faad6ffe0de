"""Replay a recorded run, or verify that the robot still moves as it did."""

from __future__ import annotations

import argparse
import math
import select
import sys
import time
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

import numpy as np

from diffdrive_jacobian.bags.reading import BagError, open_bag, read_run
from diffdrive_jacobian.bags.replayer import COMMANDED, TOLD, NothingToPlayError, Playback, Replayer
from diffdrive_jacobian.bags.verification import Verification, verify
from diffdrive_jacobian.ros.heartbeats import fast_heartbeats
from diffdrive_jacobian.ros.parameters import ParameterError
from diffdrive_jacobian.ros.runner import Runner, UserError, ros_context, running
from diffdrive_jacobian.ros.signals import Signals
from diffdrive_jacobian.tools import _cli
from diffdrive_jacobian.tools._params_file import robot_parameters
from diffdrive_jacobian.tools._progress import Playing
from diffdrive_jacobian.tools._waiting import Waiting

PROGRAM = 'replay_run'
MATCH_PATIENCE = 5.0
"""How long readers are waited for without -w (s): an older participant is announced every 3 s."""
MATCH_QUIET = 0.5
"""How long the numbers of readers must not have changed before playing starts (s)."""


def replay(
    bag: Path,
    playback: Playback,
    ros: Sequence[str],
    signals: Signals,
    *,
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
        acked: How long to wait at the end until all readers have acknowledged everything (s; 0: for
            ever); None: not at all.
        readers: Number of readers that each topic must have before anything is played; None: whoever is
            discovered within `MATCH_PATIENCE`.
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
            _wait_for_discovery(player, runner, signals)
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


def _wait_for_discovery(player: Replayer, runner: Runner, signals: Signals) -> None:
    """Wait until each topic has a reader and no more are discovered, `MATCH_PATIENCE` at most."""
    started = quiet = time.monotonic()
    counts: dict[str, int] = {}

    def over() -> bool:
        nonlocal quiet, counts
        now, found = time.monotonic(), player.readers()
        if found != counts:
            quiet, counts = now, found
        complete = min(counts.values()) > 0 and now - quiet >= MATCH_QUIET
        return bool(complete or now - started >= MATCH_PATIENCE or signals.count)

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
    with Playing((player.end - player.start) / 1e9) as progress:

        def over() -> bool:
            if _pressed_enter():
                player.toggle()
            progress.show((player.position - player.start) / 1e9, paused=player.paused)
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


def report(verification: Verification, tolerance: float, yaw_tolerance: float) -> str:
    """Say how far the robot driven again and the odometry are apart."""
    lines = [
        f'{len(verification.seconds)} odometry messages, commands from {verification.source}, '
        f'begun at the first {verification.start}',
        *(f'note: {note}' for note in verification.notes),
    ]
    for name, unit, values, allowed in (
        ('position', 'm', verification.distances, tolerance),
        ('heading', 'rad', verification.headings, yaw_tolerance),
    ):
        worst = int(np.argmax(values))
        rms = float(np.sqrt(np.mean(values**2)))
        lines.append(
            f'{name}: at most {values[worst]:.3g} {unit} apart, at {verification.seconds[worst]:.3f} s; '
            f'RMS {rms:.3g} {unit}; allowed {allowed:g} {unit}'
        )
        beyond = np.flatnonzero(values > allowed)
        if len(beyond):
            first = verification.seconds[beyond[0]]
            lines.append(f'{name}: beyond that in {len(beyond)} messages, first at {first:.3f} s')
    verdict = 'as recorded' if verification.holds(tolerance, yaw_tolerance) else 'NOT as recorded'
    return '\n'.join([*lines, f'the robot moves {verdict}'])


def _verify(bag: Path, options: argparse.Namespace) -> int:
    parameters = None if options.params_file is None else robot_parameters(options.params_file)
    verification = verify(read_run(bag), parameters)
    allowed = verification.allowed
    tolerance = allowed if options.tolerance is None else options.tolerance
    yaw_tolerance = allowed if options.yaw_tolerance is None else options.yaw_tolerance
    print(report(verification, tolerance, yaw_tolerance))
    return _cli.DONE if verification.holds(tolerance, yaw_tolerance) else _cli.FAILED


def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; gives the exit code."""
    own, ros = _cli.split_arguments(arguments)
    parser = _parser()
    options = parser.parse_args(own)
    bag = Path(options.bag)
    remap = dict(options.remap)
    names = None if options.all_topics else TOLD if options.goals else COMMANDED
    playback = Playback(
        names=names,
        topics=tuple(options.topics or ()),
        remap=remap,
        rate=options.rate,
        start_offset=options.start_offset,
        loop=options.loop,
        clock=options.clock,
        paused=options.start_paused,
    )
    if options.timeout is not None and options.readers is None:
        parser.error('--timeout is the time to wait for the readers of -w, which is missing')
    acked = None if options.wait_for_all_acked is None else options.wait_for_all_acked / 1000.0
    try:
        if options.verify:
            return _verify(bag, options)
        timeout = math.inf if options.timeout is None else options.timeout
        return replay(bag, playback, ros, signals, acked=acked, readers=options.readers, timeout=timeout)
    except NothingToPlayError as error:
        return _cli.complain(PROGRAM, error, _cli.FAILED)
    except (UserError, BagError, ParameterError) as error:
        return _cli.complain(PROGRAM, error)


def _remapping(text: str) -> tuple[str, str]:
    old, separator, new = text.partition(':=')
    if not (old and separator and new):
        raise argparse.ArgumentTypeError(f'must be OLD:=NEW, got {text!r}')
    return old, new


def _not_negative(text: str) -> float:
    value = _cli.number(text)
    if value < 0.0:
        raise argparse.ArgumentTypeError(f'must not be negative, got {text.strip()!r}')
    return value


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        usage=f'{PROGRAM} BAG [options] [--ros-args ...]',
        description='Replay a recorded run: what was commanded (cmd_vel), unless something else is '
        'asked for. On a terminal, Enter pauses and resumes. With --verify nothing is published: the '
        'robot is driven again in memory and its path compared with the odometry. Exit code 0: played, '
        'or as recorded; 1: not, or nothing to play; 2: wrong arguments or no bag; 130: interrupted.',
    )
    parser.add_argument('bag', metavar='BAG', help='the directory of a rosbag2 bag')
    what = parser.add_mutually_exclusive_group()
    what.add_argument('--goals', action='store_true', help='what the controller was told')
    what.add_argument('--all-topics', action='store_true', help='everything')
    what.add_argument('--topics', nargs='+', metavar='TOPIC', help='these, by their full names')
    what.add_argument('--verify', action='store_true', help='compare the robot with the odometry')
    parser.add_argument('-r', '--rate', type=_cli.positive, default=1.0, help='how much faster; 1')
    parser.add_argument(
        '-l', '--loop', action='store_true', help='start again when the end of the bag is reached'
    )
    parser.add_argument(
        '--start-offset', type=_not_negative, default=0.0, help='begin so late in the bag (s)'
    )
    parser.add_argument(
        '-m',
        '--remap',
        nargs='+',
        action='extend',
        default=[],
        type=_remapping,
        metavar='OLD:=NEW',
        help='publish a topic under another name',
    )
    parser.add_argument(
        '--clock',
        nargs='?',
        const=40.0,
        type=_cli.positive,
        metavar='HZ',
        help="publish the bag's time on /clock (40)",
    )
    parser.add_argument('-p', '--start-paused', action='store_true', help='begin with a pause')
    _cli.add_wait_matching(
        parser,
        'each topic has',
        f'without it, playing starts with the readers that are discovered within {MATCH_PATIENCE:g} s',
    )
    parser.add_argument(
        '--timeout',
        type=_cli.positive,
        metavar='SECONDS',
        help='with -w: give up after this time and play nothing (default: wait for ever)',
    )
    parser.add_argument(
        '--wait-for-all-acked',
        type=_not_negative,
        metavar='MS',
        help='at the end wait up to this time (ms) until all reliable readers have acknowledged all '
        'messages, 0: for ever; exit code 1 if they have not (default: do not wait)',
    )
    parser.add_argument('--tolerance', type=_cli.positive, help='with --verify: position (m)')
    parser.add_argument('--yaw-tolerance', type=_cli.positive, help='with --verify: heading (rad)')
    parser.add_argument(
        '--params-file',
        metavar='FILE',
        type=_cli.readable_file,
        help='with --verify: the parameters of the robot (YAML), where the bag has none',
    )
    return parser
