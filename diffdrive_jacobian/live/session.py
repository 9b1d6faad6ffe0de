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

"""What the server and the nodes share: the latest state one way, the commands the other way.

Each method may be called from any thread, and none waits. Nodes store their latest state, whether or
not a page reads it. A slow page receives fewer states, never older ones.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from diffdrive_jacobian.live.commands import Command
from diffdrive_jacobian.live.robot_state import Trail

MAX_COMMANDS = 256
"""Largest number of commands that wait."""
MAX_NOTICES = 50
"""Largest number of notices that are kept."""

Level = Literal['info', 'warning', 'error']


@dataclass(frozen=True, slots=True)
class Share:
    """Whom a page is shared with."""

    address: str
    """Address of this machine by which guests reach it."""
    control: bool = False
    """Whether they may steer."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Snapshot:
    """State of all robots at one time. Nothing in it is changed later."""

    robots: Sequence[Mapping[str, Any]] = ()
    """One JSON object for each robot; `name` is unique."""
    trails: Mapping[str, Trail] = field(default_factory=dict)
    """Path of each robot, by name."""
    true_trails: Mapping[str, Trail] = field(default_factory=dict)
    """Its path by the ground truth, by name."""
    world: Mapping[str, Any] = field(default_factory=dict)
    """Simulated time or bag: what can be controlled."""
    fixed: Mapping[str, Any] = field(default_factory=dict)
    """What seldom changes, sent only if it did."""


class Page:
    """One open page: what it has received so far."""

    def __init__(self, number: int, notice: int) -> None:
        """Start after a notice."""
        self.number = number
        self._version = -1
        self._notice = notice
        self._fixed: Mapping[str, Any] | None = None
        self._trails: dict[tuple[str, str], tuple[Trail, int]] = {}

    def frame(self, session: Session) -> dict[str, Any] | None:
        """Return what has changed since the last frame. None: nothing."""
        version, snapshot = session.latest()
        notices = session.notices_after(self._notice)
        if version == self._version and not notices:
            return None
        frame: dict[str, Any] = {'robots': snapshot.robots, 'world': snapshot.world}
        self._version = version
        if notices:
            self._notice = notices[-1]['number']
            frame['notices'] = notices
        if snapshot.fixed != self._fixed:
            self._fixed = frame['fixed'] = snapshot.fixed
        frame['paths'] = self._paths('paths', snapshot.trails)
        frame['true_paths'] = self._paths('true_paths', snapshot.true_trails)
        return frame

    def _paths(self, kind: str, trails: Mapping[str, Trail]) -> dict[str, Any]:
        found = {}
        for name, trail in trails.items():
            known, count = self._trails.get((kind, name), (None, 0))
            start = count if known is trail else 0
            # Points may be appended meanwhile.
            points = trail.points[start:]
            self._trails[kind, name] = trail, start + len(points)
            if points or known is not trail:
                found[name] = {'new': known is not trail, 'points': points}
        return found


class Session:
    """The state that is shown, the pages that show it, and the commands that they sent."""

    def __init__(self) -> None:
        """Start without a state, pages and commands."""
        self._lock = threading.Lock()
        self._version, self._snapshot = 0, Snapshot()
        self._commands: deque[tuple[int, Command]] = deque()
        self._notices: deque[dict[str, Any]] = deque(maxlen=MAX_NOTICES)
        self._last_notice = self._last_page = 0
        self._pages: frozenset[int] = frozenset()

    # --- From the nodes

    @property
    def watched(self) -> bool:
        """Whether a page is open."""
        return bool(self._pages)

    def is_open(self, page: int) -> bool:
        """Return whether a page is still connected."""
        return page in self._pages

    def store(self, snapshot: Snapshot) -> None:
        """Replace the state that pages receive."""
        with self._lock:
            self._version += 1
            self._snapshot = snapshot

    def take_commands(self) -> list[tuple[int, Command]]:
        """Return the commands since the last call, each with the number of its page."""
        if not self._commands:
            return []
        with self._lock:
            commands = list(self._commands)
            self._commands.clear()
        return commands

    def notify(self, text: str, level: Level = 'info') -> None:
        """Show a notice on all pages."""
        with self._lock:
            self._last_notice += 1
            self._notices.append({'number': self._last_notice, 'level': level, 'text': text})

    # --- From the server

    def latest(self) -> tuple[int, Snapshot]:
        """Return the latest state with its version."""
        with self._lock:
            return self._version, self._snapshot

    def notices_after(self, number: int) -> list[dict[str, Any]]:
        """Return the notices after one of them."""
        if self._last_notice == number:
            return []
        with self._lock:
            return [notice for notice in self._notices if notice['number'] > number]

    def enter(self) -> Page:
        """Return a new page."""
        with self._lock:
            self._last_page += 1
            page = Page(self._last_page, self._last_notice)
            self._pages |= {page.number}
        return page

    def leave(self, page: Page) -> None:
        """Remove a page. What it drives by hand stops."""
        with self._lock:
            self._pages -= {page.number}

    def put(self, page: Page, command: Command) -> bool:
        """Store a command for the nodes. Return False if too many are waiting."""
        with self._lock:
            if len(self._commands) >= MAX_COMMANDS:
                return False
            self._commands.append((page.number, command))
        return True
