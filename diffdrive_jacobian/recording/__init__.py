"""Recording of topics as bags, which the command `record_run` does, and replay of bags.

A recording goes through a journal that survives a crash.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_jacobian import lazy

if TYPE_CHECKING:
    from diffdrive_jacobian.recording.progress import ReplayProgress
    from diffdrive_jacobian.recording.replaying import (
        COMMANDS,
        GOALS,
        NothingToPlayError,
        Playback,
        Replayer,
        ReplayResult,
        describe_too_few,
        replay,
    )

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
    _MODULES = dict.fromkeys(__all__, 'recording.replaying') | {'ReplayProgress': 'recording.progress'}
    __getattr__, __dir__ = lazy.attach(__name__, _MODULES)
