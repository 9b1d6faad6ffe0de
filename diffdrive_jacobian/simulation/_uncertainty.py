"""The uncertainty of a robot's pose along its path, computed when it is first needed.

A robot gets a new state with every command, but its covariance is needed only where it is published.
Each state keeps the arc that led to it and the state before. The moments of the error are evaluated
along these arcs, in their order, so that they are the same to the last bit whenever that happens.
"""

from __future__ import annotations

from typing import TypeAlias

from diffdrive_jacobian.simulation._noise_quadrature import moments_along
from diffdrive_jacobian.simulation.exact_moments import Entries, propagated_moments
from diffdrive_jacobian.simulation.speeds import Piece

Arc: TypeAlias = tuple[float, tuple[float, float] | Piece, float, float, float]
"""Heading at the start (rad), twist (m/s, rad/s), or how it changes with time, duration (s), wheel
separation (m), k (m)."""
MAX_PENDING = 64
"""Number of arcs that are kept at most. One more evaluates those before it, so memory is bounded."""


class Uncertainty:
    """Moments of the error of a pose, given or pending. An immutable value to its users."""

    __slots__ = ('_moments', '_number', '_pending')

    def __init__(self, moments: Entries) -> None:
        """Start from given moments."""
        self._moments: Entries | None = moments
        self._pending: tuple[Uncertainty, Arc] | None = None
        self._number = 0

    def after(self, arc: Arc) -> Uncertainty:
        """Return the uncertainty at the end of an arc, without evaluating it."""
        if self._number >= MAX_PENDING:
            self._evaluate()
        later = object.__new__(Uncertainty)
        later._moments = None
        later._pending = self, arc
        later._number = self._number + 1
        return later

    def moments(self) -> Entries:
        """Return the entries of the moments.

        Raises:
            ValueError: They overflow.
        """
        moments = self._moments
        if moments is None:
            self._evaluate()
            moments = self._moments
            if moments is None:
                raise ValueError('twist and time must give a finite result, but it overflows')
        return moments

    def _evaluate(self) -> None:
        """Evaluate the pending arcs in their order. Several threads may do so at once."""
        waiting = []
        here, pending = self, self._pending
        while pending is not None:
            waiting.append((here, *pending))
            here = pending[0]
            pending = here._pending
        for here, before, arc in reversed(waiting):
            if before._moments is not None:
                # After an overflow there is none.
                theta, twist, dt, L, k = arc
                if isinstance(twist, Piece):
                    here._moments = moments_along(before._moments, theta, twist, dt, L, k)
                else:
                    here._moments = propagated_moments(before._moments, theta, twist, dt, L, k)
            here._number = 0
            # Last, because then the moments count.
            here._pending = None
