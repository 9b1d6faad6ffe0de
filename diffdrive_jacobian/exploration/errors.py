"""Errors of the exploration."""

from __future__ import annotations


class ExplorationError(Exception):
    """An exploration cannot be done; the message says why, and what to change."""
