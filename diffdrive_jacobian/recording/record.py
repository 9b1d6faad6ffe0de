"""Recording of topics of other processes until a signal, a time or an error."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from rclpy.exceptions import NameValidationException
from rclpy.node import Node

from diffdrive_jacobian.bags.bag_writer import Summary
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.messages.topics import OF_EVERY_NODE, Selection
from diffdrive_jacobian.recording.recorder import Recorder
from diffdrive_jacobian.recording.recording import Recording, RecordingError
from diffdrive_jacobian.ros.rate_limit import TokenBucket
from diffdrive_jacobian.ros.runner import ros_context, running
from diffdrive_jacobian.signals import Signals

NAME = 'record_run'
"""Name of the node."""
DISCOVERY_PERIOD = 0.2
"""Time between two searches for new topics (s)."""
WAIT_SHOWN = 0.5
"""A wait for late messages that is longer than this is shown (s)."""


class Status(NamedTuple):
    """The state of a recording."""

    messages: int
    """Number of messages received."""
    topics: int
    """Number of topics."""
    size: int
    """Size of the journal (bytes)."""
    seconds: float
    """Time since the start (s)."""
    lost: int
    """Number of messages that are known to be lost."""
    missing: tuple[str, ...] = ()
    """Topics that were selected by name and had no publisher so far, fully qualified."""
    published: tuple[str, ...] = ()
    """Topics of other nodes that have a publisher, if no topic is recorded. For messages."""


def open_recording(
    prefix: str,
    output: str | None,
    storage: str,
    *,
    lossless: bool = False,
    replace: bool = False,
) -> Recording:
    """Start a `Recording` to a path of the user; None: `PREFIX_DATE-TIME` in the current directory.

    Raises:
        OSError: The bag exists or cannot be written. The message names it.
    """
    try:
        if output is None:
            return Recording.named_by_time(prefix, storage, lossless=lossless)
        return Recording(Path(output), storage, lossless=lossless, replace=replace)
    except OSError as error:
        where = output or 'this directory'
        raise OSError(f'cannot record to {where}: {(error.strerror or str(error)).lower()}') from error


@contextmanager
def saved_on_error(recording: Recording | None) -> Iterator[None]:
    """Finish a recording if an exception is raised; discard it if that is a `UserError`.

    Without an exception the recording stays open.
    """
    try:
        yield
    except UserError:
        # Nothing ran.
        if recording is not None:
            recording.discard()
        raise
    except BaseException:
        # The first error is the one to report.
        if recording is not None:
            with suppress(RecordingError):
                recording.finish()
        raise


def record(
    recording: Recording,
    selection: Selection | None = None,
    *,
    max_duration: float | None = None,
    ros_arguments: Sequence[str] = (),
    signals: Signals | None = None,
    on_status: Callable[[Status], object] | None = None,
    on_wait: Callable[[Sequence[str]], object] | None = None,
    on_end: Callable[[], object] | None = None,
) -> Summary:
    """Record until a signal is caught, the time is over, ROS is shut down or the disk fails.

    Args:
        recording: Where to record. It is finished, or discarded on a `UserError`.
        selection: Which topics. None: those of a run.
        max_duration: Longest duration (s). None: no limit.
        ros_arguments: ROS arguments of the node.
        signals: Counter of the signals that end the recording. None: no signal does.
        on_status: Receives the status, several times a second.
        on_wait: Called if late messages are waited for at the end, with their topics.
        on_end: Called when nothing more is received, before the bag is written.

    Returns:
        What the bag contains.

    Raises:
        UserError: The ROS arguments are invalid.
        RecordingError: The recording is not complete.
    """
    signals = signals or Signals()
    with saved_on_error(recording):
        if not signals.count:
            _receive(
                recording,
                selection or Selection(),
                ros_arguments,
                signals,
                max_duration,
                on_status or (lambda status: None),
                on_wait or (lambda topics: None),
            )
    if on_end is not None:
        on_end()
    return recording.finish()


def _receive(
    recording: Recording,
    selection: Selection,
    ros_arguments: Sequence[str],
    signals: Signals,
    max_duration: float | None,
    on_status: Callable[[Status], object],
    on_wait: Callable[[Sequence[str]], object],
) -> None:
    with (
        ros_context([NAME, *ros_arguments]) as context,
        running(context, isolated=False, with_info=True) as runner,
    ):
        recorder = runner.add(lambda: Recorder(selection, recording, with_info=True, context=context))
        discovery = TokenBucket(1, DISCOVERY_PERIOD)

        def failed() -> bool:
            if discovery.permits(time.monotonic()):
                recorder.discover()
                on_status(_status(recorder, recording))
            return recording.error is not None

        left = math.inf if max_duration is None else recording.started + max_duration - time.monotonic()
        if runner.spin(failed, timeout=left, signals=signals) or not context.ok():
            return
        recorder.end()
        before = signals.count
        drained = runner.spin(recorder.drained, timeout=WAIT_SHOWN, signals=signals, handled=before)
        if not drained:
            if recorder.awaited and signals.count == before:
                on_wait(recorder.awaited)
            drained = runner.spin(recorder.drained, signals=signals, handled=before)
        if not drained and signals.count > before:
            recorder.give_up('a second signal ended the wait for late messages')


def _status(recorder: Recorder, recording: Recording) -> Status:
    return Status(
        messages=recorder.messages,
        topics=len(recorder.topics),
        size=recording.journal.size,
        seconds=time.monotonic() - recording.started,
        lost=sum(recording.lost.values()),
        missing=tuple(recorder.missing),
        published=() if recorder.topics else tuple(_published(recorder)),
    )


def _published(node: Node) -> list[str]:
    """Return the topics that have a publisher. Those that every node publishes are left out."""
    found = []
    for topic, _ in sorted(node.get_topic_names_and_types()):
        # A DDS application without ROS can use any name.
        with suppress(ValueError, NameValidationException):
            if topic not in OF_EVERY_NODE and node.count_publishers(topic):
                found.append(topic)
    return found
