"""The uncertainty of a robot's pose along its path, computed when it is first needed.

A robot gets a new state with every command, but its covariance is needed only where it is published.
Each state keeps the arc that led to it and the state before. The covariance is evaluated along these
arcs, in their order, so that it is the same to the last bit whenever it is evaluated.
"""

from __future__ import annotations

from typing import TypeAlias

from diffdrive_jacobian.simulation.odometry_noise import Entries, propagated_entries

Arc: TypeAlias = tuple[float, tuple[float, float], float, float, float]
"""Heading at the start (rad), twist (m/s, rad/s), duration (s), wheel separation (m), k (m)."""
MAX_PENDING = 64
"""Number of arcs that are kept at most. One more evaluates those before it, so memory is bounded."""


class Uncertainty:
    """Covariance of a pose, given or pending. An immutable value to its users."""

    __slots__ = ('_entries', '_number', '_pending')

    def __init__(self, entries: Entries) -> None:
        """Start from the entries xx, xy, xt, yy, yt, tt of a covariance."""
        self._entries: Entries | None = entries
        self._pending: tuple[Uncertainty, Arc] | None = None
        self._number = 0

    def after(self, arc: Arc) -> Uncertainty:
        """Return the uncertainty at the end of an arc, without evaluating it."""
        if self._number >= MAX_PENDING:
            self._evaluate()
        later = object.__new__(Uncertainty)
        later._entries = None
        later._pending = self, arc
        later._number = self._number + 1
        return later

    def entries(self) -> Entries:
        """Return the entries xx, xy, xt, yy, yt, tt.

        Raises:
            ValueError: They overflow.
        """
        entries = self._entries
        if entries is None:
            self._evaluate()
            entries = self._entries
            if entries is None:
                raise ValueError('twist and time must give a finite result, but it overflows')
        return entries

    def _evaluate(self) -> None:
        """Evaluate the pending arcs in their order. Several threads may do so at once."""
        waiting = []
        here, pending = self, self._pending
        while pending is not None:
            waiting.append((here, *pending))
            here = pending[0]
            pending = here._pending
        for here, before, arc in reversed(waiting):
            if before._entries is not None:
                # After an overflow there is none.
                here._entries = propagated_entries(before._entries, *arc)
            here._number = 0
            # Last, because then the entries count.
            here._pending = None
