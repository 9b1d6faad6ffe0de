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

"""Controllers with one defect each, as students write them, and the one without a defect.

`Controller` drives to the goals of `goal_pose` by the odometry. It publishes `cmd_vel` and
`goal_status`, and has the service `cancel_goal`. Each of the others overrides what its author got wrong.
`PROPERTIES`, `RELATIONS` and `drive` are what a tester requires who does not know the defects: the same
of all. The twelve of `DEFECTIVE` violate a property, the four of `ARRIVING` only relations.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.time import Time
from std_srvs.srv import Trigger

from diffdrive_jacobian.messages.conversion import set_time
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.properties import (
    AccelerationWithin,
    ArrivesOnceFaultsEnd,
    KeepsDriving,
    NeverFasterThan,
    NoCommandAfterCancel,
    NoStaleGoals,
    PoseFinite,
    StatusProtocol,
    StaysWithin,
    StopsAfterLastCommand,
    StopsAfterLostOdometry,
    StopsOnShutdown,
    end_of_faults,
)
from diffdrive_jacobian.relations import Late, Mirrored, Moved, Renamed, Repeated, Shifted

MAX_V, MAX_OMEGA = 1.0, 3.0
"""Largest commands (m/s, rad/s)."""
ACCELERATION_V, ACCELERATION_OMEGA = 1.0, 8.0
"""Rates of change of the commands (m/s^2, rad/s^2)."""
LONGEST_STEP = 0.05
"""Longest time for which a command may change at once (s)."""
TOLERANCE = 0.03
"""Distance at which the robot has arrived (m)."""
TIMEOUT = 0.5
"""Time without odometry after which the robot is stopped (s)."""
LONGEST_AGE = 0.3
"""Age beyond which odometry is not used (s)."""


def seconds(stamp):
    return Time.from_msg(stamp).nanoseconds / 1e9


class Controller(Node):
    """The controller without a defect."""

    def __init__(self):
        super().__init__('controller', start_parameter_services=False)
        self.goal = None
        self.executing = False
        self.pose = None
        self.command = 0.0, 0.0
        self.commanded = self.received = 0.0
        self.newest_goal = self.newest_odometry = -math.inf
        self.cmd_vel = self.create_publisher(Twist, 'cmd_vel', 10)
        self.status = self.create_publisher(GoalStatus, 'goal_status', 10)
        self.create_subscription(Odometry, 'odom', self.on_odometry, 10)
        self.create_subscription(PoseStamped, 'goal_pose', self.on_goal, 10)
        self.create_service(Trigger, 'cancel_goal', self.on_cancel)
        self.watch()

    def watch(self):
        """Look after the odometry."""
        self.create_timer(0.1, self.on_timer)

    def now(self):
        return self.get_clock().now().nanoseconds / 1e9

    # --- Goals

    def on_goal(self, goal):
        if self.is_stale(goal):
            if self.goal is None or goal.header.stamp != self.goal.header.stamp:
                self.publish_status(goal, GoalStatus.STATUS_ABORTED)
            return
        if self.goal is not None:
            self.publish_status(self.goal, GoalStatus.STATUS_CANCELED)
        self.goal, self.executing = goal, False
        self.publish_status(goal, GoalStatus.STATUS_ACCEPTED)

    def is_stale(self, goal):
        """Return whether a goal is not newer than the newest one."""
        stamp = seconds(goal.header.stamp)
        if self.newest_goal > self.now():
            # Time was reset.
            self.newest_goal = -math.inf
        if stamp <= self.newest_goal:
            return True
        self.newest_goal = stamp
        return False

    def on_cancel(self, _, response):
        self.stop()
        response.success = self.goal is not None
        if self.goal is not None:
            self.end(GoalStatus.STATUS_CANCELED)
        return response

    def end(self, status):
        self.publish_status(self.goal, status)
        self.goal, self.executing = None, False

    def publish_status(self, goal, status):
        message = GoalStatus(status=status)
        message.goal_info.stamp = goal.header.stamp
        self.status.publish(message)

    # --- Odometry

    def on_odometry(self, odometry):
        now = self.now()
        if not self.is_fresh(seconds(odometry.header.stamp), now):
            return
        self.received = now
        self.pose = self.pose_of(odometry)
        if self.goal is None:
            return
        if not self.executing:
            self.executing = True
            self.publish_status(self.goal, GoalStatus.STATUS_EXECUTING)
        dx, dy = self.to_goal(self.goal)
        if math.hypot(dx, dy) > TOLERANCE:
            self.publish_command(*self.ramp(*self.law(dx, dy, self.pose[2]), now))
        else:
            self.stop()
            twist = odometry.twist.twist
            if abs(twist.linear.x) < 0.01 and abs(twist.angular.z) < 0.05:
                self.end(GoalStatus.STATUS_SUCCEEDED)

    def is_fresh(self, stamp, now):
        """Return whether odometry is newer than that before, and not old."""
        if self.newest_odometry > now:
            # Time was reset.
            self.newest_odometry = -math.inf
        if not 0.0 <= now - stamp <= LONGEST_AGE or stamp <= self.newest_odometry:
            return False
        self.newest_odometry = stamp
        return True

    def pose_of(self, odometry):
        position, q = odometry.pose.pose.position, odometry.pose.pose.orientation
        return position.x, position.y, 2.0 * math.atan2(q.z, q.w)

    def to_goal(self, goal):
        x, y, _ = self.pose
        return goal.pose.position.x - x, goal.pose.position.y - y

    def on_timer(self):
        """Stop the robot if odometry is missing, or if the clock went back."""
        if self.command != (0.0, 0.0) and not 0.0 <= self.now() - self.received <= TIMEOUT:
            self.stop()

    # --- Commands

    def law(self, dx, dy, theta):
        """Return the twist towards the goal."""
        alpha = self.wrap(math.atan2(dy, dx) - theta)
        return math.hypot(dx, dy) * max(0.0, math.cos(alpha)), 3.0 * alpha

    def wrap(self, angle):
        return math.remainder(angle, math.tau)

    def ramp(self, v, omega, now):
        """Return the command towards a twist that the acceleration allows."""
        time = self.step(now)
        v = min(max(v, -MAX_V), MAX_V)
        omega = min(max(omega, -MAX_OMEGA), MAX_OMEGA)
        return (
            approach(self.command[0], v, ACCELERATION_V * time),
            approach(self.command[1], omega, ACCELERATION_OMEGA * time),
        )

    def step(self, now):
        """Return the time since the last command."""
        time, self.commanded = now - self.commanded, now
        return min(max(time, 0.0), LONGEST_STEP)

    def publish_command(self, v, omega):
        self.command = v, omega
        message = Twist()
        message.linear.x, message.angular.z = v, omega
        self.cmd_vel.publish(message)

    def stop(self):
        if self.command != (0.0, 0.0):
            self.publish_command(0.0, 0.0)

    def destroy_node(self):
        self.stop()
        super().destroy_node()


def approach(value, target, change):
    return min(max(target, value - change), value + change)


# --- Their defects


class NoOdometryTimeout(Controller):
    """Nobody notices that odometry is missing."""

    def watch(self):
        pass


class WrongWrap(Controller):
    """Angles repeat after a full turn, not after half of one."""

    def wrap(self, angle):
        return math.fmod(angle, math.pi)


class WrongTimeStep(Controller):
    """The time since the last command is taken to be the period of the odometry."""

    def step(self, now):
        return LONGEST_STEP


class IgnoresCancel(Controller):
    """A goal that waits for odometry is not canceled."""

    def on_cancel(self, _, response):
        self.stop()
        response.success = self.executing
        if self.executing:
            self.end(GoalStatus.STATUS_CANCELED)
        return response


class StaleGoals(Controller):
    """Every goal is the newest."""

    def is_stale(self, goal):
        return False


class AssumesOrder(Controller):
    """Odometry is taken to come before the first goal."""

    def on_goal(self, goal):
        distance = math.hypot(*self.to_goal(goal))
        self.get_logger().info(f'goal in {distance:.1f} m')
        super().on_goal(goal)


class DividesByDistance(Controller):
    """The sine of the angle to the goal is computed before it is known that there is a distance."""

    def to_goal(self, goal):
        dx, dy = super().to_goal(goal)
        self.sine = dy / math.hypot(dx, dy)
        return dx, dy

    def law(self, dx, dy, theta):
        bearing = (
            math.asin(self.sine) if dx >= 0.0 else math.copysign(math.pi, dy) - math.asin(self.sine)
        )
        alpha = self.wrap(bearing - theta)
        return math.hypot(dx, dy) * max(0.0, math.cos(alpha)), 3.0 * alpha


class NoStopOnShutdown(Controller):
    """It leaves as it is."""

    def destroy_node(self):
        super(Controller, self).destroy_node()


class AnswersTwice(Controller):
    """A goal that has succeeded is canceled, too."""

    last = None

    def end(self, status):
        self.last = self.goal
        super().end(status)

    def on_cancel(self, request, response):
        if self.goal is None and self.last is not None:
            self.publish_status(self.last, GoalStatus.STATUS_CANCELED)
        return super().on_cancel(request, response)


class Drifts(Controller):
    """The pose is added up from the twists, one period for each message."""

    def pose_of(self, odometry):
        if self.pose is None:
            return super().pose_of(odometry)
        x, y, theta = self.pose
        v, omega = odometry.twist.twist.linear.x, odometry.twist.twist.angular.z
        theta += 0.5 * omega * LONGEST_STEP
        step = v * LONGEST_STEP
        return (
            x + step * math.cos(theta),
            y + step * math.sin(theta),
            theta + 0.5 * omega * LONGEST_STEP,
        )


class TrustsStamps(Controller):
    """Stamps are taken to increase, and never to lie in the future."""

    def is_fresh(self, stamp, now):
        if now - stamp > LONGEST_AGE or stamp <= self.newest_odometry:
            return False
        self.newest_odometry = stamp
        return True

    def on_timer(self):
        if self.command != (0.0, 0.0) and self.now() - self.newest_odometry > TIMEOUT:
            self.stop()


class OverflowsAtPi(Controller):
    """The difference of two angles is taken to be an angle."""

    def wrap(self, angle):
        return angle


class WrapsBelowOnly(Controller):
    """Angles above a half turn stay."""

    def wrap(self, angle):
        return angle + math.tau if angle < -math.pi else angle


class OldOdometry(Controller):
    """Odometry may come again, or out of order."""

    def is_fresh(self, stamp, now):
        return 0.0 <= now - stamp <= LONGEST_AGE


class SinglePrecision(Controller):
    """The time of the last command is kept as float32."""

    def step(self, now):
        return super().step(float(np.float32(now)))


class AbsoluteNames(Controller):
    """Who drives the robot is in no namespace."""

    def create_publisher(self, kind, topic, *args, **kwargs):
        return super().create_publisher(kind, f'/{topic.lstrip("/")}', *args, **kwargs)


DEFECTIVE = {
    'no odometry timeout': NoOdometryTimeout,
    'wrong wrap of angles': WrongWrap,
    'integrates dt wrongly': WrongTimeStep,
    'ignores cancel': IgnoresCancel,
    'acts on stale goals': StaleGoals,
    'assumes message order': AssumesOrder,
    'divides by distance': DividesByDistance,
    'does not stop on shutdown': NoStopOnShutdown,
    'answers twice': AnswersTwice,
    'drifts with lost messages': Drifts,
    'trusts stamps': TrustsStamps,
    'overflows at pi': OverflowsAtPi,
}
ARRIVING = {
    'wraps angles below -pi only': WrapsBelowOnly,
    'uses old odometry': OldOdometry,
    'time in single precision': SinglePrecision,
    'absolute names': AbsoluteNames,
}
CONTROLLERS = {'no defect': Controller, **DEFECTIVE, **ARRIVING}


# --- What is required of them

LAST_EVENT = 6.0
"""Time at which all faults have ended, and all goals were sent (s)."""
DRIVE = 10.0
"""Longest time to reach a goal (s)."""
PROPERTIES = (
    NeverFasterThan(MAX_V, MAX_OMEGA),
    AccelerationWithin(1.2, 9.6, slack=0.15),
    StopsAfterLostOdometry(0.7),
    StopsAfterLastCommand(0.6),
    StopsOnShutdown(),
    NoCommandAfterCancel(),
    StatusProtocol(),
    NoStaleGoals(),
    ArrivesOnceFaultsEnd(DRIVE, tolerance=0.1),
    KeepsDriving(2.0, tolerance=0.1),
    PoseFinite(),
    StaysWithin((-10.0, 10.0), (-10.0, 10.0)),
)

RELATIONS = (
    *(Moved(), Mirrored(), Shifted(), Renamed(), Late('odom')),
    *(Repeated('odom'), Repeated('odom', after=0.12), Repeated('goal_pose')),
)


def drive(world, case):
    """Send goals to a controller, cancel them, and shut it down.

    The case has the name of the `controller`, the `start` of the robot, `goals` as a list of a time and
    a position each, and the times of `cancel` and `shutdown`, or None.
    """
    values = {**dict(zip(('x', 'y', 'theta'), case['start'], strict=True)), 'publish_rate': 20.0}
    overrides = [Parameter(name, value=value) for name, value in values.items()]
    world.create(lambda: VirtualRobot(parameter_overrides=overrides))
    world.create(CONTROLLERS[case['controller']])
    goals = world.node.create_publisher(PoseStamped, 'goal_pose', 10)
    cancel = world.node.create_client(Trigger, 'cancel_goal')

    def send(position):
        message = PoseStamped()
        message.pose.position.x, message.pose.position.y = position
        message.pose.orientation.w = 1.0
        set_time(message.header.stamp, world.now)
        goals.publish(message)

    def shut_down():
        for node in world.nodes:
            if node.get_name() == 'controller':
                node.destroy_node()

    def run_to(time):
        if (left := time - world.world_time / 1e9) > 0.0:
            world.run_for(left)

    events = [(time, partial(send, position)) for time, position in case['goals']]
    if case['cancel'] is not None:
        events.append((case['cancel'], lambda: cancel.call_async(Trigger.Request())))
    if case['shutdown'] is not None:
        events.append((case['shutdown'], shut_down))
    for time, act in sorted(events, key=lambda event: event[0]):
        run_to(time)
        act()
        world.settle()
    end = max(LAST_EVENT, end_of_faults(world))
    # After faults without an end nothing is due.
    end = LAST_EVENT if end == math.inf else end
    run_to(LAST_EVENT + 1.0 if case['shutdown'] is not None else end + DRIVE + 0.2)
