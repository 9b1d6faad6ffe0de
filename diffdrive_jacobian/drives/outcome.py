# Copyright 2026 The diffdrive_jacobian developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What a drive returns, and what it tells meanwhile. Imports no ROS."""

from __future__ import annotations

import math
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.control import Path
from diffdrive_jacobian.errors import NotDoneError
from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.signals import Signals

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from diffdrive_jacobian.bags.run import Run
    from diffdrive_jacobian.plots.film import Film
    from diffdrive_jacobian.recording.recording import Recording

STANDING = 1e-3
"""Speed and yaw rate up to which a robot is said to have stopped (m/s, rad/s)."""
SETTLING = 0.1
"""Odometry this much later than the last command shows its effect (s)."""
STOP_PATIENCE = 2.0
"""Longest time in which the robot may come to rest at the end, and report that (s)."""


class DriveError(NotDoneError):
    """A drive in simulated time was aborted. The message says why."""


@dataclass(frozen=True, kw_only=True, slots=True, repr=False, eq=False)
class Outcome:
    """The end of a drive, and its run."""

    status: int
    """Status of the goals, as in action_msgs/GoalStatus."""
    interrupted: bool
    """Whether a signal ended the drive."""
    pose: NDArray[np.float64] | None
    """`[x, y, theta]` where the robot stopped, shape (3,) (m, m, rad). None: there was no odometry."""
    moving: bool
    """Whether it still moved then noticeably, `STOP_PATIENCE` after the end."""
    distance: float
    """Distance from the driven point to the last goal by the odometry, of a path what remained (m)."""
    true_distance: float
    """The same by the ground truth (m). NaN: the robot has no drift."""
    across: float
    """Greatest distance of the robot from the path by the odometry (m). NaN: it was not driven along
    one."""
    late: float
    """How much later than by the trajectory the robot arrived (s). NaN: it did not, or there were no
    times."""
    tolerance: float
    """Distance that counted as arrived (m). A robot that takes time to stop may have left it again."""
    offset: float
    """x of the driven point in the body frame (m). 0: the axle centre."""
    seconds: float
    """Duration (s), in lockstep of simulated time."""
    kept: Run | None = None
    """The run, if it was kept."""

    @property
    def arrived(self) -> bool:
        """Whether the robot arrived at the last goal."""
        return self.status == GoalState.SUCCEEDED

    @property
    def run(self) -> Run:
        """The run: what robot, bridge and controller published.

        Raises:
            ValueError: It was not kept.
        """
        if self.kept is None:
            raise ValueError(
                'the run was not kept: drive had a runner, a recording that the caller finishes, or '
                'keep=False'
            )
        return self.kept

    @property
    def table(self) -> dict[str, NDArray[np.float64]]:
        """Columns by name, one value for each odometry message, as `bags.table.table`.

        Raises:
            ValueError: The run was not kept.
        """
        return self.run.table()

    def plot(self) -> Figure:
        """Return a figure of the run, as `plot_run` draws it.

        Raises:
            ValueError: The run was not kept.
            ModuleNotFoundError: matplotlib is not installed.
        """
        from diffdrive_jacobian.plots.run_pictures import run_figure

        return run_figure(self.run)

    def animate(self, speed: float | None = None) -> Film:
        """Return a film of the run, which a notebook shows and `save` writes.

        Args:
            speed: How much faster than it was the film is. None: 1, or as a film of a long run needs.

        Raises:
            ValueError: The run was not kept, or the speed is not positive or too small.
            ModuleNotFoundError: matplotlib is not installed.
        """
        from diffdrive_jacobian.plots.film import Film

        return Film(self.run, speed=speed)

    def __repr__(self) -> str:
        """Return the end of the drive in one line."""
        state = GoalState(self.status)
        end = 'interrupted' if self.interrupted else 'timed out'
        end = state.word if state.ended else end
        where = 'without odometry'
        if self.pose is not None:
            x, y, theta = self.pose
            where = f'at x {x:.3f}, y {y:.3f}, theta {theta:.3f}'
        if not math.isnan(self.true_distance):
            where += f', truly {self.true_distance:.2f} m from the goal'
        return f'Outcome({end} {where}, after {self.seconds:.1f} s)'

    def _repr_html_(self) -> str:
        """Return the end of the drive and its picture, for notebooks."""
        text = f'<p>{escape(repr(self))}</p>'
        if self.kept is None:
            return text
        try:
            from diffdrive_jacobian.plots.rendering import render

            picture = render(self.plot(), 'svg')
        except ModuleNotFoundError:
            return f'{text}<p>matplotlib draws it: pip install matplotlib</p>'
        return f'{text}<img src="data:image/svg+xml;base64,{b64encode(picture).decode()}">'


class DriveProgress(Protocol):
    """Receives the progress of a drive."""

    def nodes_created(self, names: Sequence[str]) -> None:
        """Receive the fully qualified names of the nodes, once."""

    def driving(self, seconds: float, index: int, distance: float, wheels: tuple[float, float]) -> None:
        """Receive the state of the drive, many times a second.

        Args:
            seconds: Time since the start (s), in lockstep simulated time.
            index: Index of the current goal.
            distance: Distance from the driven point to that goal (m).
            wheels: Speeds of the right and the left wheel (rad/s).
        """


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Request:
    """What is asked of a drive, however it is done. The fields are the arguments of `drives.drive`."""

    goals: NDArray[np.float64] | Path
    """Poses, shape (n, 3), or a path."""
    relative: bool
    timeout: float
    laws: Mapping[str, Any]
    """Laws of the caller's own, a `controller` or a `path_controller`."""
    parameters: Mapping[str, Any]
    robot_parameters: Mapping[str, Any]
    recording: Recording | None
    """It is finished by the caller."""
    keep: bool
    """Whether the run is kept in memory."""
    signals: Signals
    progress: DriveProgress | None


def waypoints_through(places: ArrayLike, heading: float = 0.0) -> NDArray[np.float64]:
    """Return waypoints with a heading at each place.

    Args:
        places: `[x, y]` of each place, shape (n, 2) (m).
        heading: Heading at the last place (rad).

    Returns:
        `[x, y, theta]`, shape (n, 3) (m, m, rad). theta is the direction to the next place.

    Raises:
        ValueError: `places` has another shape, or is empty.
    """
    places = np.asarray(places, dtype=np.float64)
    if places.ndim != 2 or places.shape[1] != 2 or not len(places):
        raise ValueError(f'places must have shape (n, 2) with n > 0, got {places.shape}')
    dx, dy = np.diff(places, axis=0).T
    return np.column_stack([places, [*np.arctan2(dy, dx), heading]])
