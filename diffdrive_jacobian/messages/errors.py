"""Errors of messages."""


class MessageError(ValueError):
    """A message with invalid content."""
