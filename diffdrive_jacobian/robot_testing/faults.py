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

"""Faults of the robot itself: its motors, wheels, encoders, and where it stands.

They change the model of a `VirtualRobot` while it runs, also of one that is created later or again.
`odom` shows what the motors do, and only `ground_truth` what happens between wheel and ground.
`cmd_vel_out` has the motion of the wheels that results.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, ClassVar

from rclpy.node import Node

from diffdrive_jacobian.faults.fault import Fault, Undo
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._injection import Injection
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.numerics.checks import (
    Finite,
    Name,
    Positive,
    between,
    integer,
    number,
    one_of,
)
from diffdrive_jacobian.simulation.actuators import time_constant
from diffdrive_jacobian.simulation.encoders import MAX_PER_REVOLUTION
from diffdrive_jacobian.simulation.robot import RobotModel
from diffdrive_jacobian.simulation.slip import MAX_SEED, Drift

DECAY = 7.0
"""Time constants after which a robot whose motors lag stands still: exp(-7) is 0.001."""
Wheel = Annotated[str, one_of('left', 'right')]
Multiplier = Annotated[float, partial(number, check=between(0.01, 100.0))]


@dataclass(frozen=True, repr=False)
class RobotFault(Fault):
    """A fault of a `VirtualRobot`, by the name of its node."""

    robot: Name = field(default='virtual_robot', kw_only=True)

    @abstractmethod
    def apply(self, robot: VirtualRobot, injection: Injection) -> Undo | None:
        """Begin the fault. Return what ends it; None: nothing does."""

    def install(self, injection: Injection) -> None:
        """Apply the fault to the robot, whenever there is one during the fault."""
        name, world = injection.gate(self.robot).name, injection.world
        affected: Node | None = None
        undo: Undo | None = None

        def meet() -> None:
            nonlocal affected, undo
            robot = world.find(name) if injection.active else None
            if robot is None or robot is affected:
                return
            if not isinstance(robot, VirtualRobot):
                raise LockstepError(
                    f'{self!r} needs a VirtualRobot, but node {name} is a {type(robot).__name__}'
                )
            affected, undo = robot, self.apply(robot, injection)
            if self.at_once:
                injection.end()

        def begin() -> Undo:
            meet()
            return end

        def end() -> None:
            if undo is not None and affected is world.find(name):
                undo()

        injection.when_nodes_change(meet)
        injection.during(begin)

    @property
    def affected_node(self) -> str:
        """Name of its node."""
        return self.robot


@dataclass(frozen=True, repr=False)
class DeadWheel(RobotFault):
    """The motor of a wheel is dead: its wheel, 'left' or 'right', stands still, whatever is commanded.

    A command to drive straight turns the robot about that wheel, as `odom` and `joint_states` show.
    """

    wheel: Wheel

    def apply(self, robot: VirtualRobot, injection: Injection) -> Undo:
        """Stop the wheel."""
        return robot.defects.change(_saturating(self.wheel, 0.0))


@dataclass(frozen=True, repr=False)
class SaturatedWheel(RobotFault):
    """The motor of a wheel, 'left' or 'right', is weak: it turns at most at `max_velocity` (rad/s).

    The robot does not know, so the path bends to the side of that wheel, as `odom` and `joint_states`
    show. Its parameter `max_wheel_velocity`, in contrast, slows both wheels and keeps the curvature.
    """

    wheel: Wheel
    max_velocity: Positive

    def apply(self, robot: VirtualRobot, injection: Injection) -> Undo:
        """Limit the wheel."""
        return robot.defects.change(_saturating(self.wheel, self.max_velocity))


@dataclass(frozen=True, repr=False)
class ActuatorLag(RobotFault):
    """The motors lag: the wheel speeds approach the commanded ones with first order.

    Of a step of the command `1 - exp(-t / seconds)` is reached after the time t, also of a stop. The
    motion is exact, and `odom` and `joint_states` show it. `cmd_vel_out` has the commands, and
    `/fault_events` the lag: `verify_run` needs both. Of several lags, and the parameter `wheel_lag`, the
    longest one counts.

    Attributes:
        seconds: Time constant (s).
    """

    seconds: Annotated[float, time_constant]

    def apply(self, robot: VirtualRobot, injection: Injection) -> Undo:
        """Set the lag of the motors."""
        return robot.defects.change(
            lambda model: replace(model, actuators=model.actuators.lagging(self.seconds))
        )

    def reaction_delay(self, node: Node, since: float, now: float) -> float:
        """Return the time after which the wheels have followed a command (s)."""
        return DECAY * self.seconds if self.overlap(since, now) > -DECAY * self.seconds else 0.0


@dataclass(frozen=True, repr=False)
class EncoderSteps(RobotFault):
    """The wheel encoders are coarse: they count whole increments, `per_revolution` in a turn of a wheel.

    `odom` is integrated from the counts at each publication, by one exact arc with the distances counted
    since the one before. `joint_states` and the twist in `odom` are what was counted. The motion itself
    is unchanged: `ground_truth` shows it. Each wheel is known to one increment, so the heading in `odom`
    is off by less than `2 r increment / L`. After the fault the odometry goes on from where it is.
    """

    per_revolution: Annotated[int, partial(integer, low=1, high=MAX_PER_REVOLUTION)]

    def apply(self, robot: VirtualRobot, injection: Injection) -> Undo:
        """Set the resolution of the encoders."""
        robot.defects.set_encoders(self.per_revolution)
        return lambda: robot.defects.set_encoders(None)


@dataclass(frozen=True, repr=False)
class Slip(RobotFault):
    """The wheels slip at random over the ground, as with the parameter `simulate_slip`.

    `odom` and `joint_states` do not notice. `ground_truth` shows where the robot truly is, also after
    the fault. The parameter `wheel_travel_variance` says how much the wheels slip.
    """

    def apply(self, robot: VirtualRobot, injection: Injection) -> Undo:
        """Start the slip of the wheels."""
        seed = injection.rng('slip').randint(0, MAX_SEED)
        return robot.defects.change(
            lambda model: replace(model, drift=replace(_drift(model), seed=seed))
        )


@dataclass(frozen=True, repr=False)
class WrongGeometry(RobotFault):
    """The true wheels or their separation differ from what the odometry assumes, or a wheel skids.

    `odom` and `joint_states` do not notice. `ground_truth` shows where the robot truly is, also after
    the fault. The multipliers are relative to the assumed values, and multiply the parameters
    `true_left_wheel_radius_multiplier` and so on. A left wheel that skids, and travels half the distance
    that it turns, has `left_wheel_radius_multiplier=0.5`.
    """

    left_wheel_radius_multiplier: Multiplier = 1.0
    right_wheel_radius_multiplier: Multiplier = 1.0
    wheel_separation_multiplier: Multiplier = 1.0

    def apply(self, robot: VirtualRobot, injection: Injection) -> Undo:
        """Change the true geometry."""

        def differ(model: RobotModel) -> RobotModel:
            drift = _drift(model)
            products = {name: getattr(drift, name) * getattr(self, name) for name in _MULTIPLIERS}
            return replace(model, drift=replace(drift, **products))

        return robot.defects.change(differ)


@dataclass(frozen=True, repr=False)
class Push(RobotFault):
    """Somebody pushes the robot, or lifts it elsewhere: its pose is displaced at once, at `start`.

    The wheels do not turn, so `odom` and `joint_states` do not notice, and `ground_truth` shows it. With
    `noticed` the odometry is displaced too, as if corrected by a localisation, and a new `start_pose` is
    published. It happens once, and is over then, whatever the duration.

    Attributes:
        dx: Displacement forward (m).
        dy: Displacement to the left (m).
        dtheta: Turn, counter-clockwise (rad).
        noticed: Whether the odometry shows it.
    """

    dx: Finite = 0.0
    dy: Finite = 0.0
    dtheta: Finite = 0.0
    noticed: bool = False

    at_once: ClassVar[bool] = True

    def apply(self, robot: VirtualRobot, injection: Injection) -> None:
        """Displace the robot."""
        robot.defects.push((self.dx, self.dy, self.dtheta), noticed=self.noticed)


_MULTIPLIERS = (
    'left_wheel_radius_multiplier',
    'right_wheel_radius_multiplier',
    'wheel_separation_multiplier',
)


def _drift(model: RobotModel) -> Drift:
    return model.drift or Drift()


def _saturating(wheel: str, speed: float) -> Callable[[RobotModel], RobotModel]:
    """Return a change of the model that limits the speed of a wheel (rad/s)."""
    return lambda model: replace(model, actuators=model.actuators.weakened(wheel, speed))
