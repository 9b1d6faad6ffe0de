"""Errors of lockstep."""

from __future__ import annotations


class LockstepError(Exception):
    """A condition was not met in time, simulated time could not advance, or lockstep was misused.

    The first line of the message describes the error. The last messages of all topics may follow.
    """
