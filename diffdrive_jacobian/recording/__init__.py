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
