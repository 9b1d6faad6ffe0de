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

"""What is wrong with a virtual robot beyond its parameters, for tests. Imports no ROS."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.simulation.encoders import Encoders
from diffdrive_jacobian.simulation.robot import Robot, RobotModel
from diffdrive_jacobian.simulation.slip import Drift


class Simulation(Protocol):
    """A simulated robot, as those who change it need it."""

    def time_and_robot(self) -> tuple[int, Robot]:
        """Return the time (ns), and the robot as of its last event until then."""

    def follow(self, robot: Robot) -> None:
        """Go on with another robot, of which the odometry notices nothing."""

    def place(self, robot: Robot) -> None:
        """Go on with another robot, whose odometry starts again at its pose."""

    def remodel(self) -> None:
        """Go on with the model that `RobotDefects.model` returns now."""


class RobotDefects:
    """Changes of the model of a robot, coarse encoders, and pushes.

    From the first one on after which the true pose may differ from the odometry, the model has a drift,
    and the robot publishes `ground_truth`.
    """

    def __init__(self, simulation: Simulation) -> None:
        """Start with a robot that is in order."""
        self._simulation = simulation
        self._changes: list[Callable[[RobotModel], RobotModel]] = []
        self._encoders: Encoders | None = None
        """The encoders at their last reading; None: the angles are exact."""
        self._has_truth = False

    # --- What tests do

    def change(self, change: Callable[[RobotModel], RobotModel]) -> Callable[[], None]:
        """Change the model from now on, and return a function that ends the change.

        Several changes apply in the order of the calls.
        """
        self._changes.append(change)
        self._simulation.remodel()

        def end() -> None:
            self._changes.remove(change)
            self._simulation.remodel()

        return end

    def push(self, displacement: ArrayLike, *, noticed: bool = False) -> None:
        """Displace the robot now, without turning its wheels.

        Args:
            displacement: `[dx, dy, dtheta]` in the body frame, shape (3,) (m, m, rad).
            noticed: Whether the odometry follows, as if corrected by a localisation.

        Raises:
            ValueError: The displacement is invalid.
            MessageError: Simulated time has not started.
        """
        if not noticed:
            self._know_truth()
        now, robot = self._simulation.time_and_robot()
        pushed = robot.pushed(displacement, now, noticed=noticed)
        if noticed:
            self._simulation.place(pushed)
        else:
            self._simulation.follow(pushed)

    def set_encoders(self, per_revolution: int | None) -> None:
        """Report what encoders of so many increments per turn of a wheel count; None: exact angles.

        The odometry goes on from its present pose.

        Raises:
            ValueError: It is not a positive integer.
            MessageError: Simulated time has not started.
        """
        self._know_truth()
        now, robot = self._simulation.time_and_robot()
        before, robot = self._encoders, robot.at(now)
        if before is not None:
            pose = before.read(robot).pose
            robot = robot.placed(pose, robot.covariance, now, odometry_only=True)
        self._encoders = None if per_revolution is None else Encoders.at(robot, per_revolution)
        if before is not None:
            self._simulation.place(robot)

    def _know_truth(self) -> None:
        """Compute the true pose besides that of the odometry from now on."""
        self._has_truth = True
        self._simulation.remodel()

    # --- What the robot asks

    def model(self, nominal: RobotModel) -> RobotModel:
        """Return the model of the robot, given that of its parameters."""
        for change in self._changes:
            nominal = change(nominal)
        if nominal.drift is not None:
            self._has_truth = True
        elif self._has_truth:
            # The true pose is not forgotten.
            return replace(nominal, drift=Drift())
        return nominal

    def reported(self, robot: Robot) -> Robot:
        """Read the encoders, and return the robot as they report it."""
        if self._encoders is None:
            return robot
        self._encoders = self._encoders.read(robot)
        return self._encoders.reported(robot)

    def odometry_pose(self, robot: Robot) -> NDArray[np.float64]:
        """Return `[x, y, theta]` of the odometry, shape (3,), by the last reading of encoders."""
        return np.array(robot.pose_tuple if self._encoders is None else self._encoders.pose)

    def placed(self, robot: Robot) -> None:
        """Start the odometry again at the pose of the robot."""
        if self._encoders is not None:
            self._encoders = self._encoders.read(robot).placed(robot.pose_tuple)
