"""Replay a recorded run, or verify that the robot still moves as it did."""

from __future__ import annotations

import argparse
import select
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rclpy.duration import Duration

from diffdrive_jacobian.bags.reading import BagError, open_bag, read_run
from diffdrive_jacobian.bags.replayer import COMMANDED, TOLD, Playback, Replayer
from diffdrive_jacobian.bags.verification import Verification, verify
from diffdrive_jacobian.ros.parameters import ParameterError
from diffdrive_jacobian.ros.runner import Runner, UserError, ros_context, running
from diffdrive_jacobian.ros.signals import Signals
from diffdrive_jacobian.tools import _cli
from diffdrive_jacobian.tools._params_file import robot_parameters
from diffdrive_jacobian.tools._progress import Playing

PROGRAM = 'replay_run'
MATCH_PATIENCE = 5.0
"""How long subscribers may take to be found (s): a participant that is older is announced every 3 s."""
MATCH_QUIET = 0.5
"""For how long no new one must have been found before it begins (s)."""


def replay(
    bag: Path,
    playback: Playback,
    ros: Sequence[str],
    signals: Signals,
    acked: float | None,
    readers: int = 1,
) -> int:
    """Play a bag; gives the exit code.

    Args:
        bag: The bag.
        playback: What of it, and how.
        ros: ROS arguments.
        signals: What was caught so far.
        acked: How long to wait at the end until all readers have everything (s; 0: for ever); None:
            not at all.
        readers: How many each topic should have before anything is played.

    Raises:
        UserError: The ROS arguments cannot be.
        BagError: The bag cannot be played.
    """
    with (
        open_bag(bag) as reader,
        ros_context([PROGRAM, *ros]) as context,
        running(context, closed_world=False) as runner,
    ):
        player = runner.add(lambda: Replayer(reader, playback, context=context))
        _wait_for_subscribers(player, runner, signals, readers)
        for topic, others in player.rivals().items():
            player.get_logger().warning(f'{", ".join(others)} also publishes on {topic}')
        for topic in player.unheard:
            player.get_logger().warning(f'nobody listens on {topic}')
        with Playing((player.end - player.start) / 1e9) as progress:

            def over() -> bool:
                if _pressed_enter():
                    player.toggle()
                progress.show((player.position - player.start) / 1e9, paused=player.paused)
                return bool(player.done or signals.count)

            player.begin()
            alive = runner.spin(over)
        if alive and not signals.count and acked is not None:
            patience = Duration(nanoseconds=-1) if acked == 0.0 else Duration(seconds=acked)
            alive = player.wait_for_all_acked(patience)
        print(f'{player.sent} messages played')
    if signals.count:
        return _cli.INTERRUPTED
    return _cli.DONE if alive and player.done else _cli.FAILED


def _wait_for_subscribers(player: Replayer, runner: Runner, signals: Signals, readers: int) -> None:
    """Wait until those who listen are matched: what is sent before is lost to them."""
    begun = quiet = time.monotonic()
    heard = -1

    def matched() -> bool:
        nonlocal quiet, heard
        now, unheard = time.monotonic(), len(player.heard_by_fewer(readers))
        if unheard != heard:
            quiet, heard = now, unheard
        complete = unheard == 0 and now - quiet >= MATCH_QUIET
        return bool(complete or now - begun >= MATCH_PATIENCE or signals.count)

    runner.spin(matched)


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
    acked = None if options.wait_for_all_acked is None else options.wait_for_all_acked / 1000.0
    try:
        if options.verify:
            return _verify(bag, options)
        return replay(bag, playback, ros, signals, acked, options.readers)
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
        'robot is driven again in memory and its way compared with the odometry. Exit code 0: played, '
        'or as recorded; 1: not; 2: wrong arguments or no bag; 130: interrupted.',
    )
    parser.add_argument('bag', metavar='BAG', help='the directory of a rosbag2 bag')
    what = parser.add_mutually_exclusive_group()
    what.add_argument('--goals', action='store_true', help='what the controller was told')
    what.add_argument('--all-topics', action='store_true', help='everything')
    what.add_argument('--topics', nargs='+', metavar='TOPIC', help='these, by their full names')
    what.add_argument('--verify', action='store_true', help='compare the robot with the odometry')
    parser.add_argument('-r', '--rate', type=_cli.positive, default=1.0, help='how much faster; 1')
    parser.add_argument('-l', '--loop', action='store_true', help='begin anew at the end')
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
    _cli.add_wait_matching(parser, 'each topic has')
    parser.add_argument(
        '--wait-for-all-acked',
        type=_not_negative,
        metavar='MS',
        help='wait so long at the end until all readers have everything; 0: for ever',
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
