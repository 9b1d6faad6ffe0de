"""Record a run as a rosbag2 bag, so that a crash costs a moment of it and not the whole."""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from diffdrive_jacobian.bags.building import STORAGES, Summary
from diffdrive_jacobian.bags.recorder import RUN_TOPICS, Recorder, Selection
from diffdrive_jacobian.bags.recording import Recording
from diffdrive_jacobian.ros.runner import UserError, ros_context, running
from diffdrive_jacobian.ros.signals import Signals
from diffdrive_jacobian.text import PATH_LIMIT, printable
from diffdrive_jacobian.tools import _cli
from diffdrive_jacobian.tools._recording import begin_recording

PROGRAM = 'record_run'
LOOK_PERIOD = 0.2
"""How often new topics are looked for (s)."""
STATUS_PERIOD = {True: 0.5, False: 10.0}
"""How often the status is told, on a terminal and elsewhere (s)."""


def record(
    recording: Recording,
    selection: Selection,
    ros: Sequence[str],
    signals: Signals,
    *,
    max_duration: float | None,
) -> Summary:
    """Record until a signal comes, the time is up, ROS is shut down or the disk is full.

    Raises:
        UserError: The ROS arguments cannot be.
        OSError: The bag cannot be written.
    """
    try:
        if not signals.count:
            _hear(recording, selection, ros, signals, max_duration)
    except UserError:
        recording.discard()
        raise
    except BaseException:
        recording.finish()
        raise
    return recording.finish()


def _hear(
    recording: Recording,
    selection: Selection,
    ros: Sequence[str],
    signals: Signals,
    max_duration: float | None,
) -> None:
    status = Status(recording)
    with (
        ros_context([PROGRAM, *ros]) as context,
        running(context, closed_world=False) as runner,
    ):
        recorder = runner.add(lambda: Recorder(selection, recording.journal, context=context))
        looked = -LOOK_PERIOD

        def over() -> bool:
            nonlocal looked
            now = time.monotonic()
            if now - looked >= LOOK_PERIOD:
                looked = now
                recorder.look()
                status.show(recorder)
            recording.tend()
            late = max_duration is not None and now - recording.begun >= max_duration
            return bool(signals.count or late or recording.error)

        runner.spin(over)
    status.end()


class Status:
    """A line of how the recording goes."""

    def __init__(self, recording: Recording) -> None:
        """Begin without messages."""
        self._recording = recording
        self._terminal = sys.stdout.isatty()
        self._shown = self._recording.begun
        self._messages = 0

    def show(self, recorder: Recorder) -> None:
        """Tell it anew, if it is time."""
        now = time.monotonic()
        elapsed = now - self._shown
        if elapsed < STATUS_PERIOD[self._terminal]:
            return
        rate = (recorder.messages - self._messages) / elapsed
        self._shown, self._messages = now, recorder.messages
        line = (
            f'{recorder.messages} messages of {len(recorder.topics)} topics, {rate:.0f} per second, '
            f'{self._recording.journal.size / 1e6:.1f} MB, {now - self._recording.begun:.0f} s'
        )
        print(
            f'\r{line}\x1b[K' if self._terminal else line, end='' if self._terminal else '\n', flush=True
        )

    def end(self) -> None:
        """Leave the line to others."""
        if self._terminal:
            print()


def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; gives the exit code."""
    own, ros = _cli.split_arguments(arguments)
    parser = _parser()
    options = parser.parse_args(own)
    topics = tuple(options.topics)
    selection = Selection(
        topics=topics or (() if options.regex else RUN_TOPICS),
        everything=options.all,
        pattern=options.regex or '',
    )
    try:
        recording = begin_recording('run', options.output, options.storage)
    except OSError as error:
        return _cli.complain(PROGRAM, error)
    bag = recording.bag
    print(f'recording to {printable(bag, PATH_LIMIT)}; Ctrl-C ends it', flush=True)
    try:
        summary = record(recording, selection, ros, signals, max_duration=options.max_duration)
    except UserError as error:
        return _cli.complain(PROGRAM, error)
    except OSError as error:
        journal = recording.journal.path
        print(
            f'{PROGRAM}: error: {bag} cannot be written: {error.strerror or error}. What was '
            f'recorded is in {journal}: recover_run {journal} makes the bag of it, where there is room',
            file=sys.stderr,
        )
        return _cli.FAILED
    print(describe(bag, summary))
    if recording.error is not None:
        print(f'{PROGRAM}: error: the recording broke off: {recording.error}', file=sys.stderr)
        return _cli.FAILED
    return _cli.DONE


def describe(bag: Path, summary: Summary) -> str:
    """Return a line about what a bag holds."""
    name = printable(bag, PATH_LIMIT)
    if summary.start is None or summary.end is None:
        return f'{name} is complete and empty: no message came'
    counts = sorted(summary.topics.items())
    topics = ', '.join(f'{printable(topic)} {count}' for topic, count in counts if count)
    seconds = (summary.end - summary.start) / 1e9
    return f'{name} is complete: {summary.messages} messages in {seconds:.1f} s ({topics})'


def _pattern(text: str) -> str:
    try:
        re.compile(text)
    except re.error as error:
        raise argparse.ArgumentTypeError(f'no regular expression: {text!r} ({error})') from error
    return text


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        usage=f'{PROGRAM} [TOPIC ...] [options] [--ros-args ...]',
        description='Record topics as a rosbag2 bag until Ctrl-C. What was received is on the disk '
        'within a second: after a crash recover_run makes the bag of it. Exit code 0: the bag is '
        'complete; 1: it broke off; 2: wrong arguments.',
    )
    parser.add_argument(
        'topics',
        metavar='TOPIC',
        nargs='*',
        help=f'topics; else those of a run: {", ".join(RUN_TOPICS)}',
    )
    parser.add_argument('-o', '--output', metavar='BAG', help='the directory to write; run_DATE-TIME')
    parser.add_argument(
        '-s', '--storage', choices=sorted(STORAGES), default='mcap', help='file format; %(default)s'
    )
    parser.add_argument('-a', '--all', action='store_true', help='every topic that is not hidden')
    parser.add_argument('-e', '--regex', type=_pattern, help='topics that this regular expression fits')
    parser.add_argument(
        '--max-duration', metavar='SECONDS', type=_cli.positive, help='end after this long'
    )
    return parser
