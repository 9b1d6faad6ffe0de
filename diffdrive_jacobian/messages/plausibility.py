"""The largest values that messages, parameters and arguments may have."""

MAX_SPEED = 1e3
"""Twists beyond this are not plausible (m/s, rad/s)."""
MAX_POSITION = 1e6
"""Positions beyond this are not plausible (m)."""
MAX_WHEEL_SPEED = 1e6
"""Wheel speeds beyond this are not plausible (rad/s): the rim of the smallest wheel that the nodes
accept, 1e-3 m, then exceeds `MAX_SPEED`."""
