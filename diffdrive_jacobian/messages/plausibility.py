"""Largest plausible values of messages, parameters and arguments."""

MAX_SPEED = 1e3
"""Largest plausible speed (m/s) and yaw rate (rad/s)."""
MAX_POSITION = 1e6
"""Largest plausible coordinate of a position (m)."""
MAX_WHEEL_SPEED = 1e6
"""Largest plausible wheel speed (rad/s). It corresponds to `MAX_SPEED` at the smallest wheel radius that
the nodes accept, 1e-3 m."""
