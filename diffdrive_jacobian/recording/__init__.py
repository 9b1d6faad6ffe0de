"""Recording of topics as bags, through a journal that survives a crash, and replay of bags."""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_jacobian import lazy

if TYPE_CHECKING:
    from diffdrive_jacobian.recording.playback import COMMANDS, GOALS, NothingToPlayError, Playback
    from diffdrive_jacobian.recording.playing import (
        ReplayProgress,
        ReplayResult,
        describe_too_few,
        replay,
    )
    from diffdrive_jacobian.recording.replayer import Replayer

__all__ = [
    'COMMANDS',
    'GOALS',
    'NothingToPlayError',
    'Playback',
    'ReplayProgress',
    'ReplayResult',
    'Replayer',
    'describe_too_few',
    'replay',
]
if not TYPE_CHECKING:
    # Whoever records does not need what replays.
    __getattr__, __dir__ = lazy.attach(
        __name__,
        {
            'COMMANDS': 'recording.playback',
            'GOALS': 'recording.playback',
            'NothingToPlayError': 'recording.playback',
            'Playback': 'recording.playback',
            'ReplayProgress': 'recording.playing',
            'ReplayResult': 'recording.playing',
            'Replayer': 'recording.replayer',
            'describe_too_few': 'recording.playing',
            'replay': 'recording.playing',
        },
    )
