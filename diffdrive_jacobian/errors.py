"""The base class of the errors of this package, and the error of those who start its programs."""

from __future__ import annotations

__all__ = ['DiffdriveError', 'UserError']


class DiffdriveError(Exception):
    """Base class of all errors of this package.

    Some are a ValueError, an OSError or another builtin error, too. An invalid argument of a function is
    a plain ValueError, as in NumPy.
    """


class UserError(DiffdriveError):
    """An argument, a parameter or the environment of a program is invalid; the message names it."""
