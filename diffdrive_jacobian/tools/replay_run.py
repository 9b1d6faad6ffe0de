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

"""Replay a recorded run."""

from __future__ import annotations

import argparse
import math
import select
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from diffdrive_jacobian.recording.progress import ReplayProgress
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import _cli, _output
from diffdrive_jacobian.tools.entry_points import DONE, FAILED, INTERRUPTED, long_lived

if TYPE_CHECKING:
    from diffdrive_jacobian.recording import ReplayResult

PROGRAM = 'replay_run'
VERIFY = '--verify'
MATCH_PATIENCE = 5.0
"""Longest wait for subscriptions without -w (s): an older participant is announced every 3 s."""


@_output.tool(PROGRAM)
def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; return the exit code."""
    own, ros = _cli.split_arguments(arguments)
    rest = [word for word in own if not (VERIFY.startswith(word) and word.startswith('--v'))]
    if len(rest) < len(own):
        # Slow to import.
        from diffdrive_jacobian.tools import verify_run

        return verify_run.run_as_option(PROGRAM, VERIFY, [*rest, *ros], signals)
    parser = _parser()
    options = parser.parse(arguments)
    if options.timeout is not None and options.readers is None:
        parser.error('--timeout needs -w: it is the longest wait for the subscriptions of -w')
    parser.refuse_with(options, '--namespace', '--topics')
    parser.refuse_with(options, '--wait-for-all-acked', '--loop')
    if options.start_paused and not (sys.stdin and sys.stdin.isatty()):
        parser.error('--start-paused needs a terminal: Enter resumes')
    with long_lived(), signals.ending_at_once():
        # Not above: --help needs no ROS.
        from diffdrive_jacobian.recording import COMMANDS, GOALS, Playback, replay

    acked = options.wait_for_all_acked
    playback = Playback(
        names=None if options.all_topics else GOALS if options.goals else COMMANDS,
        topics=tuple(options.topics or ()),
        namespace=options.namespace,
        remap=dict(options.remap),
        rate=options.rate,
        start_offset=options.start_offset,
        loop=options.loop,
        clock=options.clock,
        paused=options.start_paused,
    )
    result = replay(
        options.bag,
        playback,
        patience=MATCH_PATIENCE,
        readers=options.readers,
        timeout=math.inf if options.timeout is None else options.timeout,
        acknowledgement_timeout=None if acked is None else acked / 1000.0,
        ros_arguments=options.ros,
        signals=signals,
        progress=_Progress(),
    )
    return _report(result, options)


class _Progress(ReplayProgress):
    """Prints the progress of a replay, and pauses it by Enter."""

    def __init__(self) -> None:
        self._bar = _output.Bar(stays=True)
        self._seconds = 0.0
        self._waiting = _output.Waiting()

    def waiting(self, reason: str) -> None:
        self._waiting.show(reason)

    def started(self, seconds: float) -> None:
        self._seconds = seconds

    def playing(self, seconds: float, *, paused: bool) -> None:
        what = 'paused (Enter)' if paused else 'playing'
        share = seconds / self._seconds if self._seconds else 1.0
        self._bar.show(what, share, f'{seconds:.1f} of {self._seconds:.1f} s')

    def toggled(self) -> bool:
        if not sys.stdin or not sys.stdin.isatty():
            return False
        ready, _, _ = select.select([sys.stdin], [], [], 0.0)
        return bool(ready) and sys.stdin.readline() != ''

    def ended(self) -> None:
        self._bar.close()
        # The acknowledgements come next.
        self._waiting = _output.Waiting()


def _report(result: ReplayResult, options: argparse.Namespace) -> int:
    """Print what became of a replay; return the exit code."""
    from diffdrive_jacobian.recording import describe_too_few

    if not result.started:
        counts = describe_too_few(result.too_few, options.readers)
        if result.interrupted:
            print(f'interrupted: nothing was played, {counts}')
            return INTERRUPTED
        print(f'nothing was played: {counts} after --timeout {options.timeout:g} s')
        return FAILED
    print(f'{result.messages} messages played')
    if result.missing:
        _output.note(PROGRAM, f'warning: {result.missing} messages are missing in the bag')
    if result.interrupted:
        return INTERRUPTED
    if result.unacknowledged:
        topics = ', '.join(result.unacknowledged)
        seconds = options.wait_for_all_acked / 1000.0
        reason = f'not all subscriptions to {topics} have acknowledged all messages within {seconds:g} s'
        return _output.complain(PROGRAM, reason, FAILED)
    return DONE if result.played else FAILED


def _remapping(text: str) -> tuple[str, str]:
    old, separator, new = text.partition(':=')
    if not (old and separator and new):
        raise argparse.ArgumentTypeError(f'must be OLD:=NEW, got {text!r}')
    return old, new


def _parser() -> _cli.Parser:
    parser = _cli.Parser(
        prog=PROGRAM,
        usage=f'{PROGRAM} BAG [options] [--ros-args ...]',
        description='Replay a recorded run: the commands (cmd_vel), unless an option selects other '
        'topics. On a terminal, Enter pauses and resumes. Exit code 0: played; 1: not played to the '
        'end, or nothing to play; 2: wrong arguments or no bag; 130: interrupted.',
    )
    parser.add_bag()
    what = parser.add_mutually_exclusive_group()
    what.add_argument('--goals', action='store_true', help='play the goals of the controller')
    what.add_argument('--all-topics', action='store_true', help='play all topics')
    what.add_argument(
        '--topics',
        nargs='+',
        metavar='TOPIC',
        help='play these topics; the namespace can be left out where only one robot has the topic',
    )
    what.add_argument(VERIFY, action='store_true', help='run verify_run instead, with its options')
    parser.add_namespace()
    parser.add_value('-r --rate', 'RATE', 'factor on the speed', default=1.0)
    parser.add_argument('-l', '--loop', action='store_true', help='start again at the end of the bag')
    parser.add_value(
        '--start-offset',
        'SECONDS',
        'start this long after the beginning of the bag (s)',
        default=0.0,
        kind=_cli.not_negative,
    )
    parser.add_argument(
        '-m',
        '--remap',
        nargs='+',
        action='extend',
        default=[],
        type=_remapping,
        metavar='OLD:=NEW',
        help='publish a topic that is played under another name; a relative OLD is in the namespace /',
    )
    parser.add_argument(
        '--clock',
        nargs='?',
        const=40.0,
        type=_cli.positive,
        metavar='HZ',
        help='publish the time of the bag on /clock at this rate (Hz) (default: 40.0 if HZ is left '
        'out, not at all without the option)',
    )
    parser.add_argument('-p', '--start-paused', action='store_true', help='start in the paused state')
    parser.add_wait_matching('each topic has', f'those that are discovered within {MATCH_PATIENCE:g} s')
    parser.add_timeout('with -w: give up after this time (s) and play nothing (default: never)')
    parser.add_value(
        '--wait-for-all-acked',
        'MS',
        'at the end wait up to this time (ms) until all reliable subscriptions have acknowledged '
        'all messages, 0: no limit; exit code 1 if they have not (default: do not wait)',
        kind=_cli.not_negative,
    )
    return parser
