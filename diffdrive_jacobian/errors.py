"""The base class of the errors of this package, and what its programs end with."""

from __future__ import annotations

__all__ = ['DiffdriveError', 'InterruptionError', 'NotDoneError', 'UserError']


class DiffdriveError(Exception):
    """Base class of all errors of this package.

    Some are a ValueError, an OSError or another builtin error, too. An invalid argument of a function is
    a plain ValueError, as in NumPy.
    """


class UserError(DiffdriveError):
    """An argument, a parameter or the environment of a program is invalid; the message names it."""


class NotDoneError(DiffdriveError):
    """What was asked for in the right way was not done: a file cannot be written, for example."""


class InterruptionError(DiffdriveError):
    """The caller or a signal ended something before it was done. The message says what is left."""
