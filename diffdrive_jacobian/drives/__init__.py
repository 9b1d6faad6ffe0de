"""Drives of the virtual robot to goals, with all nodes in this process."""

from diffdrive_jacobian.drives.driving import (
    DriveError,
    DriveProgress,
    Outcome,
    drive,
    in_lockstep,
    in_real_time,
    waypoints_through,
)

__all__ = [
    'DriveError',
    'DriveProgress',
    'Outcome',
    'drive',
    'in_lockstep',
    'in_real_time',
    'waypoints_through',
]
