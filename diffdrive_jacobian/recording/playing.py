"""Replay of a bag: wait for subscriptions, publish the messages, wait for acknowledgements.

from pathlib import Path

from diffdrive_jacobian.recording import Playback, replay

result = replay(Path('drive_2026_01_31-12_00_00'), Playback(rate=2.0))
print(result.played, result.messages)
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from diffdrive_jacobian.bags.run_reader import open_bag
from diffdrive_jacobian.recording.playback import NODE, Playback
from diffdrive_jacobian.recording.replayer import Replayer
from diffdrive_jacobian.ros.fastdds_profiles import fast_heartbeats
from diffdrive_jacobian.ros.runner import NodeRunner, ros_context, running
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.time_units import seconds

DISCOVERY_PATIENCE = 5.0
"""Default of the longest wait for subscriptions where no number is required (s): an older participant
is announced every 3 s."""
MATCH_QUIET = 0.5
"""Time for which the numbers of subscriptions must not have changed before playback starts (s)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ReplayResult:
    """What became of a replay."""

    started: bool
    """Whether playback started. False: there were not enough subscriptions."""
    played: bool
    """Whether it came to the end of the bag."""
    interrupted: bool
    """Whether a signal ended it."""
    messages: int
    """Number of messages that were published."""
    too_few: dict[str, int] = field(default_factory=dict)
    """If playback did not start: number of subscriptions of each topic that has fewer than required."""
    unacknowledged: tuple[str, ...] = ()
    """Topics with subscriptions that have not acknowledged all messages in time."""
    missing: int = 0
    """If the whole bag was played once: how many messages less than it counts were found in it."""


class ReplayProgress(Protocol):
    """Receives the progress of a replay, and pauses it."""

    def waiting(self, reason: str) -> None:
        """Receive what is waited for, many times a second."""

    def started(self, seconds: float) -> None:
        """Receive the length of what is played (s), once."""

    def playing(self, seconds: float, *, paused: bool) -> None:
        """Receive the position in it (s), many times a second."""

    def toggled(self) -> bool:
        """Return whether to pause, or to resume. It is called many times a second."""

    def ended(self) -> None:
        """Receive that playback has ended, if it started."""


class _Silent:
    """A progress that is not shown, of a replay that is not paused."""

    def waiting(self, reason: str) -> None:
        pass

    def started(self, seconds: float) -> None:
        pass

    def playing(self, seconds: float, *, paused: bool) -> None:
        pass

    def toggled(self) -> bool:
        return False

    def ended(self) -> None:
        pass


def replay(
    bag: Path,
    playback: Playback | None = None,
    *,
    patience: float = DISCOVERY_PATIENCE,
    readers: int | None = None,
    timeout: float = math.inf,
    acknowledgement_timeout: float | None = None,
    ros_arguments: Sequence[str] = (),
    signals: Signals | None = None,
    progress: ReplayProgress | None = None,
) -> ReplayResult:
    """Publish the messages of a bag.

    Args:
        bag: The bag.
        playback: What of it is played, and how. None: the default.
        patience: Longest wait for subscriptions where no number is required (s).
        readers: Number of subscriptions that each topic must have before anything is played. None: those
            that are discovered within `patience`.
        timeout: Longest wait for the required number (s).
        acknowledgement_timeout: Longest wait at the end until all subscriptions have acknowledged all
            messages (s). 0: no limit. None: no wait.
        ros_arguments: ROS arguments of the node.
        signals: Counter of the signals that end the replay. None: no signal does.
        progress: Receives the progress. None: nothing does.

    Raises:
        UserError: The ROS arguments are invalid.
        BagError: The bag cannot be played, or not with these remappings.
        NothingToPlayError: It has no message to play.
    """
    playback, signals, progress = playback or Playback(), signals or Signals(), progress or _Silent()
    with (
        open_bag(bag) as reader,
        nullcontext() if acknowledgement_timeout is None else fast_heartbeats(),
        ros_context([NODE, *ros_arguments]) as context,
        running(context, isolated=False) as runner,
    ):
        player = runner.add(lambda: Replayer(reader, playback, context=context))
        session = _Session(player, runner, signals, progress)
        if readers is None:
            session.wait_for_discovery(patience)
        elif not session.wait_for_readers(readers, timeout):
            return ReplayResult(
                started=False,
                played=False,
                interrupted=signals.count > 0,
                messages=0,
                too_few=_too_few(player, readers),
            )
        _warn(player)
        played = session.play()
        unacknowledged: list[str] = []
        if played and acknowledgement_timeout is not None:
            unacknowledged = session.wait_for_acknowledgements(acknowledgement_timeout)
        return ReplayResult(
            started=True,
            played=played,
            interrupted=signals.count > 0,
            messages=player.sent,
            unacknowledged=tuple(unacknowledged),
            missing=max(0, player.expected - player.sent) if played else 0,
        )


