"""Errors of the exploration."""

from __future__ import annotations

from diffdrive_jacobian.errors import DiffdriveError


class ExplorationError(DiffdriveError):
    """An exploration cannot be done; the message says why, and what to change."""
