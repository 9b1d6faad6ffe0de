"""Comparison of recorded ground truth with the simulated robot."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.bags.run import Run
from diffdrive_jacobian.numerics.elementary import wrap
from diffdrive_jacobian.parameters.declaration import ParameterError, from_ros
from diffdrive_jacobian.parameters.virtual_robot import VirtualRobotParameters
from diffdrive_jacobian.simulation.robot import Robot
from diffdrive_jacobian.simulation.slip import Drift

NODE = 'virtual_robot'


class TruthDifferences(NamedTuple):
    """Differences of ground truth and simulated robot at each of n messages of ground_truth."""

    distances: NDArray[np.float64]
    """Differences of the position, shape (n,) (m)."""
    headings: NDArray[np.float64]
    """Differences of the heading, not negative, shape (n,) (rad)."""


def recorded_drift(run: Run) -> Drift | None:
    """Return in what the true motion of the recorded robot differs from its odometry.

    None: in nothing, or its parameters were not recorded.
    """
    try:
        return from_ros(VirtualRobotParameters, run.of_node(NODE)).drift()
    except ParameterError:
        return None


def truth_differences(run: Run, robots: Iterable[Robot]) -> TruthDifferences | None:
    """Compare the ground truth of a run with simulated robots at the same stamps.

    Args:
        run: The run.
        robots: Simulated robots. Messages whose stamp none of them has are left out.

    Returns:
        The differences. None: there is nothing to compare, or the robots have no drift.
    """
    at = {robot.stamp: robot for robot in robots if robot.model.drift is not None}
    truth = run.ground_truth
    rows = [index for index, stamp in enumerate(truth.stamps.tolist()) if stamp in at]
    if not rows:
        return None
    simulated = np.array([at[stamp].true_pose_tuple for stamp in truth.stamps[rows].tolist()])
    difference: NDArray[np.float64] = truth.values[rows, :3] - simulated
    return TruthDifferences(np.hypot(difference[:, 0], difference[:, 1]), np.abs(wrap(difference[:, 2])))


def placed_as_recorded(run: Run, placed: tuple[Robot, Robot]) -> Robot:
    """Return which of two placements of a robot the ground truth after it fits.

    Args:
        run: The run.
        placed: The robot whose true pose was placed, and the one whose odometry alone was reset.
    """
    truth = run.ground_truth
    later = np.flatnonzero(truth.stamps > placed[0].stamp)
    if placed[0].model.drift is None or not len(later):
        return placed[0]
    stamp, place = int(truth.stamps[later[0]]), truth.values[later[0], :2]

    def apart(robot: Robot) -> float:
        return float(np.hypot(*(robot.at(stamp).true_pose[:2] - place)))

    return min(placed, key=apart)
