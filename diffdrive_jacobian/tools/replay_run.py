"""Replay a recorded run."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import _cli, verify_run

PROGRAM = 'replay_run'
VERIFY = '--verify'
MATCH_PATIENCE = 5.0
"""How long readers are waited for without -w (s): an older participant is announced every 3 s."""


def _replay(bag: Path, options: argparse.Namespace, ros: Sequence[str], signals: Signals) -> int:
    from diffdrive_jacobian.replay.replayer import COMMANDED, TOLD, NothingToPlayError, Playback
    from diffdrive_jacobian.tools._playing import replay

    playback = Playback(
        names=None if options.all_topics else TOLD if options.goals else COMMANDED,
        topics=tuple(options.topics or ()),
        remap=dict(options.remap),
        rate=options.rate,
        start_offset=options.start_offset,
        loop=options.loop,
        clock=options.clock,
        paused=options.start_paused,
    )
    acked = options.wait_for_all_acked
    try:
        return replay(
            bag,
            playback,
            ros,
            signals,
            patience=MATCH_PATIENCE,
            acked=None if acked is None else acked / 1000.0,
            readers=options.readers,
            timeout=math.inf if options.timeout is None else options.timeout,
        )
    except NothingToPlayError as error:
        return _cli.complain(PROGRAM, error, _cli.FAILED)


def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; return the exit code."""
    own, ros = _cli.split_arguments(arguments)
    if any(VERIFY.startswith(word) and word.startswith('--v') for word in own):
        rest = [word for word in own if not (VERIFY.startswith(word) and word.startswith('--v'))]
        return verify_run.run_as_option(PROGRAM, VERIFY, [*rest, *ros])
    parser = _parser()
    options = parser.parse_args(own)
    if options.timeout is not None and options.readers is None:
        parser.error('--timeout is the time to wait for the readers of -w, which is missing')
    # Now, for --help needs no ROS.
    from diffdrive_jacobian.bags.bag_reader import BagError

    bag = Path(options.bag)
    try:
        return _replay(bag, options, ros, signals)
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
        'asked for. On a terminal, Enter pauses and resumes. Exit code 0: played; 1: not, or nothing to '
        'play; 2: wrong arguments or no bag; 130: interrupted.',
    )
    parser.add_argument('bag', metavar='BAG', help='the directory of a rosbag2 bag')
    what = parser.add_mutually_exclusive_group()
    what.add_argument('--goals', action='store_true', help='what the controller was told')
    what.add_argument('--all-topics', action='store_true', help='everything')
    what.add_argument('--topics', nargs='+', metavar='TOPIC', help='these, by their full names')
    what.add_argument(VERIFY, action='store_true', help='run verify_run instead, with its options')
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
    return parser
