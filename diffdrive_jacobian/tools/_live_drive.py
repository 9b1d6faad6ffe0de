"""`drive_to --live`: a drive with the page in the browser."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import _cli, _live
from diffdrive_jacobian.tools.drive_to import PROGRAM, controller_parameters, save

if TYPE_CHECKING:
    from diffdrive_jacobian.live.goal_progress import GoalEnd

ENDS = {
    GoalState.SUCCEEDED: 'arrived',
    GoalState.CANCELED: 'canceled',
    GoalState.ABORTED: 'refused or aborted',
}
"""How a goal ended, in words."""


def drive_with_page(
    options: argparse.Namespace, heading: float | None, ros: Sequence[str], signals: Signals
) -> int:
    """Drive with the page until Ctrl-C; return the exit code.

    Args:
        options: Arguments of `drive_to`.
        heading: Heading at the last goal (rad); None: none was given.
        ros: ROS arguments of all nodes.
        signals: Counter of the signals.
    """
    # Not above, where the message about a missing module is not printed.
    from diffdrive_jacobian.drives import DriveError, waypoints_through
    from diffdrive_jacobian.recording.record import open_recording, saved_on_error
    from diffdrive_jacobian.tools._unused_files import warn_of_unused_files

    recording = None
    try:
        from diffdrive_jacobian.live.running import drive_live

        goals: NDArray[np.float64] = np.empty((0, 3))
        if options.coordinates:
            places = np.reshape(options.coordinates, (-1, 2))
            goals = waypoints_through(places, heading or 0.0)
        if not options.no_record:
            recording = open_recording(
                'drive',
                options.output,
                'mcap',
                lossless=options.lockstep,
                replace=options.force,
            )
        with saved_on_error(recording), _live.explaining_port(options.port):
            drive_live(
                goals,
                lockstep=options.lockstep,
                isolated=not options.open,
                parameters=controller_parameters(options),
                recording=recording,
                ros_arguments=ros,
                port=options.port,
                signals=signals,
                ready=_live.announcing(
                    options,
                    waiting='the drive starts' if len(goals) else '',
                    notice=_live.DRIVES if len(goals) else _live.STEERS,
                ),
                nodes_created=lambda names: warn_of_unused_files(PROGRAM, ros, names),
                goal_ended=_report,
            )
    except ModuleNotFoundError as error:
        if (error.name or '').split('.')[0] != 'websockets':
            raise
        return _cli.complain(PROGRAM, _live.MISSING, _cli.FAILED)
    except _live.PortError as error:
        return _cli.complain(PROGRAM, error, _cli.FAILED)
    except UserError as error:
        return _cli.complain(PROGRAM, error)
    except (DriveError, OSError) as error:
        return _cli.complain(PROGRAM, error, _cli.FAILED)
    return _cli.DONE if recording is None else save(recording, plot=False, replace=options.force)


def _report(end: GoalEnd) -> None:
    """Print the end of a goal in one line."""
    where = 'there is no odometry'
    if end.pose is not None:
        x, y, theta = end.pose
        where = (
            f'the robot is at x {x:.3f} m, y {y:.3f} m, heading {theta:.3f} rad, '
            f'{_cli.distances(end.distance, end.true_distance)}'
        )
    robot = '' if end.robot == '/' else f'{end.robot}: '
    print(f'{robot}goal ({end.goal[0]:g}, {end.goal[1]:g}) {ENDS[end.state]}: {where}', flush=True)
