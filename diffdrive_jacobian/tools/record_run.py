"""Record a run as a rosbag2 bag, so that a crash costs a moment of it and not the whole."""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from diffdrive_jacobian.bags.bag_writer import STORAGES, Summary
from diffdrive_jacobian.recording.recorder import RUN_TOPICS, Recorder, Selection
from diffdrive_jacobian.recording.recording import Recording, RecordingError
from diffdrive_jacobian.ros.runner import UserError, ros_context, running
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import PATH_LIMIT, printable
from diffdrive_jacobian.time_units import NANOSECONDS
from diffdrive_jacobian.tools import _cli
from diffdrive_jacobian.tools._recording import begin_recording

PROGRAM = 'record_run'
DISCOVERY_PERIOD = 0.2
"""How often new topics are looked for (s)."""
STATUS_PERIOD = {True: 0.5, False: 10.0}
"""How often the status is printed, on a terminal and elsewhere (s)."""


def record(
    recording: Recording,
    selection: Selection,
    ros: Sequence[str],
    signals: Signals,
    *,
    max_duration: float | None,
) -> Summary:
    """Record until a signal comes, the time is up, ROS is shut down or the disk fails.

    Raises:
        UserError: The ROS arguments are invalid.
        RecordingError: The recording is not complete.
    """
    try:
        if not signals.count:
            _receive(recording, selection, ros, signals, max_duration)
    except UserError:
        recording.discard()
        raise
    except BaseException:
        # The first error is the one to report.
        with suppress(RecordingError):
            recording.finish()
        raise
    return recording.finish()


def _receive(
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
        recorder = runner.add(lambda: Recorder(selection, recording, with_info=True, context=context))
        discovered = -DISCOVERY_PERIOD

        def over() -> bool:
            nonlocal discovered
            now = time.monotonic()
            if now - discovered >= DISCOVERY_PERIOD:
                discovered = now
                recorder.discover()
                status.show(recorder)
            late = max_duration is not None and now - recording.started >= max_duration
            return bool(signals.count or late or recording.error)

        if runner.spin(over) and recording.error is None:
            recorder.end()
            # A second signal does not wait.
            before = signals.count
            runner.spin(lambda: recorder.drained() or signals.count > before)
    status.end()


class Status:
    """A line about the state of the recording."""

    def __init__(self, recording: Recording) -> None:
        """Start without messages."""
        self._recording = recording
        self._terminal = sys.stdout.isatty()
        self._shown = self._recording.started
        self._messages = 0

    def show(self, recorder: Recorder) -> None:
        """Print it again, if it is time."""
        now = time.monotonic()
        elapsed = now - self._shown
        if elapsed < STATUS_PERIOD[self._terminal]:
            return
        rate = (recorder.messages - self._messages) / elapsed
        self._shown, self._messages = now, recorder.messages
        line = (
            f'{_cli.counted(recorder.messages, "message")} of '
            f'{_cli.counted(len(recorder.topics), "topic")}, {rate:.0f} per second, '
            f'{self._recording.journal.size / 1e6:.1f} MB, {now - self._recording.started:.0f} s'
        )
        if lost := sum(self._recording.lost.values()):
            line += f', {lost} LOST'
        print(
            f'\r{line}\x1b[K' if self._terminal else line, end='' if self._terminal else '\n', flush=True
        )

    def end(self) -> None:
        """End the line."""
        if self._terminal:
            print()


def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; return the exit code."""
    own, ros = _cli.split_arguments(arguments)
    parser = _parser()
    options = _cli.parse(parser, own)
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
    except RecordingError as error:
        if error.summary is not None:
            print(describe(bag, error.summary, complete=False))
        print(f'{PROGRAM}: error: {error}', file=sys.stderr)
        return _cli.FAILED
    print(describe(bag, summary))
    return _cli.DONE


def describe(bag: Path, summary: Summary, *, complete: bool = True) -> str:
    """Return a line about what a bag holds."""
    what = f'{printable(bag, PATH_LIMIT)} is {"complete" if complete else "incomplete"}'
    if summary.start is None or summary.end is None:
        return f'{what} and empty: no message came'
    counts = sorted(summary.topics.items())
    topics = ', '.join(f'{printable(topic)} {count}' for topic, count in counts if count)
    seconds = (summary.end - summary.start) / NANOSECONDS
    lost = f'; {sum(summary.lost.values())} lost' if summary.lost else ''
    return f'{what}: {_cli.counted(summary.messages, "message")} in {seconds:.1f} s ({topics}){lost}'


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
        'complete; 1: it is not (messages were lost, or the disk failed), and why; 2: wrong arguments.',
    )
    parser.add_argument(
        'topics',
        metavar='TOPIC',
        nargs='*',
        help=f'topics; else those of a run: {", ".join(RUN_TOPICS)}',
    )
    parser.add_argument(
        '-o',
        '--output',
        metavar='BAG',
        type=_cli.bag_folder,
        help='the directory to write; run_DATE-TIME',
    )
    parser.add_argument(
        '-s', '--storage', choices=sorted(STORAGES), default='mcap', help='file format; %(default)s'
    )
    parser.add_argument('-a', '--all', action='store_true', help='every topic that is not hidden')
    parser.add_argument('-e', '--regex', type=_pattern, help='topics that this regular expression fits')
    parser.add_argument(
        '--max-duration', metavar='SECONDS', type=_cli.positive, help='end after this long'
    )
    return parser
