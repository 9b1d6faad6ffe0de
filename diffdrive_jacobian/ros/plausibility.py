"""The largest values that messages, parameters and arguments may have."""

MAX_SPEED = 1e3
"""Twists beyond this are not plausible (m/s, rad/s)."""
MAX_POSITION = 1e6
"""Positions beyond this are not plausible (m)."""
