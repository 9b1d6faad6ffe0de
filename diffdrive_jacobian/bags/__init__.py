"""Runs as rosbag2 bags: recorded so that a crash costs a moment, recovered, read, replayed, verified."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from diffdrive_jacobian.bags.reading import BagError, Run, Series, read_run

__all__ = ['BagError', 'Run', 'Series', 'read_run']


def __getattr__(name: str) -> Any:
    """Import the reading of bags, which needs rclpy, when it is asked for."""
    if name not in __all__:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    from diffdrive_jacobian.bags import reading

    return getattr(reading, name)