def _warn(player: Replayer) -> None:
    """Log which topics have other publishers, and which have no subscription."""
    for topic, others in player.other_publishers().items():
        player.get_logger().warning(f'{", ".join(others)} also publishes on {topic}')
    for topic in player.unmatched:
        player.get_logger().warning(f'no node is subscribed to {topic} (-w 1 waits for one)')


def _too_few(player: Replayer, readers: int) -> dict[str, int]:
    """Return the number of subscriptions of each topic that has fewer than required."""
    return {topic: number for topic, number in player.readers().items() if number < readers}


def describe_too_few(counts: dict[str, int], readers: int) -> str:
    """Describe which topics have fewer subscriptions than required."""
    return ', '.join(
        f'{topic} has {number} of {readers} subscriptions' for topic, number in counts.items()
    )


class _Unchanged:
    """Measures for how long a value has not changed."""

    def __init__(self) -> None:
        self._value: object = None
        self._since = 0.0

    def seconds(self, value: object) -> float:
        """Return the time since the first call with this value (s)."""
        now = time.monotonic()
        if value != self._value:
            self._value, self._since = value, now
        return now - self._since


class _Session:
    """The stages of a replay."""

    def __init__(
        self, player: Replayer, runner: NodeRunner, signals: Signals, progress: ReplayProgress
    ) -> None:
        self._player = player
        self._runner = runner
        self._signals = signals
        self._progress = progress

    def wait_for_discovery(self, patience: float) -> None:
        """Wait, at most so long (s), until each topic has a subscription and no more are discovered."""
        unchanged = _Unchanged()

        def complete() -> bool:
            counts = self._player.readers()
            quiet = unchanged.seconds(counts)
            without = ', '.join(topic for topic, count in counts.items() if not count)
            self._progress.waiting(
                f'no subscription to {without} (starting after {patience:g} s without it)'
                if without
                else 'further subscriptions may be discovered'
            )
            return not without and quiet >= MATCH_QUIET

        self._runner.spin(complete, timeout=patience, signals=self._signals)

    def wait_for_readers(self, readers: int, timeout: float) -> bool:
        """Wait until each topic has so many subscriptions; return False after a time (s) or a signal."""

        def complete() -> bool:
            missing = _too_few(self._player, readers)
            if missing:
                self._progress.waiting(describe_too_few(missing, readers))
            return not missing

        return self._runner.spin(complete, timeout=timeout, signals=self._signals)

    def play(self) -> bool:
        """Play the bag; return whether it was played to its end."""
        player = self._player
        self._progress.started(seconds(player.end - player.start))

        def done() -> bool:
            if self._progress.toggled():
                player.toggle()
            self._progress.playing(seconds(player.position - player.start), paused=player.paused)
            return player.done

        try:
            player.begin()
            self._runner.spin(done, signals=self._signals)
        finally:
            self._progress.ended()
        return player.done

    def wait_for_acknowledgements(self, seconds: float) -> list[str]:
        """Wait until all subscriptions have acknowledged all messages.

        Args:
            seconds: Longest wait (s). 0: no limit.

        Returns:
            The topics with subscriptions that have not.
        """

        def complete() -> bool:
            if missing := self._player.unacknowledged():
                topics = ', '.join(missing)
                self._progress.waiting(
                    f'not all subscriptions to {topics} have acknowledged all messages'
                )
            return not missing

        if self._runner.spin(complete, timeout=seconds or math.inf, signals=self._signals):
            return []
        return self._player.unacknowledged()
