"""Errors of messages."""

from __future__ import annotations

from diffdrive_jacobian.errors import DiffdriveError


class MessageError(DiffdriveError, ValueError):
    """A message with invalid content."""
