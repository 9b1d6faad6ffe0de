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

"""What the nodes virtual_robot, wheel_bridge and go_to_goal do around their values, without ROS.

Each takes values of messages with the time at which they are received, and publishes others. There is
one of each, in one time that never goes back, and nobody else: what the nodes do about that is not here.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.control import Arrival
from diffdrive_jacobian.drives.read_values import read_route
from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.messages.codecs import Command, Motion, Place, Route, State, Status, Wheels
from diffdrive_jacobian.messages.conversion import (
    command_time,
    from_covariance,
    plausible_twist,
)
from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.nodes.advice import gain_warnings, limit_warnings, path_warnings
from diffdrive_jacobian.nodes.odometry_rate import OdometryRate
from diffdrive_jacobian.nodes.steering import STANDSTILL, Goal, Pursuit, Steering
from diffdrive_jacobian.parameters.go_to_goal import GoToGoalParameters
from diffdrive_jacobian.parameters.virtual_robot import VirtualRobotParameters
from diffdrive_jacobian.parameters.wheel_bridge import WheelBridgeParameters
from diffdrive_jacobian.simulation.actuators import ramp
from diffdrive_jacobian.simulation.robot import Robot
from diffdrive_jacobian.simulation.speeds import Profile
from diffdrive_jacobian.time_units import NANOSECONDS, nanoseconds

Publish = Callable[[str, Any], None]
"""Receives the topic and the value of a message."""
LOG = logging.getLogger(__name__)


class Deadline:
    """The time at which an input has stayed away for too long, as `ros.watchdog.Watchdog` has it."""

    def __init__(self, timeout: float) -> None:
        """Wait for nothing until it is fed. The timeout is in s; 0: it never expires."""
        self.at = math.inf
        """When to look (ns); infinity: nothing is waited for."""
        self._timeout = nanoseconds(timeout)
        self._fed = 0

    def feed(self, now: int) -> None:
        """Restart the timeout at a time (ns)."""
        self._fed = now
        if self._timeout and self.at == math.inf:
            self.at = now + self._timeout

    def stop(self) -> None:
        """Wait for nothing until it is fed again."""
        self.at = math.inf

    def expires(self, now: int) -> bool:
        """Return whether the timeout is over at a time (ns), and then wait for nothing."""
        if now < self.at:
            return False
        end = self._fed + self._timeout
        self.at = end if now < end else math.inf
        return now >= end


class DrivenRobot:
    """What the node virtual_robot does, driven by its wheels."""

    def __init__(self, parameters: VirtualRobotParameters, now: int, publish: Publish) -> None:
        """Place it at the pose of its parameters, at a time (ns)."""
        self.parameters = parameters
        self._robot = Robot(model=parameters.model(), stamp=now, pose=self._initial_pose())
        self._publish = publish
        self._names = parameters.wheel_names
        self._interval = 1.0 / parameters.publish_rate
        # As rclpy has timers: the period is rounded down, and a clock that starts later skips some.
        self._period = int(self._interval * NANOSECONDS)
        self.next = (now // self._period + 1) * self._period
        """When it publishes next (ns)."""
        self._publish_start()

    def true_pose(self, now: int) -> NDArray[np.float64]:
        """Return `[x, y, theta]` where it truly is, shape (3,) (m, m, rad)."""
        return self._robot.at(now).true_pose

    def publish(self, now: int) -> None:
        """Publish the odometry and the wheels of a time (ns)."""
        self.next += self._period
        self._stop_in_silence(now)
        robot = self._robot.at(now)
        covariances = robot.covariance_tuple, robot.twist_covariance_tuple(self._interval)
        self._publish('odom', Motion(now, robot.pose_tuple, robot.twist, *covariances))
        wheels = Wheels.of(now, self._names, robot.wheel_speeds, robot.wheel_angles)
        self._publish('joint_states', wheels)
        if robot.model.drift is not None:
            self._publish('ground_truth', Motion(now, robot.true_pose_tuple, robot.true_twist))

    def follow(self, wheels: Wheels, now: int) -> None:
        """Follow a command, or raise MessageError."""
        v, omega = self._robot.model.twist(*wheels.speeds(self._names))
        twist = plausible_twist(v, omega)
        self._stop_in_silence(now)
        robot = self._robot
        time = command_time(wheels.stamp, now, robot.stamp, robot.model.command_timeout)
        self._robot = robot.commanded(twist, time)
        self._publish_applied()

    def place(self, place: Place, now: int) -> None:
        """Start at another pose, or raise MessageError."""
        self._stop_in_silence(now)
        covariance = from_covariance(place.covariance)
        self._robot = self._robot.placed(np.array(place.pose), covariance, now)
        self._publish_start()

    def reset_odometry(self, now: int) -> None:
        """Start the odometry at the pose of the parameters again. The robot stays where it is."""
        self._stop_in_silence(now)
        pose, covariance = self._initial_pose(), np.zeros((3, 3))
        self._robot = self._robot.placed(pose, covariance, now, odometry_only=True)
        self._publish_start()

    def change(self, parameters: VirtualRobotParameters, now: int) -> None:
        """Go on with another model, whose rate of publishing and initial pose are the same."""
        self._stop_in_silence(now)
        before, model = self._robot, parameters.model()
        self.parameters = parameters
        if model != before.model:
            self._robot = before.remodelled(model, now, wheels_commanded=True)
            takes_time = model.takes_time or before.model.takes_time
            if self._robot.target != before.target or takes_time:
                self._publish_applied()

    def _initial_pose(self) -> NDArray[np.float64]:
        parameters = self.parameters
        return np.array([parameters.x, parameters.y, se2.wrap_angle(parameters.theta)])

    def _publish_start(self) -> None:
        robot = self._robot
        self._publish('start_pose', Place(robot.stamp, robot.pose_tuple, robot.covariance_tuple))

    def _stop_in_silence(self, now: int) -> None:
        expiry = self._robot.expiry
        if expiry is not None and expiry <= now:
            self._robot = self._robot.at(expiry)
            self._publish_applied()

    def _publish_applied(self) -> None:
        self._publish('cmd_vel_out', Command(self._robot.target, self._robot.stamp))


class Bridge:
    """What the node wheel_bridge does."""

    def __init__(self, parameters: WheelBridgeParameters, publish: Publish) -> None:
        """Start with wheels that stand."""
        self.parameters = parameters
        self.silence = Deadline(parameters.cmd_vel_timeout)
        self.next = math.inf
        """When it publishes next, while the wheels accelerate within limits (ns)."""
        self._period = nanoseconds(1.0 / parameters.publish_rate)
        self._model, self._names = parameters.model(), parameters.wheel_names
        self._acceleration = parameters.acceleration_limits()
        self._publish = publish
        self._twist = self._target = STANDSTILL
        self._profile: Profile | None = None

    def follow(self, command: Command, now: int) -> None:
        """Publish the wheel speeds of a command, or start to approach them within the limits."""
        self.silence.feed(now)
        self._follow(command.twist, now)

    def stop_in_silence(self, now: int) -> None:
        """Stop the wheels, unless they stand: no command was received for the timeout."""
        if self._twist != STANDSTILL or self._target != STANDSTILL:
            self._follow(STANDSTILL, now)

    def approach(self, now: int) -> None:
        """Publish the present speeds, which approach the commanded ones."""
        assert self._profile is not None
        self.next += self._period
        self._send(self._profile.twist(self._profile.seconds(now)), now)
        if now >= self._profile.settled_at:
            self.next = math.inf

    def _follow(self, command: tuple[float, float], now: int) -> None:
        self._target = target = self._model.limited(command)
        if self._acceleration.unlimited:
            self._send(target, now)
            return
        start = self._twist
        if self._profile is not None:
            start = self._profile.twist(self._profile.seconds(now))
        self._profile = Profile(now, [*ramp(start, target, self._acceleration, self._model)])
        self.next = now
        self.approach(now)

    def _send(self, twist: tuple[float, float], now: int) -> None:
        self._twist = twist
        self._publish('joint_command', Wheels.of(now, self._names, self._model.wheel_speeds(*twist)))


class Driver:
    """What the node go_to_goal does with goals one after the other, and with odometry in order."""

    def __init__(self, parameters: GoToGoalParameters, publish: Publish) -> None:
        """Start without a goal."""
        self.parameters = parameters
        self.silence = Deadline(parameters.odom_timeout)
        self.pursuit: Pursuit | None = None
        """The goal and how far the robot has got. None: there is no goal."""
        self._publish = publish
        self._steering = Steering(parameters)
        self._rate = OdometryRate()
        self._stamp = (0, 0)
        self._driving = self._executing = self._stale = False
        self._advised: set[str] = set()
        self._advise()

    @property
    def arrival(self) -> Arrival:
        """Arrival criterion according to the parameters."""
        return self._steering.arrival

    # --- Goals

    def accept(self, sent: Route, along_path: bool, now: int) -> None:
        """Take a goal in place of the one before, or refuse it."""
        try:
            route = read_route(sent, along_path=along_path)
            goal = Goal.along_path(route) if along_path else Goal.through(route)
        except ValueError as error:
            self._refuse(sent.stamp, error)
            return
        before, pursuit = self.pursuit, Pursuit.of(goal)
        if before is not None:
            self._report(GoalState.CANCELED)
        if before is not None and before.goal.is_same_path(goal):
            pursuit = before
        else:
            self._stale = False
            self._steering.reset()
            self._rate.begin()
        if not self._driving:
            self.silence.feed(now)
        self.pursuit, self._stamp, self._executing = pursuit, sent.stamp, False
        self._report(GoalState.ACCEPTED)
        self._advise()

    def _refuse(self, stamp: tuple[int, int], error: ValueError) -> None:
        """Report that a goal is aborted. The one that is driven to is kept."""
        LOG.warning('goal refused: %s', error)
        self._publish('goal_status', Status(int(GoalState.ABORTED), stamp))
        if self.pursuit is not None:
            self._report(GoalState.EXECUTING if self._executing else GoalState.ACCEPTED)

    def cancel(self, now: int) -> bool:
        """Stop the robot, and end the goal; return whether there was one."""
        if self.pursuit is None:
            return False
        self._end(GoalState.CANCELED, now)
        return True

    # --- Odometry

    def steer(self, state: State, now: int) -> None:
        """Answer odometry with the next command towards the goal."""
        if self.pursuit is None:
            return
        self.silence.feed(now)
        if not self._rate.measured:
            self._rate.receive(now)
        if not self._executing and not self._begin(self.pursuit, state, now):
            return
        if self._stale:
            self._stale = False
            self._steering.reset()
        before = self.pursuit
        try:
            self.pursuit, command = self._steering.command(before, state, now, self._rate.hz)
        except ValueError as error:
            LOG.warning('goal aborted: %s', error)
            self._end(GoalState.ABORTED, now)
            return
        if self.pursuit.missed and not before.missed:
            LOG.warning('a waypoint was missed: driving to it and those after it one by one')
        if command is None:
            self._end(GoalState.SUCCEEDED, now)
        else:
            self._send(command)

    def _begin(self, pursuit: Pursuit, state: State, now: int) -> bool:
        try:
            self.pursuit = self._steering.begin(pursuit, state.pose)
        except ValueError as error:
            LOG.warning('goal refused: %s', error)
            self._end(GoalState.ABORTED, now, unless_silent=True)
            return False
        self._executing = True
        self._report(GoalState.EXECUTING)
        return True

    def wait(self, now: int) -> None:
        """Stop the robot because no odometry was received for the timeout, and keep the goal."""
        self._stale = self._stale or self._executing
        if self._driving:
            self._stop_robot(now)

    def _end(self, state: GoalState, now: int, *, unless_silent: bool = False) -> None:
        """Stop the robot, and end the goal. `unless_silent`: only if it was this that moved it."""
        if self._driving or not unless_silent:
            self._stop_robot(now)
        self.silence.stop()
        self.pursuit = None
        self._report(state)

    # --- Parameters

    def change(self, parameters: GoToGoalParameters) -> None:
        """Go on with other laws, gains and limits, and the same timeout."""
        before = self._steering
        self.parameters, self._steering = parameters, Steering(parameters, before)
        self._advised.clear()
        self._advise()
        if self.pursuit is not None and self._steering.drives_otherwise(before):
            self.pursuit = self.pursuit.resumed()

    def _advise(self) -> None:
        """Warn of limits and gains that do not suit, once of each; without a goal, of all."""
        found = limit_warnings(self.parameters.limits())
        goal = None if self.pursuit is None else self.pursuit.goal
        if goal is None or goal.path is None:
            found += gain_warnings(self.parameters)
        passing = goal is not None and self.parameters.pass_waypoints and len(goal.poses) > 1
        if goal is None or goal.path is not None or passing:
            found += path_warnings(self.parameters)
        for warning in found:
            if warning not in self._advised:
                self._advised.add(warning)
                LOG.warning('%s', warning)

    # --- Publishing

    def _stop_robot(self, now: int) -> None:
        self._steering.stopped(now)
        self._send(STANDSTILL)

    def _send(self, twist: tuple[float, float]) -> None:
        self._driving = twist != STANDSTILL
        self._publish('cmd_vel', Command(twist))

    def _report(self, state: GoalState) -> None:
        self._publish('goal_status', Status(int(state), self._stamp))
