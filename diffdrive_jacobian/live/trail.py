"""The path of a robot for the page, with a bounded number of points."""

from __future__ import annotations

import math

MAX_POINTS = 6000
"""Largest number of points of a path."""
SPACING = 0.01
"""Distance between two points of a path (m). It doubles when the path is full, unless jumps fill it."""
JUMP = 0.3
"""A longer step is not a motion: the path is interrupted (m)."""


class Trail:
    """A path. Points are only appended; when they are too many, `thinned` returns a new path."""

    def __init__(self, spacing: float = SPACING) -> None:
        """Start without points, with a distance between them (m)."""
        self.points: list[tuple[float, float] | None] = []
        """`(x, y)` of each point (m). None: the path is interrupted there."""
        self._spacing = spacing

    def extended(self, x: float, y: float, jump: float = JUMP) -> Trail:
        """Add a position, and return the path: this one, or a new one if this one was full.

        Args:
            x: Position (m).
            y: Likewise.
            jump: Step from which the path is interrupted (m).
        """
        last = self.points[-1] if self.points else None
        step = math.inf if last is None else math.hypot(x - last[0], y - last[1])
        if step < self._spacing:
            return self
        if last is not None and step > jump:
            self.points.append(None)
        self.points.append((round(x, 4), round(y, 4)))
        return self if len(self.points) < MAX_POINTS else self._thinned()

    def _thinned(self) -> Trail:
        if self.points.count(None) > MAX_POINTS // 4:
            # Pieces would not become fewer: the oldest are forgotten.
            trail = Trail(self._spacing)
            trail.points = self.points[MAX_POINTS // 2 :]
            return trail
        trail = Trail(2.0 * self._spacing)
        trail.points = [
            point for index, point in enumerate(self.points) if point is None or index % 2 == 0
        ]
        return trail
