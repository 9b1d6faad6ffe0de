"""What goes wrong in a lockstep world."""

from __future__ import annotations


class LockstepError(Exception):
    """A condition did not come true, time could not pass, or the world was misused.

    The first line of the message names it; the last messages of every topic follow where they help.
    """
