"""Replay of recorded messages."""

from diffdrive_jacobian.replay.playback import COMMANDS, GOALS, NothingToPlayError, Playback
from diffdrive_jacobian.replay.playing import (
    ReplayProgress,
    ReplayResult,
    describe_too_few,
    replay,
)
from diffdrive_jacobian.replay.replayer import Replayer

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
