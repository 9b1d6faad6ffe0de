# Copyright 2026 The diffdrive_jacobian developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
