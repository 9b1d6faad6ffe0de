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

"""Record topics as a rosbag2 bag. After a crash all but the last moment can be recovered."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING

from diffdrive_jacobian.errors import NotDoneError
from diffdrive_jacobian.messages.topics import RUN_TOPICS, Selection
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import PATH_LIMIT, printable
from diffdrive_jacobian.tools import _cli, _output
from diffdrive_jacobian.tools._output import counted, describe_bag
from diffdrive_jacobian.tools.entry_points import DONE, long_lived

if TYPE_CHECKING:
    from diffdrive_jacobian.recording.recorder import Status

PROGRAM = 'record_run'
STATUS_PERIOD = {True: 0.5, False: 10.0}
"""Time between two lines about the status, on a terminal and elsewhere (s)."""
MAX_LISTED = 8
"""Largest number of topics in a message."""


class StatusLine:
    """A line about the state of the recording."""

    def __init__(self, hint: str = '') -> None:
        """Start without messages. The hint follows a list of topics without a publisher."""
        self.missing = ''
        """What is missing, as long as no topic is recorded."""
        self.never_published: tuple[str, ...] = ()
        """Topics that were selected by name and had no publisher so far, fully qualified."""
        self._hint = hint
        self._terminal = sys.stdout.isatty()
        self._shown = 0.0
        self._messages = 0
        self._waiting = _output.Waiting()

    def show(self, status: Status) -> None:
        """Print the status if it is due."""
        self.missing = '' if status.topics else describe_missing(status, self._hint)
        self.never_published = status.missing
        if self.missing and not self._terminal:
            self._waiting.show(self.missing)
        elapsed = status.seconds - self._shown
        if elapsed < STATUS_PERIOD[self._terminal]:
            return
        rate = (status.messages - self._messages) / elapsed
        self._shown, self._messages = status.seconds, status.messages
        line = (
            f'{counted(status.messages, "message")} of {counted(status.topics, "topic")}, '
            f'{rate:.0f} per second, {status.size / 1e6:.1f} MB, {status.seconds:.0f} s'
        )
        if status.lost:
            line += f', {status.lost} LOST'
        if self.missing and self._terminal:
            # Not more than fits in one line.
            line = f'waiting: {printable(self.missing, 70)}'
        print(
            f'\r{line}\x1b[K' if self._terminal else line, end='' if self._terminal else '\n', flush=True
        )

    def wait(self, topics: Sequence[str]) -> None:
        """Show that late messages are waited for."""
        self.end()
        self._shown = 0.0
        print(
            f'waiting some seconds for late messages of {_listed(topics)}; '
            'Ctrl-C again ends at once, and the bag is incomplete',
            flush=True,
        )

    def end(self) -> None:
        """End the line."""
        if self._terminal and self._shown:
            print()


@_output.tool(PROGRAM)
def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; return the exit code."""
    parser = _parser()
    options = parser.parse(arguments)
    parser.refuse_without(options, '--force', '--output')
    parser.refuse_with(options, '--regex', '--all')
    if options.all and options.topics:
        parser.error('TOPIC has no effect with --all')
    with long_lived(), signals.ending_at_once():
        # Not above: --help needs no ROS.
        from diffdrive_jacobian.recording.recorder import record
        from diffdrive_jacobian.recording.recording import RecordingError, open_recording

    topics = tuple(options.topics)
    selection = Selection(
        topics=topics or (() if options.regex else RUN_TOPICS),
        everything=options.all,
        pattern=options.regex or '',
    )
    recording = open_recording('run', options.output, replace=options.force)
    bag = recording.bag
    print(f'recording to {printable(bag, PATH_LIMIT)}; Ctrl-C ends it', flush=True)
    # A word that is meant as the name of the bag is read as that of a topic.
    hint = ' (-o names the bag)' if topics and options.output is None else ''
    line, ending = StatusLine(hint), ExitStack()
    try:
        try:
            summary = record(
                recording,
                selection,
                max_duration=options.max_duration,
                ros_arguments=options.ros,
                signals=signals,
                on_status=line.show,
                on_wait=line.wait,
                on_end=lambda: ending.enter_context(_output.busy(PROGRAM, f'writing {bag}')),
            )
        finally:
            ending.close()
            line.end()
    except RecordingError as error:
        if error.summary is not None:
            print(describe_bag(bag, error.summary, 'incomplete'))
        raise
    print(describe_bag(bag, summary))
    if topics and not summary.messages:
        reason = line.missing or f'no message was received on {", ".join(topics)}'
        raise NotDoneError(reason)
    if topics and line.never_published:
        _output.note(PROGRAM, f'warning: no publisher: {_listed(line.never_published)}')
    return DONE


def describe_missing(status: Status, hint: str = '') -> str:
    """Return which topics have no publisher, and which others have one, in one line.

    Args:
        status: The status of a recording of no topic so far.
        hint: What follows the topics without a publisher.
    """
    verb = 'has' if len(status.missing) == 1 else 'have'
    line = f'{_listed(status.missing)} {verb} no publisher'
    if not status.missing:
        line = 'no topic that is selected has a publisher'
    return f'{line}{hint}; topics with a publisher: {_listed(status.published) or "none"}'


def _listed(topics: Sequence[str]) -> str:
    """Return the first `MAX_LISTED` topics as text."""
    shown = [printable(topic) for topic in topics[:MAX_LISTED]]
    return ', '.join([*shown, '...'] if len(topics) > MAX_LISTED else shown)


def _pattern(text: str) -> str:
    try:
        re.compile(text)
    except re.error as error:
        raise argparse.ArgumentTypeError(
            f'must be a regular expression, got {text!r} ({error})'
        ) from error
    return text


def _parser() -> _cli.Parser:
    parser = _cli.Parser(
        prog=PROGRAM,
        usage=f'{PROGRAM} [TOPIC ...] [options] [--ros-args ...]',
        description='Record topics as a rosbag2 bag until Ctrl-C. Messages are on the disk within a '
        'second: after a crash recover_run writes the bag from them. Exit code 0: the bag is complete; '
        '1: it is not complete (messages were or may be lost, a topic cannot be recorded, or the disk '
        'failed), or no message of a named TOPIC was received; 2: wrong arguments; 130: interrupted '
        'before it has begun.',
    )
    parser.add_argument(
        'topics',
        metavar='TOPIC',
        nargs='*',
        type=_cli.topic,
        help=f'topics to record (default: those of a run: {", ".join(RUN_TOPICS)})',
    )
    parser.add_output('BAG', 'directory of the bag (default: run_DATE-TIME)', kind=_cli.bag_folder)
    parser.add_force('BAG, at the end of the recording')
    parser.refuse_storage()
    parser.add_argument('-a', '--all', action='store_true', help='record every topic that is not hidden')
    parser.add_argument(
        '-e',
        '--regex',
        type=_pattern,
        help='record the topics in whose names this regular expression is found',
    )
    parser.add_value(
        '--max-duration', 'SECONDS', 'end the recording after this time (s) (default: never)'
    )
    return parser
